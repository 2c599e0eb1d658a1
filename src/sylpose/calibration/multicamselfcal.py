"""MultiCamSelfCal's folder: camera1.Pmat.cal, ..., and where there are some Res.dat, camera_order.txt, basename1.rad, ...

A projection matrix takes world points to pixels without distortion. A .rad file's K and kc take the distortion away, in
normalised points of that K, which may be another one than that of the projection matrix. Pixels are those of the points that
it was given.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import rq
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.calibration.camera_builder import Sizes, make_camera, make_rig, matrix_of, numbers, sizes_of
from sylpose.calibration.lens_conversion import LENS_PX, Fitted, fitted_lens, grid
from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import text_of, told
from sylpose.rig import Rig

__all__ = ["is_multicamselfcal", "read"]

_MATRIX = re.compile(r"camera([0-9]{1,4})\.Pmat\.cal", re.IGNORECASE)
_LENS = re.compile(r".*?([0-9]{1,4})\.rad", re.IGNORECASE)
_VALUE = re.compile(r"^\s*(K[1-3][1-3]|kc[1-5])\s*=\s*(\S+)\s*$", re.MULTILINE)


def is_multicamselfcal(path: Path) -> bool:
    """Whether a file's name is one of those in the folder of a self-calibration."""
    return bool(_MATRIX.fullmatch(path.name) or _LENS.fullmatch(path.name)) or path.name == "camera_order.txt"


def read(_: object, path: Path, sizes: Sizes | None = None) -> Rig:
    """The rig of the folder that a file is in; cameras are called as camera_order.txt says, or by their numbers.

    Raises:
        ValueError: naming the file, and the camera where there is one.
    """
    folder = path.parent
    matrices, lenses = _by_number(folder, _MATRIX), _by_number(folder, _LENS)
    if not matrices:
        raise ValueError(f"{path}: this is of MultiCamSelfCal, but no camera1.Pmat.cal, ... lie beside it")
    names = {i: str(i) for i in matrices}
    if (order := folder / "camera_order.txt").is_file():
        listed = text_of(order).split("\n")
        listed = [name.strip() for name in listed if name.strip()]
        if len(listed) != len(matrices):
            raise ValueError(f"{order}: {len(listed)} cameras, and {len(matrices)} projection matrices beside it")
        names = dict(zip(matrices, listed, strict=True))
    known = _sizes(folder, names, sizes)
    cameras = []
    for i, file in matrices.items():
        with told(file):
            seen = _decomposed(
                numbers(text_of(file), 12, f"{file}: the projection matrix").reshape(3, 4), f"{file}: camera {i}"
            )
        where = f"{lenses.get(i, file)}: camera {names[i]}"
        lens = _lens(lenses.get(i), seen.matrix, known[names[i]], where)
        cameras.append(
            make_camera(
                file,
                names[i],
                size=known[names[i]],
                matrix=lens.matrix,
                distortion=lens.distortion,
                camera_from_world=seen.camera_from_world,
                lens="opencv",
            )
        )
    return make_rig(folder, cameras)


def _by_number(folder: Path, name: re.Pattern[str]) -> dict[int, Path]:
    found = {int(match[1]): file for file in folder.iterdir() if (match := name.fullmatch(file.name))}
    return dict(sorted(found.items()))


def _sizes(folder: Path, names: dict[int, str], sizes: Sizes | None) -> dict[str, tuple[int, int]]:
    """Of Res.dat, which has width and height of each camera in a line."""
    file = folder / "Res.dat"
    if not file.is_file():
        return sizes_of(folder, list(names.values()), sizes)
    with told(file):
        rows = numbers(text_of(file), 2 * len(names), "width and height of each camera").reshape(-1, 2)
        if (rows != rows.round()).any() or (rows < 1).any() or (rows > 2**16).any():
            raise ValueError("widths and heights must be whole numbers of pixels")
    return {name: (int(row[0]), int(row[1])) for name, row in zip(names.values(), rows, strict=True)}


class _Seen(NamedTuple):
    matrix: FloatArray
    camera_from_world: RigidTransform


def _decomposed(projection: FloatArray, where: str) -> _Seen:
    """P = K [R t], up to its scale."""
    left = projection[:, :3]
    if not abs(np.linalg.det(left)) > 1e-12 * np.abs(left).max() ** 3:
        raise ValueError(f"{where}: the projection matrix is of no camera: its left part is singular")
    sign = np.sign(np.linalg.det(left))
    matrix, turn = rq(sign * left)
    signs = np.diag(np.sign(np.diag(matrix)))
    matrix, turn = matrix @ signs, signs @ turn
    center = -np.linalg.solve(left, projection[:, 3])
    rotation = Rotation.from_matrix(turn)
    return _Seen(matrix / matrix[2, 2], RigidTransform.from_components(-rotation.apply(center), rotation))


def _lens(file: Path | None, seen: FloatArray, size: tuple[int, int], where: str) -> Fitted:
    """Of the matrix `seen`, before which a .rad file's distortion was taken away."""
    if file is not None:
        value = dict(_VALUE.findall(text_of(file)))
        keys = ("K11", "K12", "K13", "K22", "K23", "kc1", "kc2", "kc3", "kc4")
        if lacking := [key for key in keys if key not in value]:
            raise ValueError(f"{file}: missing {', '.join(lacking)}")
        fx, skew, cx, fy, cy, *kc = numbers([value[key] for key in keys], len(keys), f"{file}: K and kc")
        if not fx > 0 or not fy > 0 or skew:
            raise ValueError(f"{file}: K must have positive focal lengths and no skew")
    else:
        fx, fy, cx, cy, kc = seen[0, 0], seen[1, 1], seen[0, 2], seen[1, 2], [0.0] * 4
    plain = matrix_of(seen[0, 0], seen[1, 1], seen[0, 2], seen[1, 2])
    if not any(kc):
        # Rounding leaves some skew, which is nothing if no pixel of the image tells it.
        return Fitted(plain if abs(seen[0, 1]) * size[1] / seen[1, 1] < LENS_PX else seen, np.zeros(5))
    # Points all over what may be in the image, and where they are in it.
    pixels = grid(size, margin=0.4)
    x, y = ((pixels - (cx, cy)) / (fx, fy)).T
    r2 = x * x + y * y
    with np.errstate(all="ignore"):
        radial = 1 + r2 * (kc[0] + r2 * kc[1])
        u = fx * (x * radial + 2 * kc[2] * x * y + kc[3] * (r2 + 2 * x * x)) + cx
        v = fy * (y * radial + kc[2] * (r2 + 2 * y * y) + 2 * kc[3] * x * y) + cy
    inside = (u > -0.05 * size[0]) & (u < 1.05 * size[0]) & (v > -0.05 * size[1]) & (v < 1.05 * size[1])
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(seen).T
    return fitted_lens(homogeneous[inside, :2], np.column_stack([u, v])[inside], plain, where)
