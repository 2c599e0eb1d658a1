"""One camera's part of `alignment`: its normal equations for the pose, with its own unknowns eliminated.

All rows are in the camera's axes; only their sums are rotated into the world's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.normal_equations import add_rotated, compute_image_row, eliminate_block, rotate_rows
from sylpose.geometry.numba_linalg import kernel
from sylpose.geometry.robust_loss import SIGMA_OF_MEDIAN, bisquare

# Cutoff of the bisquare weights, in standard deviations: 93 % efficient for Gaussian noise in both coordinates
# (choice).
CUTOFF = 4.7
# Poses are compared by the robust cost at this noise, pixels, whatever their estimated noise (choice).
REFERENCE_NOISE_PX = 0.5
# Depths of neighbors have correlated errors: only so many of a camera's matches count as independent along their lines
# (measured: docs/method/4-tracking.md, "Landmark alignment").
MAX_INDEPENDENT_MATCHES = 10.0


class StackedMatches(NamedTuple):
    """All cameras' matches as arrays (C cameras, N matches), see `LandmarkMatches`.

    Attributes:
        points, depth_error, image, prior_weight: (N, 3), (N, 3), (N, 2), (N,).
        feature: (N,), from 0 for each camera.
        basis: (N, 3) 1, u, v: displacement of each landmark by the depth model's unknowns, in units of its depth error.
        offsets: (C + 1,) camera c has the matches offsets[c] to offsets[c + 1].
        rotation, center, focal: (C, 3, 3), (C, 3), (C,).
    """

    points: FloatArray
    depth_error: FloatArray
    image: FloatArray
    prior_weight: FloatArray
    feature: IntArray
    basis: FloatArray
    offsets: IntArray
    rotation: FloatArray
    center: FloatArray
    focal: FloatArray


class CameraState(NamedTuple):
    """Local state of cameras between iterations (C cameras, N matches, at most F features), and workspace.

    Attributes:
        depth_model: (C, 3) a.
        gains: (C, 3, 7) response of a to a step: it changes by -(gain[:, 6] + gain[:, :6] (w, d)).
        weights: (N,), 0 for outliers.
        projections: (N, 13) the landmark relative to g, rotated (3), in the camera's axes; its image (2) and its depth;
            the unit vector (2) along which its image moves with its depth error, that motion's length, and the residual
            along it; its depth error (3), camera's axes.
        distance: (N,) d, the square root of e'V⁻¹e; infinite behind the camera.
        cross_residual: (N,) residual across that direction.
        equations, feature_weights, buffer: (9, 10), (F, 2), (N,) workspace.
    """

    depth_model: FloatArray
    gains: FloatArray
    weights: FloatArray
    projections: FloatArray
    distance: FloatArray
    cross_residual: FloatArray
    equations: FloatArray
    feature_weights: FloatArray
    buffer: FloatArray


@kernel
def linearize_matches(
    stacked: StackedMatches, c: int, rotation: FloatArray, translation: FloatArray, variance: float, state: CameraState
) -> None:
    """Compute camera c's landmark projections and residuals.

    Args:
        variance: σ², normalized units.
        state: its projections, distance and cross_residual are filled.
    """
    q, depth_model, projections = stacked.rotation[c], state.depth_model[c], state.projections
    distance, cross_residual = state.distance, state.cross_residual
    camera_rotation, camera_translation = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        camera_translation[i] = 0.0
        for j in range(3):
            camera_rotation[i, j] = q[i, 0] * rotation[0, j] + q[i, 1] * rotation[1, j] + q[i, 2] * rotation[2, j]
            camera_translation[i] += q[i, j] * (translation[j] - stacked.center[c, j])
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        depth_offset = 0.0
        for k in range(3):
            depth_offset += stacked.basis[i, k] * depth_model[k]
        d0, d1, d2 = stacked.depth_error[i, 0], stacked.depth_error[i, 1], stacked.depth_error[i, 2]
        x0, x1 = stacked.points[i, 0] + depth_offset * d0, stacked.points[i, 1] + depth_offset * d1
        x2 = stacked.points[i, 2] + depth_offset * d2
        s0 = camera_rotation[0, 0] * x0 + camera_rotation[0, 1] * x1 + camera_rotation[0, 2] * x2
        s1 = camera_rotation[1, 0] * x0 + camera_rotation[1, 1] * x1 + camera_rotation[1, 2] * x2
        s2 = camera_rotation[2, 0] * x0 + camera_rotation[2, 1] * x1 + camera_rotation[2, 2] * x2
        z = s2 + camera_translation[2]
        if not z > 1e-9:
            distance[i], cross_residual[i] = np.inf, 1e3
            continue
        g0 = camera_rotation[0, 0] * d0 + camera_rotation[0, 1] * d1 + camera_rotation[0, 2] * d2
        g1 = camera_rotation[1, 0] * d0 + camera_rotation[1, 1] * d1 + camera_rotation[1, 2] * d2
        g2 = camera_rotation[2, 0] * d0 + camera_rotation[2, 1] * d1 + camera_rotation[2, 2] * d2
        u, v = (s0 + camera_translation[0]) / z, (s1 + camera_translation[1]) / z
        b0, b1 = (g0 - u * g2) / z, (g1 - v * g2) / z
        length = np.sqrt(b0 * b0 + b1 * b1)
        b0, b1 = (b0 / length, b1 / length) if length > 0.0 else (1.0, 0.0)
        e0, e1 = u - stacked.image[i, 0], v - stacked.image[i, 1]
        along = b0 * e0 + b1 * e1
        cross_residual[i] = b0 * e1 - b1 * e0
        distance[i] = np.sqrt(cross_residual[i] ** 2 / variance + along * along / (variance + length * length))
        row = projections[i]
        row[0], row[1], row[2], row[3], row[4], row[5] = s0, s1, s2, u, v, z
        row[6], row[7], row[8], row[9] = b0, b1, length, along
        row[10], row[11], row[12] = g0, g1, g2


@kernel
def compute_weights(stacked: StackedMatches, c: int, state: CameraState) -> float:
    """Compute the bisquare weights of camera c's matches by their distances.

    Matches of one feature share their smallest weight.

    Returns:
        the weights' sum.
    """
    distance, feature_weights, weights = state.distance, state.feature_weights, state.weights
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        feature_weights[stacked.feature[i], 0], feature_weights[stacked.feature[i], 1] = 1.0, 0.0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        k = stacked.feature[i]
        feature_weights[k, 0] = min(feature_weights[k, 0], bisquare((distance[i] / CUTOFF) ** 2))
        feature_weights[k, 1] += 1.0
    weight_sum = 0.0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        k = stacked.feature[i]
        weights[i] = feature_weights[k, 0] / feature_weights[k, 1] * stacked.prior_weight[i]
        weight_sum += weights[i]
    return weight_sum


@kernel
def build_equations(stacked: StackedMatches, c: int, variance: float, weight_sum: float, state: CameraState) -> None:
    """Compute the equations: lower triangle of J'WJ in (w, d, a), and J'We; camera's axes.

    Args:
        weight_sum: the weights' sum.
    """
    projections, cross_residual = state.projections, state.cross_residual
    weights, equations = state.weights, state.equations
    equations[:] = 0.0
    row, phi = np.empty(6), np.empty(3)
    correlation = max(1.0, weight_sum / MAX_INDEPENDENT_MATCHES)
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        if not weights[i] > 0.0:
            continue
        s0, s1, s2 = projections[i, 0], projections[i, 1], projections[i, 2]
        u, v, z = projections[i, 3], projections[i, 4], projections[i, 5]
        g0, g1, g2 = projections[i, 10], projections[i, 11], projections[i, 12]
        b0, b1, length, along = projections[i, 6], projections[i, 7], projections[i, 8], projections[i, 9]
        depth_variance = length * length
        w = weights[i] / (variance + correlation * depth_variance)
        compute_image_row(b0, b1, u, v, z, s0, s1, s2, 1.0, row)
        for k in range(3):
            phi[k] = length * stacked.basis[i, k]
        for k in range(6):
            scaled = w * row[k]
            for j in range(k + 1):
                equations[k, j] += scaled * row[j]
            for j in range(3):
                equations[6 + j, k] += scaled * phi[j]
            equations[k, 9] += scaled * along
        for k in range(3):
            scaled = w * phi[k]
            for j in range(k + 1):
                equations[6 + k, 6 + j] += scaled * phi[j]
            equations[6 + k, 9] += scaled * along
        # Across its line a match's derivative is evaluated at its own depth, as far as noise allows an estimate; along
        # it, that would interpret noise as motion.
        w = weights[i] / variance
        depth_shift = -length * along / (variance + depth_variance)
        new_depth = z + depth_shift * g2
        if new_depth > 0.2 * z:
            s0, s1, s2 = s0 + depth_shift * g0, s1 + depth_shift * g1, s2 + depth_shift * g2
            u, v = (u * z + depth_shift * g0) / new_depth, (v * z + depth_shift * g1) / new_depth
            z = new_depth
        compute_image_row(-b1, b0, u, v, z, s0, s1, s2, 1.0, row)
        for k in range(6):
            scaled = w * row[k]
            for j in range(k + 1):
                equations[k, j] += scaled * row[j]
            equations[k, 9] += scaled * cross_residual[i]


@kernel
def _eliminate_depth_model(
    q: FloatArray, depth_model: FloatArray, equations: FloatArray, gain: FloatArray, reduced: FloatArray
) -> None:
    """Eliminate the camera's depth model (3,) from its equations.

    Hessian and gradient of (w, d), world axes, are written to reduced (6, 7).

    gain (3, 7) becomes that of `CameraState`.
    """
    block = np.empty((3, 3))
    rotate_rows(equations[6:, :6], q, gain)
    for k in range(3):
        for j in range(k + 1):
            block[k, j] = equations[6 + k, 6 + j]
        block[k, k] += 1.0
        gain[k, 6] = equations[6 + k, 9] + depth_model[k]
    reduced[:] = 0.0
    add_rotated(equations, q, reduced)
    for h in range(2):
        for i in range(3):
            for a in range(3):
                reduced[3 * h + i, 6] += q[a, i] * equations[3 * h + a, 9]
    eliminate_block(block, gain, reduced)
    # Symmetric up to rounding: only one half is sent.
    for i in range(6):
        for j in range(i):
            reduced[i, j] = reduced[j, i]


@kernel
def compute_camera_terms(
    stacked: StackedMatches,
    c: int,
    rotation: FloatArray,
    translation: FloatArray,
    sigma_px: float,
    is_used: bool,
    state: CameraState,
    reduced: FloatArray,
) -> float:
    """Write camera c's hessian and gradient of (w, d), world axes, to reduced (6, 7).

    Its depth model is eliminated.

    Args:
        sigma_px: its noise, pixels.
        is_used: whether it is used.
        state: its part is filled.

    Returns:
        the weights' sum.
    """
    variance = (sigma_px / stacked.focal[c]) ** 2
    linearize_matches(stacked, c, rotation, translation, variance, state)
    weight_sum = compute_weights(stacked, c, state)
    if not is_used:
        weight_sum = 0.0
        state.weights[stacked.offsets[c] : stacked.offsets[c + 1]] = 0.0
    build_equations(stacked, c, variance, weight_sum, state)
    _eliminate_depth_model(stacked.rotation[c], state.depth_model[c], state.equations, state.gains[c], reduced)
    return weight_sum


@kernel
def estimate_camera_noise(stacked: StackedMatches, c: int, state: CameraState) -> float:
    """Estimate camera c's noise, pixels, from the median of its inliers' distances across; NaN without any."""
    count = 0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        if state.weights[i] > 0.0:
            state.buffer[count] = abs(state.cross_residual[i])
            count += 1
    if count == 0:
        return np.nan
    return float(SIGMA_OF_MEDIAN * stacked.focal[c] * np.median(state.buffer[:count]))


@kernel
def update_depth_model(c: int, step: FloatArray, state: CameraState) -> None:
    """Update camera c's depth model after a joint step (6,) of (w, d)."""
    for k in range(3):
        state.depth_model[c, k] -= state.gains[c, k, 6]
        for j in range(6):
            state.depth_model[c, k] -= state.gains[c, k, j] * step[j]


@kernel
def _sum_costs(stacked: StackedMatches, c: int, state: CameraState) -> float:
    """Return the sum of camera c's bisquare costs, each from 0 to 1, weighted by `prior_weight`."""
    cost = 0.0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        q = (state.distance[i] / CUTOFF) ** 2
        cost += stacked.prior_weight[i] * (1.0 - max(1.0 - q, 0.0) ** 3)
    return cost


@kernel
def evaluate_pose(
    stacked: StackedMatches,
    c: int,
    rotation: FloatArray,
    translation: FloatArray,
    noise_px: float,
    is_used: bool,
    state: CameraState,
) -> tuple[float, float, int]:
    """Determine camera c's inliers for a pose; `state.cross_residual` becomes pixels.

    Args:
        noise_px: noise that defines inliers.
        is_used: whether it was used; else its weights stay 0.

    Returns:
        the sum of its matches' robust costs, each between 0 and 1, weighted by `prior_weight`; the same at
        `REFERENCE_NOISE_PX`; number of inliers.
    """
    linearize_matches(stacked, c, rotation, translation, (REFERENCE_NOISE_PX / stacked.focal[c]) ** 2, state)
    reference_cost = _sum_costs(stacked, c, state)
    linearize_matches(stacked, c, rotation, translation, (noise_px / stacked.focal[c]) ** 2, state)
    if is_used:
        compute_weights(stacked, c, state)
    cost, inliers = _sum_costs(stacked, c, state), 0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        state.cross_residual[i] *= stacked.focal[c]
        inliers += state.weights[i] > 0.0
    return cost, reference_cost, inliers
