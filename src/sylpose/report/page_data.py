"""Numeric data of report.html: a bounded number of frames and images, packed for the page's script."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.euler_angles import EulerAngles
from sylpose.report.plots import (
    X_COLOR,
    Y_COLOR,
    Z_COLOR,
    angle_labels,
    camera_colors,
    choose_length_unit,
    compute_frame_angles,
)
from sylpose.report.scene import IMAGE_GRID, Scene, Thumbnails
from sylpose.results import FramePose, FrameStatus, Trajectory
from sylpose.rig import Camera, Rig

__all__ = ["MAX_BYTES", "build_page_data", "build_page_images", "select_frames"]

# The page stays below this size, so that it can be mailed (choice). Limits within it: bytes of the encoded images, and
# number of values of all frames (base64 adds half as many bytes again).
MAX_BYTES = 5_000_000
MAX_IMAGE_BYTES, MAX_VALUES, MAX_FRAMES = 3_200_000, 200_000, 2000
# Points drawn on the object, and in all images of one frame together (choice: a cloud that shows its shape).
MAX_POINTS, MAX_IMAGE_POINTS = 6000, 480
# Maximum number of distinct reasons and of distinct faults listed frame by frame.
MAX_SENTENCES = 300
# Times that start beyond this are given relative to the first one, seconds: a day and more is a clock's (choice).
MAX_ABSOLUTE_TIME = 1e5
# Points along an axis drawn into an image; lenses bend it.
AXIS_SAMPLES = 5
# Image coordinates are integers, in fractions of width and height with this denominator; `MISSING_COORDINATE` marks
# missing ones.
COORDINATE_STEPS, MISSING_COORDINATE = 8192, -32768

# Severity, by which one frame is chosen to represent a group.
_SEVERITY = {FrameStatus.UNCERTAIN: 3, FrameStatus.COASTING: 2, FrameStatus.RELOCALIZED: 1}


def select_frames(trajectory: Trajectory, max_frames: int) -> IntArray:
    """Select at most `max_frames` frames to show.

    Returns:
        (n,) positions, in order. Each represents a group of consecutive frames and is the worst of them, so that short
        failures are not left out.
    """
    n = len(trajectory)
    group_size = -(-n // max_frames)
    ranks = np.array([_compute_severity(frame) for frame in trajectory])
    if group_size <= 1:
        return np.arange(n)
    starts = np.arange(0, n, group_size)
    return np.array([start + int(np.argmax(ranks[start : start + group_size])) for start in starts])


def _compute_severity(frame: FramePose) -> int:
    if frame.world_from_object is None:
        return 5
    return 4 if frame.faults else _SEVERITY.get(frame.status, 0)


def build_page_data(trajectory: Trajectory, scene: Scene, angles: EulerAngles) -> dict[str, Any]:
    """Build the page's data except for images, as JSON types.

    Arrays are little-endian in base64 ("f": float32, "i": int32, "h": int16). Positions are relative to `scene.center`,
    so that float32 is precise enough wherever the world's origin is.
    """
    cameras = len(scene.cameras)
    max_frames = max(2, min(MAX_FRAMES, MAX_VALUES // (27 + 4 * cameras)))
    selected = select_frames(trajectory, max_frames)
    frames = [trajectory[int(k)] for k in selected]
    shown = Trajectory(frames, trajectory.camera_names, trajectory.unit)
    poses = scene.world_from_object[selected]
    solved, start_time = trajectory.measured_mask, float(trajectory.times[0])
    start = trajectory.positions[solved][0] if solved.any() else scene.center
    moved = float(np.abs(trajectory.positions[solved] - start).max(initial=0.0))
    move_scale, move_unit = choose_length_unit(moved, trajectory.unit)
    sigma = np.array([f.sigma if f.world_from_object is not None else np.full(6, np.nan) for f in frames])
    sigma[~np.isfinite(sigma)] = np.nan
    sd_scale, sd_unit = choose_length_unit(float(np.nanmax(sigma[:, 3:], initial=0.0)), trajectory.unit)
    statuses = list(dict.fromkeys(f.status for f in frames))
    reasons, faults = _deduplicate([f.reason for f in frames]), _deduplicate(["; ".join(f.faults) for f in frames])
    points = scene.points[:: max(1, -(-len(scene.points) // MAX_POINTS))]
    point_cameras = scene.point_cameras[:: max(1, -(-len(scene.points) // MAX_POINTS))]
    counts = np.array([f.inliers for f in frames], dtype=float)
    errors = np.array([f.residuals for f in frames], dtype=float)
    # The first frame has no match partner and coasting frames have no matches: their zeros are no measurement.
    unmatched = np.array([f.status in (FrameStatus.FIRST, FrameStatus.COASTING) for f in frames])
    counts[unmatched], errors[unmatched] = np.nan, np.nan
    return {
        "total": len(trajectory),
        "shown": len(selected),
        "drawnPoints": len(points),
        "unit": trajectory.unit or "units",
        "inSeconds": not np.array_equal(trajectory.times, [f.index for f in trajectory]),
        "cameras": list(scene.cameras),
        "colors": camera_colors(cameras),
        "angles": [label for label, _ in angle_labels(angles)],
        "angleAxes": [(X_COLOR, Y_COLOR, Z_COLOR).index(color) for _, color in angle_labels(angles)],
        "moved": [move_scale, move_unit],
        "sd": [sd_scale, sd_unit],
        "statuses": [[s.value, s.text, s.has_pose] for s in statuses],
        "reasons": reasons[0],
        "faults": faults[0],
        "index": _pack_base64([f.index for f in frames], "i"),
        "start": start_time,
        "since": start_time if abs(start_time) > MAX_ABSOLUTE_TIME else 0.0,
        "time": _pack_base64(shown.times - trajectory.times[0]),
        "place": _pack_base64(poses[:, :3, 3] - scene.center),
        "begin": (start - scene.center).astype(np.float32).tolist(),  # rounded like positions, since it is one of them
        "turned": _pack_base64(poses[:, :3, :3]),
        "sigma": _pack_base64(sigma * ([180 / np.pi] * 3 + [1.0] * 3)),
        "angle": _pack_base64(np.degrees(compute_frame_angles(shown, angles))),
        "turn": _pack_base64(np.degrees(trajectory.rotation_angles[selected])),
        "status": _pack_base64([statuses.index(f.status) for f in frames], "i"),
        "reason": _pack_base64(reasons[1], "i"),
        "fault": _pack_base64(faults[1], "i"),
        "inliers": _pack_base64(counts),
        "residuals": _pack_base64(errors),
        "matches": _pack_base64([_fill_per_camera(f.matches, cameras) for f in frames]),
        "doubt": _pack_base64([_fill_per_camera(f.variance_inflation, cameras) for f in frames]),
        "center": scene.center.tolist(),
        "reach": scene.camera_distance,
        "axes": scene.axes.tolist(),
        "axisLength": scene.axis_length,
        "grid": IMAGE_GRID,
        "sheets": _pack_base64(scene.image_planes - scene.center),
        "eyes": _pack_base64(scene.world_from_camera[:, :3, 3] - scene.center),
        "looks": _pack_base64(scene.world_from_camera[:, :3, 2]),
        "sizes": scene.sizes.tolist(),
        "points": _pack_base64(points),
        "pointCameras": _pack_base64(point_cameras, "i"),
    }


def build_page_images(trajectory: Trajectory, scene: Scene, rig: Rig) -> dict[str, Any]:
    """Build the page's images, of as many frames as fit, with the object's axes and points in them.

    Args:
        trajectory: trajectory of the object.
        scene: scene of this trajectory.
        rig: whose lenses took the images.
    """
    stills = _thin_out(scene.thumbnails)
    at = {int(number): k for k, number in enumerate(scene.index)}
    shown = [(int(number), images) for number, images in zip(stills.index, stills.images, strict=True) if number in at]
    axes, points = [], []
    max_points = max(16, MAX_IMAGE_POINTS // len(rig))
    for number, _ in shown:
        pose = trajectory[at[number]].world_from_object
        for c, camera in enumerate(rig):
            camera_points = scene.points[scene.point_cameras == c]
            camera_points = camera_points[:: max(1, -(-len(camera_points) // max_points))][:max_points]
            ends = scene.axis_length * np.eye(3)[:, None] * np.linspace(0, 1, AXIS_SAMPLES)[:, None]
            axes.append(
                _quantize_pixels(camera, None if pose is None else pose.apply(ends.reshape(-1, 3)), 3 * AXIS_SAMPLES)
            )
            points.append(
                _quantize_pixels(
                    camera, None if pose is None or not len(camera_points) else pose.apply(camera_points), max_points
                )
            )
    return {
        "index": [number for number, _ in shown],
        "files": [[None if file is None else base64.b64encode(file).decode() for file in files] for _, files in shown],
        "perAxis": AXIS_SAMPLES,
        "perImage": max_points,
        "grain": COORDINATE_STEPS,
        "axes": _pack_base64(axes, "h"),
        "points": _pack_base64(points, "h"),
    }


def _thin_out(stills: Thumbnails) -> Thumbnails:
    """Drop every second frame until the images fit the size limit; none are left if one frame is too large."""
    while sum(4 * len(file) // 3 for files in stills.images for file in files if file) > MAX_IMAGE_BYTES:
        step = 2 if len(stills.images) > 1 else 1
        if step == 1:
            return Thumbnails()
        stills = Thumbnails(stills.index[::2], stills.images[::2])
    return stills


def _quantize_pixels(camera: Camera, points: FloatArray | None, n: int) -> IntArray:
    """Quantize the pixels of points, (n, 2), in steps of the image's width and height.

    Padding, and points far outside the image or without a projection, are `MISSING_COORDINATE`.
    """
    out = np.full((n, 2), MISSING_COORDINATE, np.int64)
    if points is not None:
        with np.errstate(invalid="ignore"):
            fractions = (camera.project(points) + 0.5) / camera.size
            is_near = (np.abs(fractions) < 3).all(axis=1)
        out[: len(points)][is_near] = np.round(fractions[is_near] * COORDINATE_STEPS)
    return out


def _fill_per_camera(values: ArrayLike, cameras: int) -> FloatArray:
    array = np.asarray(values, dtype=float)
    return array if len(array) else np.full(cameras, np.nan)


def _deduplicate(sentences: Sequence[str]) -> tuple[list[str], list[int]]:
    """Return the distinct sentences, the first one empty, and each sentence's index among them."""
    indices: dict[str, int] = {"": 0}
    for sentence in sentences:
        if len(indices) < MAX_SENTENCES:
            indices.setdefault(sentence, len(indices))
    rest = len(indices)
    positions = [indices.get(sentence, rest) for sentence in sentences]
    return [*indices, "see trajectory.csv: too many distinct sentences for this page"], positions


def _pack_base64(values: ArrayLike, kind: str = "f") -> str:
    types = {"f": "<f4", "i": "<i4", "h": "<i2"}
    return base64.b64encode(np.ascontiguousarray(np.asarray(values), types[kind]).tobytes()).decode()
