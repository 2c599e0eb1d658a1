"""SIFT keypoints of the object, and matches between two frames of the same camera."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sylpose.features.patches import SIDE, Patches, sample_patches
from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.matches import STATIC_PX
from sylpose.rig import Camera

# Padding of a crop, pixels: the object region has a margin already, and SIFT's time is proportional to the area.
CROP_MARGIN_PX = 8
MAX_FEATURES = 1000
# Least contrast: OpenCV compares it with so many times a keypoint's response (derived: its layers per octave). It is
# lower than Lowe's 0.04: uniform objects have few stronger features, and matches that are not of the object are
# rejected later (choice).
MIN_CONTRAST, RESPONSE_SCALE = 0.02, 3.0
# Fallback settings if these are not enough: maximum number of keypoints, lower contrast threshold, and an edge
# threshold that also admits keypoints on edges.
MAX_FAINT_FEATURES, FAINT_CONTRAST, FAINT_EDGE = 4000, 0.005, 20.0
# Keypoints closer to each other than this, pixels, are at the same position.
SAME_POSITION_PX = 3.0
# OpenCV's SIFT first doubles the image, and its keypoints are biased by half of a pixel of that, right and down. (Its
# enable_precise_upscale, since OpenCV 4.8, also removes that, but tracks less precisely.)
SIFT_BIAS_PX = 0.25
# Least cosine of two RootSIFT descriptors of the same point; unrelated ones stay below about 0.7.
MIN_COSINE = 0.85
# Number of pixels that all threads process at the same time, for each two cores: SIFT holds 11 images of four times as many
# pixels, of four bytes, and their octaves, 235 bytes per pixel; these are 0.5 GB, a whole Full HD image (choice).
MAX_CONCURRENT_PIXELS = 1920 * 1080
FULL_RESOLUTION = np.ones(2)

_cv2: Any = cv2  # OpenCV's type stubs lack SIFT


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one image.

    Attributes:
        pixels: (n, 2) in the image as recorded.
        normalized: (n, 2) the same points, undistorted, in normalized coordinates.
        descriptors: (n, 128) float32 RootSIFT, unit length.
        faint: (n,) True for keypoints below the normal contrast threshold; all False by default.
        patches: (n, s, s) what the image shows around them (`patches`); unknown by default.
    """

    pixels: FloatArray
    normalized: FloatArray
    descriptors: NDArray[np.float32]
    faint: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    patches: Patches = field(default_factory=lambda: np.zeros((0, SIDE, SIDE), np.uint8))

    def __post_init__(self) -> None:
        for name in ("faint", "patches"):
            default = getattr(self, name)
            if not len(default):
                object.__setattr__(self, name, np.zeros((len(self.pixels), *default.shape[1:]), default.dtype))

    def __len__(self) -> int:
        return len(self.pixels)

    @cached_property
    def tree(self) -> cKDTree:
        """KD-tree of the pixels."""
        return cKDTree(self.pixels)

    def subset(self, index: IntArray | BoolArray) -> Features:
        """Return the keypoints selected by a mask or an index array."""
        rows = np.flatnonzero(index) if index.dtype == np.bool_ else index
        return Features(*(getattr(self, f.name).take(rows, axis=0) for f in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence[Features]) -> Features:
        """Concatenate keypoint sets in the given order."""
        parts = [cls.empty(), *parts]
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    @classmethod
    def empty(cls) -> Features:
        """Return an empty set of keypoints, for a camera without an image or with an empty region."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 128), np.float32))


class _PixelBudget:
    """Bound on the pixels that SIFT processes at the same time, in all threads; a larger image is processed alone."""

    def __init__(self, limit: int) -> None:
        self._limit, self._used, self._condition = limit, 0, threading.Condition()

    @contextmanager
    def take(self, n_pixels: int) -> Iterator[None]:
        """Wait until so many pixels are free, and occupy them."""
        n = min(n_pixels, self._limit)
        with self._condition:
            self._condition.wait_for(lambda: self._used + n <= self._limit)
            self._used += n
        try:
            yield
        finally:
            with self._condition:
                self._used -= n
                self._condition.notify_all()


_budget = _PixelBudget(MAX_CONCURRENT_PIXELS * max((os.cpu_count() or 1) // 2, 1))


def reduce_image(image: Image, max_pixels: int) -> Image:
    """Convert an image to gray and downscale it to at most so many pixels.

    Args:
        image: (h, w, 3) BGR or (h, w) gray.
    """
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    if gray.size <= max_pixels:
        return np.asarray(gray, np.uint8)
    smaller = np.floor(np.array(gray.shape[::-1]) * np.sqrt(max_pixels / gray.size)).astype(int)
    return np.asarray(_cv2.resize(gray, smaller.tolist(), interpolation=cv2.INTER_AREA), np.uint8)


def enlarge_image(image: Image, size: tuple[int, int]) -> Image:
    """Enlarge an image that `reduce_image` has downscaled, to a size (width, height)."""
    return np.asarray(_cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)


def detect_features(
    image: Image,
    camera: Camera,
    mask: BoolArray | None = None,
    max_features: int = MAX_FEATURES,
    *,
    faint: bool = False,
    max_pixels: int | None = None,
    step: FloatArray = FULL_RESOLUTION,
) -> Features:
    """Detect SIFT keypoints with RootSIFT descriptors.

    Args:
        image: (h, w, 3) BGR or (h, w) gray.
        camera: the camera, for undistortion.
        mask: (h, w) True where to detect; only its bounding box is processed. None: everywhere.
        max_features: the strongest keypoints are kept.
        faint: also accept low contrast and edges.
        max_pixels: the processed area is downscaled to at most this many pixels, which reduces the precision
            accordingly. None: full resolution.
        step: (2,) pixels of the camera per pixel of the image, in u and v, if it was downscaled by `reduce_image`.

    Source: Lowe 2004; RootSIFT, Arandjelovic & Zisserman, "Three things everyone should know", CVPR 2012.
    """
    top, left, bottom, right = 0, 0, *image.shape[:2]
    crop_mask = None
    if mask is not None:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        if len(rows) == 0:
            return Features.empty()
        top, bottom = max(rows[0] - CROP_MARGIN_PX, 0), min(rows[-1] + 1 + CROP_MARGIN_PX, bottom)
        left, right = max(columns[0] - CROP_MARGIN_PX, 0), min(columns[-1] + 1 + CROP_MARGIN_PX, right)
        crop_mask = mask[top:bottom, left:right].astype(np.uint8) * 255
    crop = image[top:bottom, left:right]
    converted = cv2.cvtColor(crop, cv2.COLOR_BGR2GRAY) if crop.ndim == 3 else crop
    gray: Image = np.ascontiguousarray(converted, np.uint8)
    corner, full, full_step = step * np.array([left, top]), gray, step
    if max_pixels is not None and gray.size > max_pixels:
        size, gray = np.array(gray.shape[::-1]), reduce_image(gray, max_pixels)
        step = step * size / gray.shape[::-1]
        if crop_mask is not None:
            crop_mask = _cv2.resize(crop_mask, gray.shape[::-1], interpolation=cv2.INTER_NEAREST)
    faint_limits = {"contrastThreshold": FAINT_CONTRAST, "edgeThreshold": FAINT_EDGE}
    limits = faint_limits if faint else {"contrastThreshold": MIN_CONTRAST}
    sift = _cv2.SIFT_create(nfeatures=max_features, **limits)
    with _budget.take(gray.size):
        keypoints, descriptors = sift.detectAndCompute(gray, crop_mask)
    if descriptors is None or len(keypoints) == 0:
        return Features.empty()
    # The center of the first pixel is 0, also in the downscaled image.
    pixels = step * _cv2.KeyPoint_convert(keypoints).astype(float).reshape(-1, 2) + corner
    pixels += 0.5 * (step - 1.0) - step * SIFT_BIAS_PX
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
    is_faint = RESPONSE_SCALE * np.array([keypoint.response for keypoint in keypoints]) < MIN_CONTRAST
    patches = sample_patches(full, pixels, full_step, corner + 0.5 * (full_step - 1.0))
    return Features(pixels, camera.normalize_to_grid(pixels), root.astype(np.float32), is_faint, patches)


def match_features(a: Features, b: Features, ratio: float = 0.8, max_displacement_px: float = np.inf) -> IntArray:
    """Match features by mutual nearest neighbors with the ratio test.

    Args:
        a, b: features of the same camera in two frames.
        ratio: largest ratio of the distances to the best and the second best.
        max_displacement_px: matches displaced by more are dropped.

    Returns:
        (m, 2) indices into a and b. Keypoints with several SIFT orientations count once.
    """
    if len(a) < 2 or len(b) < 2:
        return np.empty((0, 2), np.int64)
    # Unit vectors: |u - v|^2 = 2 - 2 u.v, so one matrix product gives all distances.
    similarity = a.descriptors @ b.descriptors.T
    rows = np.arange(len(a))
    forward = similarity.argmax(axis=1)
    best = similarity[rows, forward]
    mutual = best == similarity.max(axis=0)[forward]
    similarity[rows, forward] = -1.0
    second = similarity.max(axis=1)
    i = np.flatnonzero(mutual & (1.0 - best <= ratio**2 * (1.0 - second)))
    j = forward[i]
    near = np.linalg.norm(a.pixels[i] - b.pixels[j], axis=1) <= max_displacement_px
    pairs = np.column_stack([i, j])[near]
    positions = np.rint(10.0 * np.concatenate([a.pixels[pairs[:, 0]], b.pixels[pairs[:, 1]]], axis=1))
    order = np.lexsort(positions.T)
    new = np.ones(len(order), bool)
    new[1:] = (positions[order[1:]] != positions[order[:-1]]).any(axis=1)
    return np.asarray(pairs[np.sort(order[new])])


def match_guided(
    a: Features, b: Features, segments: FloatArray, max_distance_px: float, ratio: float = 0.9, min_cosine: float = 0.7
) -> IntArray:
    """Match features near their predicted positions by mutual nearest neighbors.

    As few other candidates are near, the ratio test may be looser than that of `match_features`.

    Args:
        a, b: features of the same camera in two frames.
        segments: (n, 2, 2) pixels: each feature of a is predicted in b's image on the segment between these two ends;
            NaN: nowhere.
        max_distance_px: largest distance from the segment, pixels.
        ratio: largest ratio of the distances to the best and to the second best at another position.
        min_cosine: least cosine of the descriptors.

    Returns:
        (m, 2) indices into a and b.
    """
    rows = np.flatnonzero(np.isfinite(segments).all(axis=(1, 2)))
    if not len(rows) or not len(b):
        return np.empty((0, 2), np.int64)
    similarity = a.descriptors[rows] @ b.descriptors.T
    x, y = np.ascontiguousarray(b.pixels.T)
    _drop_distant(similarity, segments[rows, 0], segments[rows, 1] - segments[rows, 0], x, y, max_distance_px)
    chosen = similarity.argmax(axis=1)
    best = similarity[np.arange(len(rows)), chosen]
    mutual = np.flatnonzero((best >= min_cosine) & (best == similarity.max(axis=0)[chosen]))
    # Candidates at the same position are the same point with another orientation or scale.
    same = b.tree.query_ball_point(b.pixels[chosen[mutual]], SAME_POSITION_PX)
    similarity[np.repeat(mutual, [len(index) for index in same]), np.concatenate([np.empty(0, np.int64), *same])] = -1.0
    kept = mutual[1.0 - best[mutual] <= ratio**2 * (1.0 - similarity[mutual].max(axis=1))]
    return np.column_stack([rows[kept], chosen[kept]])


@kernel
def _drop_distant(
    similarity: NDArray[Any], start: FloatArray, along: FloatArray, x: FloatArray, y: FloatArray, max_distance: float
) -> None:
    """Set the similarity (n, m) of points (m,), (m,) to -1 that are farther than this from segments (n, 2), (n, 2)."""
    for i in range(len(start)):
        squared = max(along[i, 0] ** 2 + along[i, 1] ** 2, 1e-12)
        u, v = along[i, 0] / squared, along[i, 1] / squared
        row = similarity[i]
        for j in range(len(x)):
            dx, dy = x[j] - start[i, 0], y[j] - start[i, 1]
            fraction = min(max(dx * u + dy * v, 0.0), 1.0)
            dx -= fraction * along[i, 0]
            dy -= fraction * along[i, 1]
            row[j] = row[j] if dx * dx + dy * dy <= max_distance * max_distance else np.float32(-1.0)


def find_static_features(features: Features, earlier: Features, max_distance_px: float = STATIC_PX) -> BoolArray:
    """Find features (n,) that have not moved since an earlier frame of the same camera.

    They are at the same position with a similar descriptor.

    Args:
        features: of the current frame.
        earlier: of the earlier frame.
        max_distance_px: largest distance, pixels.
    """
    if len(features) == 0 or len(earlier) == 0:
        return np.zeros(len(features), bool)
    gap, nearest = earlier.tree.query(features.pixels, 3, distance_upper_bound=max_distance_px)
    out, near = np.zeros(len(features), bool), np.isfinite(gap).any(axis=1)
    earlier_descriptors = earlier.descriptors[np.minimum(nearest[near], len(earlier) - 1)]
    similar = np.einsum("nd,nkd->nk", features.descriptors[near], earlier_descriptors)
    out[near] = (np.isfinite(gap[near]) & (similar > MIN_COSINE)).any(axis=1)
    return out
