"""Rigs of cameras that look at a point: rings, arcs and domes.

The world's axes are OpenCV's camera axes (x right, y down, z forward): up is -y, and `cam_0` of a ring stands at -z.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import finite, number, real, whole
from sylpose.rig import MAX_LENGTH, Rig, camera_at

MOST_CAMERAS = 10_000  # of a rig (choice)

__all__ = ["arc", "dome", "ring"]


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
    """`n` cameras evenly on a full horizontal circle around the target. Arguments as in `arc`."""
    n = whole(n, "n", least=1, most=MOST_CAMERAS)
    return arc(n, 360.0 / n, radius, focal, size, height=height, target=target, distortion=distortion, first=0.0)


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
    first: float | None = None,
) -> Rig:
    """`n` cameras on a horizontal circle around the target, neighbours `spacing_deg` apart as seen from it.

    Args:
        radius: of the circle: the horizontal distance to the target.
        focal: pixels.
        size: (width, height) in pixels.
        height: above the target (towards -y), one for all or (n,) one per camera.
        target: (3,) the point that all cameras look at.
        distortion: OpenCV's coefficients, the same for all.
        first: the angle of cam_0 in degrees, 0 at -z, growing towards +x; None centres the arc on -z.

    Returns:
        cameras cam_0, cam_1, ...

    Raises:
        ValueError: fewer than one camera, heights that are neither one nor n, or anything that `Camera` refuses.
    """
    n = whole(n, "n", least=1, most=MOST_CAMERAS)
    spacing_deg = number(spacing_deg, "spacing_deg", least=-360.0, most=360.0)
    radius = number(radius, "radius", least=0.0, most=MAX_LENGTH)
    heights = real(height, f"one number or ({n},)", "height")
    if not (np.abs(heights) <= MAX_LENGTH).all():
        raise ValueError(f"height has values that are not finite, or beyond {MAX_LENGTH:g}")
    if first is not None:
        first = number(first, "first", least=-1e6, most=1e6)
    if heights.shape not in ((), (n,)):
        raise ValueError(f"height must be one number or ({n},), got shape {heights.shape}")
    start = -spacing_deg * (n - 1) / 2 if first is None else first
    angles = np.deg2rad(start + spacing_deg * np.arange(n))
    offsets = np.column_stack([radius * np.sin(angles), np.broadcast_to(-heights, n), -radius * np.cos(angles)])
    return _looking_at(offsets, target, focal, size, distortion)


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
    """`n` cameras spread evenly (a Fibonacci spiral) over the part of a sphere that is `lowest_deg` or more above the
    horizon of the target; `radius` is the sphere's. Other arguments, returns and errors as in `arc`.
    """
    n = whole(n, "n", least=1, most=MOST_CAMERAS)
    radius = number(radius, "radius", above=0.0, most=MAX_LENGTH)
    lowest_deg = number(lowest_deg, "lowest_deg", least=-90.0, most=90.0)
    bottom = np.sin(np.deg2rad(lowest_deg))
    up = bottom + (1 - bottom) * (np.arange(n) + 0.5) / n
    angles = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    flat = np.sqrt(1 - up**2)
    offsets = radius * np.column_stack([flat * np.sin(angles), -up, -flat * np.cos(angles)])
    return _looking_at(offsets, target, focal, size, distortion)


def _looking_at(
    offsets: FloatArray, target: ArrayLike, focal: float, size: tuple[int, int], distortion: ArrayLike
) -> Rig:
    target = finite(target, (3,), "target", most=MAX_LENGTH)
    cameras = [camera_at(f"cam_{i}", target + o, target, focal, size, distortion) for i, o in enumerate(offsets)]
    return Rig(cameras, "m")
