"""Pair moments against their definition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments

Arrays = tuple[FloatArray, FloatArray, FloatArray]


def matches(seed: int, n: int) -> Arrays:
    """x (n, 2), y (n, 2), weights (n,)."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, 2)), rng.normal(size=(n, 2)), rng.uniform(0, 2, n)


def homogeneous(points: FloatArray) -> FloatArray:
    return np.column_stack([points, np.ones(len(points))])


def naive(x: FloatArray, y: FloatArray, w: FloatArray) -> FloatArray:
    """Compute the definition, index by index."""
    m = np.zeros((9, 9))
    for xi, yi, wi in zip(homogeneous(x), homogeneous(y), w, strict=True):
        for a, b, c, d in np.ndindex(3, 3, 3, 3):
            m[3 * a + b, 3 * c + d] += wi * yi[a] * xi[b] * yi[c] * xi[d]
    return m


seeds = st.integers(0, 2**32 - 1)
counts = st.integers(0, 12)


@settings(max_examples=25, deadline=None)
@given(seed=seeds, n=counts)
def test_definition(seed: int, n: int) -> None:
    x, y, w = matches(seed, n)
    np.testing.assert_allclose(PairMoments.from_matches(x, y, w).matrix, naive(x, y, w), atol=1e-12, rtol=1e-12)
    ones = PairMoments.from_matches(x, y)
    np.testing.assert_allclose(ones.matrix, naive(x, y, np.ones(n)), atol=1e-12, rtol=1e-12)
    assert ones.count == n


@settings(max_examples=25, deadline=None)
@given(seed=seeds, n=counts)
def test_epipolar_cost(seed: int, n: int) -> None:
    x, y, w = matches(seed, n)
    e = np.random.default_rng(seed).normal(size=(3, 3))
    cost = sum(wi * (yi @ e @ xi) ** 2 for xi, yi, wi in zip(homogeneous(x), homogeneous(y), w, strict=True))
    m = PairMoments.from_matches(x, y, w).matrix
    assert e.ravel() @ m @ e.ravel() == pytest.approx(cost, rel=1e-9, abs=1e-12)


@settings(max_examples=25, deadline=None)
@given(seed=seeds, n=counts, split=counts)
def test_sum_is_union(seed: int, n: int, split: int) -> None:
    x, y, w = matches(seed, n)
    k = min(split, n)
    parts = PairMoments.from_matches(x[:k], y[:k], w[:k]) + PairMoments.from_matches(x[k:], y[k:], w[k:])
    np.testing.assert_allclose(parts.matrix, PairMoments.from_matches(x, y, w).matrix, atol=1e-12, rtol=1e-12)


def test_scaled_moments_equal_moments_of_scaled_weights() -> None:
    x, y = np.random.default_rng(0).standard_normal((2, 20, 2))
    expected = PairMoments.from_matches(x, y, np.full(20, 0.3))
    np.testing.assert_allclose(PairMoments.from_matches(x, y).scale_weights(0.3).matrix, expected.matrix, rtol=1e-13)


def test_zero_is_neutral() -> None:
    m = PairMoments.from_matches(*matches(0, 7))
    np.testing.assert_array_equal((m + PairMoments.zero()).matrix, m.matrix)
    assert PairMoments.zero().count == 0
    assert np.isnan(PairMoments.zero().mean_x).all()
    np.testing.assert_array_equal(PairMoments.zero().s_xx, 0)


@settings(max_examples=25, deadline=None)
@given(seed=seeds, n=counts)
def test_bytes_round_trip(seed: int, n: int) -> None:
    m = PairMoments.from_matches(*matches(seed, n))
    data = m.to_bytes()
    assert len(data) == 360
    back = PairMoments.from_bytes(data)
    np.testing.assert_array_equal(back.matrix[np.triu_indices(9)], m.matrix[np.triu_indices(9)])
    np.testing.assert_array_equal(back.matrix, back.matrix.T)
    assert back.to_bytes() == data


@settings(max_examples=25, deadline=None)
@given(seed=seeds, n=st.integers(2, 12))
def test_means_and_second_moments(seed: int, n: int) -> None:
    x, y, w = matches(seed, n)
    m = PairMoments.from_matches(x, y, w)
    mean_x, mean_y = np.average(x, axis=0, weights=w), np.average(y, axis=0, weights=w)
    assert m.count == pytest.approx(w.sum())
    for got, expected in [
        (m.mean_x, mean_x),
        (m.mean_y, mean_y),
        (m.s_xx, (w[:, None] * (x - mean_x)).T @ (x - mean_x)),
        (m.s_yx, (w[:, None] * (y - mean_y)).T @ (x - mean_x)),
        (m.s_yy, (w[:, None] * (y - mean_y)).T @ (y - mean_y)),
    ]:
        np.testing.assert_allclose(got, expected, atol=1e-9)


def test_second_moments_match_numpy() -> None:
    x, y, _ = matches(3, 40)
    m = PairMoments.from_matches(x, y)
    cov = np.cov(np.column_stack([x, y]).T, bias=True) * 40
    np.testing.assert_allclose(m.s_xx, cov[:2, :2], atol=1e-9)
    np.testing.assert_allclose(m.s_yx, cov[2:, :2], atol=1e-9)
    np.testing.assert_allclose(m.s_yy, cov[2:, 2:], atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(seed=seeds, n=counts)
def test_transform_equals_moments_of_transformed_rays(seed: int, n: int) -> None:
    x, y, w = matches(seed, n)
    a = np.random.default_rng(seed).normal(size=(3, 3))
    direct = PairMoments.from_matches(homogeneous(x) @ a.T, homogeneous(y) @ a.T, w)
    got = PairMoments.from_matches(x, y, w).transform(a).matrix
    np.testing.assert_allclose(got, direct.matrix, atol=1e-10 * (1 + np.abs(direct.matrix).max()))


def test_bad_matches() -> None:
    x, y, w = matches(0, 4)
    with pytest.raises(ValueError, match="x has 4 points and y has 3"):
        PairMoments.from_matches(x, y[:3])
    with pytest.raises(ValueError, match=r"y must be \(n, 2\) or \(n, 3\)"):
        PairMoments.from_matches(x, y.ravel())
    with pytest.raises(ValueError, match="x has values that are not finite"):
        PairMoments.from_matches(x * np.nan, y)
    for bad in (w[:3], -w, w * np.inf):
        with pytest.raises(ValueError, match=r"weights (must be|has values that are not finite)"):
            PairMoments.from_matches(x, y, bad)


def test_bad_matrix() -> None:
    with pytest.raises(ValueError, match=r"must be \(9, 9\)"):
        PairMoments(np.eye(8))
    with pytest.raises(ValueError, match="finite"):
        PairMoments(np.full((9, 9), np.nan))
    with pytest.raises(ValueError, match="symmetric"):
        PairMoments(np.triu(np.ones((9, 9))))


def test_bad_bytes() -> None:
    with pytest.raises(ValueError, match="360 bytes, got 359"):
        PairMoments.from_bytes(bytes(359))
    with pytest.raises(ValueError, match="finite"):
        PairMoments.from_bytes(np.full(45, np.inf).astype("<f8").tobytes())
