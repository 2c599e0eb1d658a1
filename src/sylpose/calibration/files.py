"""Calibration files: find one in a folder, load it whatever its format, save a rig."""

from __future__ import annotations

import os
import re
from pathlib import Path

from sylpose.atomic_io import output_folder, replacing
from sylpose.calibration.camera_builder import Sizes
from sylpose.calibration.formats import stands_for, told_format
from sylpose.calibration.writers import format_for
from sylpose.input_limits import told
from sylpose.rig import Rig

__all__ = ["find", "format_of", "is_calibration_name", "load", "save"]

# Names that other programs give to their calibrations.
_PROGRAMS = (
    r".*camchain.*\.ya?ml",
    r".*\.(?:qca\.txt|xcp|mcal)",
    r"transforms\.json",
    r"intri(?:nsics)?\.(?:ya?ml|json|xml)",
    r"rig_config\.json",
    r"cameras\.bin",
    r"stereo_params\.pickle",
    r"camera1\.Pmat\.cal",
)
SUFFIXES = (".toml", ".yml", ".yaml", ".json", ".xml")


def find(folder: str | os.PathLike[str]) -> Path:
    """The one calibration in a session's folder, by name.

    A calibration is called `camera_array`, `cameras` or `rig`, or begins or ends with `calib` or `calibration`
    (calibration.toml, Calib_scene.toml, camera_calibration.yml), and is TOML, YAML, JSON or XML. Where there is none, it is
    called as another program calls its own (camchain.yaml, take.xcp, intri.yml), or is a folder `calib...` or `sparse/0`.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: none, or more than one, naming them.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    files = sorted(path for path in folder.iterdir() if path.is_file())
    found = [path for path in files if _is_called_so(path)] or [path for path in files if _is_of_a_program(path)]
    if not found:
        inner = sorted(path for path in folder.iterdir() if path.is_dir() and path.name.lower().startswith("calib"))
        found = [path for path in (*inner, folder / "sparse" / "0") if stands_for(path)]
    if not found:
        below = next(
            (path for path in sorted(folder.glob("*/*")) if path.is_file() and is_calibration_name(path)), None
        )
        instead = f"; if {below} is its, say --calibration, and the folder that the videos are in" if below else ""
        raise ValueError(
            f"{folder}: no calibration in it; expected one such as calibration.toml, camera_array.toml, "
            "calibration.yml, .json or .xml, or as another program calls its own (camchain.yaml, intri.yml, take.xcp)"
            f"{instead}"
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


def save(rig: Rig, path: str | os.PathLike[str], to: str | None = None) -> list[str]:
    """Write a rig: sylpose's own TOML, OpenCV's FileStorage, or a format of another program.

    Loading gives the same rig back: bit for bit of sylpose's and OpenCV's, up to rounding and what is said of others. A file
    that is there is replaced once the new one is whole.

    Args:
        to: "sylpose", "opencv", "opencv-stereo", "anipose", "kalibr" or "colmap"; None for what the name tells: sylpose for
            `.toml`, OpenCV for `.yml`, `.yaml`, `.json` and `.xml`, Kalibr where that is called a camchain, COLMAP for a
            folder.

    Returns:
        what is otherwise in it than in the rig, such as its world.

    Raises:
        ValueError: a suffix that is none of these, or not of that format; a lens that it does not have, or another number of
            cameras, by name.
        OSError: a file that cannot be written.
    """
    path = Path(path)
    written = format_for(path, to)
    texts = written.texts(rig, path)
    if not written.suffixes:
        output_folder(path)
    for file, text in texts.items():
        with replacing(file) as part:
            part.write_text(text, encoding="utf-8")
    return written.notes(rig)


def is_calibration_name(path: Path) -> bool:
    """Whether `find` takes a file of this name for a calibration."""
    return _is_called_so(path) or _is_of_a_program(path)


def _is_of_a_program(path: Path) -> bool:
    """intri.yml and intrinsics.yml stand for the two of them."""
    return any(re.fullmatch(pattern, path.name, re.IGNORECASE) for pattern in _PROGRAMS)


def _is_called_so(path: Path) -> bool:
    stem = path.stem.lower()
    named = stem in ("camera_array", "cameras", "rig") or stem.startswith("calib")
    return path.suffix.lower() in SUFFIXES and (named or stem.endswith(("calib", "calibration")))
