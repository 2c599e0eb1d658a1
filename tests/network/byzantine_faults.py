"""Byzantine faults for the simulated network: falsified messages of a camera."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import unpack_symmetric
from sylpose.landmarks.messages import TermsMessage
from sylpose.network.codec import decode, encode
from sylpose.network.simulation import NodeFault
from sylpose.network.wire_format import DATA, HEADER, message_kind

__all__ = ["FaultKind", "make_fault"]

FaultKind = Literal[
    "two-faced", "whispering", "accusing", "stubborn", "false", "heavy", "bent", "nan", "junk", "flipped"
]
# Factor by which information is exaggerated; and error of a false pose, radians and relative to the object's size
# (choice).
EXAGGERATION, POSE_ERROR = 900.0, 0.3
# Number of corrupted bytes (choice).
N_CORRUPTED_BYTES = 2
# First round in which a camera accuses the others (choice).
FIRST_ACCUSING_ROUND = 40


def make_fault(fault: FaultKind, camera: int, cameras: int, seed: int = 0) -> NodeFault:
    """Make a fault of a node.

    Args:
        fault: different messages for different receivers: "two-faced", another false pose for each; "whispering", a
            false pose for one and the truth for the others; "accusing", the truth, with the digest of another history.
            The same for all: "stubborn", always the same false pose; "false", another one in each round; "heavy", a
            false pose with 900 times the information; "bent", an indefinite information matrix; "nan", NaN; "junk",
            random bytes; "flipped", corrupted bytes in any message.
        camera: number of the faulty camera.
        cameras: number of cameras.
        seed: seed of the random errors.
    """
    if fault in ("two-faced", "whispering", "accusing"):
        return NodeFault(alter_message=_make_message_fault(fault, camera, (camera + 1) % cameras, seed))
    rng, is_varying = np.random.default_rng([seed, camera]), fault in ("false", "flipped")
    return NodeFault(
        lambda content: _falsify_payload(content, fault, rng if is_varying else np.random.default_rng([seed, camera]))
    )


def _make_message_fault(fault: FaultKind, camera: int, victim: int, seed: int) -> Callable[[bytes, int], bytes]:
    """Make a fault in which a camera sends different messages to different receivers."""

    def falsify(data: bytes, to: int) -> bytes:
        if message_kind(data) != DATA or (fault == "whispering" and to != victim):
            return data
        kind, sender, number, epoch = HEADER.unpack_from(data)
        if fault == "accusing":
            return HEADER.pack(kind, sender, number, epoch ^ (number > FIRST_ACCUSING_ROUND)) + data[HEADER.size :]
        return data[: HEADER.size] + _falsify_payload(
            data[HEADER.size :], fault, np.random.default_rng([seed, camera, to])
        )

    return falsify


def _falsify_payload(content: bytes, fault: FaultKind, rng: np.random.Generator) -> bytes:
    """Falsify the payload of an alignment round; other payloads only if bytes are corrupted."""
    if fault == "flipped":
        data = np.frombuffer(content, np.uint8).copy()
        if len(data):
            data[rng.integers(len(data), size=N_CORRUPTED_BYTES)] = rng.integers(256, size=N_CORRUPTED_BYTES)
        return data.tobytes()
    messages = _decode_messages(content)
    if not messages:
        return content
    if fault == "junk":
        return rng.bytes(len(content))
    pose_error = POSE_ERROR * rng.standard_normal(6)
    return encode(tuple(_falsify_message(one, fault, pose_error) for one in messages))


def _decode_messages(content: bytes) -> tuple[TermsMessage, ...]:
    """Decode a camera's contributions for several poses in an alignment round; empty for other messages."""
    for count in range(1, 40):
        try:
            return decode(content, (TermsMessage(np.zeros(27), 0.0, np.nan),) * count)
        except ValueError:
            continue
    return ()


def _falsify_message(message: TermsMessage, fault: FaultKind, pose_error: FloatArray) -> TermsMessage:
    upper = message.upper.copy()
    information = unpack_symmetric(upper[:21])
    if fault == "nan":
        upper[:] = np.nan
    elif fault == "bent":
        upper[:21] *= -1.0
    else:
        # The gradient vanishes at the false pose.
        scale = np.sqrt(np.trace(information[:3, :3]) / max(np.trace(information[3:, 3:]), 1e-300))
        upper[21:] = -information @ (pose_error * np.repeat([1.0, scale], 3))
    if fault == "heavy":
        return TermsMessage(upper * EXAGGERATION, message.weight_sum * EXAGGERATION, message.noise_px)
    return TermsMessage(upper, message.weight_sum, message.noise_px)
