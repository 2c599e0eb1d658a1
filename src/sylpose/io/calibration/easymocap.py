"""EasyMocap's intri.yml (K_01, dist_01) and extri.yml (Rot_01 or R_01, T_01).

X_camera = R X_world + T, with OpenCV's lens.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sylpose.io.calibration.camera_builder import SizeLookup, lookup_sizes, make_camera, make_pose, make_rig, to_plain
from sylpose.io.calibration.sniffing import find_sibling_file, read_plain
from sylpose.rig import Rig

__all__ = ["is_easymocap", "read"]


def is_easymocap(data: Any) -> bool:
    """Return whether a decoded file has the names of cameras, and values of these names."""
    return isinstance(data, dict) and "names" in data and any(key.startswith(("K_", "Rot_", "R_")) for key in data)


def read(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
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
    known_sizes: dict[str, Any] = (
        given_sizes if len(given_sizes) == len(names) else {**lookup_sizes(path, names, sizes), **given_sizes}
    )
    cameras = []
    for name in names:
        rotation_key = f"Rot_{name}" if f"Rot_{name}" in data else f"R_{name}"
        if missing := [key for key in (f"dist_{name}", rotation_key, f"T_{name}") if data.get(key) is None]:
            raise ValueError(f"{path}: camera {name}: missing {', '.join(missing)}")
        values = {
            key: to_plain(data[key], f"{path}: {key}")
            for key in (f"K_{name}", f"dist_{name}", rotation_key, f"T_{name}")
        }
        matrix, lens, rotation, translation = values.values()
        cameras.append(
            make_camera(
                path,
                name,
                size=known_sizes[name],
                matrix=matrix,
                distortion=lens,
                camera_from_world=make_pose(path, name, rotation, translation),
                lens="opencv",
            )
        )
    return make_rig(path, cameras)
