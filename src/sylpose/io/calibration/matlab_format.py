"""Reader of small variables in Matlab files of versions 6 and 7: numbers, text, cells and structs.

SciPy's reader is not used: damaged files crash the process. Layout: "MAT-File Format" by MathWorks.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sylpose.input_limits import MAX_DEPTH, open_regular_file

# Bytes of a file with labels of a long recording (choice), of a variable with parameters of cameras (choice: a hundred
# times those of six), and number of variables (choice: ten times those of Label3D).
MAX_FILE_BYTES, MAX_VARIABLE_BYTES, MAX_VARIABLES = 2**32, 2**20, 100
HEADER_BYTES = 128
_VERSION_5, _VERSION_73, _HDF5 = b"MATLAB 5", b"MATLAB 7.3", b"\x89HDF\r\n\x1a\n"
_MATRIX, _COMPRESSED = 14, 15
# NumPy's types by Matlab's data types; encodings of text.
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {1: "latin1", 2: "latin1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
# Classes of arrays; numeric ones are from double to uint64.
_CELL, _STRUCT, _CHAR, _NUMERIC = 1, 2, 4, range(6, 16)


def is_version_73(path: Path) -> bool:
    """Return whether a file is a Matlab file of version 7.3, or HDF5."""
    with path.open("rb") as file:
        return file.read(HEADER_BYTES).startswith((_VERSION_73, _HDF5))


def read_variables(path: Path) -> dict[str, Any]:
    """Return the variables of at most `MAX_VARIABLE_BYTES`: arrays, strings, lists for cells, dicts for structs.

    Struct arrays of other than one element are lists. Values of other classes are None.

    Raises:
        ValueError: not a Matlab file of versions 6 and 7, or a damaged one.
    """
    with open_regular_file(path, MAX_FILE_BYTES) as file:
        header = file.read(HEADER_BYTES)
        if header.startswith((_VERSION_73, _HDF5)):
            raise ValueError("a Matlab file of version 7.3 (HDF5), which is not supported; save it with '-v7'")
        order = {b"IM": "<", b"MI": ">"}.get(header[-2:])
        if not header.startswith(_VERSION_5) or order is None:
            raise ValueError("not a Matlab file of version 6 or 7")
        try:
            return dict(_Parser(order).parse_matrix(data) for data in _iterate_variables(file, order))
        except (struct.error, zlib.error, LookupError, UnicodeError, ValueError) as error:
            raise ValueError(f"not a valid Matlab file: {error}") from None


def _iterate_variables(file: BinaryIO, order: str) -> Iterator[bytes]:
    """Yield the content of each small variable's matrix element."""
    for _ in range(MAX_VARIABLES):
        tag = file.read(8)
        if len(tag) < 8:
            return
        kind, size = struct.unpack(f"{order}II", tag)
        data = file.read(min(size, MAX_VARIABLE_BYTES))
        file.seek(size - len(data), 1)
        if kind == _COMPRESSED:
            data = zlib.decompressobj().decompress(data, MAX_VARIABLE_BYTES)
            kind, size = struct.unpack(f"{order}II", data[:8])
            data = data[8:]
        if kind == _MATRIX and len(data) == size:
            yield data


class _Parser:
    """Parser of matrix elements in one byte order."""

    def __init__(self, order: str) -> None:
        self._order = order

    def parse_matrix(self, data: bytes, depth: int = 0) -> tuple[str, Any]:
        """Return name and value of a matrix element's content."""
        if depth > MAX_DEPTH:
            raise ValueError(f"values are nested more than {MAX_DEPTH} deep")
        if not data:
            return "", None
        parts = self._iterate_elements(data)
        class_ = self._read_numbers(next(parts, None), 2)[0] & 0xFF
        shape = [int(n) for n in self._read_numbers(next(parts, None))]
        name = self._read_text(next(parts, None))
        count = math.prod(shape)
        if any(n < 0 for n in shape) or count > MAX_VARIABLE_BYTES:
            raise ValueError(f"implausible dimensions {shape[:3]}")
        if class_ in _NUMERIC:
            return name, self._read_numbers(next(parts, None), count).astype(float).reshape(shape, order="F")
        if class_ == _CHAR:
            return name, self._read_text(next(parts, None))
        if class_ == _CELL:
            return name, [self._read_matrix(next(parts, None), depth) for _ in range(count)]
        if class_ != _STRUCT:
            return name, None
        length = int(self._read_numbers(next(parts, None), 1)[0])
        kind, keys = next(parts, (0, b""))
        if kind not in _TEXTS or not 0 < length <= max(len(keys), 1):
            raise ValueError("a struct without names of its fields")
        names = [keys[k : k + length].split(b"\0")[0].decode() for k in range(0, len(keys), length)]
        # A struct without fields takes no bytes per element.
        count = count if names else 0
        structs = [{key: self._read_matrix(next(parts, None), depth) for key in names} for _ in range(count)]
        return name, structs[0] if count == 1 else structs

    def _iterate_elements(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield data type and content of the elements in some bytes."""
        place = 0
        while place + 8 <= len(data):
            kind, size = struct.unpack_from(f"{self._order}II", data, place)
            if kind >> 16:  # an element of at most four bytes, in its tag
                kind, size, begin = kind & 0xFFFF, kind >> 16, place + 4
                place += 8
            else:
                begin, place = place + 8, place + 8 + (size + 7) // 8 * 8
            if begin + size > len(data) or (begin == place - 4 and size > 4):
                raise ValueError("it is truncated")
            yield kind, data[begin : begin + size]

    def _read_matrix(self, part: tuple[int, bytes] | None, depth: int) -> Any:
        if part is None or part[0] != _MATRIX:
            raise ValueError("an element of a cell or struct is missing")
        return self.parse_matrix(part[1], depth + 1)[1]

    def _read_numbers(self, part: tuple[int, bytes] | None, count: int | None = None) -> Any:
        """Return the numbers of an element; exactly `count` if given."""
        if part is None or part[0] not in _NUMBERS:
            raise ValueError("numbers are missing")
        numbers = np.frombuffer(part[1], self._order + _NUMBERS[part[0]])
        if count is not None and len(numbers) != count:
            raise ValueError(f"{count} numbers are expected, got {len(numbers)}")
        return numbers

    def _read_text(self, part: tuple[int, bytes] | None) -> str:
        if part is None or part[0] not in _TEXTS:
            raise ValueError("a text is missing")
        encoding = _TEXTS[part[0]]
        suffix = {"<": "-le", ">": "-be"}[self._order] if encoding in ("utf-16", "utf-32") else ""
        return part[1].decode(encoding + suffix)
