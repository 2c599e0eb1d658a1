"""One table per camera: what a sight teaches is known wherever the number is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.geometry.arrays import IntArray
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.landmarks.landmark_table import ROOM, LandmarkTable


def some(values: list[float], numbers: list[int] | IntArray | None = None) -> Landmarks:
    """Landmarks that are told by their values; without numbers, new ones."""
    n = len(values)
    mean = np.array(values)[:, None] * np.ones(3)
    ids = np.full(n, -1) if numbers is None else np.asarray(numbers)
    information = np.array(values)[:, None, None] * np.eye(3)
    return Landmarks(mean, information, np.arange(n) + 1, np.array(values) > 0, mean[:, :2], ids.astype(np.int64))


def values_of(table: LandmarkTable, numbers: list[int] | IntArray) -> list[float]:
    return [float(x) for x in table.of(np.asarray(numbers, np.int64)).mean[:, 0]]


def test_new_ones_get_numbers_and_known_ones_keep_theirs() -> None:
    table = LandmarkTable()
    assert table.learn(some([1.0, 2.0])).tolist() == [0, 1]
    assert table.learn(some([5.0, 3.0, 4.0], [1, -1, -1])).tolist() == [1, 2, 3]
    assert len(table) == 4
    assert values_of(table, [3, 0, 1, 1]) == [4.0, 1.0, 5.0, 5.0]
    known = table.of(np.array([1]))
    assert (known.seen[0], known.id[0], known.information[0, 2, 2]) == (1, 1, 5.0)


def test_what_was_taken_out_is_not_what_is_in_there() -> None:
    """No frame can change what the others know but by teaching it."""
    table = LandmarkTable()
    numbers = table.learn(some([1.0, 2.0]))
    table.of(numbers).mean[:] = 9.0
    given_in = some([7.0], [0])
    table.learn(given_in)
    given_in.mean[:] = 9.0
    assert values_of(table, numbers) == [7.0, 2.0]


def test_of_several_with_one_number_the_last_counts() -> None:
    table = LandmarkTable()
    table.learn(some([1.0]))
    table.learn(some([2.0, 3.0], [0, 0]))
    assert values_of(table, [0]) == [3.0]


def test_what_no_frame_names_is_forgotten_in_time() -> None:
    table = LandmarkTable()
    table.learn(some([float(k) for k in range(10)]))
    table.keep(np.array([1, 2, 3, 4, 5]))  # not worth it yet
    assert len(table) == 10
    table.keep(np.array([7, 2, 7]))
    assert len(table) == 2
    assert values_of(table, [7, 2]) == [7.0, 2.0]
    with pytest.raises(AssertionError):
        table.of(np.array([5]))
    # Numbers are not given again.
    assert table.learn(some([11.0])).tolist() == [10]
    assert values_of(table, [10, 7]) == [11.0, 7.0]


def test_a_part_of_a_table() -> None:
    table = LandmarkTable.holding(some([3.0, 1.0, 3.0], [8, 2, 8]))
    assert values_of(table, [2, 8, 8]) == [1.0, 3.0, 3.0]
    assert len(LandmarkTable.holding(Landmarks.none()).of(np.empty(0, np.int64))) == 0


@given(st.lists(st.tuples(st.lists(st.floats(-9, 9), max_size=8), st.booleans()), max_size=12), st.integers(0, 99))
def test_it_is_a_dictionary(steps: list[tuple[list[float], bool]], seed: int) -> None:
    """Whatever is learnt and forgotten, in whatever order."""
    rng, table, twin = np.random.default_rng(seed), LandmarkTable(), dict[int, float]()
    for values, forgets in steps:
        numbers = [int(rng.choice(list(twin))) if twin and rng.random() < 0.5 else -1 for _ in values]
        for number, value in zip(table.learn(some(values, numbers)).tolist(), values, strict=True):
            twin[number] = value
        if forgets and twin:
            kept = rng.permutation(list(twin))[: max(1, len(twin) // 3)].tolist()
            before = len(table)
            table.keep(np.array(kept))
            if len(table) < before:
                twin = {number: twin[number] for number in kept}
        assert values_of(table, list(twin)) == [float(v) for v in twin.values()]


def test_it_grows_beyond_its_room() -> None:
    table = LandmarkTable()
    for _ in range(3):
        table.learn(some([float(k) for k in range(ROOM)]))
    assert len(table) == 3 * ROOM
    assert values_of(table, [0, ROOM + 5, 3 * ROOM - 1]) == [0.0, 5.0, ROOM - 1.0]


def test_what_is_not_placed_goes_along_with_what_is_around_it() -> None:
    """Two clusters of which a half is placed, one of them by mistake for one of them."""
    rng = np.random.default_rng(0)
    places = np.concatenate([rng.normal(0, 0.1, (20, 3)), rng.normal(5, 0.1, (20, 3))])
    landmarks = some([1.0] * 40)
    landmarks.mean[:] = places
    table = LandmarkTable()
    numbers = table.learn(landmarks)
    shift = np.where(np.arange(40)[:, None] < 20, [1.0, 0.0, 0.0], [0.0, 0.0, -2.0])
    chosen = np.concatenate([np.arange(10), np.arange(20, 30)])
    target = places + shift
    target[3] += 100.0
    table.place(numbers[chosen], target[chosen])
    found = table.of(numbers).mean
    np.testing.assert_allclose(found[chosen], target[chosen])
    rest = np.setdiff1d(np.arange(40), chosen)
    np.testing.assert_allclose(found[rest], (places + shift)[rest], atol=1e-12)
    # Of a few nobody knows how the rest moved.
    table.place(numbers[:3], np.zeros((3, 3)))
    np.testing.assert_allclose(table.of(numbers).mean[3:], found[3:])
