"""What report.html shows, as numbers: a bounded number of frames and images, packed for the page's script."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.euler_angles import Angles
from sylpose.report.plots import X_COLOR, Y_COLOR, Z_COLOR, angle_labels, angles_of_frames, camera_colors, readable
from sylpose.report.scene import GRID, Scene, Stills
from sylpose.results import FramePose, FrameStatus, Trajectory
from sylpose.rig import Camera, Rig

__all__ = ["MOST_BYTES", "data_of", "images_of", "shown_frames"]

# The page is kept below this, so that it can be mailed (choice); of it, the images may take so many bytes as they are coded
# in it, and the numbers of frames so many values (half as many bytes again as they have, in base64).
MOST_BYTES = 5_000_000
MOST_IMAGE_BYTES, MOST_VALUES, MOST_FRAMES = 3_200_000, 200_000, 2000
# Points that are drawn on the object, and in all images of one frame together (choice: a cloud that shows its shape).
MOST_POINTS, MOST_IMAGE_POINTS = 6000, 480
# Different sentences of reasons and of faults that are told frame by frame.
MOST_SENTENCES = 300
# Times that begin beyond this are told since the first of them, seconds: a day and more is a clock's (choice).
LATE = 1e5
# Points of an axis that is drawn into an image, which lenses bend.
AXIS = 5
# In images, fractions of width and height are whole numbers of so many; without a place they are `NOWHERE`.
GRAIN, NOWHERE = 8192, -32768

# By what a frame is told among those that are left out beside it: what went wrong before all else.
_WORST = {FrameStatus.UNCERTAIN: 3, FrameStatus.COASTING: 2, FrameStatus.RELOCALISED: 1}


def shown_frames(trajectory: Trajectory, most: int) -> IntArray:
    """(n,) positions of at most `most` frames, in order; of those that each stands for it is the one that went worst, so
    that nothing that went wrong is left out for being short."""
    n = len(trajectory)
    every = -(-n // most)
    ranks = np.array([_rank(frame) for frame in trajectory])
    if every <= 1:
        return np.arange(n)
    starts = np.arange(0, n, every)
    return np.array([start + int(np.argmax(ranks[start : start + every])) for start in starts])


def _rank(frame: FramePose) -> int:
    if frame.world_from_object is None:
        return 5
    return 4 if frame.faults else _WORST.get(frame.status, 0)


def data_of(trajectory: Trajectory, scene: Scene, angles: Angles) -> dict[str, Any]:
    """All but the images, of JSON's kinds; arrays are little-endian in base64 ("f": float32, "i": int32, "h": int16).

    Lengths are relative to `scene.center`, so that float32 has enough of them wherever the world's origin is.
    """
    cameras = len(scene.cameras)
    most = max(2, min(MOST_FRAMES, MOST_VALUES // (27 + 4 * cameras)))
    chosen = shown_frames(trajectory, most)
    frames = [trajectory[int(k)] for k in chosen]
    shown = Trajectory(frames, trajectory.camera_names, trajectory.unit)
    poses = scene.world_from_object[chosen]
    solved, start_time = trajectory.solved, float(trajectory.times[0])
    start = trajectory.positions[solved][0] if solved.any() else scene.center
    moved = float(np.abs(trajectory.positions[solved] - start).max(initial=0.0))
    move_scale, move_unit = readable(moved, trajectory.unit)
    sigma = np.array([f.sigma if f.world_from_object is not None else np.full(6, np.nan) for f in frames])
    sigma[~np.isfinite(sigma)] = np.nan
    sd_scale, sd_unit = readable(float(np.nanmax(sigma[:, 3:], initial=0.0)), trajectory.unit)
    statuses = list(dict.fromkeys(f.status for f in frames))
    reasons, faults = _table([f.reason for f in frames]), _table(["; ".join(f.faults) for f in frames])
    points = scene.points[:: max(1, -(-len(scene.points) // MOST_POINTS))]
    point_cameras = scene.point_cameras[:: max(1, -(-len(scene.points) // MOST_POINTS))]
    counts = np.array([f.inliers for f in frames], dtype=float)
    errors = np.array([f.residuals for f in frames], dtype=float)
    # The first frame is matched with nothing, and coasting ones found nothing: their zeros are no measurement.
    unmatched = np.array([f.status in (FrameStatus.FIRST, FrameStatus.COASTING) for f in frames])
    counts[unmatched], errors[unmatched] = np.nan, np.nan
    return {
        "total": len(trajectory),
        "shown": len(chosen),
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
        "index": _packed([f.index for f in frames], "i"),
        "start": start_time,
        "since": start_time if abs(start_time) > LATE else 0.0,
        "time": _packed(shown.times - trajectory.times[0]),
        "place": _packed(poses[:, :3, 3] - scene.center),
        "begin": (start - scene.center).astype(np.float32).tolist(),  # rounded as places are: it is one of them
        "turned": _packed(poses[:, :3, :3]),
        "sigma": _packed(sigma * ([180 / np.pi] * 3 + [1.0] * 3)),
        "angle": _packed(np.degrees(angles_of_frames(shown, angles))),
        "turn": _packed(np.degrees(trajectory.turn[chosen])),
        "status": _packed([statuses.index(f.status) for f in frames], "i"),
        "reason": _packed(reasons[1], "i"),
        "fault": _packed(faults[1], "i"),
        "inliers": _packed(counts),
        "residuals": _packed(errors),
        "matches": _packed([_per_camera(f.matches, cameras) for f in frames]),
        "doubt": _packed([_per_camera(f.doubt, cameras) for f in frames]),
        "center": scene.center.tolist(),
        "reach": scene.reach,
        "axes": scene.axes.tolist(),
        "axisLength": scene.axis_length,
        "grid": GRID,
        "sheets": _packed(scene.sheets - scene.center),
        "eyes": _packed(scene.world_from_camera[:, :3, 3] - scene.center),
        "looks": _packed(scene.world_from_camera[:, :3, 2]),
        "sizes": scene.sizes.tolist(),
        "points": _packed(points),
        "pointCameras": _packed(point_cameras, "i"),
    }


def images_of(trajectory: Trajectory, scene: Scene, rig: Rig) -> dict[str, Any]:
    """The images, of as many frames as there is room for, with the object's axes and points in them.

    Args:
        rig: whose lenses the images were taken by.
    """
    stills = _thinned(scene.stills)
    at = {int(number): k for k, number in enumerate(scene.index)}
    shown = [(int(number), images) for number, images in zip(stills.index, stills.images, strict=True) if number in at]
    axes, points = [], []
    most = max(16, MOST_IMAGE_POINTS // len(rig))
    for number, _ in shown:
        pose = trajectory[at[number]].world_from_object
        for c, camera in enumerate(rig):
            its = scene.points[scene.point_cameras == c]
            its = its[:: max(1, -(-len(its) // most))][:most]
            ends = scene.axis_length * np.eye(3)[:, None] * np.linspace(0, 1, AXIS)[:, None]
            axes.append(_grains(camera, None if pose is None else pose.apply(ends.reshape(-1, 3)), 3 * AXIS))
            points.append(_grains(camera, None if pose is None or not len(its) else pose.apply(its), most))
    return {
        "index": [number for number, _ in shown],
        "files": [[None if file is None else base64.b64encode(file).decode() for file in files] for _, files in shown],
        "perAxis": AXIS,
        "perImage": most,
        "grain": GRAIN,
        "axes": _packed(axes, "h"),
        "points": _packed(points, "h"),
    }


def _thinned(stills: Stills) -> Stills:
    """Every second one left out until they are few enough bytes; none of a rig of hundreds of cameras."""
    while sum(4 * len(file) // 3 for files in stills.images for file in files if file) > MOST_IMAGE_BYTES:
        step = 2 if len(stills.images) > 1 else 1
        if step == 1:
            return Stills()
        stills = Stills(stills.index[::2], stills.images[::2])
    return stills


def _grains(camera: Camera, points: FloatArray | None, n: int) -> IntArray:
    """(n, 2) where points are in an image, in grains of its width and height; filled up, and where they are not in it or
    far beside it, with `NOWHERE`."""
    out = np.full((n, 2), NOWHERE, np.int64)
    if points is not None:
        with np.errstate(invalid="ignore"):
            places = (camera.project(points) + 0.5) / camera.size
            near = (np.abs(places) < 3).all(axis=1)
        out[: len(points)][near] = np.round(places[near] * GRAIN)
    return out


def _per_camera(values: ArrayLike, cameras: int) -> FloatArray:
    array = np.asarray(values, dtype=float)
    return array if len(array) else np.full(cameras, np.nan)


def _table(sentences: Sequence[str]) -> tuple[list[str], list[int]]:
    """The different sentences, the first of them empty, and which of them each one is."""
    known: dict[str, int] = {"": 0}
    for sentence in sentences:
        if len(known) < MOST_SENTENCES:
            known.setdefault(sentence, len(known))
    rest = len(known)
    which = [known.get(sentence, rest) for sentence in sentences]
    return [*known, "see trajectory.csv: too many different sentences for this page"], which


def _packed(values: ArrayLike, kind: str = "f") -> str:
    types = {"f": "<f4", "i": "<i4", "h": "<i2"}
    return base64.b64encode(np.ascontiguousarray(np.asarray(values), types[kind]).tobytes()).decode()
