"""Lossless compact encoding of arrays.

Integers take as many bits as the range of their column, or of its differences, requires. So do numbers that become
integers when multiplied by a power of two, such as image points on their grid (`Camera.normalize_to_grid`). Other
numbers take four bytes each if that is lossless, otherwise eight.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sylpose.geometry.arrays import IntArray

__all__ = ["decode_array", "encode_array"]

Array = NDArray[Any]

# Largest number of elements: a few bytes must not announce an array that exhausts the memory (choice).
MAX_NUMBERS = 2_000_000
# Encoding of the numbers, its lowest bit set for floats; number of columns, 0 for one dimension.
_HEADER = struct.Struct("<BB")
_ROWS = struct.Struct("<I")
# Column header: bits per number, the first number if the others are differences, else 0; and the subtracted minimum.
_COLUMN = struct.Struct("<Bqq")
_EIGHT_BYTES, _FOUR_BYTES, _BIT_PACKED = 0, 1, 2
# Largest exponent of the power of two that makes numbers integers (choice: a millionth of a focal length).
MAX_EXPONENT = 24
# Larger integers are not compressed: sums and differences of smaller ones are exact (derived).
MAX_INTEGER = 2**50
MAX_COLUMNS = 6  # (choice)


def encode_array(value: Array) -> bytes:
    """Encode a one- or two-dimensional array of floats or integers.

    Raises:
        TypeError: any other array.
    """
    if value.ndim not in (1, 2) or value.dtype.kind not in "fi":
        raise TypeError(f"an array of {value.ndim} dimensions of {value.dtype} cannot be sent")
    columns = value.shape[1] if value.ndim == 2 else 0
    floats = value.dtype.kind == "f"
    with np.errstate(over="ignore"):
        four = floats and np.array_equal(value.astype("<f4"), value, equal_nan=True)
    encoding, parts = (
        _FOUR_BYTES if four else _EIGHT_BYTES,
        [value.astype("<f4" if four else "<f8" if floats else "<i8").tobytes()],
    )
    exponent = _find_exponent(value)
    if exponent is not None:
        integers = np.round(value * 2.0**exponent).astype(np.int64) if floats else value.astype(np.int64)
        columnwise = [_encode_column(part) for part in integers.reshape(len(value), -1).T]
        if sum(map(len, columnwise)) < len(parts[0]):
            encoding, parts = _BIT_PACKED + exponent, [_ROWS.pack(len(value)), *columnwise]
    return b"".join([_HEADER.pack(2 * encoding + floats, columns), *parts])


def decode_array(data: bytes) -> Array:
    """Decode the output of `encode_array`.

    Raises:
        ValueError: the bytes are not an array.
    """
    if len(data) < _HEADER.size:
        raise ValueError("not an array: too short")
    code, columns = _HEADER.unpack_from(data)
    encoding, floats, n_columns, position = code // 2, code % 2 == 1, max(columns, 1), _HEADER.size
    if columns > MAX_COLUMNS or encoding > _BIT_PACKED + MAX_EXPONENT or (encoding == _FOUR_BYTES and not floats):
        raise ValueError("not an array: invalid header")
    if encoding < _BIT_PACKED:
        kind = np.dtype("<f4" if encoding == _FOUR_BYTES else "<f8" if floats else "<i8")
        if (len(data) - position) % (n_columns * kind.itemsize):
            raise ValueError("not an array: its shape and size disagree")
        out = np.frombuffer(data, kind, offset=position).astype(float if floats else np.int64)
    else:
        rows = _ROWS.unpack_from(data, position)[0] if len(data) >= position + _ROWS.size else 0
        if not 0 < rows <= min(8 * len(data), MAX_NUMBERS // n_columns):
            raise ValueError("not an array: its shape and size disagree")
        out, position = np.empty((rows, n_columns), np.int64), position + _ROWS.size
        for k in range(n_columns):
            position = _decode_column(data, position, rows, out[:, k])
        if position != len(data):
            raise ValueError("not an array: its shape and size disagree")
        out = out / 2.0 ** (encoding - _BIT_PACKED) if floats else out
    return out.reshape(-1, columns) if columns else out.reshape(-1)


def _find_exponent(value: Array) -> int | None:
    """Return the least exponent of a power of two that makes all numbers integers; None if there is none."""
    if value.size == 0 or not (np.abs(value) < MAX_INTEGER / 2.0**MAX_EXPONENT).all():
        return None
    if value.dtype.kind == "i":
        return 0
    return next((k for k in range(MAX_EXPONENT + 1) if (np.rint(value * 2.0**k) == value * 2.0**k).all()), None)


def _encode_column(integers: IntArray) -> bytes:
    steps = np.diff(integers)
    use_differences = len(steps) > 0 and int(np.ptp(steps)) < int(np.ptp(integers))
    first, rest = (int(integers[0]), steps) if use_differences else (0, integers)
    least = int(rest.min())
    bits = max(int(rest.max() - least).bit_length(), 1)
    spread = ((rest - least)[:, None] >> np.arange(bits)) & 1
    return (
        _COLUMN.pack(bits | (0x80 if use_differences else 0), first, least)
        + np.packbits(spread.astype(np.uint8)).tobytes()
    )


def _decode_column(data: bytes, position: int, rows: int, out: IntArray) -> int:
    """Decode a column into `out` (n,).

    Returns:
        The position of the next column.
    """
    if len(data) < position + _COLUMN.size:
        raise ValueError("not an array: too short")
    column_code, first, least = _COLUMN.unpack_from(data, position)
    use_differences, bits, position = column_code >> 7, column_code & 0x7F, position + _COLUMN.size
    count = rows - use_differences
    end = position + (count * bits + 7) // 8
    if not 0 < bits < 63 or count < 1 or len(data) < end or max(abs(first), abs(least)) > MAX_INTEGER:
        raise ValueError("not an array: its shape and size disagree")
    bit_rows = np.unpackbits(np.frombuffer(data[position:end], np.uint8), count=count * bits).reshape(count, bits)
    numbers = least + bit_rows.astype(np.int64) @ (np.int64(1) << np.arange(bits, dtype=np.int64))
    out[use_differences:] = numbers
    if use_differences:
        out[0] = first
        np.cumsum(out, out=out)
    return int(end)
