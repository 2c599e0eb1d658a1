"""Image sizes from file headers, checked before decoding: a few kilobytes can decode to gigabytes."""

from __future__ import annotations

import re
import struct

__all__ = ["image_size_from_header"]

# Netpbm: magic number, width and height, separated by whitespace and comments.
_NETPBM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+([0-9]{1,9})(?:\s|#[^\n]*\n)+([0-9]{1,9})\s")
# TIFF tags: width and height of the image and of its tiles; and the `struct` format of each number type.
_TIFF_TAGS = {256: 0, 257: 1, 322: 2, 323: 3}
_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
# Largest tile in pixels; tiles are decoded as a whole, however small the image (choice: 16 times the largest in use).
MAX_TILE_PIXELS = 2**24


def image_size_from_header(data: bytes) -> tuple[int, int] | None:
    """Return (width, height) from an image header.

    Supports PNG, JPEG, TIFF, BMP, WebP, Netpbm and JPEG 2000.

    Args:
        data: the content of the file.

    Returns:
        (width, height), pixels; None for any other or a truncated file.
    """
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return _png_size(data)
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
        if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            return _tiff_size(data)
        if data.startswith(b"BM"):
            if struct.unpack_from("<I", data, 14)[0] == 12:  # OS/2 header
                return struct.unpack_from("<HH", data, 18)
            width, height = struct.unpack_from("<ii", data, 18)
            return width, abs(height)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp_size(data)
        if found := _NETPBM.match(data):
            return int(found[1]), int(found[2])
        if data.startswith((b"\0\0\0\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51")):
            # The codestream begins with its size; the enclosing box may contain another.
            right, bottom, left, top = struct.unpack_from(">IIII", data, data.index(b"\xff\x4f\xff\x51") + 8)
            return right - left, bottom - top
    except (struct.error, IndexError, ValueError):  # truncated
        pass
    return None


def _png_size(data: bytes) -> tuple[int, int] | None:
    """Return the size, or None if a chunk length exceeds the file: decoders allocate it before checking."""
    at, end = 8, len(data)
    while at < end:
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return struct.unpack_from(">II", data, 16) if at == end else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while True:
        while data[at] != 0xFF:  # garbage between segments is skipped, as decoders do
            at += 1
        while data[at] == 0xFF:
            at += 1
        marker = data[at]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 4)
            return width, height
        at += 1
        if not (0xD0 <= marker <= 0xD8 or marker == 1):  # these have no length
            at += struct.unpack_from(">H", data, at)[0]


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    order = "<" if data[:1] == b"I" else ">"
    big = data[:4] in (b"II+\0", b"MM\0+")
    at = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, 8 if big else 4)[0]
    (count,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, at)
    at += 8 if big else 2
    sizes = [0, 0, 0, 0]
    for i in range(min(count, 1000)):
        entry = at + i * (20 if big else 12)
        tag, kind = struct.unpack_from(f"{order}HH", data, entry)
        if tag in _TIFF_TAGS and kind in _TIFF_TYPES:
            where = entry + (12 if big else 8)
            sizes[_TIFF_TAGS[tag]] = struct.unpack_from(f"{order}{_TIFF_TYPES[kind]}", data, where)[0]
    width, height, *tile = sizes
    return (width, height) if tile[0] * tile[1] <= MAX_TILE_PIXELS else None


def _webp_size(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8X":
        width, height = (1 + int.from_bytes(data[at : at + 3], "little") for at in (24, 27))
        return width, height
    return None
