"""Messages of the distributed estimators: a header of 8 bytes and a few numbers."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray

__all__ = ["HEADER", "Inbox", "Message", "Packet", "decode", "decode_inbox", "encode", "select_newest"]

Inbox = Sequence[tuple[int, bytes]]  # (sending camera, received bytes)

# Number of values, flags, sender, round: 8 bytes.
HEADER = struct.Struct("<BBHI")
MAX_VALUE = 1e30  # limit of absolute values: far above valid ones, and its square is in range (choice)


class Packet(NamedTuple):
    """Bytes for one or several nodes: sent once if the network supports multicast."""

    to: tuple[int, ...]
    data: bytes


class Message(NamedTuple):
    """Message of one node in one round.

    Attributes:
        round: the sender's round.
        no_loss: the sender has missed no message so far; always True in `refine`.
        final: the sender has converged.
        values: (n,) float64.
    """

    round: int
    no_loss: bool
    final: bool
    values: FloatArray


def encode(sender: int, message: Message) -> bytes:
    """Encode a message: a header of 8 bytes, then little-endian float64 values.

    The header contains the number of values, flags, sender and round.
    """
    values = np.asarray(message.values, dtype="<f8")
    return HEADER.pack(values.size, message.no_loss + 2 * message.final, sender, message.round) + values.tobytes()


def decode(data: bytes, sender: int, sizes: tuple[int, ...]) -> Message:
    """Decode the bytes of `encode`.

    Raises:
        ValueError: the bytes are not a message of that sender with one of these numbers of finite values.
    """
    if len(data) < HEADER.size:
        raise ValueError(f"{len(data)} bytes are too short for a message")
    size, flags, header_sender, number = HEADER.unpack_from(data)
    if size not in sizes or len(data) != HEADER.size + 8 * size:
        expected = " or ".join(str(HEADER.size + 8 * n) for n in sizes)
        raise ValueError(f"{len(data)} bytes instead of {expected}")
    if header_sender != sender or flags > 3:
        raise ValueError("the header is not that of this camera")
    values = np.frombuffer(data, "<f8", offset=HEADER.size).astype(float)
    if not (np.abs(values) < MAX_VALUE).all():
        raise ValueError(f"values are not finite, or beyond {MAX_VALUE:g}")
    return Message(number, bool(flags & 1), bool(flags & 2), values)


def decode_inbox(
    inbox: Inbox, sizes: tuple[int, ...], refused: Mapping[int, str]
) -> tuple[dict[tuple[int, int], Message], dict[int, str]]:
    """Decode an inbox: return the messages by (sender, round), and the reasons of rejection by sender."""
    messages: dict[tuple[int, int], Message] = {}
    refused = dict(refused)
    for sender, data in inbox:
        try:
            message = decode(data, sender, sizes)
        except ValueError as error:
            refused.setdefault(sender, str(error))
            continue
        messages[sender, message.round] = message
    return messages, refused


def select_newest(messages: Mapping[tuple[int, int], Message], last_rounds: Mapping[int, int]) -> dict[int, Message]:
    """Return each sender's newest message, if newer than the round `last_rounds` before."""
    return {c: messages[c, n] for c, n in sorted(messages) if n > last_rounds.get(c, -1)}
