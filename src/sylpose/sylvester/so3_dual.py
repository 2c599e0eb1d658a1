"""Compiled Newton solver for the dual of a quadratic cost on SO(3), with the multiplier of RR' = I alone.

If the dual has its maximum in the interior, the global minimum follows and is certified; with many cameras this is the
usual case.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky, cholesky_solve, kernel, solve_factored
from sylpose.sylvester.so3_sos_certificate import CERTIFICATE

__all__ = ["build_system", "solve_dual"]


# A bound on Newton's steps; certified problems take three or four (choice).
MAX_DUAL_STEPS = 40
# Indices (a, b) of the orthonormal basis (e_a e_b' + e_b e_a') / norm of the symmetric 3x3 matrices.
_ROWS, _COLUMNS = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


@kernel
def build_system(H: FloatArray, L: FloatArray, step: FloatArray, length: float, K: FloatArray) -> None:
    """Write H + (L + length step) ⊗ I to K (9, 9)."""
    for i in range(9):
        for j in range(9):
            K[i, j] = H[i, j]
    for a in range(3):
        for c in range(3):
            for b in range(3):
                K[3 * a + b, 3 * c + b] += L[a, c] + length * step[a, c]


@kernel
def solve_dual(H: FloatArray, h: FloatArray, R: FloatArray) -> tuple[bool, int]:
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
        build_system(H, multiplier, step, length, factor)
        build_system(H, multiplier, step, length / 0.7, factor_ahead)
        inside = cholesky(factor) and cholesky(factor_ahead)
        new_value = 0.0
        if inside:
            for i in range(9):
                r[i] = h[i]
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
        for k in range(6):
            direction[k] = gradient[k]
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
            s = 0.0
            for i in range(9):
                s += half[k, i] * half[l, i]
            curvature[k, l] = curvature[l, k] = s
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
