"""How large an opaque body is, by what several cameras see of its surface, without any point that two of them share.

A camera that watches a body slide knows the shape of what it sees but not its size: size and distance grow together, for all
cameras alike. Yet all of them look at one surface. The point that is farthest out in a direction n has the whole body behind
it, so no part of the body hides it from a camera that n points to: all cameras that n faces see it, and so agree on how far
out it is. Seen too large, each camera's surface is also too far away, each in its own direction, and they do not agree.

Source: support functions, as in W. C. Karl, S. R. Kulkarni, G. C. Verghese, A. S. Willsky, "Local tests for consistency of
support hyperplane data", 1996; the rest is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sylpose.geometry.arrays import FloatArray

__all__ = ["DIRECTIONS", "Extent", "extent_of", "size_of"]

# Directions that extents are measured in, evenly over the sphere (choice).
COUNT = 200
# A direction faces a camera when the cosine between them is more than this: features are rare where a surface is seen at a
# grazing angle (choice).
FACING = 0.3
# The outermost of this share of a camera's points are not used: some of them are wrong (choice).
OUTERMOST = 0.02
# Fewer points do not show where a surface ends (choice).
MIN_POINTS = 30
# How far the outermost feature is from where the body ends, as a share of its radius, and how many of a pair's directions
# tell something for themselves; a camera that sees an end at a grazing angle misses more of it, by so much of the radius in
# the mean of all cameras (measured: tests/landmarks/test_support_size.py).
GAP, INDEPENDENT, GRAZED = 0.06, 3.0, 0.04


def _sphere(n: int) -> FloatArray:
    """(n, 3) unit vectors, evenly over the sphere (Fibonacci's spiral)."""
    k = np.arange(n)
    up, angle = 1.0 - (2.0 * k + 1.0) / n, np.pi * (3.0 - np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - up**2)
    return np.column_stack([flat * np.cos(angle), up, flat * np.sin(angle)])


DIRECTIONS = _sphere(COUNT)


@dataclass(frozen=True, eq=False)
class Extent:
    """How far one camera's points reach in each of the `DIRECTIONS`.

    Attributes:
        height: (COUNT,) n'X of the outermost point X; NaN where the direction does not face the camera.
        slope: (COUNT,) by how much that grows if the camera's points are as many times larger as they are farther away.
        distance: how far away they are, in the middle.
    """

    height: FloatArray
    slope: FloatArray
    distance: float


def extent_of(points: FloatArray, center: FloatArray) -> Extent:
    """The extent of points (n, 3) on a body that a camera at `center` (3,) sees, in one frame."""
    nothing = np.full(COUNT, np.nan)
    if len(points) < MIN_POINTS:
        return Extent(nothing, nothing, np.nan)
    along = points @ DIRECTIONS.T
    outermost = max(int(OUTERMOST * len(points)), 1)
    index = np.argpartition(along, -outermost - 1, axis=0)[-outermost - 1]
    height = np.take_along_axis(along, index[None], axis=0)[0]
    ray = points[index] - center
    slope = np.einsum("ni,ni->n", ray, DIRECTIONS)
    faces = -slope > FACING * np.linalg.norm(ray, axis=1)
    return Extent(
        np.where(faces, height, np.nan), np.where(faces, slope, np.nan), float(np.median(np.linalg.norm(ray, axis=1)))
    )


def size_of(extents: Sequence[Extent], radius: float) -> tuple[float, float]:
    """By which share all cameras' points are to be made larger so that they agree on one surface, and its standard
    deviation: infinite where no direction faces two cameras that look from different sides.

    Args:
        radius: of the body.
    """
    offs, slopes, weights = [np.empty(0)], [np.empty(0)], [np.empty(0)]
    for i, a in enumerate(extents):
        for b in extents[:i]:
            both = np.isfinite(a.height) & np.isfinite(b.height)
            offs.append((a.height - b.height)[both])
            slopes.append((a.slope - b.slope)[both])
            count = int(both.sum())
            weights.append(np.full(count, min(INDEPENDENT / max(count, 1), 1.0)))
    off, slope, weight = (np.concatenate(parts) for parts in (offs, slopes, weights))
    information = float(weight @ slope**2)
    if not information > 0.0:
        return 0.0, np.inf
    share = -float(weight @ (slope * off)) / information
    grazed = GRAZED * radius / float(np.nanmean([extent.distance for extent in extents]))
    # Where something hides a part of the body from a camera, no size makes the cameras agree.
    misfit = float(weight @ (off + share * slope) ** 2) / float(weight.sum())
    variance = max(2.0 * (GAP * radius) ** 2, misfit)
    return share - grazed, float(np.sqrt(variance / information))
