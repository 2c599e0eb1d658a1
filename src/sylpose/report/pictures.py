"""Images of the cameras made smaller, and as files for a browser."""

from __future__ import annotations

import cv2
import numpy as np

from sylpose.numerics.arrays import Image

__all__ = ["jpeg", "smaller"]

# Of JPEG's 100 (choice: edges stay where they are; a twentieth of the bytes).
QUALITY = 90


def smaller(image: Image, longest: int) -> Image:
    """An image (h, w, 3) or (h, w) whose longer side has at most so many pixels, each the mean of what it covers."""
    scale = longest / max(image.shape[:2])
    if scale >= 1:
        return image
    size = max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(image: Image) -> bytes:
    """An image (h, w, 3) BGR or (h, w) as a JPEG file.

    Raises:
        ValueError: one that cannot be one.
    """
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise ValueError("image: cannot be written as JPEG")
    return data.tobytes()
