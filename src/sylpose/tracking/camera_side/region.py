"""Region of the object in a camera's image: the projection of a point cloud that fills the object."""

from __future__ import annotations

import cv2
import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.rig import Camera

# An outline (k, 2) in pixels; None: out of view.
Region = FloatArray | None
# Margin of the object's search region, as a share of its size in the image (choice).
REGION_MARGIN = 0.15
# Directions in which an outline is dilated (choice).
DILATION_DIRECTIONS = np.array([[np.cos(angle), np.sin(angle)] for angle in np.linspace(0, 2 * np.pi, 9)[:-1]])


def project_outline(camera: Camera, points: FloatArray, margin_ratio: float) -> Region:
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


def rasterize_outline(outline: Region, size: tuple[int, int]) -> BoolArray:
    """Return a mask (h, w), True inside the outline (k, 2); all False without one."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    if outline is not None:
        cv2.fillConvexPoly(mask, np.round(outline).astype(np.int32), 1)
    return mask.astype(bool)
