"""Shrinkage of noisy landmark depths, which otherwise overstate the information on small rotations.

The information on a rotation comes from relief: the distances of landmarks from their common plane. If the body hardly
rotates, the relief is unknown but still fitted to noise. The fitted relief then seems to determine the rotation, most
for a translating plane. So the information is computed with the most likely relief: with a relief variance, estimated
from all landmarks of a camera, and a noise variance per landmark, each relief is multiplied by the ratio of the first
to their sum.

Source: errors in variables, W. A. Fuller, "Measurement Error Models", 1987; unequal variances, B. Efron, C. Morris,
"Stein's estimation rule and its competitors", 1973; their use here is ours.
"""

from __future__ import annotations

import numpy as np

from sylpose.bundle_adjustment.kernels import (
    Linearization,
    eliminate_landmark,
    make_landmark_system,
)
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel

# Minimum number of landmarks for a plane fit: three would be exactly on it (choice).
MIN_LANDMARKS = 6
# Iterations of the estimate of the relief variance (choice).
MAX_ITERATIONS = 20


def shrink_depth_noise(at: Linearization) -> FloatArray:
    """Return the landmarks (m, 3) at the optimum with their relief shrunk by its noise."""
    observations, points, noise = at.observations, at.points, np.full(len(at.points), np.nan)
    compute_depth_noise(at, noise)
    depths = np.einsum("mi,mi->m", observations.depth_direction, points)
    change = np.zeros(len(points))
    for c in np.unique(observations.first_viewer):
        own = np.flatnonzero((observations.first_viewer == c) & np.isfinite(noise))
        if len(own) < MIN_LANDMARKS:
            continue
        plane = np.linalg.lstsq(observations.depth_basis[own], depths[own], rcond=None)[0]
        relief = depths[own] - observations.depth_basis[own] @ plane
        change[own] = -relief * noise[own] / (noise[own] + _estimate_residual_depth_variance(relief**2, noise[own]))
    return np.ascontiguousarray(points + change[:, None] * observations.depth_direction)


def _estimate_residual_depth_variance(squares: FloatArray, noise: FloatArray) -> float:
    """Estimate the variance of the relief from squares (n,) of noisy values with individual noise variances.

    It is close to zero where noise explains the squares.
    """
    out = float(np.median(squares))
    minimum = 1e-6 * (out + float(np.median(noise)))
    for _ in range(MAX_ITERATIONS):
        weights = (out + noise + minimum) ** -2.0
        out = max(float(weights @ (squares - noise) / weights.sum()), minimum)
    return out


@kernel
def compute_depth_noise(at: Linearization, out: FloatArray) -> None:
    """Write the noise variance of each landmark's depth, in its viewer's direction at known poses, to out (m,).

    Landmarks without a weighted observation are left unchanged.
    """
    system, v = make_landmark_system(at), np.empty(3)
    for i in range(at.points.shape[0]):
        if not eliminate_landmark(at, i, system):
            continue
        root, u = system.root, at.observations.depth_direction[i]
        # Change of the landmark per unit of gradient along u: V u, V = root' root.
        for j in range(3):
            v[j] = root[j, 0] * u[0] + root[j, 1] * u[1] + root[j, 2] * u[2]
        whole = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        size = 0.0
        for j in range(3):
            moved = root[0, j] * v[0] + root[1, j] * v[1] + root[2, j] * v[2]
            size += moved * moved
        # V without the contribution of the prior, V (V^-1 - P) V with P the prior's information, along u.
        out[i] = max(whole - at.prior[0] * whole * whole - at.prior[1] * size, 0.0)
