"""Compiled: Schur complement elimination of the landmarks, and their back-substitution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.bundle_adjustment.kernels import (
    DEPTH,
    SortedObservations,
    Views,
    compute_depth_residual,
    eliminate_landmark,
    find_longest_track,
)
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel

__all__ = ["ReducedSystem", "back_substitute", "eliminate_landmarks", "find_column"]


class ReducedSystem(NamedTuple):
    """Normal equations of F free frames and C cameras' K shared parameters; filled by `eliminate_landmarks`.

    The landmarks are eliminated.

    Attributes:
        indptr, columns: (F + 1,), (k,) the blocks' pattern, lower triangle by rows, columns increasing, the diagonal
            last.
        blocks: (k, 6, 6) of frames with frames.
        gradient: (F, 6) of the frames.
        border: (F, 6, C, K) of frames with shared parameters.
        corner: (C, K, C, K) of shared parameters with each other.
        shared_gradient: (C, K) gradient of the shared parameters.
        leverage: (n,) number of an observation's two coordinates that its landmark absorbs.
    """

    indptr: IntArray
    columns: IntArray
    blocks: FloatArray
    gradient: FloatArray
    border: FloatArray
    corner: FloatArray
    shared_gradient: FloatArray
    leverage: FloatArray


@kernel
def find_column(columns: IntArray, low: int, high: int, column: int) -> int:
    """Return the position of a column in columns[low:high], which increase and contain it."""
    high -= 1
    while low < high:
        middle = (low + high) // 2
        if columns[middle] < column:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def eliminate_landmarks(
    observations: SortedObservations,
    views: Views,
    points: FloatArray,
    weights: FloatArray,
    landmark_prior: FloatArray,
    out: ReducedSystem,
) -> None:
    """Write the reduced system to `out`, which must be zero at the start.

    Args:
        points: (m, 3) landmarks.
        weights: (n,) of the squared residuals, 1/pixels²; 0 for points behind their camera.
        landmark_prior: (2,) as of `eliminate_landmark`.
    """
    longest, (n_cameras, n_shared) = find_longest_track(observations.start), views.parameters.shape
    e, pose_jacobian, point_jacobian = np.empty((longest, 2)), np.empty((longest, 2, 6)), np.empty((longest, 2, 3))
    shared_jacobian = np.zeros((longest, 2, n_shared))
    root, slope = np.zeros((3, 3)), np.empty(3)
    # Rows of the landmark's frames, and of the cameras that observe it, whitened by the landmark's system.
    frames, shared = np.empty(longest, np.int64), np.empty((longest, 3, 6))
    cameras, is_involved, common = (
        np.empty(n_cameras, np.int64),
        np.zeros(n_cameras, np.bool_),
        np.zeros((n_cameras, n_shared, 3)),
    )
    rows, za = np.empty((3, 2)), np.empty((3, 6))
    columns, blocks, gradient = out.columns, out.blocks, out.gradient
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
        first, count, previous, n_involved = observations.start[i], 0, -1, 0
        for n in range(first - 1, observations.start[i + 1]):
            c = observations.first_viewer[i] if n < first else observations.camera[n]
            if not is_involved[c]:
                is_involved[c], cameras[n_involved] = True, c
                common[c] = 0.0
                n_involved += 1
        add_depth_terms(observations, views, points[i], i, landmark_prior, root, common, out)
        for n in range(first, observations.start[i + 1]):
            w = weights[n]
            if w <= 0.0:
                continue
            o, k, c = n - first, observations.free_index[observations.frame[n]], observations.camera[n]
            lever = 0.0
            for a in range(2):
                x, y, z = point_jacobian[o, a]
                rows[0, a] = root[0, 0] * x
                rows[1, a] = root[1, 0] * x + root[1, 1] * y
                rows[2, a] = root[2, 0] * x + root[2, 1] * y + root[2, 2] * z
                lever += rows[0, a] ** 2 + rows[1, a] ** 2 + rows[2, a] ** 2
            out.leverage[n] = w * lever
            for p in range(n_shared):
                t0, t1 = w * shared_jacobian[o, 0, p], w * shared_jacobian[o, 1, p]
                if t0 == 0.0 and t1 == 0.0:
                    continue
                out.shared_gradient[c, p] += t0 * e[o, 0] + t1 * e[o, 1]
                for s in range(n_shared):
                    out.corner[c, p, c, s] += t0 * shared_jacobian[o, 0, s] + t1 * shared_jacobian[o, 1, s]
                for j in range(3):
                    common[c, p, j] += t0 * rows[j, 0] + t1 * rows[j, 1]
                if k >= 0:
                    for s in range(6):
                        out.border[k, s, c, p] += t0 * pose_jacobian[o, 0, s] + t1 * pose_jacobian[o, 1, s]
            if k < 0:
                continue
            if k != previous:
                frames[count], previous = k, k
                shared[count] = 0.0
                count += 1
            block, frame_rows = out.blocks[out.indptr[k + 1] - 1], shared[count - 1]
            for p in range(6):
                j0, j1 = w * pose_jacobian[o, 0, p], w * pose_jacobian[o, 1, p]
                out.gradient[k, p] += j0 * e[o, 0] + j1 * e[o, 1]
                for s in range(6):
                    block[p, s] += j0 * pose_jacobian[o, 0, s] + j1 * pose_jacobian[o, 1, s]
                for j in range(3):
                    frame_rows[j, p] += j0 * rows[j, 0] + j1 * rows[j, 1]
        # This loop takes most of the time. Values are loaded before any is stored, because compilers cannot assume that
        # the arrays do not overlap.
        for a in range(count):
            row = frames[a]
            low = out.indptr[row]
            for p in range(6):
                za[0, p], za[1, p], za[2, p] = shared[a, 0, p], shared[a, 1, p], shared[a, 2, p]
                gradient[row, p] -= za[0, p] * slope[0] + za[1, p] * slope[1] + za[2, p] * slope[2]
            for b in range(a + 1):
                while columns[low] < frames[b]:  # most landmarks are observed in consecutive frames
                    low += 1
                x00, x01, x02, x03, x04, x05 = (
                    shared[b, 0, 0],
                    shared[b, 0, 1],
                    shared[b, 0, 2],
                    shared[b, 0, 3],
                    shared[b, 0, 4],
                    shared[b, 0, 5],
                )
                x10, x11, x12, x13, x14, x15 = (
                    shared[b, 1, 0],
                    shared[b, 1, 1],
                    shared[b, 1, 2],
                    shared[b, 1, 3],
                    shared[b, 1, 4],
                    shared[b, 1, 5],
                )
                x20, x21, x22, x23, x24, x25 = (
                    shared[b, 2, 0],
                    shared[b, 2, 1],
                    shared[b, 2, 2],
                    shared[b, 2, 3],
                    shared[b, 2, 4],
                    shared[b, 2, 5],
                )
                for p in range(6):
                    z0, z1, z2 = za[0, p], za[1, p], za[2, p]
                    blocks[low, p, 0] -= z0 * x00 + z1 * x10 + z2 * x20
                    blocks[low, p, 1] -= z0 * x01 + z1 * x11 + z2 * x21
                    blocks[low, p, 2] -= z0 * x02 + z1 * x12 + z2 * x22
                    blocks[low, p, 3] -= z0 * x03 + z1 * x13 + z2 * x23
                    blocks[low, p, 4] -= z0 * x04 + z1 * x14 + z2 * x24
                    blocks[low, p, 5] -= z0 * x05 + z1 * x15 + z2 * x25
            for d in range(n_involved):
                c = cameras[d]
                for s in range(n_shared):
                    t0, t1, t2 = common[c, s, 0], common[c, s, 1], common[c, s, 2]
                    for p in range(6):
                        out.border[row, p, c, s] -= za[0, p] * t0 + za[1, p] * t1 + za[2, p] * t2
        for a in range(n_involved):
            c = cameras[a]
            is_involved[c] = False
            for p in range(n_shared):
                t0, t1, t2 = common[c, p, 0], common[c, p, 1], common[c, p, 2]
                out.shared_gradient[c, p] -= t0 * slope[0] + t1 * slope[1] + t2 * slope[2]
                for b in range(n_involved):
                    d = cameras[b]
                    for s in range(n_shared):
                        out.corner[c, p, d, s] -= t0 * common[d, s, 0] + t1 * common[d, s, 1] + t2 * common[d, s, 2]


@kernel
def add_depth_terms(
    observations: SortedObservations,
    views: Views,
    point: FloatArray,
    i: int,
    landmark_prior: FloatArray,
    root: FloatArray,
    common: FloatArray,
    out: ReducedSystem,
) -> None:
    """Add landmark i's depth prior to `out` and to its rows `common`."""
    u, c = observations.depth_direction[i], observations.first_viewer[i]
    r = landmark_prior[0] * compute_depth_residual(observations, views, point, i)
    for p in range(3):
        x = observations.depth_basis[i, p]
        out.shared_gradient[c, DEPTH + p] -= r * x
        for s in range(3):
            out.corner[c, DEPTH + p, c, DEPTH + s] += landmark_prior[0] * x * observations.depth_basis[i, s]
        for j in range(3):
            for q in range(j + 1):
                common[c, DEPTH + p, j] -= landmark_prior[0] * x * root[j, q] * u[q]


@kernel
def back_substitute(
    observations: SortedObservations,
    views: Views,
    points: FloatArray,
    weights: FloatArray,
    landmark_prior: FloatArray,
    step: FloatArray,
    change: FloatArray,
    out: FloatArray,
) -> None:
    """Write the landmarks after a step of the frames and the shared parameters to out.

    The derivatives are recomputed, which saves memory and takes little time.

    Args:
        observations, views, points, weights, landmark_prior: as of `eliminate_landmarks`.
        step: (N, 6) of the frames.
        change: (C, K) of the shared parameters.
        out: (m, 3) landmarks, filled.
    """
    longest, n_shared = find_longest_track(observations.start), views.parameters.shape[1]
    e, pose_jacobian, point_jacobian = np.empty((longest, 2)), np.empty((longest, 2, 6)), np.empty((longest, 2, 3))
    shared_jacobian = np.zeros((longest, 2, n_shared))
    root, slope, x = np.zeros((3, 3)), np.empty(3), np.empty(3)
    for i in range(points.shape[0]):
        out[i] = points[i]
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
        depth_change = 0.0
        for j in range(3):
            depth_change += observations.depth_basis[i, j] * change[observations.first_viewer[i], DEPTH + j]
        for j in range(3):
            x[j] = -landmark_prior[0] * depth_change * observations.depth_direction[i, j]
        for n in range(observations.start[i], observations.start[i + 1]):
            o = n - observations.start[i]
            if weights[n] <= 0.0:
                continue
            frame_step, parameter_change = step[observations.frame[n]], change[observations.camera[n]]
            for a in range(2):
                displacement = 0.0
                for p in range(n_shared):
                    displacement += shared_jacobian[o, a, p] * parameter_change[p]
                for p in range(6):
                    displacement += pose_jacobian[o, a, p] * frame_step[p]
                for j in range(3):
                    x[j] += weights[n] * displacement * point_jacobian[o, a, j]
        s0 = slope[0] + root[0, 0] * x[0]
        s1 = slope[1] + root[1, 0] * x[0] + root[1, 1] * x[1]
        s2 = slope[2] + root[2, 0] * x[0] + root[2, 1] * x[1] + root[2, 2] * x[2]
        out[i, 0] -= root[0, 0] * s0 + root[1, 0] * s1 + root[2, 0] * s2
        out[i, 1] -= root[1, 1] * s1 + root[2, 1] * s2
        out[i, 2] -= root[2, 2] * s2
