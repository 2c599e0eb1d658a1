"""Normal equations of many cameras: the motion that they share, and what each of them has for itself eliminated.

A motion is (w, d): a turn R = exp(w) R̂ and a displacement. A camera's derivatives are in its own axes, in which they are
simple, and are turned into the world's, Q of camera_from_world, once they are summed.
"""

from __future__ import annotations

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky, leaf

__all__ = ["add_turned", "eliminate", "image_row", "turn_rows"]


@leaf
def eliminate(block: FloatArray, coupled: FloatArray, kept: FloatArray) -> bool:
    """Takes the k unknowns z out of normal equations [A C'; C B] (x, z) = (a, b) of n others x: the Schur complement.

    Args:
        block: (k, k) B, lower triangle; becomes its Cholesky factor.
        coupled: (k, n + 1) C and b; becomes B⁻¹C and B⁻¹b, with which z = B⁻¹b - B⁻¹C x.
        kept: (n, n + 1) A and a; becomes A - C'B⁻¹C and a - C'B⁻¹b.

    Returns:
        False, with all three half done, where B is not positive definite.
    """
    if not cholesky(block):
        return False
    k, columns = coupled.shape
    # Row by row, so that the processor works on several columns at once.
    for i in range(k):
        row, per = coupled[i], 1.0 / block[i, i]
        for m in range(i):
            factor, other = block[i, m], coupled[m]
            for j in range(columns):
                row[j] -= factor * other[j]
        for j in range(columns):
            row[j] *= per
    # With C and b divided by the factor, what goes is their product with themselves.
    for i in range(columns - 1):
        row = kept[i]
        for m in range(k):
            factor, other = coupled[m, i], coupled[m]
            for j in range(columns):
                row[j] -= factor * other[j]
    for i in range(k - 1, -1, -1):
        row, per = coupled[i], 1.0 / block[i, i]
        for m in range(i + 1, k):
            factor, other = block[m, i], coupled[m]
            for j in range(columns):
                row[j] -= factor * other[j]
        for j in range(columns):
            row[j] *= per
    return True


@leaf
def add_turned(lower: FloatArray, q: FloatArray, total: FloatArray) -> None:
    """Adds a form in (w, d), its lower triangle (6, 6) in a camera's axes, to total (6, 6 at least) in the world's: both
    halves turn with Q (3, 3)."""
    for half in range(3):
        # The block of w, that of d, and the one between them, of which the other side is the transpose.
        h, g = (3 if half > 0 else 0), (3 if half == 1 else 0)
        b00, b10, b11 = lower[h, g], lower[h + 1, g], lower[h + 1, g + 1]
        b20, b21, b22 = lower[h + 2, g], lower[h + 2, g + 1], lower[h + 2, g + 2]
        b01, b02, b12 = b10, b20, b21
        if half == 2:
            b01, b02, b12 = lower[h, g + 1], lower[h, g + 2], lower[h + 1, g + 2]
        for j in range(3):
            x = b00 * q[0, j] + b01 * q[1, j] + b02 * q[2, j]
            y = b10 * q[0, j] + b11 * q[1, j] + b12 * q[2, j]
            z = b20 * q[0, j] + b21 * q[1, j] + b22 * q[2, j]
            for i in range(3):
                value = x * q[0, i] + y * q[1, i] + z * q[2, i]
                total[h + i, g + j] += value
                if half == 2:
                    total[g + j, h + i] += value


@leaf
def turn_rows(rows: FloatArray, q: FloatArray, out: FloatArray) -> None:
    """out (k, 6 at least): rows (k, 6) by (w, d) of a camera's axes, by those of the world's."""
    for k in range(rows.shape[0]):
        for h in range(2):
            x, y, z = rows[k, 3 * h], rows[k, 3 * h + 1], rows[k, 3 * h + 2]
            for j in range(3):
                out[k, 3 * h + j] = x * q[0, j] + y * q[1, j] + z * q[2, j]


@leaf
def image_row(
    n0: float,
    n1: float,
    u: float,
    v: float,
    z: float,
    s0: float,
    s1: float,
    s2: float,
    scale: float,
    row: FloatArray,
) -> None:
    """row (6,): how (w, d), in the camera's axes, move a point's image (u, v) in the direction n: (s × h, scale h).

    h = n' D, with D the derivative of the image by the point, which lies at the depth z and at s as seen from the centre of
    the turn. Where all is known up to the point's scale, z and s are scaled by it.
    """
    h0, h1 = n0 / z, n1 / z
    h2 = -(h0 * u + h1 * v)
    row[0], row[1], row[2] = s1 * h2 - s2 * h1, s2 * h0 - s0 * h2, s0 * h1 - s1 * h0
    row[3], row[4], row[5] = scale * h0, scale * h1, scale * h2
