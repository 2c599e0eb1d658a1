"""Calibration files: find one in a folder, load it whatever its format, save a rig."""

from __future__ import annotations

import os
from pathlib import Path

from sylpose.calibration import filestorage, native
from sylpose.calibration.build import Sizes
from sylpose.calibration.formats import told_format
from sylpose.files import replacing
from sylpose.reading import told
from sylpose.rig import Rig

__all__ = ["find", "format_of", "is_calibration_name", "load", "save"]

SUFFIXES = (".toml", ".yml", ".yaml", ".json", ".xml")


def find(folder: str | os.PathLike[str]) -> Path:
    """The one calibration in a session's folder, by name.

    A calibration is called `camera_array`, `cameras` or `rig`, or begins or ends with `calib` or `calibration`
    (calibration.toml, Calib_scene.toml, camera_calibration.yml), and is TOML, YAML, JSON or XML.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: none, or more than one, naming them.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    found = sorted(path for path in folder.iterdir() if path.is_file() and is_calibration_name(path))
    if not found:
        below = next(
            (path for path in sorted(folder.glob("*/*")) if path.is_file() and is_calibration_name(path)), None
        )
        instead = f"; if {below} is its, say --calibration, and the folder that the videos are in" if below else ""
        raise ValueError(
            f"{folder}: no calibration in it; expected one such as calibration.toml, camera_array.toml, "
            f"calibration.yml, .json or .xml{instead}"
        )
    if len(found) > 1:
        raise ValueError(
            f"{folder}: {len(found)} calibrations ({', '.join(p.name for p in found)}); say which one to use"
        )
    return found[0]


def load(path: str | os.PathLike[str], sizes: Sizes | None = None) -> Rig:
    """The rig of a calibration; the format is told from the content.

    Args:
        path: a file, or a folder with a calibration that has several.
        sizes: called with the names of cameras of whose images the calibration does not tell the size: (width, height) by
            name, of those that are known.

    Raises:
        OSError: a file that is not there or cannot be read.
        ValueError: naming the file, and the camera where there is one: no file of text, or too large (`reading`); not a
            calibration of a known format; no cameras, or two of the same name; a key that is missing or of the wrong type
            or shape; a number of distortion terms that OpenCV does not have; a value that is not finite, or absurd; a
            matrix that is not a rotation; images whose size nothing tells.
    """
    path = Path(path)
    with told(path):
        format_, file, data = told_format(path)
        with told(file):
            return format_.rig(data, file, sizes)


def format_of(path: str | os.PathLike[str]) -> str:
    """The name of a calibration's format, for people.

    Raises:
        OSError, ValueError: as `load`.
    """
    path = Path(path)
    with told(path):
        return told_format(path).format_.name


def save(rig: Rig, path: str | os.PathLike[str]) -> None:
    """Write a rig: sylpose's own TOML, or OpenCV's FileStorage for `.yml`, `.yaml`, `.json` and `.xml`.

    Loading gives the same rig back, bit for bit. A file that is there is replaced once the new one is whole.

    Raises:
        ValueError: another suffix.
        OSError: a file that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: a calibration is written as one of {', '.join(SUFFIXES)}")
    text = native.to_text(rig) if suffix == ".toml" else filestorage.to_text(rig, suffix)
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def is_calibration_name(path: Path) -> bool:
    """Whether `find` takes a file of this name for a calibration."""
    stem = path.stem.lower()
    named = stem in ("camera_array", "cameras", "rig") or stem.startswith("calib")
    return path.suffix.lower() in SUFFIXES and (named or stem.endswith(("calib", "calibration")))
