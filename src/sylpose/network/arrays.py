"""Arrays as bytes and back, in as few as keep every number as it is.

Whole numbers, and those that are after multiplication by a power of two, as image points on their grid are
(`Camera.normalize_to_grid`), are sent in as many bits as the range of their column takes, or that of its differences; others
in four bytes each if that keeps them, or eight.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sylpose.geometry.arrays import IntArray

__all__ = ["array_packed", "array_unpacked"]

Array = NDArray[Any]

# Numbers of an array at most: what few bytes announce must not take all memory (choice).
MOST_NUMBERS = 2_000_000
# How the numbers follow, and by the last bit whether they are floats; columns, 0 for no table.
_HEADER = struct.Struct("<BB")
_ROWS = struct.Struct("<I")
# Of a column: bits of each number, the first one if the rest are differences, else 0; and what was subtracted of each.
_COLUMN = struct.Struct("<Bqq")
_EIGHT, _FOUR, _BITS = 0, 1, 2
# Powers of two that make numbers whole are sought up to this one (choice: a millionth of a focal length).
MOST_BINARY = 24
# Larger ones are sent as they are: sums and differences of these keep all their bits (derived).
LARGEST_WHOLE = 2**50
MOST_COLUMNS = 6  # (choice)


def array_packed(value: Array) -> bytes:
    """Of one dimension or two, floats or integers.

    Raises:
        TypeError: another array.
    """
    if value.ndim not in (1, 2) or value.dtype.kind not in "fi":
        raise TypeError(f"an array of {value.ndim} dimensions of {value.dtype} is not sent")
    columns = value.shape[1] if value.ndim == 2 else 0
    floats = value.dtype.kind == "f"
    with np.errstate(over="ignore"):
        four = floats and np.array_equal(value.astype("<f4"), value, equal_nan=True)
    how, parts = _FOUR if four else _EIGHT, [value.astype("<f4" if four else "<f8" if floats else "<i8").tobytes()]
    binary = _binary(value)
    if binary is not None:
        whole = np.round(value * 2.0**binary).astype(np.int64) if floats else value.astype(np.int64)
        columnwise = [_column_packed(part) for part in whole.reshape(len(value), -1).T]
        if sum(map(len, columnwise)) < len(parts[0]):
            how, parts = _BITS + binary, [_ROWS.pack(len(value)), *columnwise]
    return b"".join([_HEADER.pack(2 * how + floats, columns), *parts])


def array_unpacked(data: bytes) -> Array:
    """The inverse of `array_packed`.

    Raises:
        ValueError: these bytes are no array.
    """
    if len(data) < _HEADER.size:
        raise ValueError("no array: too short")
    code, columns = _HEADER.unpack_from(data)
    how, floats, wide, at = code // 2, code % 2 == 1, max(columns, 1), _HEADER.size
    if columns > MOST_COLUMNS or how > _BITS + MOST_BINARY or (how == _FOUR and not floats):
        raise ValueError("no array: its header means nothing")
    if how < _BITS:
        kind = np.dtype("<f4" if how == _FOUR else "<f8" if floats else "<i8")
        if (len(data) - at) % (wide * kind.itemsize):
            raise ValueError("no array: its shape is not that of its numbers")
        out = np.frombuffer(data, kind, offset=at).astype(float if floats else np.int64)
    else:
        rows = _ROWS.unpack_from(data, at)[0] if len(data) >= at + _ROWS.size else 0
        if not 0 < rows <= min(8 * len(data), MOST_NUMBERS // wide):
            raise ValueError("no array: its shape is not that of its numbers")
        out, at = np.empty((rows, wide), np.int64), at + _ROWS.size
        for k in range(wide):
            at = _column_unpacked(data, at, rows, out[:, k])
        if at != len(data):
            raise ValueError("no array: its shape is not that of its numbers")
        out = out / 2.0 ** (how - _BITS) if floats else out
    return out.reshape(-1, columns) if columns else out.reshape(-1)


def _binary(value: Array) -> int | None:
    """The least power of two that makes all numbers whole; None without."""
    if value.size == 0 or not (np.abs(value) < LARGEST_WHOLE / 2.0**MOST_BINARY).all():
        return None
    if value.dtype.kind == "i":
        return 0
    return next((k for k in range(MOST_BINARY + 1) if (np.rint(value * 2.0**k) == value * 2.0**k).all()), None)


def _column_packed(whole: IntArray) -> bytes:
    steps = np.diff(whole)
    differ = len(steps) > 0 and int(np.ptp(steps)) < int(np.ptp(whole))
    first, rest = (int(whole[0]), steps) if differ else (0, whole)
    least = int(rest.min())
    bits = max(int(rest.max() - least).bit_length(), 1)
    spread = ((rest - least)[:, None] >> np.arange(bits)) & 1
    return _COLUMN.pack(bits | (0x80 if differ else 0), first, least) + np.packbits(spread.astype(np.uint8)).tobytes()


def _column_unpacked(data: bytes, at: int, rows: int, out: IntArray) -> int:
    """Fills out (n,).

    Returns:
        where the next column begins.
    """
    if len(data) < at + _COLUMN.size:
        raise ValueError("no array: too short")
    how, first, least = _COLUMN.unpack_from(data, at)
    differ, bits, at = how >> 7, how & 0x7F, at + _COLUMN.size
    count = rows - differ
    end = at + (count * bits + 7) // 8
    if not 0 < bits < 63 or count < 1 or len(data) < end or max(abs(first), abs(least)) > LARGEST_WHOLE:
        raise ValueError("no array: its shape is not that of its numbers")
    every = np.unpackbits(np.frombuffer(data[at:end], np.uint8), count=count * bits).reshape(count, bits)
    numbers = least + every.astype(np.int64) @ (np.int64(1) << np.arange(bits, dtype=np.int64))
    out[differ:] = numbers
    if differ:
        out[0] = first
        np.cumsum(out, out=out)
    return int(end)
