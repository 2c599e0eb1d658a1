"""SIFT keypoints of images that the tests have seen: many track one recording several times.

OpenCV's keypoints depend on the image, the mask and the limits only (features/test_sift.py).
"""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from sylpose.geometry.arrays import FloatArray, Image

Found = tuple[tuple[Any, ...], FloatArray | None]


@lru_cache(400)
def _detect(shape: tuple[int, ...], image: bytes, mask: bytes | None, limits: tuple[tuple[str, float], ...]) -> Found:
    pixels, where = (None if data is None else np.frombuffer(data, np.uint8).reshape(shape) for data in (image, mask))
    found: Found = cv2.SIFT_create(**dict(limits)).detectAndCompute(pixels, where)  # type: ignore[attr-defined]
    if found[1] is not None:
        found[1].flags.writeable = False
    return found


class RememberedSift:
    """In place of `cv2.SIFT`."""

    def __init__(self, **limits: float) -> None:
        self._limits = tuple(limits.items())

    def detectAndCompute(self, image: Image, mask: Image | None) -> Found:
        return _detect(image.shape, image.tobytes(), None if mask is None else mask.tobytes(), self._limits)


# In place of `cv2` in sylpose.features.sift.
REMEMBERED = SimpleNamespace(**{**vars(cv2), "SIFT_create": RememberedSift})
