"""Kalibr's camchain.yaml: cam0, cam1, ..., each with its pose in the one before, T_cn_cnm1. Lengths are metres.

The world is cam0's frame; where a file has T_cam_imu of all cameras and no chain, the IMU's. Pixels are OpenCV's, whose
detectors find Kalibr's targets.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from scipy.spatial.transform import RigidTransform

from sylpose.calibration.camera_builder import lens_terms, make_camera, make_rig, matrix_of, numbers, pose_of_matrix
from sylpose.rig import Camera, LensModel, Rig
from sylpose.units import METRES

__all__ = ["is_kalibr", "read", "to_text"]

_LENSES: dict[str, LensModel] = {"radtan": "opencv", "none": "opencv", "equidistant": "fisheye"}
_OTHER = {"omni": "omnidirectional", "ds": "double sphere", "eucm": "extended unified", "fov": "FOV"}


def is_kalibr(data: Any) -> bool:
    """Whether a decoded file has a camera of a Kalibr model, or poses in a chain."""
    nodes = [data, *data.values()] if isinstance(data, dict) else []
    return any(isinstance(node, dict) and ("T_cn_cnm1" in node or _is_camera(node)) for node in nodes)


def read(data: dict[str, Any], path: Path) -> Rig:
    """The rig; cameras are called as in the file, cam0, cam1, ...

    Raises:
        ValueError: naming the file, and the camera where there is one.
    """
    nodes = {name: node for name, node in data.items() if isinstance(node, dict) and _is_camera(node)}
    if not nodes:
        what = "one camera's lens alone" if _is_camera(data) else "poses without lenses"
        raise ValueError(
            f"{path}: this is of Kalibr, {what}; a camchain with camera_model and intrinsics of cam0, cam1, ... is needed"
        )
    names = sorted(nodes, key=lambda name: [int(word) for word in re.findall("[0-9]{1,9}", name)])
    poses = _poses({name: nodes[name] for name in names}, path)
    return make_rig(path, [_camera(nodes[name], name, path, poses[name]) for name in names], "m")


def to_text(rig: Rig) -> str:
    """A camchain of the rig, whose cameras are called cam0, cam1, ... in order; its world is the first one's frame.

    Lengths are in metres, where the rig says what its own are.

    Raises:
        ValueError: a lens that Kalibr has not.
    """
    rig = rig.in_unit("m") if rig.unit in METRES else rig
    text, before = "", rig.cameras[0].camera_from_world
    for i, camera in enumerate(rig):
        fisheye = camera.lens == "fisheye"
        lens = camera.distortion if fisheye else lens_terms(camera, 4, "Kalibr's radtan")
        values: dict[str, Any] = {
            "camera_model": "pinhole",
            "intrinsics": camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
            "distortion_model": "equidistant" if fisheye else "radtan",
            "distortion_coeffs": lens.tolist(),
            "resolution": list(camera.size),
            "rostopic": f"/{camera.name}/image_raw",
        }
        if i:
            values["T_cn_cnm1"] = (camera.camera_from_world * before.inv()).as_matrix().tolist()
        before = camera.camera_from_world
        text += f"cam{i}:\n" + "".join(f"  {key}: {json.dumps(value)}\n" for key, value in values.items())
    return text


def _is_camera(node: dict[str, Any]) -> bool:
    """Kalibr's numbers stand in a row; FileStorage's matrices do not."""
    row = node.get("intrinsics")
    return isinstance(row, list) and "camera_model" in node and not any(isinstance(value, list) for value in row)


def _poses(nodes: dict[str, dict[str, Any]], path: Path) -> dict[str, RigidTransform]:
    """camera_from_world by camera, in the order of the chain."""
    first, *rest = nodes
    if any("T_cn_cnm1" not in nodes[name] for name in rest):
        if all("T_cam_imu" in node for node in nodes.values()):
            return {name: pose_of_matrix(path, name, "T_cam_imu", node["T_cam_imu"]) for name, node in nodes.items()}
        lacking = ", ".join(name for name in rest if "T_cn_cnm1" not in nodes[name])
        raise ValueError(
            f"{path}: this is a Kalibr camchain without T_cn_cnm1 of {lacking}: it does not tell where cameras stand; "
            "calibrate all of them in one run, or give T_cam_imu of all"
        )
    poses = {first: RigidTransform.identity()}
    before = poses[first]
    for name in rest:
        poses[name] = before = pose_of_matrix(path, name, "T_cn_cnm1", nodes[name]["T_cn_cnm1"]) * before
    return poses


def _camera(node: dict[str, Any], name: str, path: Path, pose: RigidTransform) -> Camera:
    where = f"{path}: camera {name}"
    model, lens = str(node["camera_model"]), str(node.get("distortion_model", "none"))
    for key, word, known in (("camera_model", model, ("pinhole",)), ("distortion_model", lens, tuple(_LENSES))):
        if word not in known:
            called = f" ({_OTHER[word]})" if word in _OTHER else ""
            raise ValueError(
                f"{where}: {key} {word!r}{called} is none of Kalibr's that sylpose has: pinhole with radtan, equidistant or "
                "none"
            )
    terms = [] if lens == "none" else node.get("distortion_coeffs")
    if terms is None or "resolution" not in node:
        raise ValueError(f"{where}: missing key {'resolution' if terms is not None else 'distortion_coeffs'!r}")
    return make_camera(
        path,
        name,
        size=node["resolution"],
        matrix=matrix_of(*numbers(node["intrinsics"], 4, f"{where}: intrinsics")),
        distortion=terms if lens == "none" else numbers(terms, 4, f"{where}: distortion_coeffs"),
        camera_from_world=pose,
        lens=_LENSES[lens],
    )
