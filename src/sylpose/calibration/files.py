"""Calibration files: find one in a folder, load it whatever its format, save a rig."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

from sylpose.calibration import anipose, caliscope, filestorage, native
from sylpose.files import replacing
from sylpose.reading import parsed_toml, text_of, told
from sylpose.rig import Rig

__all__ = ["find", "is_calibration_name", "load", "save"]

SUFFIXES = (".toml", ".yml", ".yaml", ".json", ".xml")
KNOWN = (
    "known are sylpose, Anipose and Caliscope TOML, and OpenCV FileStorage YAML, JSON and XML "
    "with a node per camera or a sequence 'cameras'"
)


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
        raise ValueError(
            f"{folder}: no calibration in it; expected one such as calibration.toml, camera_array.toml, "
            "calibration.yml, .json or .xml"
        )
    if len(found) > 1:
        raise ValueError(
            f"{folder}: {len(found)} calibrations ({', '.join(p.name for p in found)}); say which one to use"
        )
    return found[0]


def load(path: str | os.PathLike[str]) -> Rig:
    """The rig of a calibration file; the format is told from the content.

    Raises:
        OSError: a file that is not there or cannot be read.
        ValueError: naming the file, and the camera where there is one: no file of text, or too large (`reading`); not a
            calibration of a known format; no cameras, or two of the same name; a key that is missing or of the wrong type
            or shape; a number of distortion terms that OpenCV does not have; a value that is not finite, or absurd; a
            matrix that is not a rotation.
    """
    path = Path(path)
    text = text_of(path)
    with told(path):
        start = text.lstrip()
        if start.startswith(("%YAML", "---", "<", "{")):
            return _read_storage(text, path)
        try:
            data = parsed_toml(text)
        except tomllib.TOMLDecodeError as error:
            # YAML without its header cannot be told from broken TOML but by the name.
            if path.suffix.lower() in (".yml", ".yaml"):
                return _read_storage(text, path)
            if path.suffix.lower() == ".toml":
                raise ValueError(f"not valid TOML: {error}") from None
            raise ValueError(f"not a calibration of a known format; {KNOWN}") from None
        return _read_toml(data, path)


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


def _read_toml(data: dict[str, Any], path: Path) -> Rig:
    if "format" in data:
        return native.read(data, path)
    if caliscope.is_caliscope(data):
        return caliscope.read(data, path)
    if anipose.is_anipose(data):
        return anipose.read(data, path)
    raise ValueError(f"not a calibration of a known format; {KNOWN}")


def _read_storage(text: str, path: Path) -> Rig:
    data = filestorage.decode(text)
    if not filestorage.is_calibration(data):
        raise ValueError(f"not a calibration of a known format; {KNOWN}")
    return filestorage.read(data, path)
