"""Where the object is, by where its matches are in the images: where the cameras' rays meet.

Source: the least sum of squared distances to lines is that of `rig.nearest_point_to_rays`; the rest is ours
(docs/method.md).
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel, median_of, symmetric_eigen

__all__ = ["ROUNDING", "misplaced", "placed"]

# Centers nearer to each other than this, of their coordinates, are one (derived: rounding).
ROUNDING = 1e-9
# g is where median rays meet: cameras nearly in one place, by the smallest eigenvalue of the normal equations of that point,
# tell nothing of it (choice).
ONE_PLACE = 1e-5
# Where their inverse distance is so many standard deviations above nothing, rays do meet (choice).
CONVERGING = 5.0
# Where rays go so far apart that their mean is shorter, a cone of some 36 degrees, they do (choice).
CLOSE_RAYS = 0.95
# Lines that are this near to parallel, in the least eigenvalue of their normal equations over the largest, leave the point
# open along them: 3 degrees (choice, that of `rig.nearest_point_to_rays`).
PARALLEL = 1e-3


@kernel
def placed(
    x: FloatArray, offsets: IntArray, turns: FloatArray, centers: FloatArray, offset_sd: float, center: FloatArray
) -> float:
    """center (3,) becomes where the object is; returns its radius.

    Args:
        x: (N, 2) normalised points of all terms, which offsets (T + 1,) part.
        turns, centers: (T, 3, 3), (T, 3) of the cameras that see them.
        offset_sd: by how much a ray through the middle of the points misses the object's centre, radii.
    """
    n = len(centers)
    rays, spread, anchor = np.empty((n, 3)), np.empty(n), np.empty(2)
    for t in range(n):
        mine = x[offsets[t] : offsets[t + 1]]
        far = np.empty(len(mine))
        for a in range(2):
            far[:] = mine[:, a]
            anchor[a] = median_of(far)
        for i in range(len(mine)):
            far[i] = np.sqrt((mine[i, 0] - anchor[0]) ** 2 + (mine[i, 1] - anchor[1]) ** 2)
        spread[t] = median_of(far)
        length = np.sqrt(anchor[0] ** 2 + anchor[1] ** 2 + 1.0)
        for i in range(3):
            rays[t, i] = (turns[t, 0, i] * anchor[0] + turns[t, 1, i] * anchor[1] + turns[t, 2, i]) / length
    _meeting_point(centers, rays, spread, offset_sd, center)
    radius, depths = 0.0, 0.0
    for t in range(n):
        depth = 0.0
        for i in range(3):
            depth += turns[t, 2, i] * (center[i] - centers[t, i])
        depths += abs(depth) / n
        radius += 2.0 * (offsets[t + 1] - offsets[t]) * spread[t] * abs(depth) / offsets[n]
    return max(radius, 1e-6 * depths)


@kernel
def _meeting_point(
    centers: FloatArray, rays: FloatArray, spread: FloatArray, offset_sd: float, out: FloatArray
) -> None:
    """Where rays (T, 3) from centers (T, 3) through the middle of objects meet, each of which misses the object's centre.

    Where the centers are close together, what the rays miss by, a part `offset_sd` of the object's radius of 2 spread,
    outweighs what they converge by: they may meet at any distance, or behind the cameras. Then the object is put no farther
    away than a standard deviation of its inverse distance allows.
    """
    n = len(centers)
    middle, along, slope, farthest = np.zeros(3), np.zeros(3), np.zeros(3), 0.0
    for t in range(n):
        for i in range(3):
            middle[i] += centers[t, i] / n
            along[i] += rays[t, i] / n
            farthest = max(farthest, abs(centers[t, i]))
    length = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    if not length > CLOSE_RAYS:
        _nearest(centers, rays, middle, along, out)
        return
    squares, converging = 0.0, 0.0
    for t in range(n):
        across, forward = 0.0, 0.0
        for i in range(3):
            across += (centers[t, i] - middle[i]) * along[i] / length
            forward += rays[t, i] * along[i] / length
        # Seen in the plane across, a ray has the slope (c - b) / depth at the place b, for an object about c.
        for i in range(3):
            beside = centers[t, i] - middle[i] - across * along[i] / length
            squares += beside**2
            converging -= rays[t, i] / forward * beside
            slope[i] += rays[t, i] / forward / n
    near = squares > (ROUNDING * farthest) ** 2
    sd = offset_sd * 2.0 * spread.sum() / n / np.sqrt(squares) if near else np.inf
    inverse = converging / squares if near else 0.0
    if inverse > CONVERGING * sd or not np.isfinite(sd):
        _nearest(centers, rays, middle, along, out)
        return
    for i in range(3):
        out[i] = middle[i] + slope[i] / (0.5 * (inverse + np.hypot(inverse, 2.0 * sd)))


@kernel
def _nearest(centers: FloatArray, rays: FloatArray, middle: FloatArray, along: FloatArray, out: FloatArray) -> None:
    """The point with the least sum of squared distances to rays, of which middle and along are the mean: as
    `rig.nearest_point_to_rays` has it."""
    near, right, total = np.empty(3), np.zeros(3), np.zeros((3, 3))
    length = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    for i in range(3):
        near[i] = middle[i] + (along[i] / length if length > 0.5 else 0.0)
    for t in range(len(centers)):
        beside = 0.0
        for i in range(3):
            beside += rays[t, i] * (centers[t, i] - near[i])
        for i in range(3):
            right[i] += centers[t, i] - near[i] - beside * rays[t, i]
            total[i, i] += 1.0
            for j in range(3):
                total[i, j] -= rays[t, i] * rays[t, j]
    values, vectors = np.empty(3), np.empty((3, 3))
    symmetric_eigen(total, values, vectors)
    out[:] = near
    for k in range(3):
        if values[k] > PARALLEL * values[2]:
            part = (vectors[0, k] * right[0] + vectors[1, k] * right[1] + vectors[2, k] * right[2]) / values[k]
            for i in range(3):
                out[i] += part * vectors[i, k]


@kernel
def misplaced(a1: FloatArray, qx: FloatArray, offset_sd: float, out: FloatArray) -> None:
    """out (T,): how much worse than its offset's scatter each term's inverse depth of g is known, in radii of the object;
    signed, since one unknown is behind them all.

    g is where the terms' median rays meet, each of which misses the object's centre by `offset_sd` radii or so. Cameras
    close together, seen from the object, or on opposite sides of it, magnify that along the direction that they see it in.
    Those in one place tell nothing of it, and nothing is assumed.
    """
    n = len(a1)
    total, values, vectors = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    for t in range(n):
        length = max(np.sqrt(a1[t, 0] ** 2 + a1[t, 1] ** 2 + a1[t, 2] ** 2), 1e-300)
        for i in range(3):
            total[i, i] += 1.0
            for j in range(3):
                total[i, j] -= a1[t, i] * a1[t, j] / (length * length)
    # The sum of the eigenvalues is twice the number of rays, and none exceeds that number: at most one is below 1.
    symmetric_eigen(total, values, vectors)
    if not values[0] > ONE_PLACE:
        out[:] = 0.0
        return
    worse = offset_sd * np.sqrt(max(1.0 / values[0] - 1.0, 0.0))
    for t in range(n):
        out[t] = -worse * (qx[t, 2, 0] * vectors[0, 0] + qx[t, 2, 1] * vectors[1, 0] + qx[t, 2, 2] * vectors[2, 0])
