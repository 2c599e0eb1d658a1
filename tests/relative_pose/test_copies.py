"""Copies of matches count once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.relative_pose.motion import find_first_copies

TOLERANCE = 1.5e-3


@given(st.integers(0, 10**6), st.integers(0, 60), st.integers(1, 6))
@settings(max_examples=60, deadline=None)
def test_equal_matches_map_to_the_first(seed: int, n: int, values: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (values, 4))
    rows = points[rng.integers(0, values, n)]
    first: dict[tuple[float, ...], int] = {}
    for i, row in enumerate(map(tuple, rows.tolist())):
        first.setdefault(row, i)
    found = find_first_copies(rows[:, :2].copy(), rows[:, 2:].copy(), TOLERANCE)
    assert found.tolist() == [first[row] for row in map(tuple, rows.tolist())]


@pytest.mark.parametrize(("n", "width"), [(80, 0.2), (1000, 0.2), (4000, 0.1)])
def test_independent_matches_are_no_copies(n: int, width: float) -> None:
    """However dense they are."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x = rng.uniform(-width / 2, width / 2, (n, 2))
        y = 1.05 * x + 0.01 + 0.3e-3 * rng.standard_normal((n, 2))
        assert (find_first_copies(x, y, TOLERANCE) == np.arange(n)).all()


@pytest.mark.parametrize("n", [50, 100, 200, 400])
@pytest.mark.parametrize("shape", ["line", "circle", "box"])
def test_independent_matches_on_contours_are_no_copies(n: int, shape: str) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        t = rng.uniform(0.0, 1.0, n)
        if shape == "line":
            x = np.column_stack([0.4 * t, 0.1 * t])
        elif shape == "circle":
            x = 0.07 * np.column_stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)])
        else:  # edges
            steps = rng.integers(0, 4, n) / 20.0
            x = np.where(rng.random((n, 1)) < 0.5, np.column_stack([0.2 * t, steps]), np.column_stack([steps, 0.2 * t]))
        x += 0.3e-3 * rng.standard_normal((n, 2))
        y = 1.05 * x + 0.01 + 0.3e-3 * rng.standard_normal((n, 2))
        assert (find_first_copies(x, y, TOLERANCE) == np.arange(n)).all()


@pytest.mark.parametrize(("n", "times"), [(40, 2), (40, 5), (1000, 2)])
def test_near_copies_are_found(n: int, times: int) -> None:
    rng = np.random.default_rng(n + times)
    x = rng.uniform(-0.1, 0.1, (n, 2))
    y = 1.05 * x + 0.01 + 0.3e-3 * rng.standard_normal((n, 2))
    a, b = (np.tile(points, (times, 1)) + 0.15e-3 * rng.standard_normal((times * n, 2)) for points in (x, y))
    found = find_first_copies(a, b, TOLERANCE)
    own = np.arange(times * n) % n
    assert np.mean(found == own) > 0.9  # some have other neighbors
    assert (found[found] == found).all()
    # The order does not matter, nor which image is the first.
    order = rng.permutation(times * n)
    variants = ((a, b), (b, a), (a[order], b[order]))
    counts = [len(np.unique(find_first_copies(*variant, TOLERANCE))) for variant in variants]
    assert np.ptp(counts) <= 0.05 * n
