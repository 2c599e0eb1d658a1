"""The minimal solver of `estimate_pose`: three known points on three rays, from one camera or several."""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf

__all__ = ["three_rays"]


# Intervals on which the minimal solver looks for a change of sign, and steps to the root (choice).
INTERVALS, ROOT_STEPS = 16, 12
# Three points lie on a line where the square of their triangle's area is less than this share of its sides' (choice).
ON_LINE = 1e-6
# A root's error, as a share of the third side's square (choice).
ROOT_ERROR = 1e-10


@leaf
def _align(points: FloatArray, model: FloatArray, rotation: FloatArray, place: FloatArray, axes: FloatArray) -> None:
    """rotation (3, 3) and place (3,) that bring the triangle model (3, 3) onto the congruent triangle points (3, 3)."""
    for k in range(2):
        p = points if k == 0 else model
        f = axes[k]
        for j in range(3):
            f[0, j], f[1, j] = p[1, j] - p[0, j], p[2, j] - p[0, j]
        for a, b, out in ((0, 1, 2), (2, 0, 1)):
            for j in range(3):
                m, n = (j + 1) % 3, (j + 2) % 3
                f[out, j] = f[a, m] * f[b, n] - f[a, n] * f[b, m]
        for i in range(3):
            length = np.sqrt(f[i, 0] ** 2 + f[i, 1] ** 2 + f[i, 2] ** 2)
            for j in range(3):
                f[i, j] /= length
    for i in range(3):
        for j in range(3):
            rotation[i, j] = (
                axes[0, 0, i] * axes[1, 0, j] + axes[0, 1, i] * axes[1, 1, j] + axes[0, 2, i] * axes[1, 2, j]
            )
    for i in range(3):
        place[i] = 0.0
        for k in range(3):
            turned = rotation[i, 0] * model[k, 0] + rotation[i, 1] * model[k, 1] + rotation[i, 2] * model[k, 2]
            place[i] += (points[k, i] - turned) / 3.0


@leaf
def _dot(a: FloatArray, b: FloatArray) -> float:
    product: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


@kernel
def _between(a: FloatArray, b: FloatArray) -> FloatArray:
    out = np.empty(3)
    for i in range(3):
        out[i] = b[i] - a[i]
    return out


@leaf
def _meeting(q: FloatArray, l: float, sign: float) -> float:
    """Where on the other ray a point is at the side's distance from the one at l: before or behind the foot."""
    along: float = q[3] + q[4] * l + sign * np.sqrt(max(q[5] - (q[0] * l * l + 2.0 * q[1] * l + q[2]), 0.0))
    return along


@leaf
def _excess(q: FloatArray, l2: float, l3: float) -> float:
    """How much too long the third side is, squared, between the points at l2 and l3."""
    excess: float = q[0] + l2 * l2 + l3 * l3 + 2.0 * (l2 * q[1] - l3 * q[2] - l2 * l3 * q[3]) - q[4]
    return excess


@kernel
def three_rays(
    origins: FloatArray, rays: FloatArray, model: FloatArray, rotations: FloatArray, places: FloatArray
) -> int:
    """Poses that put three model points on three rays: central (P3P) or from several cameras alike.

    With the first point at l along its ray, the second is where the sphere of their distance meets the second ray, twice,
    and the third likewise; the distance of these two from each other then is a function of l with the poses as its
    roots, on the interval where both spheres meet their rays. Roots are found from changes of sign, so that two that are
    very close may be missed: the samples are many.

    Args:
        origins, rays, model: (3, 3) the rays' origins and unit directions, and the model points.
        rotations: (8, 3, 3) and places: (8, 3), filled.

    Returns:
        number of poses.
    """
    side2, side3 = _between(model[0], model[1]), _between(model[0], model[2])
    square2, square3, across = _dot(side2, side2), _dot(side3, side3), _dot(side2, side3)
    # Three points on a line leave the turn about it open.
    if not square2 * square3 - across * across > ON_LINE * square2 * square3:
        return 0
    # Per side: squared distance of the first point from the other ray a l^2 + 2 b l + c, its foot there e + f l, side^2.
    g = np.empty((3, 6))
    low, high = 0.0, np.inf
    for j in range(2):
        v, ray = _between(origins[1 + j], origins[0]), rays[1 + j]
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
    w, third = _between(origins[2], origins[1]), _between(model[2], model[1])
    g[2, 0], g[2, 1], g[2, 2], g[2, 3] = _dot(w, w), _dot(w, rays[1]), _dot(w, rays[2]), _dot(rays[1], rays[2])
    g[2, 4] = _dot(third, third)
    # Dense at the ends, where the roots of the spheres change fast.
    grid = np.empty((INTERVALS + 1, 5))
    for k in range(INTERVALS + 1):
        l = 0.5 * (low + high - (high - low) * np.cos(np.pi * k / INTERVALS))
        grid[k, 0] = l
        for j in range(2):
            grid[k, 1 + 2 * j], grid[k, 2 + 2 * j] = _meeting(g[j], l, -1.0), _meeting(g[j], l, 1.0)
    lengths, points, axes = np.empty(3), np.empty((3, 3)), np.empty((2, 3, 3))
    tolerance = ROOT_ERROR * g[2, 4]
    found = 0
    for branch in range(4):
        at2, at3 = 1 + branch // 2, 3 + branch % 2
        sign2, sign3 = 2.0 * (branch // 2) - 1.0, 2.0 * (branch % 2) - 1.0
        f_last = _excess(g[2], grid[0, at2], grid[0, at3])
        for k in range(1, INTERVALS + 1):
            f_next = _excess(g[2], grid[k, at2], grid[k, at3])
            if (f_last < 0.0) != (f_next < 0.0) and found < 8:
                a, fa, b, fb = grid[k - 1, 0], f_last, grid[k, 0], f_next
                for _ in range(ROOT_STEPS):  # regula falsi, Illinois
                    lengths[0] = (a * fb - b * fa) / (fb - fa)
                    lengths[1] = _meeting(g[0], lengths[0], sign2)
                    lengths[2] = _meeting(g[1], lengths[0], sign3)
                    f = _excess(g[2], lengths[1], lengths[2])
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
                    _align(points, model, rotations[found], places[found], axes)
                    found += 1
            f_last = f_next
    return found
