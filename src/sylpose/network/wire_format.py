"""Wire format of the round messages: a header of 12 bytes and a payload.

The epoch in the header is a digest of all that the sender received before the round. At no extra size, each message
thus confirms the common history or reveals a faulty camera; in the latter case cameras exchange digests of what they
received.

Everything is bounded and validated before use; invalid messages are rejected with a one-sentence reason.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from typing import NamedTuple, TypeAlias

from sylpose.network.codec import MAX_PAYLOAD_BYTES

Payloads: TypeAlias = Mapping[int, bytes]  # camera -> payload


class Header:
    """Message header: kind and sender in two bytes, the low 16 bits of the round number in two, the epoch in eight."""

    size = 12
    _parts = struct.Struct("<HHQ")

    def pack(self, kind: int, sender: int, number: int, epoch: int) -> bytes:
        """Encode the header as bytes."""
        return self._parts.pack(kind << 10 | sender, number & 0xFFFF, epoch)

    def unpack_from(self, data: bytes, near: int = 0) -> tuple[int, int, int, int]:
        """Decode kind, sender, round and epoch; the round is the candidate closest to `near`."""
        both, low, epoch = self._parts.unpack_from(data)
        return both >> 10, both & 0x3FF, near + ((low - near + 0x8000) & 0xFFFF) - 0x8000, epoch


HEADER = Header()
# Message kinds: payload of a round; excluded cameras with the payloads received from them; the same for a finished
# round; heartbeat; shared state for a newcomer; presence, sent to non-members; and, if messages of a round reveal
# different histories, digests of what was received in the previous round, and then the digests received from others
# (derived).
DATA, EXCLUSION, ROUND_END, HEARTBEAT, WELCOME, HELLO, DISPUTE, RELAY = range(8)
# Bit masks of leaving cameras and of cameras whose payloads are relayed; then the size of each payload (derived).
_LEAVING, _SIZE = struct.Struct("<128s128s"), struct.Struct("<I")
# Round and bit mask of the members, before the state for a newcomer (derived).
_MEMBERS = struct.Struct("<Q128s")
# Number of cameras in the sender's group, and number of frames it has tracked (derived).
_GROUP = struct.Struct("<HI")
# Input of an epoch's digest, followed by sender, size and content of each payload (derived).
_EPOCH, _PAYLOAD = struct.Struct("<QQ128s128s"), struct.Struct("<HI")
MAX_CAMERAS = 1024  # ten bits (derived)
MASK_BYTES = MAX_CAMERAS // 8  # bytes of a bit mask (derived)
MAX_ROUND = 1 << 47  # upper bound of round numbers (choice: a thousand rounds a second for four thousand years)
MAX_MESSAGE_BYTES = HEADER.size + MAX_PAYLOAD_BYTES  # bytes (derived)


class RoundMessage(NamedTuple):
    """A decoded message with payloads by camera: the sender's own, or relayed ones."""

    kind: int
    round: int
    epoch: int
    leaving: frozenset[int]
    payloads: dict[int, bytes]


class Welcome(NamedTuple):
    """Message to a newcomer.

    Attributes:
        round: number of the round that it joins.
        epoch: together with `shared_state` it gives the round's epoch (`compute_join_epoch`), so that a newcomer with
            another state is detected.
        members: members of that round.
        shared_state: shared state.
    """

    round: int
    epoch: int
    members: frozenset[int]
    shared_state: bytes


class Hello(NamedTuple):
    """Presence message, see `membership`.

    Attributes:
        size: size of the sender's group, 0 without one.
        frames: number of frames tracked by the group; 0 if it does not know the object.
    """

    size: int
    frames: int


def message_kind(data: bytes) -> int | None:
    """Return the kind of a message; None if it is too short."""
    return HEADER.unpack_from(data)[0] if len(data) >= HEADER.size else None


def encode_message(kind: int, camera: int, number: int, epoch: int, content: bytes) -> bytes:
    return HEADER.pack(kind, camera, number, epoch) + content


def encode_relay(
    kind: int, camera: int, number: int, epoch: int, leaving: frozenset[int], also: frozenset[int], received: Payloads
) -> bytes:
    """Encode the leaving cameras of a round, with the payloads received from them and from `also` cameras.

    Args:
        kind: `EXCLUSION`, `ROUND_END` or `RELAY`.
        camera, number, epoch: of the header.
        leaving: excluded cameras.
        also: further cameras whose payloads are relayed.
        received: camera -> payload.
    """
    relayed = sorted(c for c in leaving | also if c in received)
    content = _LEAVING.pack(encode_cameras(leaving), encode_cameras(frozenset(relayed)))
    content += b"".join(_SIZE.pack(len(received[c])) + received[c] for c in relayed)
    return encode_message(kind, camera, number, epoch, content)


def encode_welcome(camera: int, welcome: Welcome) -> bytes:
    """Encode the message for a newcomer."""
    content = _MEMBERS.pack(welcome.round, encode_cameras(welcome.members)) + welcome.shared_state
    return encode_message(WELCOME, camera, welcome.round, welcome.epoch, content)


def encode_hello(camera: int, epoch: int, hello: Hello) -> bytes:
    """Encode the presence message for non-members."""
    return encode_message(HELLO, camera, 0, epoch, _GROUP.pack(*hello))


def encode_cameras(cameras: frozenset[int]) -> bytes:
    """Encode a set of cameras as a bit mask."""
    return sum(1 << c for c in cameras).to_bytes(MASK_BYTES, "little")


def decode_cameras(bits: bytes) -> frozenset[int]:
    """Decode a bit mask to a set of cameras."""
    number = int.from_bytes(bits, "little")
    return frozenset(c for c in range(number.bit_length()) if number >> c & 1)


def digest(data: bytes) -> bytes:
    """Return an 8-byte digest, long enough that no collision can be found within a round."""
    return blake2b(data, digest_size=8).digest()


def compute_next_epoch(
    previous: int, number: int, members: Sequence[int], newcomers: frozenset[int], payloads: Payloads
) -> int:
    """Compute the epoch of a round from the previous epoch and the payloads of that round.

    Args:
        previous: the previous epoch.
        number: number of the new round.
        members: members of the new round.
        newcomers: members that join with it.
        payloads: camera -> payload of the previous round.
    """
    parts = [_EPOCH.pack(previous, number, encode_cameras(frozenset(members)), encode_cameras(newcomers))]
    parts += [part for c in sorted(payloads) for part in (_PAYLOAD.pack(c, len(payloads[c])), payloads[c])]
    return int.from_bytes(digest(b"".join(parts)), "little")


def compute_join_epoch(epoch: int, shared_state: bytes) -> int:
    """Compute the epoch of a round with newcomers from the members' epoch and the state sent to the newcomers."""
    return int.from_bytes(digest(epoch.to_bytes(8, "little") + shared_state), "little")


def decode_message(sender: int, data: bytes, near: int = 0) -> RoundMessage:
    """Decode and validate a message.

    Args:
        sender: camera that sent it.
        data: the message.
        near: round number to which the message's is closest.

    Raises:
        ValueError: the reason why this is no message of that camera.
    """
    if not HEADER.size <= len(data) <= MAX_PAYLOAD_BYTES + HEADER.size:
        raise ValueError(f"{len(data)} bytes are not a message")
    kind, author, number, epoch = HEADER.unpack_from(data, near)
    if author != sender or kind not in (DATA, EXCLUSION, ROUND_END, HEARTBEAT, WELCOME, DISPUTE, RELAY):
        raise ValueError("the header is not this camera's")
    content = data[HEADER.size :]
    if kind == DISPUTE:
        accused = decode_cameras(content[:MASK_BYTES]) - {sender}
        return RoundMessage(kind, number, epoch, accused, {sender: content})
    if kind in (DATA, HEARTBEAT):
        return RoundMessage(kind, number, epoch, frozenset(), {sender: content})
    if kind == WELCOME:  # a retransmission to a camera that has joined
        return RoundMessage(HEARTBEAT, number, epoch, frozenset(), {})
    if len(content) < _LEAVING.size:
        raise ValueError("it lacks the leaving cameras")
    leaving, relayed = map(decode_cameras, _LEAVING.unpack_from(content))
    if sender in leaving:
        raise ValueError("it excludes itself")
    payloads, position = {}, _LEAVING.size
    for c in sorted(relayed):
        size = _SIZE.unpack_from(content, position)[0] if len(content) >= position + _SIZE.size else MAX_PAYLOAD_BYTES
        position += _SIZE.size
        if len(content) < position + size:
            raise ValueError("the relayed data is truncated")
        payloads[c] = content[position : position + size]
        position += size
    if position != len(content):
        raise ValueError("it contains more data than announced")
    return RoundMessage(kind, number, epoch, leaving, payloads)


def decode_welcome(camera: int, cameras: int, sender: int, data: bytes) -> Welcome | None:
    """Decode a welcome message for `camera`, one of `cameras`; None for any other message."""
    if not HEADER.size + _MEMBERS.size <= len(data) <= MAX_PAYLOAD_BYTES + HEADER.size:
        return None
    kind, author, _, epoch = HEADER.unpack_from(data)
    number, bits = _MEMBERS.unpack_from(data, HEADER.size)
    members = decode_cameras(bits)
    if kind != WELCOME or author != sender or sender == camera or not {camera, sender} <= members:
        return None
    if max(members) >= cameras or number >= MAX_ROUND:
        return None
    return Welcome(number, epoch, members, data[HEADER.size + _MEMBERS.size :])


def decode_hello(sender: int, data: bytes) -> Hello | None:
    """Decode a presence message; None for any other message."""
    if len(data) != HEADER.size + _GROUP.size:
        return None
    kind, author, _, _ = HEADER.unpack_from(data)
    return Hello(*_GROUP.unpack_from(data, HEADER.size)) if kind == HELLO and author == sender else None
