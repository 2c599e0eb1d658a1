"""`estimate_pose`: an object's pose from known points observed by any of several cameras.

Samples of three matches give starts of the search, whose best robust fits remain. Tests decide whether a pose may be due
to chance, and whether other cameras contradict it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from sylpose.absolute_pose.pose_kernels import MIN_INLIER_RATIO, Assessment, Pose, assess_pose, is_by_chance
from sylpose.absolute_pose.pose_sampling import Search, search_poses
from sylpose.absolute_pose.views import MIN_MATCHES, CameraArrays, Views, select_matches
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import invert_information, rotvec
from sylpose.geometry.normal_equations import find_unobservable_directions, has_rotation_direction
from sylpose.geometry.robust_loss import NoisePx, NoiseUnits, make_noise_units
from sylpose.geometry.validation import check_finite_rows, check_integer, check_number, check_sequence, check_type
from sylpose.results import FramePose, Motion
from sylpose.rig import MAX_FOCAL_PX, MAX_LENGTH, Camera, Rig
from sylpose.status import FrameStatus, Observability, Status

MIN_ERROR_PX = 1e-9  # smallest error bound accepted, pixels (choice)
# Smaller size ratios are errors of the calibration or the model, not another unit (choice).
MIN_SIZE_RATIO = 1.2
# Name of the estimator in its results.
METHOD = "pose"
_STATUS = {
    Status.OK: FrameStatus.LOCALIZED,
    Status.SCALE_NOT_OBSERVABLE: FrameStatus.LOCALIZED,
    Status.TOO_FEW_MATCHES: FrameStatus.TOO_FEW_MATCHES,
    Status.ROTATION_NOT_OBSERVABLE: FrameStatus.ROTATION_NOT_OBSERVABLE,
}


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
    model, counts = _stack_arrays(rig, points, 3, "points", MAX_LENGTH)
    image, pixel_counts = _stack_arrays(rig, pixels, 2, "pixels", MAX_FOCAL_PX)
    if counts != pixel_counts:
        name, n_points, n_pixels = next(x for x in zip(rig.names, counts, pixel_counts, strict=True) if x[1] != x[2])
        raise ValueError(f"camera {name}: {n_points} points but {n_pixels} pixels; give one pixel per point")
    ends = [0, *accumulate(counts)]
    return _estimate(rig, model, image, ends, max_error_px, units, seed)


def _stack_arrays(
    rig: Rig, arrays: Sequence[ArrayLike], width: int, name: str, maximum: float
) -> tuple[FloatArray, list[int]]:
    """Return the rows (n, width) of all cameras, checked, and their number for each camera."""
    # Usually one check is enough for all of them; where it fails, those of single cameras name the culprit.
    plain = [a for a in arrays if type(a) is np.ndarray and a.dtype.char == "d" and a.shape[1:] == (width,)]
    if len(plain) == len(rig):
        stacked = np.ascontiguousarray(np.concatenate(plain))
        if np.abs(stacked).max(initial=0.0) <= maximum:
            return stacked, [*map(len, plain)]
    named = [(f"camera {camera.name}: {name}", array) for camera, array in zip(rig, arrays, strict=True)]
    checked = [check_finite_rows(array, width, label, maximum=maximum) for label, array in named]
    return np.concatenate(checked), [*map(len, checked)]


def _estimate(
    rig: Rig, model: FloatArray, pixels: FloatArray, ends: list[int], max_px: float, units: NoiseUnits, seed: int
) -> Motion:
    """Run `estimate_pose` on checked matches; camera c has those from ends[c] to ends[c + 1]."""
    cameras, images, to_pixels = _stack_cameras(rig.cameras), np.empty((len(model), 2)), np.empty((len(model), 4))
    for c in cameras.distorted:
        part = slice(ends[c], ends[c + 1])
        images[part], to_pixels[part] = _undistort(rig.cameras[c], pixels[part])
    start, variance = np.array(ends), units.sigma * units.sigma
    selection = select_matches(model, pixels, start, cameras.arrays, images, to_pixels, units.per_px, variance)
    center, views = selection.center, selection.views
    if not selection.is_enough:
        return _make_empty_result(rig, ends, Status.TOO_FEW_MATCHES, center)
    if selection.is_line:
        empty = _make_empty_result(rig, ends, Status.ROTATION_NOT_OBSERVABLE, center)
        return replace(empty, unobservable=np.eye(6))
    max_square = float(max_px * units.per_px.max()) ** 2
    found = search_poses(views, max_square, seed)
    if found.n_poses == 0:
        return _make_empty_result(rig, ends, Status.NOT_CONSISTENT, center)
    best = found.best
    assessment = assess_pose(
        selection, best, found.rotations[1:], found.translations[1:], found.n_poses - 1, units.per_px
    )
    status = Status.OK if best.converged else Status.NOT_CONVERGED
    faults: tuple[str, ...] = ()
    if not assessment.all_inliers and assessment.is_by_chance:
        status = Status.NOT_CONSISTENT
    elif not assessment.all_inliers and _is_contradicted(views, best, assessment, max_square, seed):
        status = Status.NOT_CONSISTENT
        if (size := _estimate_model_scale(views, max_square, seed)) is not None:
            times = np.format_float_positional(size, trim="-")
            faults = (
                f"the points would fit if they were {times} times as large: are they in another unit than the "
                "calibration?",
            )
    unobservable = np.empty((0, 6))
    if status is Status.OK:
        if not assessment.is_observable or assessment.alternative >= 0:
            weak_directions = _find_unobservable(found, assessment)
            unobservable = weak_directions * assessment.limits
            is_rotation = has_rotation_direction(weak_directions)
            status = Status.ROTATION_NOT_OBSERVABLE if is_rotation else Status.SCALE_NOT_OBSERVABLE
        elif assessment.is_by_chance:
            status = Status.NOT_CONSISTENT
    return Motion(
        status=status,
        motion=RigidTransform(assessment.transform, normalize=False) if status.has_pose else None,
        center=center,
        information=assessment.information,
        covariance=assessment.covariance,
        unobservable=unobservable,
        inliers=tuple([assessment.is_inlier[begin:end] for begin, end in pairwise(ends)]),
        residuals=assessment.residuals,
        method=METHOD,
        iterations=best.iterations,
        faults=faults,
        camera_names=rig.names,
        unit=rig.unit,
    )


def _find_unobservable(found: Search, assessment: Assessment) -> FloatArray:
    """Return the unobservable directions (k, 6) of (w, d), in units of the limits, or the one to another pose."""
    directions = find_unobservable_directions(assessment.information, assessment.limits)
    if len(directions) or assessment.alternative < 0:
        return directions
    other, best = 1 + assessment.alternative, found.best.model
    change = found.translations[other] - best.translation
    direction = np.concatenate([rotvec(found.rotations[other] @ best.rotation.T), change])[None] / assessment.limits
    return np.asarray(direction / np.linalg.norm(direction))


def _make_empty_result(rig: Rig, ends: list[int], status: Status, center: FloatArray) -> Motion:
    """Make a result without pose and information; camera c has the matches from ends[c] to ends[c + 1]."""
    nothing = np.zeros((6, 6))
    return Motion(
        status=status,
        motion=None,
        center=center,
        information=nothing,
        covariance=invert_information(nothing),
        unobservable=np.empty((0, 6)),
        inliers=tuple(np.zeros(end - begin, bool) for begin, end in pairwise(ends)),
        residuals=np.full(len(rig), np.nan),
        method=METHOD,
        iterations=0,
        camera_names=rig.names,
        unit=rig.unit,
    )


class _RigArrays(NamedTuple):
    """Constants of a rig's cameras, and the indices of those with lens distortion."""

    arrays: CameraArrays
    distorted: tuple[int, ...]


@lru_cache
def _stack_cameras(cameras: tuple[Camera, ...]) -> _RigArrays:
    """Stack the constants of cameras, once for all calls with the same cameras, which share the result: do not write."""
    rotations, centers = np.array([c.rotation for c in cameras]), np.array([c.center for c in cameras])
    matrices = np.array([c.matrix for c in cameras])
    intrinsics = np.concatenate([matrices[:, (0, 1), (0, 1)], matrices[:, :2, 2]], axis=1)
    has_distortion = np.array([c.lens != "opencv" or bool(c.distortion.any()) for c in cameras])
    distorted = tuple(np.flatnonzero(has_distortion).tolist())
    return _RigArrays(CameraArrays(rotations, centers, intrinsics, has_distortion), distorted)


def _undistort(camera: Camera, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return normalized points (n, 2), and (n, 4), row-major, derivatives of the recorded pixel by each."""
    images = camera.normalize(pixels)
    h = 1e-4
    steps = h * np.array([[[1.0, 0.0]], [[-1.0, 0.0]], [[0.0, 1.0]], [[0.0, -1.0]]])
    right, left, down, up = camera.denormalize((images + steps).reshape(-1, 2)).reshape(4, -1, 2)
    d_u, d_v = (right - left) / (2 * h), (down - up) / (2 * h)
    return images, np.stack([d_u[:, 0], d_v[:, 0], d_u[:, 1], d_v[:, 1]], axis=1)


def _estimate_model_scale(views: Views, max_square: float, seed: int) -> float | None:
    """Estimate the factor by which the model must be scaled for cameras to agree on a pose.

    It is that of most cameras, to two digits.

    None where they do not agree then either, or already do. A single camera fits an object of any size in the same
    direction: a model that is s times too small is s times too near to each camera, and scaling these positions by s
    makes them coincide.

    Args:
        max_square: squared distance beyond which a match is an outlier, pixels.
    """
    single_poses = list(_find_camera_poses(views, max_square, seed))
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
    found = search_poses(scaled_views, max_square, seed)
    if found.n_poses == 0 or is_by_chance(scaled_views, found.best):
        return None
    is_supporting = _count_inliers(scaled_views, found.best.weights) >= MIN_INLIER_RATIO * np.diff(views.start)
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


def _count_inliers(views: Views, weights: FloatArray) -> IntArray:
    """Return (C,) number of each camera's matches with a positive weight (n,)."""
    return np.asarray(np.add.reduceat(weights > 0.0, views.start[:-1], dtype=np.int64))


def _take_matches(views: Views, mask: BoolArray) -> tuple[Views, BoolArray]:
    """Take some of the matches (n,), at least one, and return the mask of the cameras (C,) that have any of them."""
    start = np.concatenate([[0], np.cumsum(mask)])[views.start]
    has_matches = np.diff(start) > 0
    taken = views._replace(
        points=views.points[mask],
        images=views.images[mask],
        to_pixels=views.to_pixels[mask],
        start=np.append(start[:-1][has_matches], start[-1]),
        rotations=views.rotations[has_matches],
        translations=views.translations[has_matches],
    )
    return taken, has_matches


def _find_camera_poses(views: Views, max_square: float, seed: int) -> Iterator[tuple[int, Pose]]:
    """Yield the cameras that support a pose alone, with that pose.

    A majority of their matches, and more than `MIN_MATCHES`, are inliers, not by chance.
    """
    counts = np.diff(views.start)
    for c in np.flatnonzero(counts >= MIN_MATCHES):
        camera_views, _ = _take_matches(views, np.repeat(np.arange(len(counts)) == c, counts))
        found = search_poses(camera_views, max_square, seed)
        min_inliers = max(MIN_MATCHES, MIN_INLIER_RATIO * counts[c])
        if (
            found.n_poses
            and np.count_nonzero(found.best.weights) > min_inliers
            and not is_by_chance(camera_views, found.best)
        ):
            yield int(c), found.best


def _is_contradicted(views: Views, pose: Pose, assessment: Assessment, max_square: float, seed: int) -> bool:
    """Return whether at least as many cameras support another pose, so that neither can be preferred.

    With two cameras, one may be miscalibrated; with several that support different poses, the model may be too large.
    Cameras with wrong matches support none.
    """
    n_supporting = assessment.n_supporting
    if assessment.n_opposing == 0 or assessment.n_opposing < n_supporting:
        return False
    inliers, counts = assessment.inliers, np.diff(views.start)
    is_opposing = (inliers < MIN_INLIER_RATIO * counts) & (counts - inliers >= MIN_MATCHES)
    others, has_matches = _take_matches(views, (pose.weights == 0.0) & np.repeat(is_opposing, counts))
    if n_supporting <= 1:
        return any(True for _ in _find_camera_poses(others, max_square, seed))
    found = search_poses(others, max_square, seed)
    if found.n_poses == 0 or is_by_chance(others, found.best):
        return False
    has_more_inliers = _count_inliers(others, found.best.weights) > inliers[has_matches]
    return int(np.count_nonzero(has_more_inliers)) >= n_supporting
