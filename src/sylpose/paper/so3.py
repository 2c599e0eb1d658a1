"""Minima of quadratic costs on SO(3), with a certificate: what the paper's estimators all come down to.

With r the row-major vec of R, the cost is 1/2 r'Hr - h'r, H positive semidefinite. Its stationary points on SO(3) solve
K r = h with K = H + L ⊗ I and a symmetric 3x3 multiplier L, for costs of the form Σ A_c R B_c a generalised Sylvester's
equation. If K is positive definite, R is the global minimum, because for every other rotation
cost(R2) - cost(R) = 1/2 (r2 - r)' K (r2 - r).

Source: the equation is Chen & Schonfeld's (2010); the dual, the certificate and the search are ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.numerics.arrays import BoolArray, FloatArray, IntArray
from sylpose.paper.so3_kernels import CERTIFICATE, FLAT, STATIONARY, derivatives_each, minimize_each

__all__ = [
    "CERTIFICATE",
    "FLAT",
    "STATIONARY",
    "Minima",
    "cost_of",
    "derivatives",
    "minimize",
    "minimize_batch",
    "multiplier_of",
]


_STARTS = np.ascontiguousarray(Rotation.create_group("O").as_matrix())


class Minima(NamedTuple):
    """Of N costs.

    Attributes:
        candidates: (N, k, 3, 3) per cost its one minimum where certified, else all local minima found, best first; NaN
            from `counts` on. k is the largest count.
        counts: (N,) at least 1.
        certified: (N,) whether the first candidate is proved to be the global minimum.
        iterations: (N,) Newton steps, on the dual and, where that gave no certificate, on SO(3).
    """

    candidates: FloatArray
    counts: IntArray
    certified: BoolArray
    iterations: IntArray


def minimize(H: FloatArray, h: FloatArray) -> tuple[FloatArray, bool, int]:
    """Minimise 1/2 r'Hr - h'r over SO(3), H (9, 9) positive semidefinite with trace 9, h (9,).

    Returns (k, 3, 3) minima, best first; whether the first is certified as the global one; iterations.
    """
    found = minimize_batch(H[None], h[None])
    return found.candidates[0], bool(found.certified[0]), int(found.iterations[0])


def minimize_batch(H: FloatArray, h: FloatArray) -> Minima:
    """`minimize` for N costs, H (N, 9, 9) and h (N, 9): the same answers to the bit."""
    n = len(H)
    candidates = np.full((n, len(_STARTS), 3, 3), np.nan)
    counts, iterations, certified = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.bool_)
    minimize_each(_plain(H), _plain(h), _STARTS, candidates, counts, certified, iterations)
    candidates[np.arange(len(_STARTS)) >= counts[:, None]] = np.nan
    return Minima(candidates[:, : counts.max(initial=1)], counts, certified, iterations)


def multiplier_of(H: FloatArray, h: FloatArray, rotations: FloatArray) -> FloatArray:
    """(..., 3, 3) L = (C - Σ A R B) R', made symmetric, which it is where the rotation is stationary; axes as `cost_of`."""
    R = rotations
    L = (h - _times(H, R)).reshape(R.shape) @ np.swapaxes(R, -1, -2)
    return np.asarray((L + np.swapaxes(L, -1, -2)) / 2)


def cost_of(H: FloatArray, h: FloatArray, rotations: FloatArray) -> FloatArray:
    """(...) 1/2 r'Hr - h'r of (..., 3, 3) rotations; H (..., 9, 9) and h (..., 9) broadcast."""
    r = rotations.reshape(*rotations.shape[:-2], 9)
    return np.asarray((r * (0.5 * _times(H, rotations) - h)).sum(axis=-1))


def derivatives(H: FloatArray, h: FloatArray, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient (..., 3) and Hessian (..., 3, 3) of the cost at exp(w) R, w = 0, of (..., 3, 3) rotations.

    H (..., 9, 9) and h (..., 9) broadcast.
    """
    shape, n = rotations.shape[:-2], rotations[..., 0, 0].size
    gradient, hessian = np.empty((*shape, 3)), np.empty((*shape, 3, 3))
    derivatives_each(
        _plain(np.broadcast_to(H, (*shape, 9, 9)).reshape(n, 9, 9)),
        _plain(np.broadcast_to(h, (*shape, 9)).reshape(n, 9)),
        _plain(rotations.reshape(n, 3, 3)),
        np.empty(n),
        gradient.reshape(n, 3),
        hessian.reshape(n, 3, 3),
    )
    return gradient, hessian


def _times(H: FloatArray, rotations: FloatArray) -> FloatArray:
    """(..., 9) H r."""
    return np.asarray((H @ rotations.reshape(*rotations.shape[:-2], 9, 1))[..., 0])


def _plain(array: FloatArray) -> FloatArray:
    """As kernels are compiled for: float64, contiguous, writable."""
    return np.require(array, np.float64, ["C", "W"])
