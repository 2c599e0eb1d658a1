"""Quadratic costs on SO(3) and their certified global minima: the core problem of the paper's estimators.

With r the row-major vec of R, the cost (`QuadraticCost`) is 1/2 r'Hr - h'r, H positive semidefinite. Its stationary
points on SO(3) solve K r = h with K = H + L ⊗ I and a symmetric 3x3 multiplier L; for costs of the form Σ A_c R B_c
this is a generalized Sylvester equation. If K is positive definite, R is the global minimum, because for every other
rotation cost(R2) - cost(R) = 1/2 (r2 - r)' K (r2 - r). K can be indefinite at the minimum, because L is the multiplier
of RR' = I alone. The multipliers of all quadratic constraints of a rotation certify nearly every unique minimum
(`so3_sos_certificate`).

The compiled kernels find minima by the dual and by Newton's method on SO(3), for N problems sequentially. The result of
each problem depends on that problem alone, so it is bit-identical in batches of any size.

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
from sylpose.geometry.numba_linalg import apply_rotvec, cholesky, cholesky_solve, dot, kernel, solve_factored
from sylpose.sylvester.so3_sos_certificate import CERTIFICATE, COST_TOLERANCE, certify_minimum

# Stationarity tolerance of the largest tangent derivative of the cost, for a mean eigenvalue of H of 1:
# the root of rounding (derived).
GRADIENT_TOLERANCE = 1e-8
# Curvature less negative than this, relative to that mean, counts as zero (choice).
ZERO_CURVATURE = 1e-6
# Minima nearer than this (radians) are merged; where two mirrored minima coincide they are found to about 1e-4 only
# (derived: the cost is of fourth order there).
MERGE_ANGLE = 1e-3
# Number of best starts that are minimized from before the first certificate is tried: they reach the global minimum
# (measured: in 96 to 100 % of 300 problems each of six kinds of benchmarks/certificate.py).
N_FIRST_STARTS = 4
# A bound on Newton's steps (choice).
MAX_NEWTON_STEPS = 100
# A bound on Newton's steps; certified problems take three or four (choice).
MAX_DUAL_STEPS = 40
# Indices (a, b) of the orthonormal basis (e_a e_b' + e_b e_a') / norm of the symmetric 3x3 matrices.
_ROWS, _COLUMNS = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


class Minima(NamedTuple):
    """Minima of N costs.

    Attributes:
        candidates: (N, k, 3, 3) per cost its global minimum if certified, else all local minima found, best first; NaN
            from `counts` on.
        counts: (N,) at least 1.
        certified: (N,) whether the first candidate is proved to be the unique global minimum.
        iterations: (N,) Newton steps, on the dual and, where that gave no certificate, on SO(3) and of the certificate.
    """

    candidates: FloatArray
    counts: IntArray
    certified: BoolArray
    iterations: IntArray


@kernel
def _minimize_each(H: FloatArray, h: FloatArray, starts: FloatArray) -> Minima:
    """Minimize 1/2 r'Hr - h'r over SO(3) for N problems.

    Args:
        H: (N, 9, 9) positive semidefinite, h: (N, 9); scaled here to a mean eigenvalue of 1, for which the limits are
            set.
        starts: (S, 3, 3) initial rotations of the search, used where the dual gives no certificate.
    """
    n_problems, n_starts = len(H), len(starts)
    counts, iterations = np.ones(n_problems, np.int64), np.zeros(n_problems, np.int64)
    found = Minima(np.full((n_problems, n_starts, 3, 3), np.nan), counts, np.zeros(n_problems, np.bool_), iterations)
    for n in range(n_problems):
        scaled_H, scaled_h = _rescale(H[n], h[n])
        is_solved, iterations[n] = _solve_dual(scaled_H, scaled_h, found.candidates[n, 0])
        found.certified[n] = is_solved and _is_certified(scaled_H, scaled_h, found.candidates[n, 0])
        if not found.certified[n]:
            found.certified[n], counts[n], steps = _search_minima(scaled_H, scaled_h, starts, found.candidates[n])
            iterations[n] += steps
    return found


@kernel
def _certify(H: FloatArray, h: FloatArray, rotation: FloatArray) -> bool:
    """Return whether a rotation (3, 3) is the global minimum that `minimize` certifies.

    It needs to be stationary to within `GRADIENT_TOLERANCE` only: the descent is completed before the certificate is
    tried.
    """
    (scaled_H, scaled_h), R, gradient, hessian = _rescale(H, h), rotation.copy(), np.empty(3), np.empty((3, 3))
    _derivatives(scaled_H, scaled_h, R, gradient, hessian)
    if not _max_abs(gradient) < GRADIENT_TOLERANCE:
        return False
    if _is_certified(scaled_H, scaled_h, R):
        return True
    _descend(scaled_H, scaled_h, R, gradient, hessian)
    proved, _ = certify_minimum(scaled_H, scaled_h, R)
    return proved and _squared_distance(R, rotation) < 2.0 * MERGE_ANGLE**2


@kernel
def _squared_distance(a: FloatArray, b: FloatArray) -> float:
    """Return |a - b|² of (3, 3) matrices: for close rotations twice the squared angle between them."""
    s = 0.0
    for i in range(3):
        for j in range(3):
            s += (a[i, j] - b[i, j]) ** 2
    return s


@kernel
def _rescale(H: FloatArray, h: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Divide H and h by the mean eigenvalue of H; leave them unchanged if H is zero."""
    scale = 0.0
    for i in range(9):
        scale += H[i, i] / 9.0
    if not scale > 0.0:
        scale = 1.0
    return H / scale, h / scale


@kernel
def _derivatives_each(H: FloatArray, h: FloatArray, rotations: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return costs (N,), gradients (N, 3) and hessians (N, 3, 3) of N problems at one rotation each."""
    n = len(rotations)
    costs, gradients, hessians = np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3))
    for k in range(n):
        costs[k] = _derivatives(H[k], h[k], rotations[k], gradients[k], hessians[k])
    return costs, gradients, hessians


@kernel
def _derivatives(H: FloatArray, h: FloatArray, R: FloatArray, gradient: FloatArray, hessian: FloatArray) -> float:
    """Return the cost and write its gradient (3,) and Hessian (3, 3) at exp(w) R, w = 0.

    exp(w) = I + W + W²/2 + ..., W² = ww' - |w|² I: with G the derivative by R and T = G R', the gradient is <W, T> and
    the Hessian J'HJ + (T + T')/2 - tr(T) I, J's columns being the derivatives [e_k]x R of R by w.
    """
    G, J, HJ, r = np.empty((3, 3)), np.zeros((3, 9)), np.empty(9), R.reshape(9)
    cost, trace, g = 0.0, 0.0, G.reshape(9)
    for i in range(9):
        s = dot(H[i], r)
        cost += r[i] * (0.5 * s - h[i])
        g[i] = s - h[i]
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        gradient[k] = 0.0
        for j in range(3):
            gradient[k] += G[b, j] * R[a, j] - G[a, j] * R[b, j]
            trace += G[k, j] * R[k, j]
            J[k, 3 * a + j], J[k, 3 * b + j] = -R[b, j], R[a, j]
    for k in range(3):
        for i in range(9):
            HJ[i] = dot(H[i], J[k])
        for l in range(k + 1):
            s = 0.0
            for j in range(3):
                s += 0.5 * (G[k, j] * R[l, j] + G[l, j] * R[k, j])
            for i in range(9):
                s += J[l, i] * HJ[i]
            hessian[k, l] = hessian[l, k] = s - trace if k == l else s
    return cost


@kernel
def _max_abs(values: FloatArray) -> float:
    """Return the largest absolute value of three."""
    return float(max(abs(values[0]), abs(values[1]), abs(values[2])))


@kernel
def _is_certified(H: FloatArray, h: FloatArray, R: FloatArray) -> bool:
    """Return whether R is stationary and K = H + L ⊗ I, L = (C - Σ A R B) R', is positive definite."""
    gradient, hessian = np.empty(3), np.empty((3, 3))
    _derivatives(H, h, R, gradient, hessian)
    if not _max_abs(gradient) < GRADIENT_TOLERANCE:
        return False
    L, K = np.zeros((3, 3)), np.empty((9, 9))
    for i in range(9):
        s = h[i]
        for j in range(9):
            s -= H[i, j] * R[j // 3, j % 3]
        for c in range(3):
            L[i // 3, c] += 0.5 * s * R[c, i % 3]
            L[c, i // 3] += 0.5 * s * R[c, i % 3]
    _build_system(H, L, L, 0.0, K)
    for i in range(9):
        K[i, i] -= CERTIFICATE
    return cholesky(K)


@kernel
def _search_minima(H: FloatArray, h: FloatArray, starts: FloatArray, minima: FloatArray) -> tuple[bool, int, int]:
    """Write the global minimum to `minima` if it can be certified, else the local minima found, best first.

    Damped Newton steps descend from the starts. The best few starts usually reach the global minimum and are tried
    first.

    Returns:
        Whether the minimum is certified; the number of distinct minima; the largest number of steps from a start plus
        those of the certificates.
    """
    n = starts.shape[0]
    ends, costs, remaining = np.empty((n, 3, 3)), np.empty(n), np.empty(n, np.bool_)
    gradient, hessian = np.empty(3), np.empty((3, 3))
    order = _sort_starts(H, h, starts)
    best, max_steps, certificate_steps, tried = order[0], 0, 0, -1
    for done in range(n):
        s = order[done]
        ends[s] = starts[s]
        costs[s], steps = _descend(H, h, ends[s], gradient, hessian)
        max_steps = max(max_steps, steps)
        for i in range(3):
            hessian[i, i] += ZERO_CURVATURE
        remaining[s] = _max_abs(gradient) < GRADIENT_TOLERANCE and cholesky(hessian)
        if costs[s] < costs[best]:
            best = s
        if done == N_FIRST_STARTS - 1 or done == n - 1:
            try_certificate = tried < 0 or _squared_distance(ends[best], ends[tried]) > 2.0 * MERGE_ANGLE**2
            for i in range(done + 1):
                k = order[i]
                # Two equally good minima (usually one camera) cannot be certified; skip the attempt.
                try_certificate = try_certificate and (
                    costs[k] > costs[best] + COST_TOLERANCE
                    or not _squared_distance(ends[best], ends[k]) > 2.0 * MERGE_ANGLE**2
                )
            if try_certificate:
                proved, steps = certify_minimum(H, h, ends[best])
                certificate_steps += steps
                if proved:
                    minima[0] = ends[best]
                    return True, 1, max_steps + certificate_steps
            tried = best
    remaining[best] = True
    count = 0
    while remaining[best]:
        remaining[best] = False
        new = True
        for k in range(count):
            new = new and _squared_distance(ends[best], minima[k]) > 2.0 * MERGE_ANGLE**2
        if new:
            minima[count] = ends[best]
            count += 1
        for s in range(n):
            if remaining[s] and (costs[s] < costs[best] or not remaining[best]):
                best = s
    return False, count, max_steps + certificate_steps


@kernel
def _sort_starts(H: FloatArray, h: FloatArray, starts: FloatArray) -> IntArray:
    """Return indices (S,) of the starts (S, 3, 3) by increasing cost."""
    count = starts.shape[0]
    costs, order = np.zeros(count), np.empty(count, np.int64)
    for n in range(count):
        for i in range(9):
            s = -h[i]
            for j in range(9):
                s += 0.5 * H[i, j] * starts[n, j // 3, j % 3]
            costs[n] += s * starts[n, i // 3, i % 3]
        k = n
        while k > 0 and costs[order[k - 1]] > costs[n]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = n
    return order


@kernel
def _descend(
    H: FloatArray, h: FloatArray, R: FloatArray, gradient: FloatArray, hessian: FloatArray
) -> tuple[float, int]:
    """Move R (3, 3) to a stationary point by Newton steps, damped where they increase the cost.

    Gradient and Hessian at that point are written to `gradient` and `hessian`.

    Returns:
        The cost and the number of steps.
    """
    factor, step = np.empty((3, 3)), np.empty(3)
    new_gradient, new_hessian, new = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    cost, damping = _derivatives(H, h, R, gradient, hessian), 0.0
    for iteration in range(MAX_NEWTON_STEPS):
        if _max_abs(gradient) < 1e-12:
            return cost, iteration
        factor[:] = hessian
        for i in range(3):
            factor[i, i] += damping + 1e-9
            step[i] = -gradient[i]
        uphill = not cholesky_solve(factor, step)
        if not uphill:
            length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            step *= 1.0 / max(length, 1.0)
            apply_rotvec(step, R, new)
            new_cost = _derivatives(H, h, new, new_gradient, new_hessian)
            uphill = new_cost > cost + 1e-14 * (1.0 + abs(cost))  # by more than rounding
        if uphill:
            if _max_abs(gradient) < GRADIENT_TOLERANCE:
                return cost, iteration
            damping = max(4.0 * damping, 0.01)
            continue
        cost, damping = new_cost, 0.25 * damping if damping > 1e-3 else 0.0
        R[:], hessian[:], gradient[:] = new, new_hessian, new_gradient
    return cost, MAX_NEWTON_STEPS


# --- The dual, with the multiplier of RR' = I alone; with many cameras it usually suffices ----------------------------


@kernel
def _build_system(H: FloatArray, L: FloatArray, step: FloatArray, length: float, K: FloatArray) -> None:
    """Write H + (L + length step) ⊗ I to K (9, 9)."""
    K[:] = H
    for a in range(3):
        for c in range(3):
            for b in range(3):
                K[3 * a + b, 3 * c + b] += L[a, c] + length * step[a, c]


@kernel
def _solve_dual(H: FloatArray, h: FloatArray, R: FloatArray) -> tuple[bool, int]:
    """Maximize the concave dual d(L) = -1/2 h'K⁻¹h - 1/2 tr L over positive definite K = H + L ⊗ I.

    Its gradient is 1/2 (RR' - I), r = K⁻¹h. H is positive semidefinite, so any positive multiple of the identity is a
    feasible start. The rotation is written to R (3, 3).

    Returns:
        Whether there is a rotation (not if the maximum is on the boundary or R is a reflection), and the number of
        steps.
    """
    multiplier, step, gradient = np.zeros((3, 3)), np.zeros((3, 3)), np.empty(6)
    factor, factor_ahead, r = np.empty((9, 9)), np.empty((9, 9)), np.empty(9)
    curvature, direction = np.empty((6, 6)), np.empty(6)
    for i in range(3):
        multiplier[i, i] = 0.01
    value, slope, length = -np.inf, 0.0, 1.0
    for iteration in range(MAX_DUAL_STEPS):
        # A step must stay in the interior, at most 0.7 of the way to the boundary.
        _build_system(H, multiplier, step, length, factor)
        _build_system(H, multiplier, step, length / 0.7, factor_ahead)
        inside = cholesky(factor) and cholesky(factor_ahead)
        new_value = 0.0
        if inside:
            r[:] = h
            solve_factored(factor, r)
            for i in range(9):
                new_value -= 0.5 * r[i] * h[i]
            for i in range(3):
                new_value -= 0.5 * (multiplier[i, i] + length * step[i, i])
        if not inside or new_value < value + 1e-4 * length * slope - 1e-13 * abs(value):
            length *= 0.5
            continue
        value, min_pivot, max_deviation = new_value, np.inf, 0.0
        for i in range(9):
            min_pivot = min(min_pivot, factor[i, i] ** 2)
        for i in range(3):
            for j in range(3):
                multiplier[i, j] += length * step[i, j]
                s = -1.0 if i == j else 0.0
                for k in range(3):
                    s += r[3 * i + k] * r[3 * j + k]
                max_deviation = max(max_deviation, abs(s))
        if min_pivot < CERTIFICATE:
            return False, iteration
        if max_deviation < 1e-11:
            return _orthogonalize(r, R), iteration
        _dual_derivatives(factor, r, gradient, curvature)
        direction[:] = gradient
        # The curvature is singular if R is (one camera): the step is then long and ends near the boundary.
        if not cholesky_solve(curvature, direction):
            return False, iteration
        slope, length = 0.0, 1.0
        for k in range(6):
            slope += gradient[k] * direction[k]
            a, b = _ROWS[k], _COLUMNS[k]
            step[a, b] = step[b, a] = direction[k] if a == b else np.sqrt(0.5) * direction[k]
    return False, MAX_DUAL_STEPS


@kernel
def _dual_derivatives(factor: FloatArray, r: FloatArray, gradient: FloatArray, curvature: FloatArray) -> None:
    """Write gradient (6,) and negative curvature (6, 6) of the dual, given K's Cholesky factor.

    They are 1/2 <S_k, RR' - I> and r'(S_k ⊗ I) K⁻¹ (S_l ⊗ I) r with S_k the basis of the symmetric matrices. The
    curvature is regularized by 1e-13 of its trace.
    """
    half, trace = np.zeros((6, 9)), 0.0
    for k in range(6):
        a, b = _ROWS[k], _COLUMNS[k]
        norm = 1.0 if a == b else np.sqrt(0.5)
        s = -1.0 if a == b else 0.0
        for j in range(3):
            half[k, 3 * a + j] = norm * r[3 * b + j]
            half[k, 3 * b + j] = norm * r[3 * a + j]
            s += r[3 * a + j] * r[3 * b + j]
        gradient[k] = 0.5 * s / norm
        for i in range(9):
            for j in range(i):
                half[k, i] -= factor[i, j] * half[k, j]
            half[k, i] /= factor[i, i]
        for l in range(k + 1):
            curvature[k, l] = curvature[l, k] = dot(half[k], half[l])
        trace += curvature[k, k]
    for k in range(6):
        curvature[k, k] += 1e-13 * (trace + 1.0)


@kernel
def _orthogonalize(r: FloatArray, R: FloatArray) -> bool:
    """Write r (9,), orthogonal to 1e-11, to R (3, 3) after one Newton-Schulz step, which squares the deviation.

    Returns:
        Whether it is a rotation, not a reflection.
    """
    for i in range(3):
        for j in range(3):
            R[i, j] = 1.5 * r[3 * i + j]
            for k in range(3):
                product = r[3 * i] * r[3 * k] + r[3 * i + 1] * r[3 * k + 1] + r[3 * i + 2] * r[3 * k + 2]
                R[i, j] -= 0.5 * product * r[3 * k + j]
    determinant = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        determinant += R[0, i] * (R[1, j] * R[2, k] - R[1, k] * R[2, j])
    return determinant > 0.0


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
        cost, stationary = cost + self.constant, np.abs(gradient).max(axis=-1) < GRADIENT_TOLERANCE * self.scale
        multiplier = compute_multiplier(self.H, self.h, rotations)
        return CostEvaluation(cost, stationary, multiplier, hessian / self.variance(cost)[..., None, None])


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
    found = _minimize_each(_as_kernel_input(H), _as_kernel_input(h), _STARTS)
    return found._replace(candidates=found.candidates[:, : found.counts.max(initial=1)])


def is_certified(H: FloatArray, h: FloatArray, rotation: FloatArray) -> bool:
    """Return whether a rotation (3, 3) is stationary and certified as the unique global minimum.

    The criterion is that of `minimize`, for a rotation from another source.
    """
    return bool(_certify(_as_kernel_input(H), _as_kernel_input(h), _as_kernel_input(rotation)))


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


def _cost_and_derivatives(H: FloatArray, h: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the results of `evaluate_cost` and `compute_derivatives`."""
    shape, n = R.shape[:-2], R[..., 0, 0].size
    H, h = np.broadcast_to(H, (*shape, 9, 9)).reshape(n, 9, 9), np.broadcast_to(h, (*shape, 9)).reshape(n, 9)
    inputs = (_as_kernel_input(array) for array in (H, h, R.reshape(n, 3, 3)))
    cost, gradient, hessian = _derivatives_each(*inputs)
    return cost.reshape(shape), gradient.reshape(*shape, 3), hessian.reshape(*shape, 3, 3)


def _multiply(H: FloatArray, rotations: FloatArray) -> FloatArray:
    """Return H r (..., 9)."""
    return np.asarray((H @ rotations.reshape(*rotations.shape[:-2], 9, 1))[..., 0])


def _as_kernel_input(array: FloatArray) -> FloatArray:
    """Return the array as the kernels require it: float64, contiguous, writable."""
    return np.require(array, np.float64, ["C", "W"])
