"""Bundle adjustment of a trajectory: all poses, all landmarks, and per-camera parameters.

The per-camera parameters are the depth of the observed surface in front of the object's origin and, on request, the
time offset.

Robust least squares on reprojection errors with static, calibrated cameras: a landmark X of the object is observed by
camera c in frame k at project(Q_c (R_k X + t_k - o_c)). Levenberg-Marquardt with re-weighting; the landmarks are
eliminated (Schur complement), which leaves six unknowns per frame and a border of shared parameters.

Source: B. Triggs, P. McLauchlan, R. Hartley, A. Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000;
K. Levenberg, "A method for the solution of certain non-linear problems in least squares", 1944; D. Marquardt, 1963.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import block_array, coo_array, csr_array, eye_array, tril
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment import calibration_refinement as calibration
from sylpose.bundle_adjustment.calibration_refinement import CalibrationCorrection, CalibrationPrior
from sylpose.bundle_adjustment.camera_parameters import compute_depth_basis, default_depth_prior, make_camera_parameters
from sylpose.bundle_adjustment.kernels import DEPTH, TIME_OFFSET, SortedObservations
from sylpose.bundle_adjustment.problem import LATERAL_SD_RADII, Fit, FitSummary, Problem, State
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.blas_threads import limit_blas_threads
from sylpose.geometry.validation import check_finite
from sylpose.rig import Rig
from sylpose.status import Status

# Weak prior of every pose: half a revolution and several radii around its start, which keeps unconstrained poses there
# (choice).
WEAK_ROTATION_SD, WEAK_TRANSLATION_RADII = np.pi, 10.0
# The noise is re-estimated until it changes by less than this, or for so many iterations; then it is fixed (choice).
SIGMA_TOLERANCE, MAX_SIGMA_ITERATIONS = 0.05, 8
# A rough start's lower limit of the noise falls by this factor per iteration (choice: from ten pixels to the noise floor
# in five).
GRADUATION = 3.0
# Errors of reprojection with which a rough start begins, pixels (choice: more than the tracker's drift).
ROUGH_PX = 10.0
# Weights are updated until the step's square, in standard deviations and per frame, is less than this, or for so many
# iterations; then they are fixed: each weight that still changes moves the rest slightly, in ever more iterations
# (choice).
WEIGHTS_TOLERANCE, MAX_WEIGHT_ITERATIONS = 0.02, 10
# Converged when the step of all frames together is a tenth of a standard deviation: the remaining error is much smaller
# (choice).
STEP_TOLERANCE = 0.1**2
# Attempts per iteration to find a step that reduces the cost (choice).
MAX_TRIES = 8
# Number of lens linearizations (choice: each leaves a hundredth of the error).
LENS_LINEARIZATIONS = 3
# Surface depths are fixed at their prior if more than this fraction of the apparent information on them is noise
# (measured: docs/history/benchmarks.md, "Slides").
MAX_NOISE_RATIO = 0.3
# Rotations with an rms of so many times their noise dominate it, so the information from noise is not computed (choice:
# in squares this leaves it a fraction of 1e-4).
CLEAR_ROTATION_RATIO = 100.0
# Minimum number of random draws; recordings with fewer frames are drawn repeatedly (choice).
MIN_DRAWS = 24


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of landmarks, n in total.

    Attributes:
        frame, camera, landmark: (n,) indices; any order.
        image: (n, 2) normalized points.
    """

    frame: IntArray
    camera: IntArray
    landmark: IntArray
    image: FloatArray

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, used: BoolArray) -> Observations:
        """Return some of the observations, (n,)."""
        return Observations(self.frame[used], self.camera[used], self.landmark[used], self.image[used])

    def select_frames(self, is_used: BoolArray) -> Observations:
        """Return the observations in some of the N frames, (N,), renumbered."""
        own = self.select(is_used[self.frame])
        return replace(own, frame=(np.cumsum(is_used) - 1)[own.frame])

    def pair_successive(self) -> tuple[IntArray, IntArray]:
        """Return the observations (m,) of a landmark that its camera observes in the next frame as well, and those (m,)."""
        order = np.lexsort((self.frame, self.camera, self.landmark))
        frame, camera, landmark = (x[order] for x in (self.frame, self.camera, self.landmark))
        is_next = (np.diff(frame) == 1) & (np.diff(camera) == 0) & (np.diff(landmark) == 0)
        return order[:-1][is_next], order[1:][is_next]


@dataclass(frozen=True, eq=False)
class BundleResult(FitSummary):
    """Refined trajectory, with its uncertainty.

    Attributes:
        status: OK; NOT_CONVERGED within the maximum number of iterations; TOO_FEW_MATCHES when no frame is connected to
            a fixed one: then the poses are those given.
        world_from_object: N poses.
        landmarks: (M, 3) object's frame; those observed less than twice are as given, or on their ray, or at the
            origin.
        connected: (N,) frames connected to a fixed frame by landmarks, directly or through others. Others keep
            approximately the poses given, with a covariance as wide as the object's size and half a revolution.
        weights: (n,) in [0, 1], 0 for outliers and for landmarks observed less than twice.
        residuals: (n, 2) pixels; 1e6 behind a camera.
        offsets: (C,) time offset of each camera, seconds, positive for a delay; their mean is 0. Zeros when not
            requested.
        offsets_sd: (C,) their standard deviations, close to the prior's where the motion does not constrain them.
        iterations: iterations of Levenberg-Marquardt.
        correction: of the calibration, if requested.
    """

    status: Status
    world_from_object: RigidTransform
    landmarks: FloatArray
    connected: BoolArray
    weights: FloatArray
    residuals: FloatArray
    offsets: FloatArray
    offsets_sd: FloatArray
    iterations: int
    correction: CalibrationCorrection | None

    @property
    def corrected_poses(self) -> RigidTransform:
        """The N poses, changed by what calibration errors that are not estimated do to them."""
        change, poses = self.calibration_change, self.world_from_object
        rotations = Rotation.from_rotvec(change[:, :3]) * poses.rotation
        return RigidTransform.from_components(poses.translation + change[:, 3:], rotations)


@dataclass(frozen=True, eq=False)
class BundleOptions:
    """Options of `bundle_adjust` for N poses and C cameras.

    Attributes:
        landmarks: (M, 3) initial positions, object's frame; None: triangulated.
        fixed: (N,) mask of the frames with fixed poses, at least one; None: the first.
        prior_information: (N, 6, 6) of (w, d), prior information on the poses: they were measured as given.
        times: (N,) or (N, C) seconds: when each camera took each frame. The pose of a frame is that at the mean of its
            times; each camera's timestamp is reached along a parabola through neighboring poses. Increasing; None: 0,
            1, ...
        offsets_sd: seconds; if given, the cameras' time offsets are estimated, with a prior of mean zero and this
            standard deviation.
        depth_prior: prior mean (C,) and covariance (C, C), length units, of the depth of the surface that a camera
            observes in front of the object's origin, towards that camera. Its landmarks are within three radii and a
            slope of it. The error of this prior does not average out, so it alone determines the length of a motion
            without rotation; any rotation soon constrains it better. None: `default_depth_prior`, for ordinary bodies
            of the radius.
        fix_depths: fix the surfaces' depths at the prior, even if rotations could determine them.
        calibration_prior: prior of calibration errors. They are included in the covariance, scaled to the size that the
            recording shows, and their effect on the poses is estimated; None: no errors. The poses of cameras that were
            moved are always estimated.
        recalibrate: estimate the calibration errors with all else, instead of only their effect on the poses.
        rough_px: lower limit of the noise at first, pixels, which falls to none in a few iterations: graduated
            non-convexity, for starts so far off that robust weights would lose frames (A. Blake, A. Zisserman, "Visual
            Reconstruction", 1987). Then errors of the calibration are estimated from the first iteration, and
            the prior of the lenses is not scaled.
        max_iterations: maximum number of iterations.
        coarse: stop a seventh of a standard deviation per frame before the optimum, after half of the iterations, and
            with equal variances of all landmarks of a camera; not for `recalibrate`.
        on_iteration: called with the number of each iteration as it begins.
    """

    landmarks: ArrayLike | None = None
    fixed: ArrayLike | None = None
    prior_information: ArrayLike | None = None
    times: ArrayLike | None = None
    offsets_sd: float | None = None
    depth_prior: tuple[ArrayLike, ArrayLike] | None = None
    fix_depths: bool = False
    calibration_prior: CalibrationPrior | None = None
    recalibrate: bool = False
    rough_px: float = 0.0
    max_iterations: int = 30
    coarse: bool = False
    on_iteration: Callable[[int], None] | None = None


DEFAULT_OPTIONS = BundleOptions()


class _Setup(NamedTuple):
    """Problem to solve, and how it relates to the arguments of `bundle_adjust`.

    Attributes:
        problem, state: without calibration errors.
        order: (n,) order of the observations in the problem.
        indices: of the observed landmarks.
        landmarks: (M, 3) all landmarks, initially.
        connected: (N,) frames connected to a fixed one.
        is_solvable: whether one of them is free.
    """

    problem: Problem
    state: State
    order: IntArray
    indices: IntArray
    landmarks: FloatArray
    connected: BoolArray
    is_solvable: bool


@limit_blas_threads()
def bundle_adjust(
    rig: Rig,
    observations: Observations,
    world_from_object: RigidTransform,
    radius: float,
    options: BundleOptions = DEFAULT_OPTIONS,
) -> BundleResult:
    """Refine poses and landmarks jointly by minimizing the reprojection error.

    Args:
        rig: C cameras.
        observations: n observations; landmarks shared by cameras or observed again later constrain more, but are not
            required.
        world_from_object: N initial poses.
        radius: of the object.
        options: priors, fixed frames, and what else is estimated.

    Returns:
        the refined trajectory.

    Raises:
        ValueError: inconsistent shapes or indices, values that are not finite, no fixed frame, times that do not
            increase.
    """
    setup, prior = _prepare(rig, observations, world_from_object, radius, options), options.calibration_prior
    problem, state, connected = setup.problem, setup.state, setup.connected
    has_moved_cameras = prior is not None and bool((prior.predecessor >= 0).any())
    if prior is not None and has_moved_cameras:
        # The poses of moved cameras must be free from the first iteration: otherwise all poses would diverge.
        added = calibration.add_calibration_errors(problem, state, rig, prior)
        problem, state = calibration.rescale_calibration_prior(*added, calibration.NEAR_EXACT_SCALE)
    is_rough = prior is not None and options.recalibrate and options.rough_px > 0
    if prior is not None and is_rough and not has_moved_cameras:
        # Held at a rough calibration, poses would be a compromise in which whole cameras are outliers.
        problem, state = calibration.add_calibration_errors(problem, state, rig, prior)
        problem = calibration.free_calibration(problem)
    if options.fix_depths:
        problem = problem.fix_depths()
    if setup.is_solvable:
        fit = minimize(problem, state, options)
    else:
        unknown, e = np.zeros(len(observations)), problem.compute_residuals(state)
        sigma = problem.estimate_noise(e, unknown)
        weights = problem.compute_weights(e, sigma)
        fit = Fit(state, Status.TOO_FEW_MATCHES, 0, weights, sigma, unknown, np.ones(len(e)))
    summary = problem.summarize(fit, connected)
    if not options.fix_depths and setup.is_solvable and is_scale_from_noise(problem, fit, summary, connected):
        problem = problem.fix_depths()
        state = replace(fit.state, z=np.where(problem.camera_parameters.depth_mask, 0.0, fit.state.z))
        fit = minimize(problem, state, options)
        summary = problem.summarize(fit, connected)
    if prior is not None:
        path = summary.scale_sd, summary.scale_variance_ratio
        if has_moved_cameras or is_rough:
            problem, state = calibration.rescale_calibration_prior(problem, fit.state, 1.0)
        else:
            problem, state = calibration.add_calibration_errors(problem, fit.state, rig, prior)
        fit = replace(fit, state=state)
        if options.recalibrate and setup.is_solvable:
            image = setup.problem.observations.image
            problem, fit, summary = refine_with_calibration(problem, fit, rig, image, connected, options)
        else:
            summary = problem.summarize(fit, connected)
        # Calibration errors do not concern the question whether a rotation has determined the path's length.
        summary = replace(summary, scale_sd=path[0], scale_variance_ratio=path[1])
    return _make_result(rig, setup, problem, fit, summary, options)


def _prepare(
    rig: Rig, observations: Observations, world_from_object: RigidTransform, radius: float, options: BundleOptions
) -> _Setup:
    """Check the arguments of `bundle_adjust` and make the problem and its initial state."""
    n_frames, n_cameras = (1 if world_from_object.single else len(world_from_object)), len(rig)
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius: {radius} is not a positive length")
    if options.offsets_sd is not None and not (np.isfinite(options.offsets_sd) and options.offsets_sd > 0):
        raise ValueError(f"offsets_sd: {options.offsets_sd} is not a positive time")
    fixed_mask, pose_information = resolve_fixed_frames(options.fixed, n_frames), np.zeros((n_frames, 6, 6))
    if options.prior_information is not None:
        pose_information = check_finite(options.prior_information, (n_frames, 6, 6), "prior_information")
    if options.landmarks is None:
        landmarks = np.zeros((int(np.max(observations.landmark, initial=-1)) + 1, 3))
    else:
        landmarks = check_finite(options.landmarks, ("M", 3), "landmarks").copy()
    _check_observations(observations, n_frames, n_cameras, len(landmarks))
    times = np.arange(n_frames) if options.times is None else np.asarray(options.times, float)
    times = check_finite(times, (n_frames, n_cameras) if times.ndim == 2 else (n_frames,), "times")
    camera_times = times if times.ndim == 2 else np.repeat(times[:, None], n_cameras, axis=1)
    frame_times = camera_times.mean(axis=1)
    if (np.diff(frame_times) <= 0).any():
        raise ValueError("times: must increase from frame to frame")
    rotations, translations = np.atleast_3d(world_from_object.rotation.as_matrix()), world_from_object.translation
    rotations, translations = rotations.reshape(-1, 3, 3), translations.reshape(-1, 3)
    order, indices, sorted_observations = _sort_observations(observations, fixed_mask)
    repeated = np.diff(sorted_observations.start) >= 2
    connected = find_connected_frames(sorted_observations, repeated, fixed_mask | pose_information.any(axis=(1, 2)))
    depth, covariance = options.depth_prior or default_depth_prior(radius, n_cameras)
    depth = check_finite(depth, (n_cameras,), "depth_prior: mean")
    covariance = check_finite(covariance, (n_cameras, n_cameras), "depth_prior: covariance")
    used = np.unique(sorted_observations.camera)
    camera_parameters = make_camera_parameters(n_cameras, options.offsets_sd, used, depth, covariance)
    weak_information = np.repeat([WEAK_ROTATION_SD**-2, (WEAK_TRANSLATION_RADII * radius) ** -2], 3)
    time_shifts = camera_times - frame_times[:, None]
    problem = Problem(
        observations=sorted_observations,
        repeat_mask=np.repeat(repeated, np.diff(sorted_observations.start)).astype(float),
        pattern=build_covisibility_pattern(sorted_observations, repeated),
        start_rotations=rotations,
        start_translations=translations,
        prior=pose_information + np.diag(weak_information),
        radius=radius,
        times=frame_times,
        time_shifts=time_shifts,
        has_time_shifts=bool(np.abs(time_shifts).max() > 0) or camera_parameters.n_offsets > 0,
        camera_parameters=camera_parameters,
        rotations=np.array([camera.rotation for camera in rig]),
        centers=np.array([camera.center for camera in rig]),
        focals=np.array([camera.focal for camera in rig]),
    )
    z, derivatives = np.zeros(camera_parameters.basis.shape[2]), np.zeros((n_frames, 2, 6))
    state = problem.update_derivatives(State(rotations, translations, landmarks[indices], z, derivatives))
    if options.landmarks is None:
        state = replace(state, points=problem.triangulate(state))
    problem, is_solvable = _add_depth_basis(problem, state), bool((connected & ~fixed_mask).any())
    return _Setup(problem, state, order, indices, landmarks, connected, is_solvable)


def _make_result(
    rig: Rig, setup: _Setup, problem: Problem, fit: Fit, summary: FitSummary, options: BundleOptions
) -> BundleResult:
    """Make the result from the fit and its uncertainty."""
    state, parameters, prior, correction = fit.state, problem.camera_parameters, options.calibration_prior, None
    if prior is not None and options.recalibrate:
        covariance = summary.parameter_covariance
        correction = calibration.make_correction(parameters, rig, prior.predecessor, state.z, covariance)
    points = setup.landmarks.copy()
    points[setup.indices] = state.points
    weights, residuals = np.empty(len(setup.order)), np.empty((len(setup.order), 2))
    weights[setup.order], residuals[setup.order] = fit.weights, problem.compute_residuals(state)
    unused_cameras = np.setdiff1d(np.arange(len(rig)), problem.observations.camera)
    summary.sigma_px[unused_cameras] = np.nan
    basis = parameters.basis[:, TIME_OFFSET]
    spread = np.sqrt(np.einsum("ck,kl,cl->c", basis, summary.parameter_covariance, basis))
    if options.offsets_sd is not None:
        spread[unused_cameras] = options.offsets_sd
    return BundleResult(
        **vars(summary),
        status=fit.status,
        world_from_object=RigidTransform.from_components(state.translations, Rotation.from_matrix(state.rotations)),
        landmarks=points,
        connected=setup.connected,
        weights=weights,
        residuals=residuals,
        offsets=parameters.evaluate(state.z)[:, TIME_OFFSET],
        offsets_sd=spread,
        iterations=fit.iterations,
        correction=correction,
    )


def resolve_fixed_frames(fixed: ArrayLike | None, n_frames: int) -> BoolArray:
    """Return (N,) mask of the fixed frames from `bundle_adjust`'s `fixed`."""
    fixed_mask = np.arange(n_frames) == 0 if fixed is None else np.asarray(fixed, dtype=bool)
    if fixed_mask.shape != (n_frames,):
        raise ValueError(f"fixed: shape {fixed_mask.shape}, expected ({n_frames},), one per pose")
    if not fixed_mask.any() or fixed_mask.all():
        raise ValueError("fixed: at least one frame must be fixed and at least one free")
    return fixed_mask


def _check_observations(observations: Observations, n_frames: int, n_cameras: int, n_landmarks: int) -> None:
    n = len(observations)
    for name, index, size in (
        ("frame", observations.frame, n_frames),
        ("camera", observations.camera, n_cameras),
        ("landmark", observations.landmark, n_landmarks),
    ):
        if np.shape(index) != (n,) or not np.issubdtype(np.asarray(index).dtype, np.integer):
            raise ValueError(f"observations: {name} must be ({n},) integers")
        if n and not (np.min(index) >= 0 and np.max(index) < size):
            raise ValueError(f"observations: {name} must be from 0 to {size - 1}")
    check_finite(observations.image, (n, 2), "observations: image")


def _sort_observations(observations: Observations, fixed: BoolArray) -> tuple[IntArray, IntArray, SortedObservations]:
    """Sort observations by landmark.

    Returns:
        order of the observations (n,), indices of the observed landmarks (m,), and the sorted observations, without
        depth basis.
    """
    order = np.lexsort((observations.camera, observations.frame, observations.landmark))
    landmark_indices, counts = np.unique(observations.landmark, return_counts=True)
    free = np.where(fixed, -1, np.cumsum(~fixed) - 1).astype(np.int64)
    frame, camera = (np.asarray(index[order], np.int64) for index in (observations.frame, observations.camera))
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    image, lens = np.ascontiguousarray(observations.image[order], dtype=float), np.zeros((len(order), 3, 0))
    nothing, viewer = np.zeros((len(landmark_indices), 3)), camera[start[:-1]]
    sorted_observations = SortedObservations(start, frame, camera, image, lens, free, viewer, nothing, nothing)
    return order, landmark_indices, sorted_observations


def _add_depth_basis(problem: Problem, state: State) -> Problem:
    """Add each landmark's direction to its first viewer and its lateral position at that time."""
    observations = problem.observations
    k, viewer = observations.frame[observations.start[:-1]], observations.first_viewer
    object_from_world = state.rotations[k].transpose(0, 2, 1)
    centers = np.einsum("mij,mj->mi", object_from_world, problem.centers[viewer] - state.translations[k])
    axes = np.einsum("mij,mkj->mki", object_from_world, problem.rotations[viewer][:, :2])
    directions, lateral = compute_depth_basis(state.points, centers, axes, problem.radius)
    return replace(problem, observations=observations._replace(depth_direction=directions, depth_basis=lateral))


# --- optimizer --------------------------------------------------------------------------------------------------------


def minimize(problem: Problem, state: State, options: BundleOptions) -> Fit:
    """Run Levenberg-Marquardt with re-weighting from a state until it converges.

    Which observations are outliers is decided with the noise of the cameras. The landmarks' variances are estimated once,
    from the solution with equal ones. If they decided about outliers, a landmark that slides would be its own inlier, and
    one that is still for long an outlier as soon as it moves.

    With `options.coarse`, stop where the weights would be fixed: the remaining error is a seventh of a standard
    deviation per frame.
    """
    e = problem.compute_residuals(state)
    sigma = np.full(len(problem.focals), np.inf)
    leverage = np.full(len(e), min(1.0, 3.0 * len(state.points) / max(len(e), 1)))
    n_frames, damping, is_sigma_fixed, fixed_weights = len(state.rotations), 0.0, False, None
    # With unknown time offsets the path's derivatives change with each step, and few landmarks let them oscillate.
    variance_ratio, is_ratio_fixed = np.ones(len(e)), options.coarse or options.offsets_sd is not None
    floor = options.rough_px
    max_size = WEIGHTS_TOLERANCE * n_frames if options.coarse else STEP_TOLERANCE
    for iteration in range(1, options.max_iterations + 1):
        if options.on_iteration is not None:
            options.on_iteration(iteration)
        if not is_sigma_fixed:
            previous_sigma, sigma = sigma, np.maximum(problem.estimate_noise(e, leverage), floor)
            state = problem.reset_stray_landmarks(state, e, sigma)
            e = problem.compute_residuals(state)
            is_stable = bool(np.all(np.abs(sigma - previous_sigma) < SIGMA_TOLERANCE * sigma))
            is_sigma_fixed = is_stable or iteration >= MAX_SIGMA_ITERATIONS
            floor /= GRADUATION
        variances = sigma[problem.observations.camera] ** 2 * variance_ratio
        cost = problem.compute_cost(e, variances, state, fixed_weights)
        weights = problem.compute_weights(e, sigma) if fixed_weights is None else fixed_weights
        at = problem.linearize(state, weights / variances)
        system = problem.build_system(state, at)
        leverage = system.reduced.leverage
        for _ in range(MAX_TRIES):
            step, z, size = system.solve(damping)
            trial = problem.apply_step(state, at, step, z)
            e = problem.compute_residuals(trial)
            new_cost = problem.compute_cost(e, variances, trial, fixed_weights)
            if new_cost <= cost * (1.0 + 1e-12) or size < 1e-3 * STEP_TOLERANCE:
                break
            damping = max(30.0 * damping, 1e-5)
        else:
            return Fit(state, Status.NOT_CONVERGED, iteration, weights, sigma, leverage, variance_ratio)
        damping = damping / 30.0 if damping > 1e-5 else 0.0
        state = problem.update_derivatives(trial)
        if problem.has_time_shifts:
            e = problem.compute_residuals(state)
        if is_sigma_fixed and size < max_size:
            if is_ratio_fixed:
                return Fit(state, Status.OK, iteration, weights, sigma, leverage, variance_ratio)
            variance_ratio, is_ratio_fixed = problem.estimate_variance_ratio(e, weights, leverage), True
            fixed_weights = weights
        is_settled = size < WEIGHTS_TOLERANCE * n_frames or iteration >= MAX_WEIGHT_ITERATIONS
        if is_sigma_fixed and fixed_weights is None and is_settled:
            fixed_weights = problem.compute_weights(e, sigma)
    return Fit(state, Status.NOT_CONVERGED, options.max_iterations, weights, sigma, leverage, variance_ratio)


def refine_with_calibration(
    problem: Problem, fit: Fit, rig: Rig, image: FloatArray, connected: BoolArray, options: BundleOptions
) -> tuple[Problem, Fit, FitSummary]:
    """Refine with the calibration estimated as well.

    The first pass uses the observations as they are and measures the size of the calibration errors and the correlation
    of errors. Correlated errors resemble calibration errors, and the information of observations is smaller by their
    variance inflation. So the calibration prior is narrowed correspondingly for the last pass.

    Args:
        image: (n, 2) points as normalized by the rig.
    """
    problem, is_rough = calibration.free_calibration(problem), options.rough_px > 0
    options = replace(options, coarse=False, rough_px=0.0)
    for _ in range(LENS_LINEARIZATIONS):
        fit = minimize(problem, fit.state, options)
        scale = problem.summarize(fit, connected).calibration_scale
        # Extrinsics of a rough calibration are much better than their prior; its lenses need not be.
        problem, state = calibration.rescale_calibration_prior(problem, fit.state, scale, keeps_lenses=is_rough)
        problem, fit = calibration.relinearize_lenses(problem, image, rig, state.z), replace(fit, state=state)
    fit = minimize(problem, fit.state, options)
    summary, parameters = problem.summarize(fit, connected), problem.camera_parameters
    # The noise floor of the search already inflates the variance in part.
    inflation = np.median(summary.variance_inflation[problem.observations.free_index >= 0])
    inflation = inflation * np.mean((summary.sigma_px / fit.sigma) ** 2)
    factor = float(max(inflation, 1.0) ** -0.5)
    fit = minimize(*calibration.rescale_calibration_prior(problem, fit.state, parameters.scale * factor), options)
    state = replace(fit.state, z=fit.state.z * np.where(parameters.is_calibration, factor, 1.0))
    return problem, replace(fit, state=state), summary


# --- observability of the scale ---------------------------------------------------------------------------------------


def is_scale_from_noise(problem: Problem, fit: Fit, summary: FitSummary, connected: BoolArray) -> bool:
    """Return whether the information on the surfaces' depths is due to noise, or absent."""
    rotations = fit.state.rotations @ fit.state.rotations[problem.first_fixed_frame].T
    mean_square = float((Rotation.from_matrix(rotations[connected]).magnitude() ** 2).mean())
    noise = float(np.trace(summary.covariance[connected, :3, :3], axis1=1, axis2=2).mean())
    if mean_square > CLEAR_ROTATION_RATIO**2 * noise:
        return False
    try:
        return estimate_noise_ratio(problem, fit, summary, connected) > MAX_NOISE_RATIO
    except np.linalg.LinAlgError:
        return True


def estimate_noise_ratio(problem: Problem, fit: Fit, summary: FitSummary, connected: BoolArray) -> float:
    """Return the fraction of the apparent information on surface depths or path length that is due to noise.

    Depths and path lengths are determined by rotations. Estimated rotations are never zero, and the refinement uses the
    spurious information in their noise. So the information of the estimate is compared with that of rotations that are
    only noise. It is compared for the depths, which drift does not affect, and for the path, which cameras with little
    of the surface do not affect; the better determined one counts. The object may hardly have moved: a path as long as
    its size is added to its own.
    """
    state, observations = fit.state, problem.observations
    scaled = connected[observations.frame] * fit.weights
    scaled = scaled / (summary.sigma_px[observations.camera] ** 2 * fit.variance_ratio)
    rng, covariance = np.random.default_rng(0), np.where(connected[:, None, None], summary.covariance, 0.0)
    roots = np.linalg.cholesky(covariance[:, :3, :3] + 1e-18 * np.eye(3))
    right = problem.rotations[0, 0]
    translation = right * np.copysign(problem.radius, right @ (state.translations[-1] - state.translations[0]))
    shifted = state.translations + np.linspace(0.0, 1.0, len(roots))[:, None] * translation
    shifted_state = replace(state, translations=shifted)
    fixed_rotation, draws = state.rotations[problem.first_fixed_frame], max(1, MIN_DRAWS // len(roots))
    noise = np.zeros(2)
    for _ in range(draws):
        noise_rotation = Rotation.from_rotvec(np.einsum("nij,nj->ni", roots, rng.standard_normal((len(roots), 3))))
        rotations = noise_rotation.as_matrix() @ fixed_rotation
        derivatives = state.pose_derivatives * np.repeat([0.0, 1.0], 3)
        noisy_state = replace(shifted_state, rotations=rotations, pose_derivatives=derivatives)
        noise += _compute_information(problem, noisy_state, scaled, connected)
    return float((noise / draws / _compute_information(problem, shifted_state, scaled, connected)).min())


def _compute_information(problem: Problem, state: State, scaled: FloatArray, connected: BoolArray) -> FloatArray:
    """Return (2,) the information on the surfaces' depths, and on the path's length."""
    scale = _scale_information(problem, state, scaled, connected)
    return np.array([_depth_information(problem, state, scaled), scale])


def _scale_information(problem: Problem, state: State, scaled: FloatArray, connected: BoolArray) -> float:
    """Return the information on the path's relative length, without a prior of the surfaces."""
    weak_prior, moving = np.full(2, (LATERAL_SD_RADII * problem.radius) ** -2.0), problem.observations.free_index >= 0
    path = np.where(connected[:, None], state.translations - state.translations[problem.first_fixed_frame], 0.0)[moving]
    solver = problem.build_system(state, problem.linearize(state, scaled)._replace(prior=weak_prior)).factorize()
    return float((path**2).sum()) ** 2 / solver.pattern_variance(np.hstack([np.zeros_like(path), path]))


def _depth_information(problem: Problem, state: State, scaled: FloatArray) -> float:
    """Return the information on the surfaces' relative distance, averaged over the landmarks, without a prior of it."""
    fixed_problem, is_depth = problem.fix_depths(), problem.camera_parameters.depth_mask
    observations = problem.observations
    information = fixed_problem.build_system(state, fixed_problem.linearize(state, scaled)).factorize().information
    cross, other = information[np.ix_(is_depth, ~is_depth)], information[np.ix_(~is_depth, ~is_depth)]
    absorbed = cross @ np.linalg.solve(other + np.eye(len(other)), cross.T)
    own = information[np.ix_(is_depth, is_depth)] - absorbed
    spread = problem.camera_parameters.basis[:, DEPTH][:, is_depth]
    used = np.add.reduceat(scaled, observations.start[:-1]) > 0
    landmarks = np.bincount(observations.first_viewer[used], minlength=len(problem.focals))
    # The landmarks' distance from the surfaces has a small variance, which is removed from that of the surfaces.
    variance = spread @ np.linalg.pinv(own, hermitian=True) @ spread.T
    variance -= np.diag(1.0 / (np.maximum(landmarks, 1) * fixed_problem.landmark_prior[0]))
    mean = landmarks / landmarks.sum() / np.linalg.norm(problem.centers - state.translations[0], axis=1)
    return 1.0 / float(mean @ variance @ mean)


# --- covisibility of frames -------------------------------------------------------------------------------------------


def build_covisibility_pattern(observations: SortedObservations, repeated: BoolArray) -> csr_array:
    """Return (F, F) lower triangle of the covisibility of moving frames."""
    n = int(observations.free_index.max()) + 1
    incidence = _incidence(observations, observations.free_index[observations.frame], n, repeated)
    pattern = csr_array(tril(incidence @ incidence.T + eye_array(n), format="csr"))
    pattern.sort_indices()
    return pattern


def find_connected_frames(observations: SortedObservations, repeated: BoolArray, fixed: BoolArray) -> BoolArray:
    """Return (N,) mask of the frames that landmarks connect to a fixed one."""
    n = len(fixed)
    incidence = _incidence(observations, observations.frame, n, repeated)
    _, part = connected_components(block_array([[None, incidence], [incidence.T, None]]), directed=False)
    return np.asarray(np.isin(part[:n], part[:n][fixed]))


def _incidence(observations: SortedObservations, rows: IntArray, n_rows: int, repeated: BoolArray) -> csr_array:
    """Return (n_rows, m) incidence of rows and landmarks observed at least twice.

    Args:
        rows: (n,) row of each observation, or -1.
    """
    landmark = np.repeat(np.arange(len(repeated)), np.diff(observations.start))
    used = repeated[landmark] & (rows >= 0)
    entries = (np.ones(int(used.sum())), (rows[used], landmark[used]))
    return coo_array(entries, shape=(n_rows, len(repeated))).tocsr()
