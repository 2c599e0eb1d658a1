"""Reprojection errors of matches in full perspective, and the normal equations of a term.

The search on `moments_cost` provides the starting points.

A feature is on its ray x at the inverse depth ρ of its term's depth model, a quadric whose six coefficients α are
unknowns in addition to the motion, up to a residual depth ζ. With e = y - image(R x + ρ τ), its derivatives J and
V = σ² (I + Jx Jx') + ζ² Jρ Jρ',

    d² = e' V^-1 e = across² / σ² + along² / (σ² + ζ² parallax²)

so d² is chi-squared with two degrees of freedom whatever the parallax. If the parallax is below the noise, both
coordinates of a match measure the motion. If it is large, only the coordinate across the epipolar line does.

Source: errors in variables by linearized covariance, Hartley & Zisserman, section 5.2; Sampson's distance, ibid.
11.4.3; the rest is ours (docs/method/3-pose.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.plane_projection import transform_to_camera
from sylpose.relative_pose.simd_kernels import (
    ACROSS_ROW,
    ALONG_ROW,
    LANES,
    N_PARTIAL_SUMS,
    VALUES_PER_MATCH,
    DepthAnchor,
    Tolerance,
    add_missing_information,
    add_noise_information,
    add_parallax_gradient,
    add_products,
    compute_errors,
    sum_parts,
)
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE, Candidate, Stack

__all__ = [
    "InlierPrior",
    "MatchEquations",
    "MatchErrors",
    "Tolerance",
    "build_match_equations",
    "compute_distances",
    "compute_match_errors",
    "make_match_equations",
    "make_match_errors",
]


# Mask of usable matches, or the probability of each match to be one.
InlierPrior = BoolArray | FloatArray


class MatchErrors(NamedTuple):
    """Errors of N matches relative to their predictions by the motion and the depth model.

    Attributes:
        distance: (N,) d²; infinite for a point that the motion moves behind its camera.
        across: (N,) distance across the epipolar line over √(n'(I + Jx Jx')n): Sampson's distance, signed, with σ as
            its standard deviation.
        along: (N,) distance along it, likewise normalized by √(b'(I + Jx Jx')b).
        parallax: (N,) derivative of `along` with respect to the inverse depth, in units of g's inverse depth.
        weights: (N,) bisquare.
    """

    distance: FloatArray
    across: FloatArray
    along: FloatArray
    parallax: FloatArray
    weights: FloatArray


class MatchEquations(NamedTuple):
    """Weighted normal equations of one term, in the axes of its current camera.

    Attributes:
        matrix: (12, 12) lower triangle of J'WJ in (w, d, α).
        right: (12,) J'We.
        parallax_gradient: (6,) Σ W Jρ² ∂log|Jρ| by (w, d): derivative of the parallax with respect to the motion.
        parallax_squares: (1,) Σ W Jρ².
        noise_information: (6, 6) the part of J'WJ in (w, d) that arises because J is evaluated at noisy points. It
            carries no information; without this correction a small motion, or a rod's rotation about itself, would
            appear known. (0, 0) if not requested.
        missing_information: (12, 12) the part of J'WJ that is lost to uncertain match assignment: for a match of
            probability p, p (1 - p) times the square of its contribution to (w, d, α). (0, 0) if not requested.
    """

    matrix: FloatArray
    right: FloatArray
    parallax_gradient: FloatArray
    parallax_squares: FloatArray
    noise_information: FloatArray
    missing_information: FloatArray


@kernel
def make_match_errors(n: int) -> MatchErrors:
    """Allocate the errors of n matches."""
    return MatchErrors(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n))


@kernel
def make_match_equations(noise: bool, missing: bool) -> MatchEquations:
    """Allocate normal equations, with or without the noise part and the missing part."""
    unknowns, size, lost = 6 + DEPTH_MODEL_SIZE, 6 if noise else 0, 6 + DEPTH_MODEL_SIZE if missing else 0
    hessian, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    return MatchEquations(hessian, gradient, np.zeros(6), np.zeros(1), np.zeros((size, size)), np.zeros((lost, lost)))


def compute_match_errors(
    stack: Stack,
    t: int,
    candidate: Candidate,
    tolerance: Tolerance,
    usable: InlierPrior | None = None,
    *,
    noise: bool = True,
) -> tuple[MatchErrors, MatchEquations]:
    """Allocate and run `build_match_equations` for term t; the errors are those of its own matches."""
    n = len(stack.x)
    matches, equations = make_match_errors(n), make_match_equations(noise, False)
    usable_weights = np.ones(n) if usable is None else usable.astype(np.float64)
    build_match_equations(stack, t, usable_weights, candidate, tolerance, matches, equations)
    rows = slice(stack.offsets[t], stack.offsets[t + 1])
    return MatchErrors(*(values[rows] for values in matches)), equations


@kernel
def compute_distances(
    stack: Stack, t: int, usable: InlierPrior, candidate: Candidate, tolerance: Tolerance, matches: MatchErrors
) -> None:
    """Compute the errors of the matches of term t, without their normal equations."""
    rc, tc, rotated_center, lanes = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(VALUES_PER_MATCH * LANES)
    transform_to_camera(stack, t, candidate, rc, tc, rotated_center)
    anchor, depth_model = _depth_anchor(stack, t), candidate.depth_model[t]
    first, last = stack.offsets[t], stack.offsets[t + 1]
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        _compute_batch(
            stack.x,
            stack.y,
            usable,
            start,
            count,
            anchor,
            depth_model,
            tolerance,
            lanes,
            rc,
            tc,
            rotated_center,
            matches,
        )


@leaf
def _depth_anchor(stack: Stack, t: int) -> DepthAnchor:
    """Return the anchor of term t's depth model."""
    return DepthAnchor(stack.inverse_depth[t], 1.0 / stack.spread[t], stack.anchor[t, 0], stack.anchor[t, 1])


@leaf
def _copy_row(lanes: FloatArray, row: int, target: FloatArray) -> None:
    """Copy the first values of one row of lanes."""
    for k in range(len(target)):
        target[k] = lanes[row * LANES + k]


@leaf
def _compute_batch(
    x: FloatArray,
    y: FloatArray,
    usable: InlierPrior,
    start: int,
    count: int,
    anchor: DepthAnchor,
    depth_model: FloatArray,
    tolerance: Tolerance,
    lanes: FloatArray,
    rc: FloatArray,
    tc: FloatArray,
    rotated_center: FloatArray,
    matches: MatchErrors,
) -> None:
    """Load `count` matches from `start` on into the lanes and compute their errors."""
    x, y, batch_usable = x[start : start + count], y[start : start + count], usable[start : start + count]
    for k in range(count):
        lanes[k], lanes[LANES + k] = x[k, 0], x[k, 1]
        lanes[2 * LANES + k], lanes[3 * LANES + k] = y[k, 0], y[k, 1]
        lanes[4 * LANES + k] = batch_usable[k]
    # Pad with copies of the last match, without weight.
    for k in range(count, LANES):
        for j in range(4):
            lanes[j * LANES + k] = lanes[j * LANES + count - 1]
        lanes[4 * LANES + k] = 0.0
    compute_errors(anchor, depth_model, tolerance, rc, tc, rotated_center, lanes)
    last = start + count
    _copy_row(lanes, 5, matches.distance[start:last])
    _copy_row(lanes, 6, matches.across[start:last])
    _copy_row(lanes, 7, matches.along[start:last])
    _copy_row(lanes, 8, matches.parallax[start:last])
    _copy_row(lanes, 9, matches.weights[start:last])


@kernel
def build_match_equations(
    stack: Stack,
    t: int,
    usable: InlierPrior,
    candidate: Candidate,
    tolerance: Tolerance,
    matches: MatchErrors,
    equations: MatchEquations,
) -> None:
    """Compute the errors of the matches of term t and their normal equations.

    Args:
        usable: (N,) matches that may be inliers, or the probability of each to be one.
        candidate: with quadric depth models.
        matches: of all terms; the part of term t is filled.
        equations: filled.
    """
    matrix, right, parallax_gradient, squares, noise, missing = equations
    rc, tc, rotated_center = np.empty((3, 3)), np.empty(3), np.empty(3)
    transform_to_camera(stack, t, candidate, rc, tc, rotated_center)
    matrix[:] = 0.0
    right[:] = 0.0
    parallax_gradient[:] = 0.0
    squares[:] = 0.0
    noise[:] = 0.0
    missing[:] = 0.0
    lanes, weighted = np.empty(VALUES_PER_MATCH * LANES), np.empty(LANES)
    along, across = np.zeros((13, 13, N_PARTIAL_SUMS)), np.zeros((7, 7, N_PARTIAL_SUMS))
    first, last = stack.offsets[t], stack.offsets[t + 1]
    anchor, depth_model, unit = _depth_anchor(stack, t), candidate.depth_model[t], stack.inverse_depth[t]
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        _compute_batch(
            stack.x,
            stack.y,
            usable,
            start,
            count,
            anchor,
            depth_model,
            tolerance,
            lanes,
            rc,
            tc,
            rotated_center,
            matches,
        )
        add_products(lanes, ALONG_ROW, 13, 10, weighted, along)
        add_products(lanes, ACROSS_ROW, 7, 11, weighted, across)
        squares[0] += add_parallax_gradient(lanes, count, rotated_center, unit, parallax_gradient)
        if noise.shape[0] > 0:
            add_noise_information(lanes, count, tolerance.variance, unit, rc, rotated_center, noise)
        if missing.shape[0] > 0:
            for k in range(count):
                if lanes[9 * LANES + k] > 0.0:
                    add_missing_information(lanes[k::LANES], missing)
    for k in range(12):
        right[k] = sum_parts(along[12, k])
        for j in range(k + 1):
            matrix[k, j] = sum_parts(along[k, j])
    for k in range(6):
        right[k] += sum_parts(across[6, k])
        for j in range(k + 1):
            matrix[k, j] += sum_parts(across[k, j])
