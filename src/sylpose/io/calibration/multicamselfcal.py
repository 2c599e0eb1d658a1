"""MultiCamSelfCal folder: camera1.Pmat.cal, ..., and optionally Res.dat, camera_order.txt, basename1.rad, ...

A projection matrix maps world points to undistorted pixels. A .rad file's K and kc remove the distortion, in points
normalized by that K, which may differ from the intrinsics of the projection matrix. The pixel convention is that of
its input points.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import rq
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import input_errors, read_text
from sylpose.io.calibration.camera_builder import (
    SizeLookup,
    intrinsic_matrix,
    lookup_sizes,
    make_camera,
    make_rig,
    parse_numbers,
)
from sylpose.io.calibration.lens_conversion import MAX_LENS_ERROR_PX, FittedLens, fit_lens, sample_image_grid
from sylpose.rig import Rig

__all__ = ["is_multicamselfcal", "read"]

_MATRIX = re.compile(r"camera([0-9]{1,4})\.Pmat\.cal", re.IGNORECASE)
_LENS = re.compile(r".*?([0-9]{1,4})\.rad", re.IGNORECASE)
_VALUE = re.compile(r"^\s*(K[1-3][1-3]|kc[1-5])\s*=\s*(\S+)\s*$", re.MULTILINE)


def is_multicamselfcal(path: Path) -> bool:
    """Return whether a file has a name from the folder of a self-calibration."""
    return bool(_MATRIX.fullmatch(path.name) or _LENS.fullmatch(path.name)) or path.name == "camera_order.txt"


def read(_: object, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of a file's folder; cameras are named by camera_order.txt, or by their numbers.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    folder = path.parent
    matrices, lenses = _find_by_number(folder, _MATRIX), _find_by_number(folder, _LENS)
    if not matrices:
        raise ValueError(f"{path}: this is a MultiCamSelfCal file, but no camera1.Pmat.cal, ... is next to it")
    names = {i: str(i) for i in matrices}
    if (order := folder / "camera_order.txt").is_file():
        listed = read_text(order).split("\n")
        listed = [name.strip() for name in listed if name.strip()]
        if len(listed) != len(matrices):
            raise ValueError(f"{order}: {len(listed)} cameras, and {len(matrices)} projection matrices next to it")
        names = dict(zip(matrices, listed, strict=True))
    known_sizes = _read_sizes(folder, names, sizes)
    cameras = []
    for i, file in matrices.items():
        with input_errors(file):
            decomposed = _decompose(
                parse_numbers(read_text(file), 12, f"{file}: the projection matrix").reshape(3, 4),
                f"{file}: camera {i}",
            )
        where = f"{lenses.get(i, file)}: camera {names[i]}"
        lens = _fit_lens(lenses.get(i), decomposed.matrix, known_sizes[names[i]], where)
        cameras.append(
            make_camera(
                file,
                names[i],
                size=known_sizes[names[i]],
                matrix=lens.matrix,
                distortion=lens.distortion,
                camera_from_world=decomposed.camera_from_world,
                lens="opencv",
            )
        )
    return make_rig(folder, cameras)


def _find_by_number(folder: Path, name: re.Pattern[str]) -> dict[int, Path]:
    found = {int(match[1]): file for file in folder.iterdir() if (match := name.fullmatch(file.name))}
    return dict(sorted(found.items()))


def _read_sizes(folder: Path, names: dict[int, str], sizes: SizeLookup | None) -> dict[str, tuple[int, int]]:
    """Read image sizes from Res.dat, which has width and height of one camera per line."""
    file = folder / "Res.dat"
    if not file.is_file():
        return lookup_sizes(folder, list(names.values()), sizes)
    with input_errors(file):
        rows = parse_numbers(read_text(file), 2 * len(names), "width and height of each camera").reshape(-1, 2)
        if (rows != rows.round()).any() or (rows < 1).any() or (rows > 2**16).any():
            raise ValueError("widths and heights must be whole numbers of pixels")
    return {name: (int(row[0]), int(row[1])) for name, row in zip(names.values(), rows, strict=True)}


class _DecomposedCamera(NamedTuple):
    matrix: FloatArray
    camera_from_world: RigidTransform


def _decompose(projection: FloatArray, where: str) -> _DecomposedCamera:
    """Decompose P = K [R t], up to its scale."""
    left = projection[:, :3]
    if not abs(np.linalg.det(left)) > 1e-12 * np.abs(left).max() ** 3:
        raise ValueError(f"{where}: the projection matrix is invalid: its left 3x3 part is singular")
    sign = np.sign(np.linalg.det(left))
    matrix, rotation_matrix = rq(sign * left)
    signs = np.diag(np.sign(np.diag(matrix)))
    matrix, rotation_matrix = matrix @ signs, signs @ rotation_matrix
    center = -np.linalg.solve(left, projection[:, 3])
    rotation = Rotation.from_matrix(rotation_matrix)
    return _DecomposedCamera(matrix / matrix[2, 2], RigidTransform.from_components(-rotation.apply(center), rotation))


def _fit_lens(file: Path | None, intrinsics: FloatArray, size: tuple[int, int], where: str) -> FittedLens:
    """Fit the lens of a camera with intrinsics `intrinsics`, including a .rad file's distortion."""
    if file is not None:
        value = dict(_VALUE.findall(read_text(file)))
        keys = ("K11", "K12", "K13", "K22", "K23", "kc1", "kc2", "kc3", "kc4")
        if missing := [key for key in keys if key not in value]:
            raise ValueError(f"{file}: missing {', '.join(missing)}")
        fx, skew, cx, fy, cy, *kc = parse_numbers([value[key] for key in keys], len(keys), f"{file}: K and kc")
        if not fx > 0 or not fy > 0 or skew:
            raise ValueError(f"{file}: K must have positive focal lengths and no skew")
    else:
        fx, fy, cx, cy, kc = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2], [0.0] * 4
    matrix = intrinsic_matrix(intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2])
    if not any(kc):
        # Rounding leaves some skew, which is ignored if it is negligible in every pixel of the image.
        return FittedLens(
            matrix if abs(intrinsics[0, 1]) * size[1] / intrinsics[1, 1] < MAX_LENS_ERROR_PX else intrinsics,
            np.zeros(5),
        )
    # Points covering the image and its surroundings, and their distorted pixels.
    pixels = sample_image_grid(size, margin=0.4)
    x, y = ((pixels - (cx, cy)) / (fx, fy)).T
    r2 = x * x + y * y
    with np.errstate(all="ignore"):
        radial = 1 + r2 * (kc[0] + r2 * kc[1])
        u = fx * (x * radial + 2 * kc[2] * x * y + kc[3] * (r2 + 2 * x * x)) + cx
        v = fy * (y * radial + kc[2] * (r2 + 2 * y * y) + 2 * kc[3] * x * y) + cy
    inside = (u > -0.05 * size[0]) & (u < 1.05 * size[0]) & (v > -0.05 * size[1]) & (v < 1.05 * size[1])
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(intrinsics).T
    return fit_lens(homogeneous[inside, :2], np.column_stack([u, v])[inside], matrix, where)
