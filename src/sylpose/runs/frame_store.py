"""Storage of per-frame results in files, one record per frame."""

from __future__ import annotations

import os
import struct
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Generic, TypeVar

from sylpose.atomic_io import output_errors
from sylpose.runs.checkpoint_schema import RECORD_TYPES
from sylpose.serialization import deserialize, serialize

__all__ = ["FrameFile"]

# Header of each record: size of its table in bytes, size of its whole content, checksum of the content.
_FRAME = struct.Struct("<QQI")
DAMAGED_MESSAGE = "is damaged; omit --resume to start over"

T = TypeVar("T")


class FrameFile(Generic[T]):
    """File that grows by one record per frame; a record that was not written completely is not part of it.

    Args:
        path: the file; or a folder for an unnamed temporary file, which disappears when the process ends.
        kind: type of the records, one of `runs.checkpoint_schema`.
        length: number of bytes of an existing file to keep; the rest is overwritten. 0: a new file.

    Raises:
        OSError: the file cannot be written; the message names it.
        ValueError: the file is shorter than `length`; the message names it.
    """

    def __init__(self, path: Path, kind: type[T], length: int = 0) -> None:
        self.path, self._kind, self._end = path, kind, length
        if length and (not path.is_file() or path.stat().st_size < length):
            raise ValueError(f"{path}: has changed since the interrupted run, which therefore cannot be resumed")
        # Unbuffered: bytes counted as written have been passed to the operating system.
        self._file: IO[bytes]
        with output_errors(path):
            if path.is_dir():
                self._file = tempfile.TemporaryFile(buffering=0, dir=path)  # noqa: SIM115 (open until `close`)
            else:
                self._file = path.open("r+b" if length else "w+b", buffering=0)

    def write(self, record: T) -> None:
        """Append the record of a frame."""
        table, *blocks = serialize(record, RECORD_TYPES, {})
        content = b"".join([table, *blocks])
        data = memoryview(_FRAME.pack(len(table), len(content), zlib.crc32(content)) + content)
        with output_errors(self.path):
            self._file.seek(self._end)
            remaining = data
            while remaining:
                remaining = remaining[self._file.write(remaining) :]
        self._end += len(data)

    def length(self) -> int:
        """Return the length in bytes, after flushing everything to the disk."""
        with output_errors(self.path):
            os.fsync(self._file.fileno())
        return self._end

    def read(self) -> Iterator[T]:
        """Yield all records in order.

        Raises:
            ValueError: the file is damaged; the message names it.
        """
        offset = 0
        while offset < self._end:
            self._file.seek(offset)
            head = self._file.read(_FRAME.size)
            if len(head) < _FRAME.size:
                raise ValueError(f"{self.path}: {DAMAGED_MESSAGE}")
            length, size, checksum = _FRAME.unpack(head)
            offset += _FRAME.size + size
            content = self._file.read(size) if offset <= self._end else b""
            if len(content) != size or zlib.crc32(content) != checksum:
                raise ValueError(f"{self.path}: {DAMAGED_MESSAGE}")
            try:
                record: T = deserialize(memoryview(content), length, self._kind, RECORD_TYPES, {})
            except ValueError:
                raise ValueError(f"{self.path}: {DAMAGED_MESSAGE}") from None
            yield record

    def close(self) -> None:
        """Close the file; raise OSError, which names the file, if that fails."""
        with output_errors(self.path):
            self._file.close()
