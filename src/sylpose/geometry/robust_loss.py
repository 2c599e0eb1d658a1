"""Robust statistics: weight functions for re-weighting, their response to Gaussian noise, chi-squared bounds.

Weights are functions of q = (d / cutoff)², the squared residual in two coordinates relative to a cutoff, which avoids
square roots. All constants that depend on a cutoff are derived from it here.

Source: M-estimators, Huber & Ronchetti, "Robust Statistics", chapters 3 and 6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, gamma, gammainc, ndtri

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.geometry.validation import check_number, check_real

# (C,) in the order of cameras, or by their names.
NoisePx = ArrayLike | Mapping[str, float]
# Default noise of keypoints, pixels (choice: SIFT has 0.3 to 0.7).
DEFAULT_NOISE_PX = 0.5
# Smallest and largest finite noise accepted, pixels (choice: beyond that of any feature).
MIN_NOISE_PX, MAX_NOISE_PX = 1e-4, 1e6

# Probability with which chance exceeds the limits of tests (choice).
SIGNIFICANCE = 1e-3
# Weight of the rig's noise in a camera's estimate, as a number of matches (choice).
RIG_PRIOR_MATCHES = 10.0

# Values of the losses, integrals of the weights by q, from the cutoff on (derived).
BIQUARTIC_BOUND = 8.0 / 15.0
# Standard deviation of a Gaussian variable over the median of its absolute value (derived).
SIGMA_OF_MEDIAN = 1.0 / float(ndtri(0.75))


@kernel
def bisquare(q: float) -> float:
    """Return Tukey's weight (1 - q)², 0 from the cutoff on."""
    return (1.0 - q) ** 2 if q < 1.0 else 0.0


@kernel
def biquartic(q: float) -> float:
    """Return the weight (1 - q²)², 0 from the cutoff on; nearly 1 up to two fifths of the cutoff."""
    return (1.0 - q * q) ** 2 if q < 1.0 else 0.0


@kernel
def biquartic_loss(q: float) -> float:
    """Return the integral of `biquartic` from 0 to q: q for small ones, `BIQUARTIC_BOUND` from the cutoff on."""
    q2 = q * q
    return q * (1.0 - q2 * (2.0 / 3.0 - 0.2 * q2)) if q < 1.0 else BIQUARTIC_BOUND


def biquartic_weights(q: FloatArray) -> FloatArray:
    """Return (n,) `biquartic` of each."""
    bounded = np.fmin(q, 1.0)
    return np.asarray((1.0 - bounded * bounded) ** 2)


def biquartic_losses(q: FloatArray) -> FloatArray:
    """Return (n,) `biquartic_loss` of each."""
    bounded = np.fmin(q, 1.0)
    q2 = bounded * bounded
    return np.where(q < 1.0, bounded * (1.0 - q2 * (2.0 / 3.0 - 0.2 * q2)), BIQUARTIC_BOUND)


class NoiseResponse(NamedTuple):
    """Response of a weight function to Gaussian noise in two coordinates.

    Attributes:
        weight: the mean weight.
        square: the mean weighted square of a coordinate, in variances.
        score: the mean square of a weighted coordinate, in variances.
        efficiency: the variance of plain least squares over that of the weighted estimate.
    """

    weight: float
    square: float
    score: float
    efficiency: float

    @property
    def shrinkage(self) -> float:
        """The weighted mean square, in variances: divide by it to estimate the variance."""
        return self.square / self.weight

    @property
    def gain(self) -> float:
        """The information of the estimate over the sum of its weights: the sandwich A² / B over the mean weight."""
        return self.efficiency / self.weight


def bisquare_noise_response(cutoff: float) -> NoiseResponse:
    """Return the response of the bisquare with a cutoff in standard deviations of a coordinate."""
    return _compute_noise_response(np.array([1.0, -2.0, 1.0]), cutoff)


def biquartic_noise_response(cutoff: float) -> NoiseResponse:
    """Return the response of the biquartic with a cutoff in standard deviations of a coordinate."""
    return _compute_noise_response(np.array([1.0, 0.0, -2.0, 0.0, 1.0]), cutoff)


def _compute_noise_response(weight: FloatArray, cutoff: float) -> NoiseResponse:
    """Return the response of a weight that is this polynomial in q, constant term first, up to the cutoff.

    Half the square in standard deviations, s = d² / 2 = a q with a = cutoff² / 2, is exponentially distributed: the
    means of its powers, cut off at a, are incomplete gamma functions. With ψ = w e for the residual e (2,), A = E ∂ψ/∂e
    = E (w + s dw/ds) and B = E ψ² = E w² s in each coordinate.
    """
    a = 0.5 * cutoff * cutoff

    def mean(polynomial: FloatArray, times_s: int = 0) -> float:
        power = np.arange(len(polynomial)) + times_s
        return float(polynomial @ (gammainc(power + 1, a) * gamma(power + 1) / a ** (power - times_s)))

    slope, score = mean(weight * (1 + np.arange(len(weight)))), mean(np.convolve(weight, weight), 1)
    return NoiseResponse(mean(weight), mean(weight, 1), score, slope**2 / score)


def chi_squared_bound(freedom: int, probability: float = SIGNIFICANCE) -> float:
    """Return the value that chi-squared with so many degrees of freedom exceeds with this probability."""
    return float(chdtri(freedom, probability))


def robust_sigma(residuals: FloatArray, floor: float) -> float:
    """Return the standard deviation of zero-mean residuals from the median absolute value, at least `floor`."""
    if len(residuals) == 0:
        return floor
    return max(float(SIGMA_OF_MEDIAN * np.median(np.abs(residuals))), floor)


class NoiseUnits(NamedTuple):
    """Units of the image plane in which all cameras have the same noise.

    They are pixels for the camera with the least noise, unless that is above the default: then distances are scaled
    down.

    Attributes:
        per_px: (C,) units per pixel; 0 where the noise is infinite.
        sigma: the noise in these units. Estimators that measure a larger noise use the measured one.
    """

    per_px: FloatArray
    sigma: float


def make_noise_units(noise_px: NoisePx, names: Sequence[str]) -> NoiseUnits:
    """Make units of the image plane in which n cameras have equal noise.

    Args:
        noise_px: (n,) standard deviations of an image coordinate, pixels, in the order of `names`; or a mapping from
            names to them.
        names: of the cameras.

    Raises:
        ValueError: not (n,), or not of these cameras; values out of range. Infinite noise is allowed.
    """
    n = len(names)
    if isinstance(noise_px, Mapping):
        wrong = [f"{name!r} is not a camera" for name in noise_px if name not in names]
        wrong += [f"camera {name} is missing" for name in names if name not in noise_px]
        if wrong:
            raise ValueError(f"noise_px: expected a number for each of {', '.join(names)}, but {wrong[0]}")
        noise_px = [check_number(noise_px[name], f"noise_px[{name!r}]", maximum=np.inf) for name in names]
    noise = check_real(noise_px, f"({n},)", "noise_px")
    if noise.shape != (n,):
        raise ValueError(f"noise_px must be ({n},), a number for each camera, got shape {noise.shape}")
    if not (((noise >= MIN_NOISE_PX) & (noise <= MAX_NOISE_PX)) | (noise == np.inf)).all():
        raise ValueError(
            f"noise_px must be from {MIN_NOISE_PX:g} to {MAX_NOISE_PX:g} pixels, or infinite for a camera to ignore, "
            f"got {noise.tolist()}"
        )
    sigma = min(float(noise.min(initial=np.inf)), DEFAULT_NOISE_PX)
    return NoiseUnits(sigma / noise, sigma)
