"""Matches: image points of one camera in two frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sylpose.display import Printable
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import check_finite_rows, check_type
from sylpose.rig import Camera

# Largest coordinate of a point: 1e6 times the field of view of a lens (choice).
MAX_COORDINATE = 1e9

# A feature displaced by less than this, in pixels, is static within the accuracy of keypoints.
STATIC_PX = 1.5
# A feature displaced by more than this, in pixels, has moved whatever the noise; if the median of a camera's landmarks is,
# the camera has moved (choice).
MAX_STATIC_PX = 6.0


@dataclass(frozen=True, eq=False, repr=False)
class Matches(Printable):
    """Matched points of one camera in two frames i and j, undistorted.

    Attributes:
        x: (n, 2) normalized points in frame i.
        y: (n, 2) the same features' normalized points in frame j.

    Raises:
        ValueError: other shapes (nothing is reshaped), or values that are not real and finite.
    """

    x: FloatArray
    y: FloatArray

    def __post_init__(self) -> None:
        # Contiguous by rows, as the compiled solvers require.
        parts = (("matches: x", self.x), ("matches: y", self.y))
        x, y = (np.array(check_finite_rows(part, 2, name, maximum=MAX_COORDINATE)) for name, part in parts)
        if x.shape != y.shape:
            raise ValueError(f"matches need as many points in frame i as in j, got {len(x)} and {len(y)}")
        object.__setattr__(self, "x", x)
        object.__setattr__(self, "y", y)

    @classmethod
    def empty(cls) -> Matches:
        """Return an empty set, for a camera that does not observe the object."""
        return cls(np.empty((0, 2)), np.empty((0, 2)))

    @classmethod
    def from_pixels(cls, camera: Camera, pixels_i: ArrayLike, pixels_j: ArrayLike) -> Matches:
        """Make matches from pixels of the images as recorded; undistorts them.

        Args:
            camera: the camera.
            pixels_i, pixels_j: (n, 2) pixels in frames i and j.

        Raises:
            ValueError: naming the argument: wrong shape, values that are not real and finite, or different lengths.
        """
        camera = check_type(camera, Camera, "camera")
        i, j = check_finite_rows(pixels_i, 2, "pixels_i"), check_finite_rows(pixels_j, 2, "pixels_j")
        return cls(camera.normalize(i), camera.normalize(j))

    def __len__(self) -> int:
        return len(self.x)
