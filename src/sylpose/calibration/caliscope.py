"""Caliscope's `camera_array.toml`: a table `[cameras.N]` per camera, N a number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from sylpose.calibration.build import convert, make_camera, make_pose, make_rig
from sylpose.rig import Rig

__all__ = ["is_caliscope", "read"]


class _Camera(msgspec.Struct):
    size: tuple[float, float]
    matrix: list[list[float]]
    distortions: list[float | list[float]]
    rotation: list[float | list[float]]
    translation: list[float | list[float]]
    fisheye: bool = False


def is_caliscope(data: dict[str, Any]) -> bool:
    """Whether a TOML file's content looks like Caliscope's: a table `cameras` whose keys are numbers."""
    cameras = data.get("cameras")
    return isinstance(cameras, dict) and all(key.isdecimal() for key in cameras)


def read(data: dict[str, Any], path: Path) -> Rig:
    """The rig; camera N is named cam_N, as Caliscope names its videos; cameras with `ignore = true` are left out.

    Rotations are matrices in older files and rotation vectors in newer ones. `rotation_count` turns Caliscope's
    display only and is not used.

    Raises:
        ValueError: naming file and camera.
    """
    cameras = []
    for number, table in data["cameras"].items():
        name = f"cam_{number}"
        if not isinstance(table, dict):
            raise ValueError(f"{path}: camera {name}: expected a table [cameras.{number}]")
        # Older versions write "null" where there is no value.
        table = {key: value for key, value in table.items() if value != "null"}
        if table.get("ignore") is True:
            continue
        if not {"rotation", "translation"} <= table.keys():
            raise ValueError(
                f"{path}: camera {name}: no rotation and translation: calibrate its pose in Caliscope, "
                "or write ignore = true to leave it out"
            )
        entry = convert(table, _Camera, f"{path}: camera {name}")
        cameras.append(
            make_camera(
                path,
                name,
                size=entry.size,
                matrix=entry.matrix,
                distortion=entry.distortions,
                camera_from_world=make_pose(path, name, entry.rotation, entry.translation),
                lens="fisheye" if entry.fisheye else "opencv",
            )
        )
    return make_rig(path, cameras)
