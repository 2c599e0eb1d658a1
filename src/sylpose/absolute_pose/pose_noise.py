"""The noise of each camera in `estimate_pose`: from the median at first, then from the weighted squares; compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.geometry.robust_loss import biquartic, biquartic_on_noise

__all__ = ["CUTOFF", "GAIN", "MEDIAN_SQUARE", "Noise", "measure_noise", "median_square", "set_noise", "weigh"]


# Cutoff of the biquartic weights: nearly 1 up to two sigma, 0 beyond five (choice).
CUTOFF = 5.0
# For Gaussian noise: what the mean weight and the mean weighted square lose to these weights, and what the information that
# the weights say then lacks (derived).
_ON_NOISE = biquartic_on_noise(CUTOFF)
LOST_WEIGHT, LOST_SQUARE, GAIN = 1.0 - _ON_NOISE.weight, 1.0 - _ON_NOISE.square, _ON_NOISE.gain
# The median of the squared length of two Gaussian coordinates, in variances of one (derived).
MEDIAN_SQUARE = 2.0 * np.log(2.0)
# A cutoff that loses a good match less often than once in exp(WIDE) where the noise level is itself uncertain (choice).
WIDE = 8.0
# Distances from rounding alone, pixels: below it, nothing is noise (choice).
ROUNDING_PX = 1e-6
# A camera has a noise of its own when its variance differs from the others' by so many standard deviations, and when it
# has so many degrees of freedom (choice).
OWN_NOISE, OWN_FREEDOM = 4.0, 8.0


class Noise(NamedTuple):
    """The noise of each camera.

    Attributes:
        variances: (C,) of a coordinate, pixels squared.
        tops: (C,) squared distances, pixels squared, from which on a match is an outlier.
    """

    variances: FloatArray
    tops: FloatArray


@leaf
def median_square(squares: FloatArray, top: float) -> tuple[float, int]:
    """The median of the squares below `top`, to a thousandth, and their number: bisection needs no copy and no sorting."""
    count = 0
    for s in squares:
        count += s < top
    low, high = 0.0, top
    # Noise may be anywhere between rounding and the top: halve the exponent first.
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
def weigh(squares: FloatArray, start: IntArray, noise: Noise, weights: FloatArray) -> None:
    """weights (n,) of squared distances (n,)."""
    for c in range(len(start) - 1):
        for k in range(start[c], start[c + 1]):
            weights[k] = biquartic(squares[k] / noise.tops[c])


@leaf
def set_noise(noise: Noise, c: int, variance: float, least: float, freedom: float, top: float) -> None:
    """Camera c gets a variance, which is not less than what is believed at least, known with so many degrees of freedom, and
    the cutoff that goes with it."""
    variance = max(variance, least, ROUNDING_PX * ROUNDING_PX)
    # Few degrees of freedom may show far too little noise: the cutoff is then Student's, not Gauss's.
    factor = max(CUTOFF * CUTOFF, freedom * (np.exp(min(2.0 * WIDE / freedom, 50.0)) - 1.0))
    noise.variances[c] = variance
    noise.tops[c] = min(factor * variance, top)


@kernel
def measure_noise(
    squares: FloatArray, start: IntArray, weights: FloatArray, least: float, top: float, noise: Noise
) -> float:
    """The noise from the weighted squares: one level for all cameras, its own for a camera that certainly differs.

    Args:
        least: no variance is believed to be less.

    Returns:
        degrees of freedom.
    """
    n_cameras = len(start) - 1
    sums, counts = np.zeros(n_cameras), np.zeros(n_cameras)
    total = 0.0
    for c in range(n_cameras):
        agree = 0
        for k in range(start[c], start[c + 1]):
            if weights[k] > 0.0:
                sums[c] += weights[k] * squares[k]
                counts[c] += weights[k]
                agree += 1
        # What the weights take from Gaussian noise goes with the fourth power of the cutoff.
        lost = (CUTOFF * CUTOFF * noise.variances[c] / noise.tops[c]) ** 2
        sums[c] /= 1.0 - min(lost * LOST_SQUARE, 0.5)
        counts[c] = 2.0 * min(counts[c] / (1.0 - min(lost * LOST_WEIGHT, 0.5)), float(agree))
        total += counts[c]
    freedom = max(total - 6.0, 1.0)
    left = freedom / max(total, 1.0)
    own = np.zeros(n_cameras, np.bool_)
    common = 1.0
    for _ in range(3):
        squared, free = 0.0, 0.0
        for c in range(n_cameras):
            if not own[c]:
                squared, free = squared + sums[c], free + left * counts[c]
        if free <= 0.0:
            break
        common = max(squared / free, ROUNDING_PX * ROUNDING_PX)
        for c in range(n_cameras):
            mine = left * counts[c]
            # A camera most of whose matches disagree has outliers, not noise.
            if mine >= OWN_FREEDOM and counts[c] >= start[c + 1] - start[c]:
                ratio = np.log(max(sums[c] / mine, ROUNDING_PX * ROUNDING_PX) / common)
                own[c] = abs(ratio) > OWN_NOISE * np.sqrt(2.0 / mine + 2.0 / free)
    for c in range(n_cameras):
        set_noise(noise, c, sums[c] / (left * counts[c]) if own[c] else common, least, freedom, top)
    return freedom
