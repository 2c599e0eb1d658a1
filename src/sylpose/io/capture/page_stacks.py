"""Page stacks: TIFF files with one picture per page, as microscopes, ImageJ and scientific cameras write them."""

from __future__ import annotations

import re
from io import FileIO
from pathlib import Path
from typing import Self

import numpy as np
from PIL.TiffImagePlugin import ImageFileDirectory_v2, TiffImageFile

from sylpose.geometry.arrays import Image
from sylpose.input_limits import UnreadableFileError, input_errors
from sylpose.io.capture.images import MAX_TILE_PIXELS, reduce_depth
from sylpose.rig import MAX_PIXELS

STACK_SUFFIXES = frozenset({".tif", ".tiff"})
# Pages of a stack (choice: an hour at 280 frames per second), whose directories are all read when it is opened.
MAX_PAGES = 10**6
# Bytes of a directory with its tags (choice: ImageJ's metadata of a long stack are megabytes); directories may overlap, so
# that all of them together are not more than the file.
MAX_DIRECTORY_BYTES = 2**25
# Tags of TIFF.
WIDTH, HEIGHT, DESCRIPTION, TILE_WIDTH, TILE_HEIGHT = 256, 257, 270, 322, 323
_BIG_SIGNATURES = (b"II+\0", b"MM\0+")
_SIGNATURES = (b"II*\0", b"MM\0*", *_BIG_SIGNATURES)
_DECLARED_PAGES = re.compile(r"^images=([0-9]{1,9})", re.MULTILINE)


class PageStack:
    """A TIFF file with several pages of one size, opened for reading; `close` it.

    Attributes:
        path: the file.
        size: (width, height) of the pages, pixels.
        n_pages: their number.
    """

    def __init__(self, path: Path) -> None:
        """Open a stack and read its directories.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is damaged, has pages of several sizes or too many; the message names the file.
        """
        self.path = path
        with input_errors(path), _LimitedFile(path) as file:
            sizes, has_undeclared = _read_directories(file, MAX_PAGES)
            if has_undeclared:
                raise ValueError(
                    "its pages have no directories (ImageJ writes stacks of more than 4 GB like this); save it as an image "
                    "sequence, one folder for each camera"
                )
            if len(set(sizes)) > 1:
                listed = ", ".join("{}x{}".format(*size) for size in sorted(set(sizes))[:4])
                raise ValueError(
                    f"its pages have different sizes ({listed}); one picture of a camera per page is expected"
                )
        self.size, self.n_pages = sizes[0], len(sizes)
        try:
            self._image = TiffImageFile(path)
        except Exception:  # damaged bytes can raise any exception
            raise UnreadableFileError(f"{path}: page 0 cannot be read, or has pixels of an unusual type") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, k: int) -> Image:
        """Read page k as BGR (h, w, 3); 16 bits are scaled as `images.read_image` does.

        Raises:
            ValueError: it is damaged or of another pixel type; the message names the file and the page.
        """
        where = f"{self.path}: page {k}"
        try:
            self._image.seek(k)
            mode, size = self._image.mode, self._image.size
            if size == self.size and mode.startswith("I;16"):
                gray = reduce_depth(np.asarray(self._image).astype(np.uint16))
                return np.repeat(gray[:, :, None], 3, axis=2)
            if size == self.size and mode in ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "YCbCr", "CMYK"):
                return np.ascontiguousarray(np.asarray(self._image.convert("RGB"))[:, :, ::-1])
        except Exception:  # damaged bytes can raise any exception
            raise UnreadableFileError(f"{where} cannot be read") from None
        raise UnreadableFileError(f"{where} has pixels of type {mode}; 8-bit or 16-bit images are expected")

    def close(self) -> None:
        """Close the file."""
        self._image.close()


def is_page_stack(path: Path) -> bool:
    """Return whether a file is a TIFF with several pages, or declares them."""
    if path.suffix.lower() not in STACK_SUFFIXES or not path.is_file():
        return False
    try:
        with _LimitedFile(path) as file:
            sizes, has_undeclared = _read_directories(file, 2)
    except (OSError, ValueError):
        return False
    return len(sizes) > 1 or has_undeclared


class _LimitedFile(FileIO):
    """A file of which at most `left` bytes can be read."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.left = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size) or b""
        self.left -= len(data)
        if self.left < 0:
            raise ValueError("its directories overlap or are too large")
        return data


def _read_directories(file: _LimitedFile, limit: int) -> tuple[list[tuple[int, int]], bool]:
    """Read (width, height) of up to `limit` pages, and whether ImageJ's description declares pages without directories.

    Raises:
        ValueError: damaged, or with directories that overlap or with too many of them.
    """
    head = file.read(8)
    length = 16 if head[:4] in _BIG_SIGNATURES else 8
    head += file.read(length - 8)
    if head[:4] not in _SIGNATURES or len(head) < length:
        raise ValueError("cannot be read as a TIFF file")
    tags = ImageFileDirectory_v2(head)
    sizes, seen, n_declared, at = list[tuple[int, int]](), set[int](), 1, tags.next
    while at and at not in seen:
        if len(sizes) == limit:
            if limit < MAX_PAGES:
                break
            raise ValueError(f"more than {MAX_PAGES} pages")
        seen.add(at)
        unread = file.left
        file.left = min(unread, MAX_DIRECTORY_BYTES)
        try:
            file.seek(at)
            tags.load(file)
            width, height, tile_width, tile_height = (
                int(tags.get(tag, 0)) for tag in (WIDTH, HEIGHT, TILE_WIDTH, TILE_HEIGHT)
            )
            if not sizes:
                declared = _DECLARED_PAGES.search(str(tags.get(DESCRIPTION, "")))
                n_declared = int(declared[1]) if declared else 1
        except Exception:  # damaged bytes can raise any exception
            width = height = 0
        if width <= 0 or height <= 0:
            raise ValueError(f"the directory of page {len(sizes)} cannot be read")
        if width * height > MAX_PIXELS or tile_width * tile_height > MAX_TILE_PIXELS:
            raise ValueError(f"page {len(sizes)} has {width}x{height} pixels, in tiles of {tile_width}x{tile_height}")
        file.left += unread - min(unread, MAX_DIRECTORY_BYTES)
        sizes.append((width, height))
        at = tags.next
    if not sizes:
        raise ValueError("it has no pages")
    return sizes, len(sizes) == 1 < n_declared
