"""RANSAC on the affine epipolar constraint."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.relative_pose.affine_ransac import find_inliers
from sylpose.simulate import random_motion, simulate_matches
from tests.scenes import BODY, make_zigzag_rig

SEEDS = st.integers(0, 2**32 - 1)


def select_inliers(x: FloatArray, y: FloatArray, threshold: float, rng: np.random.Generator) -> BoolArray:
    """Return the kernel's weights as a mask."""
    weights = np.zeros(len(x))
    find_inliers(np.ascontiguousarray(x), np.ascontiguousarray(y), threshold, rng.random((300, 4)), weights)
    return weights > 0


def make_matches(seed: int, n: int = 60, outliers: float = 0.4) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return weak-perspective matches (n, 2), (n, 2), pixels, whose first share are outliers, and the inlier mask."""
    rng = np.random.default_rng(seed)
    # y = A x + depth b + c: any rigid motion under weak perspective.
    a, b, c = np.eye(2) + 0.1 * rng.standard_normal((2, 2)), 5 * rng.standard_normal(2), 10 * rng.standard_normal(2)
    x = rng.uniform(-80, 80, (n, 2))
    y = x @ a.T + rng.uniform(-8, 8, (n, 1)) * b + c
    right = np.arange(n) >= outliers * n
    normal = np.array([b[1], -b[0]]) / np.linalg.norm(b)  # across the epipolar lines
    wrong = ~right
    y[wrong] += (rng.choice([-1, 1], wrong.sum()) * rng.uniform(20, 60, wrong.sum()))[:, None] * normal
    return x, y, right


@pytest.mark.parametrize("n", [20, 60, 300])
@pytest.mark.parametrize("outliers", [0.0, 0.2, 0.4])
def test_ransac_finds_the_inliers(n: int, outliers: float) -> None:
    for seed in range(10):
        x, y, right = make_matches(seed, n, outliers)
        found = select_inliers(x, y, 0.1, np.random.default_rng(seed))
        np.testing.assert_array_equal(found, right)


def test_ransac_tolerates_noise() -> None:
    for seed in range(10):
        x, y, right = make_matches(seed)
        rng = np.random.default_rng(seed)
        x, y = x + 0.5 * rng.standard_normal(x.shape), y + 0.5 * rng.standard_normal(y.shape)
        found = select_inliers(x, y, 2.0, rng)
        assert found[right].mean() > 0.9
        assert found[~right].mean() < 0.1


def test_ransac_tolerates_perspective() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        rig = make_zigzag_rig(1)
        pair = simulate_matches(rig, BODY, random_motion(8, 0.02, rng), rng=rng, outliers=0.4)
        m, wrong = pair.matches[0], pair.is_outlier[0]
        found = select_inliers(m.x, m.y, 3.0 / rig.cameras[0].focal, rng)
        assert found[~wrong].mean() > 0.8
        assert found[wrong].mean() < 0.5  # about a quarter of them lie near their epipolar lines by chance


def test_ransac_is_deterministic() -> None:
    x, y, _ = make_matches(0)
    rng = np.random.default_rng(0)
    x, y = x + rng.standard_normal(x.shape), y + rng.standard_normal(y.shape)
    first, again = (select_inliers(x, y, 1.0, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first, again)


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.floats(1e-4, 1e4))
def test_ransac_is_invariant_to_scale_and_offset(seed: int, scale: float) -> None:
    x, y, right = make_matches(seed)
    found = select_inliers(scale * (x + 3), scale * (y - 7), scale * 0.1, np.random.default_rng(0))
    np.testing.assert_array_equal(found, right)


@pytest.mark.parametrize("n", range(6))
def test_fewer_than_six_matches_are_kept(n: int) -> None:
    x, y = np.random.default_rng(n).standard_normal((2, n, 2))
    found = select_inliers(x, y, 1e-6, np.random.default_rng(0))
    assert found.shape == (n,)
    assert found.all()


def test_duplicate_matches_are_handled() -> None:
    x, y, right = make_matches(0, 30)
    found = select_inliers(np.repeat(x, 3, 0), np.repeat(y, 3, 0), 0.1, np.random.default_rng(0))
    np.testing.assert_array_equal(found, np.repeat(right, 3))
    # A single repeated match: every quadruple is degenerate, and nothing is contradictory.
    one = np.ones((50, 2))
    assert select_inliers(one, 2 * one, 0.1, np.random.default_rng(0)).all()


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(0, 40), st.integers(0, 2))
def test_degenerate_points_give_a_mask(seed: int, n: int, rank: int) -> None:
    """Points on a line, in one place, or spread: a mask is returned without a warning."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, rank)) @ rng.standard_normal((rank, 2))
    found = select_inliers(x, 2 * x + 1, 0.01, rng)
    assert found.shape == (n,)
    assert found.all()
