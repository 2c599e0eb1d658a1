"""Extrapolation: where the steps of several cameras lead, from how their messages changed in the last ones.

Source: D. G. Anderson, "Iterative procedures for nonlinear integral equations" (1965).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sylpose.geometry.arrays import FloatArray

__all__ = ["History", "extended", "extrapolated"]

# (V, change of V) of the last rounds, (C, 3, 3) each, all members in order.
History = tuple[tuple[FloatArray, FloatArray], ...]

# Rounds that the extrapolation looks back: more than the 9 unknowns of a rotation's matrix (choice).
MEMORY = 10


def extended(history: History, V: FloatArray, step: FloatArray) -> tuple[History, bool]:
    """With the last step; from anew, and astray, where that is longer than the steps before."""
    astray = bool(history) and not np.linalg.norm(step) < 2 * min(np.linalg.norm(f) for _, f in history)
    return (*(() if astray else history), (V, step))[-MEMORY - 1 :], astray


def extrapolated(history: History) -> FloatArray:
    """The combination of the last V whose steps cancel best, with its own step. (C, 3, 3)."""
    V, step = history[-1]
    if len(history) < 4:
        return np.asarray(V + step)
    weight = 1 / np.sqrt(np.linalg.norm(V, axis=(1, 2)) + 1e-300)[:, None, None]
    steps = np.array([b - a for (_, a), (_, b) in pairwise(history)])
    images = np.array([(vb + b) - (va + a) for (va, a), (vb, b) in pairwise(history)])
    A = (weight * steps).reshape(len(steps), -1)
    unit = 1 / np.maximum(np.linalg.norm(A, axis=1), 1e-300)
    A = A * unit[:, None]
    mix = unit * np.linalg.solve(A @ A.T + 1e-12 * np.eye(len(A)), A @ (weight * step).ravel())
    return np.asarray(V + step - np.tensordot(mix, images, 1))
