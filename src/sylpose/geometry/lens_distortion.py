"""Compiled: projection by OpenCV's standard lens model.

`cv2.projectPoints` always computes all derivatives as well, and takes ten times as long.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel

# Coefficients, in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4. Tilted sensors, with two more, are left to
# OpenCV (derived).
N_TERMS = 12


@kernel
def distort_point(x: float, y: float, matrix: FloatArray, k: FloatArray) -> tuple[float, float]:
    """Return the pixel of a normalized point, by a matrix (3, 3) and coefficients k (12,)."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    radial /= 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    u = x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x) + r2 * (k[8] + r2 * k[9])
    v = y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y + r2 * (k[10] + r2 * k[11])
    return matrix[0, 0] * u + matrix[0, 2], matrix[1, 1] * v + matrix[1, 2]


@kernel
def project_points(
    X: FloatArray, rotation: FloatArray, translation: FloatArray, matrix: FloatArray, k: FloatArray, out: FloatArray
) -> None:
    """Write the pixels of points X (n, 3) to out (n, 2), with X_c = rotation X + translation; NaN behind the camera."""
    for i in range(X.shape[0]):
        a, b, c = X[i]
        z = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c + translation[2]
        if z > 1e-9:
            x = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c + translation[0]
            y = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c + translation[1]
            out[i, 0], out[i, 1] = distort_point(x / z, y / z, matrix, k)
        else:
            out[i, 0], out[i, 1] = np.nan, np.nan
