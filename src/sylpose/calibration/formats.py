"""All formats of calibrations: how each is told and read."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from sylpose.calibration import (
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
from sylpose.calibration.camera_builder import Sizes
from sylpose.calibration.colmap_model import is_model, read_model
from sylpose.calibration.incomplete_files import unfinished
from sylpose.calibration.sniffing import content_of
from sylpose.input_limits import told
from sylpose.rig import Rig

__all__ = ["FORMATS", "Format", "stands_for", "told_format"]


class Format(NamedTuple):
    """A format of calibrations.

    Attributes:
        name: for people.
        tells: whether a file's content is of it, however whole.
        read: the rig of such a file; of formats that do not say how large images are, with what else tells that.
        sized: whether every such file says how large its images are.
    """

    name: str
    tells: Callable[[Any], bool]
    read: Callable[..., Rig]
    sized: bool = True

    def rig(self, data: Any, path: Path, sizes: Sizes | None) -> Rig:
        """The rig of a file with this content."""
        return self.read(data, path) if self.sized else self.read(data, path, sizes)


# By the names of their files.
COLMAP = Format("COLMAP model", is_model, colmap.read)
NAMED = (
    Format("MultiCamSelfCal", multicamselfcal.is_multicamselfcal, multicamselfcal.read, sized=False),
    Format("DeepLabCut pickle", deeplabcut.is_pickle, deeplabcut.read, sized=False),
)
# By kind of content; those that are told by more stand before those that are told by less.
FORMATS: dict[str, tuple[Format, ...]] = {
    "toml": (
        Format("sylpose TOML", lambda data: "format" in data, native.read),
        Format("Caliscope TOML", caliscope.is_caliscope, caliscope.read),
        Format("Anipose TOML", anipose.is_anipose, anipose.read),
    ),
    "plain": (
        Format("COLMAP rig_config", colmap.is_rig_config, colmap.read_rig_config, sized=False),
        Format("NeRF transforms", nerf.is_nerf, nerf.read, sized=False),
        Format("Matlab stereoParameters", matlab.is_matlab, matlab.read, sized=False),
        Format("JARVIS", jarvis.is_jarvis, jarvis.read, sized=False),
        Format("EasyMocap", easymocap.is_easymocap, easymocap.read, sized=False),
        Format("ROS camera_info", ros.is_ros, ros.read),
        Format("Kalibr camchain", kalibr.is_kalibr, kalibr.read),
        Format("OpenCV stereo", stereo.is_stereo, stereo.read, sized=False),
        Format("OpenCV FileStorage", filestorage.is_calibration, filestorage.read, sized=False),
    ),
    "xml": (
        Format("Qualisys", qualisys.is_qualisys, qualisys.read),
        Format("Vicon XCP", vicon.is_vicon, vicon.read),
        Format("OptiTrack MCAL", optitrack.is_optitrack, optitrack.read),
        Format("Metashape XML", metashape.is_metashape, metashape.read),
    ),
    "unknown": (),
}
KNOWN = (
    "known are sylpose, Anipose and Caliscope TOML, OpenCV (nodes of cameras, or stereo), Kalibr, COLMAP, ROS, JARVIS, "
    "Qualisys, Vicon, OptiTrack, EasyMocap, MultiCamSelfCal, Matlab, Metashape, NeRF and DeepLabCut"
)
# Files of programs whose calibrations are read in another form, by their names' ends.
_IN_ANOTHER_FORM = {
    ".mat": "a Matlab file, which is not read; write stereoParams as JSON, jsonencode(toStruct(stereoParams))",
    ".cal": "a .cal is not read; of OptiTrack, .mcal is (of Motive 3.2 and newer), of MultiCamSelfCal camera1.Pmat.cal, ...",
    ".csv": "a table is not read as a calibration; of OptiTrack, .mcal is (of Motive 3.2 and newer)",
    **dict.fromkeys(
        (".npy", ".npz"), "NumPy's arrays are not read, whose names are anybody's; write a calibration.toml"
    ),
}


class Told(NamedTuple):
    """The format of a calibration, its file, and what is in that."""

    format_: Format
    path: Path
    data: Any


# Names of files that stand for a folder, those that tell more before those that tell less; and whether one calibration may
# have several of them.
IN_FOLDERS = (
    (r"cameras\.(?:bin|txt)", True),
    (r"camera[0-9]+\.Pmat\.cal", True),
    (r"stereo_params\.pickle", False),
    (r"(?:.*[_-])?calib.*\.(?:toml|ya?ml|json|xml)", False),
    (r".*intri.*\.(?:ya?ml|json|xml)", False),
    (r".*camchain.*\.ya?ml", False),
    (r".*\.ya?ml", True),
    (r".*\.(?:toml|json|xml|xcp|mcal|qca\.txt)", False),
)


def told_format(path: Path) -> Told:
    """The format of a file, or of a folder with several of one calibration, told from its content.

    Raises:
        OSError: it cannot be read.
        ValueError: it is of no format that is known.
    """
    if path.is_dir():
        if (file := stands_for(path)) is None:
            raise ValueError(f"{path}: no calibration of a known format in this folder; {KNOWN}")
        path = file
    with told(path):
        return _told_format(path)


def stands_for(folder: Path) -> Path | None:
    """The file of a calibration that is a folder by which it can be told and read; None where there is none.

    Raises:
        ValueError: naming the folder, where there are several and it is not clear which.
    """
    if not folder.is_dir():
        return None
    files = [file for file in sorted(folder.iterdir()) if file.is_file() and not file.name.startswith(".")]
    for pattern, several in IN_FOLDERS:
        if found := [file for file in files if re.fullmatch(pattern, file.name, re.IGNORECASE)]:
            if len(found) > 1 and not several:
                raise ValueError(f"{folder}: {', '.join(file.name for file in found)}; say which one to use")
            return found[0]
    return None


def _told_format(path: Path) -> Told:
    if is_model(path):
        return Told(COLMAP, path, read_model(path))
    for format_ in NAMED:
        if format_.tells(path):
            return Told(format_, path, None)
    if said := _IN_ANOTHER_FORM.get(path.suffix.lower()):
        raise ValueError(said)
    kind, data = content_of(path)
    for format_ in FORMATS[kind]:
        if format_.tells(data):
            return Told(format_, path, data)
    if (said := unfinished(kind, data)) is not None:
        raise ValueError(f"no calibration: this looks like a file of {said}")
    raise ValueError(f"not a calibration of a known format; {KNOWN}")
