"""Essential matrices and Sampson's distance, of stacks."""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray

__all__ = ["essential", "sampson"]


# The square of what a residual y'Ex changes by per unit of its points, below which there is no epipolar geometry (choice).
NO_MOTION = 1e-24


def essential(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """(..., 3, 3) E = [t]x R of the motion X -> R X + t of the camera's axes: y'E x = 0."""
    return np.asarray(np.cross(np.eye(3), translation[..., None, :]) @ rotation)


def sampson(E: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(...,) √g, by which to divide a residual y'E x for its distance in the image, both frames' noise counted: Sampson's.

    Args:
        E: (..., 3, 3), or one for all.
        x, y: (..., 3) points in the two frames, with a third coordinate of 1.

    Without any motion the residual vanishes and √g is 1e-12.

    Source: Hartley & Zisserman, "Multiple View Geometry", section 11.4.3.
    """
    of_y, of_x = np.einsum("...ij,...j->...i", E, x), np.einsum("...ji,...j->...i", E, y)
    g = (of_y[..., :2] ** 2).sum(axis=-1) + (of_x[..., :2] ** 2).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(g, NO_MOTION)))
