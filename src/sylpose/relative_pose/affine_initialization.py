"""Initial rotations from the affine image motion of a flat object, two cameras at a time.

To first order, a plane that rotates by w and whose depth has the relative slopes s across the image is mapped by

    A = (1 + σ) 1 + ω J + r s',      r = (w_y, -w_x),  ω = w_z in the camera's axes,  J a quarter turn,

with σ from its approach. A without σ and ω has determinant zero: a quadratic equation with two solutions, that of the
plane and that of the second plane. Neither determines the length of r, so each gives a line of rotations. The lines of
the cameras meet in the rotation. With two cameras, other pairs of lines may pass each other nearly as closely, so the
midpoints of all pairs are tried.

Source: first-order structure from motion of planes, Longuet-Higgins, "The reconstruction of a plane surface from two
perspective projections", 1984; the bas-relief ambiguity, Belhumeur, Kriegman, Yuille 1999; the intersection of the
lines is ours.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky_solve, kernel
from sylpose.relative_pose.moments_cost import MomentSums
from sylpose.relative_pose.terms import COINCIDENCE_TOLERANCE, Stack

__all__ = ["N_AFFINE_TERMS", "estimate_affine_rotations"]

# Number of terms (matches of one camera with one frame) whose lines are combined: more terms hardly leave an ambiguity
# (choice).
N_AFFINE_TERMS = 2
# Minimum number of matches for a camera's affine map, and the smallest ratio of width to length of the area that they
# cover (choice).
MIN_AFFINE_MATCHES, MIN_WIDTH_RATIO = 6.0, 0.05
# Regularization that rejects nearly parallel lines: the added share of the identity (choice).
PARALLEL_RIDGE = 1e-3
# Largest rotation that is tried, radians (choice).
MAX_ROTATION = 1.0


@kernel
def estimate_affine_rotations(stack: Stack, sums: MomentSums, rotvecs: FloatArray) -> int:
    """Set `rotvecs` to rotation vectors that fit the affine maps of the matches.

    Args:
        rotvecs: (`2**N_AFFINE_TERMS`, 3), filled.

    Returns:
        number of rotation vectors.
    """
    n = stack.focal.shape[0]
    if n != N_AFFINE_TERMS:
        return 0
    points, along = np.empty((N_AFFINE_TERMS, 2, 3)), np.empty((N_AFFINE_TERMS, 2, 3))
    translation = _estimate_translation(stack, sums)
    for t in range(n):
        if not _compute_rotation_lines(stack, sums, t, translation, points[t], along[t]):
            return 0
    for k in range(2**N_AFFINE_TERMS):
        left, right = np.zeros((3, 3)), np.zeros(3)
        for t in range(n):
            line = (k >> t) & 1
            u, p = along[t, line], points[t, line]
            along_line = p[0] * u[0] + p[1] * u[1] + p[2] * u[2]
            for i in range(3):
                right[i] += p[i] - along_line * u[i]
                for j in range(3):
                    left[i, j] -= u[i] * u[j]
                left[i, i] += 1.0 + PARALLEL_RIDGE
        rotvecs[k] = right
        if not cholesky_solve(left, rotvecs[k]):
            return 0
        size = np.sqrt(rotvecs[k, 0] ** 2 + rotvecs[k, 1] ** 2 + rotvecs[k, 2] ** 2)
        if size > MAX_ROTATION:
            rotvecs[k] *= MAX_ROTATION / size
    return int(2**N_AFFINE_TERMS)


@kernel
def _estimate_translation(stack: Stack, sums: MomentSums) -> FloatArray:
    """Estimate the translation (3,) of the object's center from the mean displacements."""
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
def _compute_rotation_lines(
    stack: Stack, sums: MomentSums, t: int, translation: FloatArray, points: FloatArray, along: FloatArray
) -> bool:
    """Compute a camera's two lines of rotations: points (2, 3) and directions (2, 3), world.

    Returns:
        whether the lines exist.
    """
    m, q = sums.moments[t], stack.qy[t]
    count = m[8, 8]
    if not count >= MIN_AFFINE_MATCHES:
        return False
    for i in range(3):
        for j in range(3):
            if abs(q[i, j] - stack.qx[t, i, j]) > COINCIDENCE_TOLERANCE:
                return False
    # The least-squares affine map.
    x0, x1 = m[8, 6] / count, m[8, 7] / count
    c00, c01, c11 = m[6, 6] / count - x0 * x0, m[6, 7] / count - x0 * x1, m[7, 7] / count - x1 * x1
    det = c00 * c11 - c01 * c01
    if not det > (MIN_WIDTH_RATIO * (c00 + c11)) ** 2:
        return False
    approach = (q[2, 0] * translation[0] + q[2, 1] * translation[1] + q[2, 2] * translation[2]) * stack.inverse_depth[t]
    a = np.empty((2, 2))
    for f in range(2):
        y = m[8, 3 * f + 2] / count
        b0, b1 = m[8, 3 * f] / count - y * x0, m[8, 3 * f + 1] / count - y * x1
        a[f, 0], a[f, 1] = (c11 * b0 - c01 * b1) / det, (c00 * b1 - c01 * b0) / det
        a[f, f] += approach - 1.0
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
