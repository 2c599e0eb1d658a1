"""mrcal's .cameramodel files, one of each camera. Lenses are OpenCV's; lengths are meters.

The file is a Python dict with comments, of which only literals are evaluated: lensmodel; intrinsics fx fy cx cy and
distortion; extrinsics, the rotation vector and translation of the camera's pose camera_from_reference; imagersize.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

from sylpose.input_limits import MAX_TEXT_BYTES, input_errors, read_text
from sylpose.io.calibration.camera_builder import CameraEntry, intrinsic_matrix, make_rig
from sylpose.io.calibration.markup import MAX_FILES
from sylpose.rig import Camera, Rig

# Bytes of a file with all observations of its calibration (choice: ten times those of a large one).
MAX_FILE_BYTES = 2**27
# Number of distortion terms of the lens models that OpenCV has.
_TERMS = {"PINHOLE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}
# Observations of the calibration, as text of base 85, which are not used.
_OBSERVATIONS = re.compile(r"""(['"]optimization_inputs['"]\s*:)\s*b?(?:'[^'\n]*'|"[^"\n]*")""")


def is_mrcal(path: Path) -> bool:
    """Return whether a file has the suffix of mrcal's models."""
    return path.suffix.lower() == ".cameramodel"


def read_mrcal(_: object, path: Path) -> Rig:
    """Read the rig of all models in the file's folder, named by their files.

    Raises:
        ValueError: naming the file: no such dict, a lens model that OpenCV does not have, or an invalid value.
    """
    files = [file for file in sorted(path.parent.iterdir()) if is_mrcal(file) and file.is_file()]
    cameras = []
    for file in files[:MAX_FILES]:
        with input_errors(file):
            cameras.append(_parse_camera(_read_model(file), CameraEntry(file, file.stem)))
    return make_rig(path.parent, cameras, "m")


def _read_model(path: Path) -> dict[str, Any]:
    text = _OBSERVATIONS.sub(r"\1 None", read_text(path, MAX_FILE_BYTES))
    if len(text) > MAX_TEXT_BYTES:
        raise ValueError(f"{len(text)} characters apart from optimization_inputs, more than {MAX_TEXT_BYTES}")
    try:
        data = ast.literal_eval(text.strip())
    except (SyntaxError, TypeError, ValueError, MemoryError, RecursionError):
        raise ValueError("not a Python dict of literals, as mrcal writes it") from None
    if not isinstance(data, dict):
        raise ValueError("not a Python dict, as mrcal writes it")
    return data


def _parse_camera(data: dict[str, Any], entry: CameraEntry) -> Camera:
    # Old versions write distortion_model, newer ones rt_cam_ref.
    model = str(data.get("lensmodel", data.get("distortion_model", ""))).split("_", 1)[-1]
    if model in ("", "NONE"):
        model = "PINHOLE" if model else model
    extrinsics = next((data[key] for key in ("extrinsics", "rt_cam_ref") if data.get(key) is not None), None)
    values = {"lensmodel": model or None, "intrinsics": data.get("intrinsics"), "extrinsics": extrinsics}
    if missing := [key for key, value in (values | {"imagersize": data.get("imagersize")}).items() if value is None]:
        raise entry.error(f"missing {', '.join(missing)} of mrcal's model")
    if model not in _TERMS:
        raise entry.error(
            f"mrcal's lens model {model} is not one of OpenCV's ({', '.join(_TERMS)}); convert it with "
            "mrcal-convert-lensmodel LENSMODEL_OPENCV8"
        )
    fx, fy, cx, cy, *terms = entry.parse_numbers(values["intrinsics"], 4 + _TERMS[model], f"intrinsics of {model}")
    pose = entry.parse_numbers(extrinsics, 6, "extrinsics")
    size = entry.parse_numbers(data["imagersize"], 2, "imagersize")
    return entry.make_camera(size, intrinsic_matrix(fx, fy, cx, cy), terms, entry.make_pose(pose[:3], pose[3:]))
