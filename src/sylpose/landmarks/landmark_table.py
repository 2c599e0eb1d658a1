"""The landmarks of one camera in one table, by number. Frames keep numbers, so what a sight teaches all of them know."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.landmarks.landmark_filter import Landmarks

__all__ = ["LandmarkTable"]

# Rows that a table has room for at first; when they are full, twice as many (choice).
ROOM = 1024
# Of so many neighbours' moves the one in the middle is taken (choice).
NEIGHBOURS = 8


class LandmarkTable:
    """A growing table. A number is given once; where landmarks were forgotten, numbers are missing."""

    def __init__(self) -> None:
        self._rows = _empty(ROOM)  # in the order of their numbers; the first `_used` of them count
        self._used = self._next = 0

    @classmethod
    def holding(cls, landmarks: Landmarks) -> LandmarkTable:
        """A table of some landmarks alone, under the numbers that they have."""
        table = cls()
        table._rows = landmarks.subset(np.unique(landmarks.id, return_index=True)[1])
        table._used, table._next = len(table._rows), int(landmarks.id.max(initial=-1)) + 1
        return table

    def __len__(self) -> int:
        return self._used

    def of(self, numbers: IntArray) -> Landmarks:
        """Those with the numbers (n,)."""
        return self._rows.subset(self._at(numbers))

    def seen(self, numbers: IntArray) -> IntArray:
        """(n,) in how many frames each of those was seen."""
        return np.asarray(self._rows.seen[self._at(numbers)])

    def learn(self, landmarks: Landmarks) -> IntArray:
        """Takes in what is known of landmarks (n) by now: of those that have a number instead of what was known before, the
        others are new. Where several have the same number, the last counts.

        Returns:
            their numbers (n,).
        """
        numbers, new = landmarks.id.copy(), landmarks.id < 0
        numbers[new] = self._next + np.arange(new.sum())
        old = landmarks.subset(~new)
        _write(self._rows, self._at(old.id), old)
        first, self._used, self._next = self._used, self._used + int(new.sum()), self._next + int(new.sum())
        if self._used > len(self._rows):
            self._rows = Landmarks.concatenate([self._rows.subset(np.arange(first)), _empty(2 * self._used - first)])
        rows = np.arange(first, self._used)
        _write(self._rows, rows, landmarks.subset(new))
        self._rows.id[rows] = numbers[new]
        return numbers

    def place(self, numbers: IntArray, places: FloatArray) -> None:
        """Puts the landmarks with some numbers (n,) at places (n, 3), as well known as before; the others go along with the
        nearest of them, or they would contradict them. Those that are forgotten by now stay so."""
        there = np.isin(numbers, self._rows.id[: self._used])
        numbers, places = numbers[there], places[there]
        at, means = self._at(numbers), self._rows.mean[: self._used]
        others = np.setdiff1d(np.flatnonzero(np.isfinite(means).all(axis=1)), at)
        moved = places - means[at]
        if len(at) >= NEIGHBOURS and len(others) and np.isfinite(moved).all():
            _, nearest = cKDTree(means[at]).query(means[others], NEIGHBOURS)
            means[others] += np.median(moved[nearest], axis=1)
        means[at] = places

    def keep(self, numbers: IntArray) -> None:
        """Forgets all but those with some numbers, once they are less than half of all."""
        used = np.zeros(self._used, bool)
        used[self._at(numbers)] = True
        if 2 * np.count_nonzero(used) < self._used:
            rows = np.flatnonzero(used)
            self._rows, self._used = self._rows.subset(rows), len(rows)

    def _at(self, numbers: IntArray) -> IntArray:
        """(n,) the rows of numbers (n,) that are there."""
        rows = np.searchsorted(self._rows.id[: self._used], numbers)
        assert (self._rows.id[rows] == numbers).all()
        return np.asarray(rows)


def _empty(n: int) -> Landmarks:
    numbers, moved = np.full(n, -1, np.int64), np.empty(n, bool)
    return Landmarks(np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n, np.int64), moved, np.empty((n, 2)), numbers)


def _write(rows: Landmarks, at: IntArray, landmarks: Landmarks) -> None:
    """Everything but the numbers."""
    rows.mean[at], rows.information[at] = landmarks.mean, landmarks.information
    rows.seen[at], rows.moved[at], rows.origin[at] = landmarks.seen, landmarks.moved, landmarks.origin
