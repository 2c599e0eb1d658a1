"""The certificate in full, compiled: what a cost on SO(3) exceeds its minimum by is a sum of squares.

With a unit quaternion (c, x) of S = R2 R', R the minimum, S is quadratic in (c, x), so that cost(R2) - cost(R) is a quartic
form f. It and its gradient vanish at x = 0, where R2 is R, so that f = m'Gm in nine monomials,

    m = (c x_1, c x_2, c x_3,   x_1², x_2², x_3²,   √2 x_2 x_3, √2 x_3 x_1, √2 x_1 x_2),   |m| = |x|.

G is not the only such matrix: the monomials obey 14 equations m'N_k m = 0, such as (x_1²)(x_2²) = (x_1 x_2)². If
G + Σ μ_k N_k is positive definite for some μ, then f > 0 for every other rotation: R is the one global minimum. These are
the multipliers of all that is quadratic and holds of a rotation: of the 20 equations of RR' = I, R'R = I and each row the
cross product of the two others, with the bound itself, R's being stationary leaves 21 - 7 free. K of `so3` is what the
first six give.

μ is sought by Newton's method along the path of a barrier: the maxima of η t + log det(G + Σ μ_k N_k - t D), η growing,
where D is the identity on the last six. (The first block of G is the same for all μ: the Hessian of the cost by x, halved.)

Source: that the relaxation is nearly always tight is Briales & Gonzalez-Jimenez's (2017); the form in nine monomials and
the search are ours.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import cholesky, kernel, solve_factored

__all__ = ["CERTIFICATE", "FREE", "LOWER", "free_matrices", "gram", "is_least"]


# A matrix must be this much above singular, relative to H's mean eigenvalue of 1, to certify: well above rounding
# (choice).
CERTIFICATE = 1e-9
# What the cost elsewhere may be lower by, in the same units, because R is stationary to rounding only (choice).
LOWER = 1e-12
# A bound on Newton's steps; what can be certified takes three to ten as a rule (choice).
STEPS = 60
# A maximum of the barrier is followed this closely (the squared Newton decrement), then η grows by this factor (choice).
NEAR, GROWTH = 1.0, 30.0
# How many multipliers are free (derived).
FREE = 14


def _free_entries() -> tuple[IntArray, FloatArray]:
    """(14, 2, 2) rows and columns, (14, 2) weights w: each N_k is the sum of two w (e_a e_b' + e_b e_a')."""
    root, at, weights = np.sqrt(0.5), [], []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        # (x_j²)(x_k²) = (√2 x_j x_k)² / 2; x_i² (√2 x_j x_k) = (√2 x_k x_i) (√2 x_i x_j) / √2;
        # (c x_i) x_a² = (c x_a) (√2 x_i x_a) / √2, a = j, k.
        at += [[[3 + j, 3 + k], [6 + i, 6 + i]], [[3 + i, 6 + i], [6 + j, 6 + k]]]
        at += [[[i, 3 + j], [j, 6 + k]], [[i, 3 + k], [k, 6 + j]]]
        weights += [[1.0, -0.5], [1.0, -root], [1.0, -root], [1.0, -root]]
    for i in range(2):  # (c x_1) (x_2 x_3) = (c x_2) (x_3 x_1) = (c x_3) (x_1 x_2)
        at.append([[i, 6 + i], [i + 1, 7 + i]])
        weights.append([1.0, -1.0])
    return np.sort(np.array(at), axis=-1)[..., ::-1].copy(), np.array(weights)


# Rows at least as large as columns: the lower triangle.
_AT, _WEIGHTS = _free_entries()


def free_matrices() -> FloatArray:
    """(14, 9, 9) N_k."""
    N = np.zeros((FREE, 9, 9))
    for k in range(FREE):
        for (a, b), w in zip(_AT[k], _WEIGHTS[k], strict=True):
            N[k, a, b] += w
            N[k, b, a] += w
    return N


@kernel
def is_least(H: FloatArray, h: FloatArray, R: FloatArray) -> tuple[bool, int]:
    """Whether R (3, 3) is proved to be the one global minimum of 1/2 r'Hr - h'r on SO(3), H (9, 9) of mean eigenvalue 1.

    Returns:
        also how many of Newton's steps it took to say.
    """
    G, gradient = np.empty((9, 9)), np.empty(3)
    gram(H, h, R, G, gradient)
    size, squared = 1.0, gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2
    for i in range(9):
        size = max(size, abs(G[i, i]))
    # With all eigenvalues above the margin, f >= margin |x|² - |gradient| |x|, at least -|gradient|² / (4 margin).
    margin = max(CERTIFICATE * size, squared / (4.0 * LOWER))
    factor, spare, inverse = np.empty((9, 9)), np.empty((9, 9)), np.empty((9, 9))
    multipliers, step, slope = np.zeros(FREE), np.zeros(FREE + 1), np.empty(FREE + 1)
    curvature, curvature_factor = np.empty((FREE + 1, FREE + 1)), np.empty((FREE + 1, FREE + 1))
    first = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            first[i, j] = G[i, j]
        first[i, i] -= margin
    if not cholesky(first):
        return False, 0
    t = -size
    for _ in range(100):
        _moved(G, multipliers, t, step, 0.0, factor)
        if cholesky(factor):
            break
        t *= 2.0
    t *= 2.0  # well inside
    eta = -6.0 / t
    for iteration in range(STEPS):
        _moved(G, multipliers, t, step, 0.0, factor)
        if not cholesky(factor):
            return False, iteration
        if t > margin:
            _moved(G, multipliers, 0.0, step, 0.0, spare)
            for i in range(9):
                spare[i, i] -= margin
            if cholesky(spare):
                return True, iteration
        _inverse(factor, spare, inverse)
        _barrier(inverse, spare, slope, curvature)
        for i in range(FREE + 1):
            for j in range(i + 1):
                curvature_factor[i, j] = curvature[i, j]
        if not cholesky(curvature_factor):
            return False, iteration
        while True:
            decrement = 0.0
            for k in range(FREE + 1):
                step[k] = slope[k] if k < FREE else slope[k] + eta
            solve_factored(curvature_factor, step)
            for k in range(FREE + 1):
                decrement += step[k] * (slope[k] if k < FREE else slope[k] + eta)
            if decrement > NEAR:
                break
            # At a maximum no t is larger by more than 6 / η.
            if t + 9.0 / eta < margin:
                return False, iteration
            eta *= GROWTH
        # A step must end inside, at most 0.8 of the way to the boundary.
        length = 1.0
        for _ in range(100):
            _moved(G, multipliers, t, step, length / 0.8, spare)
            if cholesky(spare):
                break
            length *= 0.7
        for k in range(FREE):
            multipliers[k] += length * step[k]
        t += length * step[FREE]
        for k in range(FREE + 1):
            step[k] = 0.0
    return False, STEPS


@kernel
def gram(H: FloatArray, h: FloatArray, R: FloatArray, G: FloatArray, gradient: FloatArray) -> None:
    """G (9, 9) becomes the matrix of f = cost(S R) - cost(R) for μ = 0, gradient (3,) of f by x, which G is without.

    With s = vec(S), T = (I ⊗ R) H (I ⊗ R') and n = c² + |x|² = 1, s = n vec(I) + U m: f = 1/2 m'U'TUm + n g'Um, where
    g = T vec(I) - (I ⊗ R) h is the cost's derivative. Nothing cancels but in g.
    """
    half, T, TU, g = np.empty((9, 9)), np.empty((9, 9)), np.empty((9, 9)), np.empty(9)
    for i in range(9):
        for l in range(3):
            for m in range(3):
                s = 0.0
                for n in range(3):
                    s += H[i, 3 * l + n] * R[m, n]
                half[i, 3 * l + m] = s
    for i in range(3):
        for k in range(3):
            of_g = 0.0
            for n in range(3):
                of_g -= R[k, n] * h[3 * i + n]
            for l in range(9):
                s = 0.0
                for n in range(3):
                    s += R[k, n] * half[3 * i + n, l]
                T[3 * i + k, l] = s
                if l % 4 == 0:
                    of_g += s
            g[3 * i + k] = of_g
    # U: of S_ii the entries -2 for x_j² and x_k², of S_ij √2 for √2 x_i x_j and -2 for c x_k, of S_ji +2 for that.
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        ij, ji, ii, jj = 3 * i + j, 3 * j + i, 4 * i, 4 * j
        for l in range(9):
            TU[l, k] = -2.0 * (T[l, ij] - T[l, ji])
            TU[l, 3 + k] = -2.0 * (T[l, ii] + T[l, jj])
            TU[l, 6 + k] = np.sqrt(2.0) * (T[l, ij] + T[l, ji])
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        ij, ji, ii, jj = 3 * i + j, 3 * j + i, 4 * i, 4 * j
        for l in range(9):
            G[k, l] = TU[ji, l] - TU[ij, l]
            G[3 + k, l] = -TU[ii, l] - TU[jj, l]
            G[6 + k, l] = np.sqrt(0.5) * (TU[ij, l] + TU[ji, l])
    # n g'Um: c² times a square goes to the first block, |x|² times one to the last; c x_k is the gradient's.
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        ij, ji, ii, jj = 3 * i + j, 3 * j + i, 4 * i, 4 * j
        gradient[k] = 2.0 * (g[ji] - g[ij])
        square, product = -2.0 * (g[ii] + g[jj]), np.sqrt(2.0) * (g[ij] + g[ji])
        G[k, k] += square
        G[i, j] += np.sqrt(0.5) * product
        G[j, i] += np.sqrt(0.5) * product
        for l in range(3):
            G[3 + l, 3 + k] += 0.5 * square
            G[3 + k, 3 + l] += 0.5 * square
            G[3 + l, 6 + k] += 0.5 * product
            G[6 + k, 3 + l] += 0.5 * product


@kernel
def _moved(G: FloatArray, multipliers: FloatArray, t: float, step: FloatArray, length: float, out: FloatArray) -> None:
    """The lower triangle of out (9, 9) becomes G + Σ μ_k N_k - t D, after length times step of (μ, t)."""
    for i in range(9):
        for j in range(i + 1):
            out[i, j] = G[i, j]
    for k in range(FREE):
        mu = multipliers[k] + length * step[k]
        for c in range(2):
            a, b, w = _AT[k, c, 0], _AT[k, c, 1], _WEIGHTS[k, c]
            out[a, b] += 2.0 * w * mu if a == b else w * mu
    for i in range(3, 9):
        out[i, i] -= t + length * step[FREE]


@kernel
def _inverse(factor: FloatArray, spare: FloatArray, inverse: FloatArray) -> None:
    """inverse (9, 9) becomes (L L')⁻¹, given L; spare (9, 9) becomes L⁻¹."""
    for i in range(9):
        spare[i, i] = 1.0 / factor[i, i]
        for j in range(i):
            s = 0.0
            for k in range(j, i):
                s -= factor[i, k] * spare[k, j]
            spare[i, j] = s * spare[i, i]
    for i in range(9):
        for j in range(i + 1):
            s = 0.0
            for k in range(i, 9):
                s += spare[k, i] * spare[k, j]
            inverse[i, j] = inverse[j, i] = s


@kernel
def _barrier(W: FloatArray, WDW: FloatArray, slope: FloatArray, curvature: FloatArray) -> None:
    """Of log det by (μ, t), W the matrix's inverse: slope (15,), and curvature (15, 15), negative. WDW (9, 9) is spare."""
    for i in range(9):
        for j in range(i + 1):
            s = 0.0
            for k in range(3, 9):
                s += W[i, k] * W[j, k]
            WDW[i, j] = WDW[j, i] = s
    for k in range(FREE):
        slope[k] = along_t = 0.0
        for c in range(2):
            a, b, w = _AT[k, c, 0], _AT[k, c, 1], _WEIGHTS[k, c]
            slope[k] += 2.0 * w * W[a, b]
            along_t -= 2.0 * w * WDW[a, b]
        curvature[k, FREE] = curvature[FREE, k] = along_t
        for l in range(k + 1):
            s = 0.0
            for c in range(2):
                a, b = _AT[k, c, 0], _AT[k, c, 1]
                for d in range(2):
                    e, f = _AT[l, d, 0], _AT[l, d, 1]
                    s += 2.0 * _WEIGHTS[k, c] * _WEIGHTS[l, d] * (W[a, e] * W[b, f] + W[a, f] * W[b, e])
            curvature[k, l] = curvature[l, k] = s
    slope[FREE] = curvature[FREE, FREE] = 0.0
    for i in range(3, 9):
        slope[FREE] -= W[i, i]
        curvature[FREE, FREE] += WDW[i, i]
