"""Honest covariances: inflation by the scatter of groups of observations, and shrinkage of noisy landmark depths.

Errors are correlated along a landmark's track, among neighboring landmarks and, with calibration errors, among all
observations of one camera. Least squares assumes independent errors and underestimates the variance. The scatter of the
estimates of groups of observations measures the correlation: with independent noise, the parts x_g = A^-1 s_g of the
step, s_g the gradient of group g, have sum_g E[x_g x_g'] = A^-1 - sum_g A^-1 A_g A^-1 A_g A^-1, A_g its information.
The diagonal block of each frame is compared; the second term uses the frames' diagonal blocks of A and A_g.

The information on a rotation comes from relief: the distances of landmarks from their common plane. If the body hardly
rotates, the relief is unknown but still fitted to noise. The fitted relief then seems to determine the rotation, most
for a translating plane. So the information is computed with the most likely relief: with a relief variance, estimated
from all landmarks of a camera, and a noise variance per landmark, each relief is multiplied by the ratio of the first
to their sum (`shrink_depth_noise`).

Source: H. White, "Maximum likelihood estimation of misspecified models", 1982 (the sandwich), for groups: K.-Y. Liang,
S. L. Zeger, "Longitudinal data analysis using generalized linear models", 1986; errors in variables, W. A. Fuller,
"Measurement Error Models", 1987; unequal variances, B. Efron, C. Morris, "Stein's estimation rule and its competitors",
1973; the use of the last two is ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from sylpose.bundle_adjustment.kernels import Linearization, eliminate_landmark, make_landmark_system
from sylpose.bundle_adjustment.reduced_system import Solver, System, whiten
from sylpose.geometry.arrays import FloatArray, IntArray
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


# Frames of the running median (choice).
MEDIAN_FRAMES = 11
# Scatter of independent noise, relative to its expectation, where the calibration is estimated as well: each camera
# then has about as many unknowns as groups (measured: simulated tracks of benchmarks/calibration.py, 0.66 by regions,
# 0.69 by cameras).
CALIBRATED_SCATTER_RATIO = 0.67
# Minimum degrees of freedom of the groups per frame (choice).
MIN_DEGREES_OF_FREEDOM = 1.0


class _Sums(NamedTuple):
    """Contributions of G groups of observations to the reduced system.

    Attributes:
        pose_gradients, shared_gradients: (F, G, 6), (G, C, K) gradients.
        information: (F, G, 6, 6) information of each group on each frame.
    """

    pose_gradients: FloatArray
    shared_gradients: FloatArray
    information: FloatArray


def compute_variance_inflation(at: Linearization, system: System, solver: Solver, covariance: FloatArray) -> FloatArray:
    """Return (F,) inflation of each frame's variance relative to the system of equations, at least 1.

    It increases with the distance from the fixed frames: correlated errors of neighboring frames add up.

    Regions of the object, an eighth of it as observed by one camera, disagree if errors are correlated along tracks and
    among neighbors; cameras disagree if the calibration is wrong as well. With few cameras neither is precise, so their
    excesses are added, which is conservative.

    Args:
        at: the optimum.
        system: the reduced system.
        solver: of the system, undamped.
        covariance: (F, 6, 6) of its frames.
    """
    observations, points, frames = at.observations, at.points, len(covariance)
    moving = system.free[observations.frame] >= 0
    if not (moving & (at.weights > 0)).any():
        return np.ones(frames)
    landmark = np.repeat(np.arange(len(points)), np.diff(observations.start))
    # Along the principal axes, so that the result does not depend on the world frame.
    centered = points - points.mean(axis=0)
    along = centered @ np.linalg.eigh(centered.T @ centered)[1]
    octant = (along > np.median(along, axis=0)) @ np.array([1, 2, 4])
    excess, is_calibrated = np.zeros(frames), system.parameters.is_calibration & ~system.parameters.fixed
    noise_ratio = CALIBRATED_SCATTER_RATIO if is_calibrated.any() else 1.0
    # All observations of a landmark are in one group, because they share its position; this includes those of a camera
    # that was moved.
    regions, group = np.unique((8 * observations.first_viewer + octant)[landmark], return_inverse=True)
    n, shared_shape = len(regions), at.views.parameters.shape
    by_region = _Sums(np.zeros((frames, n, 6)), np.zeros((n, *shared_shape)), np.zeros((frames, n, 6, 6)))
    _accumulate_group_scores(at, group, by_region)
    first = np.unique(regions // 8, return_index=True)[1]  # each camera's first region
    by_camera = _Sums(*(np.add.reduceat(total, first, axis) for total, axis in zip(by_region, (1, 0, 1), strict=True)))
    for sums in (by_region, by_camera):
        ratio = _scatter_ratio(sums, system, solver, covariance, noise_ratio)
        excess += np.maximum(median_filter(ratio, MEDIAN_FRAMES, mode="nearest") - 1.0, 0.0)
    return 1.0 + excess


def _scatter_ratio(sums: _Sums, system: System, solver: Solver, covariance: FloatArray, scale: float) -> FloatArray:
    """Return (F,) scatter of the groups' parts relative to independent noise."""
    frames, groups, _ = sums.pose_gradients.shape
    right = np.ascontiguousarray(sums.pose_gradients.transpose(0, 2, 1)).reshape(6 * frames, groups)
    slope = system.parameters.flat_basis.T @ sums.shared_gradients.reshape(groups, -1).T
    parts = solver.solve(right, slope)[0].reshape(frames, 6, groups)
    scatter = np.einsum("kig,kig->k", parts, np.linalg.solve(covariance, parts))
    relative_information = np.linalg.solve(system.frame_blocks()[:, None], sums.information)
    expected = 6.0 - np.einsum("kgij,kgji->k", relative_information, relative_information)
    ratio = np.ones(frames)
    np.divide(scatter, scale * expected, out=ratio, where=expected > MIN_DEGREES_OF_FREEDOM)
    return ratio


@kernel
def _accumulate_group_scores(at: Linearization, group: IntArray, sums: _Sums) -> None:
    """Add the contributions of groups of observations to sums that start at zero; group (n,) of each observation."""
    system, observations, rows, poses = make_landmark_system(at), at.observations, np.empty((3, 2)), np.empty((3, 6))
    e, pose_jacobian, shared_jacobian, point_jacobian, root, slope = system
    for i in range(at.points.shape[0]):
        if not eliminate_landmark(at, i, system):
            continue
        first = observations.start[i]
        for n in range(first, observations.start[i + 1]):
            w = at.weights[n]
            if w <= 0.0:
                continue
            o, k, c, g = n - first, observations.free_index[observations.frame[n]], observations.camera[n], group[n]
            poses[:] = 0.0
            whiten(point_jacobian[o], root, rows)
            for a in range(2):
                r = w * (e[o, a] - rows[0, a] * slope[0] - rows[1, a] * slope[1] - rows[2, a] * slope[2])
                for p in range(shared_jacobian.shape[2]):
                    sums.shared_gradients[g, c, p] += shared_jacobian[o, a, p] * r
                if k < 0:
                    continue
                for p in range(6):
                    sums.pose_gradients[k, g, p] += pose_jacobian[o, a, p] * r
                    for j in range(3):
                        poses[j, p] += w * pose_jacobian[o, a, p] * rows[j, a]
            if k < 0:
                continue
            j0, j1 = pose_jacobian[o, 0], pose_jacobian[o, 1]
            for p in range(6):
                for q in range(6):
                    used = poses[0, p] * poses[0, q] + poses[1, p] * poses[1, q] + poses[2, p] * poses[2, q]
                    sums.information[k, g, p, q] += w * (j0[p] * j0[q] + j1[p] * j1[q]) - used


def add_second_order_terms(covariance: FloatArray, surface_covariance: FloatArray) -> FloatArray:
    """Add the second-order term of uncertain rotation and surface position to covariances (N, 6, 6) of (w, d).

    Images constrain the visible surface at p from the object's origin; so d has an error w x p. If both w and p are
    uncertain, that is a product of the two, which a linear covariance does not contain.

    Args:
        surface_covariance: (N, 3, 3) covariance of p.
    """
    cross = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(2, 0, 1)
    out, parts = covariance.copy(), (cross, cross, covariance[:, :3, :3], surface_covariance)
    out[:, 3:, 3:] += np.einsum("abc,def,kbe,kcf->kad", *parts, optimize=True)
    return out
