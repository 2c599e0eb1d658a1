"""Evidence of a camera and its serialization: a quadratic cost on SO(3) (56 numbers) and surface sums (80 numbers)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import pack_upper, unpack_symmetric
from sylpose.moments import PairMoments
from sylpose.sylvester.depth_bias import SLOPE_GRID, SurfaceSums
from sylpose.sylvester.orthographic import build_cost, compute_views
from sylpose.sylvester.so3 import MIN_RELATIVE_VARIANCE, QuadraticCost

__all__ = [
    "EVIDENCE_SIZE",
    "SURFACE_SUMS_SIZE",
    "compute_evidence",
    "pack_evidence",
    "pack_sums",
    "relative_noise",
    "unpack_evidence",
    "unpack_sums",
]

# Number of values of the evidence: H's upper triangle, h, constant and weight (derived).
EVIDENCE_SIZE = 45 + 9 + 2
# Number of values of `depth_bias.SurfaceSums`: hessian, camera slopes and scales; body slopes; normal equations and log
# determinants (derived).
SURFACE_SUMS_SIZE = 3 * 6 + 18 + len(SLOPE_GRID) * (10 + 1)


def compute_evidence(rotation: ArrayLike, moments: PairMoments, *, aim: bool = True) -> QuadraticCost:
    """Compute the evidence of one camera, the cost of its matches; zero if they have no spread.

    Args:
        rotation: (3, 3) Q of camera_from_world.
        moments: the camera's pair moments.
        aim: as in `compute_views`.

    Raises:
        ValueError: rotation is not a rotation matrix.
    """
    views = compute_views(np.asarray(rotation, dtype=float)[None], [moments], aim=aim)
    try:
        return build_cost(views)
    except ValueError:
        return QuadraticCost.zero()


def pack_evidence(evidence: QuadraticCost) -> FloatArray:
    """Pack evidence into (56,) values. Packing is linear: means and sums of the values are those of the evidence."""
    return np.array([*pack_upper(evidence.H), *evidence.h, evidence.constant, evidence.weight])


def unpack_evidence(values: FloatArray) -> QuadraticCost:
    """Unpack the values of `pack_evidence`."""
    return QuadraticCost(unpack_symmetric(values[:45]), values[45:54], values[54], values[55])


def relative_noise(cost: float, size: float, weight: float) -> float:
    """Return `QuadraticCost.variance` over `QuadraticCost.size`, the noise argument of `compute_surface_sums`."""
    return max(cost / size, MIN_RELATIVE_VARIANCE) / weight


def pack_sums(sums: SurfaceSums, noise: float) -> FloatArray:
    """Pack surface sums into (80,) values, none much larger than 1; they add like the sums.

    `noise` is as in `compute_surface_sums`.
    """
    squares = [pack_upper(matrix) for matrix in sums[:3]]
    fits = [noise * pack_upper(fit) for fit in sums.normal_equations]
    return np.concatenate([*squares, sums.body_slopes.ravel(), *fits, sums.log_determinants])


def unpack_sums(values: FloatArray, noise: float) -> SurfaceSums:
    """Unpack the values of `pack_sums`."""
    hessian, camera_slopes, scales = (unpack_symmetric(part) for part in values[:18].reshape(3, 6))
    fits = np.array([unpack_symmetric(part) for part in values[36 : -len(SLOPE_GRID)].reshape(-1, 10)]) / noise
    return SurfaceSums(hessian, camera_slopes, scales, values[18:36].reshape(3, 6), fits, values[-len(SLOPE_GRID) :])
