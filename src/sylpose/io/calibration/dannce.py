"""DANNCE's Matlab files: hires_cam1_params.mat, ... of each camera, or one file of Label3D with all cameras.

K, r and t apply to row vectors, [X 1] [r; t] K, so that K and r are the transposes of OpenCV's. Matlab's first pixel
is (1, 1). Lengths are millimeters, as DANNCE requires. Label3D's exports for DANNCE have `params`, or `camParams` as its
own files, which also have imageSize (rows, columns). Files of version 7.3 are HDF5 and need h5py.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from sylpose.input_limits import input_errors
from sylpose.io.calibration.camera_builder import CameraEntry, SizeLookup, lookup_sizes, make_rig
from sylpose.io.calibration.markup import MAX_FILES
from sylpose.io.calibration.matlab_format import is_version_73, read_variables
from sylpose.io.calibration.matlab_hdf5 import read_hdf5_variables
from sylpose.rig import Camera, Rig

_SINGLE_FILE = re.compile(r"(?:.*_)?cam(?:era)?_?([0-9]{1,4})_params\.mat", re.IGNORECASE)
_CAMERA_CELLS = ("params", "camParams")
_VARIABLES = (*_CAMERA_CELLS, "camnames", "imageSize", "K", "r", "R", "t", "RDistort", "TDistort", "m")
_LENS_KEYS = ("K", "t", "RDistort", "TDistort")


def is_dannce(path: Path) -> bool:
    """Return whether a file is a Matlab file of a camera's parameters, or is named like one."""
    is_single = _SINGLE_FILE.fullmatch(path.name) is not None
    return is_single or (path.suffix.lower() == ".mat" and set(_LENS_KEYS) <= _read_if_matlab(path).keys())


def is_label3d(path: Path) -> bool:
    """Return whether a file is a Matlab file with Label3D's cameras, or one of version 7.3, whose reader explains it."""
    if path.suffix.lower() != ".mat" or not path.is_file():
        return False
    return (
        is_version_73(path) or "label3d" in path.name.lower() or bool(set(_CAMERA_CELLS) & _read_if_matlab(path).keys())
    )


def read_dannce(_: object, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of all such files in the folder; camera N is named CameraN, as DANNCE names its videos' folders.

    Raises:
        ValueError: naming the file: a single camera's file without number, or invalid content.
    """
    matches = {file: _SINGLE_FILE.fullmatch(file.name) for file in sorted(path.parent.iterdir())}
    files = {file: int(match[1]) for file, match in matches.items() if match}
    if path not in files:
        raise ValueError(
            f"{path}: a file of one camera; DANNCE names them hires_cam1_params.mat, hires_cam2_params.mat, ..."
        )
    names = {file: f"Camera{number}" for file, number in sorted(files.items(), key=lambda item: item[1])[:MAX_FILES]}
    known_sizes = lookup_sizes(path, list(names.values()), sizes)
    cameras = []
    for file, name in names.items():
        with input_errors(file):
            cameras.append(_parse_camera(_read(file), CameraEntry(file, name), known_sizes[name]))
    return make_rig(path.parent, cameras, "mm")


def read_label3d(_: object, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig; cameras have the names in `camnames`, or Camera1, Camera2, ...

    Raises:
        ValueError: naming the file, and the camera if applicable: no structs of cameras, or invalid content.
    """
    data = _read(path)
    nodes = next((found for name in _CAMERA_CELLS if (found := _to_list(data.get(name)))), [])
    if not nodes or not all(isinstance(node, dict) for node in nodes):
        raise ValueError(f"{path}: Label3D's params or camParams must be a cell of structs with K, r, t, ...")
    names = [str(name) for name in _to_list(data.get("camnames"))] or [f"Camera{k}" for k in range(1, len(nodes) + 1)]
    if len(names) != len(nodes):
        raise ValueError(f"{path}: {len(nodes)} cameras in params and {len(names)} in camnames")
    given = {}
    if (image_sizes := data.get("imageSize")) is not None and np.size(image_sizes) in (2, 2 * len(names)):
        # One row (rows, columns) for each camera, or for all.
        given = dict(
            zip(names, np.broadcast_to(np.reshape(image_sizes, (-1, 2))[:, ::-1], (len(names), 2)), strict=True)
        )
    known_sizes = lookup_sizes(path, names, sizes, given)
    pairs = zip(names, nodes, strict=True)
    cameras = [_parse_camera(node, CameraEntry(path, name), known_sizes[name]) for name, node in pairs]
    return make_rig(path, cameras, "mm")


def _to_list(value: Any) -> list[Any]:
    """Return the elements of a cell or struct array; of a single struct, itself."""
    if value is None:
        return []
    return value if isinstance(value, list) else [value]


def _parse_camera(node: dict[str, Any], entry: CameraEntry, size: Any) -> Camera:
    node = node | ({"r": node["R"]} if "R" in node and "r" not in node else {})
    if missing := [key for key in (*_LENS_KEYS, "r") if key not in node]:
        raise entry.error(f"missing {', '.join(missing)} of DANNCE's parameters")
    if np.any(node.get("m", 0)):
        raise entry.error("views through a mirror (m = 1) are not supported")
    transposed = entry.parse_matrix(node["K"], "K")
    if transposed[:2, 2].any() or not transposed[2, :2].any():
        raise entry.error("K must be Matlab's, for row vectors: its last row has the principal point")
    matrix = transposed.T.copy()
    matrix[:2, 2] -= 1.0
    k, p = (
        entry.parse_numbers(node["RDistort"], (2, 3), "RDistort"),
        entry.parse_numbers(node["TDistort"], 2, "TDistort"),
    )
    pose = entry.make_pose(entry.parse_matrix(node["r"], "r").T, entry.parse_numbers(node["t"], 3, "t"))
    return entry.make_camera(size, matrix, [k[0], k[1], *p, *k[2:]], pose)


def _read(path: Path) -> dict[str, Any]:
    return read_hdf5_variables(path, _VARIABLES) if is_version_73(path) else read_variables(path)


def _read_if_matlab(path: Path) -> dict[str, Any]:
    """Return the variables of a Matlab file; none if it is not one that can be read."""
    try:
        return _read(path) if path.is_file() else {}
    except ValueError:
        return {}
