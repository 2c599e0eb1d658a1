"""How files are written: whole or not at all, and with a sentence where they cannot be."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

__all__ = ["beside", "boxes_toml", "output_folder", "replacing", "toml_key", "toml_string", "writing"]


@contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Turns any OSError of the block into one with a sentence that names `path`."""
    try:
        yield
    except OSError as error:
        if str(error).startswith("cannot write "):  # said already
            raise
        raise OSError(f"cannot write {path}: {(error.strerror or str(error)).lower()}") from error


def output_folder(path: Path | str) -> Path:
    """The folder, made with its parents when it is not there.

    Raises:
        OSError: naming the folder, when it is a file or cannot be made.
    """
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise OSError(f"cannot write into {folder}: it is a file, a folder was expected")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def beside(path: Path) -> Path:
    """Where a file is written before it takes its place: hidden, of the same ending, and no name of a calibration."""
    return path.with_name(f".{path.stem}.part{path.suffix}")


@contextmanager
def replacing(path: Path | str, *, mode: int | None = None) -> Iterator[Path]:
    """A file that is written beside another one and takes its place once the block has ended: whoever looks finds the one
    or the other, whole. Where the block fails, the one that was there is as it was.

    Args:
        path: a link is followed; what is no file, such as /dev/null, is written to as it is; folders on its way are made.
        mode: permissions of the file; None: those of the one that was there, else the usual ones.

    Yields:
        where to write.

    Raises:
        OSError: naming `path`, for any OSError of the block, too.
    """
    target = Path(os.path.realpath(path))
    with writing(path):
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if target.exists() and not target.is_file():
            yield target
            return
        part = beside(target)
        output_folder(target.parent)
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


def toml_string(text: str) -> str:
    """A word as TOML has it."""
    # A JSON string is a TOML string too, but for the one control character that JSON leaves as it is.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_key(name: str) -> str:
    """A name before an equals sign or in a table's head."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else toml_string(name)


def boxes_toml(boxes: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    """boxes.toml (docs/formats.md#boxestoml).

    Args:
        boxes: x, y, width, height in pixels, by object and camera; an object "" has no table, and is the only one.
    """
    lines = ["# Boxes of the object in the first frame, pixels: x, y, width, height."]
    for name, its in boxes.items():
        lines += [f"\n[{toml_key(name)}]"] if name else []
        for camera, box in its.items():
            values = ", ".join(str(int(value)) if value == int(value) else repr(float(value)) for value in box)
            lines.append(f"{toml_key(camera)} = [{values}]")
    return "\n".join(lines) + "\n"
