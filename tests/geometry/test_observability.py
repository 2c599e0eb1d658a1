"""Unobservable directions: against marginal variances, in any unit, for stacks, and rotations among them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import find_unobservable_directions, has_rotation_direction
from tests.scenes import draw_rotations

seeds = st.integers(0, 10**6)
quick = settings(max_examples=30, deadline=None)


def random_information(rng: np.random.Generator, n: int) -> FloatArray:
    """Return information with standard deviations from 0.03 to 30, along any axes."""
    axes = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return np.asarray((axes * 10 ** rng.uniform(-3, 3, n)) @ axes.T)


@given(seeds, st.integers(1, 6))
@quick
def test_only_directions_beyond_the_limit_are_unobservable(seed: int, n: int) -> None:
    """The information along a unit direction is 1 over the conditional variance given all others."""
    rng = np.random.default_rng(seed)
    information, limit = random_information(rng, n), 10 ** rng.uniform(-1, 1)
    unseen = find_unobservable_directions(information, limit)
    np.testing.assert_allclose(unseen @ unseen.T, np.eye(len(unseen)), atol=1e-12)
    for v in rng.normal(size=(20, n)):
        u = unseen.T @ (unseen @ v)
        s = v - u
        assert u @ information @ u <= u @ u / limit**2 + 1e-9 * (v @ v)
        assert s @ information @ s >= s @ s / limit**2 - 1e-9 * (v @ v)


@given(seeds)
@quick
def test_unit_of_length_is_irrelevant(seed: int) -> None:
    rng = np.random.default_rng(seed)
    information, limits = random_information(rng, 6), 10 ** rng.uniform(-1, 1, 6)
    unit = np.array([1.0] * 3 + [1000.0] * 3)
    in_metres = find_unobservable_directions(information, limits)
    in_millimetres = find_unobservable_directions(information / np.outer(unit, unit), limits * unit)
    assert in_metres.shape == in_millimetres.shape
    np.testing.assert_allclose(in_metres.T @ in_metres, in_millimetres.T @ in_millimetres, atol=1e-6)


def test_zero_information_and_zero_limits() -> None:
    np.testing.assert_array_equal(np.abs(find_unobservable_directions(np.zeros((3, 3)), 0.25)), np.eye(3))
    assert find_unobservable_directions(1e12 * np.eye(6), np.zeros(6)).shape == (6, 6)
    assert find_unobservable_directions(1e12 * np.eye(6), 0.1).shape == (0, 6)


def test_relative_rounding_is_unobservable() -> None:
    information = np.diag([1e3, 1e12, 2e12])
    assert find_unobservable_directions(information, 0.25).shape == (0, 3)
    np.testing.assert_allclose(np.abs(find_unobservable_directions(information, 0.25, min_ratio=1e-6)), [[1, 0, 0]])


def test_mirrored_solutions_have_individual_directions() -> None:
    turn = draw_rotations(np.random.default_rng(0), 1)[0]
    information = np.diag([1.0, 100.0, 400.0])
    both = find_unobservable_directions(np.array([information, turn @ information @ turn.T]), 0.25)
    assert both.shape == (2, 1, 3)
    np.testing.assert_allclose(np.abs(both[0, 0]), [1, 0, 0], atol=1e-12)
    assert abs(both[1, 0] @ turn[:, 0]) == pytest.approx(1)


def test_rotation_is_detected_in_any_mixture() -> None:
    mixed = np.array([[0.8, 0, 0, 0.6, 0, 0]])
    assert has_rotation_direction(mixed)
    assert not has_rotation_direction(mixed[:, [3, 4, 5, 0, 1, 2]])
    two = np.array([[0.6, 0, 0, 0.8, 0, 0], [0.8, 0, 0, -0.6, 0, 0]])  # together they span all rotations about x
    assert has_rotation_direction(two)
    assert not has_rotation_direction(np.empty((0, 6)))
