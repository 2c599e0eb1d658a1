"""TOML with one table per camera: Anipose's `calibration.toml` and Caliscope's `camera_array.toml`.

Anipose's (aniposelib, Pose2Sim, Caliscope's export) has tables `[cam_0]`, `[cam_1]`, ... and `[metadata]`; Caliscope's
has `[cameras.N]`, N a number. Older versions of Caliscope (pyxy3d) have `[cam_N]` in `config.toml`, next to tables of
boards, recording rates and pairs of cameras.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec

from sylpose.atomic_io import format_toml_string
from sylpose.io.calibration.camera_builder import CameraEntry, drop_zero_error, make_rig
from sylpose.rig import Camera, LensModel, Rig


class _CameraTable(msgspec.Struct):
    """Camera table as written by Anipose and Caliscope."""

    size: tuple[float, float]
    matrix: list[list[float]]
    distortions: list[float | list[float]]
    rotation: list[float | list[float]]
    translation: list[float | list[float]]
    fisheye: bool = False
    error: float | None = None


class _NamedTable(_CameraTable):
    name: str | None = None


def is_anipose(data: dict[str, Any]) -> bool:
    """Return whether decoded TOML looks like Anipose's: a table with some of its camera keys."""
    keys = {"size", "matrix", "distortions", "rotation", "translation"}
    return any(isinstance(table, dict) and len(keys & table.keys()) >= 2 for table in data.values())


def read(data: dict[str, Any], path: Path) -> Rig:
    """Read the rig; each table except `[metadata]` is a camera, named by its key `name` or else by the table.

    Raises:
        ValueError: invalid content; the message names file and camera.
    """
    cameras = []
    # Anipose stores one error for all cameras, in pixels.
    metadata = data.get("metadata")
    common_error = metadata.get("error") if isinstance(metadata, dict) else None
    for key, table in data.items():
        if key == "metadata":
            continue
        table_with_error = {"error": common_error} | table if isinstance(table, dict) else table
        camera = CameraEntry(path, key).convert_table(table_with_error, _NamedTable)
        cameras.append(_make_table_camera(CameraEntry(path, camera.name or key), camera))
    return make_rig(path, cameras)


def is_caliscope(data: dict[str, Any]) -> bool:
    """Return whether decoded TOML looks like Caliscope's: a table `cameras` whose keys are numbers, or older ones."""
    cameras = data.get("cameras")
    if isinstance(cameras, dict):
        return all(key.isdecimal() for key in cameras)
    # Only Caliscope numbers its cameras by `port` and turns its display by `rotation_count`.
    return any({"port", "rotation_count"} <= table.keys() for table in _find_config_tables(data).values())


def _find_config_tables(data: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the tables `[cam_N]` of Caliscope's older config.toml by N."""
    found = {match[1]: table for key, table in data.items() if (match := re.fullmatch(r"cam_([0-9]+)", key))}
    return {number: table for number, table in found.items() if isinstance(table, dict)}


def read_caliscope(data: dict[str, Any], path: Path) -> Rig:
    """Read the rig; camera N is named cam_N, as Caliscope names its videos; cameras with `ignore = true` are skipped.

    Rotations are matrices in older files and rotation vectors in newer ones. `rotation_count` only rotates Caliscope's
    display and is not used.

    Raises:
        ValueError: invalid content; the message names file and camera.
    """
    cameras = []
    for number, table in data.get("cameras", _find_config_tables(data)).items():
        entry = CameraEntry(path, f"cam_{number}")
        if not isinstance(table, dict):
            raise entry.error(f"expected a table [cameras.{number}]")
        # Older versions write "null" where there is no value.
        table = {key: value for key, value in table.items() if value != "null"}
        if table.get("ignore") is True:
            continue
        if not {"rotation", "translation"} <= table.keys():
            raise entry.error(
                "no rotation and translation: calibrate its pose in Caliscope, or write ignore = true to leave it out"
            )
        cameras.append(_make_table_camera(entry, entry.convert_table(table, _CameraTable)))
    if not cameras:
        raise ValueError(f"{path}: no camera in this Caliscope file: [cameras.0], ... without ignore = true are needed")
    return make_rig(path, cameras)


def to_text(rig: Rig) -> str:
    """Format the rig as TOML with exact numbers; rotations are vectors, as in Anipose."""
    return "".join(_format_table(i, camera) for i, camera in enumerate(rig)) + "[metadata]\nadjusted = false\n"


def _format_table(i: int, camera: Camera) -> str:
    pose = camera.camera_from_world
    error = "" if camera.error_px is None else f"error = {camera.error_px!r}\n"
    return f"""[cam_{i}]
name = {format_toml_string(camera.name)}
size = {list(camera.size)}
matrix = {camera.matrix.tolist()}
distortions = {camera.distortion.tolist()}
rotation = {pose.rotation.as_rotvec().tolist()}
translation = {pose.translation.tolist()}
fisheye = {str(camera.lens == "fisheye").lower()}
{error}
"""


def _make_table_camera(entry: CameraEntry, table: _CameraTable) -> Camera:
    pose = entry.make_pose(table.rotation, table.translation)
    lens: LensModel = "fisheye" if table.fisheye else "opencv"
    return entry.make_camera(table.size, table.matrix, table.distortions, pose, lens, drop_zero_error(table.error))
