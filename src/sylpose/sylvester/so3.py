"""Quadratic costs on SO(3) and their certified global minima: the core problem of the paper's estimators.

With r the row-major vec of R, the cost (`QuadraticCost`) is 1/2 r'Hr - h'r, H positive semidefinite. Its stationary
points on SO(3) solve K r = h with K = H + L ⊗ I and a symmetric 3x3 multiplier L; for costs of the form Σ A_c R B_c
this is a generalized Sylvester equation. If K is positive definite, R is the global minimum, because for every other
rotation cost(R2) - cost(R) = 1/2 (r2 - r)' K (r2 - r). K can be indefinite at the minimum, because L is the multiplier
of RR' = I alone. The multipliers of all quadratic constraints of a rotation certify nearly every unique minimum
(`so3_sos_certificate`).

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
from sylpose.sylvester.so3_kernels import (
    GRADIENT_TOLERANCE,
    certify_each,
    derivatives_each,
    minimize_each,
)

# Initial rotations of the search: the 24 rotations of the cube; no rotation is farther than 63 degrees from one
# (choice).
_STARTS = np.ascontiguousarray(Rotation.create_group("O").as_matrix())
# Lower bound of the residuals' mean square, relative to that of the points: well above rounding's 1e-16 (choice).
MIN_RELATIVE_VARIANCE = 1e-12


class CostEvaluation(NamedTuple):
    """Quadratic costs (...) evaluated at rotations (..., 3, 3).

    Attributes:
        cost: (...) half the sum of squared residuals.
        stationary: (...) whether all tangent derivatives are within rounding (`GRADIENT_TOLERANCE`).
        multiplier: (..., 3, 3) L of Sylvester's equation, in the cost's units.
        information: (..., 3, 3) of w, exp(w) R, 1/rad²: the Hessian on SO(3) over `QuadraticCost.variance`.
    """

    cost: FloatArray
    stationary: BoolArray
    multiplier: FloatArray
    information: FloatArray


@dataclass(frozen=True, eq=False)
class QuadraticCost:
    """Quadratic cost of a rotation, 1/2 r'Hr - h'r + constant: half a sum of squared residuals.

    Costs of several cameras add. They are not normalized: H grows with the sum of the weights. Leading axes are
    problems.

    Attributes:
        H: (..., 9, 9) positive semidefinite.
        h: (..., 9).
        constant: (...) half the sum of squares of the measurements (the points in frame j).
        weight: (...) Σ w of the residuals, of two coordinates each.
    """

    H: FloatArray
    h: FloatArray
    constant: FloatArray
    weight: FloatArray

    @classmethod
    def from_terms(
        cls, A: FloatArray, B: FloatArray, C: FloatArray, constant: FloatArray, weight: FloatArray
    ) -> QuadraticCost:
        """Build the cost of Sylvester's equation Σ A_c R B_c + L R = Σ C_c: H = Σ A_c ⊗ B_c, h = vec(Σ C_c).

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
    def zero(cls) -> QuadraticCost:
        """Return the cost of a camera without matches."""
        return cls(np.zeros((9, 9)), np.zeros(9), np.zeros(()), np.zeros(()))

    def __add__(self, other: QuadraticCost) -> QuadraticCost:
        """Return the cost of both sets of residuals."""
        return QuadraticCost(
            self.H + other.H, self.h + other.h, self.constant + other.constant, self.weight + other.weight
        )

    @cached_property
    def scale(self) -> FloatArray:
        """(...) mean eigenvalue of H, the unit in which costs are compared."""
        return np.asarray(np.trace(self.H, axis1=-2, axis2=-1) / 9)

    def cost(self, rotations: FloatArray) -> FloatArray:
        """Return the cost (...) at rotations (..., 3, 3)."""
        return np.asarray(evaluate_cost(self.H, self.h, rotations) + self.constant)

    def is_better_than_zero(self, rotations: FloatArray) -> BoolArray:
        """Return (...) whether rotations (..., 3, 3) have a lower cost than the zero matrix.

        If noise is as large as the points' spread, a global minimum can be certified although it is due to chance.
        """
        return np.asarray(evaluate_cost(self.H, self.h, rotations) < 0.0)

    def variance(self, cost: FloatArray) -> FloatArray:
        """Return the mean square residual (...) per coordinate at this cost (...).

        It is at least 1e-12 of the points' own.
        """
        return np.asarray(np.maximum(cost, MIN_RELATIVE_VARIANCE * self.size) / self.weight)

    @property
    def size(self) -> FloatArray:
        """(...) size of the points: half their sum of squares in frame j plus about that in frame i; sizes add."""
        return np.asarray(self.constant + self.scale)

    def evaluate(self, rotations: FloatArray) -> CostEvaluation:
        """Evaluate cost, stationarity, multiplier and information at rotations (..., 3, 3)."""
        cost, gradient, hessian = _cost_and_derivatives(self.H, self.h, rotations)
        cost = cost + self.constant
        return CostEvaluation(
            cost,
            np.abs(gradient).max(axis=-1) < GRADIENT_TOLERANCE * self.scale,
            compute_multiplier(self.H, self.h, rotations),
            hessian / self.variance(cost)[..., None, None],
        )


class Minima(NamedTuple):
    """Minima of N costs.

    Attributes:
        candidates: (N, k, 3, 3) per cost its global minimum if certified, else all local minima found, best first; NaN
            from `counts` on. k is the largest count.
        counts: (N,) at least 1.
        certified: (N,) whether the first candidate is proved to be the unique global minimum.
        iterations: (N,) Newton steps, on the dual and, where that gave no certificate, on SO(3) and of the certificate.
    """

    candidates: FloatArray
    counts: IntArray
    certified: BoolArray
    iterations: IntArray


def minimize(H: FloatArray, h: FloatArray) -> tuple[FloatArray, bool, int]:
    """Minimize 1/2 r'Hr - h'r over SO(3), H (9, 9) positive semidefinite, h (9,), of any scale.

    Returns:
        candidates: (k, 3, 3) minima, best first.
        certified: whether the first is certified as the unique global minimum.
        iterations: Newton steps.
    """
    minima = minimize_batch(H[None], h[None])
    return minima.candidates[0], bool(minima.certified[0]), int(minima.iterations[0])


def minimize_batch(H: FloatArray, h: FloatArray) -> Minima:
    """Minimize N costs, H (N, 9, 9) and h (N, 9); results are bit-identical to `minimize`."""
    n = len(H)
    candidates = np.full((n, len(_STARTS), 3, 3), np.nan)
    counts, iterations, certified = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.bool_)
    minimize_each(_as_kernel_input(H), _as_kernel_input(h), _STARTS, candidates, counts, certified, iterations)
    candidates[np.arange(len(_STARTS)) >= counts[:, None]] = np.nan
    return Minima(candidates[:, : counts.max(initial=1)], counts, certified, iterations)


def is_certified(H: FloatArray, h: FloatArray, rotation: FloatArray) -> bool:
    """Return whether a rotation (3, 3) is stationary and certified as the unique global minimum.

    The criterion is that of `minimize`, for a rotation from another source.
    """
    certified = np.zeros(1, np.bool_)
    certify_each(_as_kernel_input(H[None]), _as_kernel_input(h[None]), _as_kernel_input(rotation[None]), certified)
    return bool(certified[0])


def compute_multiplier(H: FloatArray, h: FloatArray, rotations: FloatArray) -> FloatArray:
    """Return the multiplier (..., 3, 3) L = (C - Σ A R B) R', symmetrized; leading axes as in `evaluate_cost`.

    L is symmetric where the rotation is stationary.
    """
    R = rotations
    L = (h - _multiply(H, R)).reshape(R.shape) @ transpose(R)
    return np.asarray((L + transpose(L)) / 2)


def evaluate_cost(H: FloatArray, h: FloatArray, rotations: FloatArray) -> FloatArray:
    """Return 1/2 r'Hr - h'r (...) of rotations (..., 3, 3); H (..., 9, 9) and h (..., 9) broadcast."""
    r = rotations.reshape(*rotations.shape[:-2], 9)
    return np.asarray((r * (0.5 * _multiply(H, rotations) - h)).sum(axis=-1))


def compute_derivatives(H: FloatArray, h: FloatArray, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return gradient (..., 3) and Hessian (..., 3, 3) of the cost at exp(w) R, w = 0, for rotations (..., 3, 3).

    H (..., 9, 9) and h (..., 9) broadcast.
    """
    return _cost_and_derivatives(H, h, rotations)[1:]


def _cost_and_derivatives(
    H: FloatArray, h: FloatArray, rotations: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the results of `evaluate_cost` and `compute_derivatives`."""
    shape, n = rotations.shape[:-2], rotations[..., 0, 0].size
    cost, gradient, hessian = np.empty(shape), np.empty((*shape, 3)), np.empty((*shape, 3, 3))
    derivatives_each(
        _as_kernel_input(np.broadcast_to(H, (*shape, 9, 9)).reshape(n, 9, 9)),
        _as_kernel_input(np.broadcast_to(h, (*shape, 9)).reshape(n, 9)),
        _as_kernel_input(rotations.reshape(n, 3, 3)),
        cost.reshape(n),
        gradient.reshape(n, 3),
        hessian.reshape(n, 3, 3),
    )
    return cost, gradient, hessian


def _multiply(H: FloatArray, rotations: FloatArray) -> FloatArray:
    """Return H r (..., 9)."""
    return np.asarray((H @ rotations.reshape(*rotations.shape[:-2], 9, 1))[..., 0])


def _as_kernel_input(array: FloatArray) -> FloatArray:
    """Return the array as the kernels require it: float64, contiguous, writable."""
    return np.require(array, np.float64, ["C", "W"])
