"""Off a saddle: all cameras leap together to the lowest point of a curve through it.

Extrapolation finds where nothing changes, which may be a saddle; starts halfway between mirrored solutions are often near
one, and where the cameras see little of the depth it is far from both minima and hardly steeper than they. So where all
have settled at a saddle, or the extrapolation has led astray, all tell their Hessians, then their costs along the flattest
axis of the sum, which are five numbers each, and all start again from the lowest point of that curve.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.sylvester.so3 import Quadratic

__all__ = ["LEAPS", "curve_of", "lowest"]

# Leaps off a saddle, at most (choice).
LEAPS = 5


def curve_of(e: Quadratic, axis: FloatArray, rotation: FloatArray) -> FloatArray:
    """(5,) of the cost at exp(a axis) R: the coefficients of 1, cos a, sin a, cos 2a, sin 2a, which is all there is."""
    angles = np.asarray(2 * np.pi / 5 * np.arange(5), dtype=float)
    costs = e.cost(Rotation.from_rotvec(angles[:, None] * axis).as_matrix() @ rotation) - e.constant
    return np.asarray(np.linalg.solve(_waves(angles), costs), dtype=float)


def lowest(curve: FloatArray, axis: FloatArray, rotation: FloatArray) -> FloatArray:
    """(3, 3) the rotation at the lowest point of a curve."""
    angles = np.linspace(-np.pi, np.pi, 1001)
    lowest = angles[np.argmin(_waves(angles) @ curve)]
    return np.asarray(Rotation.from_rotvec(lowest * axis).as_matrix() @ rotation)


def _waves(a: FloatArray) -> FloatArray:
    return np.column_stack([np.ones_like(a), np.cos(a), np.sin(a), np.cos(2 * a), np.sin(2 * a)])
