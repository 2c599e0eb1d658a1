"""ROS: camera_info of each camera, in YAML, and beside them where the cameras' frames are. Lengths are metres.

camera_info is what camera_calibration writes (left.yaml, ost.yaml) or a message as `ros2 topic echo` prints it. Where frames
are tell transforms: /tf_static, or any TransformStamped, printed likewise. X_parent = R X_child + t; a camera's frame is its
optical one (x right, y down, z forward). Without transforms, a stereo pair's projection and rectification matrices tell it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.calibration.camera_builder import lens_named, make_camera, make_pose, make_rig, numbers, plain
from sylpose.calibration.sniffing import documents_beside
from sylpose.rig import Camera, Rig

__all__ = ["is_ros", "read"]

# A message's names, and those of camera_calibration's files.
_KEYS = {
    "K": ("camera_matrix", "k", "K"),
    "D": ("distortion_coefficients", "d", "D"),
    "R": ("rectification_matrix", "r", "R"),
    "P": ("projection_matrix", "p", "P"),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
}
# Frames on frames (choice: deeper than any robot's).
MAX_FRAMES = 100


def is_ros(data: Any) -> bool:
    """Whether a decoded file is a camera_info, or has transforms."""
    return _is_info(data) or next(_transforms(data), None) is not None


def read(_: Any, path: Path) -> Rig:
    """The rig of all camera_info and transforms in the file's folder; its world is the frame that all others hang on.

    Raises:
        ValueError: naming the file, and the camera where there is one.
    """
    found = list(documents_beside(path, "camera_matrix", "distortion_model", "child_frame_id"))
    infos = [(file, data) for file, data in found if _is_info(data)]
    transforms = [(file, one) for file, data in found for one in _transforms(data)]
    if not infos:
        raise ValueError(f"{path}: these are ROS transforms without a camera_info of any camera beside them")
    names = [_name(data) or file.stem for file, data in infos]
    if len(set(names)) < len(names):
        names = [file.stem for file, _ in infos]
    named = dict(zip(names, infos, strict=True))
    if transforms:
        tree = _tree(transforms)
        poses = {name: _from_root(name, data, tree, file) for name, (file, data) in named.items()}
        if len(roots := {root for root, _ in poses.values()}) > 1:
            raise ValueError(f"{path}: the ROS transforms beside it do not connect {' and '.join(sorted(roots))}")
        of_camera = {name: pose for name, (_, pose) in poses.items()}
    else:
        of_camera = _stereo(named, path)
    return make_rig(path, [_camera(file, name, data, of_camera[name]) for name, (file, data) in named.items()], "m")


def _is_info(data: Any) -> bool:
    """What both forms have, and cameras of other formats have not."""
    return (
        isinstance(data, dict)
        and "distortion_model" in data
        and all(_get(data, key) is not None for key in ("K", "P", "width", "height"))
        and "camera_from_world" not in data
    )


def _get(data: dict[str, Any], key: str) -> Any:
    return next((data[name] for name in _KEYS[key] if data.get(name) is not None), None)


def _name(data: dict[str, Any]) -> str:
    """The last part of the camera's name, narrow_stereo/left being left; or of its frame's without the word "optical"."""
    name = str(data.get("camera_name") or "").strip("/").rpartition("/")[2]
    return name or _frame_of(data).removesuffix("_optical_frame").removesuffix("_optical").rpartition("/")[2]


def _frame_of(data: dict[str, Any]) -> str:
    header = data.get("header")
    return str(header.get("frame_id") or "").strip("/") if isinstance(header, dict) else ""


def _transforms(data: Any) -> Iterator[dict[str, Any]]:
    """Those of a TFMessage, of a list, or one."""
    if isinstance(data, dict) and isinstance(data.get("transforms"), list):
        data = data["transforms"]
    for one in data if isinstance(data, list) else [data]:
        if isinstance(one, dict) and "child_frame_id" in one and isinstance(one.get("transform"), dict):
            yield one


def _tree(transforms: list[tuple[Path, dict[str, Any]]]) -> dict[str, tuple[str, RigidTransform]]:
    """By frame: its parent, and its pose in that."""
    tree: dict[str, tuple[str, RigidTransform]] = {}
    for file, one in transforms:
        child, parent = str(one["child_frame_id"]).strip("/"), _frame_of(one)
        where = f"{file}: the transform of {child}"
        if not parent or not child:
            raise ValueError(f"{where}: header.frame_id and child_frame_id must name frames")
        shift, turn = ([_axis(one["transform"], what, axis, where) for axis in axes] for what, axes in _PARTS)
        if not abs(np.linalg.norm(turn) - 1.0) < 1e-3:
            raise ValueError(f"{where}: its rotation must be a quaternion x, y, z, w of length 1")
        tree[child] = parent, make_pose(file, child, Rotation.from_quat(turn).as_matrix(), shift)
    return tree


_PARTS = (("translation", "xyz"), ("rotation", "xyzw"))


def _axis(transform: dict[str, Any], part: str, axis: str, where: str) -> float:
    values = transform.get(part)
    if not isinstance(values, dict) or values.get(axis) is None:
        raise ValueError(f"{where}: missing {part}.{axis}")
    return float(numbers([values[axis]], 1, f"{where}: {part}.{axis}")[0])


def _from_root(
    name: str, data: dict[str, Any], tree: dict[str, tuple[str, RigidTransform]], path: Path
) -> tuple[str, RigidTransform]:
    """The frame that a camera's hangs on in the end, and the camera's pose camera_from_root."""
    frames = {*tree, *(parent for parent, _ in tree.values())}
    own = _frame_of(data)
    if own not in frames:
        like = sorted(frame for frame in frames if _is_optical(frame, name))
        if len(like) != 1:
            called = f"{own!r} or the optical one of {name}" if own else f"the optical one of {name}"
            raise ValueError(f"{path}: camera {name}: no frame in the ROS transforms beside it is {called}")
        own = like[0]
    root_from_camera, frame = RigidTransform.identity(), own
    for _ in range(MAX_FRAMES):
        if frame not in tree:
            return frame, root_from_camera.inv()
        frame, pose = tree[frame]
        root_from_camera = pose * root_from_camera
    raise ValueError(f"{path}: camera {name}: the frame {own} hangs on itself")


def _is_optical(frame: str, name: str) -> bool:
    """Links (x forward) are none."""
    last = frame.rpartition("/")[2]
    return last in (name, f"{name}_optical", f"{name}_optical_frame", f"{name}_camera_optical_frame")


def _stereo(named: dict[str, tuple[Path, dict[str, Any]]], path: Path) -> dict[str, RigidTransform]:
    """camera_from_world of two cameras by how their images are rectified; the world is the rectified first camera's frame.

    A point X of it is at R'(X + (Tx/fx, Ty/fy, 0)) in a camera, by sensor_msgs/CameraInfo: Tx = -fx B in the second one.
    """
    poses = {}
    for name, (file, data) in named.items():
        where = f"{file}: camera {name}"
        projection = numbers(_flat(_get(data, "P"), where, "P"), 12, f"{where}: P").reshape(3, 4)
        turn = make_pose(
            file, name, np.reshape(numbers(_flat(_get(data, "R"), where, "R"), 9, f"{where}: R"), (3, 3)), [0] * 3
        )
        focal = projection[[0, 1], [0, 1]]
        shift = np.append(projection[:2, 3] / np.where(focal > 0, focal, 1.0), 0.0)
        poses[name] = turn.inv() * RigidTransform.from_translation(shift)
    apart = [pose.translation for pose in poses.values() if pose.translation.any()]
    if len(poses) != 2 or len(apart) != 1:
        raise ValueError(
            f"{path}: this is a ROS camera_info, which does not tell where the camera stands; beside those of all cameras "
            "tf_static.yaml does (ros2 topic echo --once /tf_static), or the P and R of a stereo pair"
        )
    return poses


def _flat(value: Any, where: str, key: str) -> list[Any]:
    rows = plain(value, f"{where}: {key}")
    if rows is None:
        raise ValueError(f"{where}: missing {_KEYS[key][0]!r}")
    return [v for row in rows for v in (row if isinstance(row, list) else [row])] if isinstance(rows, list) else [rows]


def _camera(path: Path, name: str, data: dict[str, Any], pose: RigidTransform) -> Camera:
    where = f"{path}: camera {name}"
    return make_camera(
        path,
        name,
        size=[_get(data, "width"), _get(data, "height")],
        matrix=np.reshape(numbers(_flat(_get(data, "K"), where, "K"), 9, f"{where}: K"), (3, 3)),
        distortion=_flat(_get(data, "D"), where, "D"),
        camera_from_world=pose,
        lens=lens_named(data["distortion_model"], where, "distortion_model"),
    )
