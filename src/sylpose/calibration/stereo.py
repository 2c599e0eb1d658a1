"""Two cameras as OpenCV's stereo samples write them: M1 D1 M2 D2 in intrinsics.yml and R T in extrinsics.yml, or all in one.

X_2 = R X_1 + T, as of cv2.stereoCalibrate: the world is the first camera's frame. R1 R2 P1 P2 Q are for rectified images and
are not used. More cameras than two have each a pose of its own, R1 T1, R2 T2, ...: camera_from_world.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.calibration.camera_builder import Sizes, make_camera, make_pose, make_rig, plain, sizes_of
from sylpose.calibration.filestorage import error_of, lens_of, pick, says
from sylpose.calibration.sniffing import beside, plain_of
from sylpose.rig import Rig

__all__ = ["is_stereo", "read", "to_text"]

_WHICH = r"_?(\d+|left|right|l|r)"
_MATRIX = re.compile(r"(?:M|K|A|CM|mtx|camera_?matrix|intrinsics?(?:_?matrix)?)" + _WHICH, re.IGNORECASE)
_LENS = re.compile(r"(?:D|dist|dist_?coeffs?|distortions?|distortion_?coefficients)" + _WHICH, re.IGNORECASE)
_TURN = re.compile(r"(?:R|rotation)" + _WHICH, re.IGNORECASE)
_SHIFT = re.compile(r"(?:T|translation)" + _WHICH, re.IGNORECASE)
_OMNIDIR = re.compile(r"xi" + _WHICH, re.IGNORECASE)
_SIDES = {"l": "left", "r": "right"}


def is_stereo(data: Any) -> bool:
    """Whether a decoded file has numbered camera matrices, or R and T without a camera that they are of."""
    if not isinstance(data, dict):
        return False
    if len(_numbered(data, _MATRIX)) > 1:
        return True
    cameras = any(isinstance(node, dict) and says(node, "matrix") for node in (data, *data.values()))
    return says(data, "rotation", "translation") and not cameras and "cameras" not in data


def read(data: dict[str, Any], path: Path, sizes: Sizes | None = None) -> Rig:
    """The rig; cameras are called by their numbers ("1", "2") or sides ("left", "right").

    Raises:
        ValueError: naming the file, and what is not in it nor in the other one of the two.
    """
    part = data
    if not _numbered(data, _MATRIX):
        data = data | _other(path, "extri", "intri", "camera matrices and lenses (M1 D1 M2 D2)", "R and T alone")
    matrices, lenses = _numbered(data, _MATRIX), _numbered(data, _LENS)
    if found := _numbered(data, _OMNIDIR):
        raise ValueError(f"{path}: {next(iter(found.values()))[0]}: cv2.omnidir's model is none that sylpose has")
    if len(matrices) < 2:
        raise ValueError(f"{path}: R and T are between two cameras, and there is a camera matrix of one")
    own = _own_poses(data, list(matrices), path)
    if own is None and not says(data, "rotation", "translation"):
        what = "camera matrices without R and T"
        if _numbered(part, _TURN):
            what += " (R1 and R2 are those that rectify images)"
        data = data | _other(path, "intri", "extri", "R and T, the second camera's pose", what)
    where = str(path)
    size = pick(data, "size", where)
    if size is None and says(data, "width", "height"):
        size = [pick(data, "width", where), pick(data, "height", where)]
    known = dict.fromkeys(matrices, size) if size is not None else sizes_of(path, list(matrices), sizes)
    if own is None:
        if len(matrices) > 2:
            raise ValueError(f"{path}: {len(matrices)} camera matrices and one R and T: each camera needs its R and T")
        first, second = matrices
        turn, shift = pick(data, "rotation", where), pick(data, "translation", where)
        own = {first: RigidTransform.identity(), second: make_pose(path, second, turn, shift)}
    cameras = []
    for name, (key, matrix) in matrices.items():
        if name not in lenses:
            raise ValueError(f"{path}: camera {name}: no distortion beside {key!r}, such as D{name}")
        cameras.append(
            make_camera(
                path,
                name,
                size=known[name],
                matrix=plain(matrix, f"{path}: {key}"),
                distortion=plain(lenses[name][1], f"{path}: {lenses[name][0]}"),
                camera_from_world=own[name],
                lens=lens_of(data, where),
                error_px=error_of(data, where),
            )
        )
    return make_rig(path, cameras)


def to_text(rig: Rig, suffix: str) -> str:
    """The text of a file of that suffix with all in it, as OpenCV's sample calls it, and the images' size.

    Raises:
        ValueError: other than two cameras, of one size and lens model.
    """
    if len(rig) != 2:
        raise ValueError(
            f"an OpenCV stereo calibration is of two cameras, not of {len(rig)} ({', '.join(rig.names)}); Rig.subset "
            "chooses two, or --only CAM --only CAM of sylpose calibration convert"
        )
    first, second = rig
    for what, same in (("sizes", first.size == second.size), ("lens models", first.lens == second.lens)):
        if not same:
            raise ValueError(
                f"an OpenCV stereo calibration has no cameras of different {what}: {first.name}, {second.name}"
            )
    pose = (second.camera_from_world * first.camera_from_world.inv()).as_matrix()
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for i, camera in enumerate(rig, start=1):
        storage.write(f"M{i}", np.array(camera.matrix))
        storage.write(f"D{i}", camera.distortion.reshape(1, -1).copy())
    storage.write("R", pose[:3, :3].copy())
    storage.write("T", pose[:3, 3:].copy())
    storage.write("image_width", first.size[0])
    storage.write("image_height", first.size[1])
    if first.lens == "fisheye":
        storage.write("fisheye", 1)
    return str(storage.releaseAndGetString())


def _numbered(data: dict[str, Any], key: re.Pattern[str]) -> dict[str, tuple[str, Any]]:
    """By the camera's number or side: key and value."""
    found: dict[str, tuple[str, Any]] = {}
    for name, value in data.items():
        if value is not None and (match := key.fullmatch(name)):
            which = match[1].lower()
            found.setdefault(_SIDES.get(which, which), (name, value))
    return found


def _own_poses(data: dict[str, Any], names: list[str], path: Path) -> dict[str, RigidTransform] | None:
    """camera_from_world of cameras that have each a turn and a shift; None unless all have."""
    turns, shifts = _numbered(data, _TURN), _numbered(data, _SHIFT)
    if any(name not in turns or name not in shifts for name in names):
        return None
    return {
        name: make_pose(path, name, *(plain(value, f"{path}: {key}") for key, value in (turns[name], shifts[name])))
        for name in names
    }


def _other(path: Path, part: str, other: str, what: str, this: str) -> dict[str, Any]:
    """The content of the other one of the two files."""
    file = beside(path, part, other)
    if file is None:
        raise ValueError(
            f"{path}: this is one of two files of an OpenCV stereo calibration, {this}; needed are {what}, in it or in "
            f"{'intrinsics' if other == 'intri' else 'extrinsics'}.yml beside it"
        )
    found = plain_of(file)
    if not isinstance(found, dict):
        raise ValueError(f"{file}: not a map of names and values")
    return found
