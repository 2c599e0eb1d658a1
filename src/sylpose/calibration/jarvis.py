"""JARVIS' folder of calibrations: a file of OpenCV's YAML for each camera, Camera_T.yaml.

Its matrices are for points that stand as rows: [X 1] [R; T] K, so that R and intrinsicMatrix are the transposes of ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sylpose.calibration.camera_builder import Sizes, make_camera, make_pose, make_rig, numbers, plain, sizes_of
from sylpose.calibration.sniffing import documents_beside
from sylpose.rig import Rig

__all__ = ["is_jarvis", "read"]


def is_jarvis(data: Any) -> bool:
    """Whether a decoded file has a camera by JARVIS' names."""
    return isinstance(data, dict) and {"intrinsicMatrix", "distortionCoefficients"} <= data.keys()


def read(_: Any, path: Path, sizes: Sizes | None = None) -> Rig:
    """The rig of all such files in the folder; cameras are called as their files are.

    Raises:
        ValueError: naming the file.
    """
    found = {file.stem: (file, data) for file, data in documents_beside(path, "intrinsicMatrix") if is_jarvis(data)}
    for file, data in found.values():
        if not {"R", "T"} <= data.keys():
            raise ValueError(f"{file}: this is a JARVIS file of intrinsics alone; those with R and T, too, are needed")
    known = sizes_of(path, list(found), sizes)
    cameras = []
    for name, (file, data) in found.items():
        where = f"{file}: camera {name}"
        matrix, turn = (
            np.reshape(numbers(plain(data[key], f"{where}: {key}"), 9, f"{where}: {key}"), (3, 3)).T
            for key in ("intrinsicMatrix", "R")
        )
        cameras.append(
            make_camera(
                file,
                name,
                size=known[name],
                matrix=matrix,
                distortion=plain(data["distortionCoefficients"], f"{where}: distortionCoefficients"),
                camera_from_world=make_pose(file, name, turn, plain(data["T"], f"{where}: T")),
                lens="opencv",
            )
        )
    return make_rig(path.parent, cameras)
