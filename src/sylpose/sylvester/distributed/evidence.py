"""What a camera knows of a rotation, and how it says it: one quadratic cost on SO(3), in 56 numbers; at one rotation, what
surfaces may have done to it, in 80."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import symmetric_of, upper_of
from sylpose.moments import PairMoments
from sylpose.sylvester.depth_bias import LEANING, Sums
from sylpose.sylvester.orthographic import quadratic_of, views_of
from sylpose.sylvester.so3 import LEAST, Quadratic

__all__ = ["EVIDENCE", "SURFACES", "evidence_of", "noise_of", "packed", "packed_sums", "unpacked", "unpacked_sums"]

# Numbers of one: H's upper triangle, h, constant and weight (derived).
EVIDENCE = 45 + 9 + 2
# Of `surfaces.Sums`: B, own and scales, shape, fits and doubts (derived).
SURFACES = 3 * 6 + 18 + len(LEANING) * (10 + 1)


def evidence_of(rotation: ArrayLike, moments: PairMoments, *, aim: bool = True) -> Quadratic:
    """Of one camera, Q (3, 3) of camera_from_world; zero if its matches have no spread.

    Raises:
        ValueError: a matrix that is no rotation.
    """
    views = views_of(np.asarray(rotation, dtype=float)[None], [moments], aim=aim)
    try:
        return quadratic_of(views)
    except ValueError:
        return Quadratic.zero()


def packed(evidence: Quadratic) -> FloatArray:
    """(56,) as sent. Means and sums of these are those of the evidence."""
    return np.array([*upper_of(evidence.H), *evidence.h, evidence.constant, evidence.weight])


def unpacked(values: FloatArray) -> Quadratic:
    """The inverse of `packed`."""
    return Quadratic(symmetric_of(values[:45]), values[45:54], values[54], values[55])


def noise_of(cost: float, size: float, weight: float) -> float:
    """`Quadratic.variance` over `Quadratic.size`: what `surfaces.sums_of` is told."""
    return max(cost / size, LEAST) / weight


def packed_sums(sums: Sums, noise: float) -> FloatArray:
    """(80,) as sent, none much larger than 1, and as they add up; `noise` as of `sums_of`."""
    squares = [upper_of(matrix) for matrix in sums[:3]]
    fits = [noise * upper_of(fit) for fit in sums.fits]
    return np.concatenate([*squares, sums.shape.ravel(), *fits, sums.doubts])


def unpacked_sums(values: FloatArray, noise: float) -> Sums:
    """The inverse of `packed_sums`."""
    turns, own, scales = (symmetric_of(part) for part in values[:18].reshape(3, 6))
    fits = np.array([symmetric_of(part) for part in values[36 : -len(LEANING)].reshape(-1, 10)]) / noise
    return Sums(turns, own, scales, values[18:36].reshape(3, 6), fits, values[-len(LEANING) :])
