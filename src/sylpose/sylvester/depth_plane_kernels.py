"""Compiled kernels of `depth_plane`: prediction, cost and derivatives of each camera.

A camera's unknowns, in order: w (3) of R = exp(w) R̂; then its own: a (2), log s, τ (2), log ζ, log σ.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel

# Priors. A uniform direction of the plane's normal: a density of (1 + |a|²)^-3/2 for its slopes (derived).
SLOPE_POWER = 1.5
# Standard deviation of log s: an approach by 5 % is fast (choice).
LOG_SCALE_SD = 0.05
# Residual depth, as a share of the points' spread, and the standard deviation of its logarithm (choice: vague).
RESIDUAL_DEPTH, LOG_RESIDUAL_DEPTH_SD = 0.3, 0.7
# Noise, as a share of the points' spread: equivalent to one additional coordinate with this noise (choice).
NOISE_PRIOR = 0.005


@kernel
def _predict(
    Qx: FloatArray, Qy: FloatArray, R: FloatArray, own: FloatArray, perspective: bool, Rc: FloatArray, H: FloatArray
) -> None:
    """Write R_c (3, 3) and H (3, 3)."""
    for i in range(3):
        for j in range(3):
            Rc[i, j] = 0.0
            for k in range(3):
                for m in range(3):
                    Rc[i, j] += Qy[i, k] * R[k, m] * Qx[j, m]
    s = np.exp(own[2])
    H[0, 2], H[1, 2], H[2, 2] = own[3], own[4], 1.0
    for i in range(3):
        for j in range(2):
            if perspective:
                H[i, j] = s * (Rc[i, j] + Rc[i, 2] * own[j]) - H[i, 2] * own[j]
            else:
                H[i, j] = s * (Rc[i, j] + Rc[i, 2] * own[j]) if i < 2 else 0.0


@kernel
def _residual_matrix(H: FloatArray, A: FloatArray) -> None:
    """Write A (2, 9): y_12 (H x)_3 - y_3 (H x)_12 = A (y ⊗ x). Linear in H."""
    A[:] = 0.0
    for j in range(3):
        A[0, j] = A[1, 3 + j] = H[2, j]
        A[0, 6 + j], A[1, 6 + j] = -H[0, j], -H[1, j]


@kernel
def _covariances(H: FloatArray, Rc: FloatArray, own: FloatArray, G: FloatArray, V: FloatArray) -> None:
    """Write G = I + F F' and V = σ² G + ζ² s² m m' (2, 2)."""
    noise, relief = np.exp(2.0 * own[6]), np.exp(2.0 * (own[5] + own[2]))
    for i in range(2):
        for j in range(2):
            G[i, j] = H[i, 0] * H[j, 0] + H[i, 1] * H[j, 1] + (1.0 if i == j else 0.0)
            V[i, j] = noise * G[i, j] + relief * Rc[i, 2] * Rc[j, 2]


@kernel
def _invert(a: FloatArray, out: FloatArray) -> float:
    """Write the inverse of a (2, 2) to out and return the determinant of a."""
    det = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    out[0, 0], out[1, 1] = a[1, 1] / det, a[0, 0] / det
    out[0, 1], out[1, 0] = -a[0, 1] / det, -a[1, 0] / det
    return float(det)


@kernel
def evaluate_costs(
    Qx: FloatArray,
    Qy: FloatArray,
    M: FloatArray,
    n: FloatArray,
    spread: FloatArray,
    perspective: bool,
    noise_known: bool,
    R: FloatArray,
    own: FloatArray,
    out: FloatArray,
) -> None:
    """Write the negative log posterior to out (S,) at R (S, 3, 3) and own (S, C, 7)."""
    Rc, H, A = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 9))
    G, V, W = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    for start in range(len(R)):
        out[start] = 0.0
        for c in range(len(n)):
            q = own[start, c]
            _predict(Qx[c], Qy[c], R[start], q, perspective, Rc, H)
            _residual_matrix(H, A)
            _covariances(H, Rc, q, G, V)
            ratio = _invert(V, W)
            ratio /= G[0, 0] * G[1, 1] - G[0, 1] * G[1, 0]
            fit = n[c] * np.log(ratio)
            for i in range(2):
                for j in range(2):
                    for k in range(9):
                        for m in range(9):
                            fit += W[i, j] * A[j, k] * M[c, k, m] * A[i, m]
            out[start] += 0.5 * fit + SLOPE_POWER * np.log1p(q[0] ** 2 + q[1] ** 2) + 0.5 * (q[2] / LOG_SCALE_SD) ** 2
            out[start] += 0.5 * ((q[5] - np.log(RESIDUAL_DEPTH * spread[c])) / LOG_RESIDUAL_DEPTH_SD) ** 2
            if not noise_known:
                out[start] += q[6] + 0.5 * (NOISE_PRIOR * spread[c] * np.exp(-q[6])) ** 2


@kernel
def evaluate_derivatives(
    Qx: FloatArray,
    Qy: FloatArray,
    M: FloatArray,
    n: FloatArray,
    spread: FloatArray,
    perspective: bool,
    noise_known: bool,
    R: FloatArray,
    own: FloatArray,
    searching: bool,
    gradient: FloatArray,
    information: FloatArray,
) -> None:
    """Write gradient (S, C, 10) and Fisher information (S, C, 10, 10) of each camera's cost.

    The information treats V's factor I + F F' as constant, as in total least squares. With `searching`, curvature by w
    that is missing where m and the residuals are small is added, which limits the steps.
    """
    Rc, H, A = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 9))
    G, V, W, G_inverse = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    AM, S, pull, by_V, by_G = np.empty((2, 9)), np.empty((2, 2)), np.empty((2, 9)), np.empty((2, 2)), np.empty((2, 2))
    dH, dA, WdAM = np.empty((10, 3, 3)), np.empty((10, 2, 9)), np.empty((10, 2, 9))
    dV, WdV, dAM, dm = np.empty((10, 2, 2)), np.empty((10, 2, 2)), np.empty((2, 9)), np.empty((3, 2))
    for start in range(len(R)):
        for c in range(len(n)):
            q, g, info = own[start, c], gradient[start, c], information[start, c]
            _predict(Qx[c], Qy[c], R[start], q, perspective, Rc, H)
            _residual_matrix(H, A)
            _covariances(H, Rc, q, G, V)
            _invert(V, W)
            _invert(G, G_inverse)
            _prediction_derivatives(Qy[c], q, Rc, H, G, perspective, dH, dV)
            for i in range(2):
                for k in range(9):
                    AM[i, k] = 0.0
                    for m in range(9):
                        AM[i, k] += A[i, m] * M[c, m, k]
            S[:] = 0.0
            for i in range(2):
                for j in range(2):
                    for k in range(9):
                        S[i, j] += AM[i, k] * A[j, k]
            noise = np.exp(2.0 * q[6])
            for i in range(2):
                for j in range(2):
                    by_V[i, j] = n[c] * W[i, j]
                    for k in range(2):
                        for m in range(2):
                            by_V[i, j] -= W[i, k] * S[k, m] * W[m, j]
                    by_G[i, j] = noise * by_V[i, j] - n[c] * G_inverse[i, j]
                for k in range(9):
                    pull[i, k] = W[i, 0] * AM[0, k] + W[i, 1] * AM[1, k]
            for u in range(10):
                _residual_matrix(dH[u], dA[u])
                g[u] = 0.0
                for i in range(2):
                    for k in range(9):
                        g[u] += pull[i, k] * dA[u, i, k]
                        dAM[i, k] = 0.0
                        for m in range(9):
                            dAM[i, k] += dA[u, i, m] * M[c, m, k]
                    for j in range(2):
                        dF_F = dH[u, i, 0] * H[j, 0] + dH[u, i, 1] * H[j, 1]
                        g[u] += 0.5 * by_V[i, j] * dV[u, i, j] + by_G[i, j] * dF_F
                        WdV[u, i, j] = W[i, 0] * dV[u, 0, j] + W[i, 1] * dV[u, 1, j]
                for i in range(2):
                    for k in range(9):
                        WdAM[u, i, k] = W[i, 0] * dAM[0, k] + W[i, 1] * dAM[1, k]
            for u in range(10):
                for v in range(u + 1):
                    total = 0.0
                    for i in range(2):
                        for k in range(9):
                            total += WdAM[u, i, k] * dA[v, i, k]
                        for j in range(2):
                            total += 0.5 * n[c] * WdV[u, i, j] * WdV[v, j, i]
                    info[u, v] = info[v, u] = total
            # Residual depth below the noise adds ζ² to the cost; its curvature by log ζ is missing in the information.
            info[8, 8] += 2.0 * max(g[8], 0.0)
            if searching:
                # V grows with the square of w where m = 0; for residuals of covariance V this term is zero on average.
                excess = 0.5 * max(by_V[0, 0] + by_V[1, 1], 0.0) * np.exp(2.0 * (q[5] + q[2]))
                for u in range(3):
                    dm[u, 0] = Qy[c, 1, u] * Rc[2, 2] - Qy[c, 2, u] * Rc[1, 2]
                    dm[u, 1] = Qy[c, 2, u] * Rc[0, 2] - Qy[c, 0, u] * Rc[2, 2]
                for u in range(3):
                    for v in range(3):
                        info[u, v] += excess * (dm[u, 0] * dm[v, 0] + dm[u, 1] * dm[v, 1])
            _add_priors(q, spread[c], noise_known, g, info)


@kernel
def _prediction_derivatives(
    Qy: FloatArray,
    own: FloatArray,
    Rc: FloatArray,
    H: FloatArray,
    G: FloatArray,
    perspective: bool,
    dH: FloatArray,
    dV: FloatArray,
) -> None:
    """Write dH (10, 3, 3), and dV (10, 2, 2) without the part through F."""
    dH[:] = 0.0
    dV[:] = 0.0
    s, noise, relief = np.exp(own[2]), np.exp(2.0 * own[6]), np.exp(2.0 * (own[5] + own[2]))
    rotated = np.empty((3, 3))
    for u in range(3):
        # exp(w) left of R is exp(Q w) left of R_c: the cross product of the axis Q e_u with each column.
        for j in range(3):
            rotated[0, j] = Qy[1, u] * Rc[2, j] - Qy[2, u] * Rc[1, j]
            rotated[1, j] = Qy[2, u] * Rc[0, j] - Qy[0, u] * Rc[2, j]
            rotated[2, j] = Qy[0, u] * Rc[1, j] - Qy[1, u] * Rc[0, j]
        for i in range(3):
            for j in range(2):
                dH[u, i, j] = s * (rotated[i, j] + rotated[i, 2] * own[j])
        for i in range(2):
            for j in range(2):
                dV[u, i, j] = relief * (rotated[i, 2] * Rc[j, 2] + Rc[i, 2] * rotated[j, 2])
    for i in range(3):
        for j in range(2):
            dH[3 + j, i, j] = s * Rc[i, 2]
            dH[5, i, j] = s * (Rc[i, j] + Rc[i, 2] * own[j])
            if perspective:
                dH[3 + j, i, j] -= H[i, 2]
    for b in range(2):
        dH[6 + b, b, 2] = 1.0
        if perspective:
            dH[6 + b, b, 0], dH[6 + b, b, 1] = -own[0], -own[1]
    if not perspective:
        dH[:, 2] = 0.0
    for i in range(2):
        for j in range(2):
            dV[5, i, j] = dV[8, i, j] = 2.0 * relief * Rc[i, 2] * Rc[j, 2]
            dV[9, i, j] = 2.0 * noise * G[i, j]


@kernel
def _add_priors(own: FloatArray, spread: float, noise_known: bool, g: FloatArray, info: FloatArray) -> None:
    """Add the priors in place; if the noise is known, its unknown is fixed."""
    slope = 2.0 * SLOPE_POWER / (1.0 + own[0] ** 2 + own[1] ** 2)
    for i in range(2):
        g[3 + i] += slope * own[i]
        info[3 + i, 3 + i] += slope
    g[5] += own[2] / LOG_SCALE_SD**2
    info[5, 5] += 1.0 / LOG_SCALE_SD**2
    g[8] += (own[5] - np.log(RESIDUAL_DEPTH * spread)) / LOG_RESIDUAL_DEPTH_SD**2
    info[8, 8] += 1.0 / LOG_RESIDUAL_DEPTH_SD**2
    if noise_known:
        g[9] = 0.0
        info[9] = 0.0
        info[:, 9] = 0.0
        info[9, 9] = 1.0
    else:
        excess = (NOISE_PRIOR * spread * np.exp(-own[6])) ** 2
        g[9] += 1.0 - excess
        info[9, 9] += 2.0 * excess
