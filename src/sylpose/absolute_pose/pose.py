"""`estimate_pose`: an object's pose from known points observed by any of several cameras.

Samples of three matches give starts of the search, whose best robust fits remain. Tests decide whether a pose may be due
to chance, and whether other cameras contradict it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from math import lgamma
from statistics import median

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose import pose_kernels as kernels
from sylpose.absolute_pose.pose_kernels import ModelPose, Pose, Views
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import invert_information
from sylpose.geometry.normal_equations import (
    UNOBSERVABLE_RATIO,
    UNOBSERVABLE_ROTATION_SD,
    find_unobservable_directions,
    has_rotation_direction,
)
from sylpose.geometry.numba_linalg import find_distinct_rows, symmetric_eigen
from sylpose.geometry.robust_loss import BIQUARTIC_BOUND, DEFAULT_NOISE_PX, NoisePx, NoiseUnits, make_noise_units
from sylpose.geometry.validation import check_finite_rows, check_integer, check_number, check_sequence, check_type
from sylpose.results import FramePose, Motion
from sylpose.rig import MAX_FOCAL_PX, MAX_LENGTH, Camera, Rig
from sylpose.status import FrameStatus, Observability, Status

MIN_ERROR_PX = 1e-9  # smallest error bound accepted, pixels (choice)
# Degrees of freedom of the noise prior. Default noise: four matches, which leave two, may agree far better than they
# were measured. Given noise: known to an eighth of its size (choice).
DEFAULT_NOISE_FREEDOM, KNOWN_NOISE_FREEDOM = 2.0, 30.0
# Smaller size ratios are errors of the calibration or the model, not another unit (choice).
MIN_SIZE_RATIO = 1.2
# Odds from which the better of two similar poses is accepted (measured: of flat models of 4 to 20 points with one
# camera and status OK, 1 in 250 is the mirror image; with odds of 3, 1 in 20) (choice).
CLEAR_ODDS = 20.0
# Name of the estimator in its results.
METHOD = "pose"
_STATUS = {
    Status.OK: FrameStatus.LOCALIZED,
    Status.SCALE_NOT_OBSERVABLE: FrameStatus.LOCALIZED,
    Status.TOO_FEW_MATCHES: FrameStatus.TOO_FEW_MATCHES,
    Status.ROTATION_NOT_OBSERVABLE: FrameStatus.ROTATION_NOT_OBSERVABLE,
}
# Three matches have several exact poses; the fourth decides (derived).
MIN_MATCHES = 4
# Maximum number of matches used in the search, evenly from the cameras (choice).
MAX_SEARCH_MATCHES = 500
# Poses kept, and iterations of re-weighting (choice).
N_KEPT, MAX_ITERATIONS = 6, 50
# A start is discarded if its score exceeds the best by this factor and this number of matches (choice).
MAX_SCORE_RATIO, MAX_SCORE_EXCESS = 2.0, 3.0
# A pose is due to chance if random matches give one as good with a higher expected number (choice).
MAX_FALSE_ALARMS = 0.01
# A camera supports a pose if this fraction of its matches are inliers (choice: a majority).
MIN_INLIER_RATIO = 0.5


def estimate_pose(
    rig: Rig,
    points: Sequence[ArrayLike],
    pixels: Sequence[ArrayLike],
    *,
    max_error_px: float = 12.0,
    noise_px: NoisePx | None = None,
    seed: int = 0,
) -> Motion:
    """Estimate the pose of an object with known points: solvePnP for many cameras.

    The points may be observed by any subset of the cameras.

    Args:
        rig: C cameras.
        points: C arrays (n_c, 3), the points that each camera observes, in the object's frame; empty without
            observations.
        pixels: C arrays (n_c, 2), their pixels in the image as recorded (with lens distortion). A match given several
            times counts once.
        max_error_px: matches with a larger error are outliers, whatever the noise; set it to five times the largest
            noise to be expected.
        noise_px: (C,) known noise of each camera, the standard deviation of a coordinate, pixels; or a mapping from
            camera names. Cameras are weighted accordingly. `max_error_px` then applies to the camera with the least
            noise and is scaled for the others. A larger noise in the matches takes precedence. Infinite: the camera is
            ignored. None: estimated from the matches alone.
        seed: of the search. The same input and seed give the same result.

    Returns:
        `Motion` with `motion` world_from_object; check its `status` first. `center` is the mean of all given points,
        without copies and ignored cameras, in the object's frame: `motion.apply(center)` is its position in the world,
        and the covariance is of (w, d) with d the error of that position. `residuals` are reprojection errors.
        Fewer than four different matches give TOO_FEW_MATCHES; points on one line ROTATION_NOT_OBSERVABLE; a position
        less certain than half of its distance from the cameras SCALE_NOT_OBSERVABLE. Matches that agree no better than
        random ones, or as many cameras that support another pose, give NOT_CONSISTENT. If the cameras would agree on
        points of another size, as of another unit, `faults` reports it.

    Raises:
        ValueError: not one array per camera; incompatible shapes; values that are not finite, naming the camera; a
            max_error_px that is not positive; noise for other cameras or out of range.

    Source: docs/method/3-pose.md, "A known model".
    """
    n = len(check_type(rig, Rig, "rig"))
    points, pixels = check_sequence(points, "points", n), check_sequence(pixels, "pixels", n)
    max_error_px = check_number(max_error_px, "max_error_px", above=0.0, minimum=MIN_ERROR_PX, maximum=MAX_FOCAL_PX)
    seed = check_integer(seed, "seed")
    units = NoiseUnits(np.ones(n), 0.0) if noise_px is None else make_noise_units(noise_px, rig.names)
    models = _check_arrays(rig, points, 3, "points", MAX_LENGTH)
    pixel_arrays = _check_arrays(rig, pixels, 2, "pixels", MAX_FOCAL_PX)
    for name, x, u in zip(rig.names, models, pixel_arrays, strict=True):
        if len(x) != len(u):
            raise ValueError(f"camera {name}: {len(x)} points but {len(u)} pixels; give one pixel per point")
    counts = np.array([len(x) for x in models])
    camera, model, image = np.repeat(np.arange(n), counts), np.concatenate(models), np.concatenate(pixel_arrays)
    # Only a match of the same camera is a copy.
    unique = find_distinct_rows(model, np.concatenate([camera[:, None], image], axis=1))
    rows = np.arange(len(model)) if unique is None else unique.rows
    kept = rows[units.per_px[camera[rows]] > 0.0]
    result = _estimate(rig, model[kept], image[kept], camera[kept], max_error_px, units, seed)
    is_inlier = np.zeros(len(model), bool)
    is_inlier[kept] = result.inliers[0]
    if unique is not None:
        is_inlier = is_inlier[unique.rows][unique.inverse]
    ends = [0, *np.cumsum(counts).tolist()]
    return replace(result, inliers=tuple(is_inlier[begin:end] for begin, end in pairwise(ends)))


def _check_arrays(rig: Rig, arrays: Sequence[ArrayLike], width: int, name: str, maximum: float) -> list[FloatArray]:
    """Return each camera's array (n, width), checked; it may be the caller's."""
    # Usually one check is enough for all of them; where it fails, those of single cameras name the culprit.
    plain = [a for a in arrays if type(a) is np.ndarray and a.dtype == float and a.flags.c_contiguous]
    plain = [a for a in plain if a.shape[1:] == (width,)]
    if len(plain) == len(rig) and np.abs(np.concatenate(plain)).max(initial=0.0) <= maximum:
        return plain
    named = [(f"camera {camera.name}: {name}", array) for camera, array in zip(rig, arrays, strict=True)]
    return [check_finite_rows(array, width, label, maximum=maximum) for label, array in named]


def _estimate(
    rig: Rig, model: FloatArray, pixels: FloatArray, camera: IntArray, max_px: float, units: NoiseUnits, seed: int
) -> Motion:
    """Run `estimate_pose` on checked matches of used cameras, sorted by camera and without copies.

    Returns:
        the result, with one mask of inliers for all cameras.
    """
    center = model.mean(axis=0) if len(model) else np.full(3, np.nan)
    if not _has_enough_matches(model, camera):
        return _make_empty_result(rig, len(model), Status.TOO_FEW_MATCHES, center)
    origin, views = _make_views(rig, camera, model - center, pixels, units)
    max_square = float(max_px * units.per_px.max()) ** 2
    extent, axes = np.empty(3), np.empty((3, 3))
    symmetric_eigen(views.points.T @ views.points / len(model), extent, axes)
    if not extent[1] > 1e-12 * extent[2]:
        empty = _make_empty_result(rig, len(model), Status.ROTATION_NOT_OBSERVABLE, center)
        return replace(empty, unobservable=np.eye(6))
    poses = search_poses(views, max_square, axes[:, 0], np.random.default_rng(seed))
    if not poses:
        return _make_empty_result(rig, len(model), Status.NOT_CONSISTENT, center)
    best = poses[0]
    status = Status.OK if best.converged else Status.NOT_CONVERGED
    all_inliers = bool(best.weights.all())
    faults: tuple[str, ...] = ()
    if not all_inliers and is_by_chance(views, best):
        status = Status.NOT_CONSISTENT
    elif not all_inliers and is_contradicted(views, best, max_square, axes[:, 0], seed):
        status = Status.NOT_CONSISTENT
        if (size := _estimate_model_scale(views, max_square, axes[:, 0], seed)) is not None:
            times = np.format_float_positional(size, trim="-")
            faults = (
                f"the points would fit if they were {times} times as large: are they in another unit than the "
                "calibration?",
            )
    pose_information = np.empty((6, 6))
    kernels.compute_information(views, best.model, best.noise, pose_information)
    pose_information *= _information_scale(best, units.sigma)
    unobservable = np.empty((0, 6))
    if status is Status.OK:
        limits = _observability_limits(views, best)
        weak_directions = _find_unobservable(views, poses, pose_information, limits, units.sigma)
        unobservable = weak_directions * limits
        if len(weak_directions):
            is_rotation = has_rotation_direction(weak_directions)
            status = Status.ROTATION_NOT_OBSERVABLE if is_rotation else Status.SCALE_NOT_OBSERVABLE
        elif all_inliers and is_by_chance(views, best):
            status = Status.NOT_CONSISTENT
    is_inlier = best.weights > 0.0
    sums = np.bincount(camera[is_inlier], best.squares[is_inlier], len(rig))
    numbers = np.bincount(camera[is_inlier], minlength=len(rig))
    residuals = np.sqrt(sums / np.maximum(numbers, 1)) / np.where(units.per_px > 0.0, units.per_px, 1.0)
    residuals[numbers == 0] = np.nan
    matrix = np.eye(4)
    matrix[:3, :3] = best.model.rotation
    matrix[:3, 3] = origin + best.model.translation - best.model.rotation @ center
    return Motion(
        status=status,
        motion=RigidTransform(matrix, normalize=False) if status.has_pose else None,
        center=center,
        information=pose_information,
        covariance=invert_information(pose_information),
        unobservable=unobservable,
        inliers=(is_inlier,),
        residuals=residuals,
        method=METHOD,
        iterations=best.iterations,
        faults=faults,
        camera_names=rig.names,
        unit=rig.unit,
    )


def _has_enough_matches(model: FloatArray, camera: IntArray) -> bool:
    """Return whether at least `MIN_MATCHES` different points are observed, each counted once per camera."""
    different = set()
    for k in range(len(model)):
        different.add((camera[k], *model[k]))
        if len(different) == MIN_MATCHES:
            return True
    return False


def _noise_prior(known_noise: float) -> tuple[float, float]:
    """Return the prior noise, pixels, and its degrees of freedom."""
    return (known_noise, KNOWN_NOISE_FREEDOM) if known_noise > 0.0 else (DEFAULT_NOISE_PX, DEFAULT_NOISE_FREEDOM)


def _information_scale(pose: Pose, known_noise: float) -> float:
    """Return the factor of a pose's information for its uncertain noise.

    The covariance becomes that of Student's distribution, and is not reduced by noise below the prior.

    Args:
        known_noise: known noise, pixels, or 0.
    """
    prior_sigma, freedom = _noise_prior(known_noise)
    measured = float(median(pose.noise.variances.tolist()))
    total_freedom = pose.freedom + (freedom if known_noise > 0.0 else 0.0)
    variance_ratio = measured * (pose.freedom + freedom) / (pose.freedom * measured + freedom * prior_sigma**2)
    return max(total_freedom - 2.0, 0.5) / total_freedom * min(variance_ratio, 1.0)


def _observability_limits(views: Views, pose: Pose) -> FloatArray:
    """Return (6,) standard deviations beyond which (w, d) are unobservable: an angle, and half of the distance."""
    positions = views.rotations @ pose.model.translation + views.translations
    distance = float(np.linalg.norm(positions, axis=1).min())
    return np.array([UNOBSERVABLE_ROTATION_SD] * 3 + [UNOBSERVABLE_RATIO * distance] * 3)


def _find_unobservable(
    views: Views, poses: Sequence[Pose], pose_information: FloatArray, limits: FloatArray, known_noise: float
) -> FloatArray:
    """Return the unobservable directions (k, 6) of (w, d), in units of the limits.

    If there is none, return the one to another pose, with a different rotation, that explains the matches about as
    well.
    """
    best = poses[0]
    directions = find_unobservable_directions(pose_information, limits)
    if len(directions) or len(poses) == 1:
        return directions
    noise, freedom = _noise_prior(known_noise)
    max_square = kernels.CUTOFF**2 * float(median(best.noise.variances.tolist()))
    workspace = kernels.make_workspace()
    losses = np.array([kernels.compute_score(views, pose.model, max_square, np.inf, workspace) for pose in poses])
    squares = BIQUARTIC_BOUND * max_square * losses + freedom * noise**2
    for pose, square in zip(poses[1:], squares[1:], strict=True):
        rotvec = Rotation.from_matrix(pose.model.rotation @ best.model.rotation.T).as_rotvec()
        odds = 0.5 * (best.freedom + freedom) * np.log(square / squares[0])
        if np.linalg.norm(rotvec) > UNOBSERVABLE_ROTATION_SD and odds < np.log(CLEAR_ODDS):
            direction = np.concatenate([rotvec, pose.model.translation - best.model.translation])[None] / limits
            return direction / np.linalg.norm(direction)
    return directions


def _make_empty_result(rig: Rig, n_matches: int, status: Status, center: FloatArray) -> Motion:
    """Make a result without pose and information, with one mask of inliers for all cameras."""
    nothing = np.zeros((6, 6))
    return Motion(
        status=status,
        motion=None,
        center=center,
        information=nothing,
        covariance=invert_information(nothing),
        unobservable=np.empty((0, 6)),
        inliers=(np.zeros(n_matches, bool),),
        residuals=np.full(len(rig), np.nan),
        method=METHOD,
        iterations=0,
        camera_names=rig.names,
        unit=rig.unit,
    )


@lru_cache
def _stack_cameras(
    cameras: tuple[Camera, ...],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, tuple[int, ...]]:
    """Stack the constants of cameras, once for all calls with the same cameras, which share the result: do not write.

    Returns:
        the cameras' centroid (3,); rotations and translations (C, 3, 3) and (C, 3) of camera_from_world with this
        origin, so that distant positions lose no digits; focal lengths and principal points (C, 2, 2), pixels; indices
        of the cameras with lens distortion.
    """
    rotations, centers = np.array([c.rotation for c in cameras]), np.array([c.center for c in cameras])
    origin, matrices = centers.mean(axis=0), np.array([c.matrix for c in cameras])
    intrinsics = np.stack([matrices[:, (0, 1), (0, 1)], matrices[:, :2, 2]], axis=1)
    translations = np.einsum("cij,cj->ci", rotations, origin - centers)
    distorted = tuple(k for k, c in enumerate(cameras) if c.lens != "opencv" or c.distortion.any())
    return origin, rotations, translations, intrinsics, distorted


def _make_views(
    rig: Rig, camera: IntArray, model: FloatArray, pixels: FloatArray, units: NoiseUnits
) -> tuple[FloatArray, Views]:
    """Return the origin (3,) of the views' world frame and the views of the cameras with matches.

    `camera` (n,) is each match's camera, ascending.
    """
    counts = np.bincount(camera, minlength=len(rig))
    used = np.flatnonzero(counts)
    cameras, start = tuple(rig.cameras[c] for c in used.tolist()), np.concatenate([[0], np.cumsum(counts[used])])
    origin, rotations, translations, intrinsics, distorted = _stack_cameras(cameras)
    intrinsics = np.repeat(intrinsics, counts[used], axis=0)
    focals = intrinsics[:, 0]
    images, to_pixels = (pixels - intrinsics[:, 1]) / focals, np.zeros((len(model), 4))
    to_pixels[:, ::3] = focals
    for k in distorted:
        part = slice(start[k], start[k + 1])
        images[part], to_pixels[part] = _undistort(cameras[k], pixels[part])
    to_pixels *= units.per_px[camera, None]
    # Pixels that the lens cannot produce are put far outside of every image.
    if not (np.isfinite(images).all() and np.isfinite(to_pixels).all()):
        is_invalid = ~(np.isfinite(images).all(axis=1) & np.isfinite(to_pixels).all(axis=1))
        images[is_invalid], to_pixels[is_invalid] = 1e9, (1.0, 0.0, 0.0, 1.0)
    return origin, Views(model, images, to_pixels, start, rotations, translations, units.sigma**2)


def _undistort(camera: Camera, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return normalized points (n, 2), and (n, 4), row-major, derivatives of the recorded pixel by each."""
    images = camera.normalize(pixels)
    h = 1e-4
    steps = h * np.array([[[1.0, 0.0]], [[-1.0, 0.0]], [[0.0, 1.0]], [[0.0, -1.0]]])
    right, left, down, up = camera.denormalize((images + steps).reshape(-1, 2)).reshape(4, -1, 2)
    d_u, d_v = (right - left) / (2 * h), (down - up) / (2 * h)
    return images, np.stack([d_u[:, 0], d_v[:, 0], d_u[:, 1], d_v[:, 1]], axis=1)


def _estimate_model_scale(views: Views, max_square: float, thin_axis: FloatArray, seed: int) -> float | None:
    """Estimate the factor by which the model must be scaled for cameras to agree on a pose.

    It is that of most cameras, to two digits.

    None where they do not agree then either, or already do. A single camera fits an object of any size in the same
    direction: a model that is s times too small is s times too near to each camera, and scaling these positions by s
    makes them coincide.

    Args:
        max_square: squared distance beyond which a match is an outlier, pixels.
        thin_axis: (3,) the direction in which the model extends least.
    """
    single_poses = list(find_camera_poses(views, max_square, thin_axis, seed))
    if len(single_poses) < 2:
        return None
    cameras = [c for c, _ in single_poses]
    centers = -np.einsum("cij,ci->cj", views.rotations[cameras], views.translations[cameras])
    offsets = np.array([pose.model.translation for _, pose in single_poses]) - centers
    # The size at which center + size * offset is equal for all, by least squares.
    centers, offsets = centers - centers.mean(axis=0), offsets - offsets.mean(axis=0)
    spread = float(np.sum(offsets * offsets))
    size = -float(np.sum(centers * offsets)) / spread if spread > 0.0 else 0.0
    if not np.isfinite(size) or size <= 0.0 or 1.0 / MIN_SIZE_RATIO < size < MIN_SIZE_RATIO:
        return None
    scaled_views = views._replace(points=size * views.points)
    poses = search_poses(scaled_views, max_square, thin_axis, np.random.default_rng(seed))
    if not poses or is_by_chance(scaled_views, poses[0]):
        return None
    is_supporting = count_inliers(scaled_views, poses[0].weights) >= MIN_INLIER_RATIO * np.diff(views.start)
    return float(f"{size:.2g}") if np.count_nonzero(is_supporting[cameras]) > len(cameras) / 2 else None


def make_frame_pose(estimate: Motion, index: int, time: float, matches: IntArray) -> FramePose:
    """Return the pose of one frame, with the covariance about the object's origin.

    Args:
        estimate: result of `estimate_pose`.
        index: of the frame.
        time: seconds.
        matches: (C,) number of points that each camera observes.
    """
    status = _STATUS.get(estimate.status, FrameStatus.NO_CONSISTENT_POSE)
    has_pose = estimate.motion is not None and status.has_pose
    center = RigidTransform.from_translation(np.nan_to_num(estimate.center))
    text = estimate.status.text
    reason = f"{matches.sum()} points observed; {text[0].lower()}{text[1:]}"
    pose = FramePose(
        index,
        time,
        status,
        estimate.motion * center if estimate.motion is not None and has_pose else None,
        estimate.covariance if has_pose else np.full((6, 6), np.nan),
        estimate.n_inliers,
        estimate.residuals,
        Observability.NO_SCALE if estimate.status is Status.SCALE_NOT_OBSERVABLE else Observability.ALL,
        faults=estimate.faults,
        matches=matches,
        reason="" if status.has_pose else reason,
    )
    # Estimated about the points' centroid.
    return pose.in_object_frame(center).mark_uncertain()


# --- search -----------------------------------------------------------------------------------------------------------


def search_poses(views: Views, max_square: float, thin_axis: FloatArray, rng: np.random.Generator) -> list[Pose]:
    """Search for distinct poses, refine them, and fit the best two to all matches; best first.

    Args:
        max_square: squared distance beyond which a match is an outlier.
        thin_axis: (3,) the direction in which the model extends least.
    """
    subset = _select_subset(views, rng)
    rotations, translations, scores = np.zeros((N_KEPT, 3, 3)), np.zeros((N_KEPT, 3)), np.full(N_KEPT + 1, np.inf)
    n_done, n_required = 0, kernels.MIN_SAMPLES
    while n_done < n_required:
        draws = rng.random((min(n_required - n_done, 200), 6))
        n_required = kernels.search_samples(
            subset, draws, n_done, max_square, thin_axis, rotations, translations, scores
        )
        n_done += len(draws)
    if not scores[0] < np.inf:
        return []
    poses: list[Pose] = []
    max_score = MAX_SCORE_RATIO * scores[0] + MAX_SCORE_EXCESS
    for k in range(np.count_nonzero(scores[:N_KEPT] <= max_score)):
        pose = _fit_pose(subset, ModelPose(rotations[k], translations[k]), max_square)
        if pose is not None and not _is_known(poses, pose.model):
            poses.append(pose)
    poses = _sort_by_false_alarms(subset, poses)
    if subset is not views:
        fitted = [_fit_pose(views, pose.model, max_square) for pose in poses[:2]]
        poses = _sort_by_false_alarms(views, [pose for pose in fitted if pose is not None])
    return poses


def count_inliers(views: Views, weights: FloatArray) -> IntArray:
    """Return (C,) number of each camera's matches with a positive weight (n,)."""
    return np.asarray(np.add.reduceat(weights > 0.0, views.start[:-1], dtype=np.int64))


def select_matches(views: Views, mask: BoolArray) -> tuple[Views, BoolArray]:
    """Select some of the matches (n,), at least one, and return the mask of the cameras (C,) that have any of them."""
    start = np.concatenate([[0], np.cumsum(mask)])[views.start]
    has_matches = np.diff(start) > 0
    rotations, translations = views.rotations[has_matches], views.translations[has_matches]
    selected = _take(views, mask, np.append(start[:-1][has_matches], start[-1]))
    return selected._replace(rotations=rotations, translations=translations), has_matches


def _take(views: Views, matches: BoolArray | IntArray, start: IntArray) -> Views:
    """Return the views of some of the matches, with the cameras' new starts."""
    points, images, to_pixels = views.points[matches], views.images[matches], views.to_pixels[matches]
    return views._replace(points=points, images=images, to_pixels=to_pixels, start=start)


def _sort_by_false_alarms(views: Views, poses: list[Pose]) -> list[Pose]:
    return sorted(poses, key=lambda pose: _log_false_alarms(views, pose)) if len(poses) > 1 else poses


def _select_subset(views: Views, rng: np.random.Generator) -> Views:
    """Select about `MAX_SEARCH_MATCHES` matches at most, evenly from the cameras."""
    if len(views.points) <= MAX_SEARCH_MATCHES:
        return views
    counts = np.diff(views.start)
    # Cameras with few matches leave their quota to the others.
    quota = MAX_SEARCH_MATCHES // len(counts)
    for _ in range(3):
        has_more = counts > quota
        if not has_more.any():
            break
        quota = max(1, int((MAX_SEARCH_MATCHES - counts[~has_more].sum()) // has_more.sum()))
    picked = [
        first + (np.arange(n) if n <= quota else rng.choice(n, quota, replace=False))
        for first, n in zip(views.start[:-1], counts, strict=True)
    ]
    return _take(views, np.concatenate(picked), np.concatenate([[0], np.cumsum([len(p) for p in picked])]))


def _is_known(poses: Sequence[Pose], other: ModelPose) -> bool:
    return any(kernels.is_same_rotation(other.rotation, p.model.rotation) for p in poses)


def _fit_pose(views: Views, start: ModelPose, max_square: float) -> Pose | None:
    """Fit a pose robustly from a start; None if fewer than `MIN_MATCHES` inliers remain."""
    pose = kernels.fit_pose(views, start, max_square, MAX_ITERATIONS, 1)
    return pose if np.count_nonzero(pose.weights) >= MIN_MATCHES else None


def _log_false_alarms(views: Views, pose: Pose) -> float:
    """Return the logarithm of the number of false alarms (NFA).

    This is the expected number of poses as good as this one from random matches. A random match is an inlier with a
    probability equal to the fraction of the object's image that a circle of `CUTOFF` sigma covers; the inliers, and the
    three of them that determine the pose, may be chosen. This balances the number of inliers against their accuracy: of
    poses of the same data the one with the smallest value is the best.

    Source: Moisan & Stival, a contrario RANSAC, 2004.
    """
    n = len(pose.weights)
    k, log_share = kernels.compute_chance(views, pose.model.translation, pose.weights, pose.noise)
    choices = lgamma(n + 1) - lgamma(n - k + 1) - lgamma(4) - lgamma(k - 2)
    return float(np.log(n) + choices + (k - 3) / k * log_share)


def is_by_chance(views: Views, pose: Pose) -> bool:
    """Return whether random matches could give a pose as good.

    If all matches are inliers, there was no choice among them, and only the matches beyond the minimal three count as
    evidence.
    """
    if not pose.weights.all():
        return bool(_log_false_alarms(views, pose) > np.log(MAX_FALSE_ALARMS))
    k, log_share = kernels.compute_chance(views, pose.model.translation, pose.weights, pose.noise)
    return bool((k - 3) / k * log_share > np.log(MAX_FALSE_ALARMS))


def find_camera_poses(views: Views, max_square: float, thin_axis: FloatArray, seed: int) -> Iterator[tuple[int, Pose]]:
    """Yield the cameras that support a pose alone, with that pose.

    A majority of their matches, and more than `MIN_MATCHES`, are inliers, not by chance.
    """
    counts = np.diff(views.start)
    for c in np.flatnonzero(counts >= MIN_MATCHES):
        camera_views, _ = select_matches(views, np.repeat(np.arange(len(counts)) == c, counts))
        poses = search_poses(camera_views, max_square, thin_axis, np.random.default_rng(seed))
        min_inliers = max(MIN_MATCHES, MIN_INLIER_RATIO * counts[c])
        if poses and np.count_nonzero(poses[0].weights) > min_inliers and not is_by_chance(camera_views, poses[0]):
            yield int(c), poses[0]


def is_contradicted(views: Views, pose: Pose, max_square: float, thin_axis: FloatArray, seed: int) -> bool:
    """Return whether at least as many cameras support another pose, so that neither can be preferred.

    With two cameras, one may be miscalibrated; with several that support different poses, the model may be too large.
    Cameras with wrong matches support none.
    """
    inliers, counts = count_inliers(views, pose.weights), np.diff(views.start)
    is_opposing = (inliers < MIN_INLIER_RATIO * counts) & (counts - inliers >= MIN_MATCHES)
    n_supporting = int(np.count_nonzero(inliers >= MIN_INLIER_RATIO * counts))
    if not is_opposing.any() or is_opposing.sum() < n_supporting:
        return False
    others, has_matches = select_matches(views, (pose.weights == 0.0) & np.repeat(is_opposing, counts))
    if n_supporting <= 1:
        return any(True for _ in find_camera_poses(others, max_square, thin_axis, seed))
    poses = search_poses(others, max_square, thin_axis, np.random.default_rng(seed))
    if not poses or is_by_chance(others, poses[0]):
        return False
    has_more_inliers = count_inliers(others, poses[0].weights) > inliers[has_matches]
    return int(np.count_nonzero(has_more_inliers)) >= n_supporting
