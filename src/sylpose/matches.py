"""Matches: points that one camera sees in two frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sylpose.display import Telling, Told
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import finite_rows, kind_of
from sylpose.rig import Camera

__all__ = ["STILL_PX", "Matches"]

# No point is farther from the middle of an image: 1e6 times what a lens can see (choice).
MOST_POINT = 1e9

# A feature displaced by less than this, in pixels, stands still for all that two keypoints can tell.
STILL_PX = 1.5


@dataclass(frozen=True, eq=False, repr=False)
class Matches(Told):
    """Points that one camera sees in two frames i and j, undistorted.

    Attributes:
        x: (n, 2) normalised points in frame i.
        y: (n, 2) the same features' normalised points in frame j.

    Raises:
        ValueError: other shapes (nothing is reshaped), no real numbers, or values that are not finite.
    """

    x: FloatArray
    y: FloatArray

    def __post_init__(self) -> None:
        # Row by row in memory, as the compiled solvers want it.
        x, y = (
            np.array(finite_rows(part, 2, f"matches: {name}", most=MOST_POINT))
            for name, part in (("x", self.x), ("y", self.y))
        )
        if x.shape != y.shape:
            raise ValueError(f"matches need as many points in frame i as in j, got {len(x)} and {len(y)}")
        object.__setattr__(self, "x", x)
        object.__setattr__(self, "y", y)

    @classmethod
    def none(cls) -> Matches:
        """No matches: what a camera has that does not see the object."""
        return cls(np.empty((0, 2)), np.empty((0, 2)))

    @classmethod
    def from_pixels(cls, camera: Camera, pixels_i: ArrayLike, pixels_j: ArrayLike) -> Matches:
        """Matches from pixels (n, 2) of the images as recorded; the lens is taken out here, once.

        Raises:
            ValueError: naming the argument: another shape, no real numbers, values that are not finite; not as many in both.
        """
        camera = kind_of(camera, Camera, "camera")
        i, j = finite_rows(pixels_i, 2, "pixels_i"), finite_rows(pixels_j, 2, "pixels_j")
        return cls(camera.normalize(i), camera.normalize(j))

    def __len__(self) -> int:
        return len(self.x)

    def _told(self) -> Telling:
        far = (
            f", moved by {np.median(np.linalg.norm(self.y - self.x, axis=1)):.3g} of the focal length"
            if len(self)
            else ""
        )
        return Telling(f"{len(self)} points in two frames{far}" + (" in the median" if far else ""))
