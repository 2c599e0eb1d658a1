"""JARVIS calibration folder: one OpenCV YAML file per camera, Camera_T.yaml.

Its matrices apply to row vectors: [X 1] [R; T] K. So R and intrinsicMatrix are the transposes of OpenCV's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sylpose.io.calibration.camera_builder import (
    SizeLookup,
    lookup_sizes,
    make_camera,
    make_pose,
    make_rig,
    parse_numbers,
    to_plain,
)
from sylpose.io.calibration.sniffing import read_folder_documents
from sylpose.rig import Rig

__all__ = ["is_jarvis", "read"]


def is_jarvis(data: Any) -> bool:
    """Return whether a decoded file has a camera with JARVIS' keys."""
    return isinstance(data, dict) and {"intrinsicMatrix", "distortionCoefficients"} <= data.keys()


def read(_: Any, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of all such files in the folder; cameras are named after their files.

    Raises:
        ValueError: invalid content; the message names the file.
    """
    found = {
        file.stem: (file, data) for file, data in read_folder_documents(path, "intrinsicMatrix") if is_jarvis(data)
    }
    for file, data in found.values():
        if not {"R", "T"} <= data.keys():
            raise ValueError(
                f"{file}: this is a JARVIS file of intrinsics alone; files that include R and T are required"
            )
    known_sizes = lookup_sizes(path, list(found), sizes)
    cameras = []
    for name, (file, data) in found.items():
        where = f"{file}: camera {name}"
        matrix, rotation = (
            np.reshape(parse_numbers(to_plain(data[key], f"{where}: {key}"), 9, f"{where}: {key}"), (3, 3)).T
            for key in ("intrinsicMatrix", "R")
        )
        cameras.append(
            make_camera(
                file,
                name,
                size=known_sizes[name],
                matrix=matrix,
                distortion=to_plain(data["distortionCoefficients"], f"{where}: distortionCoefficients"),
                camera_from_world=make_pose(file, name, rotation, to_plain(data["T"], f"{where}: T")),
                lens="opencv",
            )
        )
    return make_rig(path.parent, cameras)
