"""Diagnostics of a fit, computed in one compiled call: most fits pass them and need no further test."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel, symmetric_eigen
from sylpose.relative_pose.irls import IrlsFit, has_uniform_residuals
from sylpose.relative_pose.motion_mixture import (
    correlate_neighbors,
    has_static_candidates,
    is_mixed,
    measure_dependence,
)
from sylpose.relative_pose.observability import is_collinear, is_static
from sylpose.relative_pose.terms import Stack
from sylpose.relative_pose.uncertainty import compute_size_if_curved, measure_variance_inflation


class FitDiagnostics(NamedTuple):
    """Diagnostics of a fit.

    Attributes:
        inliers: number of inliers.
        is_finite: whether the search converged to finite values.
        has_uniform_residuals: whether the inliers' residuals are uniform instead of noise: selected by the noise bound.
        has_static_candidates: whether the matches may contain a background (`has_static_candidates`).
        is_collinear: whether the inliers are collinear (`is_collinear`).
        has_soft_assignment: whether some matches are assigned to the motion with uncertainty.
        may_be_curved: whether the valley of the cost may be curved (`has_weak_direction`).
        may_be_static: whether the motion may be zero, if the valley is straight (`is_static`).
        dependence: of the residuals on the motion (`measure_dependence`).
        is_mixed: whether neighboring residuals are correlated (`is_mixed`).
        information, information_without_depth: (6, 6) without the part that noise alone causes, inflated by the scatter
            of groups of matches. The covariance is that of Student's distribution, as the noise is estimated.
    """

    inliers: int
    is_finite: bool
    has_uniform_residuals: bool
    has_static_candidates: bool
    is_collinear: bool
    has_soft_assignment: bool
    may_be_curved: bool
    may_be_static: bool
    dependence: float
    is_mixed: bool
    information: FloatArray
    information_without_depth: FloatArray


@kernel
def diagnose(stack: Stack, usable: BoolArray, fit: IrlsFit, probabilities: FloatArray, radius: float) -> FitDiagnostics:
    """Compute the diagnostics of a fit.

    Args:
        usable: (N,) matches that may be inliers.
        probabilities: (N,) the probability of each match to belong to the motion, given that it is no mismatch.
        radius: of the object.
    """
    inliers, soft_assignment, finite = 0, False, True
    for i in range(6):
        finite = finite and (i > 2 or np.isfinite(fit.candidate.translation[i % 3]))
        for j in range(6):
            finite = finite and np.isfinite(fit.information[i, j])
    for i in range(len(probabilities)):
        inliers += fit.weights[i] > 0.0
        soft_assignment = soft_assignment or (probabilities[i] > 0.0 and probabilities[i] < 1.0)
    freedom = max(inliers - 6, 1)
    noise, student = fit.noise_information, max(freedom - 2, 1) / freedom
    share = student / measure_variance_inflation(stack, probabilities, fit)
    information = share * subtract_information(fit.information, noise)
    without_depth = share * subtract_information(fit.information_without_depth, noise)
    curved = compute_size_if_curved(fit, radius) > 0.0
    uncertain = curved or soft_assignment
    mixed = is_mixed(*correlate_neighbors(stack, fit), uncertain)
    uniform = has_uniform_residuals(fit.weights)
    background = has_static_candidates(stack, usable)
    collinear = is_collinear(stack, fit.weights, fit.sigma_px, np.zeros((3, 3)))
    static, dependence = is_static(stack, fit, information), measure_dependence(stack, fit)
    shape = background, collinear, soft_assignment, curved, static, dependence, mixed
    uniform = uniform and not soft_assignment
    return FitDiagnostics(inliers, finite, uniform, *shape, information, without_depth)


@kernel
def subtract_information(information: FloatArray, part: FloatArray) -> FloatArray:
    """Subtract from information (6, 6) a part (6, 6) that carries no information.

    In axes in which the information is the identity and the part has eigenvalues ν, each axis keeps (1 - ν)²: the sandwich
    H J'J^-1 H of M-estimation with H = J'J - part. A small share always remains.
    """
    n, largest = information.shape[0], 0.0
    for i in range(n):
        largest = max(largest, information[i, i])
    if not largest > 1e-100:
        return information.copy()
    unit, values = np.empty(n), np.empty(n)
    scaled, vectors, axes = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        unit[i] = 1.0 / np.sqrt(max(information[i, i], 1e-12 * largest))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * unit[i] * unit[j]
    symmetric_eigen(scaled, values, vectors)
    root = np.sqrt(np.maximum(values, 1e-14 * values[n - 1]))
    # The part in axes where the information is the identity.
    for i in range(n):
        for k in range(n):
            axes[i, k] = 0.0
            for j in range(n):
                axes[i, k] += part[i, j] * unit[j] * vectors[j, k] / root[k]
    for k in range(n):
        for m in range(n):
            scaled[k, m] = 0.0
            for i in range(n):
                scaled[k, m] += unit[i] * vectors[i, k] / root[k] * axes[i, m]
    symmetric_eigen(scaled, values, axes)
    half, out = np.empty((n, n)), np.empty((n, n))
    for m in range(n):
        remaining = min(max(1.0 - values[m], 1e-3), 1.0)
        for i in range(n):
            half[i, m] = 0.0
            for k in range(n):
                half[i, m] += vectors[i, k] * root[k] / unit[i] * axes[k, m] * remaining
    for i in range(n):
        for j in range(i + 1):
            out[i, j] = 0.0
            for m in range(n):
                out[i, j] += half[i, m] * half[j, m]
            out[j, i] = out[i, j]
    return out
