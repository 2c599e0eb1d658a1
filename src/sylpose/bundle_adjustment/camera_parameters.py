"""What the cameras' shared unknowns are believed to be before the recording is looked at: one joint Gaussian.

Time offsets, surfaces and corrections of the calibration are alike in this: each camera has them once for all frames, so
what is not known of them does not average out over frames or landmarks. They are written as mean + spread z with z
standard normal; a direction that `spread` does not have is not free. The joint refinement solves for z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import helmert

from sylpose.bundle_adjustment.kernels import DEPTH, OFFSET, TURN
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray

__all__ = ["SLOPE_SD", "SURFACE_RADII", "Shared", "offsets_and_surfaces", "on_surface", "usual_surfaces"]


# The visible surface of an ordinary body lies so far in front of its middle, give or take what all cameras have in common
# (the middle is not known, nor the body's shape) and what each has for itself; in radii (measured: docs/benchmarks.md,
# "Slides").
SURFACE_RADII, COMMON_RADII, OWN_RADII = 0.5, 0.4, 0.3
# Its slope in any direction: of 60 degrees, one standard deviation (choice).
SLOPE_SD = 1.7


@dataclass(frozen=True, eq=False)
class Shared:
    """What is believed of the unknowns that C cameras have once for all frames.

    Attributes:
        mean: (C, K), columns as in `kernels`.
        spread: (C, K, k) the unknowns are mean + spread z, z standard normal.
        n_offsets: the first so many of z are time offsets, the next C the surfaces' depths.
        kind: (k,) 1 for turns, 2 for shifts and 3 for lenses of the calibration, which are believed to be off alike within
            each kind; 0 for all else, and for where cameras stand that were moved.
        shares: (4,) by what share of what is believed at first each kind is off here.
        held: (k,) those of z that stay as they are: what is not known of them is only *considered*, in the covariance.
    """

    mean: FloatArray
    spread: FloatArray
    n_offsets: int
    kind: IntArray
    shares: FloatArray
    held: BoolArray

    def of(self, z: FloatArray) -> FloatArray:
        """(C, K) the unknowns."""
        return np.asarray(self.mean + self.spread @ z)

    @property
    def depths(self) -> BoolArray:
        """(k,) which of z are the surfaces' depths."""
        k = np.arange(self.spread.shape[2]) - self.n_offsets
        return (k >= 0) & (k < len(self.mean))

    @property
    def flat(self) -> FloatArray:
        """(C K, k) the spread."""
        return self.spread.reshape(-1, self.spread.shape[2])


def usual_surfaces(radius: float, n_cameras: int) -> tuple[FloatArray, FloatArray]:
    """Mean (C,) and covariance (C, C) of how far the surfaces that cameras see are in front of the object's origin."""
    covariance = COMMON_RADII**2 * np.ones((n_cameras, n_cameras)) + OWN_RADII**2 * np.eye(n_cameras)
    return np.full(n_cameras, SURFACE_RADII * radius), radius**2 * covariance


def on_surface(
    points: FloatArray, centers: FloatArray, axes: FloatArray, reach: float
) -> tuple[FloatArray, FloatArray]:
    """What the surface that a camera sees is told by, of points (m, 3) on it; all in the object's frame.

    Args:
        centers: (m, 3) of the camera as it sees each; axes: (m, 2, 3) its x and y axis.
        reach: no point is further to the side than this.

    Returns:
        (m, 3) unit vectors from the origin towards the camera; (m, 3) 1, and how far each point is to the right of the
        origin and below it: what its height along that vector is linear in.
    """
    toward = centers / np.linalg.norm(centers, axis=1, keepdims=True)
    aside = axes - np.einsum("mki,mi->mk", axes, toward)[..., None] * toward[:, None]
    offset = np.clip(np.einsum("mki,mi->mk", aside, points), -reach, reach)
    return toward, np.column_stack([np.ones(len(points)), offset])


def offsets_and_surfaces(
    n_cameras: int, offsets_sd: float | None, used: IntArray, depth: ArrayLike, covariance: ArrayLike
) -> Shared:
    """Time offsets of the used cameras, their mean 0, if they are asked for, and all cameras' surfaces.

    Args:
        offsets_sd: seconds, of each; None: they are known.
        depth, covariance: (C,) and (C, C) as of `usual_surfaces`.

    Raises:
        ValueError: a covariance that is not positive definite.
    """
    basis = helmert(len(used)).T if offsets_sd is not None and len(used) > 1 else np.zeros((len(used), 0))
    n = basis.shape[1]
    mean, spread = np.zeros((n_cameras, TURN)), np.zeros((n_cameras, TURN, n + 3 * n_cameras))
    spread[used, OFFSET, :n] = basis * (offsets_sd or 0.0)
    mean[:, DEPTH] = depth
    try:
        spread[:, DEPTH, n : n + n_cameras] = np.linalg.cholesky(np.asarray(covariance, float))
    except np.linalg.LinAlgError:
        raise ValueError("surfaces: the covariance is not positive definite") from None
    for j in (1, 2):
        spread[:, DEPTH + j, n + j * n_cameras : n + (j + 1) * n_cameras] = SLOPE_SD * np.eye(n_cameras)
    k = spread.shape[2]
    return Shared(mean, spread, n, np.zeros(k, np.int64), np.ones(4), np.zeros(k, bool))
