"""Where the object is in each image: a cloud of points that fills it, carried along with the pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from sylpose.frames import Box
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.rig import Camera, Rig, nearest_point_to_rays

__all__ = ["polygon_mask", "region_polygon", "volume_from_boxes"]


# Points per axis of the grids that are carved by the boxes; how many, each laid over what the one before has
# left (choice).
GRID, GRIDS = 15, 3
# Directions in which an outline is widened (choice).
RING = np.array([[np.cos(angle), np.sin(angle)] for angle in np.linspace(0, 2 * np.pi, 9)[:-1]])


def volume_from_boxes(rig: Rig, boxes: Mapping[str, Box]) -> tuple[FloatArray, FloatArray]:
    """The object's centre and a cloud of points that fills what all boxes allow (their visual hull).

    Args:
        boxes: of at least one camera; with one alone the object is placed at distance 1 of it.

    Returns:
        center (3,) world; points (n, 3) world.

    Raises:
        ValueError: a camera that the rig does not have; no point in space is inside all boxes.
    """
    for name in boxes:
        if name not in rig.names:
            raise ValueError(f"boxes: no camera {name!r} in the rig ({', '.join(rig.names)})")
    cameras = [rig[name] for name in boxes]
    middles = [np.array([box.x + (box.width - 1) / 2, box.y + (box.height - 1) / 2]) for box in boxes.values()]
    rays = np.array([camera.rays(m)[0] for camera, m in zip(cameras, middles, strict=True)])
    centers = np.array([camera.center for camera in cameras])
    center = nearest_point_to_rays(centers, rays) if len(cameras) > 1 else centers[0] + rays[0]
    sizes = []
    for camera, box in zip(cameras, boxes.values(), strict=True):
        depth = camera.rotation[2] @ (center - camera.center)
        sizes.append(0.5 * np.hypot(box.width, box.height) / camera.focal * depth)
    # Where no box bounds it, the object is no larger than the largest box; half as much again, since boxes are cut off at
    # the image's rim. The grid has the axes of a camera, so that a thin object upright in its box does not slip through.
    axes = cameras[int(np.argmin(sizes))].rotation
    low, high = np.full(3, -1.5 * max(sizes)), np.full(3, 1.5 * max(sizes))
    for _ in range(GRIDS):
        grid = np.stack(np.meshgrid(*np.linspace(low, high, GRID).T, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[_inside(cameras, boxes, center + grid @ axes)]
        if len(grid) == 0:
            break
        spacing = (high - low) / (GRID - 1)
        low, high = np.maximum(low, grid.min(axis=0) - spacing), np.minimum(high, grid.max(axis=0) + spacing)
    if len(grid) < 8:
        raise ValueError(f"boxes: no place in space is inside the boxes of {', '.join(boxes)} all at once")
    return center, center + grid @ axes


def _inside(cameras: Sequence[Camera], boxes: Mapping[str, Box], points: FloatArray) -> BoolArray:
    """(n,) which world points are inside all boxes, or a little outside."""
    inside = np.ones(len(points), bool)
    for camera, box in zip(cameras, boxes.values(), strict=True):
        corner, size = np.array([box.x, box.y]), np.array([box.width, box.height])
        # A side of the box at the image's rim is where the image ends, not the object.
        low = np.where(corner <= 1, -np.inf, corner - 0.03 * size)
        high = np.where(corner + size >= np.array(camera.size) - 1, np.inf, corner + 1.03 * size)
        pixels = camera.project(points)
        inside &= ((pixels >= low) & (pixels <= high)).all(axis=1)
    return inside


def region_polygon(camera: Camera, points: FloatArray, growth: float) -> FloatArray | None:
    """Outline of world points in a camera's image, widened.

    Args:
        points: (n, 3) world.
        growth: margin on every side, as a share of the outline's longer side; at least 12 pixels.

    Returns:
        (k, 2) pixels, convex; None where the points are out of view.
    """
    pixels = camera.project(points)
    size = np.array(camera.size)
    # Lens models fold back on themselves far outside the image: what lies there says nothing.
    pixels = pixels[((pixels > -size) & (pixels < 2 * size)).all(axis=1)]
    if len(pixels) < 3:
        return None
    margin = max(12.0, growth * float(np.ptp(pixels, axis=0).max()))
    if (pixels.max(axis=0) + margin < 0).any() or (pixels.min(axis=0) - margin > size - 1).any():
        return None
    hull = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2)
    widened = (hull[:, None] + margin * RING).reshape(-1, 2).astype(np.float32)
    return np.asarray(cv2.convexHull(widened).reshape(-1, 2), dtype=float)


def polygon_mask(outline: FloatArray | None, size: tuple[int, int]) -> BoolArray:
    """(h, w) mask, True inside the outline (k, 2); False everywhere without one."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    if outline is not None:
        cv2.fillConvexPoly(mask, np.round(outline).astype(np.int32), 1)
    return mask.astype(bool)
