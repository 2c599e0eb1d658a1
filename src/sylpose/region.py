"""Where the object is in each image: a cloud of points that fills it, carried along with the pose."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from sylpose.capture import Box
from sylpose.rig import Camera, Rig, nearest_point_to_rays

__all__ = ["polygon_mask", "region_polygon", "volume_from_boxes"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Points per axis of the grid that is carved by the boxes.
GRID = 21


def volume_from_boxes(rig: Rig, boxes: Mapping[str, Box]) -> tuple[FloatArray, FloatArray]:
    """The object's centre and a cloud of points that fills what all boxes allow (their visual hull).

    Args:
        boxes: of at least one camera; with one alone the object is placed at distance 1 of it.

    Returns:
        center (3,) world; points (n, 3) world.

    Raises:
        ValueError: no point in space is inside all boxes.
    """
    cameras = [rig[name] for name in boxes]
    middles = [np.array([box.x + (box.width - 1) / 2, box.y + (box.height - 1) / 2]) for box in boxes.values()]
    rays = np.array([camera.rays(m)[0] for camera, m in zip(cameras, middles, strict=True)])
    centers = np.array([camera.center for camera in cameras])
    center = nearest_point_to_rays(centers, rays) if len(cameras) > 1 else centers[0] + rays[0]
    sizes = []
    for camera, box in zip(cameras, boxes.values(), strict=True):
        depth = camera.rotation[2] @ (center - camera.center)
        sizes.append(0.5 * np.hypot(box.width, box.height) / camera.focal * depth)
    # The smallest box bounds the object best; half as much again, since boxes are cut off at the image's rim.
    half = 1.5 * min(sizes)
    axis = np.linspace(-half, half, GRID)
    points = center + np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    for camera, box in zip(cameras, boxes.values(), strict=True):
        pixels = camera.project(points) - [box.x, box.y]
        size = np.array([box.width, box.height])
        # A side of the box at the image's rim is where the image ends, not the object.
        low = np.where(np.array([box.x, box.y]) <= 1, -np.inf, -0.03 * size)
        high = np.where(np.array([box.x, box.y]) + size >= np.array(camera.size) - 1, np.inf, 1.03 * size)
        inside = ((pixels >= low) & (pixels <= high)).all(axis=1)
        points = points[inside]
    if len(points) < 8:
        raise ValueError(f"boxes: no place in space is inside the boxes of {', '.join(boxes)} all at once")
    return center, points


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
    angles = np.linspace(0, 2 * np.pi, 9)[:-1]
    ring = margin * np.column_stack([np.cos(angles), np.sin(angles)])
    hull = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2)
    widened = (hull[:, None] + ring).reshape(-1, 2).astype(np.float32)
    return np.asarray(cv2.convexHull(widened).reshape(-1, 2), dtype=float)


def polygon_mask(outline: FloatArray, size: tuple[int, int]) -> BoolArray:
    """(h, w) mask, True inside the outline (k, 2)."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    cv2.fillConvexPoly(mask, np.round(outline).astype(np.int32), 1)
    return mask.astype(bool)
