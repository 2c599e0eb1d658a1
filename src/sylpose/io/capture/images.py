"""Reading of image files and masks into arrays; sizes are checked before decoding.

A few kilobytes can decode to gigabytes. Pillow reads the size from the header, OpenCV decodes the pixels.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ExifTags import IFD, Base
from PIL.Image import DecompressionBombError
from PIL.ImageFile import ImageFile
from PIL.Jpeg2KImagePlugin import Jpeg2KImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from PIL.WebPImagePlugin import WebPImageFile

from sylpose.geometry.arrays import BoolArray, Image
from sylpose.input_limits import MAX_TEXT_BYTES, UnreadableFileError, input_errors, read_bytes
from sylpose.rig import MAX_PIXELS

# Bit depths of cameras; the smallest that contains an image's values is assumed.
BIT_DEPTHS = (8, 10, 12, 14, 16)
# Tag of EXIF and TIFF.
ORIENTATION_TAG = 274
# Diagonal of 24 x 36 mm film, to which focal lengths are converted (derived), and units of the sensor's resolution in EXIF.
FILM_DIAGONAL_MM, FOCAL_PLANE_UNITS_MM = 43.267, {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
# Largest tile of a TIFF in pixels; tiles are decoded as a whole, however small the image (choice: 16 times the largest
# in use).
MAX_TILE_PIXELS = 2**24
# Pillow's readers by the first bytes of a file. `PIL.Image.open` is not used: it warns of large images.
_HEADERS: dict[bytes, Callable[[BytesIO], ImageFile]] = {
    b"\x89PNG\r\n\x1a\n": PngImageFile,
    b"\xff\xd8": JpegImageFile,
    b"BM": BmpImageFile,
    b"RIFF": WebPImageFile,
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), PpmImageFile),
    b"\xff\x4f\xff\x51": Jpeg2KImageFile,
}
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# Pillow warns of damaged tags; a file that cannot be read has a message, and other damage is of no consequence.
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.TiffImagePlugin")


def image_size_from_header(data: bytes) -> tuple[int, int] | None:
    """Return (width, height), as coded, from the header of PNG, JPEG, TIFF, BMP, WebP, Netpbm or JPEG 2000.

    Args:
        data: the content of the file.

    Returns:
        (width, height), pixels; None for any other or a damaged file.

    Raises:
        ValueError: more pixels than Pillow allows, which are more than `MAX_PIXELS`. To be converted by `input_errors`.
    """
    try:
        if data.startswith(_TIFF_SIGNATURES):
            return _read_tiff_size(data)
        if data.startswith(b"\x89PNG") and not _has_whole_chunks(data):
            return None
        if data.startswith(b"\0\0\0\x0cjP  \r\n\x87\n"):
            # The codestream begins with its size; the enclosing box may contain another.
            data = data[data.index(b"\xff\x4f\xff\x51") :]
        header = next((header for start, header in _HEADERS.items() if data.startswith(start)), None)
        return None if header is None else header(BytesIO(data)).size
    except DecompressionBombError:
        raise ValueError(f"more than the {MAX_PIXELS} pixels that an image may have") from None
    except Exception:  # damaged bytes can raise any exception
        return None


def _has_whole_chunks(data: bytes) -> bool:
    """Return whether the chunks of a PNG end with the file: decoders allocate their lengths before checking."""
    at = 8
    while at < len(data):
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return at == len(data)


def _read_tiff_size(data: bytes) -> tuple[int, int] | None:
    """Return the size in the first directory of a TIFF, of any pixel type; None if its tiles are too large."""
    tags = ImageFileDirectory_v2(data[:16] if b"+" in data[:4] else data[:8])
    file = BytesIO(data)
    file.seek(tags.next)
    tags.load(file)
    width, height, tile_width, tile_height = (int(tags.get(tag, 0)) for tag in (256, 257, 322, 323))
    return (width, height) if width and height and tile_width * tile_height <= MAX_TILE_PIXELS else None


def read_image_size(path: Path) -> tuple[int, int]:
    """Read (width, height) from an image header without decoding the pixels.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not an image of a supported format; the message names it.
    """
    data = read_bytes(path, _max_file_size(MAX_PIXELS))
    with input_errors(path):
        if (size := image_size_from_header(data)) is None:
            raise ValueError("cannot be read as an image")
        return size


def read_orientation(path: Path) -> int:
    """Read the EXIF orientation of a JPEG, PNG or WebP: 1 to 8; 1 (as coded) for other files and without one.

    Raises:
        OSError, ValueError: the file cannot be read.
    """
    data = read_bytes(path, _max_file_size(MAX_PIXELS))
    with suppress(Exception):  # damaged bytes can raise any exception
        value = _open_header(data).getexif().get(ORIENTATION_TAG, 1)
        return int(value) if value in range(1, 9) else 1
    return 1


def read_exif_focal(path: Path) -> float | None:
    """Read the focal length from the EXIF of a photograph, pixels; None for other files and without one.

    It is that of the lens's data sheet: zoom, focus and cropping change it by some percent, or more.

    Raises:
        OSError, ValueError: the file cannot be read.
    """
    data = read_bytes(path, _max_file_size(MAX_PIXELS))
    with suppress(Exception):  # damaged bytes can raise any exception
        image = _open_header(data)
        exif, diagonal = image.getexif().get_ifd(IFD.Exif), float(np.hypot(*image.size))
        if (equivalent := float(exif.get(Base.FocalLengthIn35mmFilm, 0))) > 0:
            return equivalent * diagonal / FILM_DIAGONAL_MM
        # Pixels of the sensor, of which the image may be a smaller version.
        unit = FOCAL_PLANE_UNITS_MM[exif.get(Base.FocalPlaneResolutionUnit, 2)]
        sensor = float(np.hypot(exif[Base.ExifImageWidth], exif[Base.ExifImageHeight]))
        focal = float(exif[Base.FocalLength]) * float(exif[Base.FocalPlaneXResolution]) / unit * diagonal / sensor
        return focal if 0 < focal < np.inf else None
    return None


def _open_header(data: bytes) -> ImageFile:
    return next(header for start, header in _HEADERS.items() if data.startswith(start))(BytesIO(data))


def orient(image: Image, orientation: int) -> Image:
    """Turn and mirror an image (h, w, 3) by its EXIF orientation (1 to 8); (w, h, 3) from 5 on."""
    if orientation >= 5:
        image = image.transpose(1, 0, 2)
    rows, columns = (slice(None, None, -1 if orientation in those else 1) for those in ((3, 4, 7, 8), (2, 3, 6, 7)))
    return np.ascontiguousarray(image[rows, columns])


def read_image(path: Path, size: tuple[int, int], orientation: int = 1) -> Image:
    """Read an image as BGR (h, w, 3).

    Gray images get three equal channels. 16-bit images are scaled by the smallest depth of 8, 10, 12, 14 or 16 bits
    that contains their values, since 12-bit cameras write 16-bit files.

    Args:
        path: the image file.
        size: required (width, height), as turned; a file with another size is not decoded.
        orientation: EXIF orientation to be applied, whatever the file contains; 1 for the image as coded.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file has another size, is not a readable 8-bit or 16-bit image, or is truncated; the message
            names it.
    """
    data = read_bytes(path, _max_file_size(size[0] * size[1]))
    size = size[::-1] if orientation >= 5 else size
    with input_errors(path):
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
        image = reduce_depth(np.asarray(image, np.uint16))
    elif image.dtype != np.uint8:
        raise UnreadableFileError(f"{path}: pixels of type {image.dtype}; 8-bit or 16-bit images are expected")
    return orient(image.astype(np.uint8, copy=False), orientation)


def reduce_depth(image: NDArray[np.uint16]) -> Image:
    """Scale 16-bit pixels to 8 bits by the smallest depth of `BIT_DEPTHS` that contains them."""
    depth = next(bits for bits in BIT_DEPTHS if int(image.max()) < 1 << bits)
    return np.right_shift(image, depth - 8).astype(np.uint8)


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
