"""Observations of a known model, as input of the compiled loops of `estimate_pose`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.rig import Camera

__all__ = ["Views", "count_inliers", "make_views", "select_matches"]


class Views(NamedTuple):
    """Observations of a known model: n matches in C cameras.

    Attributes:
        points: (n, 3) model points, relative to the model's center.
        images: (n, 2) their normalized image points.
        to_pixels: (n, 4) derivative of the recorded pixel by the normalized point, row-major: lens and focal lengths.
        start: (C + 1,) camera c has the matches start[c] to start[c + 1].
        rotations, translations: (C, 3, 3) and (C, 3), camera_from_world.
        min_variance: lower limit of the noise variance, pixels squared.
    """

    points: FloatArray
    images: FloatArray
    to_pixels: FloatArray
    start: IntArray
    rotations: FloatArray
    translations: FloatArray
    min_variance: float


def make_views(
    cameras: Sequence[Camera], model: FloatArray, pixels: Sequence[FloatArray], per_px: FloatArray, min_sigma: float
) -> tuple[FloatArray, Views]:
    """Return the origin (3,) of the views' world frame and the views.

    The origin is the cameras' centroid, so that distant positions lose no digits. Pixels are in units that are per_px
    (C,) of a pixel; the noise is at least `min_sigma` of them.
    """
    poses = np.array([camera.camera_from_world.as_matrix() for camera in cameras])
    rotations, translations = np.ascontiguousarray(poses[:, :3, :3]), poses[:, :3, 3]
    origin = -np.einsum("cij,ci->j", rotations, translations) / len(cameras)
    start = np.concatenate([[0], np.cumsum([len(u) for u in pixels])])
    images, to_pixels = np.empty((len(model), 2)), np.empty((len(model), 4))
    for c, (camera, u) in enumerate(zip(cameras, pixels, strict=True)):
        camera_slice = slice(start[c], start[c + 1])
        images[camera_slice], jacobian = _undistort(camera, u)
        to_pixels[camera_slice] = per_px[c] * jacobian
    # Pixels that the lens cannot produce are put far outside of every image.
    is_invalid = ~(np.isfinite(images).all(axis=1) & np.isfinite(to_pixels).all(axis=1))
    images[is_invalid], to_pixels[is_invalid] = 1e9, (1.0, 0.0, 0.0, 1.0)
    return origin, Views(
        model, images, to_pixels, start, rotations, translations + rotations @ origin, min_sigma * min_sigma
    )


def _undistort(camera: Camera, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return normalized points (n, 2), and (n, 4) or (4,), row-major, derivatives of the recorded pixel by each."""
    if camera.lens == "opencv" and not camera.distortion.any():
        # Without distortion: OpenCV's call would be a third of the time for many cameras with few points.
        focals = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
        return (pixels - camera.matrix[:2, 2]) / focals, np.array([focals[0], 0.0, 0.0, focals[1]])
    images = camera.normalize(pixels)
    h = 1e-4
    steps = h * np.array([[[1.0, 0.0]], [[-1.0, 0.0]], [[0.0, 1.0]], [[0.0, -1.0]]])
    right, left, down, up = camera.denormalize((images + steps).reshape(-1, 2)).reshape(4, -1, 2)
    d_u, d_v = (right - left) / (2 * h), (down - up) / (2 * h)
    return images, np.stack([d_u[:, 0], d_v[:, 0], d_u[:, 1], d_v[:, 1]], axis=1)


def count_inliers(views: Views, weights: FloatArray) -> IntArray:
    """Return (C,) number of each camera's matches with a positive weight (n,)."""
    return np.asarray(np.add.reduceat(weights > 0.0, views.start[:-1], dtype=np.int64))


def select_matches(views: Views, mask: BoolArray) -> tuple[Views, BoolArray]:
    """Select some of the matches (n,), at least one, and return the mask of the cameras (C,) that have any of them."""
    start = np.concatenate([[0], np.cumsum(mask)])[views.start]
    has_matches = np.diff(start) > 0
    part = Views(
        views.points[mask],
        views.images[mask],
        views.to_pixels[mask],
        np.append(start[:-1][has_matches], start[-1]),
        views.rotations[has_matches],
        views.translations[has_matches],
        views.min_variance,
    )
    return part, has_matches
