"""Atomic file output: a file is written completely or not at all, with clear error messages."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO


@contextmanager
def output_errors(path: Path | str) -> Iterator[None]:
    """Turn any OSError of the block into one whose message names `path`."""
    try:
        yield
    except OSError as error:
        if str(error).startswith("cannot write "):  # already converted
            raise
        is_forbidden = error.errno in (errno.EACCES, errno.EPERM, errno.EROFS)
        remedy = "; choose another folder, for results with --out" if is_forbidden else ""
        raise OSError(f"cannot write {path}: {(error.strerror or str(error)).lower()}{remedy}") from error


def make_output_folder(path: Path | str) -> Path:
    """Create a folder with its parents if it does not exist, and return it.

    Raises:
        OSError: naming the folder, when it is a file or cannot be created.
    """
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise OSError(f"cannot write into {folder}: it is a file, a folder was expected")
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def partial_path(path: Path) -> Path:
    """Return the temporary path for a file: hidden, same suffix, not recognized as a calibration."""
    return path.with_name(f".{path.stem}.part{path.suffix}")


@contextmanager
def replace_atomically(path: Path | str, *, mode: int | None = None) -> Iterator[Path]:
    """Write a file atomically: to a temporary file that replaces `path` when the block succeeds.

    Readers see the old or the new file, never a partial one. If the block fails, the old file is unchanged.

    Args:
        path: links are followed; special files such as /dev/null are written to directly; missing parent folders are
            created.
        mode: permissions of the file; None: those of the replaced file, else the default ones.

    Yields:
        the path to write to.

    Raises:
        OSError: naming `path`, for any OSError of the block as well.
    """
    target = Path(os.path.realpath(path))
    with output_errors(path):
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if target.exists() and not target.is_file():
            yield target
            return
        part = partial_path(target)
        make_output_folder(target.parent)
        try:
            part.unlink(missing_ok=True)
            if mode is not None:
                os.close(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode))
            yield part
            with part.open("r+b") as file:
                os.fsync(file.fileno())
            if mode is None and target.exists():
                shutil.copymode(target, part)
            os.replace(part, target)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


class GrowingFile:
    """File that grows at its end; what is written has been passed to the operating system, and errors name the file.

    Args:
        path: the file.
        length: number of bytes of an existing file to keep; later content is overwritten, and cut by `truncate`. None: a
            new file.
        temporary: create an unnamed file in the folder `path`, which disappears when the process ends.

    Attributes:
        length: number of bytes so far.

    Raises:
        OSError: the file cannot be written; the message names it.
        ValueError: naming the file that is missing or shorter than `length`.
    """

    def __init__(self, path: Path, length: int | None = None, *, temporary: bool = False) -> None:
        self.path, self.length = path, length or 0
        if self.length and (not path.is_file() or path.stat().st_size < self.length):
            raise ValueError(f"{path}: has changed since the interrupted run, which therefore cannot be resumed")
        self._file: IO[bytes]
        with output_errors(path):
            if temporary:
                self._file = tempfile.TemporaryFile(buffering=0, dir=path)  # noqa: SIM115 (open until `close`)
            else:
                mode = "w+b" if length is None or not path.exists() else "r+b"
                self._file = path.open(mode, buffering=0)

    def write(self, data: bytes) -> None:
        """Append bytes."""
        remaining = memoryview(data)
        with output_errors(self.path):
            self._file.seek(self.length)
            while remaining:
                remaining = remaining[self._file.write(remaining) :]
        self.length += len(data)

    def read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes, or fewer at the end."""
        self._file.seek(offset)
        return self._file.read(size)

    def flush(self) -> int:
        """Flush everything to the disk and return the length."""
        with output_errors(self.path):
            os.fsync(self._file.fileno())
        return self.length

    def truncate(self, length: int) -> None:
        """Cut the file to this length."""
        with output_errors(self.path):
            self._file.truncate(length)
        self.length = length

    def close(self) -> None:
        """Close the file; may be called twice."""
        with output_errors(self.path):
            self._file.close()


def format_toml_string(text: str) -> str:
    """Format a string as TOML."""
    # A JSON string is also a TOML string, except for the one control character that JSON does not escape.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def format_toml_key(name: str) -> str:
    """Format a name as a TOML key or table name."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else format_toml_string(name)


def format_boxes_toml(boxes: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    """Format the content of boxes.toml (docs/formats.md#boxestoml).

    Args:
        boxes: x, y, width, height in pixels, by object and camera; an object "" has no table and must be the only one.
    """
    lines = ["# Boxes of the object in the first frame, pixels: x, y, width, height."]
    for name, camera_boxes in boxes.items():
        lines += [f"\n[{format_toml_key(name)}]"] if name else []
        for camera, box in camera_boxes.items():
            values = ", ".join(str(int(value)) if value == int(value) else repr(float(value)) for value in box)
            lines.append(f"{format_toml_key(camera)} = [{values}]")
    return "\n".join(lines) + "\n"
