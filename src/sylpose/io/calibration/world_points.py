"""World from three or more points: its origin, one on its x axis, and others on its plane z = 0."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import format_value
from sylpose.input_limits import to_one_line
from sylpose.rig import MAX_FOCAL_PX, MAX_LENGTH, Rig, intersect_rays
from sylpose.units import parse_length_with_unit

__all__ = ["build_world_from_points", "world_from_axes"]

# Maximum median reprojection error of a point, pixels (choice: manual picks are accurate to three).
MAX_POINT_ERROR_PX = 10.0
# Points are collinear if their extent across the line is below this fraction (choice: 3 degrees).
MIN_SPREAD_RATIO = 0.05


def build_world_from_points(data: Mapping[str, Any], rig: Rig) -> tuple[RigidTransform, float, str]:
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
    pose = world_from_axes(origin, x_direction - (x_direction @ normal) * normal, normal)
    if "distance" not in data:
        return pose, 1.0, rig.unit
    length, unit = parse_length_with_unit(str(data["distance"]), "distance")
    return pose, length / float(np.linalg.norm(x_direction)), unit or rig.unit


def world_from_axes(origin: FloatArray, x: FloatArray, z: FloatArray) -> RigidTransform:
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
