"""Covisibility of frames, and their connection to fixed frames."""

from __future__ import annotations

import numpy as np
from scipy.sparse import block_array, coo_array, csr_array, eye_array, tril
from scipy.sparse.csgraph import connected_components

from sylpose.bundle_adjustment.kernels import SortedObservations
from sylpose.geometry.arrays import BoolArray, IntArray

__all__ = ["build_covisibility_pattern", "find_connected_frames"]


def build_covisibility_pattern(observations: SortedObservations, repeated: BoolArray) -> csr_array:
    """Return (F, F) lower triangle of the covisibility of moving frames."""
    n = int(observations.free_index.max()) + 1
    incidence = _incidence(observations, observations.free_index[observations.frame], n, repeated)
    pattern = csr_array(tril(incidence @ incidence.T + eye_array(n), format="csr"))
    pattern.sort_indices()
    return pattern


def find_connected_frames(observations: SortedObservations, repeated: BoolArray, fixed: BoolArray) -> BoolArray:
    """Return (N,) mask of the frames that landmarks connect to a fixed one."""
    n = len(fixed)
    incidence = _incidence(observations, observations.frame, n, repeated)
    _, part = connected_components(block_array([[None, incidence], [incidence.T, None]]), directed=False)
    return np.asarray(np.isin(part[:n], part[:n][fixed]))


def _incidence(observations: SortedObservations, rows: IntArray, n_rows: int, repeated: BoolArray) -> csr_array:
    """Return (n_rows, m) incidence of rows and landmarks observed at least twice.

    Args:
        rows: (n,) row of each observation, or -1.
    """
    landmark = np.repeat(np.arange(len(repeated)), np.diff(observations.start))
    used = repeated[landmark] & (rows >= 0)
    entries = (np.ones(int(used.sum())), (rows[used], landmark[used]))
    return coo_array(entries, shape=(n_rows, len(repeated))).tocsr()
