"""Quadratic costs on SO(3) and their minima, with a certificate: what the paper's estimators all come down to.

With r the row-major vec of R, the cost (`Quadratic`) is 1/2 r'Hr - h'r, H positive semidefinite. Its stationary points on
SO(3) solve K r = h with K = H + L ⊗ I and a symmetric 3x3 multiplier L, for costs of the form Σ A_c R B_c a generalised
Sylvester's equation. If K is positive definite, R is the global minimum, because for every other rotation
cost(R2) - cost(R) = 1/2 (r2 - r)' K (r2 - r). It need not be: L is the multiplier of RR' = I alone. With those of all that
is quadratic and holds of a rotation nearly every minimum is proved that is the only one (`so3_squares`).

Source: the equation is Chen & Schonfeld's (2010); the dual, the certificate and the search are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import transpose
from sylpose.sylvester.so3_kernels import FLAT, STATIONARY, certify_each, derivatives_each, minimize_each
from sylpose.sylvester.so3_sos_certificate import CERTIFICATE

__all__ = [
    "CERTIFICATE",
    "FLAT",
    "STATIONARY",
    "Minima",
    "Point",
    "Quadratic",
    "cost_of",
    "derivatives",
    "is_certified",
    "minimize",
    "minimize_batch",
    "multiplier_of",
]


# The search's starts: the 24 rotations of the cube, no rotation is farther than 63 degrees from one (choice).
_STARTS = np.ascontiguousarray(Rotation.create_group("O").as_matrix())
# Residuals' mean square is taken to be at least this share of the points' own: well above rounding's 1e-16 (choice).
LEAST = 1e-12


class Point(NamedTuple):
    """What quadratic costs (...) are at rotations (..., 3, 3).

    Attributes:
        cost: (...) half the sum of squared residuals.
        stationary: (...) no tangent derivative is above rounding (`STATIONARY`).
        multiplier: (..., 3, 3) L of Sylvester's equation, in the cost's units.
        information: (..., 3, 3) of w, exp(w) R, 1/rad²: the Hessian on SO(3) over `Quadratic.variance`.
    """

    cost: FloatArray
    stationary: BoolArray
    multiplier: FloatArray
    information: FloatArray


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Half a sum of squared residuals as a function of a rotation, 1/2 r'Hr - h'r + constant. Those of cameras add.

    Not scaled, so that sums are sums: H is as large as the weights are many. Leading axes are problems.

    Attributes:
        H: (..., 9, 9) positive semidefinite.
        h: (..., 9).
        constant: (...) half the sum of squares of what is to be explained.
        weight: (...) Σ w of the residuals, of two coordinates each.
    """

    H: FloatArray
    h: FloatArray
    constant: FloatArray
    weight: FloatArray

    @classmethod
    def of_terms(
        cls, A: FloatArray, B: FloatArray, C: FloatArray, constant: FloatArray, weight: FloatArray
    ) -> Quadratic:
        """Of Sylvester's equation Σ A_c R B_c + L R = Σ C_c: H = Σ A_c ⊗ B_c, h = vec(Σ C_c).

        Args:
            A, B, C: (..., C, 3, 3); A and B symmetric.
            constant, weight: (..., C).
        """
        n = A.shape[:-3]
        # One matrix product for all cameras.
        H = transpose(A.reshape(*A.shape[:-2], 9)) @ B.reshape(*B.shape[:-2], 9)
        H = np.swapaxes(H.reshape(*n, 3, 3, 3, 3), -2, -3).reshape(*n, 9, 9)
        return cls((H + transpose(H)) / 2, C.sum(axis=-3).reshape(*n, 9), constant.sum(axis=-1), weight.sum(axis=-1))

    @classmethod
    def zero(cls) -> Quadratic:
        """Of a camera that has nothing to say."""
        return cls(np.zeros((9, 9)), np.zeros(9), np.zeros(()), np.zeros(()))

    def __add__(self, other: Quadratic) -> Quadratic:
        """The cost of both sets of residuals together."""
        return Quadratic(self.H + other.H, self.h + other.h, self.constant + other.constant, self.weight + other.weight)

    @cached_property
    def scale(self) -> FloatArray:
        """(...) the mean eigenvalue of H: what to divide by to compare costs with 1."""
        return np.asarray(np.trace(self.H, axis1=-2, axis2=-1) / 9)

    def cost(self, rotations: FloatArray) -> FloatArray:
        """(...) at rotations (..., 3, 3)."""
        return np.asarray(cost_of(self.H, self.h, rotations) + self.constant)

    def explained(self, rotations: FloatArray) -> BoolArray:
        """(...) whether rotations (..., 3, 3) leave less than the zero matrix would: what is seen has to do with them. Where
        noise is as large as the points' spread the one global minimum can be proved, too, and is by chance."""
        return np.asarray(cost_of(self.H, self.h, rotations) < 0.0)

    def variance(self, cost: FloatArray) -> FloatArray:
        """(...) mean square residual per coordinate where the cost (...) is this; at least 1e-12 of the points' own."""
        return np.asarray(np.maximum(cost, LEAST * self.size) / self.weight)

    @property
    def size(self) -> FloatArray:
        """(...) of the points: half their sum of squares in frame j, and nearly so in frame i. It adds, as the cost does."""
        return np.asarray(self.constant + self.scale)

    def at(self, rotations: FloatArray) -> Point:
        """All that is asked at rotations (..., 3, 3)."""
        cost, gradient, hessian = _with_derivatives(self.H, self.h, rotations)
        cost = cost + self.constant
        return Point(
            cost,
            np.abs(gradient).max(axis=-1) < STATIONARY * self.scale,
            multiplier_of(self.H, self.h, rotations),
            hessian / self.variance(cost)[..., None, None],
        )


class Minima(NamedTuple):
    """Of N costs.

    Attributes:
        candidates: (N, k, 3, 3) per cost its one minimum where certified, else all local minima found, best first; NaN
            from `counts` on. k is the largest count.
        counts: (N,) at least 1.
        certified: (N,) whether the first candidate is proved to be the one global minimum.
        iterations: (N,) Newton steps, on the dual and, where that gave no certificate, on SO(3) and of the proof.
    """

    candidates: FloatArray
    counts: IntArray
    certified: BoolArray
    iterations: IntArray


def minimize(H: FloatArray, h: FloatArray) -> tuple[FloatArray, bool, int]:
    """Minimise 1/2 r'Hr - h'r over SO(3), H (9, 9) positive semidefinite, h (9,), of any scale.

    Returns (k, 3, 3) minima, best first; whether the first is certified as the one global minimum; iterations.
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


def is_certified(H: FloatArray, h: FloatArray, rotation: FloatArray) -> bool:
    """Whether a rotation (3, 3) is stationary, and proved to be the one global minimum as far as it is: what `minimize` says
    of its own, for one from elsewhere."""
    certified = np.zeros(1, np.bool_)
    certify_each(_plain(H[None]), _plain(h[None]), _plain(rotation[None]), certified)
    return bool(certified[0])


def multiplier_of(H: FloatArray, h: FloatArray, rotations: FloatArray) -> FloatArray:
    """(..., 3, 3) L = (C - Σ A R B) R', made symmetric, which it is where the rotation is stationary; axes as `cost_of`."""
    R = rotations
    L = (h - _times(H, R)).reshape(R.shape) @ transpose(R)
    return np.asarray((L + transpose(L)) / 2)


def cost_of(H: FloatArray, h: FloatArray, rotations: FloatArray) -> FloatArray:
    """(...) 1/2 r'Hr - h'r of (..., 3, 3) rotations; H (..., 9, 9) and h (..., 9) broadcast."""
    r = rotations.reshape(*rotations.shape[:-2], 9)
    return np.asarray((r * (0.5 * _times(H, rotations) - h)).sum(axis=-1))


def derivatives(H: FloatArray, h: FloatArray, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient (..., 3) and Hessian (..., 3, 3) of the cost at exp(w) R, w = 0, of (..., 3, 3) rotations.

    H (..., 9, 9) and h (..., 9) broadcast.
    """
    return _with_derivatives(H, h, rotations)[1:]


def _with_derivatives(H: FloatArray, h: FloatArray, rotations: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`cost_of` and `derivatives`."""
    shape, n = rotations.shape[:-2], rotations[..., 0, 0].size
    cost, gradient, hessian = np.empty(shape), np.empty((*shape, 3)), np.empty((*shape, 3, 3))
    derivatives_each(
        _plain(np.broadcast_to(H, (*shape, 9, 9)).reshape(n, 9, 9)),
        _plain(np.broadcast_to(h, (*shape, 9)).reshape(n, 9)),
        _plain(rotations.reshape(n, 3, 3)),
        cost.reshape(n),
        gradient.reshape(n, 3),
        hessian.reshape(n, 3, 3),
    )
    return cost, gradient, hessian


def _times(H: FloatArray, rotations: FloatArray) -> FloatArray:
    """(..., 9) H r."""
    return np.asarray((H @ rotations.reshape(*rotations.shape[:-2], 9, 1))[..., 0])


def _plain(array: FloatArray) -> FloatArray:
    """As kernels are compiled for: float64, contiguous, writable."""
    return np.require(array, np.float64, ["C", "W"])
