"""Image files as arrays."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from sylpose.numerics.arrays import BoolArray, Image

__all__ = ["read_image", "read_mask"]

# Depths that cameras have; the smallest that holds an image's values is taken as its depth.
DEPTHS = (8, 10, 12, 14, 16)


def read_image(path: Path) -> Image:
    """An image as BGR (h, w, 3), as coded: EXIF orientation is not applied.

    Grey images get three equal channels. Images of 16 bits are scaled by the smallest depth of 8, 10, 12, 14 or 16 bits
    that holds their values, since 12-bit cameras write 16-bit files.

    Raises:
        ValueError: naming a file that is no readable 8-bit or 16-bit image, or is cut.
    """
    data = path.read_bytes()
    # Some JPEG readers fill what is missing of a cut file with grey: its end marker is then missing after its data.
    cut = data[:2] == b"\xff\xd8" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    image = None
    if data and not cut:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise ValueError(f"{path}: cannot be read as an image")
    if image.dtype == np.uint16:
        depth = next(bits for bits in DEPTHS if int(image.max()) < 1 << bits)
        image = np.right_shift(image, depth - 8)
    elif image.dtype != np.uint8:
        raise ValueError(f"{path}: pixels of type {image.dtype}; 8-bit or 16-bit images are expected")
    return image.astype(np.uint8, copy=False)


def read_mask(path: Path, size: tuple[int, int]) -> BoolArray:
    """A mask (h, w), True where the image is white (above half of 255) in any channel.

    Raises:
        ValueError: naming a file that is no image, or has another size than `size` (width, height).
    """
    image = read_image(path)
    if image.shape[1::-1] != size:
        raise ValueError(
            f"{path}: a mask of {image.shape[1]}x{image.shape[0]} for images of {size[0]}x{size[1]} pixels"
        )
    mask = np.asarray(image.max(axis=2) > 127)
    mask.setflags(write=False)
    return mask
