"""Fault injection for the simulated network: packets of broken or Byzantine nodes."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.sylvester.distributed.evidence_exchange import EVIDENCE_MESSAGE
from sylpose.sylvester.distributed.messages import HEADER
from sylpose.sylvester.distributed.refine import MESSAGE_SIZES

__all__ = ["PacketFault", "inject_fault"]

PacketFault = Literal["nan", "huge", "long", "truncated", "false", "stubborn", "two-faced", "ahead", "jitter", "heavy"]

# Factor of a false claim, rounds too far ahead, relative jitter (choice: values that caused failures in tests).
HEAVY, AHEAD, JITTER = 900.0, 1000, 1e-3


def inject_fault(kind: PacketFault, data: bytes, to: int, rng: np.random.Generator) -> bytes:
    """Return the faulty packet as it arrives at camera `to`.

    Args:
        kind: "nan" and "huge" values, "long" and "truncated" bytes. Or well formed: "false", another random rotation
            and junk matches with every message; "stubborn", one false rotation with matches that fit it, always and to
            all; "two-faced", a different one for each receiver; "ahead", a round number far ahead; "jitter", values
            with a relative noise of a thousandth; "heavy", a claim of 900 times the matches.
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
        # Camera rotation, digests and result keep their size.
        values[: 45 if number >= EVIDENCE_MESSAGE else None] *= 1 if number > EVIDENCE_MESSAGE else HEAVY
    else:
        story = rng if kind == "false" else np.random.default_rng([sender, to if kind == "two-faced" else 0])
        values = _falsify(values, number, story, junk=kind == "false")
    return HEADER.pack(size, flags, sender, number) + values.astype("<f8").tobytes()


def _falsify(values: FloatArray, number: int, rng: np.random.Generator, *, junk: bool) -> FloatArray:
    values, turn = values.copy(), Rotation.random(rng=rng)
    if len(values) in (45, 54) and (len(values) == 45 or number == EVIDENCE_MESSAGE):
        x = 0.1 * rng.normal(size=(60, 3))
        y = 0.1 * rng.normal(size=(60, 2)) if junk else turn.apply(x)[:, :2]
        values[:45] = np.frombuffer(PairMoments.from_matches(x[:, :2], y).to_bytes(), "<f8")
    elif len(values) in MESSAGE_SIZES and number != EVIDENCE_MESSAGE + 1:
        values[:9] = np.linalg.norm(values[:9]) / np.sqrt(3) * turn.as_matrix().ravel()
    else:
        values = np.linalg.norm(values) / np.sqrt(len(values)) * rng.normal(size=len(values))
    return values
