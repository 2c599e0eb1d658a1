"""Caliscope's `camera_array.toml`: one table `[cameras.N]` per camera, N a number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sylpose.io.calibration.anipose import CameraTable, make_table_camera
from sylpose.io.calibration.camera_builder import convert_table, make_rig
from sylpose.rig import Rig

__all__ = ["is_caliscope", "read"]


def is_caliscope(data: dict[str, Any]) -> bool:
    """Return whether decoded TOML looks like Caliscope's: a table `cameras` whose keys are numbers."""
    cameras = data.get("cameras")
    return isinstance(cameras, dict) and all(key.isdecimal() for key in cameras)


def read(data: dict[str, Any], path: Path) -> Rig:
    """Read the rig; camera N is named cam_N, as Caliscope names its videos; cameras with `ignore = true` are skipped.

    Rotations are matrices in older files and rotation vectors in newer ones. `rotation_count` only rotates Caliscope's
    display and is not used.

    Raises:
        ValueError: invalid content; the message names file and camera.
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
        cameras.append(make_table_camera(path, name, convert_table(table, CameraTable, f"{path}: camera {name}")))
    if not cameras:
        raise ValueError(f"{path}: no camera in this Caliscope file: [cameras.0], ... without ignore = true are needed")
    return make_rig(path, cameras)
