"""NeRF's transforms.json (instant-ngp, nerfstudio, Blender's): frames of static cameras, each with a pose.

transform_matrix maps the camera's points to the world; the camera looks along -z with y up. Lens and principal point
follow COLMAP, from which such files are made: the center of the top-left pixel is (0.5, 0.5). They are given once for
all frames, or in each frame.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.camera_builder import (
    OPENCV_FROM_OPENGL,
    SizeLookup,
    intrinsic_matrix,
    lookup_sizes,
    make_camera,
    make_rig,
    parse_numbers,
    parse_pose_matrix,
)
from sylpose.io.calibration.colmap import PIXEL_CENTER
from sylpose.io.calibration.static_cameras import PosedImage, find_static_cameras, image_path
from sylpose.rig import LensModel, Rig

__all__ = ["is_nerf", "read"]

_LENS_KEYS = ("camera_model", "camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h")
_TERMS = ("k1", "k2", "k3", "k4", "p1", "p2")
_MODELS: dict[str, LensModel] = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"), "opencv"),
    "OPENCV_FISHEYE": "fisheye",
}
# Maximum number of frames (choice: as in COLMAP models).
MAX_FRAMES = 100_000


def is_nerf(data: Any) -> bool:
    """Return whether decoded JSON has frames with a transform_matrix."""
    frames = data.get("frames") if isinstance(data, dict) else None
    return isinstance(frames, list) and any(isinstance(frame, dict) and "transform_matrix" in frame for frame in frames)


def read(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig; cameras are named after the frames' files, or after the folders with the frames of one camera each.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    frames = [frame for frame in data["frames"] if isinstance(frame, dict)]
    if len(frames) > MAX_FRAMES:
        raise ValueError(f"{path}: more than {MAX_FRAMES} frames")
    paths = _remove_common_folder([image_path(str(frame.get("file_path") or k)) for k, frame in enumerate(frames)])
    common = {key: data[key] for key in (*_LENS_KEYS, *_TERMS) if data.get(key) is not None}
    lenses: dict[str, dict[str, Any]] = {}
    keys: dict[str, str] = {}
    images = []
    for frame, image_file in zip(frames, paths, strict=True):
        lens = common | {
            key: frame[key] for key in common.keys() | {*_LENS_KEYS, *_TERMS} if frame.get(key) is not None
        }
        # Keys are numbered in order of appearance.
        key = keys.setdefault(json.dumps(lens, sort_keys=True), str(len(keys)))
        lenses[key] = lens
        pose = (
            parse_pose_matrix(path, str(image_file), "transform_matrix", frame.get("transform_matrix"))
            * OPENCV_FROM_OPENGL.inv()
        )
        pose = pose.inv()
        images.append(PosedImage(image_file, key, pose.rotation.as_quat(), pose.translation))
    static_cameras = find_static_cameras(images, path)
    unsized = [
        static_camera.name for static_camera in static_cameras if not {"w", "h"} <= lenses[static_camera.lens].keys()
    ]
    known_sizes = lookup_sizes(path, [static_camera.name for static_camera in static_cameras], sizes) if unsized else {}
    cameras = []
    for static_camera in static_cameras:
        lens = lenses[static_camera.lens]
        where = f"{path}: camera {static_camera.name}"
        size = known_sizes[static_camera.name] if static_camera.name in unsized else [lens["w"], lens["h"]]
        width, height = parse_numbers(size, 2, f"{where}: w and h")
        model, terms = _parse_lens(lens, where)
        cameras.append(
            make_camera(
                path,
                static_camera.name,
                size=(width, height),
                matrix=_parse_matrix(lens, width, height, where),
                distortion=terms,
                camera_from_world=static_camera.camera_from_world,
                lens=model,
            )
        )
    return make_rig(path, cameras)


def _remove_common_folder(paths: Sequence[PurePosixPath]) -> list[PurePosixPath]:
    """Remove the common parent folder of all paths."""
    if len(paths) < 2:
        return [PurePosixPath(path.name) for path in paths]
    common = (
        os.path.commonpath([str(path.parent) for path in paths]) if len({p.is_absolute() for p in paths}) == 1 else ""
    )
    return [path.relative_to(common) if common else path for path in paths]


def _parse_matrix(lens: dict[str, Any], width: float, height: float, where: str) -> FloatArray:
    def number(key: str) -> float | None:
        return None if key not in lens else float(parse_numbers([lens[key]], 1, f"{where}: {key}")[0])

    fx, fy, cx, cy = (number(key) for key in ("fl_x", "fl_y", "cx", "cy"))
    if fx is None and (angle := number("camera_angle_x")) is not None and 0 < angle < np.pi:
        fx = 0.5 * width / np.tan(0.5 * angle)
    if fy is None and (angle := number("camera_angle_y")) is not None and 0 < angle < np.pi:
        fy = 0.5 * height / np.tan(0.5 * angle)
    if fx is None and fy is None:
        raise ValueError(f"{where}: transforms.json has neither fl_x nor camera_angle_x")
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    assert fx is not None
    assert fy is not None
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    return intrinsic_matrix(fx, fy, cx - PIXEL_CENTER, cy - PIXEL_CENTER)


def _parse_lens(lens: dict[str, Any], where: str) -> tuple[LensModel, list[float]]:
    model_name = str(lens.get("camera_model", "OPENCV")).upper()
    if model_name not in _MODELS or lens.get("is_fisheye"):
        raise ValueError(f"{where}: camera_model {model_name!r} is not supported; OpenCV's are: {', '.join(_MODELS)}")
    k1, k2, k3, k4, p1, p2 = (float(parse_numbers([lens.get(key, 0.0)], 1, f"{where}: {key}")[0]) for key in _TERMS)
    if _MODELS[model_name] == "fisheye":
        return "fisheye", [k1, k2, k3, k4]
    if k4:
        raise ValueError(f"{where}: k4 is not in OpenCV's lens model; camera_model OPENCV_FISHEYE has one")
    return "opencv", [k1, k2, p1, p2, k3]
