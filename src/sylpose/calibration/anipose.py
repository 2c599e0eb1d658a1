"""Anipose's `calibration.toml` (aniposelib, Pose2Sim, Caliscope's export): a table per camera beside `[metadata]`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from sylpose.atomic_io import toml_string
from sylpose.calibration.camera_builder import convert, make_camera, make_pose, make_rig
from sylpose.rig import Camera, Rig

__all__ = ["CameraTable", "camera_of", "is_anipose", "read", "to_text"]


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


def to_text(rig: Rig) -> str:
    """The file's text. Every number is as it was; rotations are vectors, as Anipose has them."""
    return "".join(_table(i, camera) for i, camera in enumerate(rig)) + "[metadata]\nadjusted = false\n"


def _table(i: int, camera: Camera) -> str:
    pose = camera.camera_from_world
    error = "" if camera.error_px is None else f"error = {camera.error_px!r}\n"
    return f"""[cam_{i}]
name = {toml_string(camera.name)}
size = {list(camera.size)}
matrix = {camera.matrix.tolist()}
distortions = {camera.distortion.tolist()}
rotation = {pose.rotation.as_rotvec().tolist()}
translation = {pose.translation.tolist()}
fisheye = {str(camera.lens == "fisheye").lower()}
{error}
"""


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
