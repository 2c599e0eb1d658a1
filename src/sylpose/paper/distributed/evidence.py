"""What a camera knows of a rotation, as one quadratic on SO(3) that adds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sylpose.moments import PairMoments
from sylpose.numerics.arrays import FloatArray
from sylpose.paper.orthographic import quadratic_of, views_of
from sylpose.paper.so3 import cost_of, derivatives

__all__ = ["Evidence", "evidence_of"]


class Evidence(NamedTuple):
    """Half the sum of squared residuals of one camera or more: 1/2 r'Hr - h'r + constant, weight = Σ w. Sums add."""

    H: FloatArray
    h: FloatArray
    constant: float
    weight: float

    def information(self, rotation: FloatArray) -> FloatArray:
        """(3, 3) of w at a rotation, as in `CentralizedSolution`."""
        hessian, cost = derivatives(self.H, self.h, rotation)[1], float(cost_of(self.H, self.h, rotation))
        return information_of(hessian, cost + self.constant, self.constant, self.weight)


def evidence_of(rotation: ArrayLike, moments: PairMoments, *, aim: bool = True) -> Evidence:
    """Of one camera, Q (3, 3) of camera_from_world; zero if its matches have no spread.

    Raises:
        ValueError: a matrix that is no rotation.
    """
    views = views_of(np.asarray(rotation, dtype=float)[None], [moments], aim=aim)
    try:
        q = quadratic_of(views)
    except ValueError:
        return Evidence(np.zeros((9, 9)), np.zeros(9), 0.0, 0.0)
    return Evidence(q.H * q.scale, q.h * q.scale, q.constant * q.scale, q.weight)


def information_of(hessian: FloatArray, cost: float, constant: float, weight: float) -> FloatArray:
    variance = max(cost, 1e-12 * constant) / weight
    return np.asarray(hessian / variance)
