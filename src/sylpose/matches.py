"""Matches: points that one camera sees in two frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sylpose.numerics.arrays import FloatArray
from sylpose.rig import Camera

__all__ = ["STILL_PX", "Matches"]

# A feature displaced by less than this, in pixels, stands still for all that two keypoints can tell.
STILL_PX = 1.5


@dataclass(frozen=True, eq=False)
class Matches:
    """Points that one camera sees in two frames i and j, undistorted.

    Attributes:
        x: (n, 2) normalised points in frame i.
        y: (n, 2) the same features' normalised points in frame j.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """

    x: FloatArray
    y: FloatArray

    def __post_init__(self) -> None:
        # Row by row in memory, as the compiled solvers want it.
        x, y = (np.array(part, dtype=float, order="C").reshape(-1, 2) for part in (self.x, self.y))
        if x.shape != y.shape:
            raise ValueError(f"matches need as many points in frame i as in j, got {len(x)} and {len(y)}")
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise ValueError("matches have points that are not finite")
        object.__setattr__(self, "x", x)
        object.__setattr__(self, "y", y)

    @classmethod
    def none(cls) -> Matches:
        """No matches: what a camera has that does not see the object."""
        return cls(np.empty((0, 2)), np.empty((0, 2)))

    @classmethod
    def from_pixels(cls, camera: Camera, pixels_i: ArrayLike, pixels_j: ArrayLike) -> Matches:
        """Matches from pixels (n, 2) of the images as recorded; the lens is taken out here, once."""
        return cls(camera.normalize(pixels_i), camera.normalize(pixels_j))

    def __len__(self) -> int:
        return len(self.x)
