"""Static background of a camera, and the rotation of the camera if it was moved.

Corners across the image are stored with small patches. While the camera is static, most patches match at their own
positions, a check that takes a tenth of a millisecond. Otherwise the corners are tracked from the stored image, and the
rotation about the camera center is estimated on which most of them agree: to first order, a bumped camera rotates,
whatever the scene depth.

Sources: corners of Shi & Tomasi, "Good features to track", CVPR 1994, tracked by Bouguet's pyramids (`klt`); the
rotation between two sets of directions by Kabsch, Acta Cryst. A32, 1976, on random pairs (RANSAC: Fischler & Bolles,
CACM 24, 1981).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.features.klt import flatten_illumination, to_gray
from sylpose.features.sift import detect_features, match_features
from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.rig import Camera

# Images are downscaled by an integer factor until their longer side is at most this, pixels.
MAX_SIDE_PX = 480
# Largest number of corners, least distance between them as a share of the longer side, and least strength as a share of
# the strongest. Fewer than `MIN_CORNERS` corners are inconclusive.
MAX_CORNERS, MIN_CORNER_DISTANCE, MIN_CORNER_QUALITY, MIN_CORNERS = 120, 0.045, 0.01, 20
# Patch radius around a corner, pixels of the downscaled image; least contrast, the standard deviation in gray levels;
# and least correlation of matching patches.
PATCH_RADIUS, MIN_CONTRAST, MIN_CORRELATION = 4, 10.0, 0.75
# Contrast to which downscaled images are normalized, gray levels, so that illumination changes are not mistaken for
# motion.
TARGET_CONTRAST = 30.0
# Pyramidal Lucas-Kanade: window, pixels; levels above the image; and the largest forward-backward error, pixels of the
# downscaled image.
KLT_WINDOW, KLT_LEVELS, MAX_ROUND_TRIP_PX = (15, 15), 3, 0.7
# If fewer than this share of the corners agree, they may have moved too far for tracking: SIFT features are matched
# instead. A camera has rotated if as many agree on it.
MIN_INLIER_RATIO = 0.6
# Number of corner pairs whose rotations are sampled, and the inlier threshold, pixels of the downscaled image.
N_RANSAC_SAMPLES, INLIER_PX = 300, 2.0
# Corners displaced by less than this, pixels of the downscaled image, are static.
STATIC_PX = 1.0
# Least noise of tracked corners, pixels of the downscaled image: their errors are not independent.
MIN_NOISE_PX = 0.1
# Margin that is ignored along the border of a rectified image, pixels.
BORDER_PX = 8


@dataclass(frozen=True, eq=False)
class StaticBackground:
    """Corners of a static reference image.

    Attributes:
        small_image: (h, w) the image, gray, illumination flattened and downscaled by `step`.
        pixels: (n, 2) corner positions in the full image.
        patches: (n, s) patches at the corners, zero mean and unit norm.
        step: downscaling factor.
    """

    small_image: Image
    pixels: FloatArray
    patches: FloatArray
    step: int

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, eq=False)
class CameraRotation:
    """Rotation of a camera since the reference image.

    Attributes:
        rotation: (3, 3) from directions in the reference image to those in the current one, camera axes.
        sd: standard deviation about the least observable axis, radians.
        n_evaluated: number of evaluated corners that would still be in the image.
        n_inliers: number of inliers.
        n_static: number of corners that are static instead.
        spread: least standard deviation over all directions of the inlier positions, relative to the image's shorter
            side.
        displacement_px: median displacement of the inliers, pixels of the image.
    """

    rotation: FloatArray
    sd: float
    n_evaluated: int
    n_inliers: int
    n_static: int
    spread: float
    displacement_px: float


def detect_corners(image: Image, area: BoolArray | None = None) -> StaticBackground:
    """Detect the corners of a reference image.

    Args:
        image: (h, w, 3) or (h, w).
        area: (h, w) area in which to detect; None: everywhere.
    """
    step = -(-max(image.shape[:2]) // MAX_SIDE_PX)
    small = _downscale_and_normalize(image, step)
    mask = None if area is None else np.ascontiguousarray(area[::step, ::step], dtype=np.uint8)
    if mask is not None:
        mask = mask[: small.shape[0], : small.shape[1]]
    distance = MIN_CORNER_DISTANCE * max(small.shape)
    corners: Any = cv2.goodFeaturesToTrack(small, MAX_CORNERS, MIN_CORNER_QUALITY, distance, mask=mask)
    positions = np.empty((0, 2)) if corners is None else np.asarray(corners, dtype=float).reshape(-1, 2)
    pixels = np.round(_to_image_pixels(positions, step))
    reach = step * PATCH_RADIUS
    inside = ((pixels >= reach) & (pixels < np.array(image.shape[1::-1]) - reach)).all(axis=1)
    patches, contrast = _sample_patches(image, pixels[inside], step)
    kept = contrast > MIN_CONTRAST
    return StaticBackground(small, pixels[inside][kept], patches[kept], step)


def find_unchanged_corners(background: StaticBackground, image: Image) -> BoolArray:
    """Return which corners (n,) look the same at the same position in another image, whatever the illumination."""
    patches, _ = _sample_patches(image, background.pixels, background.step)
    return np.asarray((patches * background.patches).sum(axis=1) > MIN_CORRELATION)


def estimate_camera_rotation(
    background: StaticBackground, image: Image, camera: Camera, is_used: BoolArray
) -> CameraRotation | None:
    """Estimate the camera rotation since the reference image, by RANSAC over its corners.

    Args:
        background: corners of the reference image.
        image: (h, w, 3) or (h, w) current image.
        camera: the camera.
        is_used: (n,) corners to use.

    Returns:
        The rotation with the most inliers; None with fewer than three.
    """
    small, size = _downscale_and_normalize(image, background.step), np.array(camera.size)
    pixels = background.pixels[is_used]
    positions = _to_small_pixels(pixels, background.step)
    if len(positions) < 3:
        return None
    before = _compute_directions(camera, pixels)
    limit = INLIER_PX * background.step / camera.focal
    best: tuple[int, FloatArray, FloatArray, BoolArray] | None = None
    start = positions
    for iteration in range(3):
        moved = _track_corners(background.small_image, small, positions, start)
        now = _compute_small_directions(camera, moved, background.step)
        rotation, is_inlier = _fit_rotation_ransac(before, now, limit)
        if best is None or is_inlier.sum() > best[0]:
            best = int(is_inlier.sum()), rotation, moved, is_inlier
        if iteration == 0 and is_inlier.sum() < MIN_INLIER_RATIO * len(positions):
            rotation = _estimate_by_sift(background, small, camera, limit)
        # Track again from the predicted corner positions.
        start = _to_small_pixels(_rotate_pixels(camera, rotation, pixels), background.step)
    assert best is not None
    count, rotation, moved, is_inlier = best
    if count < 3:
        return None
    predicted = _rotate_pixels(camera, rotation, pixels)
    inside = ((predicted >= 0) & (predicted <= size - 1)).all(axis=1)
    displacements = background.step * np.linalg.norm(moved - positions, axis=1)
    residuals = predicted[is_inlier] - _to_image_pixels(moved[is_inlier], background.step)
    noise = max(float(np.sqrt(np.mean(residuals**2))), MIN_NOISE_PX * background.step)
    outer_products = np.einsum("ni,nj->ij", before[is_inlier], before[is_inlier])
    information = (count * np.eye(3) - outer_products) * (camera.focal / noise) ** 2
    is_static = find_unchanged_corners(background, image)[is_used] | (displacements < STATIC_PX * background.step)
    sd = float(1.0 / np.sqrt(max(np.linalg.eigvalsh(information)[0], 1e-300)))
    spread = float(np.sqrt(max(np.linalg.eigvalsh(np.cov(pixels[is_inlier].T))[0], 0.0))) / float(size.min())
    evaluated, static = int((inside | is_inlier).sum()), int((~is_inlier & is_static).sum())
    displacement = float(np.median(displacements[is_inlier]))
    return CameraRotation(rotation, sd, evaluated, count, static, spread, displacement)


class RotationRectifier:
    """Rectification of a rotated camera's images to its original orientation, by a rotation (3, 3)."""

    def __init__(self, camera: Camera, rotation: FloatArray) -> None:
        self.camera, self.rotation = camera, rotation
        width, height = camera.size
        u, v = np.meshgrid(np.arange(float(width)), np.arange(float(height)))
        source = _rotate_pixels(camera, rotation, np.column_stack([u.ravel(), v.ravel()])).astype(np.float32)
        source = np.nan_to_num(source, nan=-1e4).reshape(height, width, 2)
        low, high = source.min(axis=2), (source - np.array([width - 1, height - 1])).max(axis=2)
        self.valid: BoolArray = (low >= 0) & (high <= 0)
        around = np.ones((2 * BORDER_PX + 1, 2 * BORDER_PX + 1), np.uint8)
        self.valid = cv2.erode(self.valid.astype(np.uint8), around).astype(bool)
        self._maps: Any = cv2.convertMaps(source, np.empty(0, np.float32), cv2.CV_16SC2)

    def rectify_image(self, image: Image) -> Image:
        """Rectify an image (h, w, 3) or (h, w); only pixels in `valid` (h, w) are usable."""
        u, v = self._maps
        return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)

    def rectify_mask(self, mask: BoolArray | None) -> BoolArray:
        """Rectify the object mask (h, w) and restrict it to the valid pixels; None: everywhere."""
        if mask is None:
            return self.valid
        u, v = self._maps
        rectified = cv2.remap(mask.astype(np.uint8), u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(rectified, dtype=bool) & self.valid


def _downscale_and_normalize(image: Image, step: int) -> Image:
    """Convert an image to gray, downscale it, flatten the illumination and normalize the contrast."""
    gray = to_gray(image)
    if step > 1:
        size = gray.shape[1] // step, gray.shape[0] // step
        cropped = gray[: step * size[1], : step * size[0]]
        gray = np.asarray(cv2.resize(cropped, size, interpolation=cv2.INTER_AREA), np.uint8)
    flattened = flatten_illumination(gray)
    gain = TARGET_CONTRAST / max(float(flattened.std()), MIN_CONTRAST)
    return np.asarray(cv2.convertScaleAbs(flattened, alpha=gain, beta=128.0 * (1.0 - gain)), np.uint8)


def _to_small_pixels(pixels: FloatArray, step: int) -> FloatArray:
    """Convert pixels (n, 2) of the full image to the downscaled one."""
    return np.asarray((pixels - (step - 1) / 2) / step)


def _to_image_pixels(positions: FloatArray, step: int) -> FloatArray:
    """Convert pixels (n, 2) of the downscaled image to the full one."""
    return np.asarray(positions * step + (step - 1) / 2)


def _sample_patches(image: Image, pixels: FloatArray, step: int) -> tuple[FloatArray, FloatArray]:
    """Sample patches (n, s) of unit norm and their contrast (n,), gray levels.

    Every `step`th pixel around integer pixels (n, 2) is used.
    """
    patches, contrast = np.empty((len(pixels), (2 * PATCH_RADIUS + 1) ** 2)), np.empty(len(pixels))
    channels = image.reshape(*image.shape[:2], -1)
    fill_patches(channels, pixels.astype(np.int64), step, patches, contrast)
    return patches, contrast


@kernel
def fill_patches(image: Image, pixels: IntArray, step: int, patches: FloatArray, contrast: FloatArray) -> None:
    """Fill patches (n, s) and contrast (n,), see `_sample_patches`, from an image (h, w, channels)."""
    n_channels, samples = image.shape[2], patches.shape[1]
    for n in range(len(pixels)):
        patch, i, mean = patches[n], 0, 0.0
        for v in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
            for u in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
                value = 0.0
                for k in range(n_channels):
                    value += image[pixels[n, 1] + step * v, pixels[n, 0] + step * u, k]
                patch[i] = value / n_channels
                mean += patch[i] / samples
                i += 1
        square = 0.0
        for i in range(samples):
            patch[i] -= mean
            square += patch[i] * patch[i]
        contrast[n] = np.sqrt(square / samples)
        norm = max(np.sqrt(square), 1e-9)
        for i in range(samples):
            patch[i] /= norm


def _estimate_by_sift(background: StaticBackground, small: Image, camera: Camera, limit: float) -> FloatArray:
    """Estimate the rotation (3, 3) from SIFT matches between the two images, for any displacement."""
    a, b = detect_features(background.small_image, camera), detect_features(small, camera)
    i, j = match_features(a, b).T
    before, now = (_compute_small_directions(camera, p, background.step) for p in (a.pixels[i], b.pixels[j]))
    return _fit_rotation_ransac(before, now, limit)[0]


def _compute_small_directions(camera: Camera, positions: FloatArray, step: int) -> FloatArray:
    """Return unit directions (n, 3), camera axes, of pixels (n, 2) in the downscaled image; NaN for NaN."""
    out, is_finite = np.full((len(positions), 3), np.nan), np.isfinite(positions).all(axis=1)
    out[is_finite] = _compute_directions(camera, _to_image_pixels(positions[is_finite], step))
    return out


def _track_corners(small: Image, other: Image, positions: FloatArray, start: FloatArray) -> FloatArray:
    """Track points (n, 2) by KLT into another image; NaN if lost or if the forward-backward check fails."""
    start = np.where(np.isfinite(start), start, positions)
    options: dict[str, Any] = {"winSize": KLT_WINDOW, "maxLevel": KLT_LEVELS, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    points, start = positions.astype(np.float32), start.astype(np.float32)
    forward, forward_status, _ = cv2.calcOpticalFlowPyrLK(small, other, points, start.copy(), **options)
    # Starting at the original position would make the backward check too easy.
    returned = forward - (start - points)
    backward, backward_status, _ = cv2.calcOpticalFlowPyrLK(other, small, forward, returned, **options)
    is_tracked = (forward_status.ravel() > 0) & (backward_status.ravel() > 0)
    good = is_tracked & (np.linalg.norm(backward - points, axis=1) < MAX_ROUND_TRIP_PX)
    inside = ((forward >= 0) & (forward <= np.array(other.shape[::-1]) - 1)).all(axis=1)
    return np.where((good & inside)[:, None], forward.astype(float), np.nan)


def _compute_directions(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Return unit vectors (n, 3), camera axes."""
    rays = np.column_stack([camera.normalize(pixels), np.ones(len(pixels))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _rotate_pixels(camera: Camera, rotation: FloatArray, pixels: FloatArray) -> FloatArray:
    """Project pixels (n, 2) after a rotation of the camera; NaN for points behind it."""
    rays = _compute_directions(camera, pixels) @ rotation.T
    out = np.full((len(pixels), 2), np.nan)
    is_in_front = rays[:, 2] > 0.05
    out[is_in_front] = camera.denormalize(rays[is_in_front, :2] / rays[is_in_front, 2:])
    return out


def _fit_rotation_ransac(before: FloatArray, now: FloatArray, limit: float) -> tuple[FloatArray, BoolArray]:
    """Estimate the rotation between directions (n, 3) by RANSAC.

    Args:
        before, now: (n, 3) unit directions; NaN in `now` for missing ones.
        limit: inlier threshold, radians.

    Returns:
        The rotation (3, 3), and the inliers (n,).
    """
    visible = np.flatnonzero(np.isfinite(now).all(axis=1))
    is_inlier = np.zeros(len(before), bool)
    if len(visible) < 3:
        return np.eye(3), is_inlier
    one, two = np.random.default_rng(0).choice(visible, (2, N_RANSAC_SAMPLES))
    a, b = _build_triads(before[one], before[two]), _build_triads(now[one], now[two])
    candidates = b @ a.transpose(0, 2, 1)
    errors = np.linalg.norm(before @ candidates.transpose(0, 2, 1) - now, axis=2)
    is_inlier = errors[int((errors < limit).sum(axis=1).argmax())] < limit
    rotation = np.eye(3)
    for _ in range(3):
        if is_inlier.sum() < 3:
            break
        rotation = Rotation.align_vectors(now[is_inlier], before[is_inlier])[0].as_matrix()
        is_inlier = np.linalg.norm(before @ rotation.T - now, axis=1) < limit
    return np.asarray(rotation), np.asarray(is_inlier)


def _build_triads(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return right-handed axes (m, 3, 3), as columns, of direction pairs (m, 3); NaN for parallel ones."""
    across = np.cross(first, second)
    with np.errstate(invalid="ignore", divide="ignore"):
        across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([first, across, np.cross(first, across)], axis=2)
