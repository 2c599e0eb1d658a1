"""Anderson acceleration: extrapolation of the fixed-point iteration from the last changes of all messages.

Source: D. G. Anderson, "Iterative procedures for nonlinear integral equations" (1965).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sylpose.geometry.arrays import FloatArray

__all__ = ["History", "extend_history", "extrapolate"]

# (V, change of V) of the last rounds, (C, 3, 3) each, members in order.
History = tuple[tuple[FloatArray, FloatArray], ...]

# Number of past rounds used: more than the 9 unknowns of a rotation matrix (choice).
MAX_HISTORY = 10


def extend_history(history: History, V: FloatArray, step: FloatArray) -> tuple[History, bool]:
    """Append the last step; restart the history and return True if it is much longer than the previous ones."""
    has_diverged = bool(history) and not np.linalg.norm(step) < 2 * min(np.linalg.norm(f) for _, f in history)
    return (*(() if has_diverged else history), (V, step))[-MAX_HISTORY - 1 :], has_diverged


def extrapolate(history: History) -> FloatArray:
    """Return the extrapolated V (C, 3, 3): the combination of the last V with the smallest step, plus that step."""
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
