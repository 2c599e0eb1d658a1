"""Duplicate rows, compared with a dictionary, for any numbers."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.geometry.numba_linalg import index_distinct_rows


@given(st.integers(0, 10**6), st.integers(0, 60), st.integers(1, 4))
@settings(max_examples=60, deadline=None)
def test_rows_map_to_first_occurrence(seed: int, n: int, values: int) -> None:
    """Few values, or whole numbers, which give many rows with equal bits."""
    rng = np.random.default_rng(seed)
    of = np.concatenate([rng.integers(0, 3, values), rng.standard_normal(values)])
    a, b = rng.choice(of, (n, 2)), rng.choice(of, (n, 1))
    rows = [tuple(row) for row in np.hstack([a, b]).tolist()]
    first: dict[tuple[float, ...], int] = {}
    for i, row in enumerate(rows):
        first.setdefault(row, i)
    count, indices, inverse = index_distinct_rows(a, b)
    assert indices[:count].tolist() == list(first.values())
    assert indices[inverse].tolist() == [first[row] for row in rows]


def test_nearly_equal_rows_are_distinct() -> None:
    a = np.array([[0.1, 0.2], [0.1, np.nextafter(0.2, 1.0)], [0.1, 0.2]])
    assert index_distinct_rows(a, np.array([[1.0, 2.0], [1.0, 2.0], [1.0, 3.0]]))[0] == 3
