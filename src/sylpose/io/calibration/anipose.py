"""Anipose's `calibration.toml` (aniposelib, Pose2Sim, Caliscope's export): one table per camera, and `[metadata]`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from sylpose.atomic_io import format_toml_string
from sylpose.io.calibration.camera_builder import convert_table, make_camera, make_pose, make_rig
from sylpose.rig import Camera, Rig

__all__ = ["CameraTable", "is_anipose", "make_table_camera", "read", "to_text"]


class CameraTable(msgspec.Struct):
    """Camera table as written by Anipose and Caliscope."""

    size: tuple[float, float]
    matrix: list[list[float]]
    distortions: list[float | list[float]]
    rotation: list[float | list[float]]
    translation: list[float | list[float]]
    fisheye: bool = False
    error: float | None = None


class _NamedTable(CameraTable):
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
        entry = convert_table(table_with_error, _NamedTable, f"{path}: camera {key}")
        cameras.append(make_table_camera(path, entry.name or key, entry))
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


def make_table_camera(path: Path, name: str, table: CameraTable) -> Camera:
    """Build the camera of a table.

    Raises:
        ValueError: invalid content; the message names file and camera.
    """
    return make_camera(
        path,
        name,
        size=table.size,
        matrix=table.matrix,
        distortion=table.distortions,
        camera_from_world=make_pose(path, name, table.rotation, table.translation),
        lens="fisheye" if table.fisheye else "opencv",
        error_px=table.error,
    )
