"""Search windows: parts of an image, one of which is searched for a lost object in each frame.

Cameras are static: where the picture has not changed since it was searched, nothing new can be found. So the likeliest
window is the one that has changed most. Every now and then the window is taken that was searched longest ago, so that
each is searched again within a bounded number of frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray

# Pixels of the image per pixel of the thumbnail: noise and motion of a pixel average out (choice).
THUMBNAIL_STEP = 8
# Windows overlap by half, so that one of them contains most of an object of a window's size (derived).
WINDOW_OVERLAP = 0.5

_cv2: Any = cv2


@dataclass(frozen=True, eq=False)
class SearchWindows:
    """Windows of an image, and what each looked like when it was last searched.

    Attributes:
        bounds: (n, 4) left, top, right and bottom of each window, pixels; right and bottom are exclusive.
        ages: (n,) number of searches since each was searched.
        thumbnail: (h, w) the image, `THUMBNAIL_STEP` times smaller, each part as it was last searched.
    """

    bounds: IntArray
    ages: IntArray
    thumbnail: FloatArray

    @classmethod
    def create(cls, side_px: float, image: Image) -> SearchWindows:
        """Create the whole image and square windows that overlap by half.

        Args:
            side_px: side of a window, pixels.
            image: (h, w) or (h, w, 3), from which changes count.
        """
        height, width = image.shape[:2]
        rows, columns = _split(height, side_px), _split(width, side_px)
        parts = [(left, top, right, bottom) for top, bottom in rows for left, right in columns]
        bounds = np.array([(0, 0, width, height), *parts])
        return cls(bounds, np.zeros(len(bounds), np.int64), _make_thumbnail(image))

    def select(self, image: Image, *, oldest: bool) -> tuple[SearchWindows, BoolArray]:
        """Select the window to search in the next image.

        Args:
            image: the next image.
            oldest: take the window searched longest ago instead of the one that has changed most.

        Returns:
            the windows after that search; the window's mask (h, w).
        """
        seen = _make_thumbnail(image)
        cells = np.column_stack([self.bounds[:, :2] // THUMBNAIL_STEP, -(-self.bounds[:, 2:] // THUMBNAIL_STEP)])
        change = np.abs(seen - self.thumbnail)
        changes = [change[top:bottom, left:right].mean() for left, top, right, bottom in cells]
        chosen = int(np.argmax(self.ages if oldest else changes))
        (left, top, right, bottom), thumbnail, ages = cells[chosen], self.thumbnail.copy(), self.ages + 1
        thumbnail[top:bottom, left:right], ages[chosen] = seen[top:bottom, left:right], 0
        mask = np.zeros(image.shape[:2], bool)
        left, top, right, bottom = self.bounds[chosen]
        mask[top:bottom, left:right] = True
        return replace(self, ages=ages, thumbnail=thumbnail), mask


def _split(length: int, side: float) -> list[tuple[int, int]]:
    """Split a length into overlapping parts: their begins and ends."""
    side = min(side, length)
    count = 1 + int(np.ceil((length - side) / (WINDOW_OVERLAP * side)))
    begins = np.linspace(0.0, length - side, count)
    return [(int(begin), min(int(np.ceil(begin + side)), length)) for begin in begins]


def _make_thumbnail(image: Image) -> FloatArray:
    """Make a small gray image."""
    size = [-(-length // THUMBNAIL_STEP) for length in image.shape[1::-1]]
    small = np.asarray(_cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=float)
    return small if small.ndim == 2 else small.mean(axis=2)
