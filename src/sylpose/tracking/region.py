"""Object region in each image: the projection of a point cloud that fills the object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from sylpose.frames import Box
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.rig import Camera, Rig, intersect_rays

__all__ = ["carve_box_volume", "project_outline", "rasterize_outline"]


# Points per axis of the grids carved by the boxes; number of grids, each fitted to what the previous one has left
# (choice).
GRID_POINTS, N_GRIDS = 15, 3
# Directions in which an outline is dilated (choice).
DILATION_DIRECTIONS = np.array([[np.cos(angle), np.sin(angle)] for angle in np.linspace(0, 2 * np.pi, 9)[:-1]])


def carve_box_volume(rig: Rig, boxes: Mapping[str, Box]) -> tuple[FloatArray, FloatArray]:
    """Return the object's center and points that fill the boxes' visual hull.

    Args:
        boxes: of at least one camera; with a single one the object is placed at distance 1 from it.

    Returns:
        center (3,) world; points (n, 3) world.

    Raises:
        ValueError: a camera that is not in the rig; no point in space is inside all boxes.
    """
    for name in boxes:
        if name not in rig.names:
            raise ValueError(f"boxes: no camera {name!r} in the rig ({', '.join(rig.names)})")
    cameras = [rig[name] for name in boxes]
    box_centers = [np.array([box.x + (box.width - 1) / 2, box.y + (box.height - 1) / 2]) for box in boxes.values()]
    rays = np.array([camera.rays(m)[0] for camera, m in zip(cameras, box_centers, strict=True)])
    centers = np.array([camera.center for camera in cameras])
    center = intersect_rays(centers, rays) if len(cameras) > 1 else centers[0] + rays[0]
    sizes = []
    for camera, box in zip(cameras, boxes.values(), strict=True):
        depth = camera.rotation[2] @ (center - camera.center)
        sizes.append(0.5 * np.hypot(box.width, box.height) / camera.focal * depth)
    # Along unbounded directions the object is assumed no larger than the largest box, times 1.5, since boxes are cut
    # off at the image border. The grid is aligned with a camera, so that a thin object upright in its box is not
    # missed.
    axes = cameras[int(np.argmin(sizes))].rotation
    low, high = np.full(3, -1.5 * max(sizes)), np.full(3, 1.5 * max(sizes))
    for _ in range(N_GRIDS):
        grid = np.stack(np.meshgrid(*np.linspace(low, high, GRID_POINTS).T, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[_is_inside_boxes(cameras, boxes, center + grid @ axes)]
        if len(grid) == 0:
            break
        spacing = (high - low) / (GRID_POINTS - 1)
        low, high = np.maximum(low, grid.min(axis=0) - spacing), np.minimum(high, grid.max(axis=0) + spacing)
    if len(grid) < 8:
        raise ValueError(f"boxes: the boxes of {', '.join(boxes)} do not intersect in space")
    return center, center + grid @ axes


def _is_inside_boxes(cameras: Sequence[Camera], boxes: Mapping[str, Box], points: FloatArray) -> BoolArray:
    """Return which world points (n,) are inside all boxes, with a small margin."""
    inside = np.ones(len(points), bool)
    for camera, box in zip(cameras, boxes.values(), strict=True):
        corner, size = np.array([box.x, box.y]), np.array([box.width, box.height])
        # A side of the box at the image border limits the image, not the object.
        low = np.where(corner <= 1, -np.inf, corner - 0.03 * size)
        high = np.where(corner + size >= np.array(camera.size) - 1, np.inf, corner + 1.03 * size)
        pixels = camera.project(points)
        inside &= ((pixels >= low) & (pixels <= high)).all(axis=1)
    return inside


def project_outline(camera: Camera, points: FloatArray, margin_ratio: float) -> FloatArray | None:
    """Return the dilated outline of world points in a camera's image.

    Args:
        points: (n, 3) world.
        margin_ratio: margin on every side, as a share of the outline's longer side; at least 12 pixels.

    Returns:
        (k, 2) pixels, convex; None if the points are out of view.
    """
    pixels = camera.project(points)
    size = np.array(camera.size)
    # Lens models fold back far outside the image: projections there are invalid.
    pixels = pixels[((pixels > -size) & (pixels < 2 * size)).all(axis=1)]
    if len(pixels) < 3:
        return None
    margin = max(12.0, margin_ratio * float(np.ptp(pixels, axis=0).max()))
    if (pixels.max(axis=0) + margin < 0).any() or (pixels.min(axis=0) - margin > size - 1).any():
        return None
    hull = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2)
    widened = (hull[:, None] + margin * DILATION_DIRECTIONS).reshape(-1, 2).astype(np.float32)
    return np.asarray(cv2.convexHull(widened).reshape(-1, 2), dtype=float)


def rasterize_outline(outline: FloatArray | None, size: tuple[int, int]) -> BoolArray:
    """Return a mask (h, w), True inside the outline (k, 2); all False without one."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    if outline is not None:
        cv2.fillConvexPoly(mask, np.round(outline).astype(np.int32), 1)
    return mask.astype(bool)
