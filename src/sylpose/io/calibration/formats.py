"""Registry of calibration formats: how each is detected and read."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from sylpose.input_limits import input_errors
from sylpose.io.calibration import (
    anipose,
    caliscope,
    colmap,
    deeplabcut,
    easymocap,
    filestorage,
    jarvis,
    kalibr,
    matlab,
    metashape,
    multicamselfcal,
    native,
    nerf,
    optitrack,
    qualisys,
    ros,
    stereo,
    vicon,
)
from sylpose.io.calibration.camera_builder import SizeLookup
from sylpose.io.calibration.colmap_model import is_model, read_model
from sylpose.io.calibration.incomplete_files import describe_incomplete
from sylpose.io.calibration.sniffing import read_content
from sylpose.rig import Rig

__all__ = ["FORMATS_BY_KIND", "Format", "detect_format", "find_folder_file"]


class Format(NamedTuple):
    """Calibration format.

    Attributes:
        name: name for display.
        matches: whether a file's content has this format, even if incomplete.
        read: reader of the rig; with a size lookup for formats without image sizes.
        has_sizes: whether every file of this format contains image sizes.
    """

    name: str
    matches: Callable[[Any], bool]
    read: Callable[..., Rig]
    has_sizes: bool = True

    def read_rig(self, data: Any, path: Path, sizes: SizeLookup | None) -> Rig:
        """Read the rig of a file with this content."""
        return self.read(data, path) if self.has_sizes else self.read(data, path, sizes)


# Formats detected by file name.
COLMAP_FORMAT = Format("COLMAP model", is_model, colmap.read)
FORMATS_BY_FILE_NAME = (
    Format("MultiCamSelfCal", multicamselfcal.is_multicamselfcal, multicamselfcal.read, has_sizes=False),
    Format("DeepLabCut pickle", deeplabcut.is_pickle, deeplabcut.read, has_sizes=False),
)
# Formats by kind of content, the more specific ones first.
FORMATS_BY_KIND: dict[str, tuple[Format, ...]] = {
    "toml": (
        Format("sylpose TOML", lambda data: "format" in data, native.read),
        Format("Caliscope TOML", caliscope.is_caliscope, caliscope.read),
        Format("Anipose TOML", anipose.is_anipose, anipose.read),
    ),
    "plain": (
        Format("COLMAP rig_config", colmap.is_rig_config, colmap.read_rig_config, has_sizes=False),
        Format("NeRF transforms", nerf.is_nerf, nerf.read, has_sizes=False),
        Format("Matlab stereoParameters", matlab.is_matlab, matlab.read, has_sizes=False),
        Format("JARVIS", jarvis.is_jarvis, jarvis.read, has_sizes=False),
        Format("EasyMocap", easymocap.is_easymocap, easymocap.read, has_sizes=False),
        Format("ROS camera_info", ros.is_ros, ros.read),
        Format("Kalibr camchain", kalibr.is_kalibr, kalibr.read),
        Format("OpenCV stereo", stereo.is_stereo, stereo.read, has_sizes=False),
        Format("OpenCV FileStorage", filestorage.is_calibration, filestorage.read, has_sizes=False),
    ),
    "xml": (
        Format("Qualisys", qualisys.is_qualisys, qualisys.read),
        Format("Vicon XCP", vicon.is_vicon, vicon.read),
        Format("OptiTrack MCAL", optitrack.is_optitrack, optitrack.read),
        Format("Metashape XML", metashape.is_metashape, metashape.read),
    ),
    "unknown": (),
}
KNOWN_FORMATS = (
    "known are sylpose, Anipose and Caliscope TOML, OpenCV (nodes of cameras, or stereo), Kalibr, COLMAP, ROS, JARVIS, "
    "Qualisys, Vicon, OptiTrack, EasyMocap, MultiCamSelfCal, Matlab, Metashape, NeRF and DeepLabCut"
)
# Unsupported file types, by suffix, of programs with a supported alternative.
_UNSUPPORTED_SUFFIXES = {
    ".mat": "Matlab files are not supported; write stereoParams as JSON, jsonencode(toStruct(stereoParams))",
    ".cal": ".cal is not supported; use OptiTrack's .mcal (Motive 3.2 or newer), or MultiCamSelfCal's camera1.Pmat.cal, ...",
    ".csv": "tables are not supported as calibrations; use OptiTrack's .mcal (Motive 3.2 or newer)",
    **dict.fromkeys(
        (".npy", ".npz"), "NumPy arrays have no standard names and are not supported; write a calibration.toml"
    ),
}


class DetectedFormat(NamedTuple):
    """Detected format of a calibration, its file, and that file's content."""

    format_: Format
    path: Path
    data: Any


# File names that identify a calibration folder, more specific ones first, and whether one calibration may have several
# of them.
FOLDER_PATTERNS = (
    (r"cameras\.(?:bin|txt)", True),
    (r"camera[0-9]+\.Pmat\.cal", True),
    (r"stereo_params\.pickle", False),
    (r"(?:.*[_-])?calib.*\.(?:toml|ya?ml|json|xml)", False),
    (r".*intri.*\.(?:ya?ml|json|xml)", False),
    (r".*camchain.*\.ya?ml", False),
    (r".*\.ya?ml", True),
    (r".*\.(?:toml|json|xml|xcp|mcal|qca\.txt)", False),
)


def detect_format(path: Path) -> DetectedFormat:
    """Detect the format of a file, or of the folder of one calibration, from its content.

    Raises:
        OSError: it cannot be read.
        ValueError: the format is unknown.
    """
    if path.is_dir():
        if (file := find_folder_file(path)) is None:
            raise ValueError(f"{path}: no calibration of a known format in this folder; {KNOWN_FORMATS}")
        path = file
    with input_errors(path):
        return _detect_file_format(path)


def find_folder_file(folder: Path) -> Path | None:
    """Find the file of a calibration folder by which it is detected and read; None if there is none.

    Raises:
        ValueError: naming the folder, if there are several candidates.
    """
    if not folder.is_dir():
        return None
    files = [file for file in sorted(folder.iterdir()) if file.is_file() and not file.name.startswith(".")]
    for pattern, allows_several in FOLDER_PATTERNS:
        if found := [file for file in files if re.fullmatch(pattern, file.name, re.IGNORECASE)]:
            if len(found) > 1 and not allows_several:
                raise ValueError(f"{folder}: {', '.join(file.name for file in found)}; specify which one to use")
            return found[0]
    return None


def _detect_file_format(path: Path) -> DetectedFormat:
    if is_model(path):
        return DetectedFormat(COLMAP_FORMAT, path, read_model(path))
    for format_ in FORMATS_BY_FILE_NAME:
        if format_.matches(path):
            return DetectedFormat(format_, path, None)
    if hint := _UNSUPPORTED_SUFFIXES.get(path.suffix.lower()):
        raise ValueError(hint)
    kind, data = read_content(path)
    for format_ in FORMATS_BY_KIND[kind]:
        if format_.matches(data):
            return DetectedFormat(format_, path, data)
    if (hint := describe_incomplete(kind, data)) is not None:
        raise ValueError(f"no calibration: this looks like a file of {hint}")
    raise ValueError(f"not a calibration of a known format; {KNOWN_FORMATS}")
