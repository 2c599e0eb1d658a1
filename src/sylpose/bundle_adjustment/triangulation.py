"""Compiled: initial landmark positions, the points nearest to their rays."""

from __future__ import annotations

import numpy as np

from sylpose.bundle_adjustment.kernels import SortedObservations, Views
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky_solve, kernel

__all__ = ["triangulate_rays"]


@kernel
def triangulate_rays(observations: SortedObservations, views: Views, prior: float, out: FloatArray) -> None:
    """Write the points nearest to their rays and, weakly, to the origin to out (m, 3).

    Rays are weighted by the inverse squared size of a pixel at the object.
    """
    ray, center, a = np.empty(3), np.empty(3), np.empty((3, 3))
    for i in range(out.shape[0]):
        for p in range(3):
            a[p], out[i, p] = 0.0, 0.0
            a[p, p] = prior
        for n in range(observations.start[i], observations.start[i + 1]):
            k, c = observations.frame[n], observations.camera[n]
            r, m, b = views.object_rotations[k], views.camera_from_object[k, c], views.translations[k, c]
            x, y = observations.image[n, 0], observations.image[n, 1]
            # M R rotates the object's axes into the camera's.
            for p in range(3):
                ray[p], center[p] = 0.0, 0.0
                for q in range(3):
                    direction = m[0, q] * x + m[1, q] * y + m[2, q]
                    ray[p] += r[q, p] * direction
                    center[p] -= r[q, p] * (m[0, q] * b[0] + m[1, q] * b[1] + m[2, q] * b[2])
            square = x * x + y * y + 1.0
            weight = views.focals[c] ** 2 / (b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
            along = (ray[0] * center[0] + ray[1] * center[1] + ray[2] * center[2]) / square
            for p in range(3):
                a[p, p] += weight
                out[i, p] += weight * (center[p] - along * ray[p])
                for q in range(3):
                    a[p, q] -= weight * ray[p] * ray[q] / square
        cholesky_solve(a, out[i])
