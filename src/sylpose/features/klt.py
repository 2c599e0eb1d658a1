"""KLT feature tracking with affine consistency check against the template frame.

The square patch around each feature in its template frame is located in every later image in two steps. Pyramidal
Lucas-Kanade from the previous image predicts the position to within about a pixel. Then the template patch is
registered there with an affine warp, gain and bias. Hence errors do not accumulate over frames, and a feature is kept
only while it resembles its template.

At 1.5 degrees of object rotation per frame, frame-to-frame tracking alone has a median error of 0.6 pixels after 10
frames: the patch's change of shape is mistaken for motion, always in the same direction. This method has 0.06 pixels,
and SIFT keypoints matched with the template frame's 0.23.

Sources: Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000 (OpenCV's); Shi & Tomasi, "Good
features to track", CVPR 1994 (affine comparison with the first patch); Baker & Matthews, "Lucas-Kanade 20 years on",
IJCV 2004 (inverse compositional, with gain and bias projected out, part 3).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.geometry.numba_linalg import kernel

Filters = NDArray[np.float32]

# Patch radius around a feature, pixels.
PATCH_RADIUS = 6
# Image noise, gray levels, and prior standard deviation of the patch border's initial error, pixels: weakly textured
# patches keep their initial warp.
NOISE_GRAY_LEVELS, WARP_PRIOR_PX = 4.0, 2.0
# Features are not tracked if their position's standard deviation, from the texture, exceeds this, pixels.
MAX_SD_PX = 0.3
# Largest number of registration steps, and the step at which it converges, pixels.
MAX_ITERATIONS, CONVERGENCE_PX = 10, 0.03
# Largest correction by the registration, pixels; beyond it, it has found another feature.
MAX_CORRECTION_PX = 2.0
# Least normalized correlation with the template patch.
MIN_CORRELATION = 0.85
# Frame-to-frame Lucas-Kanade: window, pixels, pyramid levels above the image, and termination criteria. A smaller
# window mistakes less change of shape for motion.
KLT_WINDOW_PX, KLT_LEVELS = 9, 2
KLT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)
KLT_OPTIONS: Any = {"winSize": (KLT_WINDOW_PX, KLT_WINDOW_PX), "criteria": KLT_CRITERIA}
KLT_OPTIONS["flags"] = cv2.OPTFLOW_USE_INITIAL_FLOW
# Longer side of the largest images for which these levels are enough, pixels: in larger ones the same motion covers more
# pixels, so each doubling that begins adds a level (measured: with one more level in board4, of 1280x720, 43 instead of
# 48 of its frame sets are tracked; with one less at 3264x2448, an object that rotates by 4 degrees per frame is followed
# in 7 of 11).
KLT_SIDE_PX = 1280
# Width of the square over which illumination is flattened, pixels. A smaller one would reduce the capture range.
FLATTEN_WINDOW_PX = 51
# Margin of the processed area around the features, pixels: the coarsest level's window plus the motion.
MARGIN_PX = 40


@dataclass(frozen=True, eq=False)
class Tracks:
    """Tracking state of n features of a template frame. Rows keep their order; lost features are kept.

    Attributes:
        filters: (n, s, 8) float32, s = (2 PATCH_RADIUS + 1)^2 samples of the template patches in row order. Multiplying
            a sampled patch by them gives the steps of the warp's six parameters for unit gain, then the gain, then the
            mean. About 5 kB per feature.
        contrast: (n,) norm of the template patch minus its mean.
        sd: (n,) standard deviation of the feature position from the patch's texture, pixels.
        pixels: (n, 2) current positions; NaN for lost features.
        warps: (n, 2, 2) from offsets in the template patch to offsets in the image; the last one found.
        tracked: (n,) False for lost features.
    """

    filters: Filters
    contrast: FloatArray
    sd: FloatArray
    pixels: FloatArray
    warps: FloatArray
    tracked: BoolArray

    def __len__(self) -> int:
        return len(self.pixels)

    def subset(self, rows: IntArray) -> Tracks:
        """Return the rows (m,) in the given order."""
        return Tracks(*(getattr(self, f.name)[rows] for f in fields(self)))

    def concatenate(self, others: Tracks) -> Tracks:
        """Return these rows followed by those of `others`."""
        return Tracks(*(np.concatenate([getattr(own, f.name) for own in (self, others)]) for f in fields(self)))

    def keep(self, mask: BoolArray) -> Tracks:
        """Mark features outside the mask (n,) as lost, such as outliers of a motion."""
        tracked = self.tracked & mask
        return replace(self, pixels=np.where(tracked[:, None], self.pixels, np.nan), tracked=tracked)


def to_gray(image: Image) -> Image:
    """Convert an image to the gray image (h, w) that the tracking functions require.

    Compute it once per image: both pairs of which the image is part use it.

    Args:
        image: (h, w, 3) BGR or (h, w) gray, uint8.

    Raises:
        ValueError: another shape or type.
    """
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)) or not image.size:
        raise ValueError(f"an image must be uint8, (h, w, 3) BGR or (h, w), got {image.dtype} {image.shape}")
    return np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image, dtype=np.uint8)


def start_tracks(image: Image, pixels: ArrayLike) -> Tracks:
    """Start tracking features at a template frame.

    Features too close to the image border for a patch, and those with too little texture, are lost permanently.

    Args:
        image: (h, w) gray.
        pixels: (n, 2) feature positions, pixels.

    Returns:
        Tracks of the n features.

    Raises:
        ValueError: an image not made by `to_gray`, or pixels that are not (n, 2) and finite.
    """
    image, pixels = _check_image(image, "image"), _check_points(pixels, "pixels")
    if not np.isfinite(pixels).all():
        raise ValueError("pixels: must be finite in a template frame")
    n, side = len(pixels), 2 * PATCH_RADIUS + 3  # plus one on each side, for derivatives
    corners = np.floor(pixels).astype(np.int64) - PATCH_RADIUS - 1
    inside = ((corners >= 0) & (corners + side < np.array(image.shape[::-1]))).all(axis=1)
    corners[~inside] = 0
    offsets = np.arange(side + 1)
    if not inside.any():
        patches = np.zeros((n, side, side), np.float32)
    else:
        rows, columns = corners[:, 1, None] + offsets, corners[:, 0, None] + offsets
        values = image[rows[:, :, None], columns[:, None, :]].astype(np.float32)
        fx, fy = (pixels - np.floor(pixels)).astype(np.float32).T[..., None, None]
        values = values[:, :, :-1] + fx * (values[:, :, 1:] - values[:, :, :-1])
        patches = values[:, :-1] + fy * (values[:, 1:] - values[:, :-1])
    filters, contrast, sd = _build_templates(patches)
    tracked = inside & (sd < MAX_SD_PX)
    filters[~tracked] = 0.0  # never matched, whatever the guess
    return Tracks(filters, contrast, sd, pixels, np.tile(np.eye(2), (n, 1, 1)), tracked).keep(tracked)


def track_features(tracks: Tracks, previous: Image, current: Image, guess: ArrayLike | None = None) -> Tracks:
    """Track features into the next image.

    Lost features are searched wherever `guess` is finite, and found if it is right to within about 1.5 pixels. To
    recover features lost on the way to an image, pass it as `previous` and `current`, with the positions predicted from
    its pose.

    Args:
        tracks: features with their positions in `previous`.
        previous, current: (h, w) gray, of the same size.
        guess: (n, 2) expected positions in `current`, within about 4 pixels; without it, features may have moved by
            about 8 pixels since `previous`. Both double with each level that large images add.

    Returns:
        Tracks with the positions in `current`.

    Raises:
        ValueError: images not made by `to_gray` or of different sizes, or a guess that is not (n, 2).
    """
    previous, current = _check_image(previous, "previous"), _check_image(current, "current")
    if previous.shape != current.shape:
        raise ValueError(f"images of one camera must have the same size, got {previous.shape} and {current.shape}")
    start = tracks.pixels.copy() if guess is None else _check_points(guess, "guess")
    if len(start) != len(tracks):
        raise ValueError(f"guess: {len(start)} positions for {len(tracks)} features")
    start = np.where(np.isfinite(start).all(axis=1, keepdims=True), start, tracks.pixels)
    active = np.flatnonzero(tracks.tracked)
    start[active] = _track_pyramidal(previous, current, tracks.pixels[active], start[active])
    candidates = np.flatnonzero(np.isfinite(start).all(axis=1))
    positions, warps, correlation = start[candidates], tracks.warps[candidates], np.zeros(len(candidates))
    _register_patches(current, tracks.filters, tracks.contrast, candidates, positions, warps, correlation)
    found = correlation > MIN_CORRELATION
    pixels, all_warps, tracked = np.full_like(start, np.nan), tracks.warps.copy(), np.zeros(len(tracks), bool)
    rows = candidates[found]
    pixels[rows], all_warps[rows], tracked[rows] = positions[found], warps[found], True
    return replace(tracks, pixels=pixels, warps=all_warps, tracked=tracked)


def _check_image(image: Image, name: str) -> Image:
    if image.dtype != np.uint8 or image.ndim != 2 or not image.size:
        raise ValueError(f"{name}: must be a gray image (h, w), uint8, got {image.dtype} {image.shape}")
    return np.ascontiguousarray(image)


def _check_points(points: ArrayLike, name: str) -> FloatArray:
    array = np.array(points, dtype=float)
    if array.size == 0:
        return np.empty((0, 2))
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name}: must be (n, 2), got {array.shape}")
    return array


def _build_templates(patches: Filters) -> tuple[Filters, FloatArray, FloatArray]:
    """Precompute filters, contrast and sd of `Tracks` from (n, side + 2, side + 2) samples, one extra pixel per side."""
    n, samples = len(patches), (2 * PATCH_RADIUS + 1) ** 2
    along_u = (0.5 * (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2])).reshape(n, samples)
    along_v = (0.5 * (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1])).reshape(n, samples)
    offsets = slice(-PATCH_RADIUS, PATCH_RADIUS + 1)
    v, u = (np.mgrid[offsets, offsets].reshape(2, -1) / PATCH_RADIUS).astype(np.float32)
    # Derivatives with respect to translation and to the warp, the latter in pixels at the patch border.
    slopes = np.stack([along_u, along_v, along_u * u, along_u * v, along_v * u, along_v * v], axis=1)
    texture = patches[:, 1:-1, 1:-1].reshape(n, samples)
    texture = texture - texture.mean(axis=1, keepdims=True)
    power = np.maximum((texture**2).sum(axis=1), np.float32(1e-3))
    # Project out brightness and contrast, so that neither affects the warp.
    slopes -= slopes.mean(axis=2, keepdims=True)
    slopes -= (slopes @ texture[:, :, None] / power[:, None, None]) * texture[:, None]
    normal = (slopes @ slopes.transpose(0, 2, 1)).astype(float) + (NOISE_GRAY_LEVELS / WARP_PRIOR_PX) ** 2 * np.eye(6)
    inverse = np.linalg.inv(normal)
    steps = inverse @ slopes
    steps[:, 2:] /= PATCH_RADIUS
    filters = np.empty((n, samples, 8), np.float32)
    filters[:, :, :6] = steps.transpose(0, 2, 1)
    filters[:, :, 6] = texture / power[:, None]
    filters[:, :, 7] = 1.0 / samples
    sd = NOISE_GRAY_LEVELS * np.sqrt(0.5 * (inverse[:, 0, 0] + inverse[:, 1, 1]))
    return filters, np.sqrt(power.astype(float)), sd


def _track_pyramidal(previous: Image, current: Image, pixels: FloatArray, start: FloatArray) -> FloatArray:
    """Track points (n, 2) by pyramidal Lucas-Kanade from the start (n, 2); NaN on failure."""
    height, width = current.shape
    is_inside = ((start >= 0) & (start <= [width - 1, height - 1])).all(axis=1)
    tracked_pixels = np.full_like(pixels, np.nan)
    if not is_inside.any():
        return tracked_pixels
    # Pyramids cannot be reused between calls: OpenCV accepts them in C++ only, not in Python (its issue 7236). For the
    # area around the features they cost a tenth of a millisecond.
    both = np.concatenate([pixels[is_inside], start[is_inside]])
    n_added = _count_added_levels(current, float(np.ptp(both, axis=0).max()))
    left, top = np.maximum(both.min(axis=0).astype(np.int64) - (MARGIN_PX << n_added), 0)
    right, bottom = both.max(axis=0).astype(np.int64) + (MARGIN_PX << n_added) + 1
    window = slice(top, bottom), slice(left, right)
    corner = np.array([left, top], dtype=float)
    before, after = (flatten_illumination(image[window], FLATTEN_WINDOW_PX << n_added) for image in (previous, current))
    old, guess = ((p[is_inside] - corner).astype(np.float32) for p in (pixels, start))
    n_levels = KLT_LEVELS + n_added
    positions, status, _ = cv2.calcOpticalFlowPyrLK(before, after, old, guess, maxLevel=n_levels, **KLT_OPTIONS)
    tracked_pixels[is_inside] = np.where(status.reshape(-1, 1) > 0, positions.reshape(-1, 2) + corner, np.nan)
    return tracked_pixels


def _count_added_levels(image: Image, extent_px: float) -> int:
    """Return the number of pyramid levels that a large image adds.

    The window of the coarsest level is at most as wide as the features' extent: a wider one would follow what is around
    the object.
    """
    n_wanted = np.ceil(np.log2(max(image.shape) / KLT_SIDE_PX))
    n_possible = np.floor(np.log2(max(extent_px, 1.0) / (KLT_WINDOW_PX << KLT_LEVELS)))
    return max(int(min(n_wanted, n_possible)), 0)


def flatten_illumination(image: Image, window_px: int = FLATTEN_WINDOW_PX) -> Image:
    """Subtract the local mean brightness: Lucas-Kanade mistakes illumination changes for motion."""
    local_mean = cv2.blur(image, (window_px, window_px))
    return np.asarray(cv2.addWeighted(image, 1.0, local_mean, -1.0, 128.0), dtype=np.uint8)


@kernel
def _sample_patch(image: Image, x: float, y: float, warp: FloatArray, out: Filters) -> bool:
    """Sample the patch under a warp (2, 2) around (x, y), bilinear, in row order; False outside the image."""
    height, width = image.shape
    reach_u = PATCH_RADIUS * (abs(warp[0, 0]) + abs(warp[0, 1]))
    reach_v = PATCH_RADIUS * (abs(warp[1, 0]) + abs(warp[1, 1]))
    # NaN must count as outside.
    if not (x - reach_u >= 0.0 and y - reach_v >= 0.0 and x + reach_u < width - 1.01 and y + reach_v < height - 1.01):
        return False
    # 32 bits resolve a thousandth of a pixel and are twice as fast.
    right, down, one = np.float32(warp[0, 0]), np.float32(warp[1, 0]), np.uint32(1)
    i = 0
    for v in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
        u0 = np.float32(x + warp[0, 1] * v - warp[0, 0] * PATCH_RADIUS)
        v0 = np.float32(y + warp[1, 1] * v - warp[1, 0] * PATCH_RADIUS)
        for k in range(2 * PATCH_RADIUS + 1):
            at_u, at_v = u0 + right * np.float32(k), v0 + down * np.float32(k)
            column, row = np.uint32(at_u), np.uint32(at_v)
            fu, fv = at_u - np.float32(column), at_v - np.float32(row)
            a, b = np.float32(image[row, column]), np.float32(image[row, column + one])
            c, d = np.float32(image[row + one, column]), np.float32(image[row + one, column + one])
            above, below = a + fu * (b - a), c + fu * (d - c)
            out[i] = above + fv * (below - above)
            i += 1
    return True


@kernel
def _register_patches(
    image: Image,
    filters: Filters,
    contrast: FloatArray,
    index: IntArray,
    positions: FloatArray,
    warps: FloatArray,
    correlation: FloatArray,
) -> None:
    """Register template patches with an image.

    Args:
        image: (h, w) gray.
        filters, contrast: of all patches.
        index: (m,) patches to register.
        positions, warps: (m, 2), (m, 2, 2) initial positions and warps; overwritten with the final ones.
        correlation: (m,) overwritten with the final correlation; -1 for patches that leave the image or diverge.
    """
    samples = filters.shape[1]
    patch, sums = np.empty(samples, np.float32), np.empty(8, np.float32)
    for m in range(len(index)):
        filters_m, warp = filters[index[m]], warps[m]
        x, y = positions[m, 0], positions[m, 1]
        correlation[m] = -1.0
        has_converged = False
        for _ in range(MAX_ITERATIONS + 1):
            if not _sample_patch(image, x, y, warp, patch):
                break
            middle, square = patch[samples // 2], np.float32(0.0)
            sums[:] = 0.0
            for i in range(samples):
                value = patch[i] - middle  # small numbers lose less precision
                square += value * value
                for k in range(8):
                    sums[k] += filters_m[i, k] * value
            gain, power = float(sums[6]), float(square) - samples * float(sums[7]) ** 2
            if has_converged:
                correlation[m] = gain * contrast[index[m]] / np.sqrt(max(power, 1e-3))
                break
            if not gain > 0.1:
                break
            # The patch's step I + A, t is inverted before the warp W: W becomes W (I + A)^-1, and the position changes
            # by -W t.
            a, b, c, d = 1 + sums[2] / gain, sums[3] / gain, sums[4] / gain, 1 + sums[5] / gain
            area = a * d - b * c
            if not 0.3 < area < 3.0:
                break
            w00, w01, w10, w11 = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
            warp[0, 0], warp[0, 1] = (w00 * d - w01 * c) / area, (w01 * a - w00 * b) / area
            warp[1, 0], warp[1, 1] = (w10 * d - w11 * c) / area, (w11 * a - w10 * b) / area
            du = (warp[0, 0] * sums[0] + warp[0, 1] * sums[1]) / gain
            dv = (warp[1, 0] * sums[0] + warp[1, 1] * sums[1]) / gain
            x, y = x - du, y - dv
            if np.hypot(x - positions[m, 0], y - positions[m, 1]) > MAX_CORRECTION_PX:
                break
            has_converged = np.hypot(du, dv) < CONVERGENCE_PX
        positions[m, 0], positions[m, 1] = x, y
