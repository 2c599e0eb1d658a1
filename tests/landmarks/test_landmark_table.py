"""Landmark table of one camera: an update is visible under the number everywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.geometry.arrays import IntArray
from sylpose.landmarks.landmark_filter import INITIAL_CAPACITY, Landmarks, LandmarkTable


def make_landmarks(values: list[float], numbers: list[int] | IntArray | None = None) -> Landmarks:
    """Return landmarks identified by their values; without numbers, new ones."""
    n = len(values)
    mean = np.array(values)[:, None] * np.ones(3)
    ids = np.full(n, -1) if numbers is None else np.asarray(numbers)
    information = np.array(values)[:, None, None] * np.eye(3)
    return Landmarks(mean, information, np.arange(n) + 1, np.array(values) > 0, mean[:, :2], ids.astype(np.int64))


def values_of(table: LandmarkTable, numbers: list[int] | IntArray) -> list[float]:
    return [float(x) for x in table.get(np.asarray(numbers, np.int64)).mean[:, 0]]


def test_numbers_are_assigned_once() -> None:
    table = LandmarkTable()
    assert table.update(make_landmarks([1.0, 2.0])).tolist() == [0, 1]
    assert table.update(make_landmarks([5.0, 3.0, 4.0], [1, -1, -1])).tolist() == [1, 2, 3]
    assert len(table) == 4
    assert values_of(table, [3, 0, 1, 1]) == [4.0, 1.0, 5.0, 5.0]
    known = table.get(np.array([1]))
    assert (known.n_observations[0], known.id[0], known.information[0, 2, 2]) == (1, 1, 5.0)


def test_returned_landmarks_are_copies() -> None:
    """Changing a returned copy does not change the table."""
    table = LandmarkTable()
    numbers = table.update(make_landmarks([1.0, 2.0]))
    table.get(numbers).mean[:] = 9.0
    stored = make_landmarks([7.0], [0])
    table.update(stored)
    stored.mean[:] = 9.0
    assert values_of(table, numbers) == [7.0, 2.0]


def test_last_of_equal_numbers_wins() -> None:
    table = LandmarkTable()
    table.update(make_landmarks([1.0]))
    table.update(make_landmarks([2.0, 3.0], [0, 0]))
    assert values_of(table, [0]) == [3.0]


def test_unused_landmarks_are_removed() -> None:
    table = LandmarkTable()
    table.update(make_landmarks([float(k) for k in range(10)]))
    table.prune(np.array([1, 2, 3, 4, 5]))  # not yet worthwhile
    assert len(table) == 10
    table.prune(np.array([7, 2, 7]))
    assert len(table) == 2
    assert values_of(table, [7, 2]) == [7.0, 2.0]
    with pytest.raises(AssertionError):
        table.get(np.array([5]))
    # Numbers are not reused.
    assert table.update(make_landmarks([11.0])).tolist() == [10]
    assert values_of(table, [10, 7]) == [11.0, 7.0]


def test_table_of_a_subset() -> None:
    table = LandmarkTable.from_landmarks(make_landmarks([3.0, 1.0, 3.0], [8, 2, 8]))
    assert values_of(table, [2, 8, 8]) == [1.0, 3.0, 3.0]
    assert len(LandmarkTable.from_landmarks(Landmarks.empty()).get(np.empty(0, np.int64))) == 0


@given(st.lists(st.tuples(st.lists(st.floats(-9, 9), max_size=8), st.booleans()), max_size=12), st.integers(0, 99))
def test_table_behaves_as_a_dictionary(steps: list[tuple[list[float], bool]], seed: int) -> None:
    """Any sequence of updates and removals."""
    rng, table, twin = np.random.default_rng(seed), LandmarkTable(), dict[int, float]()
    for values, forgets in steps:
        numbers = [int(rng.choice(list(twin))) if twin and rng.random() < 0.5 else -1 for _ in values]
        for number, value in zip(table.update(make_landmarks(values, numbers)).tolist(), values, strict=True):
            twin[number] = value
        if forgets and twin:
            kept = rng.permutation(list(twin))[: max(1, len(twin) // 3)].tolist()
            before = len(table)
            table.prune(np.array(kept))
            if len(table) < before:
                twin = {number: twin[number] for number in kept}
        assert values_of(table, list(twin)) == [float(v) for v in twin.values()]


def test_table_grows() -> None:
    table = LandmarkTable()
    for _ in range(3):
        table.update(make_landmarks([float(k) for k in range(INITIAL_CAPACITY)]))
    assert len(table) == 3 * INITIAL_CAPACITY
    assert values_of(table, [0, INITIAL_CAPACITY + 5, 3 * INITIAL_CAPACITY - 1]) == [0.0, 5.0, INITIAL_CAPACITY - 1.0]


def test_other_landmarks_move_with_their_neighbors() -> None:
    """Two clusters, half of which is moved, one landmark to a wrong position."""
    rng = np.random.default_rng(0)
    places = np.concatenate([rng.normal(0, 0.1, (20, 3)), rng.normal(5, 0.1, (20, 3))])
    landmarks = make_landmarks([1.0] * 40)
    landmarks.mean[:] = places
    table = LandmarkTable()
    numbers = table.update(landmarks)
    shift = np.where(np.arange(40)[:, None] < 20, [1.0, 0.0, 0.0], [0.0, 0.0, -2.0])
    chosen = np.concatenate([np.arange(10), np.arange(20, 30)])
    target = places + shift
    target[3] += 100.0
    table.move(numbers[chosen], target[chosen])
    found = table.get(numbers).mean
    np.testing.assert_allclose(found[chosen], target[chosen])
    rest = np.setdiff1d(np.arange(40), chosen)
    np.testing.assert_allclose(found[rest], (places + shift)[rest], atol=1e-12)
    # With few landmarks the motion of the others is unknown.
    table.move(numbers[:3], np.zeros((3, 3)))
    np.testing.assert_allclose(table.get(numbers).mean[3:], found[3:])
