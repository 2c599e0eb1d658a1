"""Sum-of-squares certificate of global minima on SO(3), compiled.

With a unit quaternion (c, x) of S = R2 R', R the minimum, S is quadratic in (c, x), so cost(R2) - cost(R) is a quartic
form f. Its value and gradient vanish at x = 0, where R2 = R, so f = m'Gm in nine monomials,

    m = (c x_1, c x_2, c x_3,   x_1², x_2², x_3²,   √2 x_2 x_3, √2 x_3 x_1, √2 x_1 x_2),   |m| = |x|.

G is not the only such matrix: the monomials obey 14 equations m'N_k m = 0, such as (x_1²)(x_2²) = (x_1 x_2)². If
G + Σ μ_k N_k is positive definite for some μ, then f > 0 for every other rotation: R is the unique global minimum. The
μ are the multipliers of all quadratic constraints of a rotation: 20 equations (RR' = I, R'R = I, each row the cross
product of the two others) and the bound itself, of which stationarity of R leaves 21 - 7 free. The matrix K of `so3`
uses the first six only.

μ is found by Newton's method along a barrier path: the maxima of η t + log det(G + Σ μ_k N_k - t D) for growing η,
where D is the identity on the last six monomials. (The first block of G is the same for all μ: half the Hessian of the
cost by x.)

Source: Briales & Gonzalez-Jimenez (2017) for the relaxation being nearly always tight; the form in nine monomials and
the search are ours.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import cholesky, dot, kernel, solve_factored

# Minimum eigenvalue of a certifying matrix, relative to H's mean eigenvalue of 1: well above rounding
# (choice).
CERTIFICATE = 1e-9
# Tolerance by which the cost of other rotations may be lower, in the same units: R is stationary to rounding only
# (choice).
COST_TOLERANCE = 1e-12
# A bound on Newton's steps; problems that can be certified usually take three to ten (choice).
MAX_STEPS = 60
# Squared Newton decrement below which η is increased, and the factor by which it is increased (choice).
MAX_DECREMENT, BARRIER_GROWTH = 1.0, 30.0
# Number of free multipliers (derived).
N_MULTIPLIERS = 14


# Entries ij, ji, ii, jj of vec(S) for each k, with (i, j, k) cyclic (derived).
_ENTRIES = ((5, 7, 4, 8), (6, 2, 8, 0), (1, 3, 0, 4))


def _constraint_entries() -> tuple[IntArray, FloatArray]:
    """Return indices (14, 2, 2) and weights w (14, 2): each N_k is the sum of two w (e_a e_b' + e_b e_a')."""
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
_INDICES, _WEIGHTS = _constraint_entries()


@kernel
def certify_minimum(H: FloatArray, h: FloatArray, R: FloatArray) -> tuple[bool, int]:
    """Try to certify R (3, 3) as the unique global minimum of 1/2 r'Hr - h'r on SO(3), H (9, 9) of mean eigenvalue 1.

    Returns:
        Whether R is certified, and the number of Newton steps.
    """
    G, gradient = np.empty((9, 9)), np.empty(3)
    build_gram_matrix(H, h, R, G, gradient)
    size, squared = 1.0, gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2
    for i in range(9):
        size = max(size, abs(G[i, i]))
    # With all eigenvalues above the margin, f >= margin |x|² - |gradient| |x|, at least -|gradient|² / (4 margin).
    margin = max(CERTIFICATE * size, squared / (4.0 * COST_TOLERANCE))
    factor, work, inverse = np.empty((9, 9)), np.empty((9, 9)), np.empty((9, 9))
    multipliers, step, slope = np.zeros(N_MULTIPLIERS), np.zeros(N_MULTIPLIERS + 1), np.empty(N_MULTIPLIERS + 1)
    curvature = np.empty((N_MULTIPLIERS + 1, N_MULTIPLIERS + 1))
    curvature_factor, first_block = np.empty_like(curvature), G[:3, :3].copy()
    for i in range(3):
        first_block[i, i] -= margin
    if not cholesky(first_block):
        return False, 0
    t = -size
    for _ in range(100):
        _build_matrix(G, multipliers, t, step, 0.0, factor)
        if cholesky(factor):
            break
        t *= 2.0
    t *= 2.0  # well inside
    eta = -6.0 / t
    for iteration in range(MAX_STEPS):
        _build_matrix(G, multipliers, t, step, 0.0, factor)
        if not cholesky(factor):
            return False, iteration
        if t > margin:
            _build_matrix(G, multipliers, 0.0, step, 0.0, work)
            for i in range(9):
                work[i, i] -= margin
            if cholesky(work):
                return True, iteration
        _invert_factored(factor, work, inverse)
        _barrier_derivatives(inverse, work, slope, curvature)
        curvature_factor[:] = curvature
        if not cholesky(curvature_factor):
            return False, iteration
        while True:
            gradient_ahead = slope.copy()
            gradient_ahead[N_MULTIPLIERS] += eta
            step[:] = gradient_ahead
            solve_factored(curvature_factor, step)
            if dot(step, gradient_ahead) > MAX_DECREMENT:
                break
            # At a maximum, t is at most 6 / η below its supremum.
            if t + 9.0 / eta < margin:
                return False, iteration
            eta *= BARRIER_GROWTH
        # A step must stay in the interior, at most 0.8 of the way to the boundary.
        length = 1.0
        for _ in range(100):
            _build_matrix(G, multipliers, t, step, length / 0.8, work)
            if cholesky(work):
                break
            length *= 0.7
        for k in range(N_MULTIPLIERS):
            multipliers[k] += length * step[k]
        t += length * step[N_MULTIPLIERS]
        step[:] = 0.0
    return False, MAX_STEPS


@kernel
def build_gram_matrix(H: FloatArray, h: FloatArray, R: FloatArray, G: FloatArray, gradient: FloatArray) -> None:
    """Write the matrix G (9, 9) of f = cost(S R) - cost(R) for μ = 0, and the gradient (3,) of f by x.

    G does not contain the gradient. With s = vec(S), T = (I ⊗ R) H (I ⊗ R') and n = c² + |x|² = 1, s = n vec(I) + U m:
    f = 1/2 m'U'TUm + n g'Um, where g = T vec(I) - (I ⊗ R) h is the cost's derivative. Only g is subject to
    cancellation.
    """
    half, T, TU, g = np.empty((9, 9)), np.empty((9, 9)), np.empty((9, 9)), np.empty(9)
    for i in range(9):
        for l in range(3):
            for m in range(3):
                half[i, 3 * l + m] = dot(H[i, 3 * l : 3 * l + 3], R[m])
    for i in range(3):
        for k in range(3):
            g_entry = 0.0
            for n in range(3):
                g_entry -= R[k, n] * h[3 * i + n]
            for l in range(9):
                s = 0.0
                for n in range(3):
                    s += R[k, n] * half[3 * i + n, l]
                T[3 * i + k, l] = s
                if l % 4 == 0:
                    g_entry += s
            g[3 * i + k] = g_entry
    # U: S_ii has the entries -2 for x_j² and x_k², S_ij has √2 for √2 x_i x_j and -2 for c x_k, S_ji has +2 for the
    # latter.
    for k in range(3):
        ij, ji, ii, jj = _ENTRIES[k]
        for l in range(9):
            TU[l, k] = -2.0 * (T[l, ij] - T[l, ji])
            TU[l, 3 + k] = -2.0 * (T[l, ii] + T[l, jj])
            TU[l, 6 + k] = np.sqrt(2.0) * (T[l, ij] + T[l, ji])
    for k in range(3):
        ij, ji, ii, jj = _ENTRIES[k]
        for l in range(9):
            G[k, l] = TU[ji, l] - TU[ij, l]
            G[3 + k, l] = -TU[ii, l] - TU[jj, l]
            G[6 + k, l] = np.sqrt(0.5) * (TU[ij, l] + TU[ji, l])
    # n g'Um: c² times a square goes to the first block, |x|² times a square to the last; c x_k belongs to the gradient.
    for k in range(3):
        (ij, ji, ii, jj), i, j = _ENTRIES[k], (k + 1) % 3, (k + 2) % 3
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
def _build_matrix(
    G: FloatArray, multipliers: FloatArray, t: float, step: FloatArray, length: float, out: FloatArray
) -> None:
    """Write G + Σ μ_k N_k - t D to the lower triangle of out (9, 9), with (μ, t) moved by length times step."""
    out[:] = G
    for k in range(N_MULTIPLIERS):
        mu = multipliers[k] + length * step[k]
        for c in range(2):
            a, b, w = _INDICES[k, c, 0], _INDICES[k, c, 1], _WEIGHTS[k, c]
            out[a, b] += 2.0 * w * mu if a == b else w * mu
    for i in range(3, 9):
        out[i, i] -= t + length * step[N_MULTIPLIERS]


@kernel
def _invert_factored(factor: FloatArray, work: FloatArray, inverse: FloatArray) -> None:
    """Write (L L')⁻¹ to inverse (9, 9), given L, and L⁻¹ to work (9, 9)."""
    for i in range(9):
        work[i, i] = 1.0 / factor[i, i]
        for j in range(i):
            s = 0.0
            for k in range(j, i):
                s -= factor[i, k] * work[k, j]
            work[i, j] = s * work[i, i]
    for i in range(9):
        for j in range(i + 1):
            s = 0.0
            for k in range(i, 9):
                s += work[k, i] * work[k, j]
            inverse[i, j] = inverse[j, i] = s


@kernel
def _barrier_derivatives(W: FloatArray, WDW: FloatArray, slope: FloatArray, curvature: FloatArray) -> None:
    """Write slope (15,) and negative curvature (15, 15) of log det by (μ, t).

    W is the matrix's inverse; WDW (9, 9) is work space.
    """
    for i in range(9):
        for j in range(i + 1):
            WDW[i, j] = WDW[j, i] = dot(W[i, 3:], W[j, 3:])
    for k in range(N_MULTIPLIERS):
        slope[k] = along_t = 0.0
        for c in range(2):
            a, b, w = _INDICES[k, c, 0], _INDICES[k, c, 1], _WEIGHTS[k, c]
            slope[k] += 2.0 * w * W[a, b]
            along_t -= 2.0 * w * WDW[a, b]
        curvature[k, N_MULTIPLIERS] = curvature[N_MULTIPLIERS, k] = along_t
        for l in range(k + 1):
            s = 0.0
            for c in range(2):
                a, b = _INDICES[k, c, 0], _INDICES[k, c, 1]
                for d in range(2):
                    e, f = _INDICES[l, d, 0], _INDICES[l, d, 1]
                    s += 2.0 * _WEIGHTS[k, c] * _WEIGHTS[l, d] * (W[a, e] * W[b, f] + W[a, f] * W[b, e])
            curvature[k, l] = curvature[l, k] = s
    slope[N_MULTIPLIERS] = curvature[N_MULTIPLIERS, N_MULTIPLIERS] = 0.0
    for i in range(3, 9):
        slope[N_MULTIPLIERS] -= W[i, i]
        curvature[N_MULTIPLIERS, N_MULTIPLIERS] += WDW[i, i]
