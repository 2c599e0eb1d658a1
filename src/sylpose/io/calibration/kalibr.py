"""Kalibr's camchain.yaml: cam0, cam1, ..., each with its pose in the previous one, T_cn_cnm1. Lengths are meters.

The world is cam0's frame; if a file has T_cam_imu of all cameras and no chain, the IMU's. Pixels follow OpenCV's
convention, whose detectors find Kalibr's targets.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from scipy.spatial.transform import RigidTransform

from sylpose.io.calibration.camera_builder import CameraEntry, intrinsic_matrix, make_rig, standard_lens_terms
from sylpose.rig import Camera, LensModel, Rig
from sylpose.units import METERS

_LENSES: dict[str, LensModel] = {"radtan": "opencv", "none": "opencv", "equidistant": "fisheye"}
_UNSUPPORTED_MODELS = {"omni": "omnidirectional", "ds": "double sphere", "eucm": "extended unified", "fov": "FOV"}


def is_kalibr(data: Any) -> bool:
    """Return whether a decoded file has a camera of a Kalibr model, or a chain of poses."""
    nodes = [data, *data.values()] if isinstance(data, dict) else []
    return any(isinstance(node, dict) and ("T_cn_cnm1" in node or _is_camera(node)) for node in nodes)


def read(data: dict[str, Any], path: Path) -> Rig:
    """Read the rig; cameras keep the file's names, cam0, cam1, ...

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    nodes = {name: node for name, node in data.items() if isinstance(node, dict) and _is_camera(node)}
    if not nodes:
        what = "one camera's lens alone" if _is_camera(data) else "poses without lenses"
        raise ValueError(
            f"{path}: this is a Kalibr file of {what}; a camchain with camera_model and intrinsics of cam0, cam1, ... "
            "is required"
        )
    names = sorted(nodes, key=lambda name: [int(word) for word in re.findall("[0-9]{1,9}", name)])
    poses = _compute_poses({name: nodes[name] for name in names}, path)
    return make_rig(path, [_parse_camera(CameraEntry(path, name), nodes[name], poses[name]) for name in names], "m")


def to_text(rig: Rig) -> str:
    """Format the rig as a camchain with cameras cam0, cam1, ... in order; its world is the first camera's frame.

    Lengths are in meters if the rig's unit is known.

    Raises:
        ValueError: a lens that Kalibr does not support.
    """
    rig = rig.in_unit("m") if rig.unit in METERS else rig
    text, previous = "", rig.cameras[0].camera_from_world
    for i, camera in enumerate(rig):
        fisheye = camera.lens == "fisheye"
        lens = camera.distortion if fisheye else standard_lens_terms(camera, 4, "Kalibr's radtan")
        values: dict[str, Any] = {
            "camera_model": "pinhole",
            "intrinsics": camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
            "distortion_model": "equidistant" if fisheye else "radtan",
            "distortion_coeffs": lens.tolist(),
            "resolution": list(camera.size),
            "rostopic": f"/{camera.name}/image_raw",
        }
        if i:
            values["T_cn_cnm1"] = (camera.camera_from_world * previous.inv()).as_matrix().tolist()
        previous = camera.camera_from_world
        text += f"cam{i}:\n" + "".join(f"  {key}: {json.dumps(value)}\n" for key, value in values.items())
    return text


def _is_camera(node: dict[str, Any]) -> bool:
    """Return whether a node is a Kalibr camera, whose numbers form a row, unlike FileStorage's matrices."""
    row = node.get("intrinsics")
    return isinstance(row, list) and "camera_model" in node and not any(isinstance(value, list) for value in row)


def _compute_poses(nodes: dict[str, dict[str, Any]], path: Path) -> dict[str, RigidTransform]:
    """Compute camera_from_world by camera, in the order of the chain."""
    first, *rest = nodes
    if missing := [name for name in rest if "T_cn_cnm1" not in nodes[name]]:
        if all("T_cam_imu" in node for node in nodes.values()):
            entries = {name: CameraEntry(path, name) for name in nodes}
            return {name: entries[name].parse_pose_matrix(nodes[name]["T_cam_imu"], "T_cam_imu") for name in nodes}
        raise ValueError(
            f"{path}: this is a Kalibr camchain without T_cn_cnm1 of {', '.join(missing)}, so camera poses are unknown; "
            "calibrate all of them in one run, or give T_cam_imu of all"
        )
    poses = {first: RigidTransform.identity()}
    previous = poses[first]
    for name in rest:
        pose = CameraEntry(path, name).parse_pose_matrix(nodes[name]["T_cn_cnm1"], "T_cn_cnm1")
        poses[name] = previous = pose * previous
    return poses


def _parse_camera(entry: CameraEntry, node: dict[str, Any], pose: RigidTransform) -> Camera:
    model, lens = str(node["camera_model"]), str(node.get("distortion_model", "none"))
    for key, value, supported in (("camera_model", model, ("pinhole",)), ("distortion_model", lens, tuple(_LENSES))):
        if value not in supported:
            full_name = f" ({_UNSUPPORTED_MODELS[value]})" if value in _UNSUPPORTED_MODELS else ""
            raise entry.error(
                f"{key} {value!r}{full_name} is not supported; of Kalibr's models, pinhole with radtan, "
                "equidistant or none is"
            )
    for key in ("resolution",) if lens == "none" else ("distortion_coeffs", "resolution"):
        if node.get(key) is None:
            raise entry.error(f"missing key {key!r}")
    terms: Any = [] if lens == "none" else entry.parse_numbers(node["distortion_coeffs"], 4, "distortion_coeffs")
    matrix = intrinsic_matrix(*entry.parse_numbers(node["intrinsics"], 4, "intrinsics"))
    return entry.make_camera(node["resolution"], matrix, terms, pose, _LENSES[lens])
