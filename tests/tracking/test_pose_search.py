"""Noise estimate of inliers: robust against a few low-contrast features with large residuals."""

from __future__ import annotations

import numpy as np
import pytest

from sylpose.tracking.camera_side.frame import estimate_noise


def test_noise_of_gaussian_residuals() -> None:
    off = np.random.default_rng(0).normal(0.0, 0.7, 20_000)
    assert estimate_noise(off) == pytest.approx(0.7, rel=0.02)


def test_noise_is_at_most_rms() -> None:
    """Residuals spread evenly around a wrong pose keep their rms."""
    off = np.random.default_rng(1).uniform(-3.0, 3.0, 20_000)
    assert estimate_noise(off) == pytest.approx(3.0 / np.sqrt(3.0), rel=0.02)


def test_few_outliers_hardly_count() -> None:
    rng = np.random.default_rng(2)
    off = np.concatenate([rng.normal(0.0, 0.5, 800), rng.uniform(-4.0, 4.0, 200)])
    assert estimate_noise(off) < 0.75 < np.sqrt(np.mean(off**2))
    assert estimate_noise(-off) == estimate_noise(off)


def test_noise_without_residuals_is_nan() -> None:
    assert np.isnan(estimate_noise(np.empty(0)))
    assert estimate_noise(np.array([-2.0])) == 2.0
