"""Compiled: noise of each camera in `estimate_pose`, from the median at first, then from the weighted squares."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.geometry.robust_loss import biquartic, biquartic_noise_response

__all__ = [
    "CUTOFF",
    "INFORMATION_GAIN",
    "MEDIAN_SQUARE",
    "Noise",
    "compute_median_square",
    "compute_weights",
    "estimate_noise",
    "set_noise",
]


# Cutoff of the biquartic weights: nearly 1 up to two sigma, 0 beyond five (choice).
CUTOFF = 5.0
# For Gaussian noise: reduction of the mean weight and of the mean weighted square by these weights, and the factor
# missing in the information from the weights (derived).
_NOISE_RESPONSE = biquartic_noise_response(CUTOFF)
WEIGHT_LOSS, SQUARE_LOSS, INFORMATION_GAIN = (
    1.0 - _NOISE_RESPONSE.weight,
    1.0 - _NOISE_RESPONSE.square,
    _NOISE_RESPONSE.gain,
)
# Median of the squared length of two Gaussian coordinates, in variances of one (derived).
MEDIAN_SQUARE = 2.0 * np.log(2.0)
# The cutoff loses an inlier less often than once in exp(LOG_MISS_ODDS) with an uncertain noise level (choice).
LOG_MISS_ODDS = 8.0
# Distances due to rounding alone, pixels: a lower limit of the noise (choice).
ROUNDING_PX = 1e-6
# A camera has an individual noise level if its variance differs from the others' by so many standard deviations and it
# has so many degrees of freedom (choice).
MIN_DEVIATION_SIGMAS, MIN_OWN_FREEDOM = 4.0, 8.0


class Noise(NamedTuple):
    """The noise of each camera.

    Attributes:
        variances: (C,) of a coordinate, pixels squared.
        cutoffs: (C,) squared distances, pixels squared, from which on a match is an outlier.
    """

    variances: FloatArray
    cutoffs: FloatArray


@leaf
def compute_median_square(squares: FloatArray, max_square: float) -> tuple[float, int]:
    """Return the median of the squares below `max_square`, to a thousandth, and their number.

    Bisection needs no copy and no sorting.
    """
    count = 0
    for s in squares:
        count += s < max_square
    low, high = 0.0, max_square
    # The noise is anywhere between rounding and the cutoff: halve the exponent first.
    for _ in range(60):
        if high < 1.001 * low:
            break
        middle = np.sqrt(low * high) if low > 0.0 else 0.01 * high
        below = 0
        for s in squares:
            below += s < middle
        if 2 * below >= count:
            high = middle
        else:
            low = middle
        if high < ROUNDING_PX * ROUNDING_PX:
            break
    return high, count


@leaf
def compute_weights(squares: FloatArray, start: IntArray, noise: Noise, weights: FloatArray) -> None:
    """Write the weights (n,) of squared distances (n,)."""
    for c in range(len(start) - 1):
        for k in range(start[c], start[c + 1]):
            weights[k] = biquartic(squares[k] / noise.cutoffs[c])


@leaf
def set_noise(noise: Noise, c: int, variance: float, min_variance: float, freedom: float, max_square: float) -> None:
    """Set camera c's variance, at least `min_variance`, and its cutoff for so many degrees of freedom."""
    variance = max(variance, min_variance, ROUNDING_PX * ROUNDING_PX)
    # Few degrees of freedom may underestimate the noise: the cutoff is then Student's, not Gauss's.
    factor = max(CUTOFF * CUTOFF, freedom * (np.exp(min(2.0 * LOG_MISS_ODDS / freedom, 50.0)) - 1.0))
    noise.variances[c] = variance
    noise.cutoffs[c] = min(factor * variance, max_square)


@kernel
def estimate_noise(
    squares: FloatArray, start: IntArray, weights: FloatArray, min_variance: float, max_square: float, noise: Noise
) -> float:
    """Estimate the noise from the weighted squares: one level for all cameras except significantly different ones.

    Args:
        min_variance: lower limit of the variances.

    Returns:
        degrees of freedom.
    """
    n_cameras = len(start) - 1
    sums, counts = np.zeros(n_cameras), np.zeros(n_cameras)
    total = 0.0
    for c in range(n_cameras):
        n_inliers = 0
        for k in range(start[c], start[c + 1]):
            if weights[k] > 0.0:
                sums[c] += weights[k] * squares[k]
                counts[c] += weights[k]
                n_inliers += 1
        # The reduction by the weights of Gaussian noise goes with the fourth power of the cutoff.
        loss_factor = (CUTOFF * CUTOFF * noise.variances[c] / noise.cutoffs[c]) ** 2
        sums[c] /= 1.0 - min(loss_factor * SQUARE_LOSS, 0.5)
        counts[c] = 2.0 * min(counts[c] / (1.0 - min(loss_factor * WEIGHT_LOSS, 0.5)), float(n_inliers))
        total += counts[c]
    freedom = max(total - 6.0, 1.0)
    freedom_ratio = freedom / max(total, 1.0)
    has_own_noise = np.zeros(n_cameras, np.bool_)
    common = 1.0
    for _ in range(3):
        squared, free = 0.0, 0.0
        for c in range(n_cameras):
            if not has_own_noise[c]:
                squared, free = squared + sums[c], free + freedom_ratio * counts[c]
        if free <= 0.0:
            break
        common = max(squared / free, ROUNDING_PX * ROUNDING_PX)
        for c in range(n_cameras):
            own_freedom = freedom_ratio * counts[c]
            # A camera with mostly inconsistent matches has outliers, not noise.
            if own_freedom >= MIN_OWN_FREEDOM and counts[c] >= start[c + 1] - start[c]:
                ratio = np.log(max(sums[c] / own_freedom, ROUNDING_PX * ROUNDING_PX) / common)
                has_own_noise[c] = abs(ratio) > MIN_DEVIATION_SIGMAS * np.sqrt(2.0 / own_freedom + 2.0 / free)
    for c in range(n_cameras):
        set_noise(
            noise,
            c,
            sums[c] / (freedom_ratio * counts[c]) if has_own_noise[c] else common,
            min_variance,
            freedom,
            max_square,
        )
    return freedom
