"""What all cameras know of the object itself: where it was at first, its size, a cloud of points on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.tracking.region import volume_from_boxes

__all__ = ["ObjectModel"]

# Object points kept to follow the object's region (choice).
MAX_POINTS = 600


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """The object's size and points; they grow with what is found on it, unless boxes bound it.

    Attributes:
        center: (3,) in the first frame, world; None while unknown.
        radius: length units; NaN while unknown.
        points: (n, 3) a cloud in the object's frame whose image is the object's region.
        bounded: whether boxes bound it.
        guessed: whether boxes are all that is known of its depth.
    """

    center: FloatArray | None = None
    radius: float = np.nan
    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    bounded: bool = False
    guessed: bool = False

    @classmethod
    def in_boxes(cls, rig: Rig, boxes: Mapping[str, Box]) -> ObjectModel:
        """What boxes tell of it.

        Raises:
            ValueError: boxes of cameras that the rig does not have, or that do not meet in space.
        """
        center, points = volume_from_boxes(rig, boxes)
        points = points - center
        radius = float(np.quantile(np.linalg.norm(points, axis=1), 0.95))
        return cls(center, radius, points, bounded=True, guessed=True)

    def with_points(self, points: FloatArray, seed: int) -> ObjectModel:
        """With points (n, 3) that are on the object added to its cloud, of which a random part is kept."""
        points = np.concatenate([self.points, points[np.linalg.norm(points, axis=1) < 2.0 * self.radius]])
        if len(points) > MAX_POINTS:
            points = points[np.random.default_rng(seed).choice(len(points), MAX_POINTS, replace=False)]
        return replace(self, points=points)
