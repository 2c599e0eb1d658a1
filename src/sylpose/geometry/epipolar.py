"""Essential matrices and Sampson distances, vectorized."""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray

__all__ = ["essential_matrix", "sampson_scale"]


# Squared gradient of a residual y'Ex by its points below which there is no epipolar geometry (choice).
MIN_SQUARED_GRADIENT = 1e-24


def essential_matrix(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return (..., 3, 3) E = [t]x R of the motion X -> R X + t in the camera's axes: y'E x = 0."""
    return np.asarray(np.cross(np.eye(3), translation[..., None, :]) @ rotation)


def sampson_scale(E: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return (...,) √g, the divisor that turns a residual y'E x into a Sampson distance, with noise in both frames.

    Without any motion the residual vanishes and √g is 1e-12.

    Args:
        E: (..., 3, 3), or one for all.
        x, y: (..., 3) points in the two frames, with a third coordinate of 1.

    Source: Hartley & Zisserman, "Multiple View Geometry", section 11.4.3.
    """
    gradient_y, gradient_x = np.einsum("...ij,...j->...i", E, x), np.einsum("...ji,...j->...i", E, y)
    squared_gradient = (gradient_y[..., :2] ** 2).sum(axis=-1) + (gradient_x[..., :2] ** 2).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(squared_gradient, MIN_SQUARED_GRADIENT)))
