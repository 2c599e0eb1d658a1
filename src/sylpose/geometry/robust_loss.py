"""Robust statistics: the two weights that all re-weighting uses, what Gaussian noise makes of them, and bounds on chance.

Weights are functions of q = (d / cutoff)², the square of a residual in two coordinates relative to a cutoff, so that
nothing has a root to take. All constants that go with a cutoff follow from it here.

Source: M-estimators, Huber & Ronchetti, "Robust Statistics", chapters 3 and 6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, gamma, gammainc, ndtri

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel

__all__ = [
    "BIQUARTIC_BOUND",
    "BISQUARE_BOUND",
    "SIGMA_OF_MEDIAN",
    "OnNoise",
    "biquartic",
    "biquartic_loss",
    "biquartic_losses",
    "biquartic_on_noise",
    "biquartic_weights",
    "bisquare",
    "bisquare_on_noise",
    "chi_squared_bound",
    "robust_sigma",
]

# What the losses, integrals of the weights by q, come to from the cutoff on (derived).
BISQUARE_BOUND = 1.0 / 3.0
BIQUARTIC_BOUND = 8.0 / 15.0
# The standard deviation of a Gaussian variable over the median of its absolute value (derived).
SIGMA_OF_MEDIAN = 1.0 / float(ndtri(0.75))


@kernel
def bisquare(q: float) -> float:
    """Tukey's weight (1 - q)², 0 from the cutoff on."""
    return (1.0 - q) ** 2 if q < 1.0 else 0.0


@kernel
def biquartic(q: float) -> float:
    """The weight (1 - q²)², 0 from the cutoff on: flatter than the bisquare, nearly 1 up to two fifths of the cutoff."""
    return (1.0 - q * q) ** 2 if q < 1.0 else 0.0


@kernel
def biquartic_loss(q: float) -> float:
    """The integral of `biquartic` from 0 to q: q for small ones, `BIQUARTIC_BOUND` from the cutoff on."""
    q2 = q * q
    return q * (1.0 - q2 * (2.0 / 3.0 - 0.2 * q2)) if q < 1.0 else BIQUARTIC_BOUND


@kernel
def _each(q: FloatArray, loss: bool, out: FloatArray) -> None:
    for i in range(len(q)):
        out[i] = biquartic_loss(q[i]) if loss else biquartic(q[i])


def biquartic_weights(q: FloatArray) -> FloatArray:
    """(n,) `biquartic` of each."""
    out = np.empty(len(q))
    _each(q, False, out)
    return out


def biquartic_losses(q: FloatArray) -> FloatArray:
    """(n,) `biquartic_loss` of each."""
    out = np.empty(len(q))
    _each(q, True, out)
    return out


class OnNoise(NamedTuple):
    """What weights make of Gaussian noise in two coordinates.

    Attributes:
        weight: the mean weight.
        square: the mean weighted square of a coordinate, in variances.
        efficiency: the variance of plain least squares over that of the weighted estimate.
    """

    weight: float
    square: float
    efficiency: float

    @property
    def shrinkage(self) -> float:
        """The weighted mean square, in variances: what to divide it by for the variance."""
        return self.square / self.weight

    @property
    def gain(self) -> float:
        """The information that the estimate has over what its weights say: the sandwich A² / B over the mean weight."""
        return self.efficiency / self.weight


def bisquare_on_noise(cutoff: float) -> OnNoise:
    """Of the bisquare with a cutoff in standard deviations of a coordinate."""
    return _on_noise(np.array([1.0, -2.0, 1.0]), cutoff)


def biquartic_on_noise(cutoff: float) -> OnNoise:
    """Of the biquartic with a cutoff in standard deviations of a coordinate."""
    return _on_noise(np.array([1.0, 0.0, -2.0, 0.0, 1.0]), cutoff)


def _on_noise(weight: FloatArray, cutoff: float) -> OnNoise:
    """Of a weight that is this polynomial in q, constant term first, up to the cutoff.

    Half the square in standard deviations, s = d² / 2 = a q with a = cutoff² / 2, is exponential: its powers, cut off at a,
    have incomplete gamma functions as means. With ψ = w e for the residual e (2,), A = E ∂ψ/∂e = E (w + s dw/ds) and
    B = E ψ² = E w² s in each coordinate.
    """
    a = 0.5 * cutoff * cutoff

    def mean(polynomial: FloatArray, times_s: int = 0) -> float:
        power = np.arange(len(polynomial)) + times_s
        return float(polynomial @ (gammainc(power + 1, a) * gamma(power + 1) / a ** (power - times_s)))

    slope = mean(weight * (1 + np.arange(len(weight))))
    return OnNoise(mean(weight), mean(weight, 1), slope**2 / mean(np.convolve(weight, weight), 1))


def chi_squared_bound(freedom: int, chance: float = 1e-3) -> float:
    """What chi-squared with so many degrees of freedom exceeds by chance: once in a thousand times unless said otherwise."""
    return float(chdtri(freedom, chance))


def robust_sigma(residuals: FloatArray, floor: float) -> float:
    """Standard deviation of the bulk of zero-mean residuals (median absolute value), at least `floor`."""
    if len(residuals) == 0:
        return floor
    return max(float(SIGMA_OF_MEDIAN * np.median(np.abs(residuals))), floor)
