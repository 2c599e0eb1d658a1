"""Robust weights against their definitions, and the constants of a cutoff against quadrature and sampling."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import chi2

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.robust_loss import (
    BIQUARTIC_BOUND,
    SIGMA_OF_MEDIAN,
    NoiseResponse,
    biquartic,
    biquartic_loss,
    biquartic_losses,
    biquartic_noise_response,
    biquartic_weights,
    bisquare,
    bisquare_noise_response,
    chi_squared_bound,
    robust_sigma,
)

SEEDS = st.integers(0, 2**32 - 1)
Weight = Callable[[float], float]
WEIGHTS: dict[str, tuple[Weight, float, Callable[[float], NoiseResponse]]] = {
    "bisquare": (bisquare, 1.0 / 3.0, bisquare_noise_response),
    "biquartic": (biquartic, BIQUARTIC_BOUND, biquartic_noise_response),
}
CUTOFFS = [1.5, 3.0, 4.7, 5.0, 8.0]
both = pytest.mark.parametrize("name", WEIGHTS)


# --- the weights -----------------------------------------------------------------------------------------------------


@both
def test_weight_falls_from_one_to_zero_at_the_cutoff(name: str) -> None:
    weight = WEIGHTS[name][0]
    values = [weight(q) for q in np.linspace(0.0, 1.0, 101)]
    assert values[0] == 1.0
    assert (np.diff(values) < 0).all()
    for q in (1.0, 1.0 + 1e-12, 7.0, np.inf, np.nan):
        assert weight(q) == 0.0


def test_weights_at_half_the_cutoff() -> None:
    """As functions of d, not of its square: at half the cutoff, (1 - (1/2)²)² and (1 - (1/2)⁴)²."""
    assert bisquare(0.25) == pytest.approx(0.5625, rel=1e-12)
    assert biquartic(0.25) == pytest.approx(0.87890625, rel=1e-12)


@both
def test_loss_bound_is_the_integral_of_the_weight(name: str) -> None:
    weight, bound, _ = WEIGHTS[name]
    assert quad(weight, 0.0, 1.0)[0] == pytest.approx(bound, rel=1e-10)


@pytest.mark.parametrize("q", [0.0, 1e-6, 0.1, 0.5, 0.9, 1.0, 3.0, np.inf])
def test_biquartic_loss_is_the_integral_of_its_weight(q: float) -> None:
    assert biquartic_loss(q) == pytest.approx(quad(biquartic, 0.0, min(q, 1.0))[0], rel=1e-10, abs=1e-15)


@settings(max_examples=20)
@given(SEEDS)
def test_arrays_match_scalars(seed: int) -> None:
    q = np.random.default_rng(seed).uniform(0, 2, 20)
    np.testing.assert_array_equal(biquartic_weights(q), [biquartic(x) for x in q])
    np.testing.assert_array_equal(biquartic_losses(q), [biquartic_loss(x) for x in q])


# --- response to Gaussian noise ------------------------------------------------------------------------------------


def by_quadrature(weight: Weight, cutoff: float) -> NoiseResponse:
    """Compute the same integrals over the plane in polar coordinates, with the derivative of ψ by differences."""

    def mean(f: Callable[[float], float]) -> float:
        return float(quad(lambda r: f(r) * r * np.exp(-0.5 * r * r), 0.0, cutoff, limit=200)[0])

    def w(r: float) -> float:
        return weight((r / cutoff) ** 2)

    def slope(r: float) -> float:
        # Derivative of ψ = w(|e|) e: w across e and r w' + w along it, averaged.
        h = 1e-5 * cutoff
        return w(r) + 0.5 * r * (w(r + h) - w(abs(r - h))) / (2 * h)

    of_square = mean(lambda r: w(r) ** 2 * r * r / 2)
    return NoiseResponse(mean(w), mean(lambda r: w(r) * r * r / 2), of_square, mean(slope) ** 2 / of_square)


@both
@pytest.mark.parametrize("cutoff", CUTOFFS)
def test_cutoff_constants_match_quadrature(name: str, cutoff: float) -> None:
    weight, _, on_noise = WEIGHTS[name]
    np.testing.assert_allclose(on_noise(cutoff), by_quadrature(weight, cutoff), rtol=1e-7)


@both
def test_infinite_cutoff_is_least_squares(name: str) -> None:
    np.testing.assert_allclose(WEIGHTS[name][2](1e4), 1.0, atol=1e-6)
    assert WEIGHTS[name][2](1e4).shrinkage == pytest.approx(1.0, abs=1e-6)


@both
@pytest.mark.parametrize("cutoff", [3.0, 5.0])
def test_cutoff_constants_match_sampling(name: str, cutoff: float) -> None:
    """Scale and efficiency of re-weighted location estimates from Gaussian samples."""
    weight, _, on_noise = WEIGHTS[name]
    constants, rng, draws, n = on_noise(cutoff), np.random.default_rng(0), 3000, 60
    at = np.linspace(0.0, 1.0, 4001)
    table = np.array([weight(q) for q in at])
    e = rng.standard_normal((draws, n, 2))
    place = e.mean(axis=1)

    def weights(place: FloatArray) -> FloatArray:
        q = ((e - place[:, None]) ** 2).sum(axis=2) / cutoff**2
        return np.asarray(np.interp(q, at, table))

    for _ in range(30):
        w = weights(place)
        place = np.einsum("dn,dni->di", w, e) / w.sum(axis=1, keepdims=True)
    w = weights(np.zeros((draws, 2)))
    # Relative to the mean of the same draws most of the scatter cancels.
    efficiency = e.mean(axis=1).var() / place.var()
    assert efficiency == pytest.approx(constants.efficiency, abs=0.02)
    assert np.mean(w) == pytest.approx(constants.weight, abs=0.003)
    assert (w * (e**2).sum(axis=2)).sum() / 2 / w.sum() == pytest.approx(constants.shrinkage, abs=0.01)
    # The covariance from the sum of the weights and the gain is that of the estimates.
    assert place.var() * n * constants.weight * constants.gain == pytest.approx(1.0, abs=0.07)


# --- scale and probability -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("freedom", [1, 3, 6, 20])
def test_chi_squared_bound_has_the_stated_probability(freedom: int) -> None:
    assert chi_squared_bound(freedom) == pytest.approx(chi2.isf(1e-3, freedom), rel=1e-9)
    bound = chi_squared_bound(freedom, 0.05)
    squares = (np.random.default_rng(0).standard_normal((20000, freedom)) ** 2).sum(axis=1)
    assert np.mean(squares > bound) == pytest.approx(0.05, abs=0.006)


def test_robust_sigma_ignores_outliers() -> None:
    rng = np.random.default_rng(0)
    r = 0.7 * rng.standard_normal(20000)
    assert robust_sigma(r, 0.0) == pytest.approx(0.7, rel=0.03)
    r[:3000] = 1e6
    assert robust_sigma(r, 0.0) == pytest.approx(0.7, rel=0.3)
    assert robust_sigma(-r, 0.0) == robust_sigma(r, 0.0)


def test_sigma_of_median() -> None:
    density = quad(lambda x: np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi), -1 / SIGMA_OF_MEDIAN, 1 / SIGMA_OF_MEDIAN)[0]
    assert density == pytest.approx(0.5, abs=1e-12)


def test_robust_sigma_has_a_floor() -> None:
    assert robust_sigma(np.zeros(5), 0.15) == 0.15
    assert robust_sigma(np.empty(0), 0.15) == 0.15
