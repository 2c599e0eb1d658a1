"""Images of the cameras made smaller, as a lens without distortion would have them, and as files for browsers and pages."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sylpose.geometry.arrays import FloatArray, Image
from sylpose.report.drawing import in_colour, project
from sylpose.rig import Camera

__all__ = ["Straightened", "jpeg", "smaller", "straightened", "thumbnail"]

# Of JPEG's 100 (choice): edges stay where they are, in a twentieth of the bytes; and where some dozens of frames are to fit
# into a page.
QUALITY, THUMBNAIL_QUALITY = 90, 68
# Of those, the width in pixels with up to four cameras, narrower with more, so that all together take as much (choice: an
# object a tenth as wide as the image still has fifty pixels).
WIDTH, LEAST, CAMERAS = 448, 128, 4
# Of the plane z = 1 no more is shown than to this on each side of its middle: 132 degrees (choice).
WIDEST = 2.25
# BGR, beside what a camera has seen.
NOTHING = (60, 60, 60)


def thumbnail(image: Image | None, cameras: int) -> bytes | None:
    """A small JPEG file; None without an image.

    Args:
        image: (h, w, 3) BGR or (h, w) grey.
        cameras: how many there are.
    """
    if image is None:
        return None
    width = max(LEAST, round(WIDTH * min(1.0, CAMERAS / cameras) ** 0.5))
    return jpeg(_shrunk(image, width), THUMBNAIL_QUALITY)


def smaller(image: Image, longest: int) -> Image:
    """An image (h, w, 3) or (h, w) whose longer side has at most so many pixels."""
    height, width = image.shape[:2]
    return (
        _shrunk(image, max(1, round(longest * width / max(height, width)))) if max(height, width) > longest else image
    )


def _shrunk(image: Image, width: int) -> Image:
    """An image no wider than that."""
    # Halved first, which is a sixth of the time that it takes at once.
    while image.shape[1] >= 2 * width and min(image.shape[:2]) > 1:
        image = _resized(image, image.shape[1] // 2, image.shape[0] // 2, cv2.INTER_AREA)
    if image.shape[1] > width:
        image = _resized(image, width, max(1, round(width / image.shape[1] * image.shape[0])), cv2.INTER_LINEAR)
    return image


def _resized(image: Image, width: int, height: int, how: int) -> Image:
    return np.asarray(cv2.resize(image, (width, height), interpolation=how), np.uint8)


def jpeg(image: Image, quality: int = QUALITY) -> bytes:
    """An image (h, w, 3) BGR or (h, w) as a JPEG file.

    Raises:
        ValueError: one that cannot be one.
    """
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError("image: cannot be written as JPEG")
    return data.tobytes()


@dataclass(frozen=True, eq=False)
class Straightened:
    """How a camera's images are made what one without a lens's distortion would have seen.

    Attributes:
        low, high: (2,) what they then show, of the plane z = 1 before the camera: left and top, right and bottom.
        size: (width, height) of the images that come of it.
        across, down: (height, width) where each pixel is taken from, in the image made as small.
    """

    low: FloatArray
    high: FloatArray
    size: tuple[int, int]
    across: NDArray[np.float32]
    down: NDArray[np.float32]

    def of(self, image: Image) -> Image:
        """An image (h, w, 3) or (h, w) of the camera, as recorded, as (height, width, 3); grey where it shows nothing."""
        small = _shrunk(in_colour(image), self.size[0])
        rest = cv2.BORDER_CONSTANT
        taken = cv2.remap(small, self.across, self.down, cv2.INTER_LINEAR, borderMode=rest, borderValue=NOTHING)
        return np.asarray(taken, np.uint8)


def straightened(camera: Camera, longest: int) -> Straightened:
    """For images whose longer side has so many pixels; of a very wide lens its middle."""
    width, height = camera.size
    rim = np.linspace(0.0, 1.0, 33)[:, None]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    around = np.concatenate([a + rim * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    seen = np.clip(camera.normalize(around), -WIDEST, WIDEST)
    low, high = seen.min(axis=0), seen.max(axis=0)
    scale = longest / max(width, height)
    size = max(2, round(scale * width)), max(2, round(scale * height))
    steps = [(np.arange(n) + 0.5) / n for n in size]
    grid = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    pixels = _pixels(camera, low + grid * (high - low))
    places = (pixels + 0.5) * (np.array(size) / camera.size) - 0.5
    # What no pixel shows is far outside of the image.
    across, down = np.where(np.isfinite(places), places, -10.0).astype(np.float32).T.copy().reshape(2, size[1], size[0])
    return Straightened(low, high, size, across, down)


def _pixels(camera: Camera, normalized: FloatArray) -> FloatArray:
    """(n, 2) pixels of points (n, 2) of the plane z = 1 before a camera; NaN where its lens model folds back."""
    directions = np.column_stack([normalized, np.ones(len(normalized))]) @ camera.rotation
    return project(camera, camera.center + directions)
