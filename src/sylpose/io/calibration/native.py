"""sylpose's own TOML: descriptive keys, the length unit, and numbers that load exactly as saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from sylpose.atomic_io import format_toml_key, format_toml_string
from sylpose.io.calibration.camera_builder import CameraEntry, Entry, make_rig
from sylpose.rig import Camera, LensModel, Rig

FORMAT_NAME = "sylpose-calibration-1"

_HEADER = """\
# Cameras of a rig, for sylpose.
# Pixels: the center of the top-left pixel is (0, 0). Sizes: width, height.
# camera_from_world: X_camera = rotation X_world + translation; the camera looks along z, x to the right, y down.
# distortion: OpenCV's coefficients, k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]; k1 k2 k3 k4 for lens "fisheye".
# error_px: rms reprojection error of the calibration; omitted if unknown.
# unit: of all lengths; "" if unknown.
"""


class _Pose(msgspec.Struct, forbid_unknown_fields=True):
    rotation: list[float | list[float]]
    translation: list[float]


class _Camera(msgspec.Struct, forbid_unknown_fields=True):
    size: tuple[float, float]
    matrix: list[list[float]]
    distortion: list[float]
    camera_from_world: _Pose
    lens: LensModel = "opencv"
    error_px: float | None = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    cameras: dict[str, Any]
    unit: str = ""


def read(data: dict[str, Any], path: Path) -> Rig:
    """Read the rig.

    Raises:
        ValueError: naming the file, and the camera if applicable; also for an unknown format version.
    """
    if data["format"] != FORMAT_NAME:
        raise ValueError(f"{path}: the format is {data['format']!r}; this version of sylpose reads {FORMAT_NAME!r}")
    file = Entry(path).convert_table(data, _File)
    cameras = []
    for name, table in file.cameras.items():
        entry = CameraEntry(path, name)
        camera = entry.convert_table(table, _Camera)
        pose = entry.make_pose(camera.camera_from_world.rotation, camera.camera_from_world.translation)
        cameras.append(
            entry.make_camera(camera.size, camera.matrix, camera.distortion, pose, camera.lens, camera.error_px)
        )
    return make_rig(path, cameras, file.unit)


def to_text(rig: Rig) -> str:
    """Format the rig as TOML; `read` returns the same rig, bit for bit."""
    head = f"{_HEADER}\nformat = {format_toml_string(FORMAT_NAME)}\nunit = {format_toml_string(rig.unit)}\n"
    return head + "".join(_format_table(camera) for camera in rig)


def _format_table(camera: Camera) -> str:
    pose = camera.camera_from_world.as_matrix()
    error_line = "" if camera.error_px is None else f"error_px = {camera.error_px!r}\n"
    return f"""
[cameras.{format_toml_key(camera.name)}]
size = {list(camera.size)}
lens = {format_toml_string(camera.lens)}
matrix = {_format_rows(camera.matrix)}
distortion = {camera.distortion.tolist()}
{error_line}
[cameras.{format_toml_key(camera.name)}.camera_from_world]
rotation = {_format_rows(pose[:3, :3])}
translation = {pose[:3, 3].tolist()}
"""


def _format_rows(matrix: Any) -> str:
    # Python's repr of a float is the shortest text that reads back exactly, and valid TOML.
    return "[\n" + "".join(f"    {row},\n" for row in matrix.tolist()) + "]"
