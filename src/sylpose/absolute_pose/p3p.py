"""Generalized P3P, the minimal solver of `estimate_pose`: three points on three rays of one or several cameras."""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf

# Intervals searched for sign changes, and iterations of a root (choice).
N_INTERVALS, ROOT_STEPS = 16, 12
# Three points are collinear if the squared area of their triangle is below this fraction of its sides' (choice).
MIN_AREA_RATIO = 1e-6
# Tolerance of a root, relative to the third side's square (choice).
ROOT_TOLERANCE = 1e-10


@leaf
def _align_triangles(
    points: FloatArray, model: FloatArray, rotation: FloatArray, translation: FloatArray, axes: FloatArray
) -> None:
    """Write rotation (3, 3) and translation (3,) from one triangle to a congruent one.

    The model (3, 3) is mapped to the points (3, 3).
    """
    for k in range(2):
        corners, f = points if k == 0 else model, axes[k]
        for j in range(3):
            f[0, j], f[1, j] = corners[1, j] - corners[0, j], corners[2, j] - corners[0, j]
        for a, b, out in ((0, 1, 2), (2, 0, 1)):
            for j in range(3):
                k1, k2 = (j + 1) % 3, (j + 2) % 3
                f[out, j] = f[a, k1] * f[b, k2] - f[a, k2] * f[b, k1]
        for i in range(3):
            length = np.sqrt(f[i, 0] ** 2 + f[i, 1] ** 2 + f[i, 2] ** 2)
            for j in range(3):
                f[i, j] /= length
    p, m = axes[0], axes[1]
    for i in range(3):
        for j in range(3):
            rotation[i, j] = p[0, i] * m[0, j] + p[1, i] * m[1, j] + p[2, i] * m[2, j]
    for i in range(3):
        translation[i] = 0.0
        for k in range(3):
            rotated = rotation[i, 0] * model[k, 0] + rotation[i, 1] * model[k, 1] + rotation[i, 2] * model[k, 2]
            translation[i] += (points[k, i] - rotated) / 3.0


@leaf
def _dot(a: FloatArray, b: FloatArray) -> float:
    product: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


@kernel
def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    out = np.empty(3)
    for i in range(3):
        out[i] = b[i] - a[i]
    return out


@leaf
def _intersect_ray(q: FloatArray, l: float, sign: float) -> float:
    """Return the position on the other ray at the side's distance from the point at l, before or behind the foot."""
    distance: float = q[3] + q[4] * l + sign * np.sqrt(max(q[5] - (q[0] * l * l + 2.0 * q[1] * l + q[2]), 0.0))
    return distance


@leaf
def _squared_excess(q: FloatArray, l2: float, l3: float) -> float:
    """Return the excess of the squared third side between the points at l2 and l3."""
    excess: float = q[0] + l2 * l2 + l3 * l3 + 2.0 * (l2 * q[1] - l3 * q[2] - l2 * l3 * q[3]) - q[4]
    return excess


@kernel
def solve_p3p(
    origins: FloatArray, rays: FloatArray, model: FloatArray, rotations: FloatArray, translations: FloatArray
) -> int:
    """Compute the poses that put three model points on three rays.

    The rays are central (P3P) or from several cameras (generalized P3P).

    With the first point at l along its ray, the second is one of two intersections of the sphere of their distance with
    the second ray, and the third likewise. The distance between these two is then a function of l whose roots are the
    poses, on the interval where both spheres intersect their rays. Roots are found from sign changes, so two very close
    ones may be missed; the many samples compensate.

    Args:
        origins, rays, model: (3, 3) the rays' origins and unit directions, and the model points.
        rotations, translations: (8, 3, 3) and (8, 3), filled.

    Returns:
        number of poses.
    """
    side2, side3 = _difference(model[0], model[1]), _difference(model[0], model[2])
    square2, square3, cross_product = _dot(side2, side2), _dot(side3, side3), _dot(side2, side3)
    # Collinear points do not determine the rotation about their line.
    if not square2 * square3 - cross_product * cross_product > MIN_AREA_RATIO * square2 * square3:
        return 0
    # Per side: squared distance of the first point from the other ray a l^2 + 2 b l + c, its foot there e + f l,
    # side^2.
    g = np.empty((3, 6))
    low, high = 0.0, np.inf
    for j in range(2):
        v, ray = _difference(origins[1 + j], origins[0]), rays[1 + j]
        cosine, along = _dot(rays[0], ray), _dot(v, ray)
        a, b, c = 1.0 - cosine * cosine, _dot(v, rays[0]) - along * cosine, _dot(v, v) - along * along
        side = square2 if j == 0 else square3
        g[j, 0], g[j, 1], g[j, 2], g[j, 3], g[j, 4], g[j, 5] = a, b, c, along, cosine, side
        if a > 1e-12:
            inside = b * b - a * (c - side)
            if not inside > 0.0:
                return 0
            low, high = max(low, (-b - np.sqrt(inside)) / a), min(high, (-b + np.sqrt(inside)) / a)
    if not (low < high and high < np.inf):
        return 0
    w, third = _difference(origins[2], origins[1]), _difference(model[2], model[1])
    g[2, 0], g[2, 1], g[2, 2], g[2, 3] = _dot(w, w), _dot(w, rays[1]), _dot(w, rays[2]), _dot(rays[1], rays[2])
    g[2, 4] = _dot(third, third)
    # Dense at the ends, where the intersections change fast.
    grid = np.empty((N_INTERVALS + 1, 5))
    for k in range(N_INTERVALS + 1):
        l = 0.5 * (low + high - (high - low) * np.cos(np.pi * k / N_INTERVALS))
        grid[k, 0] = l
        for j in range(2):
            grid[k, 1 + 2 * j], grid[k, 2 + 2 * j] = _intersect_ray(g[j], l, -1.0), _intersect_ray(g[j], l, 1.0)
    lengths, points, axes = np.empty(3), np.empty((3, 3)), np.empty((2, 3, 3))
    tolerance = ROOT_TOLERANCE * g[2, 4]
    n_poses = 0
    for branch in range(4):
        at2, at3 = 1 + branch // 2, 3 + branch % 2
        sign2, sign3 = 2.0 * (branch // 2) - 1.0, 2.0 * (branch % 2) - 1.0
        f_last = _squared_excess(g[2], grid[0, at2], grid[0, at3])
        for k in range(1, N_INTERVALS + 1):
            f_next = _squared_excess(g[2], grid[k, at2], grid[k, at3])
            if (f_last < 0.0) != (f_next < 0.0) and n_poses < 8:
                a, fa, b, fb = grid[k - 1, 0], f_last, grid[k, 0], f_next
                for _ in range(ROOT_STEPS):  # regula falsi, Illinois
                    lengths[0] = (a * fb - b * fa) / (fb - fa)
                    lengths[1] = _intersect_ray(g[0], lengths[0], sign2)
                    lengths[2] = _intersect_ray(g[1], lengths[0], sign3)
                    f = _squared_excess(g[2], lengths[1], lengths[2])
                    if abs(f) < tolerance:
                        break
                    if (f < 0.0) == (fb < 0.0):
                        fa *= 0.5
                    else:
                        a, fa = b, fb
                    b, fb = lengths[0], f
                if lengths[0] > 0.0 and lengths[1] > 0.0 and lengths[2] > 0.0:
                    for i in range(3):
                        for j in range(3):
                            points[i, j] = origins[i, j] + lengths[i] * rays[i, j]
                    _align_triangles(points, model, rotations[n_poses], translations[n_poses], axes)
                    n_poses += 1
            f_last = f_next
    return n_poses
