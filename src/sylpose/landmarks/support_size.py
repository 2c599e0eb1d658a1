"""Size of an opaque body from several cameras' views of its surface, without common points.

A camera that observes a translating body determines its shape but not its size: size and distance are proportional,
with one factor for all cameras. Yet all of them observe one surface. The point that extends farthest in a direction n
has the whole body behind it, so the body does not occlude it from a camera that n points to. All cameras that n faces
observe it, and must agree on its extent. If the size is too large, each camera's surface is also too far away, each in
a different direction, and they disagree.

Source: support functions, as in W. C. Karl, S. R. Kulkarni, G. C. Verghese, A. S. Willsky, "Local tests for consistency
of support hyperplane data", 1996; the rest is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sylpose.geometry.arrays import FloatArray

# Directions in which extents are measured, uniformly over the sphere (choice).
N_DIRECTIONS = 200
# A direction faces a camera if the cosine between them is larger than this: features are rare on surfaces at grazing
# angles (choice).
MIN_FACING_COSINE = 0.3
# The outermost fraction of a camera's points is ignored: some of them are outliers (choice).
TRIM_RATIO = 0.02
# Minimum number of points to determine where a surface ends (choice).
MIN_POINTS = 30
# Distance of the outermost feature from the body's end, as a fraction of its radius; number of independent directions
# of a pair of cameras; and additional distance, as a fraction of the radius in the mean of all cameras, at grazing
# angles (measured: tests/landmarks/test_support_size.py).
GAP_RATIO, N_INDEPENDENT, GRAZING_RATIO = 0.06, 3.0, 0.04


def _fibonacci_sphere(n: int) -> FloatArray:
    """Return (n, 3) unit vectors, uniformly over the sphere (Fibonacci's spiral)."""
    k = np.arange(n)
    up, angle = 1.0 - (2.0 * k + 1.0) / n, np.pi * (3.0 - np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - up**2)
    return np.column_stack([flat * np.cos(angle), up, flat * np.sin(angle)])


DIRECTIONS = _fibonacci_sphere(N_DIRECTIONS)


@dataclass(frozen=True, eq=False)
class Extent:
    """Extent of one camera's points in each of the `DIRECTIONS`.

    Attributes:
        height: (N_DIRECTIONS,) n'X of the outermost point X; NaN where the direction does not face the camera.
        slope: (N_DIRECTIONS,) its derivative by a common relative change of the points' size and distance from the
            camera.
        distance: median distance of the points from the camera.
    """

    height: FloatArray
    slope: FloatArray
    distance: float


def compute_extent(points: FloatArray, center: FloatArray) -> Extent:
    """Return the extent of points (n, 3) on a body observed by a camera at `center` (3,), in one frame."""
    nothing = np.full(N_DIRECTIONS, np.nan)
    if len(points) < MIN_POINTS:
        return Extent(nothing, nothing, np.nan)
    projections = points @ DIRECTIONS.T
    n_trimmed = max(int(TRIM_RATIO * len(points)), 1)
    index = np.argpartition(projections, -n_trimmed - 1, axis=0)[-n_trimmed - 1]
    height = np.take_along_axis(projections, index[None], axis=0)[0]
    ray = points[index] - center
    slope = np.einsum("ni,ni->n", ray, DIRECTIONS)
    is_facing = -slope > MIN_FACING_COSINE * np.linalg.norm(ray, axis=1)
    return Extent(
        np.where(is_facing, height, np.nan),
        np.where(is_facing, slope, np.nan),
        float(np.median(np.linalg.norm(ray, axis=1))),
    )


def estimate_size(extents: Sequence[Extent], radius: float) -> tuple[float, float]:
    """Estimate the relative size change by which all cameras agree on one surface.

    Args:
        extents: of the cameras.
        radius: of the body.

    Returns:
        the change; its standard deviation, infinite if no direction faces two cameras with different viewing
        directions.
    """
    differences, slopes, weights = [np.empty(0)], [np.empty(0)], [np.empty(0)]
    for i, a in enumerate(extents):
        for b in extents[:i]:
            is_shared = np.isfinite(a.height) & np.isfinite(b.height)
            differences.append((a.height - b.height)[is_shared])
            slopes.append((a.slope - b.slope)[is_shared])
            count = int(is_shared.sum())
            weights.append(np.full(count, min(N_INDEPENDENT / max(count, 1), 1.0)))
    difference, slope, weight = (np.concatenate(parts) for parts in (differences, slopes, weights))
    information = float(weight @ slope**2)
    if not information > 0.0:
        return 0.0, np.inf
    relative_change = -float(weight @ (slope * difference)) / information
    grazing_bias = GRAZING_RATIO * radius / float(np.nanmean([extent.distance for extent in extents]))
    # If a part of the body is occluded from a camera, no size makes the cameras agree.
    misfit = float(weight @ (difference + relative_change * slope) ** 2) / float(weight.sum())
    variance = max(2.0 * (GAP_RATIO * radius) ** 2, misfit)
    return relative_change - grazing_bias, float(np.sqrt(variance / information))
