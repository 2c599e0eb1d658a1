"""How well what agrees with a pose does: what a few faint features are off by does not count."""

from __future__ import annotations

import numpy as np
import pytest

from sylpose.tracking.pose_search import noise_of


def test_noise_is_that_of_gaussian_residuals() -> None:
    off = np.random.default_rng(0).normal(0.0, 0.7, 20_000)
    assert noise_of(off) == pytest.approx(0.7, rel=0.02)


def test_noise_is_never_more_than_the_root_of_the_mean_square() -> None:
    """What lies anywhere near a wrong pose is no better than that says."""
    off = np.random.default_rng(1).uniform(-3.0, 3.0, 20_000)
    assert noise_of(off) == pytest.approx(3.0 / np.sqrt(3.0), rel=0.02)


def test_a_few_that_are_far_off_hardly_count() -> None:
    rng = np.random.default_rng(2)
    off = np.concatenate([rng.normal(0.0, 0.5, 800), rng.uniform(-4.0, 4.0, 200)])
    assert noise_of(off) < 0.75 < np.sqrt(np.mean(off**2))
    assert noise_of(-off) == noise_of(off)


def test_nothing_has_no_noise() -> None:
    assert np.isnan(noise_of(np.empty(0)))
    assert noise_of(np.array([-2.0])) == 2.0
