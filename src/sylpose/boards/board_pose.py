"""Pose of a calibration target from all cameras that see it at one time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.boards.detection import Detection, detect
from sylpose.boards.specification import Board
from sylpose.frames import FrameSet, check_frame_set
from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.geometry.validation import check_sequence, check_type
from sylpose.results import Motion
from sylpose.rig import Camera, Rig

# The size ratio is only reported if its relative uncertainty is below this (choice: a printer's scaling is a few
# percent).
MAX_SIZE_UNCERTAINTY = 0.0125
# Rays of two cameras that miss each other by more than this, pixels, have no common point; assumed noise of points,
# pixels (choice).
MAX_RAY_DISTANCE_PX, TYPICAL_NOISE_PX = 5.0, 0.5
# Points that approximate a circle (choice).
CIRCLE_SAMPLES = 32
# Cameras whose target is off by more than this many pixels from the others' are reported (choice: an unchanged
# calibration is accurate to one).
MAX_CAMERA_ERROR_PX = 3.0


@dataclass(frozen=True, eq=False)
class BoardObservation:
    """Observation of a target by C cameras at one time.

    Attributes:
        points: (n_c, 3) by camera, in the target's frame; empty where it is not detected.
        pixels: (n_c, 2) by camera, in the image as recorded; for circles, the projections of their centers.
        motion: world_from_board with its status and covariance, as of `estimate_pose`.
        n_symmetries: number of rotations of the target that look the same. If above 1, the x axis points as far right
            as possible in the first camera's image.
        size_ratio: ratio of measured to specified size, from the rays of two cameras; None if unknown.
        problems: sentences about detected problems.
    """

    points: tuple[FloatArray, ...]
    pixels: tuple[FloatArray, ...]
    motion: Motion
    n_symmetries: int
    size_ratio: float | None
    problems: tuple[str, ...]

    @property
    def cameras(self) -> tuple[int, ...]:
        """Return the indices of the cameras that detected it."""
        return tuple(c for c, pixels in enumerate(self.pixels) if len(pixels))


def find_board(rig: Rig, images: Sequence[Image | None], board: Board, *, seed: int = 0) -> BoardObservation:
    """Detect a target in the images of all cameras at one time, and estimate its pose.

    Args:
        rig: C cameras.
        images: C images (h, w) or (h, w, 3) BGR as recorded, None where a camera has none.
        board: board from `parse_board`, in the rig's unit.
        seed: seed of the random search; same input and seed give the same result.

    Returns:
        detected points and the target's pose.

    Raises:
        TypeError, ValueError: not one image per camera, of its size; this OpenCV has no detector for the target.
    """
    n = len(check_type(rig, Rig, "rig"))
    images = check_sequence(images, "images", n)
    missing = (None,) * n
    check_frame_set(FrameSet(0, 0.0, missing, tuple(images), missing), rig)
    board = check_type(board, Board, "board")
    pairs = zip(rig, images, strict=True)
    detections = [Detection() if image is None else detect(image, camera, board) for camera, image in pairs]
    return combine_detections(rig, detections, board, seed=seed)


def combine_detections(rig: Rig, detections: Sequence[Detection], board: Board, *, seed: int = 0) -> BoardObservation:
    """Combine the detections of all cameras, with a consistent orientation of symmetric targets.

    Cameras are processed in order of decreasing extent. Each takes the symmetry that agrees best with the previous
    ones.

    Args:
        rig: the cameras.
        detections: detection of each camera.
        board: the target.
        seed: seed of the random search.
    """
    symmetries: dict[int, IntArray] = {}
    seen = [c for c, detection in enumerate(detections) if len(detection.indices)]
    order = sorted(seen, key=lambda c: -float(np.linalg.norm(np.ptp(detections[c].pixels, axis=0))))
    if len(board.symmetries) > 1:
        for c in order:
            candidates = board.symmetries if symmetries else board.symmetries[:1]
            ways = [_collect_matches(detections, board, {**symmetries, c: way}) for way in candidates]
            misfits = [_compute_misfit(estimate_pose(rig, *matches, seed=seed)) for matches in ways]
            symmetries[c] = candidates[misfits.index(min(misfits))]
        symmetries = _choose_orientation(detections, board, symmetries)
    else:
        symmetries = dict.fromkeys(order, board.symmetries[0])
    points, pixels = _collect_matches(detections, board, symmetries)
    motion = estimate_pose(rig, points, pixels, seed=seed)
    if board.diameter and motion.motion is not None:
        world_from_board = motion.motion
        pixels = tuple(
            detection - _compute_center_offsets(camera, world_from_board, where, board.diameter)
            for camera, where, detection in zip(rig, points, pixels, strict=True)
        )
        motion = estimate_pose(rig, points, pixels, seed=seed)
    problems = [f"{rig.names[c]}: {detection.problem}" for c, detection in enumerate(detections) if detection.problem]
    size = _estimate_size_ratio(rig, detections, board)
    problems += _describe_inconsistent(rig, points, pixels, motion)
    return BoardObservation(points, pixels, motion, len(board.symmetries), size, tuple(problems))


def _collect_matches(
    detections: Sequence[Detection], board: Board, symmetries: Mapping[int, IntArray]
) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
    points, pixels = [], []
    for c, detection in enumerate(detections):
        points.append(board.points[symmetries[c][detection.indices]] if c in symmetries else np.empty((0, 3)))
        pixels.append(detection.pixels if c in symmetries else np.empty((0, 2)))
    return tuple(points), tuple(pixels)


def _compute_misfit(motion: Motion) -> tuple[float, float]:
    """Return the misfit of a pose for comparison: number of outliers, then the residual."""
    n_outliers = sum(int(np.count_nonzero(~its)) for its in motion.inliers)
    return n_outliers, float(np.nanmax(motion.residuals, initial=0.0))


def _compute_center_offsets(
    camera: Camera, world_from_board: RigidTransform, centers: FloatArray, diameter: float
) -> FloatArray:
    """Compute offsets (n, 2), pixels, from projected circle centers (n, 3) to the centroids of the circles' images.

    They differ because the nearer part of a circle looks larger.
    """
    places = world_from_board.apply((centers[:, None] + make_circle(diameter)).reshape(-1, 3))
    middles = camera.project(world_from_board.apply(centers).reshape(-1, 3))
    return compute_centroids(camera.project(places).reshape(-1, CIRCLE_SAMPLES, 2), middles)


def make_circle(diameter: float) -> FloatArray:
    """Return points (K, 3) of a circle around the origin of a board."""
    angles = 2 * np.pi * np.arange(CIRCLE_SAMPLES) / CIRCLE_SAMPLES
    return diameter / 2 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(CIRCLE_SAMPLES)])


def compute_centroids(vertices: FloatArray, origins: FloatArray) -> FloatArray:
    """Return the centroids (..., 2) of polygons (..., K, 2) relative to points (..., 2) within them."""
    offsets = vertices - origins[..., None, :]
    next_offsets = np.roll(offsets, -1, axis=-2)
    areas = offsets[..., 0] * next_offsets[..., 1] - offsets[..., 1] * next_offsets[..., 0]
    # The centroid of a polygon is the area-weighted mean of its triangles' centroids.
    weighted = (areas[..., None] * (offsets + next_offsets)).sum(axis=-2)
    return np.asarray(weighted / (3 * areas.sum(axis=-1, keepdims=True)))


def _choose_orientation(
    detections: Sequence[Detection], board: Board, symmetries: Mapping[int, IntArray]
) -> dict[int, IntArray]:
    """Rotate the target so that its x axis points as far right as possible in the first camera's image."""
    if not symmetries:
        return {}
    first = min(symmetries)
    detection = detections[first]

    def measure_rightness(way: IntArray) -> float:
        x = board.points[way[symmetries[first][detection.indices]], 0]
        return float((x - x.mean()) @ (detection.pixels[:, 0] - detection.pixels[:, 0].mean()))

    best = max(board.symmetries, key=measure_rightness)
    return {c: best[turn] for c, turn in symmetries.items()}


def _describe_inconsistent(
    rig: Rig, points: Sequence[FloatArray], pixels: Sequence[FloatArray], motion: Motion
) -> list[str]:
    """Describe each camera that sees the target at another position than the others."""
    found = []
    for camera, where, its in zip(rig, points, pixels, strict=True):
        if motion.motion is not None and len(its):
            errors = np.linalg.norm(camera.project(motion.motion.apply(where).reshape(-1, 3)) - its, axis=1)
            error = float(np.median(np.nan_to_num(errors, nan=np.inf)))
            if error > MAX_CAMERA_ERROR_PX:
                found.append(f"{camera.name} sees it at another position than the other cameras, {error:.0f} px off")
    return found


def _estimate_size_ratio(rig: Rig, detections: Sequence[Detection], board: Board) -> float | None:
    """Estimate the size ratio of `BoardObservation`, the median over pairs of cameras."""
    ratios = []
    with_points = [c for c, its in enumerate(detections) if len(its.indices)]
    for i, a in enumerate(with_points):
        for b in with_points[i + 1 :]:
            pair = (rig.cameras[a], rig.cameras[b])
            intersections = [_intersect_rays(pair, detections[a], detections[b], way) for way in board.symmetries]
            miss, points, numbers, uncertainty = min(intersections, key=lambda its: its[0])
            if miss > MAX_RAY_DISTANCE_PX or len(numbers) < 3 or uncertainty > MAX_SIZE_UNCERTAINTY:
                continue
            spreads = [np.linalg.norm(x - x.mean(axis=0)) for x in (points, board.points[numbers])]
            ratios.append(float(spreads[0] / spreads[1]))
    return float(np.median(ratios)) if ratios else None


def _intersect_rays(
    pair: tuple[Camera, Camera], a: Detection, b: Detection, symmetry: IntArray
) -> tuple[float, FloatArray, IntArray, float]:
    """Intersect the rays of two cameras, with a symmetry applied to the second one's detection.

    Returns:
        the median distance between rays, pixels; (m, 3) midpoints of the m common points; their numbers; and the
        relative uncertainty of their size.
    """
    numbers, in_a, in_b = np.intersect1d(a.indices, symmetry[b.indices], return_indices=True)
    if not len(numbers):
        return np.inf, np.empty((0, 3)), numbers, np.inf
    rays, other_rays = pair[0].rays(a.pixels[in_a]), pair[1].rays(b.pixels[in_b])
    between = pair[1].center - pair[0].center
    cosine = (rays * other_rays).sum(axis=1)
    sine = np.maximum(1.0 - cosine**2, 1e-12)
    depths = (rays @ between - cosine * (other_rays @ between)) / sine
    other_depths = (cosine * (rays @ between) - other_rays @ between) / sine
    ends = pair[0].center + depths[:, None] * rays, pair[1].center + other_depths[:, None] * other_rays
    miss = np.linalg.norm(ends[0] - ends[1], axis=1) * pair[0].focal / np.maximum(depths, 1e-12)
    extent = float(np.linalg.norm(np.ptp(a.pixels[in_a], axis=0)))
    uncertainty = TYPICAL_NOISE_PX / (float(np.sqrt(np.median(sine))) * max(extent, 1e-12))
    in_front = (depths > 0) & (other_depths > 0)
    return float(np.median(np.where(in_front, miss, np.inf))), (ends[0] + ends[1]) / 2, numbers, uncertainty
