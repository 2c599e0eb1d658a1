"""Normal equations of several cameras: a shared motion, with per-camera unknowns eliminated; unobservable directions.

A motion is (w, d): a rotation R = exp(w) R̂ and a translation. A camera's derivatives are in its axes, in which they
are simple; their sums are rotated into the world's by Q of camera_from_world.

A direction is unobservable if its standard deviation exceeds a limit. The limits of each estimator and their reasons:
docs/conventions.md, "Limits".
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import cholesky, kernel, leaf, symmetric_eigen

# A rotation with a larger standard deviation, radians, is unobservable where there is no reference to compare with
# (choice).
UNOBSERVABLE_ROTATION_SD = 0.25
# A motion, rotation or distance with a larger relative standard deviation is unobservable: even its sign is uncertain
# (choice).
UNOBSERVABLE_RATIO = 0.5
# A rotation with a smaller standard deviation, radians, is observable, however small it is: a degree (choice).
OBSERVABLE_ROTATION_SD = float(np.deg2rad(1.0))


@leaf
def eliminate_block(block: FloatArray, coupled: FloatArray, kept: FloatArray) -> bool:
    """Eliminate k unknowns z from normal equations by the Schur complement.

    The equations are [A C'; C B] (x, z) = (a, b).

    Args:
        block: (k, k) B, lower triangle; becomes its Cholesky factor.
        coupled: (k, n + 1) C and b; becomes B⁻¹C and B⁻¹b, with which z = B⁻¹b - B⁻¹C x.
        kept: (n, n + 1) A and a, of n other unknowns x; becomes A - C'B⁻¹C and a - C'B⁻¹b.

    Returns:
        False, with incomplete output, where B is not positive definite.
    """
    if not cholesky(block):
        return False
    k, columns = coupled.shape
    # Row by row, so that several columns are vectorized.
    for i in range(k):
        row, reciprocal = coupled[i], 1.0 / block[i, i]
        for m in range(i):
            factor, other = block[i, m], coupled[m]
            for j in range(columns):
                row[j] -= factor * other[j]
        for j in range(columns):
            row[j] *= reciprocal
    # With C and b divided by the factor, their product with themselves is subtracted.
    for i in range(columns - 1):
        row = kept[i]
        for m in range(k):
            factor, other = coupled[m, i], coupled[m]
            for j in range(columns):
                row[j] -= factor * other[j]
    for i in range(k - 1, -1, -1):
        row, reciprocal = coupled[i], 1.0 / block[i, i]
        for m in range(i + 1, k):
            factor, other = block[m, i], coupled[m]
            for j in range(columns):
                row[j] -= factor * other[j]
        for j in range(columns):
            row[j] *= reciprocal
    return True


@leaf
def add_rotated(lower: FloatArray, q: FloatArray, total: FloatArray) -> None:
    """Add a quadratic form in (w, d), rotated from a camera's axes to the world's, to a total.

    Args:
        lower: (6, 6) lower triangle of the form in the camera's axes.
        q: (3, 3) Q, which rotates both halves.
        total: (6, 6 at least) in the world's axes.
    """
    for part in range(3):
        # The block of w, that of d, and the one between them, whose other side is the transpose.
        h, g = (3 if part > 0 else 0), (3 if part == 1 else 0)
        b00, b10, b11 = lower[h, g], lower[h + 1, g], lower[h + 1, g + 1]
        b20, b21, b22 = lower[h + 2, g], lower[h + 2, g + 1], lower[h + 2, g + 2]
        b01, b02, b12 = b10, b20, b21
        if part == 2:
            b01, b02, b12 = lower[h, g + 1], lower[h, g + 2], lower[h + 1, g + 2]
        for j in range(3):
            x = b00 * q[0, j] + b01 * q[1, j] + b02 * q[2, j]
            y = b10 * q[0, j] + b11 * q[1, j] + b12 * q[2, j]
            z = b20 * q[0, j] + b21 * q[1, j] + b22 * q[2, j]
            for i in range(3):
                value = x * q[0, i] + y * q[1, i] + z * q[2, i]
                total[h + i, g + j] += value
                if part == 2:
                    total[g + j, h + i] += value


@leaf
def rotate_rows(rows: FloatArray, q: FloatArray, out: FloatArray) -> None:
    """Write rows (k, 6) by (w, d), rotated from a camera's axes to the world's, to out (k, 6 at least)."""
    for k in range(rows.shape[0]):
        for h in range(2):
            x, y, z = rows[k, 3 * h], rows[k, 3 * h + 1], rows[k, 3 * h + 2]
            for j in range(3):
                out[k, 3 * h + j] = x * q[0, j] + y * q[1, j] + z * q[2, j]


@leaf
def compute_image_row(
    n0: float, n1: float, u: float, v: float, z: float, s0: float, s1: float, s2: float, scale: float, row: FloatArray
) -> None:
    """Write the derivative of a point's image in a direction n by (w, d) to row (6,): (s × h, scale h).

    All in the camera's axes. h = n' D, with D the derivative of the image (u, v) by the point, which has depth z and
    position s relative to the center of rotation. Where all is known up to the point's scale, z and s are scaled by it.
    """
    h0, h1 = n0 / z, n1 / z
    h2 = -(h0 * u + h1 * v)
    row[0], row[1], row[2] = s1 * h2 - s2 * h1, s2 * h0 - s0 * h2, s0 * h1 - s1 * h0
    row[3], row[4], row[5] = scale * h0, scale * h1, scale * h2


def find_unobservable_directions(
    information: FloatArray, limits: FloatArray | float, *, min_ratio: float = 0.0
) -> FloatArray:
    """Return the directions whose standard deviation exceeds the limits.

    Args:
        information: (..., n, n) of n unknowns; several matrices must have the first one's eigenvalues (mirrored
            solutions).
        limits: (n,) in the unknowns' units, or one for all.
        min_ratio: directions with less than this fraction of the largest eigenvalue are unobservable as well: rounding.

    Returns:
        (..., k, n) orthonormal rows in units of the limits: multiplied by `limits`, they are in the unknowns' units.
    """
    scale = np.full(information.shape[-1], limits) if isinstance(limits, float) else limits
    # Usually all is observable, and no eigenvectors are needed.
    if information.ndim == 2 and are_all_observable(np.ascontiguousarray(information), scale, min_ratio):
        return np.empty((0, len(scale)))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    first = values.reshape(-1, values.shape[-1])[0]
    k = int(np.searchsorted(first, max(1.0, min_ratio * first[-1])))
    return vectors[..., :k].swapaxes(-1, -2)


@kernel
def are_all_observable(information: FloatArray, limits: FloatArray, min_ratio: float) -> bool:
    """Return whether `find_unobservable_directions` finds none; limits (n,).

    A Cholesky factor would be faster, but it also exists where rounding of the largest eigenvalue hides an unobservable
    direction.
    """
    n = len(limits)
    scaled, values = np.empty((n, n)), np.empty(n)
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * limits[i] * limits[j]
    symmetric_eigen(scaled, values, np.empty((n, n)))
    return bool(values[0] >= max(1.0, min_ratio * values[-1]))


def is_length_observable(translations: FloatArray, covariance: FloatArray) -> BoolArray:
    """Return (n,) whether the length of each translation is observable.

    Args:
        translations: (n, 3).
        covariance: (n, 6, 6) of (w, d).
    """
    squares = (translations**2).sum(axis=1)
    variance = np.einsum("ni,nij,nj->n", translations, covariance[:, 3:, 3:], translations)
    return np.asarray(variance <= (UNOBSERVABLE_RATIO * squares) ** 2)


def has_rotation_direction(directions: FloatArray) -> bool:
    """Return whether one of the directions (k, 6) of (w, d) is mostly a rotation.

    The directions are as of `find_unobservable_directions`.
    """
    return bool(np.linalg.norm(directions[:, :3], 2) ** 2 > 0.5)
