"""The dual of a quadratic cost on SO(3) by the multiplier of RR' = I alone, compiled: where it has its maximum inside, the
minimum is found and proved at once, and many cameras' as a rule are.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky, cholesky_solve, kernel, solve_factored
from sylpose.sylvester.so3_sos_certificate import CERTIFICATE

__all__ = ["dual_newton", "system"]


# A bound on Newton's steps; certified problems take three or four (choice).
DUAL_STEPS = 40
# The symmetric 3x3 matrices have the orthonormal basis (e_a e_b' + e_b e_a') / norm, (a, b) from these.
_ROWS, _COLUMNS = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


@kernel
def system(H: FloatArray, L: FloatArray, step: FloatArray, length: float, K: FloatArray) -> None:
    """K (9, 9) becomes H + (L + length step) ⊗ I."""
    for i in range(9):
        for j in range(9):
            K[i, j] = H[i, j]
    for a in range(3):
        for c in range(3):
            for b in range(3):
                K[3 * a + b, 3 * c + b] += L[a, c] + length * step[a, c]


@kernel
def dual_newton(H: FloatArray, h: FloatArray, R: FloatArray) -> tuple[bool, int]:
    """Maximises the concave dual d(L) = -1/2 h'K⁻¹h - 1/2 tr L where K = H + L ⊗ I is positive definite.

    Its gradient is 1/2 (RR' - I), r = K⁻¹h. H is positive semidefinite, so that any positive multiple of the identity
    is a start inside. R (3, 3) becomes the rotation.

    Returns:
        whether there is one: not when the maximum is on the boundary or R is a reflection; the steps.
    """
    multiplier, step, gradient = np.zeros((3, 3)), np.zeros((3, 3)), np.empty(6)
    factor, ahead, r = np.empty((9, 9)), np.empty((9, 9)), np.empty(9)
    curvature, along = np.empty((6, 6)), np.empty(6)
    for i in range(3):
        multiplier[i, i] = 0.01
    value, slope, length = -np.inf, 0.0, 1.0
    for iteration in range(DUAL_STEPS):
        # A step must end inside, at most 0.7 of the way to the boundary.
        system(H, multiplier, step, length, factor)
        system(H, multiplier, step, length / 0.7, ahead)
        inside = cholesky(factor) and cholesky(ahead)
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
        value, least, largest = new_value, np.inf, 0.0
        for i in range(9):
            least = min(least, factor[i, i] ** 2)
        for i in range(3):
            for j in range(3):
                multiplier[i, j] += length * step[i, j]
                s = -1.0 if i == j else 0.0
                for k in range(3):
                    s += r[3 * i + k] * r[3 * j + k]
                largest = max(largest, abs(s))
        if least < CERTIFICATE:
            return False, iteration
        if largest < 1e-11:
            return _to_rotation(r, R), iteration
        _dual_derivatives(factor, r, gradient, curvature)
        for k in range(6):
            along[k] = gradient[k]
        # The curvature is singular where R is (one camera): then the step is long, and ends near the boundary.
        if not cholesky_solve(curvature, along):
            return False, iteration
        slope, length = 0.0, 1.0
        for k in range(6):
            slope += gradient[k] * along[k]
            a, b = _ROWS[k], _COLUMNS[k]
            step[a, b] = step[b, a] = along[k] if a == b else np.sqrt(0.5) * along[k]
    return False, DUAL_STEPS


@kernel
def _dual_derivatives(factor: FloatArray, r: FloatArray, gradient: FloatArray, curvature: FloatArray) -> None:
    """Gradient 1/2 <S_k, RR' - I> (6,) and curvature r'(S_k ⊗ I) K⁻¹ (S_l ⊗ I) r (6, 6) of the dual, negative and a
    trace's 1e-13 above singular, S_k the basis of the symmetric matrices; K's Cholesky factor is given."""
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
def _to_rotation(r: FloatArray, R: FloatArray) -> bool:
    """R (3, 3) becomes r (9,), orthogonal to 1e-11, after a Newton-Schulz step, which squares what is left of that.

    Returns:
        whether it is a rotation, not a reflection.
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
