"""Detection of duplicate rows, for example one keypoint with several orientations, or a file read twice.

A copy is not an independent measurement: counting it makes an estimator overconfident, and a match that agrees only
with its copies looks like a majority.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel

__all__ = ["DistinctRows", "find_distinct_rows"]

# Knuth's 64 bit multiplier, and the shift of the product, whose upper bits depend on all bits of the number (choice).
HASH_MULTIPLIER, HASH_SHIFT = 6364136223846793005, 29


class DistinctRows(NamedTuple):
    """The distinct ones of n rows.

    Attributes:
        rows: (k,) index of the first occurrence of each, in order.
        inverse: (n,) position in `rows` of each row's first occurrence.
    """

    rows: IntArray
    inverse: IntArray


def find_distinct_rows(a: FloatArray, b: FloatArray) -> DistinctRows | None:
    """Find the distinct rows of a (n, i) and b (n, j), side by side; None if all are distinct.

    Rows are compared bit by bit, because noise does not make exact copies.
    """
    count, rows, inverse = _find_distinct_rows(a, b)
    return None if count == len(a) else DistinctRows(rows[:count], inverse)


@kernel
def _find_distinct_rows(a: FloatArray, b: FloatArray) -> tuple[int, IntArray, IntArray]:
    """Return the number of distinct rows, their indices (the first elements), and each row's position in them (n,)."""
    n, size, count = len(a), 4, 0
    while size < 2 * n:
        size *= 2
    # Hash table of rows with linear probing.
    table = np.full(size, -1, np.int64)
    rows, inverse = np.empty(n, np.int64), np.empty(n, np.int64)
    a_bits, b_bits = a.view(np.int64), b.view(np.int64)
    for i in range(n):
        hash_value = 0
        for part in (a_bits, b_bits):
            for k in range(part.shape[1]):
                hash_value = (hash_value ^ part[i, k]) * HASH_MULTIPLIER
                hash_value ^= hash_value >> HASH_SHIFT
        slot = hash_value & (size - 1)
        while table[slot] >= 0:
            same, first = True, rows[table[slot]]
            for k in range(a.shape[1]):
                same = same and a_bits[i, k] == a_bits[first, k]
            for k in range(b.shape[1]):
                same = same and b_bits[i, k] == b_bits[first, k]
            if same:
                break
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = count
            rows[count] = i
            count += 1
        inverse[i] = table[slot]
    return count, rows, inverse
