"""XMALab's MayaCam files and DLT coefficients (DLTdv, easyWand, Argus): pinhole cameras of undistorted images.

- MayaCam 2, text: image size, camera matrix, rotation and translation, X_camera = R X_world + t as in OpenCV.
- MayaCam 1, CSV of five rows: position; angles about the axes x y z in degrees, applied in this order; film plane; u0 v0
  Z, the principal point and focal length in pixels from (1, 1), v0 from the bottom; scale, width, height. The camera
  looks along -z with y up.
- DLT: eleven rows L1 ... L11, a column of each camera: u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1), v
  likewise of L5 ... L8. The first pixel is (1, 1) at the top left in DLTdv 8. At the bottom left, it is (1, 1) in DLTdv 1
  to 7 and easyWand, and (0, 0) in Argus; which of these is not stated, so that (0.5, 0.5) is used. Top or bottom follows
  from the coefficients, provided that the origin is in front of all cameras.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import input_errors, read_text
from sylpose.io.calibration.camera_builder import (
    OPENCV_FROM_OPENGL,
    CameraEntry,
    Entry,
    SizeLookup,
    intrinsic_matrix,
    lookup_sizes,
    make_rig,
)
from sylpose.io.calibration.folders import decompose_projection
from sylpose.io.calibration.lens_conversion import sample_image_grid
from sylpose.io.calibration.markup import MAX_FILES
from sylpose.rig import Camera, Rig

_SECTIONS = ("image size", "camera matrix", "rotation", "translation")
_NUMBER = re.compile(r"[-+]?(?:[0-9.]+(?:e[-+]?[0-9]+)?|nan|inf)", re.IGNORECASE)
_DEFAULT_SIDE = 1024.0
_N_COEFFICIENTS = 11
# Largest distance anywhere in the image, pixels, between DLT coefficients and the nearest camera without skew (choice:
# the error of points that are digitized by hand).
MAX_SKEW_ERROR_PX = 2.0
# Skew below this distance is rounding (derived: a million times that of float64 in 1000 pixels).
_ROUNDING_PX = 1e-7


def is_mayacam(data: str) -> bool:
    """Return whether text is a MayaCam file: of version 2, or a table of 5 x 3 numbers."""
    return data.lower().startswith(_SECTIONS[0]) or _has_shape(data, 5, (3,))


def read_mayacam(_: str, path: Path) -> Rig:
    """Read the rig of all MayaCam files of the same suffix in the folder, named by their files.

    Raises:
        ValueError: naming the file, for a section that is missing or invalid.
    """
    cameras = []
    for file in _find_mayacams(path):
        with input_errors(file):
            text, entry = read_text(file).lstrip(), CameraEntry(file, file.stem)
            is_second = text.lower().startswith(_SECTIONS[0])
            cameras.append(_parse_mayacam_2(text, entry) if is_second else _parse_mayacam_1(text, entry))
    return make_rig(path.parent, cameras)


def _find_mayacams(path: Path) -> list[Path]:
    """Find the MayaCam files in the folder of `path`; other files, readable or not, are left out."""
    found = list[Path]()
    for file in sorted(path.parent.iterdir()):
        if file.suffix.lower() == path.suffix.lower() and file.is_file() and len(found) < MAX_FILES:
            with suppress(ValueError):
                if is_mayacam(read_text(file).lstrip()):
                    found.append(file)
    return found


def _parse_mayacam_2(text: str, entry: CameraEntry) -> Camera:
    parts = re.split(rf"^[ \t]*({'|'.join(_SECTIONS)})[ \t\r]*$", text, flags=re.MULTILINE | re.IGNORECASE)
    sections = {name.lower(): content for name, content in zip(parts[1::2], parts[2::2], strict=True)}
    if missing := [name for name in _SECTIONS if name not in sections]:
        raise entry.error(f"missing {', '.join(missing)} of MayaCam 2.0")
    size = entry.parse_numbers(sections["image size"], 2, "image size")
    matrix = entry.parse_matrix(sections["camera matrix"], "camera matrix")
    rotation = entry.parse_matrix(sections["rotation"], "rotation")
    pose = entry.make_pose(rotation, entry.parse_numbers(sections["translation"], 3, "translation"))
    return entry.make_camera(size, matrix, [], pose)


def _parse_mayacam_1(text: str, entry: CameraEntry) -> Camera:
    position, angles, _, (u0, v0, focal), (_, *sides) = entry.parse_numbers(text, 15, "MayaCam 1.0").reshape(5, 3)
    width, height = (side or _DEFAULT_SIDE for side in sides)
    world_from_camera = RigidTransform.from_components(position, Rotation.from_euler("xyz", angles, degrees=True))
    matrix = intrinsic_matrix(abs(focal), abs(focal), u0 - 1.0, height - v0)
    return entry.make_camera([width, height], matrix, [], OPENCV_FROM_OPENGL * world_from_camera.inv())


def is_dlt(data: str) -> bool:
    """Return whether text is a table of eleven rows of numbers, a column of each camera."""
    return _has_shape(data, _N_COEFFICIENTS, range(1, MAX_FILES + 1))


def _has_shape(text: str, rows: int, columns: range | tuple[int, ...]) -> bool:
    """Return whether text is a table of numbers of this shape."""
    # Bounded before it is split; a table has at most 25 characters per number.
    if len(text) > 25 * rows * columns[-1] + 1000:
        return False
    table = [re.split(r"[,;\s]+", line.strip(" \t,;\r")) for line in text.strip().split("\n")]
    if len(table) != rows or len({len(row) for row in table}) != 1 or len(table[0]) not in columns:
        return False
    return all(
        re.fullmatch(r"[-+]?(?:[0-9.]+(?:[eE][-+]?[0-9]+)?|nan|inf)", word, re.IGNORECASE)
        for row in table
        for word in row
    )


def read_dlt(data: str, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig; cameras are named cam1, cam2, ... in the order of their columns, as DLTdv counts them.

    The nearest camera without skew is used; `error_px` is its distance from coefficients with skew.

    Raises:
        ValueError: naming the file, and the camera if applicable: coefficients of no camera, with too much skew, or
            whose origin is behind some camera.
    """
    words = re.split(r"[,;\s]+", data.strip(" \t\r\n,;"))
    columns = Entry(path).parse_numbers(words, len(words), "the coefficients").reshape(_N_COEFFICIENTS, -1).T
    names = [f"cam{k}" for k in range(1, len(columns) + 1)]
    known_sizes = lookup_sizes(path, names, sizes)
    projections = [np.append(column, 1.0).reshape(3, 4) for column in columns]
    counts_from_bottom = [float(np.linalg.det(projection[:, :3])) < 0 for projection in projections]
    if len(set(counts_from_bottom)) > 1:
        groups = (
            " and ".join(n for n, down in zip(names, counts_from_bottom, strict=True) if down == w) for w in (0, 1)
        )
        raise ValueError(
            f"{path}: the DLT coefficients of {' are mirror images of those of '.join(groups)}: the origin of the "
            "calibration must be in front of all cameras"
        )
    cameras = []
    for name, projection in zip(names, projections, strict=True):
        size = known_sizes[name]
        to_pixels = [[1.0, 0.0, -1.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]]
        if counts_from_bottom[0]:
            to_pixels[:2] = [[1.0, 0.0, -0.5], [0.0, -1.0, size[1] - 0.5]]
        pixels = np.array(to_pixels) @ projection
        matrix, pose = decompose_projection(pixels, f"{path}: camera {name}")
        cameras.append(_make_camera_without_skew(matrix, pose, CameraEntry(path, name), size))
    return make_rig(path, cameras)


def _make_camera_without_skew(
    matrix: FloatArray, pose: RigidTransform, entry: CameraEntry, size: tuple[int, int]
) -> Camera:
    """Build the camera without skew whose image of the directions is nearest to that of (3, 3) `matrix`."""
    grid = sample_image_grid(size)
    directions = np.column_stack([grid, np.ones(len(grid))]) @ np.linalg.inv(matrix).T
    plain, correction, error_px = matrix.copy(), Rotation.identity(), None
    plain[0, 1] = 0.0
    if abs(matrix[0, 1] / matrix[1, 1]) * size[1] > _ROUNDING_PX:
        # Half of a small skew is a rotation about the optical axis.
        start = np.concatenate([plain[[0, 1, 0, 1], [0, 1, 2, 2]], [0.0, 0.0, 0.5 * matrix[0, 1] / matrix[1, 1]]])
        residuals = _compare_pixels(directions, grid)
        found = least_squares(residuals, start, x_scale=np.maximum(np.abs(start), 1e-3)).x
        distances = np.linalg.norm(residuals(found).reshape(-1, 2), axis=1)
        if not distances.max() <= MAX_SKEW_ERROR_PX:
            angle = np.degrees(np.arctan2(abs(matrix[0, 1]), matrix[1, 1]))
            raise entry.error(
                f"its DLT coefficients have a skew of {angle:.2g} degrees, which no camera has: the nearest one "
                f"without deviates by up to {distances.max():.2g} pixels; calibrate with more points, or by a wand"
            )
        plain, correction = intrinsic_matrix(*found[:4]), Rotation.from_rotvec(found[4:])
        error_px = float(np.sqrt(np.mean(distances**2)))
    return entry.make_camera(size, plain, [], RigidTransform.from_rotation(correction) * pose, "opencv", error_px)


def _compare_pixels(directions: FloatArray, pixels: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return the residuals (2n,) of pixels as a function of fx fy cx cy and a rotation vector."""

    def compute_residuals(unknowns: FloatArray) -> FloatArray:
        rotated = Rotation.from_rotvec(unknowns[4:]).apply(directions)
        projected = rotated[:, :2] / rotated[:, 2:] * unknowns[:2] + unknowns[2:4]
        return np.asarray(projected - pixels).ravel()

    return compute_residuals
