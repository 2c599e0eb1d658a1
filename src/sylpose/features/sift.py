"""Features of the object: SIFT keypoints per frame, and matches between two frames of the same camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.matches import STILL_PX
from sylpose.rig import Camera

__all__ = [
    "ALL_FEATURES",
    "MAX_FEATURES",
    "Features",
    "detect",
    "match_features",
    "match_where_expected",
    "seen_before",
]


# A crop is padded by this: the object's region has a margin of its own, and SIFT's time is that of its area.
CROP_MARGIN_PX = 8
MAX_FEATURES = 1000
# Least contrast: OpenCV compares it with so many times a keypoint's response (derived: its layers per octave). Lower than
# Lowe's 0.04: on plain objects there is little else to go by, and what is not the object's motion is rejected
# later (choice).
CONTRAST, RESPONSES = 0.02, 3.0
# Where these are not enough, everything that can be found: so many, with so little contrast, and along edges too.
ALL_FEATURES, FAINT_CONTRAST, FAINT_EDGE = 4000, 0.005, 20.0
# Keypoints nearer to each other than this, pixels, are at the same place.
SAME_PLACE_PX = 3.0
# OpenCV's SIFT doubles the image first, and its keypoints are off by half of a pixel of that, right and down.
# (Its enable_precise_upscale, which OpenCV has since 4.8, removes that too, but tracks less precisely.)
SIFT_BIAS_PX = 0.25
# Cosine of two RootSIFT descriptors of the same thing seen again; unrelated ones stay below about 0.7.
SAME_LOOK = 0.85

_cv2: Any = cv2  # its type stubs lack SIFT


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one image.

    Attributes:
        pixels: (n, 2) in the image as recorded.
        normalized: (n, 2) the same points undistorted.
        descriptors: (n, 128) float32 RootSIFT, unit length.
        faint: (n,) which have so little contrast that they are only found where they are asked for; none, if not said.
    """

    pixels: FloatArray
    normalized: FloatArray
    descriptors: NDArray[np.float32]
    faint: BoolArray = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        if not len(self.faint):
            object.__setattr__(self, "faint", np.zeros(len(self.pixels), bool))

    def __len__(self) -> int:
        return len(self.pixels)

    @cached_property
    def tree(self) -> cKDTree:
        """Of the pixels."""
        return cKDTree(self.pixels)

    def subset(self, index: IntArray | BoolArray) -> Features:
        """The keypoints that a mask or an index array picks."""
        return Features(self.pixels[index], self.normalized[index], self.descriptors[index], self.faint[index])

    @classmethod
    def concatenate(cls, parts: Sequence[Features]) -> Features:
        """All parts after each other."""
        parts = [cls.none(), *parts]
        return cls(
            np.concatenate([p.pixels for p in parts]),
            np.concatenate([p.normalized for p in parts]),
            np.concatenate([p.descriptors for p in parts]),
            np.concatenate([p.faint for p in parts]),
        )

    @classmethod
    def none(cls) -> Features:
        """No keypoints: a camera without an image, or whose region is empty."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 128), np.float32))


def detect(
    image: Image,
    camera: Camera,
    mask: BoolArray | None = None,
    max_features: int = MAX_FEATURES,
    *,
    faint: bool = False,
    max_pixels: int | None = None,
) -> Features:
    """SIFT keypoints with RootSIFT descriptors.

    Args:
        image: (h, w, 3) BGR or (h, w) grey.
        camera: whose lens is taken out.
        mask: (h, w) True where to look; only its bounding box is computed. None: everywhere.
        max_features: the strongest are kept.
        faint: whether little contrast, or an edge, is enough.
        max_pixels: what is looked at is made smaller until it has no more than these, and what is found is less exact by as
            much. None: as it is.

    Source: Lowe 2004; RootSIFT, Arandjelovic & Zisserman, "Three things everyone should know", CVPR 2012.
    """
    top, left, bottom, right = 0, 0, *image.shape[:2]
    crop_mask = None
    if mask is not None:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        if len(rows) == 0:
            return Features.none()
        top, bottom = max(rows[0] - CROP_MARGIN_PX, 0), min(rows[-1] + 1 + CROP_MARGIN_PX, bottom)
        left, right = max(columns[0] - CROP_MARGIN_PX, 0), min(columns[-1] + 1 + CROP_MARGIN_PX, right)
        crop_mask = mask[top:bottom, left:right].astype(np.uint8) * 255
    crop = image[top:bottom, left:right]
    grey = cv2.cvtColor(crop, cv2.COLOR_BGR2GRAY) if crop.ndim == 3 else np.ascontiguousarray(crop)
    step = np.ones(2)
    if max_pixels is not None and grey.size > max_pixels:
        size = np.array(grey.shape[1::-1])
        smaller = np.floor(size * np.sqrt(max_pixels / grey.size)).astype(int)
        grey, step = _cv2.resize(grey, smaller.tolist(), interpolation=cv2.INTER_AREA), size / smaller
        if crop_mask is not None:
            crop_mask = _cv2.resize(crop_mask, smaller.tolist(), interpolation=cv2.INTER_NEAREST)
    limits = (
        {"contrastThreshold": FAINT_CONTRAST, "edgeThreshold": FAINT_EDGE} if faint else {"contrastThreshold": CONTRAST}
    )
    sift = _cv2.SIFT_create(nfeatures=max_features, **limits)
    keypoints, descriptors = sift.detectAndCompute(grey, crop_mask)
    if descriptors is None or len(keypoints) == 0:
        return Features.none()
    # The centre of the first pixel is 0, in the smaller image too.
    pixels = step * _cv2.KeyPoint_convert(keypoints).astype(float).reshape(-1, 2) + np.array([left, top])
    pixels += 0.5 * (step - 1.0) - step * SIFT_BIAS_PX
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
    responses = np.array([keypoint.response for keypoint in keypoints])
    return Features(pixels, camera.normalize_to_grid(pixels), root.astype(np.float32), RESPONSES * responses < CONTRAST)


def match_features(a: Features, b: Features, ratio: float = 0.8, max_shift_px: float = np.inf) -> IntArray:
    """Mutual nearest neighbours that pass the ratio test.

    Args:
        a, b: features of the same camera in two frames.
        ratio: largest ratio of the distances to the best and the second best.
        max_shift_px: matches displaced by more are dropped.

    Returns:
        (m, 2) indices into a and b. Keypoints that SIFT gives several orientations count once.
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
    near = np.linalg.norm(a.pixels[i] - b.pixels[j], axis=1) <= max_shift_px
    pairs = np.column_stack([i, j])[near]
    places = np.rint(10.0 * np.concatenate([a.pixels[pairs[:, 0]], b.pixels[pairs[:, 1]]], axis=1))
    order = np.lexsort(places.T)
    new = np.ones(len(order), bool)
    new[1:] = (places[order[1:]] != places[order[:-1]]).any(axis=1)
    return np.asarray(pairs[np.sort(order[new])])


def match_where_expected(
    a: Features, b: Features, ends: FloatArray, reach_px: float, ratio: float = 0.9, look: float = 0.7
) -> IntArray:
    """Mutual nearest neighbours among those that are where they should be. As few others are there, the ratio test may be
    looser than that of `match_features`.

    Args:
        a, b: features of the same camera in two frames.
        ends: (n, 2, 2) pixels: each feature of a should be in b's image along the line between its two ends; NaN: nowhere.
        reach_px: so far from it at most.
        ratio: largest ratio of the distances to the best and to the second best at another place.
        look: least cosine of the descriptors.

    Returns:
        (m, 2) indices into a and b.
    """
    rows = np.flatnonzero(np.isfinite(ends).all(axis=(1, 2)))
    if not len(rows) or not len(b):
        return np.empty((0, 2), np.int64)
    start, along = ends[rows, 0], ends[rows, 1] - ends[rows, 0]
    length = np.linalg.norm(along, axis=1)
    near = b.tree.query_ball_point(start + along / 2, length / 2 + reach_px)
    counts = np.array([len(index) for index in near])
    row, column = np.repeat(np.arange(len(rows)), counts), np.concatenate([*map(np.asarray, near)]).astype(np.int64)
    away = b.pixels[column] - start[row]
    share = np.clip((away * along[row]).sum(axis=1) / np.maximum(length[row] ** 2, 1e-12), 0.0, 1.0)
    close = np.linalg.norm(away - share[:, None] * along[row], axis=1) <= reach_px
    row, column = row[close], column[close]
    if not len(row):
        return np.empty((0, 2), np.int64)
    similar = np.einsum("nd,nd->n", a.descriptors[rows[row]], b.descriptors[column])
    best, others = np.full(len(rows), -1.0, np.float32), np.full(len(b), -1.0, np.float32)
    np.maximum.at(best, row, similar)
    np.maximum.at(others, column, similar)
    chosen = np.full(len(rows), -1)
    chosen[row[similar == best[row]]] = column[similar == best[row]]
    # What is at the same place is the same thing, with another orientation or scale.
    elsewhere = np.linalg.norm(b.pixels[column] - b.pixels[chosen[row]], axis=1) > SAME_PLACE_PX
    second = np.full(len(rows), -1.0, np.float32)
    np.maximum.at(second, row[elsewhere], similar[elsewhere])
    mutual = (chosen >= 0) & (best == others[chosen]) & (best >= look)
    kept = np.flatnonzero(mutual & (1.0 - best <= ratio**2 * (1.0 - second)))
    return np.column_stack([rows[kept], chosen[kept]])


def seen_before(features: Features, earlier: Features, still_px: float = STILL_PX) -> BoolArray:
    """(n,) features that an earlier frame of the same camera has at the same place, within some pixels, with the same
    look."""
    if len(features) == 0 or len(earlier) == 0:
        return np.zeros(len(features), bool)
    gap, nearest = earlier.tree.query(features.pixels, 3, distance_upper_bound=still_px)
    out, near = np.zeros(len(features), bool), np.isfinite(gap).any(axis=1)
    theirs = earlier.descriptors[np.minimum(nearest[near], len(earlier) - 1)]
    similar = np.einsum("nd,nkd->nk", features.descriptors[near], theirs)
    out[near] = (np.isfinite(gap[near]) & (similar > SAME_LOOK)).any(axis=1)
    return out
