"""Calibration files: find one in a folder, load any format, save a rig."""

from __future__ import annotations

import os
import re
from pathlib import Path

from sylpose.atomic_io import make_output_folder, replace_atomically
from sylpose.input_limits import input_errors
from sylpose.io.calibration.camera_builder import SizeLookup
from sylpose.io.calibration.formats import choose_output_format, detect_format, find_folder_file
from sylpose.rig import Rig

# Calibration file names of other programs.
_PROGRAM_PATTERNS = (
    r".*camchain.*\.ya?ml",
    r".*\.(?:qca\.txt|xcp|mcal)",
    r"transforms\.json",
    r"intri(?:nsics)?\.(?:ya?ml|json|xml)",
    r"rig_config\.json",
    r"cameras\.bin",
    r"stereo_params\.pickle",
    r"camera1\.Pmat\.cal",
    r".*(?:label3d|dannce).*\.mat",
    r".*dlt_?coef.*\.csv",
    r"scene_camera\.json",
)
# Names of files of one camera each, which are read together.
_SINGLE_CAMERA_PATTERNS = (
    r"(?:.*_)?cam(?:era)?_?[0-9]+_params\.mat",
    r".*\.cameramodel",
    r".*\.krtd",
    r".*\.ori",
    r".*mayacam.*\.(?:txt|csv)",
    r"scene_camera_.+\.json",
)
SUFFIXES = (".toml", ".yml", ".yaml", ".json", ".xml")


def find(folder: str | os.PathLike[str]) -> Path:
    """Find the single calibration in a session folder, by name.

    A calibration is named `camera_array`, `cameras` or `rig`, or its name begins or ends with `calib` or `calibration`
    (calibration.toml, Calib_scene.toml, camera_calibration.yml); it is TOML, YAML, JSON or XML. Otherwise, names of
    other programs are accepted (camchain.yaml, take.xcp, intri.yml), then the first file of a program that has one for
    each camera (hires_cam1_params.mat, a.cameramodel), then a folder `calib...`, `cal` or `sparse/0`.

    Args:
        folder: folder of the session.

    Returns:
        path of the calibration file or folder.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: none, or more than one, naming them.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    found = search(folder)
    if not found:
        nested = next(
            (path for path in sorted(folder.glob("*/*")) if path.is_file() and is_calibration_name(path)), None
        )
        hint = f"; to use {nested}, pass it by --calibration, with the folder of the videos" if nested else ""
        raise ValueError(
            f"{folder}: no calibration in it; expected one such as calibration.toml, camera_array.toml, "
            "calibration.yml, .json or .xml, or a file of another program (camchain.yaml, intri.yml, take.xcp), or make one "
            "by sylpose calibrate"
            f"{hint}"
        )
    if len(found) > 1:
        raise ValueError(
            f"{folder}: {len(found)} calibrations ({', '.join(p.name for p in found)}); specify which one to use"
        )
    return found[0]


def search(folder: Path) -> list[Path]:
    """Return the calibrations in a folder by name, as `find`: of the kind that comes first, all."""
    files = sorted(path for path in folder.iterdir() if path.is_file())
    found = [path for path in files if _has_calibration_name(path)] or [
        path for path in files if _has_program_name(path)
    ]
    if not found:
        of_each_camera = (
            [path for path in files if re.fullmatch(pattern, path.name, re.IGNORECASE)]
            for pattern in _SINGLE_CAMERA_PATTERNS
        )
        found = [paths[0] for paths in of_each_camera if paths]
    if not found:
        inner = sorted(path for path in folder.iterdir() if path.is_dir() and _is_calibration_folder(path.name.lower()))
        found = [path for path in (*inner, folder / "sparse" / "0") if find_folder_file(path)]
    return found


def load(path: str | os.PathLike[str], sizes: SizeLookup | None = None) -> Rig:
    """Load the rig of a calibration; the format is detected from the content.

    Args:
        path: a file, or the folder of a calibration with several files.
        sizes: called with the names of cameras whose image size is not in the calibration; returns known (width,
            height) by name.

    Raises:
        OSError: a file that is missing or cannot be read.
        ValueError: naming the file, and the camera if applicable: no text file, or too large (`input_limits`); not a
            calibration of a known format; no cameras, or two of the same name; a key that is missing or of the wrong
            type or shape; a number of distortion terms that OpenCV does not have; a value that is not finite, or
            implausible; a matrix that is not a rotation; unknown image size.
    """
    path = Path(path)
    with input_errors(path):
        format_, file, data = detect_format(path)
        with input_errors(file):
            return format_.read_rig(data, file, sizes)


def format_name(path: str | os.PathLike[str]) -> str:
    """Return the display name of a calibration's format.

    Raises:
        OSError, ValueError: as `load`.
    """
    path = Path(path)
    with input_errors(path):
        return detect_format(path).format_.name


def save(rig: Rig, path: str | os.PathLike[str], to: str | None = None) -> list[str]:
    """Write a rig as sylpose's own TOML, OpenCV's FileStorage, or a format of another program.

    Loading returns the same rig: bit for bit with sylpose's and OpenCV's formats, otherwise up to rounding and the
    returned notes. An existing file is replaced once the new one is complete.

    Args:
        rig: the cameras.
        path: path of the file or folder.
        to: "sylpose", "opencv", "opencv-stereo", "anipose", "kalibr" or "colmap"; None to choose by name: sylpose for
            `.toml`, OpenCV for `.yml`, `.yaml`, `.json` and `.xml`, Kalibr if the name contains camchain, COLMAP for a
            folder.

    Returns:
        notes on differences between the file and the rig, such as its world.

    Raises:
        ValueError: an unknown suffix, or one that does not fit the format; a lens or number of cameras that the format
            does not support.
        OSError: a file that cannot be written.
    """
    path = Path(path)
    written = choose_output_format(path, to)
    texts = written.to_texts(rig, path)
    if not written.suffixes:
        make_output_folder(path)
    for file, text in texts.items():
        with replace_atomically(file) as part:
            part.write_text(text, encoding="utf-8")
    return written.list_differences(rig)


def is_calibration_name(path: Path) -> bool:
    """Return whether `find` accepts a file of this name as a calibration."""
    return _has_calibration_name(path) or _has_program_name(path)


def _is_calibration_folder(name: str) -> bool:
    """Return whether a folder has the name of a calibration; OpenPTV's is cal."""
    return name == "cal" or name.startswith("calib")


def _has_program_name(path: Path) -> bool:
    """Return whether this is the calibration file of another program; intri.yml and intrinsics.yml represent pairs."""
    return any(re.fullmatch(pattern, path.name, re.IGNORECASE) for pattern in _PROGRAM_PATTERNS)


def _has_calibration_name(path: Path) -> bool:
    stem = path.stem.lower()
    has_known_stem = stem in ("camera_array", "cameras", "rig") or stem.startswith("calib")
    # MC-Calib writes calibrated_objects_data.yml, with its boards, next to calibrated_cameras_data.yml.
    is_board = stem.startswith("calibrated_objects")
    is_named = has_known_stem or stem.endswith(("calib", "calibration"))
    return path.suffix.lower() in SUFFIXES and is_named and not is_board
