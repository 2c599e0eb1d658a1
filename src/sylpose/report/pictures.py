"""Image resizing, lens undistortion and JPEG encoding for web pages."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sylpose.geometry.arrays import FloatArray, Image
from sylpose.report.drawing import project_points, to_bgr
from sylpose.rig import Camera

__all__ = ["UndistortionMap", "build_undistortion_map", "encode_jpeg", "encode_thumbnail", "shrink_image"]

# JPEG quality of 100 (choice): edges are preserved at a twentieth of the bytes. The second is for thumbnails, of which
# some dozens of frames must fit into a page.
JPEG_QUALITY, THUMBNAIL_QUALITY = 90, 68
# Thumbnail width in pixels with up to four cameras; narrower with more, so that all together keep the same size
# (choice: an object a tenth as wide as the image still has fifty pixels).
THUMBNAIL_WIDTH, MIN_THUMBNAIL_WIDTH, FULL_WIDTH_CAMERAS = 448, 128, 4
# Undistorted images cover at most this much of the plane z = 1 to each side of its middle: 132 degrees (choice).
MAX_TANGENT = 2.25
# BGR of pixels outside the camera's image.
BACKGROUND_COLOR = (60, 60, 60)


def encode_thumbnail(image: Image | None, cameras: int) -> bytes | None:
    """Encode a small JPEG file; None without an image.

    Args:
        image: (h, w, 3) BGR or (h, w) gray.
        cameras: number of cameras.
    """
    if image is None:
        return None
    width = max(MIN_THUMBNAIL_WIDTH, round(THUMBNAIL_WIDTH * min(1.0, FULL_WIDTH_CAMERAS / cameras) ** 0.5))
    return encode_jpeg(_shrink_to_width(image, width), THUMBNAIL_QUALITY)


def shrink_image(image: Image, max_side: int) -> Image:
    """Shrink an image (h, w, 3) or (h, w) so that its longer side has at most `max_side` pixels."""
    height, width = image.shape[:2]
    return (
        _shrink_to_width(image, max(1, round(max_side * width / max(height, width))))
        if max(height, width) > max_side
        else image
    )


def _shrink_to_width(image: Image, width: int) -> Image:
    """Shrink an image to at most this width."""
    # Halving first takes a sixth of the time of a single resize.
    while image.shape[1] >= 2 * width and min(image.shape[:2]) > 1:
        image = _resize(image, image.shape[1] // 2, image.shape[0] // 2, cv2.INTER_AREA)
    if image.shape[1] > width:
        image = _resize(image, width, max(1, round(width / image.shape[1] * image.shape[0])), cv2.INTER_LINEAR)
    return image


def _resize(image: Image, width: int, height: int, interpolation: int) -> Image:
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation), np.uint8)


def encode_jpeg(image: Image, quality: int = JPEG_QUALITY) -> bytes:
    """Encode an image (h, w, 3) BGR or (h, w) as a JPEG file.

    Raises:
        ValueError: the image cannot be encoded.
    """
    is_encoded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not is_encoded:
        raise ValueError("image: cannot be encoded as JPEG")
    return data.tobytes()


@dataclass(frozen=True, eq=False)
class UndistortionMap:
    """Pixel map that removes the lens distortion from a camera's images.

    Attributes:
        low, high: (2,) bounds of the result in the plane z = 1 of the camera: left and top, right and bottom.
        size: (width, height) of the resulting images.
        map_x, map_y: (height, width) source x and y of each pixel, in the image scaled to `size`.
    """

    low: FloatArray
    high: FloatArray
    size: tuple[int, int]
    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]

    def apply(self, image: Image) -> Image:
        """Undistort a camera's image (h, w, 3) or (h, w) to (height, width, 3); gray where it has no source."""
        small = _shrink_to_width(to_bgr(image), self.size[0])
        rest = cv2.BORDER_CONSTANT
        undistorted = cv2.remap(
            small, self.map_x, self.map_y, cv2.INTER_LINEAR, borderMode=rest, borderValue=BACKGROUND_COLOR
        )
        return np.asarray(undistorted, np.uint8)


def build_undistortion_map(camera: Camera, max_side: int) -> UndistortionMap:
    """Build the undistortion map for images whose longer side has `max_side` pixels.

    Of a very wide lens, only the middle is covered.
    """
    width, height = camera.size
    steps_along_edge = np.linspace(0.0, 1.0, 33)[:, None]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    border = np.concatenate(
        [a + steps_along_edge * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    bounds = np.clip(camera.normalize(border), -MAX_TANGENT, MAX_TANGENT)
    low, high = bounds.min(axis=0), bounds.max(axis=0)
    scale = max_side / max(width, height)
    size = max(2, round(scale * width)), max(2, round(scale * height))
    steps = [(np.arange(n) + 0.5) / n for n in size]
    grid = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    pixels = _project_normalized(camera, low + grid * (high - low))
    places = (pixels + 0.5) * (np.array(size) / camera.size) - 0.5
    # Pixels without a source are mapped far outside the image.
    map_x, map_y = np.where(np.isfinite(places), places, -10.0).astype(np.float32).T.copy().reshape(2, size[1], size[0])
    return UndistortionMap(low, high, size, map_x, map_y)


def _project_normalized(camera: Camera, normalized: FloatArray) -> FloatArray:
    """Project points (n, 2) of the camera's plane z = 1 to pixels (n, 2); NaN where the lens model folds back."""
    directions = np.column_stack([normalized, np.ones(len(normalized))]) @ camera.rotation
    return project_points(camera, camera.center + directions)
