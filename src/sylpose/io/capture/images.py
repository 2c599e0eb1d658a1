"""Reading of image files and masks into arrays."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from sylpose.geometry.arrays import BoolArray, Image
from sylpose.input_limits import MAX_TEXT_BYTES, UnreadableFileError, read_bytes
from sylpose.io.capture.headers import image_size_from_header
from sylpose.rig import MAX_PIXELS

__all__ = ["read_image", "read_image_size", "read_mask"]

# Bit depths of cameras; the smallest that contains an image's values is assumed.
BIT_DEPTHS = (8, 10, 12, 14, 16)


def read_image_size(path: Path) -> tuple[int, int]:
    """Read (width, height) from an image header without decoding the pixels.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not an image of a supported format; the message names it.
    """
    size = image_size_from_header(read_bytes(path, _max_file_size(MAX_PIXELS)))
    if size is None:
        raise UnreadableFileError(f"{path}: cannot be read as an image")
    return size


def read_image(path: Path, size: tuple[int, int]) -> Image:
    """Read an image as BGR (h, w, 3), as coded: EXIF orientation is not applied.

    Gray images get three equal channels. 16-bit images are scaled by the smallest depth of 8, 10, 12, 14 or 16 bits
    that contains their values, since 12-bit cameras write 16-bit files.

    Args:
        path: the image file.
        size: required (width, height); a file with another size is not decoded.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file has another size, is not a readable 8-bit or 16-bit image, or is truncated; the message
            names it.
    """
    data = read_bytes(path, _max_file_size(size[0] * size[1]))
    header_size = image_size_from_header(data)
    if header_size is not None and header_size != size:
        raise UnreadableFileError(f"{path}: {header_size[0]}x{header_size[1]}, not {size[0]}x{size[1]} pixels")
    # Some JPEG decoders fill missing data of a truncated file with gray: its end marker is then missing after its data.
    is_truncated = data[:2] == b"\xff\xd8" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    image = None
    if header_size is not None and not is_truncated:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        with suppress(cv2.error):  # contradictory headers
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None or image.shape[1::-1] != size:
        raise UnreadableFileError(f"{path}: cannot be read as an image")
    if image.dtype == np.uint16:
        depth = next(bits for bits in BIT_DEPTHS if int(image.max()) < 1 << bits)
        image = np.right_shift(image, depth - 8)
    elif image.dtype != np.uint8:
        raise UnreadableFileError(f"{path}: pixels of type {image.dtype}; 8-bit or 16-bit images are expected")
    return image.astype(np.uint8, copy=False)


def _max_file_size(pixels: int) -> int:
    """Return an upper bound of the file size: uncompressed, four 32-bit channels, plus metadata."""
    return 16 * pixels + MAX_TEXT_BYTES


def read_mask(path: Path, size: tuple[int, int]) -> BoolArray:
    """Read a mask (h, w), True where the image is white (above half of 255) in any channel.

    Args:
        path: the image file.
        size: required (width, height).

    Raises:
        ValueError: the file is not an image or has another size; the message names it.
    """
    image = read_image(path, size)
    mask = np.asarray(image.max(axis=2) > 127)
    mask.setflags(write=False)
    return mask
