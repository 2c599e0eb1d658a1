"""Registry of calibration formats: how each is detected, read and written."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from sylpose.input_limits import input_errors
from sylpose.io.calibration import (
    anipose,
    biomechanics,
    colmap,
    dannce,
    filestorage,
    folders,
    kalibr,
    kwiver,
    motion_capture,
    mrcal,
    native,
    opencap,
    opencv_programs,
    openptv,
    photogrammetry,
    posed_images,
    ros,
    stereo,
    stereo_arrays,
)
from sylpose.io.calibration.camera_builder import SizeLookup
from sylpose.io.calibration.incomplete_files import describe_incomplete
from sylpose.io.calibration.markup import read_content
from sylpose.rig import Rig


class Format(NamedTuple):
    """Calibration format.

    Attributes:
        name: name for display.
        matches: whether a file's content has this format, even if incomplete; a file's path, for formats by file name.
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


# Formats detected by file name; their readers get no content.
FORMATS_BY_FILE_NAME = (
    Format("COLMAP model", colmap.is_model, colmap.read),
    Format("MultiCamSelfCal", folders.is_multicamselfcal, folders.read_multicamselfcal, has_sizes=False),
    Format("OpenCap pickle", opencap.is_opencap, opencap.read_opencap),
    Format("DeepLabCut pickle", folders.is_pickle, folders.read_deeplabcut, has_sizes=False),
    Format("stereo arrays", stereo_arrays.is_stereo_arrays, stereo_arrays.read_stereo_arrays, has_sizes=False),
    Format("DANNCE", dannce.is_dannce, dannce.read_dannce, has_sizes=False),
    Format("Label3D", dannce.is_label3d, dannce.read_label3d, has_sizes=False),
    Format("mrcal cameramodel", mrcal.is_mrcal, mrcal.read_mrcal),
    Format("KWIVER KRTD", kwiver.is_krtd, kwiver.read_krtd, has_sizes=False),
    Format("OpenPTV", openptv.is_openptv, openptv.read_openptv),
)
# Formats by kind of content, the more specific ones first.
FORMATS_BY_KIND: dict[str, tuple[Format, ...]] = {
    "toml": (
        Format("sylpose TOML", lambda data: "format" in data, native.read),
        Format("Caliscope TOML", anipose.is_caliscope, anipose.read_caliscope),
        Format("Anipose TOML", anipose.is_anipose, anipose.read),
    ),
    "plain": (
        Format("COLMAP rig_config", colmap.is_rig_config, colmap.read_rig_config, has_sizes=False),
        Format("NeRF transforms", photogrammetry.is_nerf, photogrammetry.read_nerf, has_sizes=False),
        Format("BOP scene_camera", posed_images.is_bop, posed_images.read_bop, has_sizes=False),
        Format("3D Gaussian splatting", posed_images.is_splat, posed_images.read_splat),
        Format("VIAME stereo", kwiver.is_viame, kwiver.read_viame, has_sizes=False),
        Format("Matlab stereoParameters", stereo.is_matlab, stereo.read_matlab, has_sizes=False),
        Format("JARVIS", folders.is_jarvis, folders.read_jarvis, has_sizes=False),
        Format("EasyMocap", folders.is_easymocap, folders.read_easymocap, has_sizes=False),
        Format("ROS camera_info", ros.is_ros, ros.read),
        Format("Kalibr camchain", kalibr.is_kalibr, kalibr.read),
        Format("MC-Calib", opencv_programs.is_mc_calib, opencv_programs.read_mc_calib, has_sizes=False),
        Format("CMU Panoptic", opencv_programs.is_panoptic, opencv_programs.read_panoptic, has_sizes=False),
        Format("OpenCV stereo", stereo.is_stereo, stereo.read, has_sizes=False),
        Format("OpenCV FileStorage", filestorage.is_calibration, filestorage.read, has_sizes=False),
    ),
    "xml": (
        Format("Qualisys", motion_capture.is_qualisys, motion_capture.read_qualisys),
        Format("Vicon XCP", motion_capture.is_vicon, motion_capture.read_vicon),
        Format("OptiTrack MCAL", motion_capture.is_optitrack, motion_capture.read_optitrack),
        Format("Metashape XML", photogrammetry.is_metashape, photogrammetry.read_metashape),
    ),
    "unknown": (
        Format("XMALab MayaCam", biomechanics.is_mayacam, biomechanics.read_mayacam),
        Format("DLT coefficients", biomechanics.is_dlt, biomechanics.read_dlt, has_sizes=False),
    ),
}
KNOWN_FORMATS = (
    "known are sylpose, Anipose, Caliscope, OpenCV, Kalibr, COLMAP, ROS, JARVIS, Qualisys, Vicon, OptiTrack, EasyMocap, "
    "MultiCamSelfCal, Matlab, Metashape, NeRF, DeepLabCut, DANNCE, OpenCap, MC-Calib, Panoptic, mrcal, BOP, 3DGS, XMALab, "
    "DLT, OpenPTV and KWIVER"
)
# Unsupported file types, by suffix, of programs with a supported alternative.
_UNSUPPORTED_SUFFIXES = {
    ".mat": "Matlab files are not supported; write stereoParams as JSON, jsonencode(toStruct(stereoParams))",
    ".cal": ".cal is not supported; use OptiTrack's .mcal (Motive 3.2 or newer), or MultiCamSelfCal's camera1.Pmat.cal, ...",
    **dict.fromkeys(
        (".npy", ".npz"),
        "NumPy arrays have no standard names; with OpenCV's of two cameras (cameraMatrix1, ...) they are read",
    ),
}
_UNKNOWN_TABLE = (
    "tables are not supported as calibrations, apart from DLT coefficients and MayaCam; use OptiTrack's .mcal "
    "(Motive 3.2 or newer)"
)


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
    (r"cameraIntrinsicsExtrinsics\.pickle", False),
    (r"(?:.*_)?cam(?:era)?_?[0-9]+_params\.mat", True),
    (r".*(?:label3d|dannce).*\.mat", False),
    (r".*\.(?:cameramodel|krtd|ori)", True),
    (r".*mayacam.*\.(?:txt|csv)", True),
    (r".*dlt_?coef.*\.csv", False),
    (r"scene_camera.*\.json", True),
    # MC-Calib's folder also has the poses of its boards.
    (r"calibrated_cameras_data\.ya?ml", False),
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
    # OpenCap's folder of videos has a folder of each camera.
    return next(iter(sorted(folder.glob(f"*/{opencap.CAMERA_FILE}"))), None)


def _detect_file_format(path: Path) -> DetectedFormat:
    for format_ in FORMATS_BY_FILE_NAME:
        if format_.matches(path):
            return DetectedFormat(format_, path, None)
    if hint := _UNSUPPORTED_SUFFIXES.get(path.suffix.lower()):
        raise ValueError(hint)
    kind, data = read_content(path)
    for format_ in FORMATS_BY_KIND[kind]:
        if format_.matches(data):
            return DetectedFormat(format_, path, data)
    if path.suffix.lower() == ".csv":
        raise ValueError(_UNKNOWN_TABLE)
    if (hint := describe_incomplete(kind, data)) is not None:
        raise ValueError(f"no calibration: this looks like a file of {hint}")
    raise ValueError(f"not a calibration of a known format; {KNOWN_FORMATS}")


_STORAGE = (".yml", ".yaml", ".json", ".xml")


class OutputFormat(NamedTuple):
    """Output format of rigs.

    Attributes:
        suffixes: suffixes of its file; empty for a folder.
        to_texts: returns the texts of its files by their paths, given the file or folder.
        list_differences: returns sentences on differences between the files and the rig.
    """

    suffixes: tuple[str, ...]
    to_texts: Callable[[Rig, Path], dict[Path, str]]
    list_differences: Callable[[Rig], list[str]] = lambda _: []


def _note_unit(rig: Rig) -> list[str]:
    return [f"it does not contain the length unit, {rig.unit}"] if rig.unit else []


def _note_world(rig: Rig) -> list[str]:
    return [f"its world is the frame of camera {rig.cameras[0].name}"]


def _note_stereo(rig: Rig) -> list[str]:
    names = f"its cameras are called 1 and 2, which are {' and '.join(rig.names)}"
    return [*_note_world(rig), names, *_note_unit(rig)]


def _note_kalibr(rig: Rig) -> list[str]:
    renamed = ", ".join(f"cam{i} is {name}" for i, name in enumerate(rig.names) if name != f"cam{i}")
    unit_note = ["lengths are in m"] if rig.unit not in ("", "m") else []
    return [*_note_world(rig), *([renamed] if renamed else []), *unit_note]


OUTPUT_FORMATS: dict[str, OutputFormat] = {
    "sylpose": OutputFormat((".toml",), lambda rig, path: {path: native.to_text(rig)}),
    "opencv": OutputFormat(_STORAGE, lambda rig, path: {path: filestorage.to_text(rig, path.suffix.lower())}),
    "opencv-stereo": OutputFormat(
        _STORAGE, lambda rig, path: {path: stereo.to_text(rig, path.suffix.lower())}, _note_stereo
    ),
    "anipose": OutputFormat((".toml",), lambda rig, path: {path: anipose.to_text(rig)}, _note_unit),
    "kalibr": OutputFormat((".yaml", ".yml"), lambda rig, path: {path: kalibr.to_text(rig)}, _note_kalibr),
    "colmap": OutputFormat(
        (), lambda rig, folder: {folder / name: text for name, text in colmap.to_texts(rig).items()}, _note_unit
    ),
}


def choose_output_format(path: Path, to: str | None) -> OutputFormat:
    """Choose the output format of a calibration: the given one, or the one implied by the file name.

    Raises:
        ValueError: no such format, or a name that does not fit it.
    """
    suffix = path.suffix.lower()
    if to is None:
        if suffix and suffix not in (".toml", *_STORAGE) and not path.is_dir():
            raise ValueError(
                f"{path}: a calibration is written as one of .toml, {', '.join(_STORAGE)}, or as COLMAP's folder; "
                f"or specify the format: {', '.join(OUTPUT_FORMATS)}"
            )
        to = "sylpose" if suffix == ".toml" else "opencv" if suffix in _STORAGE else "colmap"
        if "camchain" in path.stem.lower() and suffix in OUTPUT_FORMATS["kalibr"].suffixes:
            to = "kalibr"
    if to not in OUTPUT_FORMATS:
        raise ValueError(f"to must be one of {', '.join(OUTPUT_FORMATS)}, got {to!r}")
    if OUTPUT_FORMATS[to].suffixes and suffix not in OUTPUT_FORMATS[to].suffixes:
        raise ValueError(f"{path}: {to} is written as one of {', '.join(OUTPUT_FORMATS[to].suffixes)}")
    return OUTPUT_FORMATS[to]
