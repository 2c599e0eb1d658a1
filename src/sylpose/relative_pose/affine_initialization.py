"""Turns that fit the affine image of a flat object, camera by camera: where a search is to start, beside the identity.

To first order a plane that turns by w, whose depth has the relative slopes s across the image, is seen mapped by

    A = (1 + σ) 1 + ω J + r s',      r = (w_y, -w_x),  ω = w_z in the camera's axes,  J a quarter turn,

with σ from its coming nearer. What is left of A without σ and ω has no determinant: a quadratic equation with two
solutions, the plane's and the second plane's. Neither tells how long r is: each is a line of turns. The cameras' lines meet
in the turn, but with two cameras other pairs of lines may pass each other nearly as closely. So the middles of all pairs are
tried.

Source: first-order structure from motion of planes, Longuet-Higgins, "The reconstruction of a plane surface from two
perspective projections", 1984; the bas-relief ambiguity, Belhumeur, Kriegman, Yuille 1999; the meeting lines are ours.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky_solve, kernel
from sylpose.relative_pose.moments_cost import Sums
from sylpose.relative_pose.terms import ROUNDING, Stack

__all__ = ["FEW", "affine_turns"]

# So many terms, matches of one camera with one frame, have their lines combined: more hardly leave a choice (choice).
FEW = 2
# Matches of which a camera's affine map is believed, and how thin what they cover may be: its width by its length (choice).
MANY, THIN = 6.0, 0.05
# Lines this near to parallel meet nowhere: the added share of the identity (choice).
PARALLEL = 1e-3
# No turn is tried that is larger, radians (choice).
LARGEST = 1.0


@kernel
def affine_turns(stack: Stack, sums: Sums, turns: FloatArray) -> int:
    """turns (2^FEW, 3) becomes rotation vectors that fit the affine maps of the matches; returns how many."""
    n = stack.focal.shape[0]
    if n != FEW:
        return 0
    points, along = np.empty((FEW, 2, 3)), np.empty((FEW, 2, 3))
    shift = _shift(stack, sums)
    for t in range(n):
        if not _lines(stack, sums, t, shift, points[t], along[t]):
            return 0
    for k in range(2**FEW):
        left, right = np.zeros((3, 3)), np.zeros(3)
        for t in range(n):
            which = (k >> t) & 1
            u, p = along[t, which], points[t, which]
            beside = p[0] * u[0] + p[1] * u[1] + p[2] * u[2]
            for i in range(3):
                right[i] += p[i] - beside * u[i]
                for j in range(3):
                    left[i, j] -= u[i] * u[j]
                left[i, i] += 1.0 + PARALLEL
        turns[k] = right
        if not cholesky_solve(left, turns[k]):
            return 0
        size = np.sqrt(turns[k, 0] ** 2 + turns[k, 1] ** 2 + turns[k, 2] ** 2)
        if size > LARGEST:
            turns[k] *= LARGEST / size
    return int(2**FEW)


@kernel
def _shift(stack: Stack, sums: Sums) -> FloatArray:
    """(3,) by what the object's centre moves, for all that the mean displacements say."""
    left, right = np.zeros((3, 3)), np.zeros(3)
    for t in range(stack.focal.shape[0]):
        m, q = sums.moments[t], stack.qy[t]
        count = m[8, 8]
        for f in range(2):
            x, y = m[8, 6 + f] / count, m[8, 3 * f + 2] / count
            for i in range(3):
                row_i = (q[f, i] - x * q[2, i]) * stack.inverse_depth[t]
                right[i] += row_i * (y - x)
                for j in range(3):
                    left[i, j] += row_i * (q[f, j] - x * q[2, j]) * stack.inverse_depth[t]
    trace = left[0, 0] + left[1, 1] + left[2, 2]
    for i in range(3):
        left[i, i] += 1e-6 * trace
    if not cholesky_solve(left, right):
        right[:] = 0.0
    return right


@kernel
def _lines(stack: Stack, sums: Sums, t: int, shift: FloatArray, points: FloatArray, along: FloatArray) -> bool:
    """A camera's two lines of turns: points (2, 3) on them and their directions (2, 3), world; whether there are any."""
    m, q = sums.moments[t], stack.qy[t]
    count = m[8, 8]
    if not count >= MANY:
        return False
    for i in range(3):
        for j in range(3):
            if abs(q[i, j] - stack.qx[t, i, j]) > ROUNDING:
                return False
    # The affine map of least squares.
    x0, x1 = m[8, 6] / count, m[8, 7] / count
    c00, c01, c11 = m[6, 6] / count - x0 * x0, m[6, 7] / count - x0 * x1, m[7, 7] / count - x1 * x1
    det = c00 * c11 - c01 * c01
    if not det > (THIN * (c00 + c11)) ** 2:
        return False
    farther = (q[2, 0] * shift[0] + q[2, 1] * shift[1] + q[2, 2] * shift[2]) * stack.inverse_depth[t]
    a = np.empty((2, 2))
    for f in range(2):
        y = m[8, 3 * f + 2] / count
        b0, b1 = m[8, 3 * f] / count - y * x0, m[8, 3 * f + 1] / count - y * x1
        a[f, 0], a[f, 1] = (c11 * b0 - c01 * b1) / det, (c00 * b1 - c01 * b0) / det
        a[f, f] += farther - 1.0
    # det (a - ω J) = ω² + (a01 - a10) ω + det a = 0
    half = 0.5 * (a[1, 0] - a[0, 1])
    root = np.sqrt(max(half * half - (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]), 0.0))
    for k in range(2):
        omega = half + (root if k == 0 else -root)
        b00, b01, b10, b11 = a[0, 0], a[0, 1] + omega, a[1, 0] - omega, a[1, 1]
        # r is the image of b = r s', its longer column.
        first = b00 * b00 + b10 * b10 > b01 * b01 + b11 * b11
        r0, r1 = (b00, b10) if first else (b01, b11)
        length = np.sqrt(r0 * r0 + r1 * r1)
        if not length > 0.0:
            return False
        for i in range(3):
            points[k, i] = omega * q[2, i]
            along[k, i] = (-r1 * q[0, i] + r0 * q[1, i]) / length
    return True
