"""Which frames share landmarks, and which of them that ties to one that stays."""

from __future__ import annotations

import numpy as np
from scipy.sparse import block_array, coo_array, csr_array, eye_array, tril
from scipy.sparse.csgraph import connected_components

from sylpose.bundle_adjustment.kernels import Sightings
from sylpose.geometry.arrays import BoolArray, IntArray

__all__ = ["pattern_of", "tied_frames"]


def pattern_of(sightings: Sightings, often: BoolArray) -> csr_array:
    """(F, F) lower triangle of which moving frames share landmarks."""
    n = int(sightings.free.max()) + 1
    sees = _incidence(sightings, sightings.free[sightings.frame], n, often)
    pattern = csr_array(tril(sees @ sees.T + eye_array(n), format="csr"))
    pattern.sort_indices()
    return pattern


def tied_frames(sightings: Sightings, often: BoolArray, anchored: BoolArray) -> BoolArray:
    """(N,) frames that landmarks connect to an anchored one."""
    n = len(anchored)
    sees = _incidence(sightings, sightings.frame, n, often)
    _, part = connected_components(block_array([[None, sees], [sees.T, None]]), directed=False)
    return np.asarray(np.isin(part[:n], part[:n][anchored]))


def _incidence(sightings: Sightings, rows: IntArray, n_rows: int, often: BoolArray) -> csr_array:
    """(n_rows, m) which rows see which landmarks, of those seen at least twice; rows (n,) of the observations, or -1."""
    landmark = np.repeat(np.arange(len(often)), np.diff(sightings.start))
    used = often[landmark] & (rows >= 0)
    entries = (np.ones(int(used.sum())), (rows[used], landmark[used]))
    return coo_array(entries, shape=(n_rows, len(often))).tocsr()
