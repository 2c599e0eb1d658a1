"""Stereo calibrations of OpenCV and Matlab. X_2 = R X_1 + T: the world is the first camera's frame.

- OpenCV: M1 D1 M2 D2 in intrinsics.yml and R T in extrinsics.yml, or all in one file, as of cv2.stereoCalibrate. R1 R2 P1
  P2 Q belong to rectified images and are not used. With more than two cameras, each has its own pose camera_from_world,
  R1 T1, R2 T2, ...
- Matlab: stereoParameters as JSON, jsonencode(toStruct(stereoParams)). Matlab's first pixel is (1, 1). IntrinsicMatrix and
  RotationOfCamera2 apply to row vectors and are the transposes of OpenCV's; K and PoseCamera2 of newer versions are not.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
from scipy.spatial.transform import RigidTransform

from sylpose.io.calibration.camera_builder import CameraEntry, Entry, SizeLookup, lookup_sizes, make_rig
from sylpose.io.calibration.filestorage import (
    get_value,
    has_values,
    parse_error_px,
    parse_lens_model,
    write_arrays,
)
from sylpose.io.calibration.markup import find_sibling_file, read_plain
from sylpose.rig import Camera, Rig

_CAMERA_SUFFIX = r"_?(\d+|left|right|l|r)"
_MATRIX = re.compile(r"(?:M|K|A|CM|mtx|camera_?matrix|intrinsics?(?:_?matrix)?)" + _CAMERA_SUFFIX, re.IGNORECASE)
_LENS = re.compile(r"(?:D|dist|dist_?coeffs?|distortions?|distortion_?coefficients)" + _CAMERA_SUFFIX, re.IGNORECASE)
_ROTATION = re.compile(r"(?:R|rotation)" + _CAMERA_SUFFIX, re.IGNORECASE)
_TRANSLATION = re.compile(r"(?:T|translation)" + _CAMERA_SUFFIX, re.IGNORECASE)
_OMNIDIR = re.compile(r"xi" + _CAMERA_SUFFIX, re.IGNORECASE)
_SIDES = {"l": "left", "r": "right"}


def is_stereo(data: Any) -> bool:
    """Return whether a decoded file has numbered camera matrices, or R and T without a camera they belong to."""
    if not isinstance(data, dict):
        return False
    if count_matrices(data) > 1:
        return True
    cameras = any(isinstance(node, dict) and has_values(node, "matrix") for node in (data, *data.values()))
    return has_values(data, "rotation", "translation") and not cameras and "cameras" not in data


def count_matrices(data: dict[str, Any]) -> int:
    """Return the number of numbered camera matrices."""
    return len(_collect_numbered(data, _MATRIX))


def read(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig; cameras are named by their numbers ("1", "2") or sides ("left", "right").

    Raises:
        ValueError: naming the file, and what is missing in it and its counterpart.
    """
    given_data = data
    if not _collect_numbered(data, _MATRIX):
        data = data | _read_other_file(
            path, "extri", "intri", "camera matrices and lenses (M1 D1 M2 D2)", "R and T alone"
        )
    matrices, lenses = _collect_numbered(data, _MATRIX), _collect_numbered(data, _LENS)
    if found := _collect_numbered(data, _OMNIDIR):
        raise ValueError(f"{path}: {next(iter(found.values()))[0]}: cv2.omnidir's model is not supported")
    if len(matrices) < 2:
        raise ValueError(f"{path}: R and T relate two cameras, but there is only one camera matrix")
    poses = _read_own_poses(data, list(matrices), path)
    if poses is None and not has_values(data, "rotation", "translation"):
        what = "camera matrices without R and T"
        if _collect_numbered(given_data, _ROTATION):
            what += " (R1 and R2 only rectify images)"
        data = data | _read_other_file(path, "intri", "extri", "R and T, the second camera's pose", what)
    where = Entry(path)
    size = get_value(data, "size", where)
    if size is None and has_values(data, "width", "height"):
        size = [get_value(data, "width", where), get_value(data, "height", where)]
    known_sizes = lookup_sizes(path, list(matrices), sizes, {} if size is None else dict.fromkeys(matrices, size))
    if poses is None:
        if len(matrices) > 2:
            raise ValueError(f"{path}: {len(matrices)} camera matrices and one R and T: each camera needs its R and T")
        first, second = matrices
        rotation, translation = get_value(data, "rotation", where), get_value(data, "translation", where)
        poses = {first: RigidTransform.identity(), second: CameraEntry(path, second).make_pose(rotation, translation)}
    lens_model, error_px = parse_lens_model(data, where), parse_error_px(data, where)
    cameras = []
    for name, (key, matrix) in matrices.items():
        entry = CameraEntry(path, name)
        if name not in lenses:
            raise entry.error(f"no distortion next to {key!r}, such as D{name}")
        arrays = where.to_plain(matrix, key), where.to_plain(lenses[name][1], lenses[name][0])
        cameras.append(entry.make_camera(known_sizes[name], *arrays, poses[name], lens_model, error_px))
    return make_rig(path, cameras)


def to_text(rig: Rig, suffix: str) -> str:
    """Format the rig as a single file for that suffix, with the keys of OpenCV's sample and the image size.

    Raises:
        ValueError: other than two cameras, of one size and lens model.
    """
    if len(rig) != 2:
        raise ValueError(
            f"an OpenCV stereo calibration has two cameras, not {len(rig)} ({', '.join(rig.names)}); Rig.subset "
            "chooses two, or --only CAM --only CAM of sylpose calibration convert"
        )
    first, second = rig
    for what, same in (("sizes", first.size == second.size), ("lens models", first.lens == second.lens)):
        if not same:
            raise ValueError(
                f"an OpenCV stereo calibration requires equal {what}: those of {first.name} and {second.name} differ"
            )
    pose = (second.camera_from_world * first.camera_from_world.inv()).as_matrix()
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for i, camera in enumerate(rig, start=1):
        write_arrays(storage, {f"M{i}": camera.matrix, f"D{i}": camera.distortion.reshape(1, -1)})
    write_arrays(storage, {"R": pose[:3, :3], "T": pose[:3, 3:]})
    storage.write("image_width", first.size[0])
    storage.write("image_height", first.size[1])
    if first.lens == "fisheye":
        storage.write("fisheye", 1)
    return str(storage.releaseAndGetString())


def _collect_numbered(data: dict[str, Any], key: re.Pattern[str]) -> dict[str, tuple[str, Any]]:
    """Collect key and value by the camera's number or side."""
    found: dict[str, tuple[str, Any]] = {}
    for name, value in data.items():
        if value is not None and (match := key.fullmatch(name)):
            suffix = match[1].lower()
            found.setdefault(_SIDES.get(suffix, suffix), (name, value))
    return found


def _read_own_poses(data: dict[str, Any], names: list[str], path: Path) -> dict[str, RigidTransform] | None:
    """Return camera_from_world of cameras with their own rotation and translation; None unless all have both."""
    rotations, translations = _collect_numbered(data, _ROTATION), _collect_numbered(data, _TRANSLATION)
    if any(name not in rotations or name not in translations for name in names):
        return None
    poses = {}
    for name in names:
        rotation, translation = (
            Entry(path).to_plain(value, key) for key, value in (rotations[name], translations[name])
        )
        poses[name] = CameraEntry(path, name).make_pose(rotation, translation)
    return poses


def _read_other_file(path: Path, part: str, other: str, what: str, present: str) -> dict[str, Any]:
    """Read the content of the counterpart file."""
    file = find_sibling_file(path, part, other)
    if file is None:
        raise ValueError(
            f"{path}: this is one of two files of an OpenCV stereo calibration, {present}; it requires {what}, in it or "
            f"in {'intrinsics' if other == 'intri' else 'extrinsics'}.yml next to it"
        )
    found = read_plain(file)
    if not isinstance(found, dict):
        raise ValueError(f"{file}: not a map of names and values")
    return found


# Matlab


_UNITS = {"millimeters": "mm", "centimeters": "cm", "meters": "m", "inches": "in"}
_UNITS |= {unit: unit for unit in _UNITS.values()}


def is_matlab(data: Any) -> bool:
    """Return whether decoded JSON has Matlab's keys of two cameras, or of one."""
    return isinstance(data, dict) and bool(
        {"CameraParameters1", "CameraParameters2"} & data.keys() or _is_matlab_lens(data)
    )


def read_matlab(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of cameras "1" and "2".

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    nodes = {name: data.get(f"CameraParameters{name}") for name in ("1", "2")}
    if any(node is None for node in nodes.values()):
        raise ValueError(f"{path}: these are Matlab's parameters of one camera; stereoParameters of two are required")
    entries = {name: CameraEntry(path, name) for name in nodes}
    lenses = {name: _find_matlab_lens(node, entries[name]) for name, node in nodes.items()}
    # ImageSize is (rows, columns).
    given_sizes = {
        name: entries[name].parse_numbers(node["ImageSize"], 2, "ImageSize")[::-1]
        for name, node in lenses.items()
        if node.get("ImageSize")
    }
    known_sizes = lookup_sizes(path, list(nodes), sizes, given_sizes)
    poses = {"1": RigidTransform.identity(), "2": _parse_matlab_pose(data, entries["2"])}
    word = str(data["CameraParameters1"].get("WorldUnits") or "").lower()
    cameras = [_parse_matlab_camera(entries[name], lenses[name], known_sizes[name], poses[name]) for name in nodes]
    return make_rig(path, cameras, _UNITS.get(word, ""))


def _is_matlab_lens(node: Any) -> bool:
    return isinstance(node, dict) and "RadialDistortion" in node and ("IntrinsicMatrix" in node or "K" in node)


def _find_matlab_lens(node: Any, entry: CameraEntry) -> dict[str, Any]:
    """Return the struct with the numbers: the camera's own, or its Intrinsics."""
    inner = node.get("Intrinsics", {}) if isinstance(node, dict) else {}
    for lens in (node, inner):
        if isinstance(lens, dict) and _is_matlab_lens(lens):
            return lens
    if any(isinstance(lens, dict) and "MappingCoefficients" in lens for lens in (node, inner)):
        raise entry.error("Matlab's fisheye model (Scaramuzza's) is not supported")
    raise entry.error("missing RadialDistortion and K, or IntrinsicMatrix, of Matlab's cameraParameters")


def _parse_matlab_pose(data: dict[str, Any], entry: CameraEntry) -> RigidTransform:
    struct = data.get("PoseCamera2")
    if isinstance(struct, dict) and "A" in struct:
        pose = Entry(entry.path).parse_numbers(struct["A"], 16, "PoseCamera2.A").reshape(4, 4)
        return entry.make_pose(pose[:3, :3], pose[:3, 3])
    if isinstance(struct, dict) and {"R", "Translation"} <= struct.keys():
        return entry.make_pose(struct["R"], struct["Translation"])
    if not {"RotationOfCamera2", "TranslationOfCamera2"} <= data.keys():
        raise ValueError(
            f"{entry.path}: these are Matlab's stereoParameters without PoseCamera2, or RotationOfCamera2 and "
            "TranslationOfCamera2"
        )
    rotation = Entry(entry.path).parse_matrix(data["RotationOfCamera2"], "RotationOfCamera2").T
    return entry.make_pose(rotation, data["TranslationOfCamera2"])


def _parse_matlab_camera(entry: CameraEntry, node: dict[str, Any], size: Any, pose: RigidTransform) -> Camera:
    key = "K" if node.get("K") is not None else "IntrinsicMatrix"
    matrix = entry.parse_matrix(node[key], key)
    matrix = (matrix if key == "K" else matrix.T).copy()
    matrix[:2, 2] -= 1.0
    k = entry.parse_numbers(node["RadialDistortion"], (2, 3), "RadialDistortion")
    p = entry.parse_numbers(node.get("TangentialDistortion") or [0, 0], 2, "TangentialDistortion")
    return entry.make_camera(size, matrix, [k[0], k[1], p[0], p[1], *k[2:]], pose)
