"""Hand-eye equation A X = X B: how frames of reference are related that observe the motion of one rigid body.

Frame of reference c, a camera or a robot's base, measures poses M_ci = S_c X_c T_i O_c in frames i: T_i is the pose of
the body in the reference frame, O_c the axes on the body, and S_c divides lengths by the scale s_c. The motion between
two frames cancels O_c: A X = X B.

- Rotations: R_A X = X R_B is Sylvester's equation, homogeneous. Its least-squares solution on SO(3) is a quadratic cost
  (`so3`), so its global minimum is certified. The residual is the rotation of the noise in A and B, of the same size for
  any angle, also near half a turn.
- Translations and scales: s_c t_ci = X_c (R_i o_c + t_i) + x_c is linear once rotations are known. The measured t_ci are
  multiplied by unknowns, so this is a problem of total least squares: plain least squares would underestimate scales.

Source: F. Park, B. Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group", 1994; the quadratic cost,
its certificate and the scales are ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import transpose
from sylpose.geometry.robust_loss import biquartic_weights
from sylpose.sylvester.so3 import QuadraticCost, compute_derivatives, minimize

# Pairs of frames whose motions are compared: steps of 1, 2, 3, 5, ... frames, and since the first one (choice).
PAIR_STEPS = (1, 2, 3, 5, 8, 13, 21, 34)
# Residuals beyond so many standard deviations have no weight (choice: that of the bundle adjustment).
CUTOFF_SIGMAS = 5.0
# Median of the squared length of three standard normal numbers (chi-squared).
MEDIAN_SQUARE = 2.366
# Translations start far from the solution with Cauchy's weights, so many times (choice).
START_ITERATIONS = 5
# Iterations of robust weights, and the change of weights that ends them (choice).
MAX_ITERATIONS, WEIGHTS_TOLERANCE = 20, 1e-3
# Residuals below this share of what they are the difference of are due to rounding (derived).
ROUNDING = 1e-10
# Smallest eigenvalue of the system of translations, of unit diagonal, that is no rounding (derived).
SINGULAR = 1e-12
AXIS_REASON = "the body rotated about parallel axes only: rotate it about a second axis as well"
# Ratio of two scales, which is that of two distances, at most; a smaller one is that of a body whose origin moved too
# little to measure it (choice).
MAX_SCALE = 20.0
PLACE_REASON = "the body was rotated in place, which leaves scales undetermined: carry it about by its own size as well"
# Rotation angles of one motion, in two frames of reference, differ by this fraction at most (choice).
RELATIVE_ANGLE_TOLERANCE = 0.12
# Second over first singular value of the rotation vectors: below, the axes are parallel (measured: docs/calibrating.md,
# 0.001 to 0.005 for one axis, above 0.08 otherwise).
MIN_AXIS_SPREAD = 0.03


@dataclass(frozen=True, eq=False)
class HandEyeRotation:
    """Solution X of R_A X = X R_B.

    Attributes:
        rotation: (3, 3) X.
        certified: whether it is proved to be the unique global minimum of the cost with the final weights.
        information: (3, 3) of w, X = exp(w) X̂, if all pairs are independent; it includes the residuals' variance.
        residuals: (n,) angles between R_A X and X R_B, radians.
        weights: (n,) robust weights in [0, 1].
        variance_factor: variance of the residuals relative to that given.
    """

    rotation: FloatArray
    certified: bool
    information: FloatArray
    residuals: FloatArray
    weights: FloatArray
    variance_factor: float


def select_pairs(n: int) -> IntArray:
    """Return (m, 2) pairs of n frames, whose motions are compared."""
    pairs = [(i, i + step) for step in PAIR_STEPS for i in range(n - step)] + [(0, k) for k in range(1, n)]
    return np.unique(np.array(pairs), axis=0)


def measure_axis_spread(rotation_vectors: FloatArray) -> float:
    """Return second over first singular value of rotation vectors (n, 3): 0 if their axes are parallel."""
    values = np.linalg.svd(rotation_vectors, compute_uv=False)
    return float(values[1] / values[0]) if values[0] > 0 else 0.0


def solve_hand_eye_rotation(a: FloatArray, b: FloatArray, variance: FloatArray) -> HandEyeRotation:
    """Solve R_A X = X R_B over n pairs of rotations, with robust weights.

    Args:
        a, b: (n, 3, 3) rotations of the body in two frames of reference; X maps the second to the first.
        variance: (n,) of the residuals about each axis, rad², up to a common factor.

    Returns:
        the solution; about a common axis of all rotations it is arbitrary, and its information zero.
    """
    weights = np.ones(len(a))
    # The weights of Geman and McClure never vanish, so that the start does not choose among frames that contradict each
    # other; those of the second pass ignore outliers.
    for reweight in (_weigh_smoothly, _weigh_inliers):
        for _ in range(MAX_ITERATIONS):
            cost = build_rotation_cost(a, b, weights / variance)
            candidates, certified, _ = minimize(cost.H, cost.h)
            X = candidates[0]
            residuals = np.linalg.norm(a @ X - X @ b, axis=(1, 2)) / np.sqrt(2.0)
            squares = residuals**2 / variance
            factor = max(float(np.median(squares)) / MEDIAN_SQUARE, ROUNDING**2 / float(variance.min()))
            previous, weights = weights, reweight(squares / factor)
            if np.abs(weights - previous).max() < WEIGHTS_TOLERANCE:
                break
    angles = 2.0 * np.arcsin(np.minimum(residuals / 2.0, 1.0))
    information = compute_derivatives(cost.H, cost.h, X)[1] / factor
    return HandEyeRotation(X, certified, information, angles, weights, factor)


def _weigh_smoothly(squares: FloatArray) -> FloatArray:
    return np.asarray((1.0 + squares) ** -2.0)


def _weigh_inliers(squares: FloatArray) -> FloatArray:
    return biquartic_weights(squares / CUTOFF_SIGMAS**2)


def build_rotation_cost(a: FloatArray, b: FloatArray, weights: FloatArray) -> QuadraticCost:
    """Return the cost Σ w/4 |R_A X - X R_B|²; the norm's square is twice that of the residual's angle, if small."""
    products = np.einsum("n,nij,nkl->ikjl", weights, a, b).reshape(9, 9)
    H = weights.sum() * np.eye(9) - 0.5 * (products + products.T)
    total = np.asarray(weights.sum())
    return QuadraticCost(H, np.zeros(9), np.zeros(()), total)


@dataclass(frozen=True, eq=False)
class HandEyeTranslations:
    """Translations and scales of C frames of reference; the first is the reference.

    Attributes:
        translations: (C, 3) x_c of X_c.
        offsets: (C, 3) o_c of O_c: the body's origin of c in the axes of the reference.
        scales: (C,) s_c; 1 for the reference.
        covariance: (7 C - 7, 7 C - 7) of (x, o, s) of all but the reference, if all frames are independent.
        squares: (C, N) squared residuals divided by their variance; NaN without a measurement.
        weights: (C, N) robust weights in [0, 1].
        variance_factor: variance of the residuals relative to that given.
    """

    translations: FloatArray
    offsets: FloatArray
    scales: FloatArray
    covariance: FloatArray
    squares: FloatArray
    weights: FloatArray
    variance_factor: float


def solve_hand_eye_translations(
    rotations: FloatArray,
    body_rotations: FloatArray,
    positions: FloatArray,
    covariances: FloatArray,
    *,
    has_known_scales: bool = False,
) -> HandEyeTranslations:
    """Solve s_c t_ci = X_c (R_i o_c + t_i) + x_c for x_c, o_c, s_c and all t_i, with robust weights.

    Args:
        rotations: (C, 3, 3) of X_c; the identity for the first.
        body_rotations: (N, 3, 3) of T_i, axes of the reference.
        positions: (C, N, 3) measured t_ci; NaN where there is none.
        covariances: (C, N, 3, 3) of them, up to a common factor.
        has_known_scales: whether all scales are 1.

    Raises:
        ValueError: a singular system: the motion does not determine the translations.
    """
    n = len(rotations)
    is_measured = np.isfinite(positions).all(axis=2) & (np.isfinite(positions).all(axis=2).sum(axis=0) > 1)
    whiteners = np.zeros((*positions.shape, 3))
    whiteners[is_measured] = transpose(np.linalg.cholesky(np.linalg.inv(covariances[is_measured])))
    rows = _make_rows(rotations, body_rotations, np.where(is_measured[..., None], positions, 0.0))
    scales = np.ones(n) if has_known_scales else _compare_extents(positions, is_measured)
    weights, squares, factor = is_measured.astype(float), np.zeros(is_measured.shape), 1.0
    for iteration in range(MAX_ITERATIONS):
        is_start, at = iteration < START_ITERATIONS, np.clip(scales, 1.0 / MAX_SCALE, MAX_SCALE)
        L = whiteners / at[:, None, None, None]
        try:
            solution, covariance, share = _solve_rows(L, rotations, rows, weights, at, has_known_scales or is_start)
        except np.linalg.LinAlgError:
            raise ValueError(PLACE_REASON if iteration > 0 else AXIS_REASON) from None
        scales = solution[-n:]
        size = np.where(np.arange(len(solution)) < len(solution) - n, 0.0, solution)
        squares = _compute_squares(L, rotations, rows @ solution, weights)
        rounding = ROUNDING**2 * float((np.einsum("cnij,cnj->cni", L, rows @ size) ** 2).sum(axis=2).max())
        factor = max(float(np.median(squares[is_measured])) / (MEDIAN_SQUARE * share), rounding)
        previous, ratio = weights, squares / factor
        weights = 1.0 / (1.0 + ratio) if is_start else biquartic_weights(ratio / CUTOFF_SIGMAS**2)
        weights = np.where(is_measured, weights, 0.0)
        if not is_start and np.abs(weights - previous).max() < WEIGHTS_TOLERANCE:
            break
    if not (scales > 1.0 / MAX_SCALE).all():
        raise ValueError(PLACE_REASON)
    places = solution[:-n].reshape(2, n - 1, 3)
    x, o = (np.vstack([np.zeros(3), values]) for values in places)
    squares = np.where(is_measured, squares, np.nan)
    return HandEyeTranslations(x, o, scales, max(factor, 1.0) * covariance, squares, weights, factor)


def _compare_extents(positions: FloatArray, is_measured: BoolArray) -> FloatArray:
    """Return scales (C,) by which the median distances of positions (C, N, 3) to their median are those of the first."""
    extents = [
        np.median(np.linalg.norm(p[m] - np.median(p[m], axis=0), axis=1))
        for p, m in zip(positions, is_measured, strict=True)
    ]
    return np.asarray(extents[0] / np.maximum(extents, 1e-300))


def _make_rows(rotations: FloatArray, body_rotations: FloatArray, positions: FloatArray) -> FloatArray:
    """Return (C, N, 3, 7 C - 6) derivatives of s_c t_ci - x_c - X_c R_i o_c by x, o and s."""
    n, frames = positions.shape[:2]
    rows = np.zeros((n, frames, 3, 7 * n - 6))
    for c in range(n):
        if c > 0:
            rows[c, :, :, 3 * c - 3 : 3 * c] = -np.eye(3)
            rows[c, :, :, 3 * (n + c) - 6 : 3 * (n + c) - 3] = -rotations[c] @ body_rotations
        rows[c, :, :, 6 * n - 6 + c] = positions[c]
    return rows


def _solve_rows(
    L: FloatArray, rotations: FloatArray, rows: FloatArray, weights: FloatArray, scales: FloatArray, are_fixed: bool
) -> tuple[FloatArray, FloatArray, float]:
    """Minimize v'Mv / v'Nv over the unknowns v = (x, o, s), M of the rows without t_i and N of the noise in them.

    Args:
        L: (C, N, 3, 3) whiteners of the measurements.
        rows: (C, N, 3, U).
        weights: (C, N), zero without a measurement.
        scales: (C,) for which the whiteners hold.
        are_fixed: whether the scales are known.

    Returns:
        v (U,) with a reference scale of 1; its covariance without the reference scale; and the expected square of a
        residual's coordinate, for noise of unit variance.
    """
    n, unknowns = len(rotations), rows.shape[3]
    root = np.sqrt(weights)[..., None, None]
    W, G = root * (L @ rows), root * (L @ rotations[:, None])
    gram = np.einsum("cnij,cnik->njk", G, G)
    is_used = np.count_nonzero(weights, axis=0) > 1
    gram[~is_used] = np.eye(3)
    inverse = np.linalg.inv(gram)
    M = np.einsum("cniu,cniv->uv", W[:, is_used], W[:, is_used])
    cross = np.einsum("cnij,cniu->nju", G, W)[is_used]
    M -= np.einsum("nju,njk,nkv->uv", cross, inverse[is_used], cross, optimize=True)
    # Of each measurement's three coordinates, the expected square that is left by fitting t_i.
    left = 3.0 * weights - np.einsum("cnij,njk,cnik->cn", G, inverse, G) * weights
    left[:, ~is_used] = 0.0
    noise = left.sum(axis=1) / scales**2
    share = float(left.sum() / max(3.0 * weights[:, is_used].sum(), 1e-300))
    if are_fixed:
        merge = np.zeros((unknowns, unknowns - n + 1))
        merge[: unknowns - n, : unknowns - n] = np.eye(unknowns - n)
        merge[unknowns - n :, -1] = scales
        M, noise = merge.T @ M @ merge, np.array([noise @ scales**2])
    k = M.shape[0] - len(noise)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(M)[:k], 1e-300))
    scaled = M[:k, :k] * np.outer(unit, unit)
    if not np.linalg.eigvalsh(scaled)[0] > SINGULAR:
        raise np.linalg.LinAlgError("translations are not determined")
    gain = unit[:, None] * np.linalg.solve(scaled, unit[:, None] * M[:k, k:])
    values, vectors = eigh(M[k:, k:] - M[:k, k:].T @ gain, np.diag(noise))
    s = vectors[:, 0] / vectors[0, 0]
    solution = np.concatenate([-gain @ s, s])
    # Curvature of the quotient, for a reference scale of 1.
    information = M.copy()
    information[k:, k:] -= values[0] * np.diag(noise)
    free = np.delete(np.arange(len(information)), k)
    covariance = _invert(information[np.ix_(free, free)])
    if are_fixed:
        solution = np.concatenate([solution[:-1], scales])
        covariance = np.pad(covariance, (0, n - 1))
    return solution, covariance, share


def _invert(information: FloatArray) -> FloatArray:
    """Invert a symmetric matrix scaled to a unit diagonal; directions without information have infinite variance."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    with np.errstate(divide="ignore"):
        return np.asarray((vectors / np.maximum(values, 1e-300)) @ vectors.T * np.outer(scale, scale))


def _compute_squares(L: FloatArray, rotations: FloatArray, positions: FloatArray, weights: FloatArray) -> FloatArray:
    """Return (C, N) squared whitened residuals after fitting t_i to positions (C, N, 3)."""
    G, e = L @ rotations[:, None], np.einsum("cnij,cnj->cni", L, positions)
    gram = np.einsum("cn,cnij,cnik->njk", weights, G, G)
    right = np.einsum("cn,cnij,cni->nj", weights, G, e)
    is_used = np.linalg.matrix_rank(gram) == 3
    fitted = np.zeros_like(right)
    fitted[is_used] = np.linalg.solve(gram[is_used], right[is_used][..., None])[..., 0]
    return np.asarray(((e - np.einsum("cnij,nj->cni", G, fitted)) ** 2).sum(axis=2))
