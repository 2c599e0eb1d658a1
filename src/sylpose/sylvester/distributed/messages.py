"""What cameras say to each other in the distributed estimators: a few numbers after a header of 8 bytes."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray

__all__ = ["HEADER", "Inbox", "Message", "Packet", "decode", "encode", "newest", "read"]

Inbox = Sequence[tuple[int, bytes]]  # (the camera that a link leads to, what came over it)

# Number of values, flags, sender, round: 8 bytes.
HEADER = struct.Struct("<BBHI")
LARGEST = 1e30  # no value comes near it, and its square is in range (choice)


class Packet(NamedTuple):
    """Bytes for some cameras: sent once, if the network can multicast."""

    to: tuple[int, ...]
    data: bytes


class Message(NamedTuple):
    """What one camera says in one round.

    Attributes:
        round: the sender's.
        clean: the sender has missed no message so far; in `refine`, keeps step.
        final: the sender has settled.
        values: (n,) float64.
    """

    round: int
    clean: bool
    final: bool
    values: FloatArray


def encode(sender: int, message: Message) -> bytes:
    """8 bytes of header (number of values, flags, sender, round), then the values as little-endian float64."""
    values = np.asarray(message.values, dtype="<f8")
    return HEADER.pack(values.size, message.clean + 2 * message.final, sender, message.round) + values.tobytes()


def decode(data: bytes, sender: int, sizes: tuple[int, ...]) -> Message:
    """The inverse of `encode`.

    Raises:
        ValueError: why these bytes are no message of that camera with one of these numbers of finite values.
    """
    if len(data) < HEADER.size:
        raise ValueError(f"{len(data)} bytes are no message")
    size, flags, author, number = HEADER.unpack_from(data)
    if size not in sizes or len(data) != HEADER.size + 8 * size:
        expected = " or ".join(str(HEADER.size + 8 * n) for n in sizes)
        raise ValueError(f"{len(data)} bytes instead of {expected}")
    if author != sender or flags > 3:
        raise ValueError("the header is not this camera's")
    values = np.frombuffer(data, "<f8", offset=HEADER.size).astype(float)
    if not (np.abs(values) < LARGEST).all():
        raise ValueError(f"values that are not finite, or beyond {LARGEST:g}")
    return Message(number, bool(flags & 1), bool(flags & 2), values)


def read(
    inbox: Inbox, sizes: tuple[int, ...], refused: Mapping[int, str]
) -> tuple[dict[tuple[int, int], Message], dict[int, str]]:
    """The messages by sender and round, and whom to refuse, and why."""
    news: dict[tuple[int, int], Message] = {}
    refused = dict(refused)
    for sender, data in inbox:
        try:
            message = decode(data, sender, sizes)
        except ValueError as error:
            refused.setdefault(sender, str(error))
            continue
        news[sender, message.round] = message
    return news, refused


def newest(messages: Mapping[tuple[int, int], Message], seen: Mapping[int, int]) -> dict[int, Message]:
    """Of each camera the newest message, if it is newer than what was `seen` of it."""
    return {c: messages[c, n] for c, n in sorted(messages) if n > seen.get(c, -1)}
