"""Saddle escape: all nodes restart from the lowest point of a curve through the saddle point.

Extrapolation converges to stationary points, which may be saddles. Starts halfway between mirrored solutions are often
near one; if depth is hardly observable, the saddle is far from both minima and its cost hardly higher. If all nodes
have converged to a saddle, or the extrapolation has diverged, they exchange their Hessians, then their costs along the
flattest axis of the sum (five numbers each), and restart from the lowest point of that curve.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.sylvester.so3 import QuadraticCost

__all__ = ["MAX_RESTARTS", "fit_cost_curve", "minimize_curve"]

# Maximum number of restarts from a saddle (choice).
MAX_RESTARTS = 5


def fit_cost_curve(e: QuadraticCost, axis: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the coefficients (5,) of the cost at exp(a axis) R, exactly: of 1, cos a, sin a, cos 2a, sin 2a."""
    angles = np.asarray(2 * np.pi / 5 * np.arange(5), dtype=float)
    costs = e.cost(Rotation.from_rotvec(angles[:, None] * axis).as_matrix() @ rotation) - e.constant
    return np.asarray(np.linalg.solve(_fourier_basis(angles), costs), dtype=float)


def minimize_curve(curve: FloatArray, axis: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) at the lowest point of a curve."""
    angles = np.linspace(-np.pi, np.pi, 1001)
    best_angle = angles[np.argmin(_fourier_basis(angles) @ curve)]
    return np.asarray(Rotation.from_rotvec(best_angle * axis).as_matrix() @ rotation)


def _fourier_basis(a: FloatArray) -> FloatArray:
    return np.column_stack([np.ones_like(a), np.cos(a), np.sin(a), np.cos(2 * a), np.sin(2 * a)])
