"""Atomic file output: a file is written completely or not at all, with clear error messages."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def output_errors(path: Path | str) -> Iterator[None]:
    """Turn any OSError of the block into one whose message names `path`."""
    try:
        yield
    except OSError as error:
        if str(error).startswith("cannot write "):  # already converted
            raise
        raise OSError(f"cannot write {path}: {(error.strerror or str(error)).lower()}") from error


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
