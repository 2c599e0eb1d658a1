"""Images of cameras, small enough that some dozens of them fit into a page."""

from __future__ import annotations

import cv2
import numpy as np

from sylpose.numerics.arrays import Image

__all__ = ["thumbnail"]

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
    if (scale := width / image.shape[1]) < 1:
        size = (width, max(1, round(scale * image.shape[0])))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return bytes(data) if done else None
