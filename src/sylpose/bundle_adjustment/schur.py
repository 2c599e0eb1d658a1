"""Compiled: the landmarks eliminated from the joint refinement's system, and found again from its answer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.bundle_adjustment.kernels import DEPTH, Sightings, Views, above_surface, eliminated, longest_track
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel

__all__ = ["Reduced", "place_of", "reduce", "substitute"]


class Reduced(NamedTuple):
    """Normal equations of F free frames and of C cameras' K shared unknowns, landmarks eliminated: filled by `reduce`.

    Attributes:
        indptr (F + 1,), columns: the blocks' pattern, lower triangle by rows, columns rising, the diagonal last.
        blocks: (k, 6, 6) of frames with frames.
        gradient: (F, 6).
        border: (F, 6, C, K) of frames with shared unknowns.
        corner: (C, K, C, K) of shared unknowns with each other; slope: (C, K) their gradient.
        leverage: (n,) how many of an observation's two coordinates its landmark uses up.
    """

    indptr: IntArray
    columns: IntArray
    blocks: FloatArray
    gradient: FloatArray
    border: FloatArray
    corner: FloatArray
    slope: FloatArray
    leverage: FloatArray


@kernel
def place_of(columns: IntArray, low: int, high: int, column: int) -> int:
    """Where a column is in columns[low:high], which rise and contain it."""
    high -= 1
    while low < high:
        middle = (low + high) // 2
        if columns[middle] < column:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def reduce(
    seen: Sightings, views: Views, points: FloatArray, weights: FloatArray, pull: FloatArray, out: Reduced
) -> None:
    """The reduced system `out`, which must be zero at the start.

    Args:
        points: (m, 3) landmarks.
        weights: (n,) of the squared residuals, 1/pixels²; 0 for what is behind its camera.
        pull: (2,) as of `eliminated`.
    """
    longest, (n_cameras, n_shared) = longest_track(seen.start), views.shared.shape
    e, by_pose, by_point = np.empty((longest, 2)), np.empty((longest, 2, 6)), np.empty((longest, 2, 3))
    by_shared = np.zeros((longest, 2, n_shared))
    root, slope = np.zeros((3, 3)), np.empty(3)
    # Of each of the landmark's frames, and of the cameras that see it: their rows with it, in the landmark's terms.
    frames, shared = np.empty(longest, np.int64), np.empty((longest, 3, 6))
    cameras, involved, common = (
        np.empty(n_cameras, np.int64),
        np.zeros(n_cameras, np.bool_),
        np.zeros((n_cameras, n_shared, 3)),
    )
    rows, za = np.empty((3, 2)), np.empty((3, 6))
    columns, blocks, gradient = out.columns, out.blocks, out.gradient
    for i in range(points.shape[0]):
        if not eliminated(seen, views, points[i], i, weights, pull, e, by_pose, by_shared, by_point, root, slope):
            continue
        first, count, previous, n_involved = seen.start[i], 0, -1, 0
        for n in range(first - 1, seen.start[i + 1]):
            c = seen.viewer[i] if n < first else seen.camera[n]
            if not involved[c]:
                involved[c], cameras[n_involved] = True, c
                common[c] = 0.0
                n_involved += 1
        against_surface(seen, views, points[i], i, pull, root, common, out)
        for n in range(first, seen.start[i + 1]):
            w = weights[n]
            if w <= 0.0:
                continue
            o, k, c = n - first, seen.free[seen.frame[n]], seen.camera[n]
            lever = 0.0
            for a in range(2):
                x, y, z = by_point[o, a]
                rows[0, a] = root[0, 0] * x
                rows[1, a] = root[1, 0] * x + root[1, 1] * y
                rows[2, a] = root[2, 0] * x + root[2, 1] * y + root[2, 2] * z
                lever += rows[0, a] ** 2 + rows[1, a] ** 2 + rows[2, a] ** 2
            out.leverage[n] = w * lever
            for p in range(n_shared):
                t0, t1 = w * by_shared[o, 0, p], w * by_shared[o, 1, p]
                if t0 == 0.0 and t1 == 0.0:
                    continue
                out.slope[c, p] += t0 * e[o, 0] + t1 * e[o, 1]
                for s in range(n_shared):
                    out.corner[c, p, c, s] += t0 * by_shared[o, 0, s] + t1 * by_shared[o, 1, s]
                for j in range(3):
                    common[c, p, j] += t0 * rows[j, 0] + t1 * rows[j, 1]
                if k >= 0:
                    for s in range(6):
                        out.border[k, s, c, p] += t0 * by_pose[o, 0, s] + t1 * by_pose[o, 1, s]
            if k < 0:
                continue
            if k != previous:
                frames[count], previous = k, k
                shared[count] = 0.0
                count += 1
            block, mine = out.blocks[out.indptr[k + 1] - 1], shared[count - 1]
            for p in range(6):
                j0, j1 = w * by_pose[o, 0, p], w * by_pose[o, 1, p]
                out.gradient[k, p] += j0 * e[o, 0] + j1 * e[o, 1]
                for s in range(6):
                    block[p, s] += j0 * by_pose[o, 0, s] + j1 * by_pose[o, 1, s]
                for j in range(3):
                    mine[j, p] += j0 * rows[j, 0] + j1 * rows[j, 1]
        # This loop takes most of the time. Numbers are taken out before any is stored: compilers cannot know that the
        # arrays are not the same.
        for a in range(count):
            row = frames[a]
            low = out.indptr[row]
            for p in range(6):
                za[0, p], za[1, p], za[2, p] = shared[a, 0, p], shared[a, 1, p], shared[a, 2, p]
                gradient[row, p] -= za[0, p] * slope[0] + za[1, p] * slope[1] + za[2, p] * slope[2]
            for b in range(a + 1):
                while columns[low] < frames[b]:  # most landmarks are seen in frames that follow each other
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
            involved[c] = False
            for p in range(n_shared):
                t0, t1, t2 = common[c, p, 0], common[c, p, 1], common[c, p, 2]
                out.slope[c, p] -= t0 * slope[0] + t1 * slope[1] + t2 * slope[2]
                for b in range(n_involved):
                    d = cameras[b]
                    for s in range(n_shared):
                        out.corner[c, p, d, s] -= t0 * common[d, s, 0] + t1 * common[d, s, 1] + t2 * common[d, s, 2]


@kernel
def against_surface(
    seen: Sightings,
    views: Views,
    point: FloatArray,
    i: int,
    pull: FloatArray,
    root: FloatArray,
    common: FloatArray,
    out: Reduced,
) -> None:
    """Adds what landmark i says of its viewer's surface: to corner, slope, and its rows `common` with the landmark."""
    u, c = seen.toward[i], seen.viewer[i]
    r = pull[0] * above_surface(seen, views, point, i)
    for p in range(3):
        x = seen.across[i, p]
        out.slope[c, DEPTH + p] -= r * x
        for s in range(3):
            out.corner[c, DEPTH + p, c, DEPTH + s] += pull[0] * x * seen.across[i, s]
        for j in range(3):
            for q in range(j + 1):
                common[c, DEPTH + p, j] -= pull[0] * x * root[j, q] * u[q]


@kernel
def substitute(
    seen: Sightings,
    views: Views,
    points: FloatArray,
    weights: FloatArray,
    pull: FloatArray,
    step: FloatArray,
    change: FloatArray,
    out: FloatArray,
) -> None:
    """out (m, 3) becomes the landmarks that belong to steps of the frames (N, 6) and a change of the shared (C, K).

    Args: the rest as in `reduce`, whose derivatives are made again here: keeping them would cost memory, not making them
        little time.
    """
    longest, n_shared = longest_track(seen.start), views.shared.shape[1]
    e, by_pose, by_point = np.empty((longest, 2)), np.empty((longest, 2, 6)), np.empty((longest, 2, 3))
    by_shared = np.zeros((longest, 2, n_shared))
    root, slope, x = np.zeros((3, 3)), np.empty(3), np.empty(3)
    for i in range(points.shape[0]):
        out[i] = points[i]
        if not eliminated(seen, views, points[i], i, weights, pull, e, by_pose, by_shared, by_point, root, slope):
            continue
        rise = 0.0
        for j in range(3):
            rise += seen.across[i, j] * change[seen.viewer[i], DEPTH + j]
        for j in range(3):
            x[j] = -pull[0] * rise * seen.toward[i, j]
        for n in range(seen.start[i], seen.start[i + 1]):
            o = n - seen.start[i]
            if weights[n] <= 0.0:
                continue
            move, own = step[seen.frame[n]], change[seen.camera[n]]
            for a in range(2):
                moved = 0.0
                for p in range(n_shared):
                    moved += by_shared[o, a, p] * own[p]
                for p in range(6):
                    moved += by_pose[o, a, p] * move[p]
                for j in range(3):
                    x[j] += weights[n] * moved * by_point[o, a, j]
        s0 = slope[0] + root[0, 0] * x[0]
        s1 = slope[1] + root[1, 0] * x[0] + root[1, 1] * x[1]
        s2 = slope[2] + root[2, 0] * x[0] + root[2, 1] * x[1] + root[2, 2] * x[2]
        out[i, 0] -= root[0, 0] * s0 + root[1, 0] * s1 + root[2, 0] * s2
        out[i, 1] -= root[1, 1] * s1 + root[2, 1] * s2
        out[i, 2] -= root[2, 2] * s2
