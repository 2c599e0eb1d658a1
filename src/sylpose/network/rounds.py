"""Rounds in which all cameras that take part hear the same: one camera's side, pure, (state, inbox) -> (state, packets).

In each round every camera tells all others one thing, and a round ends when it has heard them all. Nobody can be more than
one round ahead, since that takes what this camera tells; who is one behind is told again. So loss and delay cost time and
change nothing.

A camera that is silent for long is given up, by all alike: each that misses it says so, with what it has heard of it in this
round, until all that are left give up the same ones. What any of them had heard of those counts for all, or else nothing
does; from then on they take no part. Whom a camera gives up only grows, and who has ended a round says how instead of
agreeing to anything else; so no two cameras that listen to each other end it differently. One camera's word alone excludes
nobody that the others hear.

Between two rounds, cameras may join: all members have to begin the next one with the same newcomers, each of which is told
what there is to know.

A round's epoch is a digest of all that was told before it, and by whom: what was said in one means nothing in another. So a
camera that tells each listener something else is found out with the next word of any of them. Then all tell each other
digests of what they heard of whom (`liars`), those that lie are members no more, and the others begin a round in which
nothing is told, from which they go back to where they last were alike.

Source: view synchrony, K. Birman, T. Joseph, "Exploiting virtual synchrony in distributed systems" (1987); what listeners
tell each other of what they heard, L. Lamport, R. Shostak, M. Pease, "The Byzantine generals problem" (1982), section 3, of
digests and only where something is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from sylpose.network.byzantine import NOBODY_LIES, Blame, claim, verdict
from sylpose.network.wire_format import (
    DISPUTES,
    ENDED,
    GIVES_UP,
    MOST_CAMERAS,
    RELAYS,
    TELLS,
    WORKS,
    Welcome,
    Word,
    digest,
    entered,
    following,
    message,
    passed_on,
    read_word,
    welcomed,
)
from sylpose.sylvester.distributed.messages import Inbox, Packet

__all__ = ["PATIENCE", "Agreeing", "Patience", "agree_next", "agree_start", "agree_step"]

# Ticks after which a camera says again what it has said, or that it is at work, and of these so many after which a newcomer
# is welcomed again: that is long (choice).
AGAIN, TOUR = 2, 5


class Patience(NamedTuple):
    """Ticks. silent: after so many without a word of it, a camera is given up; long: those of a round after which it is that
    has not told what it has to tell, or does not agree on who is given up."""

    silent: int
    long: int


PATIENCE = Patience(30, 120)  # (choice)
# Where nobody joins.
NO_WELCOME = Welcome(0, 0, frozenset(), b"")


@dataclass(frozen=True, eq=False)
class Agreeing:
    """One camera among others.

    Attributes:
        camera: its number. members: who takes part, this one included.
        round: counts from 0; epoch: of its own newcomers.
        own: what it tells in this round.
        patience: with the others.
        welcome: for newcomers, and newcomers: who has not spoken yet of those that joined with this round.
        heard: camera -> what it told in this round; early: of those one ahead, the epoch and what they told in the next one.
        before, left_before, epoch_before: camera -> what it told in the round before, who left with that, and its epoch.
        odd: whose words say that they heard something else before this round; stray: those words.
        claims: once there is a dispute about that, camera -> what it says that it heard; relays: and then what it received
            of that from each.
        blame: who is known to lie, and which pairs of whom one does. again: this round is one after which all go back.
            outcast: this camera itself is one of those that leave.
        silent: camera -> ticks without a word of it. waited: ticks of this round.
        giving_up: whom this camera gives up. consent: camera -> whom that one does, and what it has heard of these.
        ends: camera -> the same, with which it has ended this round. ended: so many agree on that, that it is so.
        outcome: camera -> what it told, once the round is over; those that left unheard are missing.
        refused: camera -> why its first bad message was not read.
    """

    camera: int
    members: tuple[int, ...]
    round: int
    epoch: int
    own: bytes
    heard: Mapping[int, bytes]
    patience: Patience = PATIENCE
    welcome: Welcome = NO_WELCOME
    newcomers: frozenset[int] = frozenset()
    early: Mapping[int, tuple[int, bytes]] = field(default_factory=dict)
    before: Mapping[int, bytes] = field(default_factory=dict)
    left_before: frozenset[int] = frozenset()
    epoch_before: int = 0
    odd: frozenset[int] = frozenset()
    stray: Mapping[int, tuple[int, bytes]] = field(default_factory=dict)
    claims: Mapping[int, bytes] = field(default_factory=dict)
    relays: Mapping[int, Mapping[int, bytes]] = field(default_factory=dict)
    blame: Blame = NOBODY_LIES
    again: bool = False
    outcast: bool = False
    silent: Mapping[int, int] = field(default_factory=dict)
    waited: int = 0
    giving_up: frozenset[int] = frozenset()
    consent: Mapping[int, Word] = field(default_factory=dict)
    ends: Mapping[int, Word] = field(default_factory=dict)
    ended: bool = False
    outcome: Mapping[int, bytes] | None = None
    refused: Mapping[int, str] = field(default_factory=dict)

    @property
    def others(self) -> tuple[int, ...]:
        """The members but this one and those that it gives up."""
        return tuple(c for c in self.members if c != self.camera and c not in self.giving_up)


def agree_start(
    camera: int,
    members: Sequence[int],
    own: bytes,
    *,
    number: int = 0,
    epoch: int = 0,
    patience: Patience = PATIENCE,
    blame: Blame = NOBODY_LIES,
) -> tuple[Agreeing, list[Packet]]:
    """A camera, and what it tells in its first round.

    Args:
        number, epoch: of that round, for one that joins others.
        blame: from groups before.

    Raises:
        ValueError: cameras that are not among 0 to 1,023, or this one not among them.
    """
    if camera not in members or min(members) < 0 or max(members) >= MOST_CAMERAS:
        raise ValueError(f"camera {camera} of {list(members)}: expected one of some of 0 to {MOST_CAMERAS - 1}")
    who, heard = tuple(sorted(members)), {camera: own}
    s = Agreeing(camera, who, number, epoch, own, heard, patience, blame=blame, epoch_before=epoch)
    return _settled(s), _packets(s.others, _tells(s))


def agree_next(
    state: Agreeing, own: bytes, newcomers: frozenset[int] = frozenset(), welcome: bytes = b""
) -> tuple[Agreeing, list[Packet]]:
    """The next round, once there is an outcome.

    Args:
        newcomers: who joins with it, the same at all members; welcome: what these have to know.
    """
    assert state.outcome is not None
    number, newcomers = state.round + 1, newcomers - {*state.others, state.camera}
    members = tuple(sorted({*state.others, state.camera, *newcomers}))
    epoch = known = following(state.epoch, number, members, newcomers, state.outcome)
    if newcomers:
        epoch = entered(known, welcome)
    early = {c: data for c, (of, data) in state.early.items() if c in members and of == epoch}
    odd = {c for c, (of, _) in state.early.items() if c in members and of != epoch}
    s = Agreeing(
        state.camera,
        members,
        number,
        epoch,
        own,
        {state.camera: own, **early},
        state.patience,
        Welcome(number, known, frozenset(members), welcome),
        newcomers,
        before=state.outcome,
        left_before=state.giving_up,
        epoch_before=state.epoch,
        odd=frozenset(odd),
        blame=state.blame,
        silent={c: n for c, n in state.silent.items() if c in members},
        refused=state.refused,
    )
    packets = _packets(tuple(c for c in s.others if c not in newcomers), _tells(s))
    packets += _packets(tuple(sorted(newcomers)), _welcomes(s))
    s, more = _disputing(s)
    return _settled(s), packets + more


def agree_step(state: Agreeing, inbox: Inbox, *, tick: bool = True) -> tuple[Agreeing, list[Packet]]:
    """Hear the others; say again what they may have missed, or whom this camera gives up.

    Args:
        tick: whether time has passed, in which others were silent.
    """
    s = state
    out: list[Packet] = []
    if tick:
        s = replace(s, silent={c: s.silent.get(c, 0) + 1 for c in s.others}, waited=s.waited + 1)
    others, silent, heard, early = set(s.others), dict(s.silent), dict(s.heard), dict(s.early)
    ends, consent, refused, newcomers = dict(s.ends), dict(s.consent), dict(s.refused), set(s.newcomers)
    odd, stray, claims, relays = set(s.odd), dict(s.stray), dict(s.claims), dict(s.relays)
    for sender, data in inbox:
        if sender not in others:
            continue
        try:
            word = read_word(sender, data, s.round)
        except ValueError as error:
            refused.setdefault(sender, str(error))
            continue
        ahead = word.round == s.round + 1 and word.kind == TELLS
        if word.round == s.round and sender in s.before:
            if word.kind in (DISPUTES, RELAYS) and (s.outcome is None or s.again):
                silent[sender] = 0
                if word.kind == DISPUTES:
                    claims.setdefault(sender, word.told[sender])
                else:
                    relays.setdefault(sender, word.told)
                if s.again and word.epoch:  # it has missed what this camera says; an answer needs none
                    out += _disputes(s, (sender,))
                continue
            if word.kind == TELLS and word.epoch != s.epoch:
                odd.add(sender)
                stray[sender] = word.epoch, word.told[sender]
        if (word.epoch not in (s.epoch, s.epoch_before) and not ahead) or word.round > s.round + 1:
            # It is in another group, or has gone on without this camera, which was silent for long: no word for it.
            continue
        silent[sender] = 0
        if word.kind == WORKS:
            continue
        if ahead:
            early[sender] = word.epoch, word.told[sender]
        elif word.round == s.round and word.epoch == s.epoch:
            newcomers.discard(sender)
            if s.outcome is not None:  # it has missed this camera's word, or someone else's
                out += _packets((sender,), _again(s, word, s.outcome))
            elif word.kind == TELLS:
                heard.setdefault(sender, word.told[sender])
            else:
                (ends if word.kind == ENDED else consent)[sender] = word
        elif word.round == s.round - 1 and word.epoch == s.epoch_before and s.camera in s.before:
            out += _packets((sender,), _again(s, word, s.before))
    s = replace(
        s,
        silent=silent,
        heard=heard,
        early=early,
        ends=ends,
        consent=consent,
        refused=refused,
        newcomers=frozenset(newcomers),
        odd=frozenset(odd),
        stray=stray,
        claims=claims,
        relays=relays,
    )
    s, more = _disputing(_ended(s))
    s, judged = _judged(_impatient(s))
    s = _settled(s)
    return s, out + more + judged + (_said_again(s) if tick and not s.outcast else [])


def _said_again(s: Agreeing) -> list[Packet]:
    """What others may have missed."""
    if s.outcome is not None:
        works = message(WORKS, s.camera, s.round, s.epoch, b"")
        return _packets(s.others, works) if s.waited % AGAIN == 0 else []
    out: list[Packet] = []
    if s.claims and not s.again:
        out += _disputes(s, s.others)
    if s.giving_up and not s.ended:
        gives_up = passed_on(GIVES_UP, s.camera, s.round, s.epoch, s.giving_up, frozenset(), s.heard)
        out += _packets(s.others, gives_up)
    if s.waited % AGAIN == 0:
        out += _packets(tuple(c for c in s.others if c not in s.newcomers), _tells(s))
    if s.waited % (AGAIN * TOUR) == 0:
        out += _packets(tuple(sorted(s.newcomers & {*s.others})), _welcomes(s))
    return out


def _again(s: Agreeing, word: Word, outcome: Mapping[int, bytes]) -> bytes:
    """An answer to a word of a round that is over."""
    if word.kind == TELLS:
        return message(TELLS, s.camera, word.round, word.epoch, outcome[s.camera])
    leaving = s.giving_up if word.round == s.round else s.left_before
    return passed_on(ENDED, s.camera, word.round, word.epoch, leaving, word.leaving, outcome)


def _ended(s: Agreeing) -> Agreeing:
    """Ended as another camera has, if that concerns only what this one has missed, or most others say so."""
    if s.outcome is not None or s.ended:
        return s
    missed = {c for c in s.members if c not in s.heard} | s.giving_up
    for word in s.ends.values():
        alike = sum(word.leaving == other.leaving for other in s.ends.values())
        if word.leaving <= missed or (2 * alike > len(s.others) and s.camera not in word.leaving):
            told = {c: data for c, data in word.told.items() if c in missed}
            return replace(s, heard={**told, **s.heard}, giving_up=word.leaving, ended=True)
    return s


def _impatient(s: Agreeing) -> Agreeing:
    """Gives up who was silent for long, where it is waited for."""
    if s.outcome is not None or s.ended or s.outcast:
        return s
    missed = {c for c in s.others if c not in s.heard or (s.giving_up and not _consents(s, c))}
    missed |= {c for c in s.others if s.claims and not s.again and not (c in s.claims and c in s.relays)}
    silent, long = s.patience
    more = {c for c in missed if s.silent.get(c, 0) > silent or s.waited > long} - s.giving_up
    # The others have as long again to agree to it.
    return replace(s, giving_up=s.giving_up | more, waited=0) if more else s


def _consents(s: Agreeing, camera: int) -> bool:
    return camera in s.consent and s.consent[camera].leaving == s.giving_up


def _settled(s: Agreeing) -> Agreeing:
    """With the outcome, where all that are left have told, and give up the same."""
    if s.outcast:  # for a while it answers those that have missed what it says
        return replace(s, outcome={}, members=(s.camera,)) if s.waited > s.patience.silent else s
    agreed = s.ended or not s.giving_up or all(_consents(s, c) for c in s.others)
    if s.outcome is not None or not agreed or any(c not in s.heard for c in s.others):
        return s
    if s.claims and not s.again and not s.ended:  # its word in a dispute counts: it waits for how that ends
        return s
    # Of who leaves, what any has heard; nobody hears it once it is given up.
    passed_on = [s.consent[c].told for c in s.others if c in s.consent and not s.ended]
    told = {c: data for of in passed_on for c, data in of.items() if c in s.giving_up} | dict(s.heard)
    return replace(s, outcome={c: told[c] for c in s.members if c in told})


def _disputing(s: Agreeing) -> tuple[Agreeing, list[Packet]]:
    """Takes part in a dispute, where there is one: says what it has heard, then what the others say."""
    if s.again or s.outcome is not None or s.ended or not (s.odd or s.claims):
        return s, []
    told = len(s.claims) + len(s.relays)
    if s.camera not in s.claims:
        mine = claim(s.odd, {c: digest(data) for c, data in s.before.items()})
        s = replace(s, claims={**s.claims, s.camera: mine})
    if s.camera not in s.relays and all(c in s.claims for c in s.others):
        s = replace(s, relays={**s.relays, s.camera: s.claims})
    return s, _disputes(s, s.others) if len(s.claims) + len(s.relays) > told else []


def _judged(s: Agreeing) -> tuple[Agreeing, list[Packet]]:
    """Without those that lie, once all that are left have said what they heard: they go back, a round later."""
    if s.again or s.outcome is not None or s.ended or any(c not in s.relays for c in (s.camera, *s.others)):
        return s, []
    out, blame = verdict(s.before.keys(), s.relays, s.blame)
    # Those as well that this camera has given up meanwhile: not all may have.
    left = tuple(sorted((set(s.members) & s.before.keys()) - out))
    epoch = following(s.epoch_before, s.round, left, frozenset(), {})
    s = replace(s, blame=blame, again=True, outcast=s.camera in out, odd=frozenset(), newcomers=frozenset())
    if s.outcast:
        return replace(s, waited=0), []
    s = replace(
        s,
        members=left,
        epoch=epoch,
        own=b"",
        heard={s.camera: b"", **{c: told for c, (of, told) in s.stray.items() if c in left and of == epoch}},
        early={},
        consent={},
        ends={},
        giving_up=frozenset(),
        silent={},
        waited=0,
    )
    return s, _packets(s.others, _tells(s))


def _disputes(s: Agreeing, to: tuple[int, ...]) -> list[Packet]:
    """What this camera says in a dispute, with no epoch where that is over for it: it answers."""
    header = s.camera, s.round, 0 if s.again else s.epoch
    out = _packets(to, message(DISPUTES, *header, s.claims[s.camera])) if s.camera in s.claims else []
    if s.camera in s.relays:
        relays = s.relays[s.camera]
        out += _packets(to, passed_on(RELAYS, *header, frozenset(), frozenset(relays), relays))
    return out


def _packets(to: tuple[int, ...], data: bytes) -> list[Packet]:
    return [Packet(to, data)] if to else []


def _tells(s: Agreeing) -> bytes:
    return message(TELLS, s.camera, s.round, s.epoch, s.own)


def _welcomes(s: Agreeing) -> bytes:
    return welcomed(s.camera, s.welcome)
