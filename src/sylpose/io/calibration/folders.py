"""Calibrations of several files in one folder: JARVIS, EasyMocap, MultiCamSelfCal and DeepLabCut.

- JARVIS: one OpenCV YAML file per camera, Camera_T.yaml. Its matrices apply to row vectors: [X 1] [R; T] K. So R and
  intrinsicMatrix are the transposes of OpenCV's.
- EasyMocap: intri.yml (K_01, dist_01) and extri.yml (Rot_01 or R_01, T_01). X_camera = R X_world + T, with OpenCV's lens.
- MultiCamSelfCal: camera1.Pmat.cal, ..., and optionally Res.dat, camera_order.txt, basename1.rad, ... A projection matrix
  maps world points to undistorted pixels. A .rad file's K and kc remove the distortion, in points normalized by that K,
  which may differ from the intrinsics of the projection matrix. The pixel convention is that of its input points.
- DeepLabCut: camera_matrix/stereo_params.pickle, from cv2.stereoCalibrate; read without executing its content.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import rq
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import input_errors, read_bytes, read_text
from sylpose.io.calibration.camera_builder import (
    CameraEntry,
    Entry,
    SizeLookup,
    intrinsic_matrix,
    lookup_sizes,
    make_rig,
)
from sylpose.io.calibration.lens_conversion import MAX_LENS_ERROR_PX, FittedLens, fit_lens, sample_image_grid
from sylpose.io.calibration.markup import find_sibling_file, read_folder_documents, read_plain
from sylpose.io.calibration.safe_pickle import load_safely
from sylpose.rig import Rig


def is_jarvis(data: Any) -> bool:
    """Return whether a decoded file has a camera with JARVIS' keys."""
    return isinstance(data, dict) and {"intrinsicMatrix", "distortionCoefficients"} <= data.keys()


def read_jarvis(_: Any, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of all such files in the folder; cameras are named after their files.

    Raises:
        ValueError: invalid content; the message names the file.
    """
    found = {file: data for file, data in read_folder_documents(path, "intrinsicMatrix") if is_jarvis(data)}
    for file, data in found.items():
        if not {"R", "T"} <= data.keys():
            raise ValueError(
                f"{file}: this is a JARVIS file of intrinsics alone; files that include R and T are required"
            )
    known_sizes = lookup_sizes(path, [file.stem for file in found], sizes)
    cameras = []
    for file, data in found.items():
        entry = CameraEntry(file, file.stem)
        matrix, rotation = (entry.parse_matrix(data[key], key).T for key in ("intrinsicMatrix", "R"))
        lens, translation = (entry.to_plain(data[key], key) for key in ("distortionCoefficients", "T"))
        cameras.append(entry.make_camera(known_sizes[file.stem], matrix, lens, entry.make_pose(rotation, translation)))
    return make_rig(path.parent, cameras)


def is_easymocap(data: Any) -> bool:
    """Return whether a decoded file has the names of cameras, and values of these names."""
    return isinstance(data, dict) and "names" in data and any(key.startswith(("K_", "Rot_", "R_")) for key in data)


def read_easymocap(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of the file and its counterpart, intri.yml or extri.yml, next to it.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    for part, other, key, what in (("intri", "extri", "T_", "poses"), ("extri", "intri", "K_", "lenses")):
        if not any(name.startswith(key) for name in data):
            file = find_sibling_file(path, part, other)
            if file is None:
                raise ValueError(
                    f"{path}: this is one of EasyMocap's two files; the {what} are in {other}.yml, which is missing"
                )
            found = read_plain(file)
            data = data | (found if isinstance(found, dict) else {})
    # Do not use `names`, in which a number may have lost its leading zeros.
    names = [key.removeprefix("K_") for key in data if key.startswith("K_")]
    if not names:
        raise ValueError(f"{path}: EasyMocap's intri.yml has no camera matrix K_NAME")
    given_sizes = {
        name: [data[f"W_{name}"], data[f"H_{name}"]] for name in names if {f"W_{name}", f"H_{name}"} <= data.keys()
    }
    known_sizes = lookup_sizes(path, names, sizes, given_sizes)
    cameras = []
    for name in names:
        entry = CameraEntry(path, name)
        keys = f"K_{name}", f"dist_{name}", f"Rot_{name}" if f"Rot_{name}" in data else f"R_{name}", f"T_{name}"
        if missing := [key for key in keys[1:] if data.get(key) is None]:
            raise entry.error(f"missing {', '.join(missing)}")
        matrix, lens, rotation, translation = (Entry(path).to_plain(data[key], key) for key in keys)
        cameras.append(entry.make_camera(known_sizes[name], matrix, lens, entry.make_pose(rotation, translation)))
    return make_rig(path, cameras)


# MultiCamSelfCal


_PROJECTION_FILE = re.compile(r"camera([0-9]{1,4})\.Pmat\.cal", re.IGNORECASE)
_LENS_FILE = re.compile(r".*?([0-9]{1,4})\.rad", re.IGNORECASE)
_LENS_KEYS = ("K11", "K12", "K13", "K22", "K23", "kc1", "kc2", "kc3", "kc4")


def is_multicamselfcal(path: Path) -> bool:
    """Return whether a file has a name from the folder of a self-calibration."""
    return bool(_PROJECTION_FILE.fullmatch(path.name) or _LENS_FILE.fullmatch(path.name)) or (
        path.name == "camera_order.txt"
    )


def read_multicamselfcal(_: object, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of a file's folder; cameras are named by camera_order.txt, or by their numbers.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    folder = path.parent
    matrices, lenses = _find_by_number(folder, _PROJECTION_FILE), _find_by_number(folder, _LENS_FILE)
    if not matrices:
        raise ValueError(f"{path}: this is a MultiCamSelfCal file, but no camera1.Pmat.cal, ... is next to it")
    names = [str(i) for i in matrices]
    if (order := folder / "camera_order.txt").is_file():
        names = [name.strip() for name in read_text(order).split("\n") if name.strip()]
        if len(names) != len(matrices):
            raise ValueError(f"{order}: {len(names)} cameras, and {len(matrices)} projection matrices next to it")
    known_sizes = _read_sizes(folder, names, sizes)
    cameras = []
    for name, (i, file) in zip(names, matrices.items(), strict=True):
        with input_errors(file):
            projection = Entry(file).parse_matrix(read_text(file), "the projection matrix", columns=4)
            matrix, pose = decompose_projection(projection, f"{file}: camera {i}")
        lens = _fit_lens(lenses.get(i), matrix, known_sizes[name], f"{lenses.get(i, file)}: camera {name}")
        cameras.append(CameraEntry(file, name).make_camera(known_sizes[name], lens.matrix, lens.distortion, pose))
    return make_rig(folder, cameras)


def _find_by_number(folder: Path, name: re.Pattern[str]) -> dict[int, Path]:
    found = {int(match[1]): file for file in folder.iterdir() if (match := name.fullmatch(file.name))}
    return dict(sorted(found.items()))


def _read_sizes(folder: Path, names: list[str], sizes: SizeLookup | None) -> dict[str, Any]:
    """Read image sizes from Res.dat, which has width and height of one camera per line."""
    file = folder / "Res.dat"
    if not file.is_file():
        return lookup_sizes(folder, names, sizes)
    with input_errors(file):
        rows = (
            Entry(file).parse_numbers(read_text(file), 2 * len(names), "width and height of each camera").reshape(-1, 2)
        )
        if (rows != rows.round()).any() or (rows < 1).any() or (rows > 2**16).any():
            raise ValueError("widths and heights must be whole numbers of pixels")
    return {name: (int(row[0]), int(row[1])) for name, row in zip(names, rows, strict=True)}


def decompose_projection(projection: FloatArray, where: str) -> tuple[FloatArray, RigidTransform]:
    """Decompose (3, 4) P = K [R t], up to its scale, into K, possibly with skew, and the pose camera_from_world.

    Raises:
        ValueError: beginning with `where`, for a matrix that is not that of a camera with a center.
    """
    left = projection[:, :3]
    if not abs(np.linalg.det(left)) > 1e-12 * np.abs(left).max() ** 3:
        raise ValueError(f"{where}: the projection matrix is invalid: its left 3x3 part is singular")
    sign = np.sign(np.linalg.det(left))
    matrix, rotation_matrix = rq(sign * left)
    signs = np.diag(np.sign(np.diag(matrix)))
    matrix, rotation_matrix = matrix @ signs, signs @ rotation_matrix
    center = -np.linalg.solve(left, projection[:, 3])
    rotation = Rotation.from_matrix(rotation_matrix)
    return matrix / matrix[2, 2], RigidTransform.from_components(-rotation.apply(center), rotation)


def _read_lens_values(file: Path) -> dict[str, str]:
    """Return the values of a .rad file's lines `KEY = VALUE`, of one word each."""
    pairs = (line.partition("=") for line in read_text(file).split("\n"))
    return {key.strip(): value.strip() for key, _, value in pairs if len(value.split()) == 1}


def _fit_lens(file: Path | None, intrinsics: FloatArray, size: tuple[int, int], where: str) -> FittedLens:
    """Fit the lens of a camera with intrinsics `intrinsics`, including a .rad file's distortion."""
    if file is not None:
        value = _read_lens_values(file)
        if missing := [key for key in _LENS_KEYS if key not in value]:
            raise ValueError(f"{file}: missing {', '.join(missing)}")
        numbers = Entry(file).parse_numbers([value[key] for key in _LENS_KEYS], len(_LENS_KEYS), "K and kc")
        fx, skew, cx, fy, cy, *kc = numbers
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


# DeepLabCut


# Maximum bytes (choice: ten times those of a pair of cameras).
MAX_PICKLE = 2**16
STEREO_FILE = "stereo_params.pickle"
_INTRINSIC_SUFFIX = "_intrinsic_params.pickle"
_PAIR_KEYS = ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "R", "T")


def is_pickle(path: Path) -> bool:
    """Return whether a file has the suffix of a pickle."""
    return path.suffix.lower() in (".pickle", ".pkl")


def read_deeplabcut(_: Any, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of the file, or of the stereo_params.pickle next to the file of a single camera.

    Raises:
        ValueError: naming the file: not such a pickle, content other than numbers, or no pair of cameras.
    """
    if path.name.endswith(_INTRINSIC_SUFFIX):
        stereo = path.with_name(STEREO_FILE)
        if not stereo.is_file():
            raise ValueError(
                f"{path}: this is DeepLabCut's file of a single camera; {STEREO_FILE}, with both, is not next to it"
            )
        path = stereo
    data = load_safely(read_bytes(path, MAX_PICKLE))
    pairs = {key: value for key, value in data.items() if isinstance(value, dict)} if isinstance(data, dict) else {}
    if len(pairs) != 1 or not all(isinstance(key, str) for key in pairs):
        raise ValueError(f"{path}: a pickle, but not DeepLabCut's {STEREO_FILE} with a pair of cameras")
    ((key, pair),) = pairs.items()
    if missing := [name for name in _PAIR_KEYS if pair.get(name) is None]:
        raise ValueError(f"{path}: a pickle without {', '.join(missing)} of DeepLabCut's {STEREO_FILE}")
    names = _split_names(key, path)
    values = [getattr(pair[name], "value", None) for name in _PAIR_KEYS]
    if any(value is None for value in values):
        raise ValueError(f"{path}: {', '.join(_PAIR_KEYS)} must be arrays")
    shape, given_sizes = pair.get("image_shape"), {}
    if isinstance(shape, (list, tuple)) and len(shape) == 2:
        given_sizes = {
            name: Entry(path).parse_numbers(size, 2, "image_shape") for name, size in zip(names, shape, strict=True)
        }
    known_sizes = lookup_sizes(path, names, sizes, given_sizes)
    first, second = (CameraEntry(path, name) for name in names)
    matrix_1, lens_1, matrix_2, lens_2, rotation, translation = values
    cameras = [
        first.make_camera(known_sizes[names[0]], matrix_1, lens_1, RigidTransform.identity()),
        second.make_camera(known_sizes[names[1]], matrix_2, lens_2, second.make_pose(rotation, translation)),
    ]
    return make_rig(path, cameras)


def _split_names(key: str, path: Path) -> list[str]:
    """Split a pair's key, two names joined by a dash: by the cameras' own files, or else in its middle."""
    single_names = sorted(
        file.name.removesuffix(_INTRINSIC_SUFFIX) for file in path.parent.glob(f"*{_INTRINSIC_SUFFIX}")
    )
    for first in single_names:
        if key.startswith(f"{first}-") and key.removeprefix(f"{first}-") in single_names:
            return [first, key.removeprefix(f"{first}-")]
    parts = key.split("-")
    half = len(parts) // 2
    if len(parts) % 2:
        raise ValueError(f"{path}: the camera names in {key!r} are ambiguous without their {_INTRINSIC_SUFFIX} files")
    return ["-".join(parts[:half]), "-".join(parts[half:])]
