"""NeRF's transforms.json (instant-ngp, nerfstudio, Blender's): frames with a pose each, of cameras that stand still.

transform_matrix takes the camera's points to the world, and the camera looks along -z with y up. Lens and principal point
are COLMAP's, from which such files are made: the centre of the top-left pixel is (0.5, 0.5). They stand beside the frames,
or in each of them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from sylpose.calibration.camera_builder import (
    Sizes,
    from_opengl,
    make_camera,
    make_rig,
    matrix_of,
    numbers,
    pose_of_matrix,
    sizes_of,
)
from sylpose.calibration.colmap import HALF
from sylpose.calibration.static_cameras import Shot, path_of, still_cameras
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import LensModel, Rig

__all__ = ["is_nerf", "read"]

_LENS_KEYS = ("camera_model", "camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h")
_TERMS = ("k1", "k2", "k3", "k4", "p1", "p2")
_MODELS: dict[str, LensModel] = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"), "opencv"),
    "OPENCV_FISHEYE": "fisheye",
}
# Frames (choice: those of COLMAP's models).
MAX_FRAMES = 100_000


def is_nerf(data: Any) -> bool:
    """Whether decoded JSON has frames with a transform_matrix."""
    frames = data.get("frames") if isinstance(data, dict) else None
    return isinstance(frames, list) and any(isinstance(frame, dict) and "transform_matrix" in frame for frame in frames)


def read(data: dict[str, Any], path: Path, sizes: Sizes | None = None) -> Rig:
    """The rig; cameras are called as the files of the frames are, or the folders that have those of one camera each.

    Raises:
        ValueError: naming the file, and the camera where there is one.
    """
    frames = [frame for frame in data["frames"] if isinstance(frame, dict)]
    if len(frames) > MAX_FRAMES:
        raise ValueError(f"{path}: more than {MAX_FRAMES} frames")
    paths = _without_common([path_of(str(frame.get("file_path") or k)) for k, frame in enumerate(frames)])
    common = {key: data[key] for key in (*_LENS_KEYS, *_TERMS) if data.get(key) is not None}
    lenses: dict[str, dict[str, Any]] = {}
    keys: dict[str, str] = {}
    shots = []
    for frame, its in zip(frames, paths, strict=True):
        lens = common | {
            key: frame[key] for key in common.keys() | {*_LENS_KEYS, *_TERMS} if frame.get(key) is not None
        }
        # By the order in which they come.
        key = keys.setdefault(json.dumps(lens, sort_keys=True), str(len(keys)))
        lenses[key] = lens
        pose = pose_of_matrix(path, str(its), "transform_matrix", frame.get("transform_matrix")) * from_opengl.inv()
        pose = pose.inv()
        shots.append(Shot(its, key, pose.rotation.as_quat(), pose.translation))
    stills = still_cameras(shots, path)
    without = [still.name for still in stills if not {"w", "h"} <= lenses[still.lens].keys()]
    known = sizes_of(path, [still.name for still in stills], sizes) if without else {}
    cameras = []
    for still in stills:
        lens = lenses[still.lens]
        where = f"{path}: camera {still.name}"
        size = known[still.name] if still.name in without else [lens["w"], lens["h"]]
        width, height = numbers(size, 2, f"{where}: w and h")
        model, terms = _lens(lens, where)
        cameras.append(
            make_camera(
                path,
                still.name,
                size=(width, height),
                matrix=_matrix(lens, width, height, where),
                distortion=terms,
                camera_from_world=still.camera_from_world,
                lens=model,
            )
        )
    return make_rig(path, cameras)


def _without_common(paths: Sequence[PurePosixPath]) -> list[PurePosixPath]:
    """Without the folder that all are in."""
    if len(paths) < 2:
        return [PurePosixPath(path.name) for path in paths]
    common = (
        os.path.commonpath([str(path.parent) for path in paths]) if len({p.is_absolute() for p in paths}) == 1 else ""
    )
    return [path.relative_to(common) if common else path for path in paths]


def _matrix(lens: dict[str, Any], width: float, height: float, where: str) -> FloatArray:
    def number(key: str) -> float | None:
        return None if key not in lens else float(numbers([lens[key]], 1, f"{where}: {key}")[0])

    fx, fy, cx, cy = (number(key) for key in ("fl_x", "fl_y", "cx", "cy"))
    if fx is None and (angle := number("camera_angle_x")) is not None and 0 < angle < np.pi:
        fx = 0.5 * width / np.tan(0.5 * angle)
    if fy is None and (angle := number("camera_angle_y")) is not None and 0 < angle < np.pi:
        fy = 0.5 * height / np.tan(0.5 * angle)
    if fx is None and fy is None:
        raise ValueError(f"{where}: transforms.json says neither fl_x nor camera_angle_x")
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    assert fx is not None
    assert fy is not None
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    return matrix_of(fx, fy, cx - HALF, cy - HALF)


def _lens(lens: dict[str, Any], where: str) -> tuple[LensModel, list[float]]:
    word = str(lens.get("camera_model", "OPENCV")).upper()
    if word not in _MODELS or lens.get("is_fisheye"):
        raise ValueError(
            f"{where}: camera_model {word!r} is none of OpenCV's, which sylpose has; {', '.join(_MODELS)} are"
        )
    k1, k2, k3, k4, p1, p2 = (float(numbers([lens.get(key, 0.0)], 1, f"{where}: {key}")[0]) for key in _TERMS)
    if _MODELS[word] == "fisheye":
        return "fisheye", [k1, k2, k3, k4]
    if k4:
        raise ValueError(f"{where}: k4 is not in OpenCV's lens model; camera_model OPENCV_FISHEYE has one")
    return "opencv", [k1, k2, p1, p2, k3]
