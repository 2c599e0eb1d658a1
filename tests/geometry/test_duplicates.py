"""Rows that are given several times: as a table of the standard library finds them, for any numbers."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.geometry.duplicates import distinct


@given(st.integers(0, 10**6), st.integers(0, 60), st.integers(1, 4))
@settings(max_examples=60, deadline=None)
def test_each_row_is_where_it_was_first(seed: int, n: int, values: int) -> None:
    """Few values, or whole numbers, of which many rows are made, share most of their bits."""
    rng = np.random.default_rng(seed)
    of = np.concatenate([rng.integers(0, 3, values), rng.standard_normal(values)])
    a, b = rng.choice(of, (n, 2)), rng.choice(of, (n, 1))
    rows = [tuple(row) for row in np.hstack([a, b]).tolist()]
    first: dict[tuple[float, ...], int] = {}
    for i, row in enumerate(rows):
        first.setdefault(row, i)
    found = distinct(a, b)
    if found is None:
        assert len(first) == n
        return
    assert len(first) < n
    assert found.rows.tolist() == list(first.values())
    assert found.rows[found.which].tolist() == [first[row] for row in rows]


def test_what_is_nearly_the_same_is_another_row() -> None:
    a = np.array([[0.1, 0.2], [0.1, np.nextafter(0.2, 1.0)], [0.1, 0.2]])
    assert distinct(a[:2], np.ones((2, 2))) is None
    found = distinct(a, np.array([[1.0, 2.0], [1.0, 2.0], [1.0, 3.0]]))
    assert found is None
