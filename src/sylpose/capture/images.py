"""Image files as arrays."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from sylpose.capture.headers import said_size
from sylpose.geometry.arrays import BoolArray, Image
from sylpose.input_limits import MAX_TEXT, Unreadable, bytes_of
from sylpose.rig import MAX_PIXELS

__all__ = ["image_size", "read_image", "read_mask"]

# Depths that cameras have; the smallest that holds an image's values is taken as its depth.
DEPTHS = (8, 10, 12, 14, 16)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) that a file's header says; its pixels are not decoded.

    Raises:
        OSError: it cannot be read.
        ValueError: naming a file that is no image of a format that is read.
    """
    size = said_size(bytes_of(path, _bytes_of_pixels(MAX_PIXELS)))
    if size is None:
        raise Unreadable(f"{path}: cannot be read as an image")
    return size


def read_image(path: Path, size: tuple[int, int]) -> Image:
    """An image as BGR (h, w, 3), as coded: EXIF orientation is not applied.

    Grey images get three equal channels. Images of 16 bits are scaled by the smallest depth of 8, 10, 12, 14 or 16 bits
    that holds their values, since 12-bit cameras write 16-bit files.

    Args:
        size: (width, height) that it must have: what says another is not decoded.

    Raises:
        OSError: it cannot be read.
        ValueError: naming a file that has another size, is no readable 8-bit or 16-bit image, or is cut.
    """
    data = bytes_of(path, _bytes_of_pixels(size[0] * size[1]))
    said = said_size(data)
    if said is not None and said != size:
        raise Unreadable(f"{path}: {said[0]}x{said[1]}, not {size[0]}x{size[1]} pixels")
    # Some JPEG readers fill what is missing of a cut file with grey: its end marker is then missing after its data.
    cut = data[:2] == b"\xff\xd8" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    image = None
    if said is not None and not cut:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        with suppress(cv2.error):  # of headers that contradict themselves
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None or image.shape[1::-1] != size:
        raise Unreadable(f"{path}: cannot be read as an image")
    if image.dtype == np.uint16:
        depth = next(bits for bits in DEPTHS if int(image.max()) < 1 << bits)
        image = np.right_shift(image, depth - 8)
    elif image.dtype != np.uint8:
        raise Unreadable(f"{path}: pixels of type {image.dtype}; 8-bit or 16-bit images are expected")
    return image.astype(np.uint8, copy=False)


def _bytes_of_pixels(pixels: int) -> int:
    """More than any file has of so many: not packed, with four channels of 32 bits, and what is said beside."""
    return 16 * pixels + MAX_TEXT


def read_mask(path: Path, size: tuple[int, int]) -> BoolArray:
    """A mask (h, w), True where the image is white (above half of 255) in any channel.

    Raises:
        ValueError: naming a file that is no image, or has another size than `size` (width, height).
    """
    image = read_image(path, size)
    mask = np.asarray(image.max(axis=2) > 127)
    mask.setflags(write=False)
    return mask
