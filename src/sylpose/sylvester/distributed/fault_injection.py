"""What becomes of the packets of a camera that is broken, or lies: for the simulated network."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.sylvester.distributed.evidence_exchange import SHOW
from sylpose.sylvester.distributed.messages import HEADER
from sylpose.sylvester.distributed.refine import SIZES

__all__ = ["Nonsense", "garbled"]

Nonsense = Literal["nan", "huge", "long", "truncated", "false", "stubborn", "two-faced", "ahead", "jitter", "heavy"]

# A claim so many times too large, rounds too far ahead, a relative jitter (choice: those that once did harm).
HEAVY, AHEAD, JITTER = 900.0, 1000, 1e-3


def garbled(kind: Nonsense, data: bytes, to: int, rng: np.random.Generator) -> bytes:
    """A packet's bytes as they arrive at camera `to`.

    Args:
        kind: "nan" and "huge" values, "long" and "truncated" bytes. Or well formed: "false", another random rotation and
            junk matches with every message; "stubborn", one false rotation and the matches that fit it, always and to all;
            "two-faced", another such story for each listener; "ahead", the number of a round far ahead; "jitter", values
            that tremble by a thousandth; "heavy", the claim of 900 times the matches.
    """
    if kind == "long":
        return data + bytes(8)
    if kind == "truncated":
        return data[:-5]
    size, flags, sender, number = HEADER.unpack_from(data)
    values = np.frombuffer(data[HEADER.size :], "<f8").copy()
    if kind == "nan":
        values[0] = np.nan
    elif kind == "huge":
        values *= 1e200
    elif kind == "ahead":
        number = (number + AHEAD) % 2**32
    elif kind == "jitter":
        values *= 1 + JITTER * rng.standard_normal(len(values))
    elif kind == "heavy":
        # Neither a camera's rotation, nor digests, nor an answer grow.
        values[: 45 if number >= SHOW else None] *= 1 if number > SHOW else HEAVY
    else:
        story = rng if kind == "false" else np.random.default_rng([sender, to if kind == "two-faced" else 0])
        values = _false(values, number, story, junk=kind == "false")
    return HEADER.pack(size, flags, sender, number) + values.astype("<f8").tobytes()


def _false(values: FloatArray, number: int, rng: np.random.Generator, *, junk: bool) -> FloatArray:
    values, turn = values.copy(), Rotation.random(rng=rng)
    if len(values) in (45, 54) and (len(values) == 45 or number == SHOW):
        x = 0.1 * rng.normal(size=(60, 3))
        y = 0.1 * rng.normal(size=(60, 2)) if junk else turn.apply(x)[:, :2]
        values[:45] = np.frombuffer(PairMoments.from_matches(x[:, :2], y).to_bytes(), "<f8")
    elif len(values) in SIZES and number != SHOW + 1:
        values[:9] = np.linalg.norm(values[:9]) / np.sqrt(3) * turn.as_matrix().ravel()
    else:
        values = np.linalg.norm(values) / np.sqrt(len(values)) * rng.normal(size=len(values))
    return values
