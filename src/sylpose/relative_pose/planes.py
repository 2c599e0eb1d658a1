"""Planes as depth models of flat objects, also if they are seen edge on.

Such a plane, and a rough surface that faces the camera, are two minima of the same motion.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky_solve, kernel
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.relative_pose.irls import IrlsFit, copy_fit, make_empty_irls_fit, run_constrained_irls
from sylpose.relative_pose.limits import SIGMA_FLOOR_PX
from sylpose.relative_pose.match_cost import InlierPrior
from sylpose.relative_pose.terms import Stack, copy_into, transform_to_camera

# An object is flat if residual depth and curvature displace points by less than this, in standard deviations of their
# noise (chi-squared, once in a thousand times).
MAX_FLAT_SIGMAS = float(np.sqrt(chi_squared_bound(1)))
# The prior of a slope is concave beyond this, in its standard deviations, and allows another minimum (derived).
CONCAVE_SLOPE = 1.0


@kernel
def is_flat(stack: Stack, fit: IrlsFit) -> bool:
    """Return whether the object appears flat in all cameras with inliers."""
    rotation, translation, depth_model = fit.candidate
    for t in range(len(stack.focal)):
        inliers, curvature, squares = 0, 0.0, 0.0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            inliers += fit.weights[i] > 0.0
        for k in range(3, 6):
            curvature = max(curvature, abs(depth_model[t, k]))
        for i in range(3):
            tau = translation[i] - stack.a2[t, i]
            for j in range(3):
                tau += rotation[i, j] * stack.a1[t, j]
            squares += tau * tau
        parallax = stack.inverse_depth[t] * np.sqrt(squares) * stack.focal[t] / fit.sigma_px[t]
        if inliers > 0 and (fit.residual_depth[t] + curvature) * parallax > MAX_FLAT_SIGMAS:
            return False
    return True


@kernel
def fit_edge_on(stack: Stack, usable: InlierPrior, fit: IrlsFit, must_be_flat: bool) -> tuple[int, float, float]:
    """Run re-weighted least squares, and again from steep planes if the inliers show them; keep the likelier fit, in place.

    The prior of the slopes has long tails: a plane that is seen edge on, and a rough surface that faces the camera, are
    two minima between which no step leads.

    Args:
        must_be_flat: whether steep planes count only if the object is flat with them. Otherwise they may explain the matches
            of two motions.

    Returns:
        as `run_irls`.
    """
    iterations, decrease, cost = run_constrained_irls(stack, usable, fit, SIGMA_FLOOR_PX, np.zeros(6))
    planes = np.empty_like(fit.candidate.depth_model)
    if not cost < np.inf or triangulate_planes(stack, fit, planes) <= CONCAVE_SLOPE:
        return iterations, decrease, cost
    edge_on = make_empty_irls_fit(stack)
    copy_into(edge_on.candidate, fit.candidate)
    edge_on.candidate.depth_model[:], edge_on.sigma_px[:] = planes, fit.sigma_px
    done, new_decrease, new_cost = run_constrained_irls(stack, usable, edge_on, SIGMA_FLOOR_PX, np.zeros(6))
    if not new_cost < cost or (must_be_flat and not is_flat(stack, edge_on)):
        return iterations + done, decrease, cost
    copy_fit(fit, edge_on)
    return iterations + done, new_decrease, new_cost


@kernel
def triangulate_planes(stack: Stack, fit: IrlsFit, planes: FloatArray) -> float:
    """Triangulate a fit's inliers with its motion, and fit a plane to those of each camera.

    The prior of the slopes is that the points are within the object's radius.

    Args:
        planes: (T, 6) receives them as depth models.

    Returns:
        the largest change of a slope of the fit, in standard deviations of its prior.
    """
    rc, tc, rotated, largest = np.empty((3, 3)), np.empty(3), np.empty(3), 0.0
    matrix, right, row = np.empty((3, 3)), np.empty(3), np.ones(3)
    for t in range(len(planes)):
        transform_to_camera(stack, t, fit.candidate, rc, tc, rotated)
        prior, count = stack.depth_model_information[t], 0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            count += fit.weights[i] > 0.0
        matrix[:], right[:], planes[t] = 0.0, 0.0, stack.depth_model_mean[t]
        matrix[0, 0], right[0] = prior[0, 0], prior[0, 0] * planes[t, 0]
        variance, within_radius = (fit.sigma_px[t] / stack.focal[t]) ** 2, (2.0 * stack.spread[t]) ** -2 / max(count, 1)
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if not fit.weights[i] > 0.0:
                continue
            x0, x1, y0, y1 = stack.x[i, 0], stack.x[i, 1], stack.y[i, 0], stack.y[i, 1]
            row[1], row[2] = (x0 - stack.anchor[t, 0]) / stack.spread[t], (x1 - stack.anchor[t, 1]) / stack.spread[t]
            v0, v1 = rc[0, 0] * x0 + rc[0, 1] * x1 + rc[0, 2], rc[1, 0] * x0 + rc[1, 1] * x1 + rc[1, 2]
            v2 = rc[2, 0] * x0 + rc[2, 1] * x1 + rc[2, 2]
            # (y0, y1, 1) is parallel to v + ρ τ: a ρ = b, two equations of one unknown.
            a0, a1 = stack.inverse_depth[t] * (tc[0] - y0 * tc[2]), stack.inverse_depth[t] * (tc[1] - y1 * tc[2])
            square, product = a0 * a0 + a1 * a1, a0 * (y0 * v2 - v0) + a1 * (y1 * v2 - v1)
            weight = 1.0 / (variance * v2 * v2 + stack.residual_depth[t] ** 2 * square)
            for j in range(3):
                right[j] += weight * product * row[j]
                for k in range(3):
                    matrix[j, k] += (weight * square + (within_radius if min(j, k) > 0 else 0.0)) * row[j] * row[k]
        if not cholesky_solve(matrix, right):
            continue  # too few inliers
        planes[t, :3], planes[t, 3:] = right, 0.0
        for j in range(1, 3):
            change = abs(right[j] - fit.candidate.depth_model[t, j])
            largest = max(largest, change * np.sqrt(prior[j, j]))
    return largest
