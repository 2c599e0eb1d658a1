"""Model of the object: center, size and a point cloud, at first from the boxes that contain it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sylpose.frames import Box
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.rig import Camera, Rig, intersect_rays

# Maximum number of object points that define the search region (choice).
MAX_CLOUD_POINTS = 600
# So many points of known depth describe the object's surface (choice).
MIN_SURFACE_POINTS = 20
# Points per axis of the grids carved by the boxes; number of grids, each fitted to what the previous one has left
# (choice).
GRID_POINTS, N_GRIDS = 15, 3


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """Size and point cloud of the object; points are added unless boxes bound it.

    Attributes:
        center: (3,) in the first frame, world; None while unknown.
        radius: length units; NaN while unknown.
        points: (n, 3) point cloud in the object's frame; its projection is the search region.
        is_bounded: whether boxes bound the object.
        is_depth_guessed: whether its depth is known from boxes only.
    """

    center: FloatArray | None = None
    radius: float = np.nan
    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    is_bounded: bool = False
    is_depth_guessed: bool = False

    @classmethod
    def from_boxes(cls, rig: Rig, boxes: Mapping[str, Box]) -> ObjectModel:
        """Create the model from boxes.

        Raises:
            ValueError: boxes of cameras that are not in the rig, or that do not intersect in space.
        """
        center, points = carve_box_volume(rig, boxes)
        points = points - center
        radius = float(np.quantile(np.linalg.norm(points, axis=1), 0.95))
        return cls(center, radius, points, is_bounded=True, is_depth_guessed=True)

    def add_points(self, points: FloatArray, seed: int) -> ObjectModel:
        """Add points (n, 3) on the object to the cloud; keep a random subset if there are too many."""
        points = np.concatenate([self.points, points[np.linalg.norm(points, axis=1) < 2.0 * self.radius]])
        if len(points) > MAX_CLOUD_POINTS:
            points = points[np.random.default_rng(seed).choice(len(points), MAX_CLOUD_POINTS, replace=False)]
        return replace(self, points=points)


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
