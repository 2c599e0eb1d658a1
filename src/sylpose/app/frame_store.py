"""What is found in the frames, in files, since it is much: one frame after the other, as data."""

from __future__ import annotations

import os
import struct
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Generic, TypeVar

from sylpose.app.checkpoint_schema import KINDS
from sylpose.app.serialization import decoded, encoded
from sylpose.atomic_io import writing

__all__ = ["FrameFile"]

# Before each frame: bytes of its table and of all that follows, and a checksum of that.
_FRAME = struct.Struct("<QQI")
DAMAGED = "is damaged; to start anew leave out --resume"

T = TypeVar("T")


class FrameFile(Generic[T]):
    """A file that grows by a thing for each frame. What could not be written whole is not in it.

    Args:
        path: of the file; of a folder, for one without a name, which is gone with the process, however that ends.
        kind: of the things, one of `app.checkpoint_schema`.
        length: bytes that are gone on with; what follows them is written over, by the same. 0: a new file.

    Raises:
        OSError: naming the path, when it cannot be written.
        ValueError: naming it, when it is shorter than that.
    """

    def __init__(self, path: Path, kind: type[T], length: int = 0) -> None:
        self.path, self._kind, self._end = path, kind, length
        if length and (not path.is_file() or path.stat().st_size < length):
            raise ValueError(f"{path}: is not as the interrupted run left it, which cannot be gone on with")
        # Without a buffer of its own, what is counted as written has been.
        self._file: IO[bytes]
        with writing(path):
            if path.is_dir():
                self._file = tempfile.TemporaryFile(buffering=0, dir=path)  # noqa: SIM115 (open until `close`)
            else:
                self._file = path.open("r+b" if length else "w+b", buffering=0)

    def write(self, thing: T) -> None:
        """Appends a frame."""
        table, *blocks = encoded(thing, KINDS, {})
        content = b"".join([table, *blocks])
        data = memoryview(_FRAME.pack(len(table), len(content), zlib.crc32(content)) + content)
        with writing(self.path):
            self._file.seek(self._end)
            left = data
            while left:
                left = left[self._file.write(left) :]
        self._end += len(data)

    def length(self) -> int:
        """In bytes; all that was written is then on the disk."""
        with writing(self.path):
            os.fsync(self._file.fileno())
        return self._end

    def read(self) -> Iterator[T]:
        """All frames, in order.

        Raises:
            ValueError: naming the file, which is not as it was written.
        """
        at = 0
        while at < self._end:
            self._file.seek(at)
            head = self._file.read(_FRAME.size)
            if len(head) < _FRAME.size:
                raise ValueError(f"{self.path}: {DAMAGED}")
            length, size, checksum = _FRAME.unpack(head)
            at += _FRAME.size + size
            content = self._file.read(size) if at <= self._end else b""
            if len(content) != size or zlib.crc32(content) != checksum:
                raise ValueError(f"{self.path}: {DAMAGED}")
            try:
                thing: T = decoded(memoryview(content), length, self._kind, KINDS, {})
            except ValueError:
                raise ValueError(f"{self.path}: {DAMAGED}") from None
            yield thing

    def close(self) -> None:
        """Raises OSError, naming the file, when that fails."""
        with writing(self.path):
            self._file.close()
