"""Variance inflation from the scatter of groups of observations (cluster-robust covariance).

Errors are correlated along a landmark's track, among neighboring landmarks and, with calibration errors, among all
observations of one camera. Least squares assumes independent errors and underestimates the variance. The scatter of the
estimates of groups of observations measures the correlation: with independent noise, the parts x_g = A^-1 s_g of the
step, s_g the gradient of group g, have sum_g E[x_g x_g'] = A^-1 - sum_g A^-1 A_g A^-1 A_g A^-1, A_g its information.
The diagonal block of each frame is compared; the second term uses the frames' diagonal blocks of A and A_g.

Source: H. White, "Maximum likelihood estimation of misspecified models", 1982 (the sandwich), for groups: K.-Y. Liang,
S. L. Zeger, "Longitudinal data analysis using generalized linear models", 1986.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from sylpose.bundle_adjustment.group_scores import accumulate_group_scores
from sylpose.bundle_adjustment.kernels import SortedObservations, Views
from sylpose.bundle_adjustment.reduced_system import Solver, System
from sylpose.geometry.arrays import FloatArray

__all__ = ["add_second_order_terms", "compute_variance_inflation"]


# Frames of the running median (choice).
MEDIAN_FRAMES = 11
# Scatter of independent noise, relative to its expectation, where the calibration is estimated as well: each camera
# then has about as many unknowns as groups (measured: simulated tracks of benchmarks/calibration.py, 0.66 by regions,
# 0.69 by cameras).
CALIBRATED_SCATTER_RATIO = 0.67
# Minimum degrees of freedom of the groups per frame (choice).
MIN_DEGREES_OF_FREEDOM = 1.0


def compute_variance_inflation(
    observations: SortedObservations,
    views: Views,
    points: FloatArray,
    weights: FloatArray,
    landmark_prior: FloatArray,
    system: System,
    solver: Solver,
    covariance: FloatArray,
) -> FloatArray:
    """Return (F,) inflation of each frame's variance relative to the system of equations, at least 1.

    It increases with the distance from the fixed frames: correlated errors of neighboring frames add up.

    Regions of the object, an eighth of it as observed by one camera, disagree if errors are correlated along tracks and
    among neighbors; cameras disagree if the calibration is wrong as well. With few cameras neither is precise, so their
    excesses are added, which is conservative.

    Args:
        observations, views, points, weights, landmark_prior: as of the system at the optimum.
        system: the reduced system.
        solver: of the system, undamped.
        covariance: (F, 6, 6) of its frames.
    """
    moving = system.free[observations.frame] >= 0
    if not (moving & (weights > 0)).any():
        return np.ones(len(covariance))
    landmark = np.repeat(np.arange(len(points)), np.diff(observations.start))
    octant = (points > np.median(points, axis=0)) @ np.array([1, 2, 4])
    frames = len(covariance)
    excess, is_calibrated = np.zeros(frames), (system.parameters.kind > 0) & ~system.parameters.fixed
    noise_ratio = CALIBRATED_SCATTER_RATIO if is_calibrated.any() else 1.0
    # All observations of a landmark are in one group, because they share its position; this includes those of a camera
    # that was moved.
    camera = observations.first_viewer[landmark]
    for group in (8 * camera + octant[landmark], camera):
        group_names, group = np.unique(group, return_inverse=True)
        pose_gradients, shared_gradients = (
            np.zeros((frames, len(group_names), 6)),
            np.zeros((len(group_names), *views.parameters.shape)),
        )
        information = np.zeros((frames, len(group_names), 6, 6))
        accumulate_group_scores(
            observations, views, points, weights, landmark_prior, group, pose_gradients, shared_gradients, information
        )
        ratio = _scatter_ratio(pose_gradients, shared_gradients, information, system, solver, covariance, noise_ratio)
        excess += np.maximum(median_filter(ratio, MEDIAN_FRAMES, mode="nearest") - 1.0, 0.0)
    return 1.0 + excess


def _scatter_ratio(
    pose_gradients: FloatArray,
    shared_gradients: FloatArray,
    information: FloatArray,
    system: System,
    solver: Solver,
    covariance: FloatArray,
    noise_ratio: float,
) -> FloatArray:
    """Return (F,) scatter of the groups' parts relative to independent noise.

    Args:
        pose_gradients, shared_gradients, information: as of `accumulate_group_scores`.
    """
    frames, groups, _ = pose_gradients.shape
    right = np.ascontiguousarray(pose_gradients.transpose(0, 2, 1)).reshape(6 * frames, groups)
    slope = system.parameters.flat_basis.T @ shared_gradients.reshape(groups, -1).T
    parts = solver.solve(right, slope)[0].reshape(frames, 6, groups)
    scatter = np.einsum("kig,kig->k", parts, np.linalg.solve(covariance, parts))
    relative_information = np.linalg.solve(system.frame_blocks()[:, None], information)
    expected = 6.0 - np.einsum("kgij,kgji->k", relative_information, relative_information)
    ratio = np.ones(frames)
    np.divide(scatter, noise_ratio * expected, out=ratio, where=expected > MIN_DEGREES_OF_FREEDOM)
    return ratio


def add_second_order_terms(covariance: FloatArray, surface_covariance: FloatArray) -> FloatArray:
    """Add the second-order term of uncertain rotation and surface position to covariances (N, 6, 6) of (w, d).

    Images constrain the visible surface at p from the object's origin; so d has an error w x p. If both w and p are
    uncertain, that is a product of the two, which a linear covariance does not contain.

    Args:
        surface_covariance: (N, 3, 3) covariance of p.
    """
    cross = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(2, 0, 1)
    out = covariance.copy()
    out[:, 3:, 3:] += np.einsum(
        "abc,def,kbe,kcf->kad", cross, cross, covariance[:, :3, :3], surface_covariance, optimize=True
    )
    return out
