"""ROS camera_info files in YAML, one per camera, with transforms next to them. Lengths are meters.

camera_info is written by camera_calibration (left.yaml, ost.yaml) or printed as a message by `ros2 topic echo`.
Transforms give the frames' poses: /tf_static, or any TransformStamped, printed likewise. X_parent = R X_child + t; a
camera's frame is its optical one (x right, y down, z forward). Without transforms, the poses of a stereo pair follow
from its projection and rectification matrices. Images have the size of the region of interest (roi), divided by the
binning.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.camera_builder import CameraEntry, Entry, make_rig
from sylpose.io.calibration.markup import read_folder_documents
from sylpose.rig import Camera, Rig

# Keys of messages, and of camera_calibration's files.
_KEYS = {
    "K": ("camera_matrix", "k", "K"),
    "D": ("distortion_coefficients", "d", "D"),
    "R": ("rectification_matrix", "r", "R"),
    "P": ("projection_matrix", "p", "P"),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
}
# Maximum depth of the frame tree (choice: deeper than any robot's).
MAX_TREE_DEPTH = 100


def is_ros(data: Any) -> bool:
    """Return whether a decoded file is a camera_info, or has transforms."""
    return _is_info(data) or next(_iterate_transforms(data), None) is not None


def read(_: Any, path: Path) -> Rig:
    """Read the rig of all camera_info and transforms in the file's folder; its world is the root frame.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    found = list(read_folder_documents(path, "camera_matrix", "distortion_model", "child_frame_id"))
    infos = [(file, data) for file, data in found if _is_info(data)]
    transforms = [(file, transform) for file, data in found for transform in _iterate_transforms(data)]
    if not infos:
        raise ValueError(f"{path}: these are ROS transforms without a camera_info next to them")
    names = [_camera_name(data) or file.stem for file, data in infos]
    if len(set(names)) < len(names):
        names = [file.stem for file, _ in infos]
    entries = [CameraEntry(file, name) for name, (file, _) in zip(names, infos, strict=True)]
    cameras = dict(zip(entries, (data for _, data in infos), strict=True))
    if transforms:
        tree = _build_tree(transforms)
        found_frames = [_find_camera_from_root(entry, data, tree) for entry, data in cameras.items()]
        poses = [pose for _, pose in found_frames]
        if len(roots := {root for root, _ in found_frames}) > 1:
            raise ValueError(f"{path}: the ROS transforms next to it do not connect {' and '.join(sorted(roots))}")
    else:
        poses = _poses_from_rectification(cameras, path)
    posed = zip(cameras.items(), poses, strict=True)
    return make_rig(path, [_parse_camera(entry, data, pose) for (entry, data), pose in posed], "m")


def _is_info(data: Any) -> bool:
    """Return whether it has the keys common to both forms of camera_info, and absent in other formats."""
    return (
        isinstance(data, dict)
        and "distortion_model" in data
        and all(_get_value(data, key) is not None for key in ("K", "P", "width", "height"))
        and "camera_from_world" not in data
    )


def _get_value(data: dict[str, Any], key: str) -> Any:
    return next((data[name] for name in _KEYS[key] if data.get(name) is not None), None)


def _camera_name(data: dict[str, Any]) -> str:
    """Return the last part of the camera's name (narrow_stereo/left is left), or of its frame's without "optical"."""
    name = str(data.get("camera_name") or "").strip("/").rpartition("/")[2]
    return name or _get_frame_id(data).removesuffix("_optical_frame").removesuffix("_optical").rpartition("/")[2]


def _get_frame_id(data: dict[str, Any]) -> str:
    header = data.get("header")
    return str(header.get("frame_id") or "").strip("/") if isinstance(header, dict) else ""


def _iterate_transforms(data: Any) -> Iterator[dict[str, Any]]:
    """Yield the transforms of a TFMessage, of a list, or a single one."""
    if isinstance(data, dict) and isinstance(data.get("transforms"), list):
        data = data["transforms"]
    for transform in data if isinstance(data, list) else [data]:
        if (
            isinstance(transform, dict)
            and "child_frame_id" in transform
            and isinstance(transform.get("transform"), dict)
        ):
            yield transform


def _build_tree(transforms: list[tuple[Path, dict[str, Any]]]) -> dict[str, tuple[str, RigidTransform]]:
    """Build the frame tree: by frame, its parent, and its pose in the parent."""
    tree: dict[str, tuple[str, RigidTransform]] = {}
    for file, transform in transforms:
        child, parent = str(transform["child_frame_id"]).strip("/"), _get_frame_id(transform)
        where = Entry(file, f"the transform of {child}")
        if not parent or not child:
            raise where.error("header.frame_id and child_frame_id must name frames")
        translation, quaternion = (
            [_parse_component(transform["transform"], part, axis, where) for axis in axes]
            for part, axes in (("translation", "xyz"), ("rotation", "xyzw"))
        )
        rotation = where.parse_quaternion(quaternion, "its rotation must be a quaternion x, y, z, w of length 1")
        tree[child] = parent, CameraEntry(file, child).make_pose(rotation.as_matrix(), translation)
    return tree


def _parse_component(transform: dict[str, Any], part: str, axis: str, where: Entry) -> float:
    values = transform.get(part)
    if not isinstance(values, dict) or values.get(axis) is None:
        raise where.error(f"missing {part}.{axis}")
    return where.parse_number(values[axis], f"{part}.{axis}")


def _find_camera_from_root(
    entry: CameraEntry, data: dict[str, Any], tree: dict[str, tuple[str, RigidTransform]]
) -> tuple[str, RigidTransform]:
    """Return the root frame of a camera, and its pose camera_from_root."""
    frames = {*tree, *(parent for parent, _ in tree.values())}
    camera_frame = _get_frame_id(data)
    if camera_frame not in frames:
        candidates = sorted(frame for frame in frames if _is_optical_frame(frame, entry.place))
        if len(candidates) != 1:
            own = f"{camera_frame!r} or " if camera_frame else ""
            raise entry.error(f"no frame in the ROS transforms next to it is {own}the optical one of {entry.place}")
        camera_frame = candidates[0]
    root_from_camera, frame = RigidTransform.identity(), camera_frame
    for _ in range(MAX_TREE_DEPTH):
        if frame not in tree:
            return frame, root_from_camera.inv()
        frame, pose = tree[frame]
        root_from_camera = pose * root_from_camera
    raise entry.error(f"the frame {camera_frame} is its own ancestor")


def _is_optical_frame(frame: str, name: str) -> bool:
    """Return whether a frame is the camera's optical frame, as opposed to its link (x forward)."""
    last = frame.rpartition("/")[2]
    return last in (name, f"{name}_optical", f"{name}_optical_frame", f"{name}_camera_optical_frame")


def _poses_from_rectification(cameras: dict[CameraEntry, dict[str, Any]], path: Path) -> list[RigidTransform]:
    """Compute camera_from_world of two cameras from their rectification.

    The world is the rectified first camera's frame. A point X of it is at R'(X + (Tx/fx, Ty/fy, 0)) in a camera, by
    sensor_msgs/CameraInfo: Tx = -fx B in the second one.
    """
    poses = []
    for entry, data in cameras.items():
        projection = _parse_info_matrix(data, "P", entry, columns=4)
        rotation = entry.make_pose(_parse_info_matrix(data, "R", entry), [0] * 3)
        focal = projection[[0, 1], [0, 1]]
        translation = np.append(projection[:2, 3] / np.where(focal > 0, focal, 1.0), 0.0)
        poses.append(rotation.inv() * RigidTransform.from_translation(translation))
    if len(poses) != 2 or sum(pose.translation.any() for pose in poses) != 1:
        raise ValueError(
            f"{path}: this is a ROS camera_info, which does not contain the camera's pose; add "
            "tf_static.yaml (ros2 topic echo --once /tf_static), or use P and R of a stereo pair"
        )
    return poses


def _parse_info_matrix(data: dict[str, Any], key: str, entry: CameraEntry, columns: int = 3) -> FloatArray:
    return entry.parse_matrix(_require_value(data, key, entry), key, columns)


def _require_value(data: dict[str, Any], key: str, entry: CameraEntry) -> Any:
    if (value := _get_value(data, key)) is None:
        raise entry.error(f"missing {_KEYS[key][0]!r}")
    return entry.to_plain(value, key)


def _parse_camera(entry: CameraEntry, data: dict[str, Any], pose: RigidTransform) -> Camera:
    matrix, distortion = _parse_info_matrix(data, "K", entry), _require_value(data, "D", entry)
    full_size = entry.parse_numbers([_get_value(data, "width"), _get_value(data, "height")], 2, "width and height")
    first, size, binning = _parse_region(data, full_size, entry)
    # The center of a binned pixel is the mean of those of its pixels.
    matrix[:2, 2] = (matrix[:2, 2] - first + 0.5) / binning - 0.5
    matrix[[0, 1], [0, 1]] /= binning
    lens = entry.parse_lens_model(data["distortion_model"], "distortion_model")
    return entry.make_camera(size // binning, matrix, distortion, pose, lens)


def _parse_region(
    data: dict[str, Any], full_size: FloatArray, entry: CameraEntry
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the first pixel (x, y) and the size of the region of interest, unbinned, and the binning.

    By sensor_msgs/CameraInfo, K is that of the full sensor, and 0 means no binning, or the whole image.
    """
    region = data.get("roi")
    values = region if isinstance(region, dict) else {}
    what = "roi.x_offset, y_offset, width and height"
    numbers = [values.get(key, 0) for key in ("x_offset", "y_offset", "width", "height")]
    first, size = entry.parse_numbers(numbers, 4, what).reshape(2, 2)
    size = np.where(size == 0, full_size - first, size)
    if (first < 0).any() or (first + size > full_size).any() or (size < 1).any() or (first != first.round()).any():
        raise entry.error(f"{what} must be a region in the image of {full_size[0]:g}x{full_size[1]:g}")
    binning = entry.parse_numbers(
        [data.get(key, 1) for key in ("binning_x", "binning_y")], 2, "binning_x and binning_y"
    )
    binning = np.maximum(binning, 1.0)
    if (binning != binning.round()).any():
        raise entry.error("binning_x and binning_y must be whole numbers")
    return first, size, binning
