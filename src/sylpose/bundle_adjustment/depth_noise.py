"""What of the landmarks' relief is only noise: without it they tell less of small turns.

A turn is told by relief: by how far landmarks are in front of, or behind, the plane that goes through them. Of a body that
has hardly turned that is not known, but fitted all the same, from the noise of where it is seen, and seems to tell the turn:
of a plane that is only displaced, the more the more wrong it is. So the information is that of landmarks with the relief
that is likeliest: if relief has a variance of its own, found from all landmarks of a camera, and one's noise another, each
has only the share of it that the first has in the sum.

Source: errors in variables, W. A. Fuller, "Measurement Error Models", 1987; unequal variances, B. Efron, C. Morris, "Stein's
estimation rule and its competitors", 1973; their use here is ours.
"""

from __future__ import annotations

import numpy as np

from sylpose.bundle_adjustment.kernels import Sightings, Views, eliminated, longest_track
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel

__all__ = ["without_noise"]

# Landmarks that a plane is put through, at least: three would lie on it (choice).
FEWEST = 6
# Rounds in which the relief's own variance is found (choice).
ROUNDS = 20


def without_noise(
    seen: Sightings, views: Views, points: FloatArray, weights: FloatArray, pull: FloatArray
) -> FloatArray:
    """Landmarks (m, 3) with the relief that those at `points` have but for noise.

    Args: as of `elimination.reduce`, at the optimum.
    """
    noise = np.full(len(points), np.nan)
    relief_noise(seen, views, points, weights, pull, noise)
    above = np.einsum("mi,mi->m", seen.toward, points)
    change = np.zeros(len(points))
    for c in np.unique(seen.viewer):
        mine = np.flatnonzero((seen.viewer == c) & np.isfinite(noise))
        if len(mine) < FEWEST:
            continue
        plane = np.linalg.lstsq(seen.across[mine], above[mine], rcond=None)[0]
        relief = above[mine] - seen.across[mine] @ plane
        change[mine] = -relief * noise[mine] / (noise[mine] + _scatter(relief**2, noise[mine]))
    return np.ascontiguousarray(points + change[:, None] * seen.toward)


def _scatter(squares: FloatArray, noise: FloatArray) -> float:
    """Variance of the relief itself, of squares (n,) of it that noise has a part in, of a variance of its own each; next to
    nothing where noise explains them."""
    out = float(np.median(squares))
    least = 1e-6 * (out + float(np.median(noise)))
    for _ in range(ROUNDS):
        weights = (out + noise + least) ** -2.0
        out = max(float(weights @ (squares - noise) / weights.sum()), least)
    return out


@kernel
def relief_noise(
    seen: Sightings, views: Views, points: FloatArray, weights: FloatArray, pull: FloatArray, out: FloatArray
) -> None:
    """out (m,) becomes the variance that noise gives each landmark's distance, as seen by its viewer, at known poses; those
    without an observation of weight are left out."""
    longest, n_shared = longest_track(seen.start), views.shared.shape[1]
    e, by_pose, by_point = np.empty((longest, 2)), np.empty((longest, 2, 6)), np.empty((longest, 2, 3))
    by_shared = np.zeros((longest, 2, n_shared))
    root, slope, v = np.zeros((3, 3)), np.empty(3), np.empty(3)
    for i in range(points.shape[0]):
        if not eliminated(seen, views, points[i], i, weights, pull, e, by_pose, by_shared, by_point, root, slope):
            continue
        u = seen.toward[i]
        # By how much the landmark moves for each unit that its distance is asked to change: V u, V = root' root.
        for j in range(3):
            v[j] = root[j, 0] * u[0] + root[j, 1] * u[1] + root[j, 2] * u[2]
        whole = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        size = 0.0
        for j in range(3):
            moved = root[0, j] * v[0] + root[1, j] * v[1] + root[2, j] * v[2]
            size += moved * moved
        # V less what it owes to beliefs, V (V^-1 - pull) V, along u.
        out[i] = max(whole - pull[0] * whole * whole - pull[1] * size, 0.0)
