"""Rigs of cameras that look at a point: rings, arcs and domes.

The world's axes are OpenCV's camera axes (x right, y down, z forward): up is -y, and `cam_0` of a ring is at -z.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import check_finite, check_integer, check_number, check_real
from sylpose.rig import MAX_LENGTH, Rig, make_look_at_camera

MAX_CAMERAS = 10_000  # maximum number of cameras of a rig (choice)


def ring(
    n: int,
    radius: float = 1.5,
    focal: float = 1000.0,
    size: tuple[int, int] = (1280, 960),
    *,
    height: ArrayLike = 0.0,
    target: ArrayLike = (0.0, 0.0, 0.0),
    distortion: ArrayLike = (),
) -> Rig:
    """Build a rig of `n` cameras evenly on a full horizontal circle around the target. Arguments as in `arc`."""
    n = check_integer(n, "n", minimum=1, maximum=MAX_CAMERAS)
    return arc(n, 360.0 / n, radius, focal, size, height=height, target=target, distortion=distortion, first_deg=0.0)


def arc(
    n: int,
    spacing_deg: float,
    radius: float = 1.5,
    focal: float = 1000.0,
    size: tuple[int, int] = (1280, 960),
    *,
    height: ArrayLike = 0.0,
    target: ArrayLike = (0.0, 0.0, 0.0),
    distortion: ArrayLike = (),
    first_deg: float | None = None,
) -> Rig:
    """Build a rig of `n` cameras on a horizontal circle around the target.

    Args:
        n: number of cameras.
        spacing_deg: angle between neighboring cameras as seen from the target, degrees.
        radius: radius of the circle: the horizontal distance to the target.
        focal: pixels.
        size: (width, height) in pixels.
        height: above the target (towards -y), one for all or (n,) one per camera.
        target: (3,) the point that all cameras look at.
        distortion: OpenCV's coefficients, the same for all cameras.
        first_deg: the angle of cam_0 in degrees, 0 at -z, growing towards +x; None centers the arc on -z.

    Returns:
        The rig with cameras cam_0, cam_1, ...

    Raises:
        ValueError: there are fewer than one camera, the heights are neither one nor n, or `Camera` rejects a value.
    """
    n = check_integer(n, "n", minimum=1, maximum=MAX_CAMERAS)
    spacing_deg = check_number(spacing_deg, "spacing_deg", minimum=-360.0, maximum=360.0)
    radius = check_number(radius, "radius", minimum=0.0, maximum=MAX_LENGTH)
    heights = check_real(height, f"one number or ({n},)", "height")
    if not (np.abs(heights) <= MAX_LENGTH).all():
        raise ValueError(f"height has values that are not finite, or beyond {MAX_LENGTH:g}")
    if first_deg is not None:
        first_deg = check_number(first_deg, "first_deg", minimum=-1e6, maximum=1e6)
    if heights.shape not in ((), (n,)):
        raise ValueError(f"height must be one number or ({n},), got shape {heights.shape}")
    start = -spacing_deg * (n - 1) / 2 if first_deg is None else first_deg
    angles = np.deg2rad(start + spacing_deg * np.arange(n))
    offsets = np.column_stack([radius * np.sin(angles), np.broadcast_to(-heights, n), -radius * np.cos(angles)])
    return _rig_from_offsets(offsets, target, focal, size, distortion)


def dome(
    n: int,
    radius: float = 1.5,
    focal: float = 1000.0,
    size: tuple[int, int] = (1280, 960),
    *,
    lowest_deg: float = 10.0,
    target: ArrayLike = (0.0, 0.0, 0.0),
    distortion: ArrayLike = (),
) -> Rig:
    """Build a rig of `n` cameras evenly on a dome around the target (a Fibonacci spiral).

    The dome is the part of the sphere of this radius that is `lowest_deg` or more above the horizon of the target.
    Other arguments, result and errors as in `arc`.
    """
    n = check_integer(n, "n", minimum=1, maximum=MAX_CAMERAS)
    radius = check_number(radius, "radius", above=0.0, maximum=MAX_LENGTH)
    lowest_deg = check_number(lowest_deg, "lowest_deg", minimum=-90.0, maximum=90.0)
    bottom = np.sin(np.deg2rad(lowest_deg))
    up = bottom + (1 - bottom) * (np.arange(n) + 0.5) / n
    angles = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    flat = np.sqrt(1 - up**2)
    offsets = radius * np.column_stack([flat * np.sin(angles), -up, -flat * np.cos(angles)])
    return _rig_from_offsets(offsets, target, focal, size, distortion)


def _rig_from_offsets(
    offsets: FloatArray, target: ArrayLike, focal: float, size: tuple[int, int], distortion: ArrayLike
) -> Rig:
    target = check_finite(target, (3,), "target", maximum=MAX_LENGTH)
    cameras = [
        make_look_at_camera(f"cam_{i}", target + o, target, focal, size, distortion) for i, o in enumerate(offsets)
    ]
    return Rig(cameras, "m")
