"""Robust statistics."""

from __future__ import annotations

import numpy as np

from sylpose.numerics.arrays import FloatArray

__all__ = ["robust_sigma"]


def robust_sigma(residuals: FloatArray, floor: float) -> float:
    """Standard deviation of the bulk of zero-mean residuals (median absolute value), at least `floor`."""
    if len(residuals) == 0:
        return floor
    return max(float(1.4826 * np.median(np.abs(residuals))), floor)


def bisquare(residuals: FloatArray, cutoff: FloatArray | float) -> FloatArray:
    """Tukey's bisquare weights: (1 - (r / cutoff)^2)^2 inside the cutoff, 0 outside."""
    return np.asarray(np.maximum(1.0 - (residuals / cutoff) ** 2, 0.0) ** 2)
