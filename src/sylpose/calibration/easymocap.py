"""EasyMocap's intri.yml (K_01, dist_01) and extri.yml (Rot_01 or R_01, T_01): X_camera = R X_world + T, OpenCV's lens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sylpose.calibration.camera_builder import Sizes, make_camera, make_pose, make_rig, plain, sizes_of
from sylpose.calibration.sniffing import beside, plain_of
from sylpose.rig import Rig

__all__ = ["is_easymocap", "read"]


def is_easymocap(data: Any) -> bool:
    """Whether a decoded file has the names of cameras, and values of these names."""
    return isinstance(data, dict) and "names" in data and any(key.startswith(("K_", "Rot_", "R_")) for key in data)


def read(data: dict[str, Any], path: Path, sizes: Sizes | None = None) -> Rig:
    """The rig of the file and the other one of the two beside it.

    Raises:
        ValueError: naming the file, and the camera where there is one.
    """
    for part, other, key, what in (("intri", "extri", "T_", "poses"), ("extri", "intri", "K_", "lenses")):
        if not any(name.startswith(key) for name in data):
            file = beside(path, part, other)
            if file is None:
                raise ValueError(
                    f"{path}: this is one of EasyMocap's two files; the {what} are in {other}.yml, not beside it"
                )
            found = plain_of(file)
            data = data | (found if isinstance(found, dict) else {})
    # Not by `names`, in which a number may have lost its zeros.
    names = [key.removeprefix("K_") for key in data if key.startswith("K_")]
    if not names:
        raise ValueError(f"{path}: no camera's K_ in EasyMocap's intri.yml")
    said = {name: [data[f"W_{name}"], data[f"H_{name}"]] for name in names if {f"W_{name}", f"H_{name}"} <= data.keys()}
    known: dict[str, Any] = said if len(said) == len(names) else {**sizes_of(path, names, sizes), **said}
    cameras = []
    for name in names:
        turn = f"Rot_{name}" if f"Rot_{name}" in data else f"R_{name}"
        if lacking := [key for key in (f"dist_{name}", turn, f"T_{name}") if data.get(key) is None]:
            raise ValueError(f"{path}: camera {name}: missing {', '.join(lacking)}")
        values = {key: plain(data[key], f"{path}: {key}") for key in (f"K_{name}", f"dist_{name}", turn, f"T_{name}")}
        matrix, lens, rotation, translation = values.values()
        cameras.append(
            make_camera(
                path,
                name,
                size=known[name],
                matrix=matrix,
                distortion=lens,
                camera_from_world=make_pose(path, name, rotation, translation),
                lens="opencv",
            )
        )
    return make_rig(path, cameras)
