"""What cannot be seen: against variances one direction at a time, in any unit, of stacks, and which of it is a turn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.observability import about_a_turn, unseen_directions
from tests.scenes import random_rotations

seeds = st.integers(0, 10**6)
quick = settings(max_examples=30, deadline=None)


def random_information(rng: np.random.Generator, n: int) -> FloatArray:
    """Standard deviations from 0.03 to 30, along any axes."""
    axes = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return np.asarray((axes * 10 ** rng.uniform(-3, 3, n)) @ axes.T)


@given(seeds, st.integers(1, 6))
@quick
def test_what_is_unseen_is_beyond_the_limit_and_all_else_is_not(seed: int, n: int) -> None:
    """The information along a unit direction is 1 over the variance that is left when all else is known."""
    rng = np.random.default_rng(seed)
    information, limit = random_information(rng, n), 10 ** rng.uniform(-1, 1)
    unseen = unseen_directions(information, limit)
    np.testing.assert_allclose(unseen @ unseen.T, np.eye(len(unseen)), atol=1e-12)
    for v in rng.normal(size=(20, n)):
        u = unseen.T @ (unseen @ v)
        s = v - u
        assert u @ information @ u <= u @ u / limit**2 + 1e-9 * (v @ v)
        assert s @ information @ s >= s @ s / limit**2 - 1e-9 * (v @ v)


@given(seeds)
@quick
def test_the_unit_of_length_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    information, limits = random_information(rng, 6), 10 ** rng.uniform(-1, 1, 6)
    unit = np.array([1.0] * 3 + [1000.0] * 3)
    in_metres = unseen_directions(information, limits)
    in_millimetres = unseen_directions(information / np.outer(unit, unit), limits * unit)
    assert in_metres.shape == in_millimetres.shape
    np.testing.assert_allclose(in_metres.T @ in_metres, in_millimetres.T @ in_millimetres, atol=1e-6)


def test_nothing_known_is_nothing_seen_and_a_limit_of_nothing_is_never_met() -> None:
    np.testing.assert_array_equal(np.abs(unseen_directions(np.zeros((3, 3)), 0.25)), np.eye(3))
    assert unseen_directions(1e12 * np.eye(6), np.zeros(6)).shape == (6, 6)
    assert unseen_directions(1e12 * np.eye(6), 0.1).shape == (0, 6)


def test_what_is_flat_to_rounding_is_not_seen_however_much_there_is_of_it() -> None:
    information = np.diag([1e3, 1e12, 2e12])
    assert unseen_directions(information, 0.25).shape == (0, 3)
    np.testing.assert_allclose(np.abs(unseen_directions(information, 0.25, flat=1e-6)), [[1, 0, 0]])


def test_mirrored_solutions_have_each_their_own_directions() -> None:
    turn = random_rotations(np.random.default_rng(0), 1)[0]
    information = np.diag([1.0, 100.0, 400.0])
    both = unseen_directions(np.array([information, turn @ information @ turn.T]), 0.25)
    assert both.shape == (2, 1, 3)
    np.testing.assert_allclose(np.abs(both[0, 0]), [1, 0, 0], atol=1e-12)
    assert abs(both[1, 0] @ turn[:, 0]) == pytest.approx(1)


def test_a_turn_is_found_in_any_mixture_of_the_unseen() -> None:
    mixed = np.array([[0.8, 0, 0, 0.6, 0, 0]])
    assert about_a_turn(mixed)
    assert not about_a_turn(mixed[:, [3, 4, 5, 0, 1, 2]])
    two = np.array([[0.6, 0, 0, 0.8, 0, 0], [0.8, 0, 0, -0.6, 0, 0]])  # together they hold all turns about x
    assert about_a_turn(two)
    assert not about_a_turn(np.empty((0, 6)))
