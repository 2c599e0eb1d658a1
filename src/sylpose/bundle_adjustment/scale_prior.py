"""Bundle adjustment for small rotations: from two starts, and with a scale prior from the object's shape.

A small rotation and a translation look much alike, with different relief of the surface (the bas-relief ambiguity).
From the tracker's poses, the refinement may not reach the other solution, and noise may prefer the wrong one. So it
also starts without rotation. The better solution is used; if it is not much better, their difference is added to the
covariance.

A robust refinement does not recover from a start far from the truth: it treats the observations that disagree as
outliers. If the object has turned once around, the tracker's drift is such a disagreement, and the path breaks where
the fewest observations connect it. So a frame that a refinement lost is relocalized: its landmarks are known from
other frames, and its pose can be estimated independently (`absolute_pose`). If the path still breaks, or it does not
converge, it starts again with graduated weights (`BundleOptions.rough_px`). The better solution is used.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.bundle_adjustment.bundle import (
    DEFAULT_OPTIONS,
    ROUGH_PX,
    BundleOptions,
    BundleResult,
    Observations,
    bundle_adjust,
    resolve_fixed_frames,
)
from sylpose.bundle_adjustment.camera_parameters import MEAN_DEPTH_RADII, compute_depth_basis
from sylpose.bundle_adjustment.covariance_inflation import add_second_order_terms
from sylpose.bundle_adjustment.problem import CUTOFF_SIGMAS
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.robust_loss import biquartic_losses
from sylpose.landmarks.support_size import compute_extent, estimate_size
from sylpose.rig import Rig
from sylpose.status import Status

# A relative standard deviation of the length below this is sufficient (choice).
MAX_SCALE_SD = 0.005
# Otherwise it is unobservable if it makes up this fraction of the translations' variance (choice).
MIN_SCALE_VARIANCE_RATIO = 0.5
# Total rotations below this, radians, may be zero. One start is rejected if it costs so many times as much as the
# other: a wrong one has cost a fifth less than the true one (measured: docs/history/benchmarks.md, "Kinds of scenes").
SMALL_ROTATION, CLEAR_COST_RATIO = 0.3, 1.5
# A start loses a frame if it explains less than this fraction of what the other explains of it: that frame may be the
# only one that determines the surface, and all the others agree better without it (choice).
LOST_INLIER_RATIO = 0.7
# Standard deviation of each camera's surface depth in addition to the size, in radii (choice).
OWN_DEPTH_SD_RADII = 0.1
# A frame is lost if at most this fraction of its observations are inliers and it has at least so many (choice).
MAX_INLIER_RATIO, MIN_OBSERVATIONS = 0.5, 12


def is_scale_unobservable(result: BundleResult) -> bool:
    """Return whether the path's length is not observable and follows from the prior on the object."""
    return bool(MAX_SCALE_SD < result.scale_sd < np.inf and result.scale_variance_ratio > MIN_SCALE_VARIANCE_RATIO)


def bundle_adjust_with_scale(
    rig: Rig,
    observations: Observations,
    world_from_object: RigidTransform,
    radius: float,
    options: BundleOptions = DEFAULT_OPTIONS,
) -> BundleResult:
    """Run `bundle_adjust`, with a scale prior if the path's length is not observable.

    The prior is on the depths: all cameras observe one body.

    Args:
        rig, observations, world_from_object, radius, options: as of `bundle_adjust`.
    """
    result, alternative_covariance = _bundle_from_two_starts(rig, observations, world_from_object, radius, options)
    result = recover(rig, observations, world_from_object, result, radius, options)
    depth_prior = None
    if len(rig) > 1 and is_scale_unobservable(result):
        depth_prior = _estimate_depth_prior(rig, observations, result, radius)
    if depth_prior is not None:
        new_options = replace(options, landmarks=result.landmarks, depth_prior=depth_prior)
        result = bundle_adjust(rig, observations, result.world_from_object, radius, new_options)
    difference = add_second_order_terms(alternative_covariance, result.surface_covariance)
    return replace(result, covariance=result.covariance + difference)


def _bundle_from_two_starts(
    rig: Rig, observations: Observations, world_from_object: RigidTransform, radius: float, options: BundleOptions
) -> tuple[BundleResult, FloatArray]:
    """Run `bundle_adjust` from the given poses and, if they rotate little, without rotation.

    A start without rotation contains no information on the surfaces.

    Returns:
        the solution of lower cost, and the squared difference (N, 6, 6) of (w, d) from the other, where it is nearly as
        good.
    """
    result = bundle_adjust(rig, observations, world_from_object, radius, options)
    first, no_difference = world_from_object.rotation[0], np.zeros_like(result.covariance)
    if (world_from_object.rotation * first.inv()).magnitude().max() > SMALL_ROTATION:
        return result, no_difference
    static_start = RigidTransform.from_components(world_from_object.translation, first)
    static_options = replace(options, landmarks=None, fix_depths=True)
    static_result = bundle_adjust(rig, observations, static_start, radius, static_options)
    repeated = find_repeated_observations(observations)
    if has_lost_frame(static_result, result, observations, repeated):
        return result, no_difference
    costs = _compute_costs(result, static_result, observations, repeated)
    best, second = result, static_result
    if costs[1] < costs[0]:
        best = _restart(rig, observations, static_result, static_result.world_from_object, radius, options)
        second = result
        if has_lost_frame(best, result, observations, repeated):
            return result, no_difference
    if max(costs) > CLEAR_COST_RATIO * min(costs):
        return best, no_difference
    rotation = (second.world_from_object.rotation * best.world_from_object.rotation.inv()).as_rotvec()
    difference = np.hstack([rotation, second.world_from_object.translation - best.world_from_object.translation])
    return best, difference[:, :, None] * difference[:, None, :]


def _is_better(result: BundleResult, other: BundleResult, observations: Observations) -> bool:
    """Return whether one result explains more of the observations than another, without losing a frame for it.

    One that did not converge is not better than one that did.
    """
    if other.status is Status.OK and result.status is not Status.OK:
        return False
    repeated = find_repeated_observations(observations)
    costs = _compute_costs(result, other, observations, repeated)
    return costs[0] < costs[1] and not has_lost_frame(result, other, observations, repeated)


def _compute_costs(
    first: BundleResult, second: BundleResult, observations: Observations, mask: BoolArray
) -> list[float]:
    """Return the costs of two refinements on the counted observations (n,), with equal noise."""
    cutoff = (CUTOFF_SIGMAS * np.fmin(first.sigma_px, second.sigma_px)[observations.camera[mask]]) ** 2
    return [float(biquartic_losses((b.residuals[mask] ** 2).sum(axis=1) / cutoff).sum()) for b in (first, second)]


def has_lost_frame(result: BundleResult, other: BundleResult, observations: Observations, repeated: BoolArray) -> bool:
    """Return whether one result loses a frame of which the other explains most counted observations (n,)."""
    inliers, totals = count_inliers(result, observations, repeated)
    other_inliers, _ = count_inliers(other, observations, repeated)
    return bool(((2 * other_inliers > totals) & (inliers < LOST_INLIER_RATIO * other_inliers)).any())


def _estimate_depth_prior(
    rig: Rig, observations: Observations, result: BundleResult, radius: float
) -> tuple[FloatArray, FloatArray] | None:
    """Return mean (C,) and covariance (C, C) of a depth prior from the body's shape; None if uninformative."""
    first = result.world_from_object[0]
    counts = np.bincount(observations.landmark[result.weights > 0], minlength=len(result.landmarks))
    camera = np.zeros(len(result.landmarks), np.int64)
    camera[observations.landmark] = observations.camera
    centers = first.inv().apply(np.array([c.center for c in rig])).reshape(-1, 3)
    of_cameras = [result.landmarks[(camera == c) & (counts >= 2)] for c in range(len(rig))]
    extents = [compute_extent(landmarks, o) for landmarks, o in zip(of_cameras, centers, strict=True)]
    relative_size, sd = estimate_size(extents, radius)
    if not np.isfinite(sd):
        return None
    axes = [c.rotation[:2] @ first.rotation.as_matrix() for c in rig]
    depths = [_estimate_surface_depth(*arguments, radius) for arguments in zip(of_cameras, centers, axes, strict=True)]
    distances = np.linalg.norm(centers, axis=1)
    covariance = sd**2 * np.outer(distances, distances) + (OWN_DEPTH_SD_RADII * radius) ** 2 * np.eye(len(rig))
    return np.array(depths) - relative_size * distances, covariance


def _estimate_surface_depth(points: FloatArray, center: FloatArray, axes: FloatArray, radius: float) -> float:
    """Return the depth at which the plane of a camera's landmarks (n, 3) crosses its viewing ray through the origin.

    Without landmarks, return the default depth.

    Args:
        center: (3,) of the camera, object's frame.
        axes: (2, 3) its x and y axis, object's frame.
    """
    n = len(points)
    if not n:
        return MEAN_DEPTH_RADII * radius
    directions, basis = compute_depth_basis(points, np.tile(center, (n, 1)), np.tile(axes, (n, 1, 1)), radius)
    return float(np.linalg.lstsq(basis, np.einsum("ni,ni->n", points, directions), rcond=None)[0][0])


# --- lost frames ------------------------------------------------------------------------------------------------------


def find_repeated_observations(observations: Observations) -> BoolArray:
    """Return (n,) mask of the informative observations: those of landmarks observed more than once."""
    return np.asarray(np.bincount(observations.landmark)[observations.landmark] > 1)


def count_inliers(result: BundleResult, observations: Observations, repeated: BoolArray) -> tuple[IntArray, IntArray]:
    """Return for each frame (N,) the number of counted observations (n,) that are inliers, and their total number."""
    frames = len(result.covariance)
    inliers = np.bincount(observations.frame[repeated & (result.weights > 0)], minlength=frames)
    return inliers, np.bincount(observations.frame[repeated], minlength=frames)


def find_lost_frames(result: BundleResult, observations: Observations) -> BoolArray:
    """Return (N,) mask of the lost frames."""
    inliers, totals = count_inliers(result, observations, find_repeated_observations(observations))
    return np.asarray((totals >= MIN_OBSERVATIONS) & (inliers <= MAX_INLIER_RATIO * totals))


def has_break(result: BundleResult, observations: Observations, fixed: BoolArray) -> bool:
    """Return whether the observations that connect two successive frames are mostly outliers.

    Args:
        fixed: (N,) fixed frames; what connects two of these does not count.
    """
    earlier, later = observations.pair_successive()
    frame = observations.frame[later]
    counts = ~(fixed[frame - 1] & fixed[frame])
    is_inlier = counts & (np.minimum(result.weights[earlier], result.weights[later]) > 0)
    totals, inliers = np.bincount(frame, counts), np.bincount(frame, is_inlier)
    return bool(((totals >= MIN_OBSERVATIONS) & (inliers <= MAX_INLIER_RATIO * totals)).any())


def recover(
    rig: Rig,
    observations: Observations,
    world_from_object: RigidTransform,
    result: BundleResult,
    radius: float,
    options: BundleOptions,
) -> BundleResult:
    """Return a result; if it lost frames, did not converge or has a break, the best one of it and of other starts.

    Args:
        rig, observations, world_from_object, radius, options: as of `bundle_adjust`. With `options.coarse`, lost frames are
            relocalized only, as time is short.
    """
    fixed = resolve_fixed_frames(options.fixed, len(result.covariance))
    poses = relocalize_lost_frames(rig, observations, result, fixed)
    if poses is not None:
        alternative = _restart(rig, observations, result, poses, radius, options)
        result = alternative if _is_better(alternative, result, observations) else result
    if not options.coarse and (result.status is Status.NOT_CONVERGED or has_break(result, observations, fixed)):
        rough_options = replace(options, recalibrate=False, rough_px=ROUGH_PX)
        alternative = bundle_adjust(rig, observations, world_from_object, radius, rough_options)
        if options.recalibrate:
            alternative = _restart(rig, observations, alternative, alternative.world_from_object, radius, options)
        result = alternative if _is_better(alternative, result, observations) else result
    return result


def _restart(
    rig: Rig,
    observations: Observations,
    result: BundleResult,
    poses: RigidTransform,
    radius: float,
    options: BundleOptions,
) -> BundleResult:
    """Run `bundle_adjust` from poses and the landmarks of a result."""
    return bundle_adjust(rig, observations, poses, radius, replace(options, landmarks=result.landmarks))


def relocalize_lost_frames(
    rig: Rig, observations: Observations, result: BundleResult, fixed_mask: BoolArray
) -> RigidTransform | None:
    """Return the poses (N,) with lost frames relocalized by the landmarks; None if none succeeds.

    Args:
        fixed_mask: (N,) fixed frames.
    """
    lost = find_lost_frames(result, observations)
    # Landmarks supported by observations in other frames.
    is_support = (result.weights > 0) & ~lost[observations.frame]
    supported = np.bincount(observations.landmark, is_support, minlength=len(result.landmarks)) > 1
    poses, has_new_pose = list(result.world_from_object), False
    for k in np.flatnonzero(lost & ~fixed_mask).tolist():
        camera_indices = [
            np.flatnonzero((observations.frame == k) & (observations.camera == c) & supported[observations.landmark])
            for c in range(len(rig))
        ]
        points = [result.landmarks[observations.landmark[own]] for own in camera_indices]
        pixels = [camera.denormalize(observations.image[own]) for camera, own in zip(rig, camera_indices, strict=True)]
        estimate = estimate_pose(rig, points, pixels)
        if estimate.status is Status.OK and estimate.motion is not None:
            poses[k], has_new_pose = estimate.motion, True
    return RigidTransform.concatenate(poses) if has_new_pose else None
