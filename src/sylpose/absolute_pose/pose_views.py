"""What the cameras see of a known model, as the compiled loops of `estimate_pose` take it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.rig import Camera

__all__ = ["Views", "agreeing", "part_of", "views_of"]


class Views(NamedTuple):
    """n matches in C cameras.

    Attributes:
        points: (n, 3) model points, relative to the model's centre.
        images: (n, 2) where they are seen, normalised.
        to_pixels: (n, 4) the derivative of the recorded pixel by the normalised point, row-major: lens and focal lengths.
        start: (C + 1,) camera c has the matches start[c] to start[c + 1].
        turns: (C, 3, 3) and shifts: (C, 3), camera_from_world.
        least: variance of the noise that is believed at least, pixels squared.
    """

    points: FloatArray
    images: FloatArray
    to_pixels: FloatArray
    start: IntArray
    turns: FloatArray
    shifts: FloatArray
    least: float


def views_of(
    cameras: Sequence[Camera], model: FloatArray, pixels: Sequence[FloatArray], per_px: FloatArray, least: float
) -> tuple[FloatArray, Views]:
    """The world's origin (3,), moved to the middle of the cameras so that places far off cost no digits, and the views, in
    units that are per_px (C,) of a pixel; no less noise than `least` of them is believed."""
    poses = np.array([camera.camera_from_world.as_matrix() for camera in cameras])
    turns, shifts = np.ascontiguousarray(poses[:, :3, :3]), poses[:, :3, 3]
    origin = -np.einsum("cij,ci->j", turns, shifts) / len(cameras)
    start = np.concatenate([[0], np.cumsum([len(u) for u in pixels])])
    images, to_pixels = np.empty((len(model), 2)), np.empty((len(model), 4))
    for c, (camera, u) in enumerate(zip(cameras, pixels, strict=True)):
        of_camera = slice(start[c], start[c + 1])
        images[of_camera], by_normalised = _without_lens(camera, u)
        to_pixels[of_camera] = per_px[c] * by_normalised
    # What a lens cannot have made is far outside of every image.
    lost = ~(np.isfinite(images).all(axis=1) & np.isfinite(to_pixels).all(axis=1))
    images[lost], to_pixels[lost] = 1e9, (1.0, 0.0, 0.0, 1.0)
    return origin, Views(model, images, to_pixels, start, turns, shifts + turns @ origin, least * least)


def _without_lens(camera: Camera, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normalised points (n, 2), and (n, 4) or (4,), row-major, how the recorded pixel moves with each."""
    if camera.lens == "opencv" and not camera.distortion.any():
        # Nothing to undo: OpenCV's call would be a third of the time that many cameras with few points take.
        focals = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
        return (pixels - camera.matrix[:2, 2]) / focals, np.array([focals[0], 0.0, 0.0, focals[1]])
    images = camera.normalize(pixels)
    h = 1e-4
    sides = h * np.array([[[1.0, 0.0]], [[-1.0, 0.0]], [[0.0, 1.0]], [[0.0, -1.0]]])
    right, left, down, up = camera.denormalize((images + sides).reshape(-1, 2)).reshape(4, -1, 2)
    by_u, by_v = (right - left) / (2 * h), (down - up) / (2 * h)
    return images, np.stack([by_u[:, 0], by_v[:, 0], by_u[:, 1], by_v[:, 1]], axis=1)


def agreeing(views: Views, weights: FloatArray) -> IntArray:
    """(C,) how many of each camera's matches have a weight (n,)."""
    return np.asarray(np.add.reduceat(weights > 0.0, views.start[:-1], dtype=np.int64))


def part_of(views: Views, rows: BoolArray) -> tuple[Views, BoolArray]:
    """Some of the matches (n,), of at least one, and which of the cameras (C,) have any of them."""
    start = np.concatenate([[0], np.cumsum(rows)])[views.start]
    some = np.diff(start) > 0
    part = Views(
        views.points[rows],
        views.images[rows],
        views.to_pixels[rows],
        np.append(start[:-1][some], start[-1]),
        views.turns[some],
        views.shifts[some],
        views.least,
    )
    return part, some
