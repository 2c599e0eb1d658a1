"""What cameras say to each other in agreed rounds, as bytes: a header of 12, then what they tell.

The header's epoch is a digest of all that the sender has heard before the round. So each word says, in no bytes more, that
all have heard the same until then; or that somebody lies, and then they tell each other digests of what they heard.

Everything is bounded and checked before it is used: what is no message is refused by a sentence.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from typing import NamedTuple

from sylpose.network.codec import LARGEST

__all__ = [
    "BITS",
    "DISPUTES",
    "ENDED",
    "GIVES_UP",
    "HEADER",
    "HELLO",
    "LARGEST_WORD",
    "MOST_CAMERAS",
    "RELAYS",
    "TELLS",
    "WELCOME",
    "WORKS",
    "Hello",
    "Welcome",
    "Word",
    "bits_of",
    "digest",
    "entered",
    "following",
    "kind_of",
    "message",
    "of_bits",
    "passed_on",
    "read_hello",
    "read_welcome",
    "read_word",
    "said_hello",
    "welcomed",
]


class Header:
    """Kind and sender in two bytes, the end of the round's number in two, epoch in eight."""

    size = 12
    _parts = struct.Struct("<HHQ")

    def pack(self, kind: int, sender: int, number: int, epoch: int) -> bytes:
        """As bytes."""
        return self._parts.pack(kind << 10 | sender, number & 0xFFFF, epoch)

    def unpack_from(self, data: bytes, near: int = 0) -> tuple[int, int, int, int]:
        """Kind, sender, round, epoch; of the rounds that it may be, the one next to another."""
        both, low, epoch = self._parts.unpack_from(data)
        return both >> 10, both & 0x3FF, near + ((low - near + 0x8000) & 0xFFFF) - 0x8000, epoch


HEADER = Header()
# What a camera tells; whom it gives up, and what it has heard of these; that of a round that it has ended; that it is at
# work; what a newcomer has to know; to those that are no members, that there is somebody; and, where words of a round say
# that cameras heard different things in the one before, digests of what this one heard, and then what others say that they
# heard (derived).
TELLS, GIVES_UP, ENDED, WORKS, WELCOME, HELLO, DISPUTES, RELAYS = range(8)
# Bits of those that leave, and of those that something is passed on of; then the number of bytes of each (derived).
_LEAVING, _SIZE = struct.Struct("<128s128s"), struct.Struct("<I")
# Round and bits of the members, before what a newcomer has to know (derived).
_MEMBERS = struct.Struct("<Q128s")
# How many cameras and frames a camera's group has (derived).
_GROUP = struct.Struct("<HI")
# What makes an epoch, with what was told before (derived).
_EPOCH, _TOLD = struct.Struct("<QQ128s128s"), struct.Struct("<HI")
MOST_CAMERAS = 1024  # ten bits (derived)
BITS = MOST_CAMERAS // 8  # bytes with a bit for each (derived)
FAR = 1 << 47  # no round has such a number (choice: a thousand rounds a second for four thousand years)
LARGEST_WORD = HEADER.size + LARGEST  # bytes (derived)


class Word(NamedTuple):
    """A message: what a camera told, by camera; passed on but where it is its own."""

    kind: int
    round: int
    epoch: int
    leaving: frozenset[int]
    told: dict[int, bytes]


class Welcome(NamedTuple):
    """What a newcomer is told. round, members: of the round that it joins with; knows: what it has to know; epoch: with that
    it makes the round's (`entered`), so that who was told something else is not understood."""

    round: int
    epoch: int
    members: frozenset[int]
    knows: bytes


class Hello(NamedTuple):
    """Somebody is there. size: of its group, 0 without one; frames: that this has tracked, if it knows the object. See
    `presence`."""

    size: int
    frames: int


def kind_of(data: bytes) -> int | None:
    """Of a message; None of what is none."""
    return HEADER.unpack_from(data)[0] if len(data) >= HEADER.size else None


def message(kind: int, camera: int, number: int, epoch: int, content: bytes) -> bytes:
    return HEADER.pack(kind, camera, number, epoch) + content


def passed_on(
    kind: int,
    camera: int,
    number: int,
    epoch: int,
    leaving: frozenset[int],
    missed: frozenset[int],
    heard: Mapping[int, bytes],
) -> bytes:
    """Who leaves with a round, and what was heard in it of these and of some that another camera has missed."""
    relayed = sorted(c for c in leaving | missed if c in heard)
    content = _LEAVING.pack(bits_of(leaving), bits_of(frozenset(relayed)))
    content += b"".join(_SIZE.pack(len(heard[c])) + heard[c] for c in relayed)
    return message(kind, camera, number, epoch, content)


def welcomed(camera: int, welcome: Welcome) -> bytes:
    """A newcomer is told what it has to know."""
    content = _MEMBERS.pack(welcome.round, bits_of(welcome.members)) + welcome.knows
    return message(WELCOME, camera, welcome.round, welcome.epoch, content)


def said_hello(camera: int, epoch: int, hello: Hello) -> bytes:
    """That somebody is there, for those that are no members."""
    return message(HELLO, camera, 0, epoch, _GROUP.pack(*hello))


def bits_of(cameras: frozenset[int]) -> bytes:
    """One bit for each camera."""
    return sum(1 << c for c in cameras).to_bytes(BITS, "little")


def of_bits(bits: bytes) -> frozenset[int]:
    """The cameras whose bits are set."""
    number = int.from_bytes(bits, "little")
    return frozenset(c for c in range(number.bit_length()) if number >> c & 1)


def digest(data: bytes) -> bytes:
    """Eight bytes: so many that nobody finds another message with the same in the time of a round."""
    return blake2b(data, digest_size=8).digest()


def following(
    before: int, number: int, members: Sequence[int], newcomers: frozenset[int], told: Mapping[int, bytes]
) -> int:
    """Of a round, from that before, and what was told in it."""
    parts = [_EPOCH.pack(before, number, bits_of(frozenset(members)), bits_of(newcomers))]
    parts += [part for c in sorted(told) for part in (_TOLD.pack(c, len(told[c])), told[c])]
    return int.from_bytes(digest(b"".join(parts)), "little")


def entered(epoch: int, knows: bytes) -> int:
    """The epoch of a round that newcomers join with, from that of the members and what these were told."""
    return int.from_bytes(digest(epoch.to_bytes(8, "little") + knows), "little")


def read_word(sender: int, data: bytes, near: int = 0) -> Word:
    """A message.

    Args:
        near: its round is next to this one.

    Raises:
        ValueError: why these bytes are no message of that camera.
    """
    if not HEADER.size <= len(data) <= LARGEST + HEADER.size:
        raise ValueError(f"{len(data)} bytes are no message")
    kind, author, number, epoch = HEADER.unpack_from(data, near)
    if author != sender or kind not in (TELLS, GIVES_UP, ENDED, WORKS, WELCOME, DISPUTES, RELAYS):
        raise ValueError("the header is not this camera's")
    content = data[HEADER.size :]
    if kind == DISPUTES:
        odd = of_bits(content[:BITS]) - {sender}
        return Word(kind, number, epoch, odd, {sender: content})
    if kind in (TELLS, WORKS):
        return Word(kind, number, epoch, frozenset(), {sender: content})
    if kind == WELCOME:  # again, after this camera has heard it
        return Word(WORKS, number, epoch, frozenset(), {})
    if len(content) < _LEAVING.size:
        raise ValueError("it does not say who leaves")
    leaving, relayed = map(of_bits, _LEAVING.unpack_from(content))
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
    return Word(kind, number, epoch, leaving, told)


def read_welcome(camera: int, cameras: int, sender: int, data: bytes) -> Welcome | None:
    """A message, if it welcomes a camera of so many."""
    if not HEADER.size + _MEMBERS.size <= len(data) <= LARGEST + HEADER.size:
        return None
    kind, author, _, epoch = HEADER.unpack_from(data)
    number, bits = _MEMBERS.unpack_from(data, HEADER.size)
    members = of_bits(bits)
    if kind != WELCOME or author != sender or sender == camera or not {camera, sender} <= members:
        return None
    if max(members) >= cameras or number >= FAR:
        return None
    return Welcome(number, epoch, members, data[HEADER.size + _MEMBERS.size :])


def read_hello(sender: int, data: bytes) -> Hello | None:
    """A message, if it says that somebody is there."""
    if len(data) != HEADER.size + _GROUP.size:
        return None
    kind, author, _, _ = HEADER.unpack_from(data)
    return Hello(*_GROUP.unpack_from(data, HEADER.size)) if kind == HELLO and author == sender else None
