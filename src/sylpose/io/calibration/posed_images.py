"""JSON with the pose of each image: BOP's scene_camera.json and the cameras.json of 3D Gaussian splatting.

- BOP: by image ID, cam_K, and cam_R_w2c and cam_t_w2c in millimeters. Scenes with several sensors have a file
  scene_camera_SENSOR.json of each. Image sizes are in camera.json, camera_SENSOR.json of the dataset, if at all.
- 3D Gaussian splatting (graphdeco): `rotation` and `position` are the camera's pose in the world. Images are
  undistorted, with the principal point in their middle.

Images are assigned to static cameras as in photogrammetry.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from sylpose.io.calibration.camera_builder import CameraEntry, SizeLookup, intrinsic_matrix, lookup_sizes, make_rig
from sylpose.io.calibration.markup import MAX_FILES, read_plain
from sylpose.io.calibration.photogrammetry import (
    MAX_FRAMES,
    PIXEL_CENTER,
    PosedImage,
    find_static_cameras,
    image_path,
)
from sylpose.rig import Rig

_SCENE_FILE = re.compile(r"scene_camera(?:_(.+))?\.json", re.IGNORECASE)
_SPLAT_KEYS = ("img_name", "width", "height", "fx", "fy", "rotation", "position")


def is_bop(data: Any) -> bool:
    """Return whether decoded JSON has cam_K by image IDs."""
    return (
        isinstance(data, dict)
        and all(key.isdecimal() and isinstance(node, dict) for key, node in data.items())
        and any("cam_K" in node for node in data.values())
    )


def read_bop(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of the file, or of the files of all sensors of the scene.

    Cameras are named by their sensors; those of scene_camera.json by their images.

    Raises:
        ValueError: naming the file, and the image or camera if applicable: no pose, a camera that moves, an unknown
            image size.
    """
    match = _SCENE_FILE.fullmatch(path.name)
    files = {match[1] if match else None: path}
    if match and match[1]:
        named = [
            (found[1], file) for file in sorted(path.parent.iterdir()) if (found := _SCENE_FILE.fullmatch(file.name))
        ]
        files = dict([(sensor, file) for sensor, file in named if sensor][:MAX_FILES])
    images: list[PosedImage] = []
    # Lenses are numbered in order of appearance.
    keys, lenses = dict[str, str](), dict[str, tuple[str | None, Any]]()
    for sensor, file in files.items():
        scene = data if file == path else read_plain(file)
        if not is_bop(scene):
            raise ValueError(f"{file}: BOP's scene_camera has cam_K of each image")
        for number, node in scene.items():
            entry = CameraEntry(file, number.zfill(6))
            if "cam_K" not in node:
                raise entry.error("missing cam_K")
            lens = keys.setdefault(json.dumps([sensor, node["cam_K"]]), str(len(keys)))
            lenses.setdefault(lens, (sensor, entry.parse_matrix(node["cam_K"], "cam_K")))
            folder = PurePosixPath(sensor) if sensor else PurePosixPath()
            images.append(_read_bop_image(node, folder / entry.place, lens, entry))
            if len(images) > MAX_FRAMES:
                raise ValueError(f"{path}: more than {MAX_FRAMES} images")
    static_cameras = find_static_cameras(images, path)
    sizes_in_dataset = {sensor: _find_bop_size(path, sensor) for sensor in files}
    given = {c.name: size for c in static_cameras if (size := sizes_in_dataset[lenses[c.lens][0]])}
    known_sizes = lookup_sizes(path, [camera.name for camera in static_cameras], sizes, given)
    cameras = [
        CameraEntry(path, camera.name).make_camera(
            known_sizes[camera.name], lenses[camera.lens][1], [], camera.camera_from_world
        )
        for camera in static_cameras
    ]
    return make_rig(path, cameras, "mm")


def _read_bop_image(node: dict[str, Any], path: PurePosixPath, lens: str, entry: CameraEntry) -> PosedImage:
    if missing := [key for key in ("cam_R_w2c", "cam_t_w2c") if key not in node]:
        raise entry.error(f"missing {', '.join(missing)}: this BOP scene has no poses of its cameras")
    rotation = entry.parse_matrix(node["cam_R_w2c"], "cam_R_w2c")
    pose = entry.make_pose(rotation, entry.parse_numbers(node["cam_t_w2c"], 3, "cam_t_w2c"))
    return PosedImage(path, lens, pose.rotation.as_quat(), pose.translation)


def _find_bop_size(path: Path, sensor: str | None) -> list[Any] | None:
    """Find the image size in the dataset's camera file: next to the folder of its images, or of its scenes."""
    name = f"camera_{sensor}.json" if sensor else "camera.json"
    for folder in list(path.resolve().parents)[:3]:
        if (file := folder / name).is_file() and file != path:
            node = read_plain(file)
            return (
                [node["width"], node["height"]]
                if isinstance(node, dict) and {"width", "height"} <= node.keys()
                else None
            )
    return None


def is_splat(data: Any) -> bool:
    """Return whether decoded JSON is a list of images with the names of 3D Gaussian splatting."""
    return isinstance(data, list) and any(isinstance(node, dict) and "img_name" in node for node in data)


def read_splat(data: Sequence[dict[str, Any]], path: Path) -> Rig:
    """Read the rig; cameras are named by their images, or the folders of these.

    Raises:
        ValueError: naming the file, and the image or camera if applicable.
    """
    if len(data) > MAX_FRAMES:
        raise ValueError(f"{path}: more than {MAX_FRAMES} images")
    # Lenses are numbered in order of appearance.
    keys, lenses, images = dict[str, str](), dict[str, tuple[Any, Any]](), []
    for number, node in enumerate(data):
        if missing := [key for key in _SPLAT_KEYS if not isinstance(node, dict) or key not in node]:
            raise ValueError(f"{path}: image {number}: missing {', '.join(missing)}")
        image = image_path(str(node["img_name"]))
        entry = CameraEntry(path, str(image))
        values = [entry.parse_number(node[key], key) for key in ("fx", "fy", "width", "height")]
        lens = keys.setdefault(json.dumps(values), str(len(keys)))
        lenses[lens] = values[2:], intrinsic_matrix(*values[:2], *(0.5 * np.array(values[2:]) - PIXEL_CENTER))
        rotation, position = (
            entry.parse_matrix(node["rotation"], "rotation"),
            entry.parse_numbers(node["position"], 3, "position"),
        )
        pose = entry.make_pose(rotation, position).inv()
        images.append(PosedImage(image, lens, pose.rotation.as_quat(), pose.translation))
    cameras = [
        CameraEntry(path, camera.name).make_camera(*lenses[camera.lens], [], camera.camera_from_world)
        for camera in find_static_cameras(images, path)
    ]
    return make_rig(path, cameras)
