"""sylpose's own TOML: names that say what they mean, the length unit, and numbers that load exactly as saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from sylpose.atomic_io import toml_key, toml_string
from sylpose.calibration.camera_builder import convert, make_camera, make_pose, make_rig
from sylpose.rig import Camera, LensModel, Rig

__all__ = ["FORMAT", "read", "to_text"]

FORMAT = "sylpose-calibration-1"

_HEADER = """\
# Cameras of a rig, for sylpose.
# Pixels: the centre of the top-left pixel is (0, 0). Sizes: width, height.
# camera_from_world: X_camera = rotation X_world + translation; the camera looks along z, x to the right, y down.
# distortion: OpenCV's coefficients, k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]; k1 k2 k3 k4 for lens "fisheye".
# error_px: of the calibration itself, rms reprojection; left out where it is not known.
# unit: of all lengths; "" when it is not known.
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
    """The rig.

    Raises:
        ValueError: naming the file, and the camera where there is one; for a format version that is not known too.
    """
    if data["format"] != FORMAT:
        raise ValueError(f"{path}: the format is {data['format']!r}; this version of sylpose reads {FORMAT!r}")
    file = convert(data, _File, str(path))
    cameras = []
    for name, table in file.cameras.items():
        entry = convert(table, _Camera, f"{path}: camera {name}")
        pose = entry.camera_from_world
        cameras.append(
            make_camera(
                path,
                name,
                size=entry.size,
                matrix=entry.matrix,
                distortion=entry.distortion,
                camera_from_world=make_pose(path, name, pose.rotation, pose.translation),
                lens=entry.lens,
                error_px=entry.error_px,
            )
        )
    return make_rig(path, cameras, file.unit)


def to_text(rig: Rig) -> str:
    """The file's text; `read` gives the same rig back, bit for bit."""
    head = f"{_HEADER}\nformat = {toml_string(FORMAT)}\nunit = {toml_string(rig.unit)}\n"
    return head + "".join(_table(camera) for camera in rig)


def _table(camera: Camera) -> str:
    pose = camera.camera_from_world.as_matrix()
    said = "" if camera.error_px is None else f"error_px = {camera.error_px!r}\n"
    return f"""
[cameras.{toml_key(camera.name)}]
size = {list(camera.size)}
lens = {toml_string(camera.lens)}
matrix = {_rows(camera.matrix)}
distortion = {camera.distortion.tolist()}
{said}
[cameras.{toml_key(camera.name)}.camera_from_world]
rotation = {_rows(pose[:3, :3])}
translation = {pose[:3, 3].tolist()}
"""


def _rows(matrix: Any) -> str:
    # Python's repr of a float is its shortest text that reads back exactly, and valid TOML.
    return "[\n" + "".join(f"    {row},\n" for row in matrix.tolist()) + "]"
