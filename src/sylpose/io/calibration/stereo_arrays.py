"""Stereo calibrations as named arrays: .npz (VIAME, or numpy.savez of OpenCV's results) and Matlab's .mat.

Arrays have OpenCV's names (`stereo`), such as cameraMatrixL, distCoeffsL, ..., R and T. Bouguet's Matlab toolbox
(Calib_Results_stereo.mat) has fc_left, cc_left, alpha_c_left, kc_left, ..., om or R, T, nx and ny; its first pixel is
(0, 0), its lens OpenCV's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sylpose.input_limits import MAX_TEXT_BYTES, open_regular_file
from sylpose.io.calibration import stereo
from sylpose.io.calibration.camera_builder import Entry, SizeLookup
from sylpose.io.calibration.matlab_format import read_variables
from sylpose.io.object_files import read_npz
from sylpose.rig import Rig

_SIDES = ("left", "right")
_BOUGUET_KEYS = tuple(f"{key}_{side}" for side in _SIDES for key in ("fc", "cc", "kc"))


def is_stereo_arrays(path: Path) -> bool:
    """Return whether a file has arrays of two cameras, under OpenCV's or Bouguet's names."""
    if path.suffix.lower() not in (".npz", ".mat") or not path.is_file():
        return False
    try:
        data = _load(path)
    except ValueError:
        return False
    return stereo.count_matrices(data) > 1 or set(_BOUGUET_KEYS) <= data.keys()


def read_stereo_arrays(_: object, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig; its world is the first camera's frame.

    Raises:
        ValueError: as `stereo.read`.
    """
    data = _load(path)
    return stereo.read(_convert_bouguet(data, path) if set(_BOUGUET_KEYS) <= data.keys() else data, path, sizes)


def _load(path: Path) -> dict[str, Any]:
    """Return the arrays of a file as lists, and those in the struct Cal, by their names."""
    if path.suffix.lower() == ".mat":
        data = read_variables(path)
    else:
        with open_regular_file(path, MAX_TEXT_BYTES) as file:
            data = dict(read_npz(file, MAX_TEXT_BYTES, by_columns=True))
    data |= data["Cal"] if isinstance(data.get("Cal"), dict) else {}
    return {name: value.tolist() for name, value in data.items() if isinstance(value, np.ndarray)}


def _convert_bouguet(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the same calibration under OpenCV's names."""
    where, found = Entry(path), {"R": data.get("R", data.get("om")), "T": data.get("T")}
    for side in _SIDES:
        (fx, fy), (cx, cy) = (where.parse_numbers(data[f"{key}_{side}"], 2, f"{key}_{side}") for key in ("fc", "cc"))
        skew = where.parse_number(np.ravel(data.get(f"alpha_c_{side}", 0.0))[0], f"alpha_c_{side}")
        found[f"cameraMatrix_{side}"] = [[fx, skew * fx, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        found[f"distCoeffs_{side}"] = data[f"kc_{side}"]
    if {"nx", "ny"} <= data.keys():
        found["image_size"] = where.parse_numbers([data["nx"], data["ny"]], 2, "nx and ny").tolist()
    return {key: value for key, value in found.items() if value is not None}
