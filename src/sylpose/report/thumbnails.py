"""Images of cameras, small enough that some dozens of them fit into a page."""

from __future__ import annotations

import cv2
import numpy as np

from sylpose.numerics.arrays import Image

__all__ = ["shrunk", "thumbnail"]

# Width in pixels with up to four cameras, narrower with more, so that all together take as much (choice: an object a tenth
# as wide as the image still has fifty pixels); JPEG's quality (choice).
WIDTH, LEAST, CAMERAS, QUALITY = 448, 128, 4, 68


def thumbnail(image: Image | None, cameras: int) -> bytes | None:
    """A JPEG file; None without an image.

    Args:
        image: (h, w, 3) BGR or (h, w) grey.
        cameras: how many there are.
    """
    if image is None:
        return None
    width = max(LEAST, round(WIDTH * min(1.0, CAMERAS / cameras) ** 0.5))
    image = shrunk(image, width)
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return bytes(data) if done else None


def shrunk(image: Image, width: int) -> Image:
    """An image no wider than that."""
    # Halved first, which is a sixth of the time that it takes at once.
    while image.shape[1] >= 2 * width and min(image.shape[:2]) > 1:
        image = _resized(image, image.shape[1] // 2, image.shape[0] // 2, cv2.INTER_AREA)
    if image.shape[1] > width:
        image = _resized(image, width, max(1, round(width / image.shape[1] * image.shape[0])), cv2.INTER_LINEAR)
    return image


def _resized(image: Image, width: int, height: int, how: int) -> Image:
    return np.asarray(cv2.resize(image, (width, height), interpolation=how), np.uint8)
