"""Matlab's stereoParameters as JSON: jsonencode(toStruct(stereoParams)).

Matlab's first pixel is (1, 1). IntrinsicMatrix and RotationOfCamera2 apply to row vectors and are the transposes of
OpenCV's; K and PoseCamera2 of newer versions are not. X_2 = R X_1 + t: the world is the first camera's frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scipy.spatial.transform import RigidTransform

from sylpose.io.calibration.camera_builder import (
    SizeLookup,
    lookup_sizes,
    make_camera,
    make_pose,
    make_rig,
    parse_numbers,
)
from sylpose.rig import Camera, Rig

__all__ = ["is_matlab", "read"]

_UNITS = {
    "millimeters": "mm",
    "mm": "mm",
    "centimeters": "cm",
    "cm": "cm",
    "meters": "m",
    "m": "m",
    "inches": "in",
    "in": "in",
}


def is_matlab(data: Any) -> bool:
    """Return whether decoded JSON has Matlab's keys of two cameras, or of one."""
    return isinstance(data, dict) and bool({"CameraParameters1", "CameraParameters2"} & data.keys() or _is_lens(data))


def read(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of cameras "1" and "2".

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    nodes = {name: data.get(f"CameraParameters{name}") for name in ("1", "2")}
    if any(node is None for node in nodes.values()):
        raise ValueError(f"{path}: these are Matlab's parameters of one camera; stereoParameters of two are required")
    lenses = {name: _find_lens(node, f"{path}: camera {name}") for name, node in nodes.items()}
    # ImageSize is (rows, columns).
    known_sizes: dict[str, Any] = {
        name: parse_numbers(node["ImageSize"], 2, f"{path}: camera {name}: ImageSize")[::-1]
        for name, node in lenses.items()
        if node.get("ImageSize")
    }
    if len(known_sizes) < len(lenses):
        known_sizes = {**lookup_sizes(path, list(nodes), sizes), **known_sizes}
    second = _parse_pose(data, path)
    poses = {"1": RigidTransform.identity(), "2": second}
    word = str(data["CameraParameters1"].get("WorldUnits") or "").lower()
    cameras = [_parse_camera(path, name, node, known_sizes[name], poses[name]) for name, node in lenses.items()]
    return make_rig(path, cameras, _UNITS.get(word, ""))


def _is_lens(node: Any) -> bool:
    return isinstance(node, dict) and "RadialDistortion" in node and ("IntrinsicMatrix" in node or "K" in node)


def _find_lens(node: Any, where: str) -> dict[str, Any]:
    """Return the struct with the numbers: the camera's own, or its Intrinsics."""
    inner = node.get("Intrinsics", {}) if isinstance(node, dict) else {}
    for lens in (node, inner):
        if isinstance(lens, dict) and _is_lens(lens):
            return lens
    if any(isinstance(lens, dict) and "MappingCoefficients" in lens for lens in (node, inner)):
        raise ValueError(f"{where}: Matlab's fisheye model (Scaramuzza's) is not supported")
    raise ValueError(f"{where}: missing RadialDistortion and K, or IntrinsicMatrix, of Matlab's cameraParameters")


def _parse_pose(data: dict[str, Any], path: Path) -> RigidTransform:
    pose_struct = data.get("PoseCamera2")
    if isinstance(pose_struct, dict) and "A" in pose_struct:
        pose = parse_numbers(pose_struct["A"], 16, f"{path}: PoseCamera2.A").reshape(4, 4)
        return make_pose(path, "2", pose[:3, :3], pose[:3, 3])
    if isinstance(pose_struct, dict) and {"R", "Translation"} <= pose_struct.keys():
        return make_pose(path, "2", pose_struct["R"], pose_struct["Translation"])
    if not {"RotationOfCamera2", "TranslationOfCamera2"} <= data.keys():
        raise ValueError(
            f"{path}: these are Matlab's stereoParameters without PoseCamera2, or RotationOfCamera2 and "
            "TranslationOfCamera2"
        )
    rotation = parse_numbers(data["RotationOfCamera2"], 9, f"{path}: RotationOfCamera2").reshape(3, 3).T
    return make_pose(path, "2", rotation, data["TranslationOfCamera2"])


def _parse_camera(path: Path, name: str, node: dict[str, Any], size: Any, pose: RigidTransform) -> Camera:
    where = f"{path}: camera {name}"
    key = "K" if node.get("K") is not None else "IntrinsicMatrix"
    matrix = parse_numbers(node[key], 9, f"{where}: {key}").reshape(3, 3)
    matrix = (matrix if key == "K" else matrix.T).copy()
    matrix[:2, 2] -= 1.0
    k = parse_numbers(node["RadialDistortion"], (2, 3), f"{where}: RadialDistortion")
    p = parse_numbers(node.get("TangentialDistortion") or [0, 0], 2, f"{where}: TangentialDistortion")
    return make_camera(
        path,
        name,
        size=size,
        matrix=matrix,
        distortion=[k[0], k[1], p[0], p[1], *k[2:]],
        camera_from_world=pose,
        lens="opencv",
    )
