"""A node among others: whose group it is in, who else is there, who joins, pure: (state, inbox) -> (state, packets).

A node that is in no group says that it is there, to all. The members of a group hear that, and take it in between two
frames; it is told what all of them know, and takes part from then on. So a node that comes late, or one that died and was
started again, or was silent for too long, needs nothing but a word. Of two groups that hear each other the one that knows
the object goes on, if both do the larger one, and the nodes of the other leave theirs to be taken in. Where nobody has a
group, the first camera of those that are there founds one: once all of the rig are, or after a while.

What a node does is asked of it by its work (`Ask`), which waits for the `Answer`.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

from sylpose.network.byzantine import NOBODY_LIES, Blame
from sylpose.network.rounds import PATIENCE, Agreeing, Patience, agree_next, agree_start, agree_step
from sylpose.network.wire_format import (
    HELLO,
    WORKS,
    Hello,
    Welcome,
    entered,
    kind_of,
    message,
    read_hello,
    read_welcome,
    said_hello,
)
from sylpose.sylvester.distributed.messages import Inbox, Packet

__all__ = [
    "Answer",
    "Ask",
    "Enter",
    "Entered",
    "Heard",
    "Present",
    "Tell",
    "answer",
    "asked",
    "present_step",
    "silenced",
]

# Ticks after which a node says again that it is there; after so many of these without it, it is not (choice).
HELLOS, GONE = 5, 3
# A member that says it has no group, or another one, so often without another word, is none any more (choice).
DENIES = 3


class Tell(NamedTuple):
    """Work tells the others something. newcomers: who joins with this round; knows: what these have to know."""

    own: bytes
    newcomers: frozenset[int] = frozenset()
    knows: bytes = b""


class Enter(NamedTuple):
    """Work leaves its group, if it has one, and wants to be taken in by one."""


class Heard(NamedTuple):
    """Everybody has told. newcomers: who wants to be taken in; outdone: whether there is a larger group; again: not all have
    heard the same, and all go back to where they last were alike; outcast: but for this one, which leaves."""

    told: Mapping[int, bytes]
    newcomers: frozenset[int]
    outdone: bool
    again: bool = False
    outcast: bool = False


class Entered(NamedTuple):
    """It is in a group. knows: what it was told; None where it founded this group. newcomers: as in `Heard`."""

    knows: bytes | None
    newcomers: frozenset[int]


Ask: TypeAlias = Tell | Enter
Answer: TypeAlias = Heard | Entered


class Other(NamedTuple):
    """A node outside of the group. silent: ticks since it said so."""

    hello: Hello
    silent: int


@dataclass(frozen=True, eq=False)
class Present:
    """One node.

    Attributes:
        camera: its number, of so many cameras; incarnation: another one each time that it starts.
        wait: ticks for which it waits for all cameras before a group is founded.
        patience: with the others.
        ask: what its work waits for; None while that is busy.
        agreeing: its group; None without one.
        welcome: what it was told of the group that it is being taken in by.
        frames: that its group has tracked; 0 where nobody in it knows the object.
        outside: camera -> who is there and no member.
        ticks: it is there; since: those when it began to wait for a group; apart: until which it keeps to its own, where a
            larger one has not taken it in.
        refused: camera -> why a message of it was not read.
        blame: of those that lie, in groups before.
    """

    camera: int
    cameras: int
    incarnation: int = 0
    wait: int = 0
    patience: Patience = PATIENCE
    ask: Ask | None = None
    agreeing: Agreeing | None = None
    welcome: Welcome | None = None
    frames: int = 0
    outside: Mapping[int, Other] = field(default_factory=dict)
    ticks: int = 0
    since: int = 0
    apart: int = 0
    refused: Mapping[int, str] = field(default_factory=dict)
    blame: Blame = NOBODY_LIES

    @property
    def members(self) -> tuple[int, ...]:
        """Of its group; empty without one."""
        s = self.agreeing
        return () if s is None else tuple(sorted({*s.others, s.camera}))

    @property
    def all_refused(self) -> Mapping[int, str]:
        """As `refused`, with those that its group did not read, and those that lie."""
        refused = {} if self.agreeing is None else self.agreeing.refused
        return {**self.refused, **refused, **self.all_blame.sentences()}

    @property
    def all_blame(self) -> Blame:
        """As `blame`, with that of its group."""
        return self.blame if self.agreeing is None else self.agreeing.blame


def asked(p: Present, ask: Ask, frames: int) -> tuple[Present, list[Packet]]:
    """Work asks for something. See `answer`.

    Args:
        frames: as in `Present`.
    """
    p = replace(p, ask=ask, frames=frames)
    if isinstance(ask, Enter):
        p = replace(p, refused=p.all_refused, blame=p.all_blame, since=p.ticks)
        return replace(p, agreeing=None, welcome=None), []
    if p.agreeing is not None:
        agreeing, packets = agree_next(p.agreeing, ask.own, ask.newcomers, ask.knows)
    elif p.welcome is not None:
        number, epoch, members, knows = p.welcome
        epoch = entered(epoch, knows)
        agreeing, packets = agree_start(
            p.camera, sorted(members), ask.own, number=number, epoch=epoch, patience=p.patience, blame=p.blame
        )
    else:
        epoch = zlib.crc32(f"{p.camera} {p.incarnation} {p.ticks}".encode())
        agreeing, packets = agree_start(p.camera, [p.camera], ask.own, epoch=epoch, patience=p.patience, blame=p.blame)
    return replace(p, agreeing=agreeing, welcome=None), packets


def answer(p: Present) -> tuple[Present, Answer | None]:
    """What was asked for, once it is there: all that the others told, or a group."""
    if isinstance(p.ask, Tell) and p.agreeing is not None and p.agreeing.outcome is not None:
        barred = {c for c in p.outside if p.all_blame.bars(c, frozenset(p.members))}
        others = {c: o for c, o in p.outside.items() if c not in p.members and c not in barred}
        mine = p.frames > 0, len(p.members), -min(p.members)
        outdone = any((o.hello.frames > 0, o.hello.size, -c) > mine for c, o in others.items() if o.hello.size)
        again, outcast = p.agreeing.again, p.agreeing.outcast
        heard = Heard(p.agreeing.outcome, _wanting(p, others), outdone and p.ticks >= p.apart, again, outcast)
        return replace(p, ask=None), heard
    if isinstance(p.ask, Enter):
        if p.welcome is not None:
            return replace(p, ask=None), Entered(p.welcome.knows, frozenset())
        if p.ticks - p.since > p.wait + p.patience.long and any(o.hello.size for o in p.outside.values()):
            # Somebody in there does not hear it: better apart than nothing, for as long again.
            p = replace(p, apart=p.ticks + p.patience.long)
            return replace(p, ask=None), Entered(None, _wanting(p, p.outside))
        if _founds(p):
            return replace(p, ask=None), Entered(None, _wanting(p, p.outside))
    return p, None


def _wanting(p: Present, others: Mapping[int, Other]) -> frozenset[int]:
    """Who would be taken in: of two that one of lies, one."""
    wanting = frozenset[int]()
    for c in sorted(c for c, o in others.items() if not o.hello.size):
        if not p.all_blame.bars(c, wanting | frozenset({p.camera, *p.members})):
            wanting |= {c}
    return wanting


def _founds(p: Present) -> bool:
    """Whether a node that waits to be taken in founds a group, if there is none: that of those that wait which has tracked
    most, the first of several."""
    waited = p.ticks >= p.wait or len(p.outside) + 1 == p.cameras
    first = all((p.frames, -p.camera) > (o.hello.frames, -c) for c, o in p.outside.items())
    return waited and first and not any(o.hello.size for o in p.outside.values())


def silenced(agreeing: Agreeing, camera: int, ticks: int) -> Agreeing:
    """With a camera silent for so many ticks more: it says elsewhere that it is no member."""
    return replace(agreeing, silent={**agreeing.silent, camera: agreeing.silent.get(camera, 0) + ticks})


def present_step(p: Present, inbox: Inbox, *, tick: bool = True) -> tuple[Present, list[Packet]]:
    """Hear the others; say what they may have missed, and that this node is there.

    Args:
        tick: whether time has passed, in which others were silent.
    """
    out: list[Packet] = []
    words: list[tuple[int, bytes]] = []
    outside, agreeing = dict(p.outside), p.agreeing
    if tick:
        p = replace(p, ticks=p.ticks + 1)
        outside = {c: Other(o.hello, o.silent + 1) for c, o in outside.items() if o.silent < HELLOS * GONE}
    mine = frozenset({p.camera, *p.members})
    for sender, data in inbox:
        if p.all_blame.bars(sender, mine):
            continue
        if kind_of(data) != HELLO:
            words.append((sender, data))
            continue
        hello = read_hello(sender, data)
        if hello is None or not 0 <= sender < p.cameras or sender == p.camera or hello.size > p.cameras:
            p = replace(p, refused={sender: "it says hello as another one", **p.refused})
            continue
        outside[sender] = Other(hello, 0)
        if agreeing is not None and sender in agreeing.others and sender not in agreeing.newcomers:
            agreeing = silenced(agreeing, sender, p.patience.silent // DENIES + 1)
    if agreeing is not None:
        agreeing, out = agree_step(agreeing, words, tick=tick)
    elif isinstance(p.ask, Enter) and p.welcome is None:
        welcomes = (read_welcome(p.camera, p.cameras, sender, data) for sender, data in words)
        p = replace(p, welcome=next((w for w in welcomes if w is not None), None))
    p = replace(p, agreeing=agreeing, outside=outside)
    if tick and agreeing is None and p.welcome is not None:
        # It learns what it was told, and has not spoken yet.
        number, epoch, members, knows = p.welcome
        works = message(WORKS, p.camera, number, entered(epoch, knows), b"")
        out.append(Packet(tuple(sorted(members - {p.camera})), works))
    others = tuple(c for c in range(p.cameras) if c != p.camera and c not in p.members)
    if tick and others and p.ticks % HELLOS == 0 and p.welcome is None:
        hello = Hello(len(p.members), p.frames)
        out.append(Packet(others, said_hello(p.camera, 0 if agreeing is None else agreeing.epoch, hello)))
    return p, out
