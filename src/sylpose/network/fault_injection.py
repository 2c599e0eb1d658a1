"""What becomes of the words of a node that lies: for the simulated network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import symmetric_of
from sylpose.landmarks.messages import Says
from sylpose.network.codec import packed, unpacked
from sylpose.network.wire_format import HEADER, TELLS, kind_of

__all__ = ["Liar", "Lie", "false_content", "liar"]

Lie = Literal["two-faced", "whispering", "accusing", "stubborn", "false", "heavy", "bent", "nan", "junk", "flipped"]
# A node's word as it arrives at another one.
Liar: TypeAlias = Callable[[bytes, int], bytes]

# A claim so many times too large; how far off a false pose is, radians and of the object's size (choice).
HEAVY, OFF = 900.0, 0.3
# Bytes that are others (choice).
FLIPPED = 2
# From which round on a camera accuses the others (choice).
ACCUSES = 40


def liar(lie: Lie, camera: int, cameras: int, seed: int = 0) -> Liar | None:
    """How a camera of so many tells its listeners different things; None where it tells all the same (`false_content`).

    Args:
        lie: "two-faced", another false pose for each listener; "whispering", one for one listener alone, the others are told
            the truth; "accusing", the truth, with a digest of something else.
    """
    victim = (camera + 1) % cameras

    def lies(data: bytes, to: int) -> bytes:
        if kind_of(data) != TELLS or (lie == "whispering" and to != victim):
            return data
        kind, sender, number, epoch = HEADER.unpack_from(data)
        if lie == "accusing":
            return HEADER.pack(kind, sender, number, epoch ^ (number > ACCUSES)) + data[HEADER.size :]
        return data[: HEADER.size] + _changed(data[HEADER.size :], lie, np.random.default_rng([seed, camera, to]))

    return lies if lie in ("two-faced", "whispering", "accusing") else None


def false_content(lie: Lie, camera: int, seed: int = 0) -> Callable[[bytes], bytes]:
    """What a camera tells in place of the truth, and goes on with itself.

    Args:
        lie: "stubborn", always the same false pose; "false", another one in each round; "heavy", 900 times the information,
            of a false pose; "bent", an information that is none; "nan", no numbers; "junk", other bytes; "flipped", some
            bytes of any message are others.
    """
    rng, anew = np.random.default_rng([seed, camera]), lie in ("false", "flipped")
    return lambda content: _changed(content, lie, rng if anew else np.random.default_rng([seed, camera]))


def _changed(content: bytes, lie: Lie, rng: np.random.Generator) -> bytes:
    """Of a round of the alignment; another message stays, unless bytes are flipped."""
    if lie == "flipped":
        data = np.frombuffer(content, np.uint8).copy()
        if len(data):
            data[rng.integers(len(data), size=FLIPPED)] = rng.integers(256, size=FLIPPED)
        return data.tobytes()
    says = _says_of(content)
    if not says:
        return content
    if lie == "junk":
        return rng.bytes(len(content))
    off = OFF * rng.standard_normal(6)
    return packed(tuple(_false(one, lie, off) for one in says))


def _says_of(content: bytes) -> tuple[Says, ...]:
    """What a camera says of several poses in a round of the alignment; nothing of another message."""
    for count in range(1, 40):
        try:
            return unpacked(content, (Says(np.zeros(27), 0.0, np.nan),) * count)
        except ValueError:
            continue
    return ()


def _false(says: Says, lie: Lie, off: FloatArray) -> Says:
    upper = says.upper.copy()
    information = symmetric_of(upper[:21])
    if lie == "nan":
        upper[:] = np.nan
    elif lie == "bent":
        upper[:21] *= -1.0
    else:
        # Where it says the pose is, it would be at rest.
        scale = np.sqrt(np.trace(information[:3, :3]) / max(np.trace(information[3:, 3:]), 1e-300))
        upper[21:] = -information @ (off * np.repeat([1.0, scale], 3))
    if lie == "heavy":
        return Says(upper * HEAVY, says.mass * HEAVY, says.level_px)
    return Says(upper, says.mass, says.level_px)
