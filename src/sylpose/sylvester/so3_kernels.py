"""The compiled part of `so3`: its minima, by the dual and by Newton's method on SO(3), one problem after another.

Each problem's result depends on that problem alone, so that one alone and the same one among thousands agree to the bit.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import cholesky, cholesky_solve, kernel, turn_by
from sylpose.sylvester.so3_dual import dual_newton, system
from sylpose.sylvester.so3_sos_certificate import CERTIFICATE, LOWER, is_least

__all__ = ["FLAT", "SAME", "STATIONARY", "certify_each", "derivatives_each", "minimize_each"]


# Stationary to this: the largest tangent derivative of the cost, H's mean eigenvalue being 1:
# the root of rounding (derived).
STATIONARY = 1e-8
# Curvature less negative than this, relative to that mean, is none (choice).
FLAT = 1e-6
# Minima nearer than this (radians) are one; a minimum where two mirrored ones merge is found to some 1e-4 only
# (derived: the cost is of fourth order there).
SAME = 1e-3
# So many of the starts, the best, are gone down from before a proof is tried: the global minimum is among what they reach
# (measured: in 96 to 100 % of 300 problems each of six kinds of benchmarks/certificate.py).
FIRST = 4
# A bound on Newton's steps (choice).
DIRECT_STEPS = 100


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
        found, iterations[n] = dual_newton(scaled_H, scaled_h, candidates[n, 0])
        certified[n] = found and _is_certified(scaled_H, scaled_h, candidates[n, 0])
        if not certified[n]:
            certified[n], counts[n], steps = _search(scaled_H, scaled_h, starts, candidates[n])
            iterations[n] += steps


@kernel
def certify_each(H: FloatArray, h: FloatArray, rotations: FloatArray, certified: BoolArray) -> None:
    """certified (N,) becomes whether rotations (N, 3, 3) are proved to be the global minima that `minimize_each` certifies,
    to within `STATIONARY`: what is left of the descent is gone down first."""
    scaled_H, scaled_h, R = np.empty((9, 9)), np.empty(9), np.empty((3, 3))
    gradient, hessian = np.empty(3), np.empty((3, 3))
    for n in range(H.shape[0]):
        _scaled(H[n], h[n], scaled_H, scaled_h)
        _derivatives(scaled_H, scaled_h, rotations[n], gradient, hessian)
        certified[n] = False
        if _largest(gradient) < STATIONARY:
            _copy(rotations[n], R)
            certified[n] = _is_certified(scaled_H, scaled_h, R)
            if not certified[n]:
                _descend(scaled_H, scaled_h, R, gradient, hessian)
                certified[n] = is_least(scaled_H, scaled_h, R)[0] and _distance2(R, rotations[n]) < 2.0 * SAME**2


@kernel
def _distance2(a: FloatArray, b: FloatArray) -> float:
    """|a - b|² of (3, 3): for near rotations twice the squared angle between them."""
    s = 0.0
    for i in range(3):
        for j in range(3):
            s += (a[i, j] - b[i, j]) ** 2
    return s


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
    system(H, L, L, 0.0, K)
    for i in range(9):
        K[i, i] -= CERTIFICATE
    return cholesky(K)


@kernel
def _search(H: FloatArray, h: FloatArray, starts: FloatArray, minima: FloatArray) -> tuple[bool, int, int]:
    """The global minimum on SO(3) into `minima` if one can be proved, else the local ones, best first, that damped Newton
    steps reach from the starts. The best few starts have the global one in reach, as a rule, and are asked first.

    Returns:
        whether it is proved; how many differ; the most steps that a start took, with those of the proofs.
    """
    n = starts.shape[0]
    ends, costs, left = np.empty((n, 3, 3)), np.empty(n), np.empty(n, np.bool_)
    gradient, hessian = np.empty(3), np.empty((3, 3))
    order = _order(H, h, starts)
    best, most, of_proofs, tried = order[0], 0, 0, -1
    for done in range(n):
        s = order[done]
        _copy(starts[s], ends[s])
        costs[s], steps = _descend(H, h, ends[s], gradient, hessian)
        most = max(most, steps)
        for i in range(3):
            hessian[i, i] += FLAT
        left[s] = _largest(gradient) < STATIONARY and cholesky(hessian)
        if costs[s] < costs[best]:
            best = s
        if done == FIRST - 1 or done == n - 1:
            wanted = tried < 0 or _distance2(ends[best], ends[tried]) > 2.0 * SAME**2
            for i in range(done + 1):
                k = order[i]
                # Of two that are equally good there is no proof, and no need to look for one: one camera, mostly.
                wanted = wanted and (
                    costs[k] > costs[best] + LOWER or not _distance2(ends[best], ends[k]) > 2.0 * SAME**2
                )
            if wanted:
                proved, steps = is_least(H, h, ends[best])
                of_proofs += steps
                if proved:
                    _copy(ends[best], minima[0])
                    return True, 1, most + of_proofs
            tried = best
    left[best] = True
    count = 0
    while left[best]:
        left[best] = False
        new = True
        for k in range(count):
            new = new and _distance2(ends[best], minima[k]) > 2.0 * SAME**2
        if new:
            _copy(ends[best], minima[count])
            count += 1
        for s in range(n):
            if left[s] and (costs[s] < costs[best] or not left[best]):
                best = s
    return False, count, most + of_proofs


@kernel
def _order(H: FloatArray, h: FloatArray, starts: FloatArray) -> IntArray:
    """(S,) of the starts (S, 3, 3), those of least cost first."""
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
