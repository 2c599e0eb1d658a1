"""Rows that are given several times: the same keypoint with several orientations, say, or a file read twice.

A copy is no measurement of its own: an estimator that counts it believes itself too much, and what agrees with nothing but
its own copies looks like a majority.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel

__all__ = ["Distinct", "distinct"]

# Knuth's multiplier, of 64 bits, and by how many the product is shifted: its upper bits depend on all of the number's
# (choice).
MULTIPLIER, SHIFT = 6364136223846793005, 29


class Distinct(NamedTuple):
    """The different ones among n rows.

    Attributes:
        rows: (k,) the first of each, in order.
        which: (n,) of all rows, the place in `rows` of the one they are.
    """

    rows: IntArray
    which: IntArray


def distinct(a: FloatArray, b: FloatArray) -> Distinct | None:
    """Which of the rows of a (n, i) and b (n, j), side by side, are different; None where all are. Equal to the last bit:
    noise makes no copies."""
    count, rows, which = _distinct(a, b)
    return None if count == len(a) else Distinct(rows[:count], which)


@kernel
def _distinct(a: FloatArray, b: FloatArray) -> tuple[int, IntArray, IntArray]:
    """The number of different rows, with the first so many of (n,) they are, and which of them each is (n,)."""
    n, size, count = len(a), 4, 0
    while size < 2 * n:
        size *= 2
    # Rows by their hashes; where a place is taken, the next one.
    table = np.full(size, -1, np.int64)
    rows, which = np.empty(n, np.int64), np.empty(n, np.int64)
    a_bits, b_bits = a.view(np.int64), b.view(np.int64)
    for i in range(n):
        mixed = 0
        for part in (a_bits, b_bits):
            for k in range(part.shape[1]):
                mixed = (mixed ^ part[i, k]) * MULTIPLIER
                mixed ^= mixed >> SHIFT
        place = mixed & (size - 1)
        while table[place] >= 0:
            same, first = True, rows[table[place]]
            for k in range(a.shape[1]):
                same = same and a_bits[i, k] == a_bits[first, k]
            for k in range(b.shape[1]):
                same = same and b_bits[i, k] == b_bits[first, k]
            if same:
                break
            place = (place + 1) & (size - 1)
        if table[place] < 0:
            table[place] = count
            rows[count] = i
            count += 1
        which[i] = table[place]
    return count, rows, which
