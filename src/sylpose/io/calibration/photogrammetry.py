"""Photogrammetry: static cameras from the poses of individual images; Metashape's XML and NeRF's transforms.json.

A static camera has the same pose in all of its images, up to the program's own error. Images in folders belong to the
camera named after the folder. Images without folder belong to the camera of their lens if all images of each lens
agree in rotation; otherwise each belongs to its own camera. The center of the top-left pixel is (0.5, 0.5).

- Agisoft Metashape's cameras as XML (File, Export, Export Cameras): a camera's transform maps its points to the chunk (x
  right, y down, z forward), the chunk's transform maps those to the world: X_world = scale R X + t. Pixels are f x' + cx
  + width / 2. p1 and p2 are swapped relative to OpenCV's.
- NeRF's transforms.json (instant-ngp, nerfstudio, Blender's): transform_matrix maps the camera's points to the world; the
  camera looks along -z with y up. Lens and principal point follow COLMAP, from which such files are made. They are given
  once for all frames, or in each frame.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.camera_builder import (
    OPENCV_FROM_OPENGL,
    CameraEntry,
    Entry,
    SizeLookup,
    intrinsic_matrix,
    lookup_sizes,
    make_rig,
)
from sylpose.rig import Camera, LensModel, Rig

# Center of the top-left pixel.
PIXEL_CENTER = 0.5
# Maximum deviation among a camera's poses: twice that of images with some hundred points (choice), as an angle in
# degrees and a fraction of the largest distance between cameras.
MAX_ROTATION_DEG, MAX_TRANSLATION_RATIO = 0.2, 0.005
# Maximum number of frames (choice: as in COLMAP models).
MAX_FRAMES = 100_000
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".jp2", ".dng", ".exr")


class PosedImage(NamedTuple):
    """Image with a pose camera_from_world: (4,) quaternion, w last, and (3,) translation.

    Its path has no file suffix; `lens` is the key of its lens.
    """

    path: PurePosixPath
    lens: str
    quaternion: FloatArray
    translation: FloatArray


class StaticCamera(NamedTuple):
    """Static camera, with the key of its lens."""

    name: str
    lens: str
    camera_from_world: RigidTransform


def image_path(name: str) -> PurePosixPath:
    """Return an image's path from a name with or without suffix."""
    path = PurePosixPath(name.replace("\\", "/"))
    return path.with_suffix("") if path.suffix.lower() in _IMAGE_SUFFIXES else path


def find_static_cameras(images: Sequence[PosedImage], path: Path) -> list[StaticCamera]:
    """Find the cameras of images, in the order of their lenses, then of their names.

    Raises:
        ValueError: naming the file, and the camera whose images have several poses or lenses; no images.
    """
    if not images:
        raise ValueError(f"{path}: no image in it has a pose")
    groups = _group_by_camera(images)
    means = {name: _mean_pose(camera_images) for name, camera_images in groups.items()}
    centers = np.array([pose.inv().translation for pose in means.values()])
    extent = max(float(np.linalg.norm(centers - center, axis=1).max()) for center in centers)
    order = {lens: k for k, lens in enumerate(dict.fromkeys(image.lens for image in images))}
    found = []
    for name, camera_images in groups.items():
        where = f"{path}: camera {name}: its {len(camera_images)} images"
        if len(lenses := sorted({image.lens for image in camera_images})) > 1:
            raise ValueError(f"{where} have {len(lenses)} lenses: {', '.join(lenses)}")
        rotation, distance = _compute_spread(camera_images, means[name])
        # With a single camera, use its distance from the origin, which such programs place among the points.
        scale = extent if extent > 0 else float(np.linalg.norm(means[name].inv().translation))
        if not (rotation <= MAX_ROTATION_DEG and distance <= MAX_TRANSLATION_RATIO * scale):
            raise ValueError(
                f"{where} do not have one pose: they are up to {rotation:.2f} degrees and {distance:.2g} units away "
                "from their mean; sylpose requires static cameras"
            )
        found.append(StaticCamera(name, camera_images[0].lens, means[name]))
    return sorted(found, key=lambda camera: (order[camera.lens], camera.name))


def make_unique_names(folders: Sequence[PurePosixPath]) -> list[str]:
    """Return unique names of folders: their last parts if these differ, else their full paths."""
    last = [folder.name for folder in folders]
    return last if len(set(last)) == len(last) else ["_".join(folder.parts) for folder in folders]


def _group_by_camera(images: Sequence[PosedImage]) -> dict[str, list[PosedImage]]:
    """Group images by the camera's name."""
    in_folders = all(len(image.path.parts) > 1 for image in images)
    images_by_lens: dict[str, list[PosedImage]] = {}
    for image in images:
        images_by_lens.setdefault(image.lens, []).append(image)
    poses_agree = all(_compute_spread(its, _mean_pose(its))[0] <= MAX_ROTATION_DEG for its in images_by_lens.values())
    found: dict[PurePosixPath, list[PosedImage]] = {}
    for image in images:
        key = image.path.parent if in_folders else PurePosixPath(image.lens) if poses_agree else image.path
        found.setdefault(key, []).append(image)
    if in_folders:
        names = make_unique_names(list(found))
    else:
        names = [its[0].path.name if len(its) == 1 else str(key) for key, its in found.items()]
    if len(set(names)) < len(names):
        names = [str(key).replace("/", "_") for key in found]
    return dict(zip(names, found.values(), strict=True))


def _stack_poses(images: Sequence[PosedImage]) -> RigidTransform:
    """Return camera_from_world of each image."""
    rotations = Rotation.from_quat(np.array([image.quaternion for image in images]))
    return RigidTransform.from_components(np.array([image.translation for image in images]), rotations)


def _mean_pose(images: Sequence[PosedImage]) -> RigidTransform:
    """Return the mean camera_from_world of a static camera."""
    poses = _stack_poses(images)
    if (poses.as_matrix() == poses[0].as_matrix()).all():
        return poses[0]
    rotation = poses.rotation.mean()
    return RigidTransform.from_components(-rotation.apply(poses.inv().translation.mean(axis=0)), rotation)


def _compute_spread(images: Sequence[PosedImage], mean: RigidTransform) -> tuple[float, float]:
    """Return the largest deviation of an image's pose from the mean: rotation in degrees, and distance."""
    poses = _stack_poses(images)
    distances = np.linalg.norm(poses.inv().translation - mean.inv().translation, axis=1)
    return float(np.degrees((poses.rotation * mean.rotation.inv()).magnitude().max())), float(distances.max())


# Metashape


_METASHAPE_TERMS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


def is_metashape(root: Element) -> bool:
    """Return whether XML has a Metashape chunk."""
    return root.tag == "document" and root.find("chunk/sensors") is not None


def read_metashape(root: Element, path: Path) -> Rig:
    """Read the rig of the aligned images, named by their labels.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    chunks = [chunk for chunk in root.findall("chunk") if chunk.find("cameras") is not None]
    if len(chunks) != 1:
        raise ValueError(
            f"{path}: {len(chunks)} chunks with cameras in this file of Metashape; exactly one is required"
        )
    sensors = {sensor.get("id"): sensor for sensor in chunks[0].findall("sensors/sensor")}
    cameras = []
    if not (images := list(_find_metashape_images(chunks[0], path))):
        raise ValueError(f"{path}: no camera in this file of Metashape is aligned: none has a transform")
    for static_camera in find_static_cameras(images, path):
        entry = CameraEntry(path, static_camera.name)
        sensor = sensors.get(static_camera.lens)
        if sensor is None:
            raise entry.error(f"its sensor {static_camera.lens} is not in this file of Metashape")
        cameras.append(_parse_metashape_camera(sensor, static_camera.camera_from_world, entry))
    return make_rig(path, cameras)


def _find_metashape_images(chunk: Element, path: Path) -> Iterator[PosedImage]:
    """Yield the aligned images with their poses in the world."""
    where = Entry(path, "the chunk's transform")
    given = {node.tag: node.text or "" for node in chunk.findall("transform/*")[::-1]}
    rotation = where.parse_matrix(given["rotation"], "rotation") if "rotation" in given else np.eye(3)
    translation = where.parse_numbers(given.get("translation", "0 0 0"), 3, "translation")
    scale = where.parse_number(given.get("scale", "1"), "scale")
    if not scale > 0:
        raise where.error(f"scale must be positive, got {scale:g}")
    world_from_chunk = CameraEntry(path, "of the chunk").make_pose(rotation, translation)
    for camera in chunk.iter("camera"):
        entry = CameraEntry(path, camera.get("label") or camera.get("id") or "")
        if camera.get("master_id") is not None:
            raise entry.error("multi-camera systems of Metashape are not supported; align it separately")
        if (node := camera.find("transform")) is None:
            continue
        chunk_from_camera = entry.parse_pose_matrix(entry.parse_numbers(node.text or "", 16, "transform"), "transform")
        scaled = RigidTransform.from_components(scale * chunk_from_camera.translation, chunk_from_camera.rotation)
        pose = (world_from_chunk * scaled).inv()
        lens = camera.get("sensor_id") or ""
        yield PosedImage(image_path(entry.place), lens, pose.rotation.as_quat(), pose.translation)


def _parse_metashape_camera(sensor: Element, pose: RigidTransform, entry: CameraEntry) -> Camera:
    found = sensor.findall("calibration")
    calibration = next((c for c in found if c.get("class") == "adjusted"), found[0] if found else None)
    if calibration is None:
        raise entry.error(f"its sensor {sensor.get('id')} has no calibration in this file of Metashape")
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", "fisheye"):
        raise entry.error(f"Metashape's {kind!r} camera model is not supported; frame and fisheye are")
    if calibration.find("fx") is not None:
        raise entry.error("its calibration has the format of an old PhotoScan (fx, fy); export it from Metashape")
    value = {
        node.tag: entry.parse_number(node.text or "", node.tag) for node in calibration if node.tag in _METASHAPE_TERMS
    }
    if "f" not in value:
        raise entry.error("missing 'f' in Metashape's calibration of its sensor")
    f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4 = (float(value.get(name, 0.0)) for name in _METASHAPE_TERMS)
    unsupported = {"b2": b2, "p3": p3, "p4": p4} | ({"p1": p1, "p2": p2} if kind == "fisheye" else {"k4": k4})
    if nonzero := [name for name, term in unsupported.items() if term]:
        raise entry.error(f"{', '.join(nonzero)} of Metashape's {kind} model is not in OpenCV's; calibrate without it")
    size = entry.parse_attributes(calibration.find("resolution"), "width", "height")
    matrix = intrinsic_matrix(f + b1, f, size[0] / 2 + cx - PIXEL_CENTER, size[1] / 2 + cy - PIXEL_CENTER)
    if kind == "fisheye":
        return entry.make_camera(size, matrix, [k1, k2, k3, k4], pose, "fisheye")
    return entry.make_camera(size, matrix, [k1, k2, p2, p1, k3], pose)


# NeRF


_NERF_KEYS = ("camera_model", "is_fisheye", "camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h")
_NERF_TERMS = ("k1", "k2", "k3", "k4", "p1", "p2")
_NERF_MODELS: dict[str, LensModel] = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"), "opencv"),
    "OPENCV_FISHEYE": "fisheye",
}


def is_nerf(data: Any) -> bool:
    """Return whether decoded JSON has frames with a transform_matrix."""
    frames = data.get("frames") if isinstance(data, dict) else None
    return isinstance(frames, list) and any(isinstance(frame, dict) and "transform_matrix" in frame for frame in frames)


def read_nerf(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig; cameras are named after the frames' files, or after the folders with the frames of one camera each.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    frames = [frame for frame in data["frames"] if isinstance(frame, dict)]
    if len(frames) > MAX_FRAMES:
        raise ValueError(f"{path}: more than {MAX_FRAMES} frames")
    paths = _remove_common_folder([image_path(str(frame.get("file_path") or k)) for k, frame in enumerate(frames)])
    keys_used = (*_NERF_KEYS, *_NERF_TERMS)
    lenses, keys, images = dict[str, dict[str, Any]](), dict[str, str](), []
    for frame, image_file in zip(frames, paths, strict=True):
        lens = {key: table[key] for table in (data, frame) for key in keys_used if table.get(key) is not None}
        # Keys are numbered in order of appearance.
        key = keys.setdefault(json.dumps(lens, sort_keys=True), str(len(keys)))
        lenses[key] = lens
        world_from_camera = CameraEntry(path, str(image_file)).parse_pose_matrix(
            frame.get("transform_matrix"), "transform_matrix"
        )
        pose = (world_from_camera * OPENCV_FROM_OPENGL.inv()).inv()
        images.append(PosedImage(image_file, key, pose.rotation.as_quat(), pose.translation))
    static_cameras = find_static_cameras(images, path)
    given_sizes = {
        camera.name: [lens["w"], lens["h"]]
        for camera in static_cameras
        if {"w", "h"} <= (lens := lenses[camera.lens]).keys()
    }
    known_sizes = lookup_sizes(path, [camera.name for camera in static_cameras], sizes, given_sizes)
    cameras = [_parse_nerf_camera(c, lenses[c.lens], known_sizes[c.name], path) for c in static_cameras]
    return make_rig(path, cameras)


def _remove_common_folder(paths: Sequence[PurePosixPath]) -> list[PurePosixPath]:
    """Remove the common parent folder of all paths."""
    if len(paths) < 2:
        return [PurePosixPath(path.name) for path in paths]
    is_mixed = len({path.is_absolute() for path in paths}) > 1
    common = "" if is_mixed else os.path.commonpath([str(path.parent) for path in paths])
    return [path.relative_to(common) if common else path for path in paths]


def _parse_nerf_camera(camera: StaticCamera, lens: dict[str, Any], size: Any, path: Path) -> Camera:
    entry, pose = CameraEntry(path, camera.name), camera.camera_from_world
    width, height = entry.parse_numbers(size, 2, "w and h")
    number = {
        key: entry.parse_number(lens[key], key)
        for key in ("fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", *_NERF_TERMS)
        if key in lens
    }
    for key, angle, side in (("fl_x", "camera_angle_x", width), ("fl_y", "camera_angle_y", height)):
        if key not in number and 0 < number.get(angle, 0.0) < np.pi:
            number[key] = 0.5 * side / np.tan(0.5 * number[angle])
    focal = number.get("fl_x", number.get("fl_y"))
    if focal is None:
        raise entry.error("transforms.json has neither fl_x nor camera_angle_x")
    cx, cy = number.get("cx", width / 2) - PIXEL_CENTER, number.get("cy", height / 2) - PIXEL_CENTER
    matrix = intrinsic_matrix(focal, number.get("fl_y", focal), cx, cy)
    model_name = str(lens.get("camera_model", "OPENCV")).upper()
    if model_name not in _NERF_MODELS:
        raise entry.error(f"camera_model {model_name!r} is not supported; OpenCV's are: {', '.join(_NERF_MODELS)}")
    k1, k2, k3, k4, p1, p2 = (number.get(key, 0.0) for key in _NERF_TERMS)
    if _NERF_MODELS[model_name] == "fisheye":
        return entry.make_camera((width, height), matrix, [k1, k2, k3, k4], pose, "fisheye")
    if lens.get("is_fisheye"):
        raise entry.error("is_fisheye is only supported with camera_model OPENCV_FISHEYE")
    if k4:
        raise entry.error("k4 is not in OpenCV's lens model; camera_model OPENCV_FISHEYE has one")
    return entry.make_camera((width, height), matrix, [k1, k2, p1, p2, k3], pose)
