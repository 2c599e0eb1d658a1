"""Bundle adjustment of a trajectory: all poses, all landmarks, and per-camera parameters.

The per-camera parameters are the depth of the observed surface in front of the object's origin and, on request, the
time offset.

Robust least squares on reprojection errors with static, calibrated cameras: a landmark X of the object is observed by
camera c in frame k at project(Q_c (R_k X + t_k - o_c)). Levenberg-Marquardt with re-weighting; the landmarks are
eliminated (Schur complement), which leaves six unknowns per frame and a border of shared parameters.

Source: B. Triggs, P. McLauchlan, R. Hartley, A. Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.calibration_refinement import (
    NEAR_EXACT_SCALES,
    CalibrationCorrection,
    CalibrationPrior,
    add_calibration_errors,
    make_correction,
    rescale_calibration_prior,
)
from sylpose.bundle_adjustment.camera_parameters import compute_depth_basis, default_depth_prior, make_camera_parameters
from sylpose.bundle_adjustment.covisibility import build_covisibility_pattern, find_connected_frames
from sylpose.bundle_adjustment.kernels import TIME_OFFSET, SortedObservations
from sylpose.bundle_adjustment.optimizer import minimize, refine_with_calibration
from sylpose.bundle_adjustment.problem import Fit, Problem, State
from sylpose.bundle_adjustment.scale_observability import is_scale_from_noise
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.results import Status
from sylpose.rig import Rig

__all__ = ["BundleResult", "Observations", "bundle_adjust", "resolve_fixed_frames"]


# Weak prior of every pose: half a revolution and several radii around its start, which keeps unconstrained poses there
# (choice).
WEAK_ROTATION_SD, WEAK_TRANSLATION_RADII = np.pi, 10.0


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


@dataclass(frozen=True, eq=False)
class BundleResult:
    """Refined trajectory.

    Attributes:
        status: OK; NOT_CONVERGED within the maximum number of iterations; TOO_FEW_MATCHES when no frame is connected to
            a fixed one: then the poses are those given.
        world_from_object: N poses.
        landmarks: (M, 3) object's frame; those observed less than twice are as given, or on their ray, or at the
            origin.
        covariance: (N, 6, 6) of (w, d), docs/conventions.md, relative to the fixed frames, where it is zero.
        connected: (N,) frames connected to a fixed frame by landmarks, directly or through others. Others keep
            approximately the poses given, with a covariance as wide as the object's size and half a revolution.
        sigma_px: (C,) noise of each camera, pixels, of one coordinate; NaN for a camera without observations.
        weights: (n,) in [0, 1], 0 for outliers and for landmarks observed less than twice.
        residuals: (n,) pixels; 1e6 behind a camera.
        offsets: (C,) time offset of each camera, seconds, positive for a delay; their mean is 0. Zeros when not
            requested.
        offsets_sd: (C,) their standard deviations, close to the prior's where the motion does not constrain them.
        iterations: iterations of Levenberg-Marquardt.
        variance_inflation: (N,) variance inflation relative to independent noise of sigma_px, at least 1: errors are
            correlated along tracks, and by calibration errors (`covariance_inflation`).
        scale_sd: relative standard deviation of the path's length: of a common factor of all translations of the
            object's origin, which a motion without rotation does not determine. inf without any translation.
        scale_variance_ratio: in [0, 1], its fraction of the variance of all translations.
        correction: of the calibration, if requested.
        calibration_scales: (4,) 1, then the estimated size of calibration errors relative to their prior, for the
            cameras' rotations, translations and lenses; 1 without a calibration prior.
        surface_covariance: (N, 3, 3) covariance of the mean position of the observed surface relative to the object's
            origin (`add_second_order_terms`).
    """

    status: Status
    world_from_object: RigidTransform
    landmarks: FloatArray
    covariance: FloatArray
    connected: BoolArray
    sigma_px: FloatArray
    weights: FloatArray
    residuals: FloatArray
    offsets: FloatArray
    offsets_sd: FloatArray
    iterations: int
    variance_inflation: FloatArray
    scale_sd: float
    scale_variance_ratio: float
    correction: CalibrationCorrection | None
    calibration_scales: FloatArray
    surface_covariance: FloatArray


def bundle_adjust(
    rig: Rig,
    observations: Observations,
    world_from_object: RigidTransform,
    radius: float,
    *,
    landmarks: ArrayLike | None = None,
    fixed: ArrayLike | None = None,
    prior_information: ArrayLike | None = None,
    times: ArrayLike | None = None,
    offsets_sd: float | None = None,
    depth_prior: tuple[ArrayLike, ArrayLike] | None = None,
    fix_depths: bool = False,
    calibration_prior: CalibrationPrior | None = None,
    recalibrate: bool = False,
    max_iterations: int = 30,
    coarse: bool = False,
    on_iteration: Callable[[int], None] | None = None,
) -> BundleResult:
    """Refine poses and landmarks jointly by minimizing the reprojection error.

    Args:
        rig: C cameras.
        observations: n observations; landmarks shared by cameras or observed again later constrain more, but are not
            required.
        world_from_object: N initial poses.
        radius: of the object.
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
            recording shows; None: no errors. The poses of cameras that were moved are always estimated.
        recalibrate: estimate the calibration errors, instead of only including them in the covariance.
        max_iterations: maximum number of iterations.
        coarse: stop a seventh of a standard deviation per frame before the optimum, after half of the iterations; not
            for `recalibrate`.
        on_iteration: called with the number of each iteration as it begins.

    Returns:
        the refined trajectory.

    Raises:
        ValueError: inconsistent shapes or indices, values that are not finite, no fixed frame, times that do not
            increase.
    """
    n_frames, n_cameras = (1 if world_from_object.single else len(world_from_object)), len(rig)
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius: {radius} is not a positive length")
    if offsets_sd is not None and not (np.isfinite(offsets_sd) and offsets_sd > 0):
        raise ValueError(f"offsets_sd: {offsets_sd} is not a positive time")
    fixed_mask = resolve_fixed_frames(fixed, n_frames)
    pose_information = (
        np.zeros((n_frames, 6, 6))
        if prior_information is None
        else _to_finite_array("prior_information", prior_information, (n_frames, 6, 6))
    )
    initial_landmarks = None if landmarks is None else _to_finite_array("landmarks", landmarks, (-1, 3))
    n_landmarks = (
        int(np.max(observations.landmark, initial=-1)) + 1 if initial_landmarks is None else len(initial_landmarks)
    )
    _check_observations(observations, n_frames, n_cameras, n_landmarks)
    camera_times = np.arange(n_frames) if times is None else np.asarray(times, float)
    camera_times = _to_finite_array(
        "times", camera_times, (n_frames, n_cameras) if camera_times.ndim == 2 else (n_frames,)
    )
    camera_times = camera_times if camera_times.ndim == 2 else np.repeat(camera_times[:, None], n_cameras, axis=1)
    frame_times = camera_times.mean(axis=1)
    if (np.diff(frame_times) <= 0).any():
        raise ValueError("times: must increase from frame to frame")

    rotations, translations = np.atleast_3d(world_from_object.rotation.as_matrix()), world_from_object.translation
    rotations, translations = rotations.reshape(-1, 3, 3), translations.reshape(-1, 3)
    order, landmark_indices, sorted_observations = _sort_observations(observations, fixed_mask)
    repeated = np.diff(sorted_observations.start) >= 2
    connected = find_connected_frames(sorted_observations, repeated, fixed_mask | pose_information.any(axis=(1, 2)))
    depth, depth_covariance = default_depth_prior(radius, n_cameras) if depth_prior is None else depth_prior
    camera_parameters = make_camera_parameters(
        n_cameras,
        offsets_sd,
        np.unique(sorted_observations.camera),
        _to_finite_array("depth_prior: mean", depth, (n_cameras,)),
        _to_finite_array("depth_prior: covariance", depth_covariance, (n_cameras, n_cameras)),
    )
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
    state = State(
        rotations,
        translations,
        np.zeros((len(landmark_indices), 3)),
        np.zeros(camera_parameters.basis.shape[2]),
        np.zeros((n_frames, 2, 6)),
    )
    state = problem.update_derivatives(state)
    state = replace(
        state, points=problem.triangulate(state) if initial_landmarks is None else initial_landmarks[landmark_indices]
    )
    problem = _add_depth_basis(problem, state)
    has_moved_cameras = calibration_prior is not None and bool((calibration_prior.predecessor >= 0).any())
    if calibration_prior is not None and has_moved_cameras:
        # The poses of moved cameras must be free from the first iteration: otherwise all poses would diverge.
        problem, state = rescale_calibration_prior(
            *add_calibration_errors(problem, state, rig, calibration_prior), NEAR_EXACT_SCALES
        )
    if fix_depths:
        problem = problem.fix_depths()
    if (connected & ~fixed_mask).any():
        fit = minimize(problem, state, max_iterations, on_iteration, coarse=coarse)
    else:
        unknown, e = np.zeros(len(observations)), problem.compute_residuals(state)
        sigma = problem.estimate_noise(e, unknown)
        fit = Fit(state, Status.TOO_FEW_MATCHES, 0, problem.compute_weights(e, sigma), sigma, unknown)
    summary = problem.summarize(fit, connected)
    if not fix_depths and (connected & ~fixed_mask).any() and is_scale_from_noise(problem, fit, summary, connected):
        problem = problem.fix_depths()
        state = replace(fit.state, z=np.where(problem.camera_parameters.depth_mask, 0.0, fit.state.z))
        fit = minimize(problem, state, max_iterations, on_iteration, coarse=coarse)
        summary = problem.summarize(fit, connected)
    if calibration_prior is not None:
        problem, state = (
            rescale_calibration_prior(problem, fit.state, np.ones(4))
            if has_moved_cameras
            else add_calibration_errors(problem, fit.state, rig, calibration_prior)
        )
        fit = replace(fit, state=state)
        if recalibrate and (connected & ~fixed_mask).any():
            problem, fit, summary = refine_with_calibration(
                problem, fit, rig, sorted_observations.image, connected, max_iterations, on_iteration
            )
        else:
            summary = problem.summarize(fit, connected)
    state, camera_parameters = fit.state, problem.camera_parameters
    correction = (
        make_correction(camera_parameters, rig, calibration_prior.predecessor, state.z, summary.parameter_covariance)
        if calibration_prior is not None
        else None
    )

    points = np.zeros((n_landmarks, 3)) if initial_landmarks is None else initial_landmarks.copy()
    points[landmark_indices] = state.points
    weights, distances = np.empty(len(observations)), np.empty(len(observations))
    weights[order], distances[order] = fit.weights, np.linalg.norm(problem.compute_residuals(state), axis=1)
    has_time_offsets = offsets_sd is not None
    unused_cameras = np.setdiff1d(np.arange(n_cameras), observations.camera)
    summary.sigma[unused_cameras] = np.nan
    spread = np.sqrt(
        np.einsum(
            "ck,kl,cl->c",
            camera_parameters.basis[:, TIME_OFFSET],
            summary.parameter_covariance,
            camera_parameters.basis[:, TIME_OFFSET],
        )
    )
    if has_time_offsets:
        spread[unused_cameras] = offsets_sd
    return BundleResult(
        fit.status,
        RigidTransform.from_components(state.translations, Rotation.from_matrix(state.rotations)),
        points,
        summary.covariance,
        connected,
        summary.sigma,
        weights,
        distances,
        camera_parameters.evaluate(state.z)[:, TIME_OFFSET],
        spread,
        fit.iterations,
        summary.variance_inflation,
        summary.scale_sd,
        summary.scale_variance_ratio,
        correction if recalibrate else None,
        summary.calibration_scales,
        summary.surface_covariance,
    )


def _to_finite_array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return the values as a finite array of a shape, in which -1 matches any size."""
    array = np.asarray(values, dtype=float)
    if array.ndim != len(shape) or any(
        size not in (-1, actual) for size, actual in zip(shape, array.shape, strict=True)
    ):
        expected = ", ".join("any" if n < 0 else str(n) for n in shape)
        raise ValueError(f"{name}: shape {array.shape}, expected ({expected})")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: has values that are not finite")
    return array


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
    _to_finite_array("observations: image", observations.image, (n, 2))


def _sort_observations(
    observations: Observations, fixed_mask: BoolArray
) -> tuple[IntArray, IntArray, SortedObservations]:
    """Sort observations by landmark.

    Returns:
        order of the observations (n,), indices of the observed landmarks (m,), and the sorted observations, without
        depth basis.
    """
    order = np.lexsort((observations.camera, observations.frame, observations.landmark))
    landmark_indices, counts = np.unique(observations.landmark, return_counts=True)
    free = np.where(fixed_mask, -1, np.cumsum(~fixed_mask) - 1).astype(np.int64)
    frame, camera = (np.asarray(index[order], np.int64) for index in (observations.frame, observations.camera))
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    image, lens = np.ascontiguousarray(observations.image[order], dtype=float), np.zeros((len(order), 3, 0))
    nothing = np.zeros((len(landmark_indices), 3))
    return (
        order,
        landmark_indices,
        SortedObservations(start, frame, camera, image, lens, free, camera[start[:-1]], nothing, nothing),
    )


def _add_depth_basis(problem: Problem, state: State) -> Problem:
    """Add each landmark's direction to its first viewer and its lateral position at that time."""
    observations = problem.observations
    k, viewer = observations.frame[observations.start[:-1]], observations.first_viewer
    object_from_world = state.rotations[k].transpose(0, 2, 1)
    centers = np.einsum("mij,mj->mi", object_from_world, problem.centers[viewer] - state.translations[k])
    axes = np.einsum("mij,mkj->mki", object_from_world, problem.rotations[viewer][:, :2])
    directions, lateral = compute_depth_basis(state.points, centers, axes, problem.radius)
    return replace(problem, observations=observations._replace(depth_direction=directions, depth_basis=lateral))
