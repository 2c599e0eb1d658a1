"""User-defined worlds: their pose in the calibration's world, and their files (docs/formats.md, "Worlds")."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.atomic_io import format_toml_string, replace_atomically
from sylpose.geometry.validation import check_finite, check_number, check_type
from sylpose.input_limits import input_errors, parse_toml, read_text
from sylpose.io.calibration.camera_builder import convert_table, make_rigid_transform
from sylpose.io.calibration.world_points import build_world_from_points, world_from_axes
from sylpose.rig import MAX_LENGTH, Rig, check_single_pose
from sylpose.units import METERS

__all__ = ["FORMAT", "World", "load_world", "parse_up_world", "save_world", "transform_rig", "world_with_up"]

FORMAT = "sylpose-world-1"
# Minimum horizontal component of the axis that defines x in the plane (choice: 3 degrees from vertical).
MIN_HORIZONTAL = 0.05
_HEADER = """\
# A user-defined world, for --world of sylpose: X_world = scale (rotation X_calibration + translation).
# unit: of the translation, the calibration's; world_unit: of lengths in this world.
"""
_NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_VECTOR = rf"\s*{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}\s*"


@dataclass(frozen=True, eq=False)
class World:
    """World frame, defined relative to the calibration's world.

    Attributes:
        world_from_calibration: pose, in lengths of the calibration.
        description: description of its origin, for display.
        unit: unit of the calibration's lengths, or "".
        scale: factor applied to lengths after the pose.
        world_unit: unit of the scaled lengths, or "".

    Raises:
        TypeError, ValueError: an invalid pose; a scale that is not positive.
    """

    world_from_calibration: RigidTransform
    description: str = ""
    unit: str = ""
    scale: float = 1.0
    world_unit: str = ""

    def __post_init__(self) -> None:
        check_single_pose(self.world_from_calibration, "world_from_calibration")
        for name in ("description", "unit", "world_unit"):
            check_type(getattr(self, name), str, name)
        check_number(self.scale, "scale", above=0.0, minimum=1e-12, maximum=1e12)


class _Pose(msgspec.Struct, forbid_unknown_fields=True):
    rotation: list[list[float]] | None = None
    quaternion: list[float] | None = None
    translation: list[float] | None = None
    matrix: list[list[float]] | None = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    world_from_calibration: _Pose
    description: str = ""
    unit: str = ""
    scale: float = 1.0
    world_unit: str | None = None


def transform_rig(rig: Rig, world: World) -> Rig:
    """Express a rig in a world; poses `world_from_object` and their covariances follow.

    Args:
        rig: in the calibration's world.
        world: the new world.

    Returns:
        the rig in the new world, in its length unit.

    Raises:
        ValueError: the units of the world and of the rig cannot be converted.
    """
    pose, factor = world.world_from_calibration, 1.0
    if rig.unit != world.unit:
        if not {rig.unit, world.unit} <= METERS.keys():
            units = [f"in {unit}" if unit else "in an unknown unit" for unit in (world.unit, rig.unit)]
            raise ValueError(f"world: it is defined {units[0]}, and the calibration is {units[1]}")
        factor = METERS[world.unit] / METERS[rig.unit]
        pose = RigidTransform.from_components(factor * pose.translation, pose.rotation)
    # Without a scale, lengths keep the rig's unit, whatever it is.
    rotated = rig.in_world(pose)
    if world.scale == 1.0 and world.world_unit == world.unit:
        return rotated
    scale, poses = world.scale / factor, [camera.camera_from_world for camera in rotated]
    scaled_poses = [RigidTransform.from_components(scale * pose.translation, pose.rotation) for pose in poses]
    return Rig(
        [replace(c, camera_from_world=pose) for c, pose in zip(rig, scaled_poses, strict=True)], world.world_unit
    )


def world_with_up(
    up: ArrayLike, origin: ArrayLike = (0.0, 0.0, 0.0), *, unit: str = "", description: str = ""
) -> World:
    """Build a world whose z axis points up.

    Its x axis is the horizontal part of the calibration's x axis, or of its y axis if x is vertical.

    Args:
        up: (3,) in the calibration's world, of any length.
        origin: (3,) in the calibration's world.
        unit: unit of the calibration's lengths, or "" if unknown.
        description: description of its origin, for display.

    Raises:
        ValueError: numbers that are not finite; no direction.
    """
    up, origin = check_finite(up, (3,), "up"), check_finite(origin, (3,), "origin", maximum=MAX_LENGTH)
    length = float(np.linalg.norm(up))
    if not length > 1e-12:
        raise ValueError("up must be a direction, got (0, 0, 0)")
    z = up / length
    horizontal_axes = np.eye(3) - np.outer(z, z)
    x = next(axis for axis in horizontal_axes if np.linalg.norm(axis) > MIN_HORIZONTAL)
    return World(world_from_axes(origin, x, z), description, unit, 1.0, unit)


def parse_up_world(text: str, unit: str = "") -> World | None:
    """Parse the world of `up=0,-1,0` or `up=-y`, optionally followed by `origin=0.1,0.2,0`; None for other text.

    Raises:
        ValueError: it begins like that but is invalid.
    """
    if not re.match(r"\s*up\s*=", text):
        return None
    found = re.fullmatch(rf"\s*up\s*=({_VECTOR}|\s*[+-]?[xyz]\s*)(?:[,;\s]\s*origin\s*=({_VECTOR}))?", text)
    if found is None:
        raise ValueError(f"{text!r}: up=0,-1,0 or up=-y is expected, optionally followed by origin=0.1,0.2,0")
    if axis := re.fullmatch(r"([+-]?)([xyz])", found[1].strip()):
        up = (-1.0 if axis[1] == "-" else 1.0) * np.eye(3)["xyz".index(axis[2])]
    else:
        up = np.array([float(part) for part in found[1].split(",")])
    origin = [float(part) for part in found[2].split(",")] if found[2] else [0.0, 0.0, 0.0]
    return world_with_up(up, origin, unit=unit, description=text.strip())


def load_world(path: Path | str, rig: Rig) -> World:
    """Load a world from a file written by `save_world`, or with three points as in `world_points`.

    Args:
        path: path of the file.
        rig: the calibration that it refers to.

    Raises:
        OSError: it is missing or cannot be read.
        ValueError: naming the file: neither of the two; a matrix that is not a rotation; points that define no world.
    """
    path = Path(path)
    text = read_text(path)
    with input_errors(path):
        try:
            data = parse_toml(text)
        except tomllib.TOMLDecodeError as error:
            raise ValueError(f"not valid TOML: {error}") from None
        if "format" not in data and "world_from_calibration" not in data:
            pose, scale, unit = build_world_from_points(data, rig)
            return World(pose, f"points of {path.name}", rig.unit, scale, unit)
        return _parse_world(data, path)


def save_world(world: World, path: Path | str) -> None:
    """Write a world; loading returns the same one up to rounding.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    matrix = world.world_from_calibration.as_matrix()
    rows = "[\n" + "".join(f"    {row},\n" for row in matrix[:3, :3].tolist()) + "]"
    head = f"description = {format_toml_string(world.description)}\nunit = {format_toml_string(world.unit)}\n"
    scale_lines = f"scale = {float(world.scale)!r}\nworld_unit = {format_toml_string(world.world_unit)}\n"
    pose = f"\n[world_from_calibration]\nrotation = {rows}\ntranslation = {matrix[:3, 3].tolist()}\n"
    with replace_atomically(path) as part:
        part.write_text(
            f"{_HEADER}\nformat = {format_toml_string(FORMAT)}\n{head}{scale_lines}{pose}", encoding="utf-8"
        )


def _parse_world(data: dict[str, Any], path: Path) -> World:
    data = {"format": FORMAT, **data}
    if data["format"] != FORMAT:
        raise ValueError(f"the format is {data['format']!r}; this version of sylpose reads {FORMAT!r}")
    file = convert_table(data, _File, str(path))
    pose_table = file.world_from_calibration
    rotation_keys = [name for name in ("matrix", "rotation", "quaternion") if getattr(pose_table, name) is not None]
    if len(rotation_keys) != 1 or (rotation_keys == ["matrix"]) == (pose_table.translation is not None):
        raise ValueError(
            "world_from_calibration must have a matrix (3x4 or 4x4), or a translation and a rotation (3x3) or "
            "quaternion (x, y, z, w)"
        )
    where = f"{path}: world_from_calibration"
    if pose_table.quaternion is not None:
        quaternion = check_finite(pose_table.quaternion, (4,), f"{where}: the quaternion")
        if abs(np.linalg.norm(quaternion) - 1.0) > 1e-3:
            raise ValueError(f"{where}: the quaternion must have length 1")
        pose = make_rigid_transform(where, Rotation.from_quat(quaternion).as_matrix(), pose_table.translation)
    elif pose_table.matrix is not None:
        try:
            matrix = np.array(pose_table.matrix, dtype=float)
        except ValueError:
            matrix = np.empty(0)
        if matrix.shape not in ((3, 4), (4, 4)) or (matrix.shape == (4, 4) and (matrix[3] != [0, 0, 0, 1]).any()):
            raise ValueError(f"{where}: the matrix must be 3x4, or 4x4 with (0, 0, 0, 1) as last row")
        pose = make_rigid_transform(where, matrix[:3, :3], matrix[:3, 3])
    else:
        pose = make_rigid_transform(where, pose_table.rotation, pose_table.translation)
    world_unit = file.unit if file.world_unit is None else file.world_unit
    return World(pose, file.description, file.unit, file.scale, world_unit)
