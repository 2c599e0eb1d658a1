"""Windows in which a lost object is searched for: the one that has changed most, and the one searched longest ago."""

from __future__ import annotations

import numpy as np
import pytest

from sylpose.features.search_windows import SearchWindows


@pytest.mark.parametrize(("shape", "side"), [((480, 640), 200.0), ((360, 480, 3), 77.3), ((101, 333), 1e12)])
def test_windows_cover_image_and_overlap(shape: tuple[int, ...], side: float) -> None:
    windows = SearchWindows.create(side, np.zeros(shape, np.uint8))
    whole, *parts = windows.bounds.tolist()
    assert whole == [0, 0, shape[1], shape[0]]
    covered = np.zeros(shape[:2], int)
    for left, top, right, bottom in parts:
        covered[top:bottom, left:right] += 1
        assert max(right - left, bottom - top) <= side + 2
    assert covered.min() >= 1
    # A square of half of a window's side is inside one of them, wherever it is.
    half = min(side, *shape[:2]) / 2
    for x, y in np.random.default_rng(0).uniform(0, [shape[1] - half, shape[0] - half], (100, 2)):
        assert any(a <= x + 1 and b <= y + 1 and x + half <= c + 1 and y + half <= d + 1 for a, b, c, d in parts)


def test_window_that_has_changed_most_is_selected() -> None:
    empty = np.full((480, 640), 90, np.uint8)
    windows = SearchWindows.create(160.0, empty)
    image = empty.copy()
    left, top, right, bottom = windows.bounds[-1]
    image[top + 16 : bottom, left + 16 : right] = 200
    changed, mask = windows.select(image, oldest=False)
    assert mask[top:bottom, left:right].all()
    # It was searched: another change counts now, however small.
    image[40:90, 30:80] += 20
    _, other = changed.select(image, oldest=False)
    assert other[40:90, 30:80].all()
    # The input is unchanged.
    _, again = windows.select(image, oldest=False)
    np.testing.assert_array_equal(again, mask)


def test_all_windows_are_searched_in_turn() -> None:
    image = np.full((240, 320, 3), 90, np.uint8)
    windows = SearchWindows.create(100.0, image)
    count, seen = len(windows.bounds), set()
    for k in range(2 * count):
        windows, mask = windows.select(image, oldest=k % 2 == 0)
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        seen.add((columns[0], rows[0], columns[-1] + 1, rows[-1] + 1))
    assert len(seen) == count
