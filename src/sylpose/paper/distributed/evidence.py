"""What a camera knows of a rotation, and how it says it: one quadratic cost on SO(3), in 56 numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sylpose.moments import PairMoments
from sylpose.numerics.arrays import FloatArray
from sylpose.paper.orthographic import quadratic_of, views_of
from sylpose.paper.so3 import Quadratic

__all__ = ["EVIDENCE", "evidence_of", "packed", "unpacked"]

# Numbers of one: H's upper triangle, h, constant and weight (derived).
EVIDENCE = 45 + 9 + 2

_UPPER = np.triu_indices(9)


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
    return np.array([*evidence.H[_UPPER], *evidence.h, evidence.constant, evidence.weight])


def unpacked(values: FloatArray) -> Quadratic:
    """The inverse of `packed`."""
    H = np.zeros((9, 9))
    H[_UPPER] = values[:45]
    return Quadratic(H + np.triu(H, 1).T, values[45:54], values[54], values[55])
