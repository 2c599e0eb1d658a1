"""What a camera knows of a rotation, and how it says it: one quadratic cost on SO(3), in 56 numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sylpose.moments import PairMoments
from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.matrices import symmetric_of, upper_of
from sylpose.paper.orthographic import quadratic_of, views_of
from sylpose.paper.so3 import Quadratic

__all__ = ["EVIDENCE", "evidence_of", "packed", "unpacked"]

# Numbers of one: H's upper triangle, h, constant and weight (derived).
EVIDENCE = 45 + 9 + 2


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
