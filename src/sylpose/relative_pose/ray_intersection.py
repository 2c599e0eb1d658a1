"""Location of the object from its image positions: the intersection of the cameras' rays.

Source: the least sum of squared distances to lines is that of `rig.intersect_rays`; the rest is ours
(docs/method/3-pose.md).
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import compute_median, kernel, symmetric_eigen

__all__ = ["COINCIDENCE_TOLERANCE", "compute_distance_sd", "locate_from_rays"]

# Centers whose distance is below this share of their coordinates coincide (derived: rounding).
COINCIDENCE_TOLERANCE = 1e-9
# Below this smallest eigenvalue of the normal equations of the intersection point, cameras nearly in one place do not
# determine it (choice).
MIN_EIGENVALUE = 1e-5
# Rays converge if their inverse distance is so many standard deviations above zero (choice).
MIN_CONVERGENCE_SIGMAS = 5.0
# Rays also converge if their mean is shorter than this, a cone of some 36 degrees (choice).
MIN_PARALLEL_MEAN = 0.95
# Below this ratio of the least to the largest eigenvalue of their normal equations, nearly parallel lines leave the
# point undetermined along them: 3 degrees (choice, that of `rig.intersect_rays`).
MIN_EIGENVALUE_RATIO = 1e-3


@kernel
def locate_from_rays(
    x: FloatArray, offsets: IntArray, rotations: FloatArray, centers: FloatArray, offset_sd: float, center: FloatArray
) -> float:
    """Set center (3,) to the location of the object; return its radius.

    Args:
        x: (N, 2) normalized points of all terms, split by offsets (T + 1,).
        rotations, centers: (T, 3, 3), (T, 3) of the cameras that see them.
        offset_sd: distance of a ray through the median point from the object's center, radii.
    """
    n = len(centers)
    rays, spread, anchor = np.empty((n, 3)), np.empty(n), np.empty(2)
    for t in range(n):
        points = x[offsets[t] : offsets[t + 1]]
        distances = np.empty(len(points))
        for a in range(2):
            distances[:] = points[:, a]
            anchor[a] = compute_median(distances)
        for i in range(len(points)):
            distances[i] = np.sqrt((points[i, 0] - anchor[0]) ** 2 + (points[i, 1] - anchor[1]) ** 2)
        spread[t] = compute_median(distances)
        length = np.sqrt(anchor[0] ** 2 + anchor[1] ** 2 + 1.0)
        for i in range(3):
            rays[t, i] = (rotations[t, 0, i] * anchor[0] + rotations[t, 1, i] * anchor[1] + rotations[t, 2, i]) / length
    _intersect_rays(centers, rays, spread, offset_sd, center)
    radius, depths = 0.0, 0.0
    for t in range(n):
        depth = 0.0
        for i in range(3):
            depth += rotations[t, 2, i] * (center[i] - centers[t, i])
        depths += abs(depth) / n
        radius += 2.0 * (offsets[t + 1] - offsets[t]) * spread[t] * abs(depth) / offsets[n]
    return max(radius, 1e-6 * depths)


@kernel
def _intersect_rays(
    centers: FloatArray, rays: FloatArray, spread: FloatArray, offset_sd: float, out: FloatArray
) -> None:
    """Intersect rays (T, 3) from centers (T, 3), each of which misses the object's center.

    If the centers are close together, the errors of the rays, a part `offset_sd` of the object's radius of 2 spread,
    outweigh their convergence: they may meet at any distance, or behind the cameras. The object is then placed no
    farther away than one standard deviation of its inverse distance allows.
    """
    n = len(centers)
    middle, along, slope, max_coordinate = np.zeros(3), np.zeros(3), np.zeros(3), 0.0
    for t in range(n):
        for i in range(3):
            middle[i] += centers[t, i] / n
            along[i] += rays[t, i] / n
            max_coordinate = max(max_coordinate, abs(centers[t, i]))
    length = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    if not length > MIN_PARALLEL_MEAN:
        _find_nearest_point(centers, rays, middle, along, out)
        return
    squares, convergence = 0.0, 0.0
    for t in range(n):
        across, forward = 0.0, 0.0
        for i in range(3):
            across += (centers[t, i] - middle[i]) * along[i] / length
            forward += rays[t, i] * along[i] / length
        # In the transverse plane, a ray from position b has the slope (c - b) / depth for an object at c.
        for i in range(3):
            lateral = centers[t, i] - middle[i] - across * along[i] / length
            squares += lateral**2
            convergence -= rays[t, i] / forward * lateral
            slope[i] += rays[t, i] / forward / n
    near = squares > (COINCIDENCE_TOLERANCE * max_coordinate) ** 2
    sd = offset_sd * 2.0 * spread.sum() / n / np.sqrt(squares) if near else np.inf
    inverse = convergence / squares if near else 0.0
    if inverse > MIN_CONVERGENCE_SIGMAS * sd or not np.isfinite(sd):
        _find_nearest_point(centers, rays, middle, along, out)
        return
    for i in range(3):
        out[i] = middle[i] + slope[i] / (0.5 * (inverse + np.hypot(inverse, 2.0 * sd)))


@kernel
def _find_nearest_point(
    centers: FloatArray, rays: FloatArray, middle: FloatArray, along: FloatArray, out: FloatArray
) -> None:
    """Find the point with the least sum of squared distances to rays, as `rig.intersect_rays` does.

    middle and along are the means of the centers and of the rays.
    """
    near, right, total = np.empty(3), np.zeros(3), np.zeros((3, 3))
    length = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    for i in range(3):
        near[i] = middle[i] + (along[i] / length if length > 0.5 else 0.0)
    for t in range(len(centers)):
        along_ray = 0.0
        for i in range(3):
            along_ray += rays[t, i] * (centers[t, i] - near[i])
        for i in range(3):
            right[i] += centers[t, i] - near[i] - along_ray * rays[t, i]
            total[i, i] += 1.0
            for j in range(3):
                total[i, j] -= rays[t, i] * rays[t, j]
    values, vectors = np.empty(3), np.empty((3, 3))
    symmetric_eigen(total, values, vectors)
    out[:] = near
    for k in range(3):
        if values[k] > MIN_EIGENVALUE_RATIO * values[2]:
            part = (vectors[0, k] * right[0] + vectors[1, k] * right[1] + vectors[2, k] * right[2]) / values[k]
            for i in range(3):
                out[i] += part * vectors[i, k]


@kernel
def compute_distance_sd(a1: FloatArray, qx: FloatArray, offset_sd: float, out: FloatArray) -> None:
    """Set out (T,) to the additional standard deviation of each term's inverse depth of g, in radii of the object.

    It is signed, since all terms share one unknown. g is the intersection of the terms' median rays, each of which
    misses the object's center by about `offset_sd` radii. Cameras close together as seen from the object, or on
    opposite sides of it, magnify that error along their viewing direction. Cameras in one place do not determine the
    distance, and nothing is added.
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
    if not values[0] > MIN_EIGENVALUE:
        out[:] = 0.0
        return
    excess_sd = offset_sd * np.sqrt(max(1.0 / values[0] - 1.0, 0.0))
    for t in range(n):
        out[t] = -excess_sd * (qx[t, 2, 0] * vectors[0, 0] + qx[t, 2, 1] * vectors[1, 0] + qx[t, 2, 2] * vectors[2, 0])
