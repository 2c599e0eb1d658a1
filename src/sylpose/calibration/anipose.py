"""Anipose's `calibration.toml` (aniposelib, Pose2Sim, Caliscope's export): a table per camera beside `[metadata]`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from sylpose.calibration.build import convert, make_camera, make_pose, make_rig
from sylpose.rig import Rig

__all__ = ["is_anipose", "read"]


class _Camera(msgspec.Struct):
    size: tuple[float, float]
    matrix: list[list[float]]
    distortions: list[float | list[float]]
    rotation: list[float | list[float]]
    translation: list[float | list[float]]
    name: str | None = None
    fisheye: bool = False


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
    for key, table in data.items():
        if key == "metadata":
            continue
        entry = convert(table, _Camera, f"{path}: camera {key}")
        name = entry.name or key
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
