"""KWIVER's and VIAME's cameras: .krtd of each camera, and VIAME's stereo calibration in JSON.

- KRTD: the numbers of K (3x3), R (3x3), t (3) and OpenCV's distortion; X_camera = R X_world + t.
- JSON: fx_left, ..., fx_right, ..., R and T, as of cv2.stereoCalibrate: the world is the left camera's frame. VIAME's
  stereo files in YAML have OpenCV's names (`stereo`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import input_errors, read_text
from sylpose.io.calibration.camera_builder import (
    CameraEntry,
    Entry,
    SizeLookup,
    intrinsic_matrix,
    lookup_sizes,
    make_rig,
)
from sylpose.io.calibration.markup import MAX_FILES
from sylpose.rig import Camera, Rig

_SIDES = ("left", "right")
# OpenCV's numbers of distortion terms.
_TERMS = (4, 5, 8, 12, 14)


def is_krtd(path: Path) -> bool:
    """Return whether a file has the suffix of KWIVER's cameras."""
    return path.suffix.lower() == ".krtd"


def read_krtd(_: object, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of all such files in the folder, named by their files.

    Raises:
        ValueError: naming the file, for other than its numbers.
    """
    files = [file for file in sorted(path.parent.iterdir()) if is_krtd(file) and file.is_file()][:MAX_FILES]
    known_sizes = lookup_sizes(path, [file.stem for file in files], sizes)
    cameras = []
    for file in files:
        with input_errors(file):
            cameras.append(_parse_krtd(file, known_sizes[file.stem]))
    return make_rig(path.parent, cameras)


def _parse_krtd(file: Path, size: Any) -> Camera:
    entry = CameraEntry(file, file.stem)
    words = read_text(file).split()
    counts = tuple(21 + n for n in range(_TERMS[-1] + 1))
    numbers = entry.parse_numbers(words, counts, "K, R, t and the distortion")
    matrix = numbers[:9].reshape(3, 3)
    if not matrix[2, 2] > 0:
        raise entry.error("the last number of K must be positive")
    pose = entry.make_pose(numbers[9:18].reshape(3, 3), numbers[18:21])
    return entry.make_camera(size, matrix / matrix[2, 2], _pad_terms(numbers[21:]), pose)


def _pad_terms(terms: FloatArray) -> FloatArray:
    """Return distortion with zeros up to a number of terms that OpenCV has; a single 0 means none."""
    return np.pad(terms, (0, next(n for n in _TERMS if n >= len(terms)) - len(terms)))


def is_viame(data: Any) -> bool:
    """Return whether decoded JSON has the focal lengths of VIAME's stereo cameras."""
    return isinstance(data, dict) and bool({"fx_left", "fx_right"} & data.keys())


def read_viame(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of cameras left and right; lengths are millimeters if the board's square is given in them.

    Raises:
        ValueError: naming the file, and what is missing or invalid.
    """
    where = Entry(path)
    keys = [f"{key}_{side}" for side in _SIDES for key in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")]
    if missing := [key for key in (*keys, "R", "T") if data.get(key) is None]:
        raise where.error(f"missing {', '.join(missing)} of VIAME's stereo calibration")
    given = {}
    if {"image_width", "image_height"} <= data.keys():
        given = {side: [data["image_width"], data["image_height"]] for side in _SIDES}
    known_sizes = lookup_sizes(path, _SIDES, sizes, given)
    cameras = []
    for side in _SIDES:
        entry = CameraEntry(path, side)

        def number(key: str, side: str = side) -> float:
            return where.parse_number(data.get(f"{key}_{side}", 0.0), f"{key}_{side}")

        pose = RigidTransform.identity()
        if side == "right":
            pose = entry.make_pose(entry.parse_matrix(data["R"], "R"), entry.parse_numbers(data["T"], 3, "T"))
        terms = [number(key) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
        matrix = intrinsic_matrix(*(number(key) for key in ("fx", "fy", "cx", "cy")))
        cameras.append(entry.make_camera(known_sizes[side], matrix, terms if any(terms[5:]) else terms[:5], pose))
    return make_rig(path, cameras, "mm" if "square_size_mm" in data else "")
