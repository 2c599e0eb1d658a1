"""Detection of faulty cameras: wrong calibration, junk matches or a frozen image.

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

Each camera is scored by the distance of its matches from the consensus rotation of the cameras. The search for it
starts from small groups of cameras, so that faulty ones do not mask themselves by biasing the estimate. Of two
rotations with equal scores the smaller is likelier: large rotations allow larger residuals, which log det V penalizes.

A camera's own moments determine the kind of fault: for any rotation and any plane of depths, F has |F'u| = s, near 1,
for the u that is normal to m. A camera whose F is too small for every u has junk matches; one whose matches do not move
while those of others do is frozen; otherwise its calibration is wrong.

Source: Chen & Schonfeld (2010) name sensor errors; docs/method/2-sylvester.md; noise in x: W. Fuller, Measurement Error
Models (1987); the search and the test are ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import fdtri

from sylpose.display import Printable
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import transpose
from sylpose.geometry.validation import check_integer, check_list, check_rotation, check_sequence
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate
from sylpose.status import Status
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.orthographic import ROUNDING_SHARE, Views, compute_views

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
# have converged, at the latest after so many iterations (choice).
MAX_STEP, STEP_TOLERANCE, MAX_ITERATIONS = 0.3, 1e-6, 12
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
    by_w = (to_y[:, None] @ _SKEW) @ rotations[:, None, None] @ from_x[:, None]  # (K, n, 3, 2, 3): by w
    jacobian = (by_w[..., :2] + by_w[..., 2:] * slopes[..., None, None, :]).reshape(*shape, 3, 4)
    return Scores(squared + added.min(axis=0), deviance, difference, precision, transpose(jacobian), slopes)


def _refine(fits: AffineFits, rotations: FloatArray, masks: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Minimize the scores of the cameras in K masks (K, n) by Gauss-Newton with V fixed in each step.

    A prior with a standard deviation of one radian applies to the rotation. Returns the K rotations and their
    information (K, 3, 3).
    """
    information = np.empty((0, 3, 3))
    for _ in range(MAX_ITERATIONS):
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


FaultKind = Literal["calibration", "frozen", "junk"]

# A camera has full weight up to this score, half of `FAULT_SCORE`, and none from `FAULT_SCORE` on (choice).
FULL_WEIGHT_SCORE = 6.0
# A camera at fault has junk matches if no rotation gives it a score below this (measured:
# docs/history/benchmarks.md#bad-sensors, the kind is right in all).
JUNK_SCORE = 4.0
# Matches are static if noise explains their displacements at this significance level (choice; F-test).
STATIC_SIGNIFICANCE = 1e-4
# Squared displacements of static matches are at most this share of their squared spread (choice).
STATIC_SHARE = 0.1
# Maximum number of cameras in the search for the rotation (choice: time).
MAX_CAMERAS_SEARCHED = 24
# Squared displacements up to this share of the points' squares are rounding (derived).
STATIC_ROUNDING_SHARE = 1e-12
_FAULT_TEXTS: dict[FaultKind, str] = {
    "calibration": "its matches fit a rotation, but not that of the other cameras: its calibration is wrong, "
    "it was moved, or its images are mirrored, exchanged or of another object",
    "frozen": "its matches do not move while those of the other cameras do: its image is frozen",
    "junk": "no rotation explains its matches: they are junk",
}


@dataclass(frozen=True)
class Fault:
    """Fault of a camera.

    Attributes:
        camera: its name, or its index as text.
        kind: "calibration" (its matches fit a rotation, but not that of the other cameras: its camera_from_world is
            wrong, or its images are mirrored or another camera's), "junk" (no rotation explains its matches), or
            "frozen" (its matches do not move while those of the others do).
        score: squared distance of its affine map from the others' rotation, in standard deviations.
        text: a sentence with the camera's name.
    """

    camera: str
    kind: FaultKind
    score: float
    text: str


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Printable):
    """Diagnosis of all cameras from their moments.

    Attributes:
        consistent: more than half of the cameras with a score, except junk and frozen ones, agree on a rotation, and
            the set of those that disagree is certain.
        text: a sentence with the faults found, or the reason why they are uncertain.
        rotation: (3, 3) rotation that the scores refer to, world frame.
        scores: (C,) as `Fault.score`; NaN for cameras with too few or collinear matches.
        weights: (C,) 0 for a camera at fault, 1 for a good one (or one without a score), between them near the
            threshold.
        faults: (C,) None for a camera that is not at fault.
    """

    consistent: bool
    text: str
    rotation: FloatArray
    scores: FloatArray
    weights: FloatArray
    faults: tuple[Fault | None, ...]


@dataclass(frozen=True, eq=False, repr=False)
class RobustSolution(RotationEstimate):
    """Rotation estimated from the cameras that are not at fault.

    Attributes:
        status: that of `solution`, or `NOT_CONSISTENT` if no majority of cameras agrees or the faulty camera is
            uncertain (`diagnosis.text`); `solution` is then the likeliest.
        rotation, information, unobservable, iterations: those of `solution`.
        solution: the centralized estimate with the cameras' weights; None if all cameras have junk matches.
        diagnosis: the fault of each camera.
    """

    solution: CentralizedSolution | None
    diagnosis: Diagnosis

    @property
    def weights(self) -> FloatArray:
        """(C,) weights of the cameras."""
        return self.diagnosis.weights

    @property
    def faults(self) -> tuple[Fault | None, ...]:
        """(C,) None for a camera that is not at fault."""
        return self.diagnosis.faults


def solve_robust(
    rotations: ArrayLike, moments: Sequence[PairMoments], *, names: Sequence[str] | None = None, aim: bool = True
) -> RobustSolution:
    """Estimate the rotation from the cameras that are not at fault, and diagnose the others.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        names: C camera names for the faults' texts; None for the indices.
        aim: as in `compute_views`.

    Returns:
        The weighted centralized estimate with its diagnosis.

    Raises:
        ValueError: as `solve_centralized`, or the number of names is not C.
    """
    moments = check_list(moments, PairMoments, "moments")
    diagnosis = diagnose_cameras(rotations, moments, names=names, aim=aim)
    Q = np.asarray(rotations, dtype=float)
    kept = np.flatnonzero(diagnosis.weights > 0).tolist()
    if len(kept) == 0:
        nothing = np.full((3, 3), np.nan), np.zeros((3, 3)), np.eye(3)
        return RobustSolution(Status.NOT_CONSISTENT, *nothing, 0, None, diagnosis)
    weighted = [moments[c].scale_weights(float(diagnosis.weights[c])) for c in kept]
    s = solve_centralized(Q[kept], weighted, aim=aim)
    status = s.status if diagnosis.consistent else Status.NOT_CONSISTENT
    return RobustSolution(status, s.rotation, s.information, s.unobservable, s.iterations, s, diagnosis)


def diagnose_cameras(
    rotations: ArrayLike, moments: Sequence[PairMoments], *, names: Sequence[str] | None = None, aim: bool = True
) -> Diagnosis:
    """Find the cameras at fault by the consensus rotation, as input weights for any estimator.

    Estimators drop the moments of weight 0 and scale the others. With two cameras a disagreement is detected, but not
    the faulty camera. With three or four it is often uncertain, except for junk and frozen ones. A fault that does not
    affect the matches (a wrong calibration while the object hardly rotates) is not found and has little effect.

    Args:
        rotations, moments, names, aim: as in `solve_robust`.

    Returns:
        The faults and weights of all cameras.

    Raises:
        ValueError: as `compute_views`, or the number of names is not C.
    """
    moments = check_list(moments, PairMoments, "moments")
    cameras = _fit_cameras(rotations, moments, names, aim)
    fits, static, junk = cameras.fits, cameras.static, cameras.junk
    voters = np.flatnonzero(junk <= FAULT_SCORE)
    if len(voters) == 0:
        return _build_diagnosis(cameras, np.eye(3), junk, True)
    # A static object cannot appear to move: if two or more cameras observe motion, those without motion do not vote.
    moving = voters[~static[voters]]
    voting = moving if len(moving) > 1 else voters
    sample = voting[np.linspace(0, len(voting) - 1, min(len(voting), MAX_CAMERAS_SEARCHED)).astype(int)]
    Q = np.asarray(rotations, dtype=float)[fits.camera[sample]]
    initial = solve_centralized(Q, [moments[c] for c in fits.camera[sample]], aim=aim).rotation
    R, certain = find_consensus_rotation(fits.subset(sample), initial)
    R, voting_scores = refine_consensus(fits.subset(voting), R)
    scores = np.maximum(compute_scores(fits, R[None]).scores[0], junk)
    scores[voting] = voting_scores
    return _build_diagnosis(cameras, R, scores, certain)


def find_faulty_cameras(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    rotation: ArrayLike,
    *,
    at_fault: Sequence[int] = (),
    names: Sequence[str] | None = None,
    aim: bool = True,
) -> Diagnosis:
    """Find the cameras at fault for a known rotation of the object.

    Args:
        rotations, moments, names, aim: as in `solve_robust`.
        rotation: (3, 3) R, world frame, assumed exact.
        at_fault: indices of cameras already known to be at fault (for instance by large epipolar residuals); only the
            kind of their fault is determined.

    Returns:
        The faults and weights of all cameras.

    Raises:
        ValueError: as `compute_views`, the number of names is not C, or rotation is not a rotation matrix.
    """
    R = check_rotation(rotation)
    moments = check_list(moments, PairMoments, "moments")
    last, indices = len(moments) - 1, check_sequence(at_fault, "at_fault")
    faulty = [check_integer(c, f"at_fault[{k}]", maximum=last) for k, c in enumerate(indices)]
    cameras = _fit_cameras(rotations, moments, names, aim)
    scores = np.maximum(compute_scores(cameras.fits, R[None]).scores[0], cameras.junk)
    scores[np.isin(cameras.fits.camera, np.array(faulty, dtype=np.int64))] = np.inf
    return _build_diagnosis(cameras, R, scores, True)


def max_fault_score(fits: AffineFits, rotation: FloatArray) -> float:
    """Return the largest `Fault.score` of these cameras at a rotation (3, 3), assumed exact; 0 without any camera."""
    scores = np.maximum(compute_scores(fits, rotation[None]).scores[0], _junk_scores(fits))
    return float(scores.max(initial=0.0))


class _Fits(NamedTuple):
    """Names of all cameras, and fits, static matches and junk scores (n,) of those that can be scored."""

    labels: list[str]
    fits: AffineFits
    static: BoolArray
    junk: FloatArray

    @property
    def kinds(self) -> list[FaultKind]:
        """(n,) kind of the fault of each camera, if it is at fault."""
        is_junk = self.junk > JUNK_SCORE
        return ["junk" if j else "frozen" if s else "calibration" for s, j in zip(self.static, is_junk, strict=True)]


def _fit_cameras(rotations: ArrayLike, moments: Sequence[PairMoments], names: Sequence[str] | None, aim: bool) -> _Fits:
    n = len(moments)
    labels = [str(c) for c in range(n)] if names is None else check_list(names, str, "names", n)
    fits = fit_affine_maps(compute_views(rotations, moments, aim=aim))
    return _Fits(labels, fits, find_static_views(moments, fits), _junk_scores(fits))


def _junk_scores(fits: AffineFits) -> FloatArray:
    """Return each camera's score (n,) at its own best rotation: 0 unless |F'u| < 1 for all u."""
    u, values, v = np.linalg.svd(fits.F)
    along = (u[:, :, 0, None] * v[:, None, 0]).reshape(-1, 4)
    variance = np.einsum("ci,cij,cj->c", along, fits.noise, along) + SCALE_SD**2 + NON_AFFINE_SD**2
    return np.asarray(np.maximum(1 - values[:, 0], 0.0) ** 2 / variance)


def find_static_views(moments: Sequence[PairMoments], fits: AffineFits) -> BoolArray:
    """Return the mask (n,) of cameras whose matches do not move by more than their noise."""
    if len(fits.camera) == 0:
        return np.zeros(0, dtype=bool)
    M = np.array([moments[c].matrix for c in fits.camera])
    i, j, n = [6, 7], [2, 5], fits.weight
    xx, yy, yx = M[:, i][:, :, i], M[:, j][:, :, j], M[:, j][:, :, i]
    d, s = M[:, j, 8] - M[:, i, 8], M[:, j, 8] + M[:, i, 8]
    mean = (d**2).sum(axis=1) / n
    dd = np.trace(xx + yy - yx - transpose(yx), axis1=1, axis2=2) - mean
    # d = y - x as a function of s = x + y: the noise of d is not in s, as it is in x, where the image may be narrow.
    ss = xx + yy + yx + transpose(yx) - s[:, :, None] * s[:, None] / n[:, None, None]
    ds = yy - xx + yx - transpose(yx) - d[:, :, None] * s[:, None] / n[:, None, None]
    explained = (ds * transpose(np.linalg.solve(ss, transpose(ds)))).sum(axis=(1, 2))
    # F-test of the affine map's six numbers; displacements within rounding are no motion. A half turn looks like noise
    # in d.
    noise = np.maximum(dd - explained, 0.0) / (2 * n - 6)
    rounding = STATIC_ROUNDING_SHARE * np.trace(M, axis1=1, axis2=2)
    is_small = dd <= STATIC_SHARE * np.trace(ss, axis1=1, axis2=2)
    limit = 6 * noise * fdtri(6, 2 * n - 6, 1 - STATIC_SIGNIFICANCE) + rounding
    return np.asarray(is_small & (mean + explained <= limit))


def _build_diagnosis(cameras: _Fits, R: FloatArray, camera_scores: FloatArray, certain: bool) -> Diagnosis:
    """Build the diagnosis from the scores (n,); `certain`: whether the set of faulty cameras is certain."""
    labels, fits, kinds = cameras.labels, cameras.fits, cameras.kinds
    at_fault = camera_scores > FAULT_SCORE
    is_junk = (cameras.junk > JUNK_SCORE) & at_fault
    disagreeing = at_fault & ~is_junk
    agree, against = int((~at_fault).sum()), int((disagreeing & ~cameras.static).sum())
    # One camera against one other is no majority.
    majority = agree > against and (agree > 1 or not disagreeing.any())
    consistent = len(camera_scores) == 0 or (majority and (certain or not disagreeing.any()))
    score_weights = np.clip((FAULT_SCORE - camera_scores) / (FAULT_SCORE - FULL_WEIGHT_SCORE), 0.0, 1.0)
    weights, scores = np.ones(len(labels)), np.full(len(labels), np.nan)
    weights[fits.camera] = score_weights if majority else np.where(is_junk, 0.0, 1.0)
    scores[fits.camera] = camera_scores
    faults: list[Fault | None] = [None] * len(labels)
    for k in np.flatnonzero(at_fault if consistent else is_junk).tolist():
        c = int(fits.camera[k])
        faults[c] = Fault(labels[c], kinds[k], float(camera_scores[k]), f"camera {labels[c]}: {_FAULT_TEXTS[kinds[k]]}")
    sentences = [fault.text for fault in faults if fault is not None]
    if not consistent and disagreeing.any():
        likeliest = ", ".join(labels[c] for c in fits.camera[disagreeing])
        sentences.append(f"the cameras disagree, and it is not certain which one is wrong (the likeliest: {likeliest})")
    text = "; ".join(sentences) or "no camera is at fault"
    return Diagnosis(consistent, f"{text[0].upper()}{text[1:]}.", R, scores, weights, tuple(faults))
