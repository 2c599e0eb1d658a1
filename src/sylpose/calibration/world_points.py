"""A world by three points or more: its origin, one on its x axis, and others of its plane z = 0."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import shown
from sylpose.input_limits import one_line
from sylpose.rig import MAX_LENGTH, MAX_PX, Rig, nearest_point_to_rays
from sylpose.units import measured

__all__ = ["standing_at", "world_of_points"]

# Pixels by which a point's rays may miss it in the middle (choice: what is picked by hand is good to three).
ASTRAY_PX = 10.0
# Points lie on a line where they extend across it by less than this share (choice: 3 degrees).
FLAT = 0.05


def world_of_points(data: Mapping[str, Any], rig: Rig) -> tuple[RigidTransform, float, str]:
    """The world of a file's points.

    Args:
        data: `origin`, `x`, `xy` and any others that begin with xy, each a table of pixels by camera or a list of three
            coordinates in the calibration's world; `distance` from the first to the second, where it is known.

    Returns:
        world_from_calibration, by what its lengths are multiplied, and the unit of lengths then.

    Raises:
        ValueError: naming the point: missing, seen by one camera only, seen in different places; points on a line.
    """
    plane = [name for name in data if name.startswith("xy")]
    known = {"origin", "x", *plane, "distance"}
    if unknown := [name for name in data if name not in known]:
        raise ValueError(
            f"{shown(unknown[0])} is neither origin, x, xy (xy2, ...) nor distance, and this is no world either"
        )
    missing = [name for name in ("origin", "x") if name not in data] + ["xy"] * (not plane)
    if missing:
        raise ValueError(
            f"points are expected by the names origin, x (on the x axis) and xy (where z = 0): {missing[0]} is missing"
        )
    places = {name: _place(name, data[name], rig) for name in ("origin", "x", *plane)}
    origin, along = places["origin"], places["x"] - places["origin"]
    others = np.array([places[name] - origin for name in plane])
    normal = _normal(along, others)
    pose = standing_at(origin, along - (along @ normal) * normal, normal)
    if "distance" not in data:
        return pose, 1.0, rig.unit
    length, unit = measured(str(data["distance"]), "distance")
    return pose, length / float(np.linalg.norm(along)), unit or rig.unit


def standing_at(origin: FloatArray, x: FloatArray, z: FloatArray) -> RigidTransform:
    """world_from_calibration of a world whose axes x and z (square to it, of any length) and origin are these in the
    calibration's."""
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    rotation = Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))
    return RigidTransform.from_components(-rotation.apply(origin), rotation)


def _normal(along: FloatArray, others: FloatArray) -> FloatArray:
    """(3,) of the plane that fits origin, x and the others (n, 3) best, on the side from which y is to the left of x."""
    length = float(np.linalg.norm(along))
    far = float(np.linalg.norm(others, axis=1).max())
    if not length > 0 or not far > 0:
        raise ValueError("two of its points are one")
    across = np.cross(along, others.mean(axis=0))
    aside = float(np.linalg.norm(across)) / length
    if aside <= FLAT * max(length, far):
        raise ValueError("its points are on a line, or nearly: they leave open where z is")
    rows = np.concatenate([[np.zeros(3), along], others])
    normal = np.linalg.svd(rows - rows.mean(axis=0))[2][2]
    return np.asarray(normal if normal @ across > 0 else -normal)


def _place(name: str, value: Any, rig: Rig) -> FloatArray:
    """(3,) where a point is in the calibration's world."""
    if isinstance(value, list):
        return _numbers(name, value, 3, "three coordinates", MAX_LENGTH)
    if not isinstance(value, Mapping):
        raise ValueError(f"{name}: pixels by camera, or three coordinates, are expected, got {shown(value)}")
    cameras = []
    for camera in value:
        if camera not in rig.names:
            raise ValueError(
                f"{name}: {shown(camera)} is no camera of the calibration ({one_line(', '.join(rig.names), 200)})"
            )
        cameras.append(rig[camera])
    if len(cameras) < 2:
        raise ValueError(f"{name}: pixels in two cameras at least are expected, got {len(cameras)}")
    pixels = [_numbers(f"{name}: {camera.name}", value[camera.name], 2, "two pixels", MAX_PX) for camera in cameras]
    rays = np.concatenate([camera.rays(pixel) for camera, pixel in zip(cameras, pixels, strict=True)])
    centers = np.array([camera.center for camera in cameras])
    if np.linalg.svd(rays)[1][1] < FLAT / 2:
        raise ValueError(
            f"{name}: {', '.join(c.name for c in cameras)} see it from nearly one side, which leaves open how far it is"
        )
    place = nearest_point_to_rays(centers, rays)
    off = [
        float(np.linalg.norm(camera.project(place)[0] - pixel)) for camera, pixel in zip(cameras, pixels, strict=True)
    ]
    if not np.median(np.nan_to_num(off, nan=np.inf)) <= ASTRAY_PX:
        said = ", ".join(f"{camera.name} by {far:.0f} px" for camera, far in zip(cameras, off, strict=True))
        raise ValueError(f"{name}: the cameras do not mean the same point; the nearest one is missed by {said}")
    return place


def _numbers(name: str, value: Any, n: int, what: str, most: float) -> FloatArray:
    numbers = value if isinstance(value, list) else []
    if len(numbers) != n or not all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) <= most for v in numbers
    ):
        raise ValueError(
            f"{name}: {what} are expected, such as [{', '.join(['412.5', '180.0', '30.0'][:n])}], got {shown(str(value))}"
        )
    return np.array(numbers, dtype=float)
