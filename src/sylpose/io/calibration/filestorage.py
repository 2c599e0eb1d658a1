"""OpenCV's FileStorage, YAML, JSON or XML, in the common layouts for several cameras.

OpenCV defines no layout for a rig. Accepted are one node per camera (or a map or a sequence `cameras`), each with

- `camera_matrix` 3x3,
- `distortion_coefficients`,
- `image_width` and `image_height`, or `image_size` (width, height),
- `R` (3x3, or a rotation vector) and `T`: the pose camera_from_world, as of cv2.solvePnP and cv2.stereoCalibrate; or
  `camera_from_world` or `world_from_camera`, 3x4 or 4x4,
- if the lens is not of OpenCV's standard model: `fisheye: 1` or `distortion_model: fisheye`,
- optionally `avg_reprojection_error`, pixels: per camera, or one value for all next to the cameras,

or common synonyms of these keys (`_NAMES` below), and Multical's `calibration.json`, which has separate `camera_poses`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.camera_builder import (
    CameraEntry,
    Entry,
    SizeLookup,
    drop_zero_error,
    lookup_sizes,
    make_rig,
)
from sylpose.io.calibration.incomplete_files import describe_incomplete
from sylpose.rig import Camera, LensModel, Rig

_NAMES = {
    "matrix": ("camera_matrix", "cameraMatrix", "K", "intrinsic_matrix", "intrinsics", "intrinsic", "matrix", "mtx"),
    "distortion": (
        *("distortion_coefficients", "distCoeffs", "dist_coeffs", "distortion_coeffs", "distortion_vector"),
        *("distortion", "distortions", "distCoef", "dist", "D"),
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
# Keys that distinguish a camera's node from others (such as a board, which has a name and a size as well).
_CAMERA_KEYS = {n for k in ("matrix", "distortion", "rotation", "translation", "camera_from_world") for n in _NAMES[k]}

_LENS_KEYS = ("lens", "distortion_model", "distortion_type", "camera_model", "model")
_FLAGS: dict[str, LensModel] = {
    **dict.fromkeys(("true", "1", "1.0"), "fisheye"),
    **dict.fromkeys(("false", "0", "0.0"), "opencv"),
}

_CONVENTIONS = (
    "R and T are camera_from_world, X_camera = R X_world + T; the center of the top-left pixel is (0, 0); "
    "distortion coefficients in the order of OpenCV"
)


def is_calibration(data: Any) -> bool:
    """Return whether a decoded file has cameras in a layout that `read` accepts, or at least one camera's lens."""
    return isinstance(data, dict) and (
        "cameras" in data
        or bool(_CAMERA_KEYS & data.keys())
        or any(isinstance(node, dict) and _CAMERA_KEYS & node.keys() for node in data.values())
    )


def read(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of a decoded file.

    Args:
        data: decoded content.
        path: path of the file, for the messages.
        sizes: lookup of image sizes for cameras whose node has none; None if unavailable.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    nodes = _find_camera_nodes(data, path)
    if not nodes and _CAMERA_KEYS & data.keys():
        if (
            not has_values(data, "matrix", "rotation")
            and (format_hint := describe_incomplete("plain", data)) is not None
        ):
            raise ValueError(f"{path}: no calibration: this looks like a file of {format_hint}")
        raise ValueError(f"{path}: contains a single lens; one node per camera is required, each with its pose R and T")
    unit = data.get("unit", "")
    if not isinstance(unit, str):
        raise ValueError(f"{path}: unit must be a string, got {unit!r}")
    common_error = parse_error_px(data, Entry(path))
    known_sizes = {} if sizes is None else _lookup_missing_sizes(nodes, path, sizes)
    cameras = [
        _parse_camera(CameraEntry(path, name), node, common_error, known_sizes.get(name)) for name, node in nodes
    ]
    return make_rig(path, cameras, unit)


def read_lenses(data: dict[str, Any], path: Path, sizes: SizeLookup, name: str) -> list[Camera]:
    """Read the lenses of a decoded file; their poses are identity, whatever the file has.

    Besides the layouts of `read`, the file may be of one camera, as of `camera_info` of ROS, sylpose's or Anipose's TOML,
    or EasyMocap's intri.yml.

    Args:
        data, path, sizes: as of `read`.
        name: of the camera, if the file is of one and does not name it.

    Raises:
        ValueError: no lens, or as of `read`.
    """
    lens_keys = {*_NAMES["matrix"]}
    if lens_keys & data.keys():
        own = get_value(data, "name", Entry(path))
        nodes = [(own if isinstance(own, str) else name, data)]
    elif by_name := {key[2:]: value for key, value in data.items() if key.startswith("K_")}:
        nodes = [(key, {"K": value, "dist": data.get(f"dist_{key}")}) for key, value in by_name.items()]
    else:
        nodes = [(key, node) for key, node in _find_camera_nodes(data, path) if lens_keys & node.keys()]
    if not nodes:
        raise ValueError(f"{path}: no lens: a matrix and distortion coefficients are expected")
    known, common_error = _lookup_missing_sizes(nodes, path, sizes), parse_error_px(data, Entry(path))
    identity, cameras = RigidTransform.identity(), []
    for key, node in nodes:
        cameras.append(_parse_camera(CameraEntry(path, key), node, common_error, known.get(key), identity))
    return cameras


def to_text(rig: Rig, suffix: str) -> str:
    """Format the rig as FileStorage text for a suffix ".yml", ".yaml", ".json" or ".xml": a sequence `cameras`.

    A sequence is used because OpenCV does not accept every name as a node's.
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
        lens = {"camera_matrix": camera.matrix, "distortion_coefficients": camera.distortion.reshape(1, -1)}
        write_arrays(storage, lens | {"R": pose[:3, :3], "T": pose[:3, 3:]})
        if camera.error_px is not None:
            storage.write("avg_reprojection_error", camera.error_px)
        storage.endWriteStruct()
    storage.endWriteStruct()
    return str(storage.releaseAndGetString())


def write_arrays(storage: cv2.FileStorage, arrays: Mapping[str, FloatArray]) -> None:
    """Write arrays by their keys; OpenCV requires them contiguous and writable."""
    for key, array in arrays.items():
        storage.write(key, np.array(array, order="C"))


def _find_camera_nodes(data: dict[str, Any], path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return (name, node) of every camera."""
    cameras = data.get("cameras", data)
    if isinstance(cameras, list):
        nodes = []
        for i, node in enumerate(cameras):
            name = get_value(node, "name", Entry(path, f"cameras[{i}]")) if isinstance(node, dict) else None
            if not isinstance(name, str):
                raise ValueError(f"{path}: cameras[{i}] must be a map with a key 'name'")
            nodes.append((name, node))
    elif isinstance(cameras, dict):
        # In a map `cameras` every map is a camera; at the top level there may be others (metadata, matrices).
        everything = cameras is not data
        nodes = [(k, v) for k, v in cameras.items() if isinstance(v, dict) and (everything or _CAMERA_KEYS & v.keys())]
    else:
        raise ValueError(f"{path}: 'cameras' must be a map or a sequence")
    poses = data.get("camera_poses")
    if not isinstance(poses, dict):
        return nodes
    of_camera = _read_multical_poses(poses)
    return [(name, node | of_camera.get(name, {})) for name, node in nodes]


def _read_multical_poses(poses: dict[str, Any]) -> dict[str, dict[str, Any]]:
    # Keys are "cam1" or, with a master camera, "cam1_to_MASTER". Either way the pose maps points from the rig's (the
    # master's) frame to camera cam1, despite the key: multical/io/export_calib.py, export_relative.
    found: dict[str, dict[str, Any]] = {}
    for key, pose in poses.items():
        for name in (key, key.partition("_to_")[0], key.rpartition("_to_")[0]):
            found.setdefault(name, pose if isinstance(pose, dict) else {})
    return found


def _lookup_missing_sizes(nodes: list[tuple[str, dict[str, Any]]], path: Path, sizes: SizeLookup) -> dict[str, Any]:
    """Look up image sizes of cameras whose node has none."""
    without = [name for name, node in nodes if not any(has_values(node, key) for key in ("size", "width", "height"))]
    known = lookup_sizes(path, [name for name, _ in nodes], sizes) if without else {}
    return {name: known[name] for name in without}


def _parse_camera(
    entry: CameraEntry,
    node: dict[str, Any],
    common_error: float | None,
    known_size: Any,
    pose: RigidTransform | None = None,
) -> Camera:
    """Parse a camera; `pose` replaces that of the node."""
    own_error = parse_error_px(node, entry)
    size = get_value(node, "size", entry) if known_size is None else known_size
    if size is None:
        size = [_require_value(node, "width", entry), _require_value(node, "height", entry)]
    return entry.make_camera(
        np.ravel(size) if isinstance(size, list) else size,
        _require_value(node, "matrix", entry),
        _require_value(node, "distortion", entry),
        _parse_pose(node, entry) if pose is None else pose,
        parse_lens_model(node, entry),
        common_error if own_error is None else own_error,
    )


def parse_error_px(node: dict[str, Any], where: Entry) -> float | None:
    """Return the reprojection error of a camera, or of all, in pixels; None if missing."""
    value = get_value(node, "error", where)
    if value is None or (isinstance(value, (int, float)) and not isinstance(value, bool)):
        return drop_zero_error(value)
    raise where.error(f"the reprojection error must be a number of pixels, got {value!r}")


def _parse_pose(node: dict[str, Any], entry: CameraEntry) -> RigidTransform:
    given = {key: value for key in ("camera_from_world", "world_from_camera") if (value := get_value(node, key, entry))}
    if not given:
        return entry.make_pose(_require_value(node, "rotation", entry), _require_value(node, "translation", entry))
    if len(given) == 2 or get_value(node, "rotation", entry) is not None:
        raise entry.error("its pose is given twice; keep one")
    key, value = given.popitem()
    pose = entry.parse_pose_matrix(value, key)
    return pose if key == "camera_from_world" else pose.inv()


def parse_lens_model(node: dict[str, Any], where: Entry) -> LensModel:
    """Return the lens model given by a camera's keys; OpenCV's standard model by default."""
    found: set[LensModel] = set()
    for key in _LENS_KEYS:
        if (value := node.get(key)) is None:
            continue
        model = where.parse_lens_model(value, key)
        # In Kalibr, a "pinhole" camera with an "equidistant" lens is a fisheye.
        if str(value).lower() != "pinhole":
            found.add(model)
    if (fisheye := node.get("fisheye")) is not None:
        # A boolean true is 1.0 after OpenCV's YAML parsing, and "true" after XML.
        if str(fisheye).lower() not in _FLAGS:
            raise where.error(f"fisheye must be true or false, got {fisheye!r}")
        found.add(_FLAGS[str(fisheye).lower()])
    if len(found) > 1:
        raise where.error("the lens is declared both fisheye and not fisheye")
    return found.pop() if found else "opencv"


def _require_value(node: dict[str, Any], key: str, where: Entry) -> Any:
    value = get_value(node, key, where)
    if value is None:
        raise where.error(f"missing key {_NAMES[key][0]!r} (or {', '.join(_NAMES[key][1:])})")
    return value


def has_values(node: dict[str, Any], *keys: str) -> bool:
    """Return whether a camera has values for all these keys, under any of their names."""
    return all(any(node.get(name) is not None for name in _NAMES[key]) for key in keys)


def get_value(node: dict[str, Any], key: str, where: Entry) -> Any:
    """Return the value of a key under any of its names, as plain numbers; None if missing."""
    names = [name for name in _NAMES[key] if node.get(name) is not None]
    if len(names) > 1:
        raise where.error(f"{' and '.join(names)} are synonyms; keep one")
    return where.to_plain(node[names[0]], names[0]) if names else None
