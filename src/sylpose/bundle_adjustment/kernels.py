"""Compiled loops of the joint refinement: residuals, their derivatives, and each landmark's own small system.

Observations are sorted by landmark, then by frame. A landmark X of the object is seen by camera c in frame k at
p = M (R X) + b, M = Q E and b = Q (t + u - o), where E and u carry frame k's pose to the camera's own instant.

Beside the frames' poses there are unknowns that each camera has once for all frames, its *shared* ones: the columns
`OFFSET`, `DEPTH`, `TURN`, `SHIFT` and `LENS` below. What is believed of them, and which are free, `shared` says.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel

__all__ = [
    "BEHIND_PX",
    "DEPTH",
    "LENS",
    "OFFSET",
    "SHIFT",
    "TURN",
    "Sightings",
    "Views",
    "above_surface",
    "derivatives",
    "eliminated",
    "longest_track",
    "pixels",
    "residuals",
]


# What is behind a camera is this far from where it is seen, pixels: an outlier at any noise (choice).
BEHIND_PX = 1e6
# A camera's shared unknowns (derived: they follow each other): seconds by which it is late; how far in front of the
# object's origin the surface is that it sees, and by how much that rises to the right and downwards; then, only where its
# calibration is in question, its turn (camera's axes) and the shift of its centre (world's axes), and its lens.
OFFSET, DEPTH, TURN, SHIFT, LENS = 0, 1, 4, 7, 10


class Sightings(NamedTuple):
    """n observations of m landmarks.

    Attributes:
        start: (m + 1,) landmark i has the observations start[i] to start[i + 1].
        frame, camera: (n,), frames not falling within a landmark.
        image: (n, 2) normalised.
        lens: (n, 3, L) by what the normalised point moves with the camera's L unknowns of the lens, and by what share what
            is one pixel there; L may be 0.
        free: (N,) number of each frame among those that move, rising, or -1 for a frame that is fixed.
        viewer: (m,) the camera that saw a landmark first.
        toward: (m, 3) unit vector from the object's origin towards it then, object's frame.
        across: (m, 3) 1, and how far a landmark is to the right and below as seen by it: what its depth is linear in.
    """

    start: IntArray
    frame: IntArray
    camera: IntArray
    image: FloatArray
    lens: FloatArray
    free: IntArray
    viewer: IntArray
    toward: FloatArray
    across: FloatArray


class Views(NamedTuple):
    """N frames as C cameras see them.

    Attributes:
        turns: (N, 3, 3) R of world_from_object.
        carried: (N, C, 3, 3) M; place: (N, C, 3) b, see the module.
        spin, drift: (N, C, 3) the object's angular velocity and its origin's velocity, camera's axes, per second.
        rotations: (C, 3, 3) Q of camera_from_world; twists: (C, 3, 3) what its rotation vector's change turns it by.
        focals: (C,) pixels.
        shared: (C, K) the cameras' shared unknowns.
    """

    turns: FloatArray
    carried: FloatArray
    place: FloatArray
    spin: FloatArray
    drift: FloatArray
    rotations: FloatArray
    twists: FloatArray
    focals: FloatArray
    shared: FloatArray


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
                focal = views.focals[c] * pixels(seen, views, n)
                for a in range(2):
                    p = m[a, 0] * y[0] + m[a, 1] * y[1] + m[a, 2] * y[2] + b[a]
                    image = seen.image[n, a]
                    for j in range(seen.lens.shape[2]):
                        image += seen.lens[n, a, j] * views.shared[c, LENS + j]
                    out[n, a] = focal * (p / z - image)
            else:
                out[n, 0], out[n, 1] = BEHIND_PX, 0.0


@kernel
def pixels(seen: Sightings, views: Views, n: int) -> float:
    """By what a pixel of observation n is larger than with the lens as given.

    Without this, a longer focal length would make all residuals less, and be found.
    """
    out, c = 1.0, seen.camera[n]
    for j in range(seen.lens.shape[2]):
        out += seen.lens[n, 2, j] * views.shared[c, LENS + j]
    return out


@kernel
def derivatives(
    seen: Sightings,
    views: Views,
    point: FloatArray,
    n: int,
    e: FloatArray,
    by_pose: FloatArray,
    by_shared: FloatArray,
    by_point: FloatArray,
) -> None:
    """One observation's residual (2,) and its derivatives by (w, d) (2, 6), by its camera's shared unknowns (2, K) and by
    the landmark (2, 3), pixels.

    The landmark must be in front of the camera. The columns `DEPTH` are left alone: no residual depends on them.
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
    p0, p1, z = g0 + b[0], g1 + b[1], g2 + b[2]
    larger = pixels(seen, views, n)
    focal = views.focals[c] * larger
    scale = focal / z
    # How the point moves in the camera's axes while time passes.
    v0 = spin[1] * g2 - spin[2] * g1 + drift[0]
    v1 = spin[2] * g0 - spin[0] * g2 + drift[1]
    v2 = spin[0] * g1 - spin[1] * g0 + drift[2]
    calibrated = views.shared.shape[1] > TURN
    for a in range(2):
        image = (p0 if a == 0 else p1) / z
        seen_at = seen.image[n, a]
        h0 = scale * (m[a, 0] - image * m[2, 0])
        h1 = scale * (m[a, 1] - image * m[2, 1])
        h2 = scale * (m[a, 2] - image * m[2, 2])
        by_pose[a, 0] = y1 * h2 - y2 * h1
        by_pose[a, 1] = y2 * h0 - y0 * h2
        by_pose[a, 2] = y0 * h1 - y1 * h0
        for j in range(3):
            by_pose[a, 3 + j] = scale * (q[a, j] - image * q[2, j])
            by_point[a, j] = h0 * r[0, j] + h1 * r[1, j] + h2 * r[2, j]
        by_shared[a, OFFSET] = scale * ((v0 if a == 0 else v1) - image * v2)
        if calibrated:
            # By p it is scale (1, 0, -image) or scale (0, 1, -image), and p moves by the turn x p.
            x, y = (scale, 0.0) if a == 0 else (0.0, scale)
            t0 = -p1 * scale * image - z * y
            t1 = z * x + p0 * scale * image
            t2 = p0 * y - p1 * x
            for j in range(3):
                twist = views.twists[c]
                by_shared[a, TURN + j] = t0 * twist[0, j] + t1 * twist[1, j] + t2 * twist[2, j]
                by_shared[a, SHIFT + j] = -by_pose[a, 3 + j]
            for j in range(seen.lens.shape[2]):
                seen_at += seen.lens[n, a, j] * views.shared[c, LENS + j]
                by_shared[a, LENS + j] = -focal * seen.lens[n, a, j]
        e[a] = focal * (image - seen_at)
        for j in range(seen.lens.shape[2]):
            by_shared[a, LENS + j] += e[a] * seen.lens[n, 2, j] / larger


@kernel
def eliminated(
    seen: Sightings,
    views: Views,
    point: FloatArray,
    i: int,
    weights: FloatArray,
    pull: FloatArray,
    e: FloatArray,
    by_pose: FloatArray,
    by_shared: FloatArray,
    by_point: FloatArray,
    root: FloatArray,
    slope: FloatArray,
) -> bool:
    """All that concerns landmark i: its observations' residuals and derivatives, and the landmark's own 3x3 system.

    root (3, 3) becomes the inverse of the Cholesky factor of its information, slope (3,) root times its gradient.

    Args:
        pull: (2,) information, 1/length², that its depth is that of the surface, and that it is at the origin.

    Returns:
        False where no observation has weight: the landmark then stays where it is.
    """
    first, last = seen.start[i], seen.start[i + 1]
    u, r = seen.toward[i], pull[0] * above_surface(seen, views, point, i)
    v00, v11, v22 = pull[1] + pull[0] * u[0] * u[0], pull[1] + pull[0] * u[1] * u[1], pull[1] + pull[0] * u[2] * u[2]
    v10, v20, v21 = pull[0] * u[1] * u[0], pull[0] * u[2] * u[0], pull[0] * u[2] * u[1]
    g0, g1, g2 = pull[1] * point[0] + r * u[0], pull[1] * point[1] + r * u[1], pull[1] * point[2] + r * u[2]
    used = False
    for n in range(first, last):
        w = weights[n]
        if w <= 0.0:
            continue
        used = True
        o = n - first
        derivatives(seen, views, point, n, e[o], by_pose[o], by_shared[o], by_point[o])
        for a in range(2):
            x, y, z = by_point[o, a]
            r = w * e[o, a]
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
def above_surface(seen: Sightings, views: Views, point: FloatArray, i: int) -> float:
    """How much nearer than its viewer's surface a landmark is to its viewer."""
    u, height = seen.toward[i], views.shared[seen.viewer[i]]
    out: float = u[0] * point[0] + u[1] * point[1] + u[2] * point[2]
    for j in range(3):
        out -= seen.across[i, j] * height[DEPTH + j]
    return out


@kernel
def longest_track(start: IntArray) -> int:
    longest = 0
    for i in range(start.shape[0] - 1):
        longest = max(longest, start[i + 1] - start[i])
    return longest
