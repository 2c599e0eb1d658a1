"""Rounds in which all cameras that take part hear the same: one camera's side, pure, (state, inbox) -> (state, packets).

In each round every camera tells all others one thing, and a round ends when it has heard them all. Nobody can be more than
one round ahead, since that takes what this camera tells; who is one behind is told again. So loss and delay cost time and
change nothing.

A camera that is silent for long is given up, by all alike: each that misses it says so, with what it has heard of it in this
round, until all that are left give up the same ones. What any of them had heard of those counts for all, or else nothing
does; from then on they take no part. Whom a camera gives up only grows, and who has ended a round says how instead of
agreeing to anything else; so no two cameras that listen to each other end it differently. One camera's word alone excludes
nobody that the others hear.

Source: view synchrony, K. Birman, T. Joseph, "Exploiting virtual synchrony in distributed systems" (1987).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from sylpose.network.codec import LARGEST
from sylpose.paper.distributed.messages import Inbox, Packet

__all__ = ["HEADER", "Agreeing", "agree_next", "agree_start", "agree_step"]

# Kind, sender, round: 8 bytes.
HEADER = struct.Struct("<BxHI")
# What a camera tells; whom it gives up, and what it has heard of these; and that of a round that it has ended (derived).
TELLS, GIVES_UP, ENDED = 0, 1, 2
# Bits of those that leave, and of those that something is passed on of; then the number of bytes of each (derived).
_LEAVING, _SIZE = struct.Struct("<QQ"), struct.Struct("<I")
MOST_CAMERAS = 64  # bits (derived)
# Steps without an outcome after which a camera says again what it has said, and silent ones after which one is given up
# (choice).
AGAIN, PATIENCE = 2, 30
# Steps of a round after which those are given up as well that do not agree on who is (choice).
LONG = 4 * PATIENCE


class Word(NamedTuple):
    """A message: what a camera told, by camera; passed on but where it is its own."""

    kind: int
    round: int
    leaving: frozenset[int]
    told: dict[int, bytes]


@dataclass(frozen=True, eq=False)
class Agreeing:
    """One camera among others.

    Attributes:
        camera: its number. members: who takes part, this one included.
        round: counts from 0.
        own: what it tells in this round.
        heard: camera -> what it told in this round; early: of those one ahead, in the next one.
        before, left_before: camera -> what it told in the round before, and who left with that.
        silent: camera -> steps without a word of it. waited: steps of this round.
        giving_up: whom this camera gives up. consent: camera -> whom that one does, and what it has heard of these.
        ends: camera -> the same, with which it has ended this round. ended: so many agree on that, that it is so.
        outcome: camera -> what it told, once the round is over; those that left unheard are missing.
        refused: camera -> why its first bad message was not read.
    """

    camera: int
    members: tuple[int, ...]
    round: int
    own: bytes
    heard: Mapping[int, bytes]
    early: Mapping[int, bytes] = field(default_factory=dict)
    before: Mapping[int, bytes] = field(default_factory=dict)
    left_before: frozenset[int] = frozenset()
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


def agree_start(camera: int, members: Sequence[int], own: bytes) -> tuple[Agreeing, list[Packet]]:
    """A camera, and what it tells in the first round.

    Raises:
        ValueError: cameras that are not among 0 to 63, or this one not among them.
    """
    if camera not in members or min(members) < 0 or max(members) >= MOST_CAMERAS:
        raise ValueError(f"camera {camera} of {list(members)}: expected one of some of 0 to {MOST_CAMERAS - 1}")
    s = Agreeing(camera, tuple(sorted(members)), 0, own, {camera: own})
    return _settled(s), _packets(s.others, _tells(s))


def agree_next(state: Agreeing, own: bytes) -> tuple[Agreeing, list[Packet]]:
    """The next round, once there is an outcome."""
    assert state.outcome is not None
    members = tuple(sorted({*state.others, state.camera}))
    s = Agreeing(
        state.camera,
        members,
        state.round + 1,
        own,
        {state.camera: own, **{c: data for c, data in state.early.items() if c in members}},
        before=state.outcome,
        left_before=state.giving_up,
        silent={c: n for c, n in state.silent.items() if c in members},
        refused=state.refused,
    )
    return _settled(s), _packets(s.others, _tells(s))


def agree_step(state: Agreeing, inbox: Inbox) -> tuple[Agreeing, list[Packet]]:
    """Hear the others; say again what they may have missed, or whom this camera gives up."""
    s = replace(state, silent={c: state.silent.get(c, 0) + 1 for c in state.others}, waited=state.waited + 1)
    out: list[Packet] = []
    for sender, data in inbox:
        if sender not in s.others:
            continue
        try:
            word = _read(sender, data)
            if word.round > s.round + 1:
                raise ValueError(f"it is {word.round - s.round} rounds ahead")
        except ValueError as error:
            s = replace(s, refused={sender: str(error), **s.refused})
            continue
        s = replace(s, silent={**s.silent, sender: 0})
        if word.round == s.round + 1 and word.kind == TELLS:
            s = replace(s, early={**s.early, sender: word.told[sender]})
        elif word.round == s.round:
            if s.outcome is None:
                s = _heard(s, sender, word)
            elif word.kind == TELLS:  # again: it has missed this camera's word
                out += _packets((sender,), _tells(s))
            else:
                out += _packets((sender,), _passes_on(s, ENDED, s.round, s.giving_up, word.leaving, s.outcome))
        elif word.round == s.round - 1:
            # It has missed this camera's word, or someone else's.
            again = _message(TELLS, s.camera, word.round, s.before[s.camera])
            if word.kind != TELLS:
                again = _passes_on(s, ENDED, word.round, s.left_before, word.leaving, s.before)
            out += _packets((sender,), again)
    s = _settled(_impatient(_ended(s)))
    if s.outcome is None:
        if s.giving_up and not s.ended:
            out += _packets(s.others, _passes_on(s, GIVES_UP, s.round, s.giving_up, frozenset(), s.heard))
        if s.waited % AGAIN == 0:
            out += _packets(s.others, _tells(s))
    return s, out


def _heard(s: Agreeing, sender: int, word: Word) -> Agreeing:
    """With a word of this round."""
    if word.kind == TELLS:
        return replace(s, heard={**word.told, **s.heard})
    if word.kind == ENDED:
        return replace(s, ends={**s.ends, sender: word})
    return replace(s, consent={**s.consent, sender: word})


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
    if s.outcome is not None or s.ended:
        return s
    missed = {c for c in s.others if c not in s.heard or (s.giving_up and not _consents(s, c))}
    return replace(s, giving_up=s.giving_up | {c for c in missed if s.silent.get(c, 0) > PATIENCE or s.waited > LONG})


def _consents(s: Agreeing, camera: int) -> bool:
    return camera in s.consent and s.consent[camera].leaving == s.giving_up


def _settled(s: Agreeing) -> Agreeing:
    """With the outcome, where all that are left have told, and give up the same."""
    agreed = s.ended or not s.giving_up or all(_consents(s, c) for c in s.others)
    if s.outcome is not None or not agreed or any(c not in s.heard for c in s.others):
        return s
    # Of who leaves, what any has heard; nobody hears it once it is given up.
    passed_on = [s.consent[c].told for c in s.others if c in s.consent and not s.ended]
    told = {c: data for of in passed_on for c, data in of.items() if c in s.giving_up} | dict(s.heard)
    return replace(s, outcome={c: told[c] for c in s.members if c in told})


def _packets(to: tuple[int, ...], data: bytes) -> list[Packet]:
    return [Packet(to, data)] if to else []


def _tells(s: Agreeing) -> bytes:
    return _message(TELLS, s.camera, s.round, s.own)


def _message(kind: int, camera: int, number: int, content: bytes) -> bytes:
    return HEADER.pack(kind, camera, number) + content


def _passes_on(
    s: Agreeing, kind: int, number: int, leaving: frozenset[int], missed: frozenset[int], heard: Mapping[int, bytes]
) -> bytes:
    """Who leaves with a round, and what was heard in it of these and of some that another camera has missed."""
    relayed = sorted(c for c in leaving | missed if c in heard)
    content = _LEAVING.pack(_bits(leaving), _bits(frozenset(relayed)))
    content += b"".join(_SIZE.pack(len(heard[c])) + heard[c] for c in relayed)
    return _message(kind, s.camera, number, content)


def _bits(cameras: frozenset[int]) -> int:
    return sum(1 << c for c in cameras)


def _of_bits(bits: int) -> frozenset[int]:
    return frozenset(c for c in range(MOST_CAMERAS) if bits >> c & 1)


def _read(sender: int, data: bytes) -> Word:
    """A message.

    Raises:
        ValueError: why these bytes are no message of that camera.
    """
    if not HEADER.size <= len(data) <= LARGEST + HEADER.size:
        raise ValueError(f"{len(data)} bytes are no message")
    kind, author, number = HEADER.unpack_from(data)
    if author != sender or kind not in (TELLS, GIVES_UP, ENDED):
        raise ValueError("the header is not this camera's")
    content = data[HEADER.size :]
    if kind == TELLS:
        return Word(kind, number, frozenset(), {sender: content})
    if len(content) < _LEAVING.size:
        raise ValueError("it does not say who leaves")
    leaving, relayed = map(_of_bits, _LEAVING.unpack_from(content))
    if sender in leaving:
        raise ValueError("it gives itself up")
    told, at = {}, _LEAVING.size
    for c in sorted(relayed):
        size = _SIZE.unpack_from(content, at)[0] if len(content) >= at + _SIZE.size else LARGEST
        at += _SIZE.size
        if len(content) < at + size:
            raise ValueError("what it passes on is cut off")
        told[c] = content[at : at + size]
        at += size
    if at != len(content):
        raise ValueError("it passes on more than it announced")
    return Word(kind, number, leaving, told)
