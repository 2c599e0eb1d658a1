"""Consensus rotation of the cameras, scored by the affine maps of their matches.

Each camera's matches define an affine map y = F x. For the object's rotation R, F = s (N + m a'), with N the upper-left
2x2 block and m the third entries of the first two rows of Q R Q', a plane z = a'x of depths and a scale s near 1. The
four residuals F - N of each camera have a covariance from the noise of its matches, the unknown plane and scale, and
neglected perspective (θ is the angle of R):

    V = cov(F) + λ σ_a² mm' ⊗ I + σ_s² vec(N) vec(N)' + (τ₀² + τ₁² θ²) I,
    score = min over λ >= 1 of vec(F - N)' V⁻¹ vec(F - N) + log λ + 1/λ - 1.

λ is the steepness of the plane, with a penalty: a normal of uniform direction has slopes a of density
(1 + |a|²)^(-3/2) / 2π, a Cauchy distribution, i.e. a normal one of random variance λ, which adds log λ + 1/λ to
-2 log-likelihood (of log λ). So a board seen at 80 degrees from its normal is plausible, unlike with normally
distributed slopes. The two entries of F across m, which do not depend on the slopes, are scored without λ.

The search starts from small groups of cameras, so that faulty ones do not mask themselves by biasing the estimate. Of
two rotations with equal scores the smaller is likelier: large rotations allow larger residuals, which log det V
penalizes.

Source: docs/method/2-sylvester.md; noise in x: W. Fuller, Measurement Error Models (1987); the search is
    ours.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import transpose
from sylpose.sylvester.orthographic import ROUNDING_SHARE, Views

# Prior standard deviations of a camera's view: slopes of the depth plane (choice), change of scale (choice: an approach
# by 5 % is fast), and deviations from an affine map, constant and per radian of rotation (measured:
# docs/history/benchmarks.md#bad-sensors, no good camera named).
SLOPE_SD, SCALE_SD, NON_AFFINE_SD, NON_AFFINE_SD_PER_RADIAN = 0.5, 0.05, 0.003, 0.03
# Values of λ: planes of up to 89.9 degrees. Intermediate values would lower the score by at most 0.3 (derived).
STEEPNESS_GRID = 4.0 ** np.arange(11)
# Noise of x: at most this share of the squares along the wider direction (choice: noise above a tenth of the object's
# size leaves nothing to score). Minimum share of the squares in each direction that is not noise (choice: F along a
# line as narrow as its noise is useless, as its covariance shows). Relative standard deviation of the noise estimate
# (derived: root mean square of the smaller of two eigenvalues, of twenty matches).
MAX_NOISE_SHARE, MIN_SIGNAL_SHARE, NOISE_RELATIVE_SD = 0.01, 0.1, 0.4
# A camera is at fault above this score: 99 % of good ones (boxes and ellipsoids in perspective) are below 4
# (measured: docs/history/benchmarks.md#bad-sensors, no good camera of 12,400 is named).
FAULT_SCORE = 12.0
# -2 log-likelihood of a camera at fault: any F is possible, and faults are rare. A large F requires slopes here too:
# this much is added per log |F|² (derived: F = m a', any m, slopes a of a Cauchy distribution, whose length has a
# density ~ |a|⁻², in four dimensions). Margin by which the best set of faulty cameras must be likelier than any other:
# a factor of exp(3) = 20 (choice).
FAULT_COST, FAULT_COST_PER_LOG_SIZE, MIN_COST_MARGIN = 0.0, 5.0, 6.0
# The search is skipped for more than this number of cameras, all below this score; fewer can agree on a wrong rotation
# (choice).
MAX_CAMERAS_ALWAYS_SEARCHED, AGREEMENT_SCORE = 4, 4.0
# Minimum number of matches for a score; an affine map with offset needs three (choice).
MIN_MATCHES = 6.0
# Matches are collinear if the smaller spread is at most this share of the larger: the root of rounding's (derived).
COLLINEAR_RATIO = 1e-9
# Maximum number of groups that the search starts from, and of the best that it continues with (choice: time).
MAX_GROUPS, MAX_KEPT_GROUPS = 40, 8
# Maximum step, radians: V is fixed within a step but depends on the rotation (choice). Steps below `STEP_TOLERANCE`
# have converged (choice).
MAX_STEP, STEP_TOLERANCE = 0.3, 1e-6
_SKEW = -np.cross(np.eye(3)[:, None], np.eye(3))


class AffineFits(NamedTuple):
    """Affine maps of the n cameras that can be scored.

    Attributes:
        camera: (n,) indices of the cameras.
        F: (n, 2, 2) y = F x on centered points.
        noise: (n, 4, 4) covariance of vec(F), from the map's residuals and the uncertainty of the noise of x.
        axes_x, axes_y: (n, 3, 3) camera axes in frames i and j, world.
        weight: (n,) Σ w.
    """

    camera: IntArray
    F: FloatArray
    noise: FloatArray
    axes_x: FloatArray
    axes_y: FloatArray
    weight: FloatArray

    def subset(self, rows: IntArray) -> AffineFits:
        """Return the fits selected by an index array."""
        return AffineFits._make(field[rows] for field in self)


class Scores(NamedTuple):
    """Scores of n cameras at K rotations.

    Attributes:
        scores: (K, n) scores.
        deviance: (K, n) -2 log-likelihood: the minimum over λ of the score's terms plus log det V.
        residuals: (K, n, 4) vec(F - N).
        precision: (K, n, 4, 4) V⁻¹.
        jacobian: (K, n, 4, 3) of vec(N + m a') by w, R = exp(w) R.
        slopes: (K, n, 2) the best-fitting a of each camera.
    """

    scores: FloatArray
    deviance: FloatArray
    residuals: FloatArray
    precision: FloatArray
    jacobian: FloatArray
    slopes: FloatArray


def fit_affine_maps(views: Views) -> AffineFits:
    """Fit affine maps of the cameras with at least `MIN_MATCHES` matches that are not collinear."""
    spread = np.linalg.eigvalsh(views.s_xx)
    is_usable = (views.weights >= MIN_MATCHES) & (spread[:, 0] > COLLINEAR_RATIO * spread[:, 1])
    is_usable &= spread[:, 1] > 10 * ROUNDING_SHARE * views.total
    v = views.subset(is_usable)
    misfit = v.s_yy - v.s_yx @ np.linalg.solve(v.s_xx, transpose(v.s_yx))
    misfit = (misfit + transpose(misfit)) / 2
    values, vectors = np.linalg.eigh(misfit)
    misfit = (vectors * np.maximum(values, 0.0)[:, None]) @ transpose(vectors)
    variance = misfit / (v.weights - 3)[:, None, None]
    inverse, noise_x = _inverse_without_noise(v)
    F = v.s_yx @ inverse
    noise = np.einsum("cij,ckl->cikjl", variance, inverse @ v.s_xx @ inverse).reshape(-1, 4, 4)
    noise_column = NOISE_RELATIVE_SD * noise_x[:, None] * (F @ inverse).reshape(-1, 4)
    noise += noise_column[:, :, None] * noise_column[:, None]
    return AffineFits(np.flatnonzero(is_usable), F, noise, v.rotation_x, v.rotation_y, v.weights)


def _inverse_without_noise(v: Views) -> tuple[FloatArray, FloatArray]:
    """Return the inverse (n, 2, 2) of s_xx corrected for the noise of x, and that noise along each direction (n,).

    Least squares underestimate F along directions in which the image is hardly wider than the noise of x (a board seen
    from the side). For any depths, (x, y) is near a hyperplane; the distance from it is the noise.
    """
    scatter = np.block([[v.s_xx, transpose(v.s_yx)], [v.s_yx, v.s_yy]])
    spread, axes = np.linalg.eigh(v.s_xx)
    noise_x = np.clip(np.linalg.eigvalsh(scatter)[:, 0], 0.0, MAX_NOISE_SHARE * spread[:, 1])
    true = np.maximum(spread - noise_x[:, None], MIN_SIGNAL_SHARE * spread)
    return (axes / true[:, None]) @ transpose(axes), noise_x


def compute_scores(fits: AffineFits, rotations: FloatArray) -> Scores:
    """Compute the scores of all cameras at K rotations (K, 3, 3)."""
    to_y = fits.axes_y[:, :2]
    from_x = transpose(fits.axes_x)
    in_camera = to_y @ rotations[:, None] @ from_x
    N, m = in_camera[..., :2], in_camera[..., 2]
    shape = N.shape[:2]
    n = N.reshape(*shape, 4)
    angle = Rotation.from_matrix(rotations).magnitude()
    non_affine = NON_AFFINE_SD**2 + (NON_AFFINE_SD_PER_RADIAN * angle) ** 2
    V = fits.noise + SCALE_SD**2 * n[..., :, None] * n[..., None, :] + non_affine[:, None, None, None] * np.eye(4)
    precision_flat = np.linalg.inv(V)
    difference = fits.F.reshape(-1, 4) - n
    # Slopes add a rank-two term to V; along its two directions all values of λ are evaluated at once.
    slope_basis = (m[..., :, None, None] * np.eye(2)).reshape(*shape, 4, 2)
    weight, directions = np.linalg.eigh(transpose(slope_basis) @ precision_flat @ slope_basis)
    weight = np.maximum(weight, 0.0)
    projection = precision_flat @ slope_basis @ directions
    pull = (transpose(projection) @ difference[..., None])[..., 0]
    slope_variances = SLOPE_SD**2 * STEEPNESS_GRID[:, None, None, None]
    penalty = np.log(STEEPNESS_GRID) + 1 / STEEPNESS_GRID - 1
    added = penalty[:, None, None] - (pull**2 / (weight + 1 / slope_variances)).sum(axis=-1)  # (λ, K, n)
    best = added.argmin(axis=0)
    gain = 1 / (weight + 1 / slope_variances[best][..., 0, 0, :])
    precision = precision_flat - (projection * gain[..., None, :]) @ transpose(projection)
    squared = (difference * (precision_flat @ difference[..., None])[..., 0]).sum(axis=-1)
    added_deviance = added + np.log1p(slope_variances * weight).sum(axis=-1)
    deviance = squared + np.linalg.slogdet(V)[1] + added_deviance.min(axis=0)
    slopes = (directions @ (gain * pull)[..., None])[..., 0]
    rotation_derivative = (to_y[:, None] @ _SKEW) @ rotations[:, None, None] @ from_x[:, None]  # (K, n, 3, 2, 3): by w
    jacobian = (rotation_derivative[..., :2] + rotation_derivative[..., 2:] * slopes[..., None, None, :]).reshape(
        *shape, 3, 4
    )
    return Scores(squared + added.min(axis=0), deviance, difference, precision, transpose(jacobian), slopes)


def _refine(
    fits: AffineFits, rotations: FloatArray, masks: BoolArray, max_iterations: int = 12
) -> tuple[FloatArray, FloatArray]:
    """Minimize the scores of the cameras in K masks (K, n) by Gauss-Newton with V fixed in each step.

    A prior with a standard deviation of one radian applies to the rotation. Returns the K rotations and their
    information (K, 3, 3).
    """
    information = np.empty((0, 3, 3))
    for _ in range(max_iterations):
        s = compute_scores(fits, rotations)
        weighted = transpose(s.jacobian) @ s.precision * masks[..., None, None]
        information = np.eye(3) + (weighted @ s.jacobian).sum(axis=1)
        gradient = (weighted @ s.residuals[..., None]).sum(axis=1)
        step = np.linalg.solve(information, gradient)[..., 0]
        length = np.linalg.norm(step, axis=1)
        step /= np.maximum(length / MAX_STEP, 1.0)[:, None]
        rotations = Rotation.from_rotvec(step).as_matrix() @ rotations
        if length.max() < STEP_TOLERANCE:
            break
    return rotations, information


def find_consensus_rotation(fits: AffineFits, initial: FloatArray) -> tuple[FloatArray, bool]:
    """Find the likeliest rotation when some cameras may be at fault.

    Args:
        fits: n cameras.
        initial: (3, 3) an initial rotation, in addition to the identity.

    Returns:
        The rotation (3, 3), and whether the set of faulty cameras is certain.
    """
    n = len(fits.camera)
    starts = np.stack([np.eye(3), initial])
    R, _ = _refine(fits, starts, np.ones((2, n), dtype=bool))
    worst = compute_scores(fits, R).scores.max(axis=1)
    if n > MAX_CAMERAS_ALWAYS_SEARCHED and worst.min() <= AGREEMENT_SCORE:
        return R[np.argmin(worst)], True
    groups = _camera_groups(n)
    R, _ = _refine(fits, np.repeat(starts, len(groups), axis=0), np.concatenate([groups, groups]))
    R = R[np.argsort(_consensus_cost(fits, compute_scores(fits, R)), kind="stable")[:MAX_KEPT_GROUPS]]
    for _ in range(3):
        # Cameras that agree with a group are added to it; members that disagree are removed.
        R, _ = _refine(fits, R, compute_scores(fits, R).scores <= FAULT_SCORE)
    at = compute_scores(fits, R)
    cost, inside = _consensus_cost(fits, at), at.scores <= FAULT_SCORE
    best = int(np.argmin(cost))
    is_alternative = inside[:, ~inside[best]].any(axis=1)  # hypotheses that contain a camera which the best excludes
    return R[best], not bool((cost[is_alternative] < cost[best] + MIN_COST_MARGIN).any())


def _consensus_cost(fits: AffineFits, scores: Scores) -> FloatArray:
    """Return the -2 log-likelihood (K,) with each camera either good or at fault."""
    size = np.maximum((fits.F**2).sum(axis=(1, 2)) / 2, 1.0)  # 1 for a rotation about the viewing direction
    return np.asarray(np.minimum(scores.deviance, FAULT_COST + FAULT_COST_PER_LOG_SIZE * np.log(size)).sum(axis=1))


def _camera_groups(n: int) -> BoolArray:
    """Return masks (g, n): all cameras, and groups of three (of n - 1 if there are at most three)."""
    members = list(combinations(range(n), 3 if n > 3 else max(n - 1, 1)))
    if len(members) > MAX_GROUPS:
        members = [members[i] for i in np.random.default_rng(0).choice(len(members), MAX_GROUPS, replace=False)]
    masks = np.zeros((len(members) + 1, n), dtype=bool)
    masks[0] = True
    for mask, member in zip(masks[1:], members, strict=True):
        mask[list(member)] = True
    return masks


def refine_consensus(fits: AffineFits, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Refine R with all cameras that agree with it.

    Returns the rotation (3, 3) and the scores (n,) of all cameras there; for cameras that disagree, V includes the
    uncertainty of that rotation.
    """
    information = np.eye(3)
    inside = np.zeros(len(fits.camera), dtype=bool)
    for _ in range(5):
        previous, inside = inside, compute_scores(fits, R[None]).scores[0] <= FAULT_SCORE
        if (inside == previous).all():
            break
        (R,), (information,) = _refine(fits, R[None], inside[None])
    at = compute_scores(fits, R[None])
    scores, outside = at.scores[0].copy(), ~inside
    if inside.any():
        J, difference = at.jacobian[0][outside], at.residuals[0][outside]
        V = np.linalg.inv(at.precision[0][outside]) + J @ np.linalg.inv(information) @ transpose(J)
        scores[outside] = (difference * np.linalg.solve(V, difference[..., None])[..., 0]).sum(axis=1)
    return R, scores
