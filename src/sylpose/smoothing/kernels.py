"""Compiled loops of the joint refinement: residuals, the system that is left without landmarks, and back.

Observations are sorted by landmark, then by frame. A landmark X of the object is seen by camera c in frame k at
p = M (R X) + b, M = Q E and b = Q (t + u - o), where E and u carry frame k's pose to the camera's own instant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.numerics.arrays import FloatArray, IntArray
from sylpose.numerics.compiled import kernel

__all__ = [
    "BEHIND_PX",
    "Reduced",
    "Sightings",
    "Views",
    "derivatives",
    "eliminated",
    "longest_track",
    "reduce",
    "residuals",
    "substitute",
]


# What is behind a camera is this far from where it is seen, pixels: an outlier at any noise (choice).
BEHIND_PX = 1e6


class Sightings(NamedTuple):
    """n observations of m landmarks.

    Attributes:
        start: (m + 1,) landmark i has the observations start[i] to start[i + 1].
        frame, camera: (n,), frames not falling within a landmark.
        image: (n, 2) normalised.
        free: (N,) number of each frame among those that move, rising, or -1 for a frame that is fixed.
    """

    start: IntArray
    frame: IntArray
    camera: IntArray
    image: FloatArray
    free: IntArray


class Views(NamedTuple):
    """N frames as C cameras see them.

    Attributes:
        turns: (N, 3, 3) R of world_from_object.
        carried: (N, C, 3, 3) M; place: (N, C, 3) b, see the module.
        spin, drift: (N, C, 3) the object's angular velocity and its origin's velocity, camera's axes, per second.
        rotations: (C, 3, 3) Q of camera_from_world.
        focals: (C,) pixels.
    """

    turns: FloatArray
    carried: FloatArray
    place: FloatArray
    spin: FloatArray
    drift: FloatArray
    rotations: FloatArray
    focals: FloatArray


class Reduced(NamedTuple):
    """Normal equations of F free frames and T time offsets, landmarks eliminated: filled by `reduce`.

    Attributes:
        indptr (F + 1,), columns: the blocks' pattern, lower triangle by rows, columns rising, the diagonal last.
        blocks: (k, 6, 6) of frames with frames.
        gradient: (F, 6).
        border: (F, 6, T) of frames with offsets; T is 0 or the number of cameras.
        corner: (T, T) of offsets with offsets; slope: (T,) their gradient.
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
def residuals(seen: Sightings, views: Views, points: FloatArray, out: FloatArray) -> None:
    """out (n, 2) becomes where landmarks (m, 3) project to minus where they are seen, pixels."""
    y = np.empty(3)
    for i in range(points.shape[0]):
        for n in range(seen.start[i], seen.start[i + 1]):
            k, c = seen.frame[n], seen.camera[n]
            r, m, b = views.turns[k], views.carried[k, c], views.place[k, c]
            for a in range(3):
                y[a] = r[a, 0] * points[i, 0] + r[a, 1] * points[i, 1] + r[a, 2] * points[i, 2]
            z = m[2, 0] * y[0] + m[2, 1] * y[1] + m[2, 2] * y[2] + b[2]
            if z > 1e-9:
                for a in range(2):
                    p = m[a, 0] * y[0] + m[a, 1] * y[1] + m[a, 2] * y[2] + b[a]
                    out[n, a] = views.focals[c] * (p / z - seen.image[n, a])
            else:
                out[n, 0], out[n, 1] = BEHIND_PX, 0.0


@kernel
def derivatives(
    seen: Sightings, views: Views, point: FloatArray, n: int, e: FloatArray, by_pose: FloatArray, by_point: FloatArray
) -> None:
    """One observation's residual (2,) and its derivatives by (w, d, offset) (2, 7) and by the landmark (2, 3), pixels.

    The landmark must be in front of the camera.
    """
    k, c = seen.frame[n], seen.camera[n]
    r, m, b, q = views.turns[k], views.carried[k, c], views.place[k, c], views.rotations[c]
    spin, drift = views.spin[k, c], views.drift[k, c]
    y0 = r[0, 0] * point[0] + r[0, 1] * point[1] + r[0, 2] * point[2]
    y1 = r[1, 0] * point[0] + r[1, 1] * point[1] + r[1, 2] * point[2]
    y2 = r[2, 0] * point[0] + r[2, 1] * point[1] + r[2, 2] * point[2]
    g0 = m[0, 0] * y0 + m[0, 1] * y1 + m[0, 2] * y2
    g1 = m[1, 0] * y0 + m[1, 1] * y1 + m[1, 2] * y2
    g2 = m[2, 0] * y0 + m[2, 1] * y1 + m[2, 2] * y2
    z = g2 + b[2]
    scale = views.focals[c] / z
    # How the point moves in the camera's axes while time passes.
    v0 = spin[1] * g2 - spin[2] * g1 + drift[0]
    v1 = spin[2] * g0 - spin[0] * g2 + drift[1]
    v2 = spin[0] * g1 - spin[1] * g0 + drift[2]
    for a in range(2):
        image = ((g0 if a == 0 else g1) + b[a]) / z
        e[a] = views.focals[c] * (image - seen.image[n, a])
        h0 = scale * (m[a, 0] - image * m[2, 0])
        h1 = scale * (m[a, 1] - image * m[2, 1])
        h2 = scale * (m[a, 2] - image * m[2, 2])
        by_pose[a, 0] = y1 * h2 - y2 * h1
        by_pose[a, 1] = y2 * h0 - y0 * h2
        by_pose[a, 2] = y0 * h1 - y1 * h0
        for j in range(3):
            by_pose[a, 3 + j] = scale * (q[a, j] - image * q[2, j])
            by_point[a, j] = h0 * r[0, j] + h1 * r[1, j] + h2 * r[2, j]
        by_pose[a, 6] = scale * ((v0 if a == 0 else v1) - image * v2)


@kernel
def eliminated(
    seen: Sightings,
    views: Views,
    point: FloatArray,
    i: int,
    weights: FloatArray,
    prior: float,
    e: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
    root: FloatArray,
    slope: FloatArray,
) -> bool:
    """All that concerns landmark i: its observations' residuals and derivatives, and the landmark's own 3x3 system.

    root (3, 3) becomes the inverse of the Cholesky factor of its information, slope (3,) root times its gradient.

    Returns:
        False where no observation has weight: the landmark then stays where it is.
    """
    first, last = seen.start[i], seen.start[i + 1]
    v00 = v11 = v22 = prior
    v10 = v20 = v21 = 0.0
    g0, g1, g2 = prior * point[0], prior * point[1], prior * point[2]
    used = False
    for n in range(first, last):
        w = weights[n]
        if w <= 0.0:
            continue
        used = True
        derivatives(seen, views, point, n, e[n - first], by_pose[n - first], by_point[n - first])
        for a in range(2):
            x, y, z = by_point[n - first, a]
            r = w * e[n - first, a]
            v00 += w * x * x
            v10 += w * y * x
            v11 += w * y * y
            v20 += w * z * x
            v21 += w * z * y
            v22 += w * z * z
            g0 += r * x
            g1 += r * y
            g2 += r * z
    l00 = np.sqrt(v00)
    l10, l20 = v10 / l00, v20 / l00
    l11 = np.sqrt(v11 - l10 * l10)
    l21 = (v21 - l20 * l10) / l11
    l22 = np.sqrt(v22 - l20 * l20 - l21 * l21)
    root[0, 0], root[1, 1], root[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / l22
    root[1, 0] = -l10 / (l00 * l11)
    root[2, 1] = -l21 / (l11 * l22)
    root[2, 0] = (l10 * l21 - l20 * l11) / (l00 * l11 * l22)
    slope[0] = root[0, 0] * g0
    slope[1] = root[1, 0] * g0 + root[1, 1] * g1
    slope[2] = root[2, 0] * g0 + root[2, 1] * g1 + root[2, 2] * g2
    return used


@kernel
def longest_track(start: IntArray) -> int:
    longest = 0
    for i in range(start.shape[0] - 1):
        longest = max(longest, start[i + 1] - start[i])
    return longest


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
def reduce(seen: Sightings, views: Views, points: FloatArray, weights: FloatArray, prior: float, out: Reduced) -> None:
    """The reduced system `out`, which must be zero at the start.

    Args:
        points: (m, 3) landmarks.
        weights: (n,) of the squared residuals, 1/pixels²; 0 for what is behind its camera.
        prior: information, per coordinate, that landmarks lie at the origin.
    """
    longest, n_offsets = longest_track(seen.start), out.corner.shape[0]
    e, by_pose, by_point = np.empty((longest, 2)), np.empty((longest, 2, 7)), np.empty((longest, 2, 3))
    root, slope = np.zeros((3, 3)), np.empty(3)
    # Of each of the landmark's frames, and of each camera's offset: its rows with the landmark, in the landmark's terms.
    frames, shared = np.empty(longest, np.int64), np.empty((longest, 3, 6))
    timed = np.zeros((n_offsets, 3))
    rows, za = np.empty((3, 2)), np.empty((3, 6))
    columns, blocks, gradient = out.columns, out.blocks, out.gradient
    for i in range(points.shape[0]):
        if not eliminated(seen, views, points[i], i, weights, prior, e, by_pose, by_point, root, slope):
            continue
        first, count, previous = seen.start[i], 0, -1
        timed[:] = 0.0
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
            if n_offsets > 0:
                t0, t1 = by_pose[o, 0, 6], by_pose[o, 1, 6]
                out.corner[c, c] += w * (t0 * t0 + t1 * t1)
                out.slope[c] += w * (t0 * e[o, 0] + t1 * e[o, 1])
                for j in range(3):
                    timed[c, j] += w * (rows[j, 0] * t0 + rows[j, 1] * t1)
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
                if n_offsets > 0:
                    out.border[k, p, c] += j0 * by_pose[o, 0, 6] + j1 * by_pose[o, 1, 6]
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
            for c in range(n_offsets):
                for p in range(6):
                    out.border[row, p, c] -= za[0, p] * timed[c, 0] + za[1, p] * timed[c, 1] + za[2, p] * timed[c, 2]
        for c in range(n_offsets):
            out.slope[c] -= timed[c, 0] * slope[0] + timed[c, 1] * slope[1] + timed[c, 2] * slope[2]
            for d in range(n_offsets):
                out.corner[c, d] -= timed[c, 0] * timed[d, 0] + timed[c, 1] * timed[d, 1] + timed[c, 2] * timed[d, 2]


@kernel
def substitute(
    seen: Sightings,
    views: Views,
    points: FloatArray,
    weights: FloatArray,
    prior: float,
    step: FloatArray,
    offsets: FloatArray,
    out: FloatArray,
) -> None:
    """out (m, 3) becomes the landmarks that belong to steps of the frames (N, 6) and of the cameras' offsets (C,).

    Args: the rest as in `reduce`, whose derivatives are made again here: keeping them would cost memory, not making them
        little time.
    """
    longest = longest_track(seen.start)
    e, by_pose, by_point = np.empty((longest, 2)), np.empty((longest, 2, 7)), np.empty((longest, 2, 3))
    root, slope, x = np.zeros((3, 3)), np.empty(3), np.empty(3)
    for i in range(points.shape[0]):
        out[i] = points[i]
        if not eliminated(seen, views, points[i], i, weights, prior, e, by_pose, by_point, root, slope):
            continue
        x[:] = 0.0
        for n in range(seen.start[i], seen.start[i + 1]):
            o = n - seen.start[i]
            if weights[n] <= 0.0:
                continue
            move = step[seen.frame[n]]
            for a in range(2):
                change = by_pose[o, a, 6] * offsets[seen.camera[n]]
                for p in range(6):
                    change += by_pose[o, a, p] * move[p]
                for j in range(3):
                    x[j] += weights[n] * change * by_point[o, a, j]
        s0 = slope[0] + root[0, 0] * x[0]
        s1 = slope[1] + root[1, 0] * x[0] + root[1, 1] * x[1]
        s2 = slope[2] + root[2, 0] * x[0] + root[2, 1] * x[1] + root[2, 2] * x[2]
        out[i, 0] -= root[0, 0] * s0 + root[1, 0] * s1 + root[2, 0] * s2
        out[i, 1] -= root[1, 1] * s1 + root[2, 1] * s2
        out[i, 2] -= root[2, 2] * s2
