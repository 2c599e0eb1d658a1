"""Shared object model: initial center, size and a point cloud."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.tracking.region import carve_box_volume

__all__ = ["ObjectModel"]

# Maximum number of object points that define the search region (choice).
MAX_CLOUD_POINTS = 600


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
