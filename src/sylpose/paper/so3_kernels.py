"""The compiled part of `so3`: Newton's method on the dual and on SO(3), one problem after another.

Each problem's result depends on that problem alone, so that one alone and the same one among thousands agree to the bit.
"""

from __future__ import annotations

import numpy as np

from sylpose.numerics.arrays import BoolArray, FloatArray, IntArray
from sylpose.numerics.compiled import cholesky, cholesky_solve, kernel, solve_factored, turn_by

__all__ = ["CERTIFICATE", "FLAT", "SAME", "STATIONARY", "derivatives_each", "minimize_each"]


# K must be this much above singular, relative to H's mean eigenvalue of 1, to certify: well above rounding
# (choice).
CERTIFICATE = 1e-9
# Stationary to this: the largest tangent derivative of the cost, H's mean eigenvalue being 1:
# the root of rounding (derived).
STATIONARY = 1e-8
# Curvature less negative than this, relative to that mean, is none (choice).
FLAT = 1e-6
# Minima nearer than this (radians) are one; a minimum where two mirrored ones merge is found to some 1e-4 only
# (derived: the cost is of fourth order there).
SAME = 1e-3
# Bounds on Newton's steps; certified problems take three or four (choice).
DUAL_STEPS, DIRECT_STEPS = 40, 100
# The symmetric 3x3 matrices have the orthonormal basis (e_a e_b' + e_b e_a') / norm, (a, b) from these.
_ROWS, _COLUMNS = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


@kernel
def minimize_each(
    H: FloatArray,
    h: FloatArray,
    starts: FloatArray,
    candidates: FloatArray,
    counts: IntArray,
    certified: BoolArray,
    iterations: IntArray,
) -> None:
    """Minimises 1/2 r'Hr - h'r over SO(3) for N problems.

    Args:
        H: (N, 9, 9) positive semidefinite, h: (N, 9); scaled here, once, to a mean eigenvalue of 1, as the limits are for.
        starts: (S, 3, 3) of the search where the dual gives no certificate.
        candidates: (N, S, 3, 3) becomes the minima, best first, `counts` (N,) of them.
        certified: (N,) becomes whether the first is proved to be the global minimum; then it is the only one.
        iterations: (N,) becomes the number of Newton's steps.
    """
    scaled_H, scaled_h = np.empty((9, 9)), np.empty(9)
    for n in range(H.shape[0]):
        _scaled(H[n], h[n], scaled_H, scaled_h)
        counts[n] = 1
        found, iterations[n] = _dual_newton(scaled_H, scaled_h, candidates[n, 0])
        certified[n] = found and _is_certified(scaled_H, scaled_h, candidates[n, 0])
        if not certified[n]:
            # The dual can also creep along the boundary past a maximum inside: the certificate is asked for again.
            counts[n], steps = _local_minima(scaled_H, scaled_h, starts, candidates[n])
            iterations[n] += steps
            certified[n] = _is_certified(scaled_H, scaled_h, candidates[n, 0])
            if certified[n]:
                counts[n] = 1


@kernel
def _scaled(H: FloatArray, h: FloatArray, scaled_H: FloatArray, scaled_h: FloatArray) -> None:
    """Over H's mean eigenvalue; as they are where H is zero."""
    scale = 0.0
    for i in range(9):
        scale += H[i, i] / 9.0
    if not scale > 0.0:
        scale = 1.0
    for i in range(9):
        scaled_h[i] = h[i] / scale
        for j in range(9):
            scaled_H[i, j] = H[i, j] / scale


@kernel
def derivatives_each(
    H: FloatArray, h: FloatArray, rotations: FloatArray, costs: FloatArray, gradients: FloatArray, hessians: FloatArray
) -> None:
    """`_derivatives` of N problems at one rotation each; costs (N,), gradients (N, 3), hessians (N, 3, 3) are filled."""
    for n in range(rotations.shape[0]):
        costs[n] = _derivatives(H[n], h[n], rotations[n], gradients[n], hessians[n])


@kernel
def _derivatives(H: FloatArray, h: FloatArray, R: FloatArray, gradient: FloatArray, hessian: FloatArray) -> float:
    """Cost, gradient (3,) and Hessian (3, 3) of the cost at exp(w) R, w = 0.

    exp(w) = I + W + W²/2 + ..., W² = ww' - |w|² I: with G the derivative by R and T = G R', the gradient is <W, T> and
    the Hessian J'HJ + (T + T')/2 - tr(T) I, J's columns being the derivatives [e_k]x R of R by w.
    """
    G, J, HJ = np.empty((3, 3)), np.zeros((3, 9)), np.empty(9)
    cost = 0.0
    for i in range(3):
        for j in range(3):
            s = 0.0
            for k in range(3):
                for l in range(3):
                    s += H[3 * i + j, 3 * k + l] * R[k, l]
            cost += R[i, j] * (0.5 * s - h[3 * i + j])
            G[i, j] = s - h[3 * i + j]
    trace = 0.0
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        gradient[k] = 0.0
        for j in range(3):
            gradient[k] += G[b, j] * R[a, j] - G[a, j] * R[b, j]
            trace += G[k, j] * R[k, j]
            J[k, 3 * a + j], J[k, 3 * b + j] = -R[b, j], R[a, j]
    for k in range(3):
        for i in range(9):
            s = 0.0
            for j in range(9):
                s += H[i, j] * J[k, j]
            HJ[i] = s
        for l in range(k + 1):
            s = 0.0
            for j in range(3):
                s += 0.5 * (G[k, j] * R[l, j] + G[l, j] * R[k, j])
            for i in range(9):
                s += J[l, i] * HJ[i]
            hessian[k, l] = hessian[l, k] = s - trace if k == l else s
    return cost


@kernel
def _largest(values: FloatArray) -> float:
    """The largest absolute value of three."""
    return float(max(abs(values[0]), abs(values[1]), abs(values[2])))


@kernel
def _system(H: FloatArray, L: FloatArray, step: FloatArray, length: float, K: FloatArray) -> None:
    """K (9, 9) becomes H + (L + length step) ⊗ I."""
    for i in range(9):
        for j in range(9):
            K[i, j] = H[i, j]
    for a in range(3):
        for c in range(3):
            for b in range(3):
                K[3 * a + b, 3 * c + b] += L[a, c] + length * step[a, c]


@kernel
def _is_certified(H: FloatArray, h: FloatArray, R: FloatArray) -> bool:
    """Whether R is stationary and K = H + L ⊗ I, with its multiplier L = (C - Σ A R B) R', positive definite."""
    gradient, hessian = np.empty(3), np.empty((3, 3))
    _derivatives(H, h, R, gradient, hessian)
    if not _largest(gradient) < STATIONARY:
        return False
    L, K = np.zeros((3, 3)), np.empty((9, 9))
    for i in range(9):
        s = h[i]
        for j in range(9):
            s -= H[i, j] * R[j // 3, j % 3]
        for c in range(3):
            L[i // 3, c] += 0.5 * s * R[c, i % 3]
            L[c, i // 3] += 0.5 * s * R[c, i % 3]
    _system(H, L, L, 0.0, K)
    for i in range(9):
        K[i, i] -= CERTIFICATE
    return cholesky(K)


@kernel
def _dual_newton(H: FloatArray, h: FloatArray, R: FloatArray) -> tuple[bool, int]:
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
        _system(H, multiplier, step, length, factor)
        _system(H, multiplier, step, length / 0.7, ahead)
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


@kernel
def _local_minima(H: FloatArray, h: FloatArray, starts: FloatArray, minima: FloatArray) -> tuple[int, int]:
    """The local minima on SO(3) that damped Newton steps reach from the starts, into `minima`, best first.

    Returns:
        how many differ; the most steps that a start took.
    """
    n = starts.shape[0]
    ends, costs, left = np.empty((n, 3, 3)), np.empty(n), np.empty(n, np.bool_)
    gradient, hessian = np.empty(3), np.empty((3, 3))
    most, best = 0, 0
    for s in range(n):
        _copy(starts[s], ends[s])
        costs[s], steps = _descend(H, h, ends[s], gradient, hessian)
        most = max(most, steps)
        for i in range(3):
            hessian[i, i] += FLAT
        left[s] = _largest(gradient) < STATIONARY and cholesky(hessian)
        if costs[s] < costs[best]:
            best = s
    left[best] = True
    count = 0
    while left[best]:
        left[best] = False
        new = True
        for k in range(count):
            # |R1 - R2|² is twice the squared angle between near rotations.
            distance = 0.0
            for i in range(9):
                distance += (ends[best, i // 3, i % 3] - minima[k, i // 3, i % 3]) ** 2
            new = new and distance > 2.0 * SAME**2
        if new:
            _copy(ends[best], minima[count])
            count += 1
        for s in range(n):
            if left[s] and (costs[s] < costs[best] or not left[best]):
                best = s
    return count, most


@kernel
def _descend(
    H: FloatArray, h: FloatArray, R: FloatArray, gradient: FloatArray, hessian: FloatArray
) -> tuple[float, int]:
    """R (3, 3) goes down to a stationary point by Newton's steps, damped where they lead up.

    Returns:
        its cost, whose derivatives gradient and hessian become; how many steps.
    """
    factor, step = np.empty((3, 3)), np.empty(3)
    new_gradient, new_hessian, new = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    cost, damping = _derivatives(H, h, R, gradient, hessian), 0.0
    for iteration in range(DIRECT_STEPS):
        if _largest(gradient) < 1e-12:
            return cost, iteration
        _copy(hessian, factor)
        for i in range(3):
            factor[i, i] += damping + 1e-9
            step[i] = -gradient[i]
        uphill = not cholesky_solve(factor, step)
        if not uphill:
            length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            for i in range(3):
                step[i] *= 1.0 / max(length, 1.0)
            turn_by(step, R, new)
            new_cost = _derivatives(H, h, new, new_gradient, new_hessian)
            uphill = new_cost > cost + 1e-14 * (1.0 + abs(cost))  # by more than rounding
        if uphill:
            if _largest(gradient) < STATIONARY:
                return cost, iteration
            damping = max(4.0 * damping, 0.01)
            continue
        cost, damping = new_cost, 0.25 * damping if damping > 1e-3 else 0.0
        _copy(new, R)
        _copy(new_hessian, hessian)
        for i in range(3):
            gradient[i] = new_gradient[i]
    return cost, DIRECT_STEPS


@kernel
def _copy(source: FloatArray, target: FloatArray) -> None:
    """Of (3, 3)."""
    for i in range(3):
        for j in range(3):
            target[i, j] = source[i, j]
