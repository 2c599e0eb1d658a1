"""Normal equations of many cameras: the motion that they share, and what each of them has for itself eliminated.

A motion is (w, d): a turn R = exp(w) R̂ and a displacement. A camera's derivatives are in its own axes, in which they are
simple, and are turned into the world's, Q of camera_from_world, once they are summed.
"""

from __future__ import annotations

from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.compiled import cholesky, kernel

__all__ = ["add_turned", "eliminate", "image_row", "turn_rows"]


@kernel
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
    for i in range(k):
        for j in range(columns):
            s = coupled[i, j]
            for m in range(i):
                s -= block[i, m] * coupled[m, j]
            coupled[i, j] = s / block[i, i]
    # With C and b divided by the factor, what goes is their product with themselves.
    for i in range(columns - 1):
        for j in range(columns):
            s = kept[i, j]
            for m in range(k):
                s -= coupled[m, i] * coupled[m, j]
            kept[i, j] = s
    for i in range(k - 1, -1, -1):
        for j in range(columns):
            s = coupled[i, j]
            for m in range(i + 1, k):
                s -= block[m, i] * coupled[m, j]
            coupled[i, j] = s / block[i, i]
    return True


@kernel
def add_turned(lower: FloatArray, q: FloatArray, total: FloatArray) -> None:
    """Adds a form in (w, d), its lower triangle (6, 6) in a camera's axes, to total (6, 6 at least) in the world's: both
    halves turn with Q (3, 3)."""
    half = lower[:6, :6].copy()
    for i in range(6):
        for j in range(i):
            half[j, i] = half[i, j]
    for h in range(2):
        for i in range(6):
            x, y, z = half[i, 3 * h], half[i, 3 * h + 1], half[i, 3 * h + 2]
            for j in range(3):
                half[i, 3 * h + j] = x * q[0, j] + y * q[1, j] + z * q[2, j]
    for h in range(2):
        for j in range(6):
            x, y, z = half[3 * h, j], half[3 * h + 1, j], half[3 * h + 2, j]
            for i in range(3):
                total[3 * h + i, j] += x * q[0, i] + y * q[1, i] + z * q[2, i]


@kernel
def turn_rows(rows: FloatArray, q: FloatArray, out: FloatArray) -> None:
    """out (k, 6 at least): rows (k, 6) by (w, d) of a camera's axes, by those of the world's."""
    for k in range(rows.shape[0]):
        for h in range(2):
            x, y, z = rows[k, 3 * h], rows[k, 3 * h + 1], rows[k, 3 * h + 2]
            for j in range(3):
                out[k, 3 * h + j] = x * q[0, j] + y * q[1, j] + z * q[2, j]


@kernel
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
