"""Anipose's `calibration.toml` (aniposelib, Pose2Sim, Caliscope's export): a table per camera beside `[metadata]`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from sylpose.calibration.build import convert, make_camera, make_pose, make_rig
from sylpose.rig import Camera, Rig

__all__ = ["CameraTable", "camera_of", "is_anipose", "read"]


class CameraTable(msgspec.Struct):
    """A camera as Anipose and Caliscope write it."""

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
    """Whether a TOML file's content looks like Anipose's: a table that has some of its cameras' keys."""
    keys = {"size", "matrix", "distortions", "rotation", "translation"}
    return any(isinstance(table, dict) and len(keys & table.keys()) >= 2 for table in data.values())


def read(data: dict[str, Any], path: Path) -> Rig:
    """The rig; each table but `[metadata]` is a camera, named by its key `name` or else by the table.

    Raises:
        ValueError: naming file and camera.
    """
    cameras = []
    # Anipose says one error for all cameras, in pixels.
    metadata = data.get("metadata")
    whole = metadata.get("error") if isinstance(metadata, dict) else None
    for key, table in data.items():
        if key == "metadata":
            continue
        told = {"error": whole} | table if isinstance(table, dict) else table
        entry = convert(told, _NamedTable, f"{path}: camera {key}")
        cameras.append(camera_of(path, entry.name or key, entry))
    return make_rig(path, cameras)


def camera_of(path: Path, name: str, table: CameraTable) -> Camera:
    """The camera of a table.

    Raises:
        ValueError: naming file and camera.
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
