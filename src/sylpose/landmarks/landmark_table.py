"""Landmark table of one camera, indexed by number.

Frames store numbers, so updates apply to all of them.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.landmarks.landmark_filter import Landmarks

__all__ = ["LandmarkTable"]

# Initial number of rows; it is doubled when they are full (choice).
INITIAL_CAPACITY = 1024
# Neighbors whose median displacement is used (choice).
N_NEIGHBORS = 8


class LandmarkTable:
    """Table of one camera's landmarks that grows as needed.

    Numbers are not reused; those of removed landmarks are missing.
    """

    def __init__(self) -> None:
        self._rows = _allocate(INITIAL_CAPACITY)  # sorted by number; the first `_used` of them are valid
        self._used = self._next = 0

    @classmethod
    def from_landmarks(cls, landmarks: Landmarks) -> LandmarkTable:
        """Return a table of these landmarks, with the numbers that they have."""
        table = cls()
        table._rows = landmarks.subset(np.unique(landmarks.id, return_index=True)[1])
        table._used, table._next = len(table._rows), int(landmarks.id.max(initial=-1)) + 1
        return table

    def __len__(self) -> int:
        return self._used

    def get(self, numbers: IntArray) -> Landmarks:
        """Return the landmarks with the numbers (n,)."""
        return self._rows.subset(self._find_rows(numbers))

    def observation_counts(self, numbers: IntArray) -> IntArray:
        """Return (n,) the number of frames in which each was observed."""
        return np.asarray(self._rows.n_observations[self._find_rows(numbers)])

    def update(self, landmarks: Landmarks) -> IntArray:
        """Store landmarks (n): those with a number are replaced, the others are added. The last of equal numbers wins.

        Returns:
            their numbers (n,).
        """
        numbers, new = landmarks.id.copy(), landmarks.id < 0
        numbers[new] = self._next + np.arange(new.sum())
        existing = landmarks.subset(~new)
        _write_rows(self._rows, self._find_rows(existing.id), existing)
        first, self._used, self._next = self._used, self._used + int(new.sum()), self._next + int(new.sum())
        if self._used > len(self._rows):
            self._rows = Landmarks.concatenate([self._rows.subset(np.arange(first)), _allocate(2 * self._used - first)])
        rows = np.arange(first, self._used)
        _write_rows(self._rows, rows, landmarks.subset(new))
        self._rows.id[rows] = numbers[new]
        return numbers

    def move(self, numbers: IntArray, positions: FloatArray) -> None:
        """Move the landmarks with some numbers (n,) to positions (n, 3), with unchanged information.

        The others move with the nearest of them, to stay consistent. Numbers of removed landmarks are ignored.
        """
        exists = np.isin(numbers, self._rows.id[: self._used])
        numbers, positions = numbers[exists], positions[exists]
        rows, means = self._find_rows(numbers), self._rows.mean[: self._used]
        others = np.setdiff1d(np.flatnonzero(np.isfinite(means).all(axis=1)), rows)
        displacements = positions - means[rows]
        if len(rows) >= N_NEIGHBORS and len(others) and np.isfinite(displacements).all():
            _, nearest = cKDTree(means[rows]).query(means[others], N_NEIGHBORS)
            means[others] += np.median(displacements[nearest], axis=1)
        means[rows] = positions

    def prune(self, numbers: IntArray) -> None:
        """Remove all but those with some numbers, once they are less than half of all."""
        used = np.zeros(self._used, bool)
        used[self._find_rows(numbers)] = True
        if 2 * np.count_nonzero(used) < self._used:
            rows = np.flatnonzero(used)
            self._rows, self._used = self._rows.subset(rows), len(rows)

    def _find_rows(self, numbers: IntArray) -> IntArray:
        """Return (n,) the rows of existing numbers (n,)."""
        rows = np.searchsorted(self._rows.id[: self._used], numbers)
        assert (self._rows.id[rows] == numbers).all()
        return np.asarray(rows)


def _allocate(n: int) -> Landmarks:
    numbers, moved = np.full(n, -1, np.int64), np.empty(n, bool)
    return Landmarks(np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n, np.int64), moved, np.empty((n, 2)), numbers)


def _write_rows(rows: Landmarks, index: IntArray, landmarks: Landmarks) -> None:
    """Write everything except the numbers."""
    rows.mean[index], rows.information[index] = landmarks.mean, landmarks.information
    rows.n_observations[index], rows.has_moved[index], rows.origin[index] = (
        landmarks.n_observations,
        landmarks.has_moved,
        landmarks.origin,
    )
