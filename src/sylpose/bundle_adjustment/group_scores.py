"""Compiled: contribution of each group of observations to the reduced system."""

from __future__ import annotations

import numpy as np

from sylpose.bundle_adjustment.kernels import SortedObservations, Views, eliminate_landmark, find_longest_track
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel

__all__ = ["accumulate_group_scores"]


@kernel
def accumulate_group_scores(
    observations: SortedObservations,
    views: Views,
    points: FloatArray,
    weights: FloatArray,
    landmark_prior: FloatArray,
    group: IntArray,
    pose_gradients: FloatArray,
    shared_gradients: FloatArray,
    information: FloatArray,
) -> None:
    """Add the contributions of G groups of observations to sums that start at zero.

    Args:
        observations, views, points, weights, landmark_prior: as of `eliminate_landmarks`.
        group: (n,) group of each observation.
        pose_gradients, shared_gradients: (F, G, 6), (G, C, K) gradients.
        information: (F, G, 6, 6) information of each group on each frame.
    """
    longest, n_shared = find_longest_track(observations.start), views.parameters.shape[1]
    e, pose_jacobian, point_jacobian = np.empty((longest, 2)), np.empty((longest, 2, 6)), np.empty((longest, 2, 3))
    shared_jacobian = np.zeros((longest, 2, n_shared))
    root, slope, rows, shared = np.zeros((3, 3)), np.empty(3), np.empty((3, 2)), np.empty((3, 6))
    for i in range(points.shape[0]):
        if not eliminate_landmark(
            observations,
            views,
            points[i],
            i,
            weights,
            landmark_prior,
            e,
            pose_jacobian,
            shared_jacobian,
            point_jacobian,
            root,
            slope,
        ):
            continue
        for n in range(observations.start[i], observations.start[i + 1]):
            w = weights[n]
            if w <= 0.0:
                continue
            o, k, c, g = (
                n - observations.start[i],
                observations.free_index[observations.frame[n]],
                observations.camera[n],
                group[n],
            )
            shared[:] = 0.0
            for a in range(2):
                x, y, z = point_jacobian[o, a]
                rows[0, a] = root[0, 0] * x
                rows[1, a] = root[1, 0] * x + root[1, 1] * y
                rows[2, a] = root[2, 0] * x + root[2, 1] * y + root[2, 2] * z
                r = w * (e[o, a] - rows[0, a] * slope[0] - rows[1, a] * slope[1] - rows[2, a] * slope[2])
                for p in range(n_shared):
                    shared_gradients[g, c, p] += shared_jacobian[o, a, p] * r
                if k < 0:
                    continue
                for p in range(6):
                    pose_gradients[k, g, p] += pose_jacobian[o, a, p] * r
                    for j in range(3):
                        shared[j, p] += w * pose_jacobian[o, a, p] * rows[j, a]
            if k < 0:
                continue
            for p in range(6):
                for q in range(6):
                    whole = w * (
                        pose_jacobian[o, 0, p] * pose_jacobian[o, 0, q]
                        + pose_jacobian[o, 1, p] * pose_jacobian[o, 1, q]
                    )
                    used = shared[0, p] * shared[0, q] + shared[1, p] * shared[1, q] + shared[2, p] * shared[2, q]
                    information[k, g, p, q] += whole - used
