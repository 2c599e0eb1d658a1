"""Time derivatives of poses: of paths with known derivatives, uniformly sampled or not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sylpose.bundle_adjustment.problem as problem_module
from sylpose.bundle_adjustment.bundle import BundleOptions, bundle_adjust
from sylpose.bundle_adjustment.problem import (
    compute_velocity_variance,
    differentiate_quadratic,
    differentiate_quartic,
)
from sylpose.geometry.arrays import FloatArray
from tests.bundle_adjustment.test_bundle import RADIUS, RIG, disturb_poses, path, tracks

AXIS = np.array([0.6, 0.0, 0.8])


def uneven(n: int, seed: int = 0) -> FloatArray:
    """Return (n,) increasing times, two of which are missing in the middle."""
    times = np.arange(n + 2) + np.random.default_rng(seed).uniform(-0.2, 0.2, n + 2)
    return np.asarray(np.delete(times, [n // 2, n // 2 + 1]) / 30.0)


def about(angle: FloatArray) -> FloatArray:
    """Return (n, 3, 3) rotations by angles about an axis."""
    return np.asarray(Rotation.from_rotvec(angle[:, None] * AXIS).as_matrix())


@pytest.mark.parametrize("times", [np.arange(20) / 30.0, uneven(20)])
def test_polynomials_of_the_fourth_degree_are_exact(times: FloatArray) -> None:
    rng = np.random.default_rng(1)
    ways = [np.polynomial.Polynomial(rng.normal(size=5)) for _ in range(3)]
    turn = np.polynomial.Polynomial(rng.normal(size=5))
    places = np.column_stack([way(times) for way in ways])
    found = differentiate_quartic(about(turn(times)), places, times)[2:-2]
    for k in (0, 1):
        expected = np.column_stack([np.outer(turn.deriv(k + 1)(times), AXIS), *(w.deriv(k + 1)(times) for w in ways)])
        np.testing.assert_allclose(found[:, k], expected[2:-2], atol=1e-7)


def test_parabolas_underestimate_oscillations() -> None:
    # 20 frames a period, at the center of the oscillation, where the speed is largest.
    rate, frequency = 30.0, 2 * np.pi / 20.0
    k = np.arange(41.0)
    places = np.outer(np.sin(frequency * (k - 20.0)), [1.0, -2.0, 0.5])
    turns, times, true = about(0.1 * places[:, 0]), k / rate, frequency * rate
    slower, exact = (
        differentiate_quadratic(turns, places, times)[20, 0],
        differentiate_quartic(turns, places, times)[20, 0],
    )
    np.testing.assert_allclose(slower, (1.0 - frequency**2 / 6.0) * exact, rtol=2e-3)
    assert exact[3] == pytest.approx(true, rel=5e-4)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4])
def test_few_frames_use_parabolas(n: int) -> None:
    times = np.arange(n) / 30.0
    given = about(times), np.outer(times, [1.0, 2.0, 3.0]), times
    np.testing.assert_array_equal(differentiate_quartic(*given), differentiate_quadratic(*given))
    if n > 1:
        np.testing.assert_allclose(differentiate_quadratic(*given)[:, 0, 3:], np.tile([1.0, 2.0, 3.0], (n, 1)))


def test_velocity_variance() -> None:
    # The speeds are linear in the positions: the variance is the sum of the squared coefficients.
    times = np.arange(12) / 30.0
    alone = np.eye(12)[:, :, None] * np.ones(3)
    slopes = np.array([differentiate_quartic(about(np.zeros(12)), places, times)[:, 0, 3] for places in alone])
    np.testing.assert_allclose(compute_velocity_variance(times), (slopes**2).sum(axis=0), rtol=1e-9)


def test_time_offsets_are_not_overestimated(monkeypatch: pytest.MonkeyPatch) -> None:
    # An offset of half a frame, for oscillations with periods of 13 to 31 frames.
    late, rate = np.array([0.5, -0.4, 0.3, -0.4]) / 30.0, 30.0
    times = np.arange(60) / rate
    seen = tracks([path(1.25 * (times + s) * rate) for s in late], 40, 0.1, 0)
    start = disturb_poses(path(1.25 * times * rate))

    def scale() -> float:
        found = bundle_adjust(RIG, seen, start, RADIUS, BundleOptions(times=times, offsets_sd=0.02))
        return float(found.offsets @ late / (late @ late))

    assert scale() == pytest.approx(1.0, abs=0.004)
    monkeypatch.setattr(problem_module, "differentiate_quartic", differentiate_quadratic)
    assert 1.006 < scale() < 1.03
