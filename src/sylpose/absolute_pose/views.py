"""Observations of a known model, as the compiled loops of `estimate_pose` take them, from matches of a rig's cameras."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import index_distinct_rows, kernel, leaf, symmetric_eigen

# Three matches have several exact poses; the fourth decides (derived).
MIN_MATCHES = 4
# Maximum number of matches used in the search, evenly from the cameras, and of inliers whose neighbors are counted (choice).
MAX_SEARCH_MATCHES = 500
# Points are on one line if their second largest variance is below this fraction of the largest (choice: rounding).
MIN_VARIANCE_RATIO = 1e-12
# Normalized coordinates of pixels that a lens cannot produce: far outside of every image (choice).
INVALID_IMAGE = 1e9


class Views(NamedTuple):
    """Observations of a known model: n matches in C cameras.

    Attributes:
        points: (n, 3) model points, relative to the model's center.
        images: (n, 2) their normalized image points.
        to_pixels: (n, 4) derivative of the recorded pixel by the normalized point, row-major: lens and focal lengths.
        start: (C + 1,) camera c has the matches start[c] to start[c + 1].
        rotations, translations: (C, 3, 3) and (C, 3), camera_from_world.
        min_variance: lower limit of the noise variance, pixels squared.
        thin_axis: (3,) the direction in which the model extends least.
    """

    points: FloatArray
    images: FloatArray
    to_pixels: FloatArray
    start: IntArray
    rotations: FloatArray
    translations: FloatArray
    min_variance: float
    thin_axis: FloatArray


class CameraArrays(NamedTuple):
    """Constants of C cameras.

    Attributes:
        rotations, centers: (C, 3, 3) and (C, 3), world frame.
        intrinsics: (C, 4) focal lengths and principal point, pixels.
        has_distortion: (C,) whether the lens has distortion.
    """

    rotations: FloatArray
    centers: FloatArray
    intrinsics: FloatArray
    has_distortion: BoolArray


class Selection(NamedTuple):
    """The given matches that are used: those of cameras with finite noise, without copies.

    Attributes:
        views: of the used matches, in a world frame with the used cameras' centroid as origin, so that distant positions
            lose no digits.
        origin: (3,) of this frame.
        center: (3,) the model's center, the mean of the used points; NaN without any.
        cameras: (C,) the rig's cameras that have matches.
        used: (n,) the used match that represents each given match, or -1.
        is_enough: whether at least `MIN_MATCHES` different points are observed, each counted once per camera.
        is_line: whether all points are on one line.
    """

    views: Views
    origin: FloatArray
    center: FloatArray
    cameras: IntArray
    used: IntArray
    is_enough: bool
    is_line: bool


@kernel
def select_matches(
    model: FloatArray,
    pixels: FloatArray,
    start: IntArray,
    cameras: CameraArrays,
    images: FloatArray,
    to_pixels: FloatArray,
    per_px: FloatArray,
    min_variance: float,
) -> Selection:
    """Select the matches to use.

    Args:
        model, pixels: (n, 3) points and (n, 2) pixels, by camera.
        start: (C + 1,) camera c has the matches start[c] to start[c + 1].
        images, to_pixels: as in `Views`, of cameras with lens distortion; the others are filled.
        per_px: (C,) units of the image plane per pixel; 0: the camera is ignored.
        min_variance: as in `Views`.
    """
    n, n_cameras = len(model), len(per_px)
    camera, observed = np.empty(n, np.int64), np.empty((n, 3))
    for c in range(n_cameras):
        f0, f1, c0, c1 = (
            cameras.intrinsics[c, 0],
            cameras.intrinsics[c, 1],
            cameras.intrinsics[c, 2],
            cameras.intrinsics[c, 3],
        )
        for k in range(start[c], start[c + 1]):
            camera[k], observed[k, 0], observed[k, 1], observed[k, 2] = c, c, pixels[k, 0], pixels[k, 1]
            if not cameras.has_distortion[c]:
                images[k, 0], images[k, 1] = (pixels[k, 0] - c0) / f0, (pixels[k, 1] - c1) / f1
                to_pixels[k, 0], to_pixels[k, 1], to_pixels[k, 2], to_pixels[k, 3] = f0, 0.0, 0.0, f1
    # Only a match of the same camera is a copy.
    n_distinct, rows, index = index_distinct_rows(model, observed)
    counts, used = np.zeros(n_cameras, np.int64), np.full(n_distinct, -1)
    n_used = 0
    for d in range(n_distinct):
        c = camera[rows[d]]
        if per_px[c] > 0.0:
            rows[n_used], used[d] = rows[d], n_used
            counts[c] += 1
            n_used += 1
    for k in range(n):
        index[k] = used[index[k]]
    n_views, origin, center = 0, np.zeros(3), np.zeros(3)
    for c in range(n_cameras):
        if counts[c] > 0:
            n_views += 1
            for i in range(3):
                origin[i] += cameras.centers[c, i]
    views = Views(
        np.empty((n_used, 3)), np.empty((n_used, 2)), np.empty((n_used, 4)), np.zeros(n_views + 1, np.int64),
        np.empty((n_views, 3, 3)), np.zeros((n_views, 3)), min_variance, np.zeros(3),
    )  # fmt: skip
    view_cameras, v = np.empty(n_views, np.int64), 0
    for i in range(3):
        origin[i] /= n_views
    for c in range(n_cameras):
        if counts[c] > 0:
            view_cameras[v], views.start[v + 1] = c, views.start[v] + counts[c]
            for i in range(3):
                for j in range(3):
                    views.rotations[v, i, j] = cameras.rotations[c, i, j]
                    views.translations[v, i] += cameras.rotations[c, i, j] * (origin[j] - cameras.centers[c, j])
            v += 1
    for k in range(n_used):
        for i in range(3):
            center[i] += model[rows[k], i]
    for i in range(3):
        center[i] /= n_used
    scatter = np.zeros((3, 3))
    for k in range(n_used):
        r = rows[k]
        _copy_match(views, k, images[r], to_pixels[r], per_px[camera[r]])
        for i in range(3):
            views.points[k, i] = model[r, i] - center[i]
        for i in range(3):
            for j in range(3):
                scatter[i, j] += views.points[k, i] * views.points[k, j]
    extent, axes = np.empty(3), np.empty((3, 3))
    symmetric_eigen(scatter, extent, axes)
    for i in range(3):
        views.thin_axis[i] = axes[i, 0]
    is_line = not extent[1] > MIN_VARIANCE_RATIO * extent[2]
    return Selection(views, origin, center, view_cameras, index, _is_enough(model, camera, rows, n_used), is_line)


@leaf
def _copy_match(views: Views, k: int, image: FloatArray, to_pixels: FloatArray, per_px: float) -> None:
    """Write the image (2,) of match k and its derivative (4,), unless the lens cannot produce this pixel."""
    is_valid = np.isfinite(image[0]) and np.isfinite(image[1])
    for j in range(4):
        is_valid = is_valid and np.isfinite(to_pixels[j])
    for j in range(2):
        views.images[k, j] = image[j] if is_valid else INVALID_IMAGE
    for j in range(4):
        views.to_pixels[k, j] = per_px * to_pixels[j] if is_valid else (1.0 if j % 3 == 0 else 0.0)


@kernel
def _is_enough(model: FloatArray, camera: IntArray, rows: IntArray, n_used: int) -> bool:
    """Return whether the used rows have at least `MIN_MATCHES` different points, each counted once per camera."""
    different, count = np.empty(MIN_MATCHES, np.int64), 0
    for k in range(n_used):
        r, is_new = rows[k], True
        for d in different[:count]:
            same = camera[r] == camera[d]
            for i in range(3):
                same = same and model[r, i] == model[d, i]
            is_new = is_new and not same
        if is_new:
            different[count] = r
            count += 1
            if count == MIN_MATCHES:
                return True
    return False
