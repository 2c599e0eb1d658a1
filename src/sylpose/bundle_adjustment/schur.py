"""Compiled: Schur complement elimination of the landmarks, and their back-substitution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.bundle_adjustment.kernels import (
    DEPTH,
    LandmarkSystem,
    Linearization,
    compute_depth_residual,
    eliminate_landmark,
    make_landmark_system,
)
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel


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


class _Rows(NamedTuple):
    """Rows of one landmark's frames, and of the cameras that observe it, whitened by the landmark's system.

    Attributes:
        frames, poses: (k,), (k, 3, 6) its free frames and their rows.
        cameras, is_involved, shared: (C,) its cameras, (C,) whether each is among them, (C, K, 3) the rows of their
            shared parameters.
        point: (3, 2) rows of one observation.
    """

    frames: IntArray
    poses: FloatArray
    cameras: IntArray
    is_involved: BoolArray
    shared: FloatArray
    point: FloatArray


@kernel
def eliminate_landmarks(at: Linearization, out: ReducedSystem) -> None:
    """Write the reduced system to `out`, which must be zero at the start."""
    system, observations, (n_cameras, n_shared) = make_landmark_system(at), at.observations, at.views.parameters.shape
    longest = system.e.shape[0]
    frames, poses, point = np.empty(longest, np.int64), np.empty((longest, 3, 6)), np.empty((3, 2))
    cameras, is_involved = np.empty(n_cameras, np.int64), np.zeros(n_cameras, np.bool_)
    rows = _Rows(frames, poses, cameras, is_involved, np.zeros((n_cameras, n_shared, 3)), point)
    for i in range(at.points.shape[0]):
        if not eliminate_landmark(at, i, system):
            continue
        first, n_involved = observations.start[i], 0
        for n in range(first - 1, observations.start[i + 1]):
            c = observations.first_viewer[i] if n < first else observations.camera[n]
            if not is_involved[c]:
                is_involved[c], cameras[n_involved] = True, c
                rows.shared[c] = 0.0
                n_involved += 1
        _add_depth_terms(at, i, system.root, rows.shared, out)
        count = _add_observations(at, i, system, rows, out)
        _subtract_products(count, n_involved, system.slope, rows, out)


@kernel
def _add_depth_terms(at: Linearization, i: int, root: FloatArray, shared: FloatArray, out: ReducedSystem) -> None:
    """Add landmark i's depth prior to `out` and to its rows."""
    observations, information = at.observations, at.prior[0]
    u, c = observations.depth_direction[i], observations.first_viewer[i]
    r = information * compute_depth_residual(at, i)
    for p in range(3):
        x = observations.depth_basis[i, p]
        out.shared_gradient[c, DEPTH + p] -= r * x
        for s in range(3):
            out.corner[c, DEPTH + p, c, DEPTH + s] += information * x * observations.depth_basis[i, s]
        for j in range(3):
            for q in range(j + 1):
                shared[c, DEPTH + p, j] -= information * x * root[j, q] * u[q]


@kernel
def whiten(point_jacobian: FloatArray, root: FloatArray, rows: FloatArray) -> None:
    """Write the rows (3, 2) of an observation from its derivatives (2, 3) by the landmark."""
    for a in range(2):
        x, y, z = point_jacobian[a]
        rows[0, a] = root[0, 0] * x
        rows[1, a] = root[1, 0] * x + root[1, 1] * y
        rows[2, a] = root[2, 0] * x + root[2, 1] * y + root[2, 2] * z


@kernel
def _add_observations(at: Linearization, i: int, system: LandmarkSystem, rows: _Rows, out: ReducedSystem) -> int:
    """Add landmark i's observations to `out` and fill its rows; return the number of its free frames."""
    observations, e, pose_jacobian, shared_jacobian = (
        at.observations,
        system.e,
        system.pose_jacobian,
        system.shared_jacobian,
    )
    first, count, previous, n_shared, point = observations.start[i], 0, -1, shared_jacobian.shape[2], rows.point
    for n in range(first, observations.start[i + 1]):
        w = at.weights[n]
        if w <= 0.0:
            continue
        o, k, c = n - first, observations.free_index[observations.frame[n]], observations.camera[n]
        whiten(system.point_jacobian[o], system.root, point)
        lever = 0.0
        for a in range(2):
            lever += point[0, a] ** 2 + point[1, a] ** 2 + point[2, a] ** 2
        out.leverage[n] = w * lever
        for p in range(n_shared):
            t0, t1 = w * shared_jacobian[o, 0, p], w * shared_jacobian[o, 1, p]
            if t0 == 0.0 and t1 == 0.0:
                continue
            out.shared_gradient[c, p] += t0 * e[o, 0] + t1 * e[o, 1]
            for s in range(n_shared):
                out.corner[c, p, c, s] += t0 * shared_jacobian[o, 0, s] + t1 * shared_jacobian[o, 1, s]
            for j in range(3):
                rows.shared[c, p, j] += t0 * point[j, 0] + t1 * point[j, 1]
            if k >= 0:
                for s in range(6):
                    out.border[k, s, c, p] += t0 * pose_jacobian[o, 0, s] + t1 * pose_jacobian[o, 1, s]
        if k < 0:
            continue
        if k != previous:
            rows.frames[count], previous = k, k
            rows.poses[count] = 0.0
            count += 1
        block, frame_rows = out.blocks[out.indptr[k + 1] - 1], rows.poses[count - 1]
        for p in range(6):
            j0, j1 = w * pose_jacobian[o, 0, p], w * pose_jacobian[o, 1, p]
            out.gradient[k, p] += j0 * e[o, 0] + j1 * e[o, 1]
            for s in range(6):
                block[p, s] += j0 * pose_jacobian[o, 0, s] + j1 * pose_jacobian[o, 1, s]
            for j in range(3):
                frame_rows[j, p] += j0 * point[j, 0] + j1 * point[j, 1]
    return count


@kernel
def _subtract_products(count: int, n_involved: int, slope: FloatArray, rows: _Rows, out: ReducedSystem) -> None:
    """Subtract the products of a landmark's rows from `out`; no camera is involved afterwards."""
    frames, poses, cameras, is_involved, shared, _ = rows
    columns, blocks, gradient, za, n_shared = out.columns, out.blocks, out.gradient, np.empty((3, 6)), shared.shape[1]
    # This loop takes most of the time. Values are loaded before any is stored, because compilers cannot assume that the
    # arrays do not overlap.
    for a in range(count):
        row = frames[a]
        low = out.indptr[row]
        for p in range(6):
            za[0, p], za[1, p], za[2, p] = poses[a, 0, p], poses[a, 1, p], poses[a, 2, p]
            gradient[row, p] -= za[0, p] * slope[0] + za[1, p] * slope[1] + za[2, p] * slope[2]
        for b in range(a + 1):
            while columns[low] < frames[b]:  # most landmarks are observed in consecutive frames
                low += 1
            x = poses[b]
            x00, x01, x02, x03, x04, x05 = x[0, 0], x[0, 1], x[0, 2], x[0, 3], x[0, 4], x[0, 5]
            x10, x11, x12, x13, x14, x15 = x[1, 0], x[1, 1], x[1, 2], x[1, 3], x[1, 4], x[1, 5]
            x20, x21, x22, x23, x24, x25 = x[2, 0], x[2, 1], x[2, 2], x[2, 3], x[2, 4], x[2, 5]
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
                t0, t1, t2 = shared[c, s, 0], shared[c, s, 1], shared[c, s, 2]
                for p in range(6):
                    out.border[row, p, c, s] -= za[0, p] * t0 + za[1, p] * t1 + za[2, p] * t2
    for a in range(n_involved):
        c = cameras[a]
        is_involved[c] = False
        for p in range(n_shared):
            t0, t1, t2 = shared[c, p, 0], shared[c, p, 1], shared[c, p, 2]
            out.shared_gradient[c, p] -= t0 * slope[0] + t1 * slope[1] + t2 * slope[2]
            for b in range(n_involved):
                d = cameras[b]
                for s in range(n_shared):
                    out.corner[c, p, d, s] -= t0 * shared[d, s, 0] + t1 * shared[d, s, 1] + t2 * shared[d, s, 2]


@kernel
def back_substitute(at: Linearization, step: FloatArray, change: FloatArray, out: FloatArray) -> None:
    """Write the landmarks after a step of the frames and the shared parameters to out.

    The derivatives are recomputed, which saves memory and takes little time.

    Args:
        step: (N, 6) of the frames.
        change: (C, K) of the shared parameters.
        out: (m, 3) landmarks, filled.
    """
    system, observations, x = make_landmark_system(at), at.observations, np.empty(3)
    root, slope = system.root, system.slope
    for i in range(at.points.shape[0]):
        out[i] = at.points[i]
        if not eliminate_landmark(at, i, system):
            continue
        depth_change = 0.0
        for j in range(3):
            depth_change += observations.depth_basis[i, j] * change[observations.first_viewer[i], DEPTH + j]
        for j in range(3):
            x[j] = -at.prior[0] * depth_change * observations.depth_direction[i, j]
        for n in range(observations.start[i], observations.start[i + 1]):
            o = n - observations.start[i]
            if at.weights[n] <= 0.0:
                continue
            frame_step, parameter_change = step[observations.frame[n]], change[observations.camera[n]]
            for a in range(2):
                displacement = 0.0
                for p in range(change.shape[1]):
                    displacement += system.shared_jacobian[o, a, p] * parameter_change[p]
                for p in range(6):
                    displacement += system.pose_jacobian[o, a, p] * frame_step[p]
                for j in range(3):
                    x[j] += at.weights[n] * displacement * system.point_jacobian[o, a, j]
        s0 = slope[0] + root[0, 0] * x[0]
        s1 = slope[1] + root[1, 0] * x[0] + root[1, 1] * x[1]
        s2 = slope[2] + root[2, 0] * x[0] + root[2, 1] * x[1] + root[2, 2] * x[2]
        out[i, 0] -= root[0, 0] * s0 + root[1, 0] * s1 + root[2, 0] * s2
        out[i, 1] -= root[1, 1] * s1 + root[2, 1] * s2
        out[i, 2] -= root[2, 2] * s2
