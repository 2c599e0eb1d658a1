"""Compiled: what each group of observations adds to the joint refinement's system, which tells how far groups pull apart."""

from __future__ import annotations

import numpy as np

from sylpose.bundle_adjustment.kernels import Sightings, Views, eliminated, longest_track
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel

__all__ = ["scores"]


@kernel
def scores(
    seen: Sightings,
    views: Views,
    points: FloatArray,
    weights: FloatArray,
    pull: FloatArray,
    group: IntArray,
    by_pose_sum: FloatArray,
    by_shared_sum: FloatArray,
    shares: FloatArray,
) -> None:
    """What each of G groups of observations, `group` (n,), adds to the reduced system; the three sums are zero at the start.

    by_pose_sum (F, G, 6) and by_shared_sum (G, C, K) become its gradient, shares (F, G, 6, 6) its information about each
    frame.
    """
    longest, n_shared = longest_track(seen.start), views.shared.shape[1]
    e, by_pose, by_point = np.empty((longest, 2)), np.empty((longest, 2, 6)), np.empty((longest, 2, 3))
    by_shared = np.zeros((longest, 2, n_shared))
    root, slope, rows, shared = np.zeros((3, 3)), np.empty(3), np.empty((3, 2)), np.empty((3, 6))
    for i in range(points.shape[0]):
        if not eliminated(seen, views, points[i], i, weights, pull, e, by_pose, by_shared, by_point, root, slope):
            continue
        for n in range(seen.start[i], seen.start[i + 1]):
            w = weights[n]
            if w <= 0.0:
                continue
            o, k, c, g = n - seen.start[i], seen.free[seen.frame[n]], seen.camera[n], group[n]
            shared[:] = 0.0
            for a in range(2):
                x, y, z = by_point[o, a]
                rows[0, a] = root[0, 0] * x
                rows[1, a] = root[1, 0] * x + root[1, 1] * y
                rows[2, a] = root[2, 0] * x + root[2, 1] * y + root[2, 2] * z
                r = w * (e[o, a] - rows[0, a] * slope[0] - rows[1, a] * slope[1] - rows[2, a] * slope[2])
                for p in range(n_shared):
                    by_shared_sum[g, c, p] += by_shared[o, a, p] * r
                if k < 0:
                    continue
                for p in range(6):
                    by_pose_sum[k, g, p] += by_pose[o, a, p] * r
                    for j in range(3):
                        shared[j, p] += w * by_pose[o, a, p] * rows[j, a]
            if k < 0:
                continue
            for p in range(6):
                for q in range(6):
                    whole = w * (by_pose[o, 0, p] * by_pose[o, 0, q] + by_pose[o, 1, p] * by_pose[o, 1, q])
                    used = shared[0, p] * shared[0, q] + shared[1, p] * shared[1, q] + shared[2, p] * shared[2, q]
                    shares[k, g, p, q] += whole - used
