"""OpenCap's cameraIntrinsicsExtrinsics.pickle, one of each camera, in folders Cam0, Cam1, ... or in one folder.

intrinsicMat, distortion, rotation and translation are OpenCV's, X_camera = R X_world + t in millimeters; imageSize is
(height, width). The world is that of the board, which stands upright. Pickles are read without executing them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sylpose.input_limits import input_errors, read_bytes
from sylpose.io.calibration.camera_builder import CameraEntry, make_rig
from sylpose.io.calibration.folders import MAX_PICKLE, is_pickle
from sylpose.io.calibration.markup import MAX_FILES
from sylpose.io.calibration.safe_pickle import load_safely
from sylpose.rig import Camera, Rig

CAMERA_FILE = "cameraIntrinsicsExtrinsics.pickle"
_KEYS = ("intrinsicMat", "distortion", "imageSize", "rotation", "translation")


def is_opencap(path: Path) -> bool:
    """Return whether a file is a pickle with OpenCap's keys, or has its name."""
    return path.name == CAMERA_FILE or (is_pickle(path) and _KEYS[0] in _load_if_readable(path))


def read_opencap(_: object, path: Path) -> Rig:
    """Read the rig of the file and its counterparts, named by their folders, or by their files in one folder.

    Raises:
        ValueError: naming the file: content other than arrays, a missing key, or an invalid value.
    """
    if path.name == CAMERA_FILE:
        files = {file.parent.name: file for file in sorted(path.parent.parent.glob(f"*/{CAMERA_FILE}"))}
    else:
        files = {file.stem: file for file in sorted(path.parent.iterdir()) if is_opencap(file)}
    cameras = []
    for name, file in list(files.items())[:MAX_FILES]:
        with input_errors(file):
            cameras.append(_parse_camera(_load(file), CameraEntry(file, name)))
    return make_rig(path, cameras, "mm")


def _parse_camera(data: dict[str, Any], entry: CameraEntry) -> Camera:
    if "rotation" not in data or "translation" not in data:
        raise entry.error(
            "this is OpenCap's file of intrinsics alone; files with rotation and translation are required"
        )
    if missing := [key for key in _KEYS if key not in data]:
        raise entry.error(f"missing {', '.join(missing)} of OpenCap's parameters")
    matrix, distortion, size, rotation, translation = (getattr(data[key], "value", data[key]) for key in _KEYS)
    matrix = entry.parse_matrix(matrix, "intrinsicMat")
    sides = entry.parse_numbers(size, 2, "imageSize")
    # Some files have (width, height): the principal point is near the middle of the image.
    orders = (sides[::-1], sides)
    size = min(orders, key=lambda order: float(np.linalg.norm(matrix[:2, 2] - 0.5 * order)))
    pose = entry.make_pose(entry.parse_matrix(rotation, "rotation"), translation)
    return entry.make_camera(size, matrix, distortion, pose)


def _load(path: Path) -> dict[str, Any]:
    data = load_safely(read_bytes(path, MAX_PICKLE))
    if not isinstance(data, dict):
        raise ValueError(f"{path}: a pickle, but not a dict of a camera's parameters")
    return data


def _load_if_readable(path: Path) -> dict[str, Any]:
    try:
        return _load(path) if path.is_file() else {}
    except ValueError:
        return {}
