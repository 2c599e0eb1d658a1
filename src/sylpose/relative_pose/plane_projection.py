"""A motion and a plane as one term's camera sees them: the homography, the essential matrix, the epipolar line.

Source: Hartley & Zisserman, "Multiple View Geometry", sections 9.6, 11.4.3 and 13.1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.terms import Candidate, Stack

__all__ = ["Scratch", "epipolar_rows", "essential", "homography", "line", "look", "scratch", "view_of"]

# Sampson's denominator, in squares of the unit of length, of an epipolar geometry that is nothing but rounding (choice).
TINY = 1e-28


class Scratch(NamedTuple):
    """What is computed for one term, room that is taken once for all steps of a search.

    Attributes:
        rc, tc, turned: the motion as the camera sees it (`view_of`).
        plane: (3,) the inverse depth is plane·(u, v, 1).
        h, e: (10, 3, 3), (7, 3, 3) the homography and the essential matrix, then their derivatives.
        rows, image: (10, 9), (9,).
    """

    rc: FloatArray
    tc: FloatArray
    turned: FloatArray
    plane: FloatArray
    h: FloatArray
    e: FloatArray
    rows: FloatArray
    image: FloatArray


@kernel
def scratch() -> Scratch:
    """Empty."""
    return Scratch(
        np.empty((3, 3)),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.zeros((10, 3, 3)),
        np.zeros((7, 3, 3)),
        np.empty((10, 9)),
        np.empty(9),
    )


@leaf
def view_of(
    stack: Stack,
    t: int,
    candidate: Candidate,
    rc: FloatArray,
    tc: FloatArray,
    turned: FloatArray,
) -> None:
    """The motion as term t's camera sees it: rc = Qy R Qx', tc = Qy τ, turned = Qy R a1."""
    rotation, shift = candidate.rotation, candidate.shift
    qx, qy, a1, a2 = stack.qx[t], stack.qy[t], stack.a1[t], stack.a2[t]
    for i in range(3):
        r0 = qy[i, 0] * rotation[0, 0] + qy[i, 1] * rotation[1, 0] + qy[i, 2] * rotation[2, 0]
        r1 = qy[i, 0] * rotation[0, 1] + qy[i, 1] * rotation[1, 1] + qy[i, 2] * rotation[2, 1]
        r2 = qy[i, 0] * rotation[0, 2] + qy[i, 1] * rotation[1, 2] + qy[i, 2] * rotation[2, 2]
        for j in range(3):
            rc[i, j] = r0 * qx[j, 0] + r1 * qx[j, 1] + r2 * qx[j, 2]
        turned[i] = r0 * a1[0] + r1 * a1[1] + r2 * a1[2]
        tc[i] = turned[i]
        for j in range(3):
            tc[i] += qy[i, j] * (shift[j] - a2[j])


@leaf
def look(stack: Stack, t: int, candidate: Candidate, at: Scratch) -> None:
    """The motion, and the plane, as term t's camera sees them: what the functions `..._at` take."""
    view_of(stack, t, candidate, at.rc, at.tc, at.turned)
    _plane(stack, t, candidate.surface[t], at.plane)


@leaf
def _plane(stack: Stack, t: int, surface: FloatArray, out: FloatArray) -> None:
    """out (3,): ρ = out·(u, v, 1)."""
    unit, anchor, spread = stack.inverse_depth[t], stack.anchor[t], stack.spread[t]
    out[0] = unit * surface[1] / spread
    out[1] = unit * surface[2] / spread
    out[2] = unit * surface[0] - out[0] * anchor[0] - out[1] * anchor[1]


@leaf
def line(rc: FloatArray, tc: FloatArray, plane: FloatArray, u: float, v: float) -> tuple[float, float, float]:
    """By how much, per inverse depth, depth moves the point (u, v) in the image, and the direction."""
    rho = plane[0] * u + plane[1] * v + plane[2]
    p0 = rc[0, 0] * u + rc[0, 1] * v + rc[0, 2] + rho * tc[0]
    p1 = rc[1, 0] * u + rc[1, 1] * v + rc[1, 2] + rho * tc[1]
    p2 = rc[2, 0] * u + rc[2, 1] * v + rc[2, 2] + rho * tc[2]
    b0, b1 = (tc[0] - p0 / p2 * tc[2]) / p2, (tc[1] - p1 / p2 * tc[2]) / p2
    length = np.sqrt(b0 * b0 + b1 * b1)
    if length > 0.0:
        return length, b0 / length, b1 / length
    return 0.0, 1.0, 0.0


@leaf
def homography(at: Scratch, x0: float, x1: float) -> float:
    """The homography R + τ plane'; returns the depth of (x0, x1)."""
    for i in range(3):
        for j in range(3):
            at.h[0, i, j] = at.rc[i, j] + at.tc[i] * at.plane[j]
    return float(at.h[0, 2, 0] * x0 + at.h[0, 2, 1] * x1 + at.h[0, 2, 2])


@leaf
def essential(at: Scratch) -> None:
    """The essential matrix."""
    rc, tc, e = at.rc, at.tc, at.e
    for j in range(3):
        e[0, 0, j] = tc[1] * rc[2, j] - tc[2] * rc[1, j]
        e[0, 1, j] = tc[2] * rc[0, j] - tc[0] * rc[2, j]
        e[0, 2, j] = tc[0] * rc[1, j] - tc[1] * rc[0, j]


@leaf
def epipolar_rows(e: FloatArray, n: int, x0: float, x1: float, y0: float, y1: float, rows: FloatArray) -> float:
    """vec(E) / √g and its derivatives as rows (n, 9); returns g, Sampson's denominator at the mean rays."""
    p0 = e[0, 0, 0] * x0 + e[0, 0, 1] * x1 + e[0, 0, 2]
    p1 = e[0, 1, 0] * x0 + e[0, 1, 1] * x1 + e[0, 1, 2]
    o0 = e[0, 0, 0] * y0 + e[0, 1, 0] * y1 + e[0, 2, 0]
    o1 = e[0, 0, 1] * y0 + e[0, 1, 1] * y1 + e[0, 2, 1]
    g = p0 * p0 + p1 * p1 + o0 * o0 + o1 * o1
    if not g > TINY:
        return 0.0
    root = np.sqrt(g)
    for k in range(n):
        by = 0.0
        if k > 0:
            d = e[k]
            by = (
                p0 * (d[0, 0] * x0 + d[0, 1] * x1 + d[0, 2])
                + p1 * (d[1, 0] * x0 + d[1, 1] * x1 + d[1, 2])
                + o0 * (d[0, 0] * y0 + d[1, 0] * y1 + d[2, 0])
                + o1 * (d[0, 1] * y0 + d[1, 1] * y1 + d[2, 1])
            ) / g
        for i in range(3):
            for j in range(3):
                rows[k, 3 * i + j] = e[k, i, j] / root
                if k > 0:
                    rows[k, 3 * i + j] -= by * rows[0, 3 * i + j]
    return float(g)
