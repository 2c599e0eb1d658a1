"""What smoothing needs of the frames, in a file, since it is much: one frame after the other, as data."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from sylpose.app.encoding import decoded, encoded
from sylpose.app.state import KINDS
from sylpose.files import writing
from sylpose.smoothing.trajectory import Track

__all__ = ["TrackFile"]

# Before each frame: bytes of its table and of all that follows, and a checksum of that.
_FRAME = struct.Struct("<QQI")
DAMAGED = "is damaged; to start anew leave out --resume"


class TrackFile:
    """A file of tracks that grows.

    Args:
        length: bytes that are gone on with; what follows them is written over, by the same. 0: a new file.

    Raises:
        OSError: naming the file, when it cannot be written.
        ValueError: naming it, when it is shorter than that.
    """

    def __init__(self, path: Path, length: int = 0) -> None:
        self.path = path
        if length and (not path.is_file() or path.stat().st_size < length):
            raise ValueError(f"{path}: is not as the interrupted run left it, which cannot be gone on with")
        with writing(path):
            self._file = path.open("r+b" if length else "wb")
            self._file.seek(length)

    def write(self, track: Track) -> None:
        """Appends a frame."""
        table, *blocks = encoded(track, KINDS, {})
        content = b"".join([table, *blocks])
        with writing(self.path):
            self._file.write(_FRAME.pack(len(table), len(content), zlib.crc32(content)) + content)

    def length(self) -> int:
        """In bytes; all that was written is then on the disk."""
        with writing(self.path):
            self._file.flush()
            os.fsync(self._file.fileno())
        return self._file.tell()

    def read(self) -> Iterator[Track]:
        """All frames, in order.

        Raises:
            ValueError: naming the file, which is not as it was written.
        """
        end = self.length()
        with self.path.open("rb") as file:
            while file.tell() < end:
                head = file.read(_FRAME.size)
                if len(head) < _FRAME.size:
                    raise ValueError(f"{self.path}: {DAMAGED}")
                length, size, checksum = _FRAME.unpack(head)
                content = file.read(size) if size <= end - file.tell() else b""
                if len(content) != size or zlib.crc32(content) != checksum:
                    raise ValueError(f"{self.path}: {DAMAGED}")
                try:
                    yield decoded(memoryview(content), length, Track, KINDS, {})
                except ValueError:
                    raise ValueError(f"{self.path}: {DAMAGED}") from None

    def close(self) -> None:
        """Raises OSError, naming the file, when the last of it cannot be written."""
        with writing(self.path):
            self._file.close()
