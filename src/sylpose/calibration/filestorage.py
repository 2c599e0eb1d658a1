"""OpenCV's FileStorage, YAML, JSON or XML, in the layouts that people write for several cameras.

OpenCV has no layout of its own for a rig. Understood are a node per camera (or a map or a sequence `cameras`), each with

- `camera_matrix` 3x3,
- `distortion_coefficients`,
- `image_width` and `image_height`, or `image_size` (width, height),
- `R` (3x3, or a rotation vector) and `T`: the pose camera_from_world, as of cv2.solvePnP and cv2.stereoCalibrate; or
  `camera_from_world` or `world_from_camera`, 3x4 or 4x4,
- if the lens is not of OpenCV's standard model: `fisheye: 1` or `distortion_model: fisheye`,
- if it is known, `avg_reprojection_error`, pixels: its own, or beside the cameras one of all,

or the usual other names of these (`_NAMES` below), and Multical's `calibration.json`, which keeps its `camera_poses` apart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.calibration.camera_builder import (
    Sizes,
    lens_named,
    make_camera,
    make_pose,
    make_rig,
    plain,
    pose_of_matrix,
    sizes_of,
)
from sylpose.calibration.incomplete_files import unfinished
from sylpose.rig import Camera, LensModel, Rig

__all__ = ["error_of", "is_calibration", "lens_of", "pick", "read", "says", "to_text"]

_NAMES = {
    "matrix": ("camera_matrix", "cameraMatrix", "K", "intrinsic_matrix", "intrinsics", "intrinsic", "matrix", "mtx"),
    "distortion": (
        *("distortion_coefficients", "distCoeffs", "dist_coeffs", "distortion_coeffs", "distortion_vector"),
        *("distortion", "distortions", "dist", "D"),
    ),
    "size": ("image_size", "imageSize", "size", "resolution", "img_size"),
    "width": ("image_width", "imageWidth", "width", "img_width"),
    "height": ("image_height", "imageHeight", "height", "img_height"),
    "rotation": ("R", "rotation", "rotation_matrix", "rvec", "rotation_vector"),
    "translation": ("T", "t", "translation", "translation_vector", "tvec"),
    "camera_from_world": ("camera_from_world", "extrinsics", "extrinsic", "extrinsic_matrix"),
    "world_from_camera": ("world_from_camera",),
    "name": ("name", "camera_name"),
    "error": (
        *("avg_reprojection_error", "Avg_Reprojection_Error", "reprojection_error", "rms_reprojection_error"),
        *("rms_error", "rms", "error"),
    ),
}
# What tells a camera's node from others (a board, say, which has a name and a size as well).
_TELLING = {n for k in ("matrix", "distortion", "rotation", "translation", "camera_from_world") for n in _NAMES[k]}

_LENS_KEYS = ("lens", "distortion_model", "distortion_type", "camera_model", "model")
_FLAGS: dict[str, LensModel] = {
    **dict.fromkeys(("true", "1", "1.0"), "fisheye"),
    **dict.fromkeys(("false", "0", "0.0"), "opencv"),
}

_CONVENTIONS = (
    "R and T are camera_from_world, X_camera = R X_world + T; the centre of the top-left pixel is (0, 0); "
    "distortion coefficients in the order of OpenCV"
)


def is_calibration(data: Any) -> bool:
    """Whether a decoded file has cameras in one of the layouts that `read` takes, or at least one camera's lens."""
    return isinstance(data, dict) and (
        "cameras" in data
        or bool(_TELLING & data.keys())
        or any(isinstance(node, dict) and _TELLING & node.keys() for node in data.values())
    )


def read(data: dict[str, Any], path: Path, sizes: Sizes | None = None) -> Rig:
    """The rig of a decoded file.

    Args:
        sizes: of the images of cameras whose node has none; None where nothing tells them.

    Raises:
        ValueError: naming the file, and the camera where there is one.
    """
    nodes = _camera_nodes(data, path)
    if not nodes and _TELLING & data.keys():
        if not says(data, "matrix", "rotation") and (said := unfinished("plain", data)) is not None:
            raise ValueError(f"{path}: no calibration: this looks like a file of {said}")
        raise ValueError(f"{path}: holds a single lens; needed is a node per camera, each with its pose R and T")
    unit = data.get("unit", "")
    if not isinstance(unit, str):
        raise ValueError(f"{path}: unit must be a string, got {unit!r}")
    whole = error_of(data, str(path))
    known = {} if sizes is None else _sizes_known(nodes, path, sizes)
    return make_rig(path, [_camera(node, name, path, whole, known.get(name)) for name, node in nodes], unit)


def to_text(rig: Rig, suffix: str) -> str:
    """The text of a file of that suffix (".yml", ".yaml", ".json" or ".xml"): a sequence `cameras`.

    A sequence and not a node per camera because OpenCV does not take every name as a node's.
    """
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("conventions", _CONVENTIONS)
    storage.write("unit", rig.unit)
    storage.startWriteStruct("cameras", cv2.FILE_NODE_SEQ)
    for camera in rig:
        pose = camera.camera_from_world.as_matrix()
        storage.startWriteStruct("", cv2.FILE_NODE_MAP)
        storage.write("name", camera.name)
        storage.write("image_width", camera.size[0])
        storage.write("image_height", camera.size[1])
        storage.write("lens", camera.lens)
        storage.write("camera_matrix", np.array(camera.matrix))
        storage.write("distortion_coefficients", camera.distortion.reshape(1, -1).copy())
        storage.write("R", pose[:3, :3].copy())
        storage.write("T", pose[:3, 3:].copy())
        if camera.error_px is not None:
            storage.write("avg_reprojection_error", camera.error_px)
        storage.endWriteStruct()
    storage.endWriteStruct()
    return str(storage.releaseAndGetString())


def _camera_nodes(data: dict[str, Any], path: Path) -> list[tuple[str, dict[str, Any]]]:
    """(name, node) of every camera."""
    cameras = data.get("cameras", data)
    if isinstance(cameras, list):
        nodes = []
        for i, node in enumerate(cameras):
            name = pick(node, "name", f"{path}: cameras[{i}]") if isinstance(node, dict) else None
            if not isinstance(name, str):
                raise ValueError(f"{path}: cameras[{i}] must be a map with a key 'name'")
            nodes.append((name, node))
    elif isinstance(cameras, dict):
        # In a map `cameras` everything is a camera; at the top level there may be other maps (metadata, matrices).
        everything = cameras is not data
        nodes = [(k, v) for k, v in cameras.items() if isinstance(v, dict) and (everything or _TELLING & v.keys())]
    else:
        raise ValueError(f"{path}: 'cameras' must be a map or a sequence")
    poses = data.get("camera_poses")
    if not isinstance(poses, dict):
        return nodes
    of_camera = _multical_poses(poses)
    return [(name, node | of_camera.get(name, {})) for name, node in nodes]


def _multical_poses(poses: dict[str, Any]) -> dict[str, dict[str, Any]]:
    # Keys are "cam1" or, with a master camera, "cam1_to_MASTER". Either way the pose takes points of the rig's (the
    # master's) frame to camera cam1, whatever the key suggests: multical/io/export_calib.py, export_relative.
    found: dict[str, dict[str, Any]] = {}
    for key, pose in poses.items():
        for name in (key, key.partition("_to_")[0], key.rpartition("_to_")[0]):
            found.setdefault(name, pose if isinstance(pose, dict) else {})
    return found


def _sizes_known(nodes: list[tuple[str, dict[str, Any]]], path: Path, sizes: Sizes) -> dict[str, tuple[int, int]]:
    """Of cameras that say nothing of their size."""
    said = [name for key in ("size", "width", "height") for name in _NAMES[key]]
    without = [name for name, node in nodes if all(node.get(key) is None for key in said)]
    known = sizes_of(path, [name for name, _ in nodes], sizes) if without else {}
    return {name: known[name] for name in without}


def _camera(node: dict[str, Any], name: str, path: Path, whole: float | None, known: tuple[int, int] | None) -> Camera:
    where = f"{path}: camera {name}"
    own = error_of(node, where)
    size = pick(node, "size", where) if known is None else known
    if size is None:
        size = [_require(node, "width", where), _require(node, "height", where)]
    return make_camera(
        path,
        name,
        size=np.ravel(size) if isinstance(size, list) else size,
        matrix=_require(node, "matrix", where),
        distortion=_require(node, "distortion", where),
        camera_from_world=_pose(node, name, path),
        lens=lens_of(node, where),
        error_px=whole if own is None else own,
    )


def error_of(node: dict[str, Any], where: str) -> float | None:
    """What a camera, or all of them, say of their reprojection error, pixels; None where that is nothing."""
    value = pick(node, "error", where)
    if value is None or (isinstance(value, (int, float)) and not isinstance(value, bool)):
        return value
    raise ValueError(f"{where}: the reprojection error must be a number of pixels, got {value!r}")


def _pose(node: dict[str, Any], name: str, path: Path) -> RigidTransform:
    where = f"{path}: camera {name}"
    given = {key: value for key in ("camera_from_world", "world_from_camera") if (value := pick(node, key, where))}
    if not given:
        return make_pose(path, name, _require(node, "rotation", where), _require(node, "translation", where))
    if len(given) == 2 or pick(node, "rotation", where) is not None:
        raise ValueError(f"{where}: its pose is given twice; keep one")
    key, value = given.popitem()
    pose = pose_of_matrix(path, name, key, value)
    return pose if key == "camera_from_world" else pose.inv()


def lens_of(node: dict[str, Any], where: str) -> LensModel:
    """The lens model that a camera's keys name; OpenCV's standard one where they name none."""
    found: set[LensModel] = set()
    for key in _LENS_KEYS:
        if (value := node.get(key)) is None:
            continue
        model = lens_named(value, where, key)
        # A "pinhole" camera with an "equidistant" lens is Kalibr's way to say fisheye.
        if str(value).lower() != "pinhole":
            found.add(model)
    if (fisheye := node.get("fisheye")) is not None:
        # true is 1.0 after OpenCV has read it from YAML, and "true" from XML.
        if str(fisheye).lower() not in _FLAGS:
            raise ValueError(f"{where}: fisheye must be true or false, got {fisheye!r}")
        found.add(_FLAGS[str(fisheye).lower()])
    if len(found) > 1:
        raise ValueError(f"{where}: the lens is said to be a fisheye and not to be one")
    return found.pop() if found else "opencv"


def _require(node: dict[str, Any], key: str, where: str) -> Any:
    value = pick(node, key, where)
    if value is None:
        raise ValueError(f"{where}: missing key {_NAMES[key][0]!r} (or {', '.join(_NAMES[key][1:])})")
    return value


def says(node: dict[str, Any], *keys: str) -> bool:
    """Whether a camera has values under names of all these keys."""
    return all(any(node.get(name) is not None for name in _NAMES[key]) for key in keys)


def pick(node: dict[str, Any], key: str, where: str) -> Any:
    """The value that a camera has under one of the key's names, as plain numbers; None if there is none."""
    names = [name for name in _NAMES[key] if node.get(name) is not None]
    if len(names) > 1:
        raise ValueError(f"{where}: {' and '.join(names)} mean the same; keep one")
    return plain(node[names[0]], f"{where}: {names[0]}") if names else None
