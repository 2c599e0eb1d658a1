"""Motion and plane in the view of one camera: homography, essential matrix, epipolar line.

Source: Hartley & Zisserman, "Multiple View Geometry", sections 9.6, 11.4.3 and 13.1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.terms import Candidate, Stack

__all__ = [
    "TermView",
    "build_epipolar_rows",
    "compute_epipolar_line",
    "compute_essential",
    "compute_homography",
    "make_term_view",
    "transform_to_camera",
    "update_view",
]

# Sampson's denominator, in squared length units, below which an epipolar geometry is pure rounding (choice).
MIN_DENOMINATOR = 1e-28


class TermView(NamedTuple):
    """View of one term's camera: work arrays that are allocated once for all steps of a search.

    Attributes:
        rc, tc, rotated_center: the motion in the camera's axes (`transform_to_camera`).
        plane: (3,) the inverse depth is plane·(u, v, 1).
        h, e: (10, 3, 3), (7, 3, 3) the homography and the essential matrix, followed by their derivatives.
        rows, image: (10, 9), (9,).
    """

    rc: FloatArray
    tc: FloatArray
    rotated_center: FloatArray
    plane: FloatArray
    h: FloatArray
    e: FloatArray
    rows: FloatArray
    image: FloatArray


@kernel
def make_term_view() -> TermView:
    """Allocate a view."""
    return TermView(
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
def transform_to_camera(
    stack: Stack,
    t: int,
    candidate: Candidate,
    rc: FloatArray,
    tc: FloatArray,
    rotated_center: FloatArray,
) -> None:
    """Transform the motion into term t's camera: `rc` = Qy R Qx', `tc` = Qy τ, `rotated_center` = Qy R a1."""
    rotation, translation = candidate.rotation, candidate.translation
    qx, qy, a1, a2 = stack.qx[t], stack.qy[t], stack.a1[t], stack.a2[t]
    for i in range(3):
        r0 = qy[i, 0] * rotation[0, 0] + qy[i, 1] * rotation[1, 0] + qy[i, 2] * rotation[2, 0]
        r1 = qy[i, 0] * rotation[0, 1] + qy[i, 1] * rotation[1, 1] + qy[i, 2] * rotation[2, 1]
        r2 = qy[i, 0] * rotation[0, 2] + qy[i, 1] * rotation[1, 2] + qy[i, 2] * rotation[2, 2]
        for j in range(3):
            rc[i, j] = r0 * qx[j, 0] + r1 * qx[j, 1] + r2 * qx[j, 2]
        rotated_center[i] = r0 * a1[0] + r1 * a1[1] + r2 * a1[2]
        tc[i] = rotated_center[i]
        for j in range(3):
            tc[i] += qy[i, j] * (translation[j] - a2[j])


@leaf
def update_view(stack: Stack, t: int, candidate: Candidate, view: TermView) -> None:
    """Set the view of term t's camera, motion and plane, for functions of a `TermView`."""
    transform_to_camera(stack, t, candidate, view.rc, view.tc, view.rotated_center)
    _compute_plane(stack, t, candidate.depth_model[t], view.plane)


@leaf
def _compute_plane(stack: Stack, t: int, depth_model: FloatArray, out: FloatArray) -> None:
    """Set out (3,): ρ = out·(u, v, 1)."""
    unit, anchor, spread = stack.inverse_depth[t], stack.anchor[t], stack.spread[t]
    out[0] = unit * depth_model[1] / spread
    out[1] = unit * depth_model[2] / spread
    out[2] = unit * depth_model[0] - out[0] * anchor[0] - out[1] * anchor[1]


@leaf
def compute_epipolar_line(
    rc: FloatArray, tc: FloatArray, plane: FloatArray, u: float, v: float
) -> tuple[float, float, float]:
    """Return the length and the direction of the image displacement of (u, v) per unit of inverse depth."""
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
def compute_homography(view: TermView, x0: float, x1: float) -> float:
    """Compute the homography R + τ plane'; return the depth of (x0, x1)."""
    for i in range(3):
        for j in range(3):
            view.h[0, i, j] = view.rc[i, j] + view.tc[i] * view.plane[j]
    return float(view.h[0, 2, 0] * x0 + view.h[0, 2, 1] * x1 + view.h[0, 2, 2])


@leaf
def compute_essential(view: TermView) -> None:
    """Compute the essential matrix."""
    rc, tc, e = view.rc, view.tc, view.e
    for j in range(3):
        e[0, 0, j] = tc[1] * rc[2, j] - tc[2] * rc[1, j]
        e[0, 1, j] = tc[2] * rc[0, j] - tc[0] * rc[2, j]
        e[0, 2, j] = tc[0] * rc[1, j] - tc[1] * rc[0, j]


@leaf
def build_epipolar_rows(e: FloatArray, n: int, x0: float, x1: float, y0: float, y1: float, rows: FloatArray) -> float:
    """Compute vec(E) / √g and its derivatives as rows (n, 9); return g, Sampson's denominator at the mean rays."""
    p0 = e[0, 0, 0] * x0 + e[0, 0, 1] * x1 + e[0, 0, 2]
    p1 = e[0, 1, 0] * x0 + e[0, 1, 1] * x1 + e[0, 1, 2]
    o0 = e[0, 0, 0] * y0 + e[0, 1, 0] * y1 + e[0, 2, 0]
    o1 = e[0, 0, 1] * y0 + e[0, 1, 1] * y1 + e[0, 2, 1]
    g = p0 * p0 + p1 * p1 + o0 * o0 + o1 * o1
    if not g > MIN_DENOMINATOR:
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
