"""User-defined worlds: their pose in the calibration's world, and their files (docs/formats.md, "Worlds")."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.atomic_io import format_toml_string, replace_atomically
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import check_finite, check_number, check_type, format_value
from sylpose.input_limits import input_errors, parse_toml, read_text, to_one_line
from sylpose.io.calibration.camera_builder import Entry
from sylpose.rig import MAX_FOCAL_PX, MAX_LENGTH, Rig, check_single_pose, intersect_rays
from sylpose.units import METERS, parse_length_with_unit

FORMAT = "sylpose-world-1"
# Minimum horizontal component of the axis that defines x in the plane (choice: 3 degrees from vertical).
MIN_HORIZONTAL = 0.05
# Maximum median reprojection error of a point, pixels (choice: manual picks are accurate to three).
MAX_POINT_ERROR_PX = 10.0
# Points are collinear if their extent across the line is below this fraction (choice: 3 degrees).
MIN_SPREAD_RATIO = 0.05
_HEADER = """\
# A user-defined world, for --world of sylpose: X_world = scale (rotation X_calibration + translation).
# unit: of the translation, the calibration's; world_unit: of lengths in this world.
"""
# Possessive quantifiers: each character is looked at once.
_NUMBER = r"[+-]?(?:[0-9]++\.?[0-9]*+|\.[0-9]++)(?:[eE][+-]?[0-9]++)?"
_VECTOR = rf"\s*+{_NUMBER}\s*+,\s*+{_NUMBER}\s*+,\s*+{_NUMBER}\s*+"
_UP = re.compile(rf"\s*+up\s*+=({_VECTOR}|\s*+[+-]?[xyz]\s*+)(?:(?:[,;]\s*+|(?<=\s))origin\s*+=({_VECTOR}))?")


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
    return World(_world_from_axes(origin, x, z), description, unit, 1.0, unit)


def parse_up_world(text: str, unit: str = "") -> World | None:
    """Parse the world of `up=0,-1,0` or `up=-y`, optionally followed by `origin=0.1,0.2,0`; None for other text.

    Raises:
        ValueError: it begins like that but is invalid.
    """
    if not re.match(r"\s*up\s*=", text):
        return None
    found = _UP.fullmatch(text)
    if found is None:
        raise ValueError(f"{text!r}: up=0,-1,0 or up=-y is expected, optionally followed by origin=0.1,0.2,0")
    if axis := re.fullmatch(r"([+-]?)([xyz])", found[1].strip()):
        up = (-1.0 if axis[1] == "-" else 1.0) * np.eye(3)["xyz".index(axis[2])]
    else:
        up = np.array([float(part) for part in found[1].split(",")])
    origin = [float(part) for part in found[2].split(",")] if found[2] else [0.0, 0.0, 0.0]
    return world_with_up(up, origin, unit=unit, description=text.strip())


def load_world(path: Path | str, rig: Rig) -> World:
    """Load a world from a file written by `save_world`, or with three or more points (`_build_world_from_points`).

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
        data = parse_toml(text)
        if "format" not in data and "world_from_calibration" not in data:
            pose, scale, unit = _build_world_from_points(data, rig)
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
    file = Entry(path).convert_table(data, _File)
    pose_table = file.world_from_calibration
    rotation_keys = [name for name in ("matrix", "rotation", "quaternion") if getattr(pose_table, name) is not None]
    if len(rotation_keys) != 1 or (rotation_keys == ["matrix"]) == (pose_table.translation is not None):
        raise ValueError(
            "world_from_calibration must have a matrix (3x4 or 4x4), or a translation and a rotation (3x3) or "
            "quaternion (x, y, z, w)"
        )
    where = Entry(path, "world_from_calibration")
    if pose_table.matrix is not None:
        pose = where.parse_pose_matrix(pose_table.matrix, "the matrix")
    else:
        rotation: Any = pose_table.rotation
        if pose_table.quaternion is not None:
            quaternion = check_finite(pose_table.quaternion, (4,), f"{where}: the quaternion")
            rotation = where.parse_quaternion(quaternion, "the quaternion must have length 1").as_matrix()
        pose = where.make_pose(rotation, pose_table.translation)
    world_unit = file.unit if file.world_unit is None else file.world_unit
    return World(pose, file.description, file.unit, file.scale, world_unit)


# Worlds of three or more points: the origin, one on the x axis, and others on the plane z = 0.


def _build_world_from_points(data: Mapping[str, Any], rig: Rig) -> tuple[RigidTransform, float, str]:
    """Build the world defined by a file's points.

    Args:
        data: `origin`, `x`, `xy` and any others that begin with xy, each a table of pixels by camera or a list of three
            coordinates in the calibration's world; optional `distance` from the first to the second.
        rig: the calibration.

    Returns:
        world_from_calibration, the scale of its lengths, and the unit of scaled lengths.

    Raises:
        ValueError: naming the point: missing, seen by a single camera, inconsistent between cameras; collinear points.
    """
    plane = [name for name in data if name.startswith("xy")]
    known_keys = {"origin", "x", *plane, "distance"}
    if unknown := [name for name in data if name not in known_keys]:
        raise ValueError(
            f"{format_value(unknown[0])} is neither origin, x, xy (xy2, ...) nor distance, and this is not a world file"
        )
    missing = [name for name in ("origin", "x") if name not in data] + ["xy"] * (not plane)
    if missing:
        raise ValueError(
            f"points origin, x (on the x axis) and xy (on the plane z = 0) are expected: {missing[0]} is missing"
        )
    places = {name: _locate_point(name, data[name], rig) for name in ("origin", "x", *plane)}
    origin, x_direction = places["origin"], places["x"] - places["origin"]
    others = np.array([places[name] - origin for name in plane])
    normal = _fit_normal(x_direction, others)
    pose = _world_from_axes(origin, x_direction - (x_direction @ normal) * normal, normal)
    if "distance" not in data:
        return pose, 1.0, rig.unit
    length, unit = parse_length_with_unit(str(data["distance"]), "distance")
    return pose, length / float(np.linalg.norm(x_direction)), unit or rig.unit


def _world_from_axes(origin: FloatArray, x: FloatArray, z: FloatArray) -> RigidTransform:
    """Return world_from_calibration of a world by its origin and axes x and z in the calibration's world.

    The axes are orthogonal, of any length.
    """
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    rotation = Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))
    return RigidTransform.from_components(-rotation.apply(origin), rotation)


def _fit_normal(x_direction: FloatArray, others: FloatArray) -> FloatArray:
    """Fit the normal (3,) of the plane through origin, x and the others (n, 3).

    It is oriented so that y is to the left of x.
    """
    length = float(np.linalg.norm(x_direction))
    extent = float(np.linalg.norm(others, axis=1).max())
    if not length > 0 or not extent > 0:
        raise ValueError("two of its points coincide")
    across = np.cross(x_direction, others.mean(axis=0))
    across_distance = float(np.linalg.norm(across)) / length
    if across_distance <= MIN_SPREAD_RATIO * max(length, extent):
        raise ValueError("its points are collinear, or nearly: they do not define z")
    rows = np.concatenate([[np.zeros(3), x_direction], others])
    normal = np.linalg.svd(rows - rows.mean(axis=0))[2][2]
    return np.asarray(normal if normal @ across > 0 else -normal)


def _locate_point(name: str, value: Any, rig: Rig) -> FloatArray:
    """Compute a point's position (3,) in the calibration's world."""
    if isinstance(value, list):
        return _parse_coordinates(name, value, 3, "three coordinates", MAX_LENGTH)
    if not isinstance(value, Mapping):
        raise ValueError(f"{name}: pixels by camera, or three coordinates, are expected, got {format_value(value)}")
    cameras = []
    for camera in value:
        if camera not in rig.names:
            raise ValueError(
                f"{name}: {format_value(camera)} is not a camera of the calibration "
                f"({to_one_line(', '.join(rig.names), 200)})"
            )
        cameras.append(rig[camera])
    if len(cameras) < 2:
        raise ValueError(f"{name}: pixels in at least two cameras are expected, got {len(cameras)}")
    pixels = [
        _parse_coordinates(f"{name}: {camera.name}", value[camera.name], 2, "two pixels", MAX_FOCAL_PX)
        for camera in cameras
    ]
    rays = np.concatenate([camera.rays(pixel) for camera, pixel in zip(cameras, pixels, strict=True)])
    centers = np.array([camera.center for camera in cameras])
    if np.linalg.svd(rays)[1][1] < MIN_SPREAD_RATIO / 2:
        raise ValueError(
            f"{name}: {', '.join(c.name for c in cameras)} see it from nearly one direction; its distance is "
            "undetermined"
        )
    place = intersect_rays(centers, rays)
    errors = [
        float(np.linalg.norm(camera.project(place)[0] - pixel)) for camera, pixel in zip(cameras, pixels, strict=True)
    ]
    if not np.median(np.nan_to_num(errors, nan=np.inf)) <= MAX_POINT_ERROR_PX:
        error_list = ", ".join(
            f"{camera.name} by {error:.0f} px" for camera, error in zip(cameras, errors, strict=True)
        )
        raise ValueError(f"{name}: the cameras' pixels are inconsistent; the nearest point is missed by {error_list}")
    return place


def _parse_coordinates(name: str, value: Any, n: int, what: str, maximum: float) -> FloatArray:
    numbers = value if isinstance(value, list) else []
    if len(numbers) != n or not all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) <= maximum for v in numbers
    ):
        raise ValueError(
            f"{name}: {what} are expected, such as [{', '.join(['412.5', '180.0', '30.0'][:n])}], got "
            f"{format_value(str(value))}"
        )
    return np.array(numbers, dtype=float)
