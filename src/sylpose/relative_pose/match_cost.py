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
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE, Candidate, Stack, transform_to_camera

# Kernels process 32 matches at a time, in loops over lanes of arrays with constant strides, so that the processor handles
# several per instruction. Sums are taken in the same order on every machine.
# Matches of a batch, and the values of each: x, y, usable; distance, across, along, parallax, weight; the weights of
# its two rows; h of `compute_image_row` along the line and |Jρ|, h across it, standard deviation of ρ due to noise; the
# row along the line with its residual, and that across (derived).
LANES, N_PARTIAL_SUMS, ALONG_ROW, ACROSS_ROW, VALUES_PER_MATCH = 32, 8, 20, 33, 40
# Mask of usable matches, or the probability of each match to be one.
InlierPrior = BoolArray | FloatArray


class Tolerance(NamedTuple):
    """Noise model of a term's matches.

    Attributes:
        variance: σ², normalized units.
        residual_depth: ζ, in units of the inverse depth of g.
        shared_residual_depth: the residual depth left in the mean of many matches, times the root of their number; used
            in the normal equations.
        cutoff: of d.
    """

    variance: float
    residual_depth: float
    shared_residual_depth: float
    cutoff: float


class Term(NamedTuple):
    """One term's motion, depth model and noise, in the axes of its current camera (`Stack`).

    Attributes:
        first, last: the range of its matches.
        rc, tc, rotated_center: as `transform_to_camera` computes them.
        inverse_depth: of g.
        inverse_spread: inverse of the spread.
        anchor: (2,) the image of g.
        depth_model: (6,).
        tolerance: noise model.
    """

    first: int
    last: int
    rc: FloatArray
    tc: FloatArray
    rotated_center: FloatArray
    inverse_depth: float
    inverse_spread: float
    anchor: FloatArray
    depth_model: FloatArray
    tolerance: Tolerance


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
    """

    matrix: FloatArray
    right: FloatArray
    parallax_gradient: FloatArray
    parallax_squares: FloatArray
    noise_information: FloatArray


@kernel
def make_match_errors(n: int) -> MatchErrors:
    """Allocate the errors of n matches."""
    return MatchErrors(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n))


@kernel
def make_match_equations(noise: bool) -> MatchEquations:
    """Allocate normal equations, with or without the noise part."""
    unknowns, size = 6 + DEPTH_MODEL_SIZE, 6 if noise else 0
    hessian, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    return MatchEquations(hessian, gradient, np.zeros(6), np.zeros(1), np.zeros((size, size)))


@kernel
def make_term(stack: Stack, t: int, candidate: Candidate, tolerance: Tolerance) -> Term:
    """Return term t's motion, quadric depth model and noise."""
    rc, tc, rotated = np.empty((3, 3)), np.empty(3), np.empty(3)
    unit, per_spread = stack.inverse_depth[t], 1.0 / stack.spread[t]
    transform_to_camera(stack, t, candidate, rc, tc, rotated)
    first, last, anchor, depth_model = stack.offsets[t], stack.offsets[t + 1], stack.anchor[t], candidate.depth_model[t]
    return Term(first, last, rc, tc, rotated, unit, per_spread, anchor, depth_model, tolerance)


@kernel
def compute_distances(stack: Stack, term: Term, usable: InlierPrior, matches: MatchErrors) -> None:
    """Compute the errors of the matches of a term, without their normal equations."""
    lanes = np.empty(VALUES_PER_MATCH * LANES)
    for start in range(term.first, term.last, LANES):
        _compute_batch(stack, usable, start, min(LANES, term.last - start), term, lanes, matches)


@leaf
def _compute_batch(
    stack: Stack, usable: InlierPrior, start: int, count: int, term: Term, lanes: FloatArray, matches: MatchErrors
) -> None:
    """Load `count` matches from `start` on into the lanes and compute their errors."""
    x, y = stack.x, stack.y
    for k in range(count):
        lanes[k], lanes[LANES + k] = x[start + k, 0], x[start + k, 1]
        lanes[2 * LANES + k], lanes[3 * LANES + k] = y[start + k, 0], y[start + k, 1]
        lanes[4 * LANES + k] = usable[start + k]
    # Pad with copies of the last match, without weight.
    for k in range(count, LANES):
        for j in range(4):
            lanes[j * LANES + k] = lanes[j * LANES + count - 1]
        lanes[4 * LANES + k] = 0.0
    _compute_errors(term, lanes)
    for k in range(count):
        matches.distance[start + k], matches.across[start + k] = lanes[5 * LANES + k], lanes[6 * LANES + k]
        matches.along[start + k], matches.parallax[start + k] = lanes[7 * LANES + k], lanes[8 * LANES + k]
        matches.weights[start + k] = lanes[9 * LANES + k]


@kernel
def build_match_equations(
    stack: Stack, term: Term, usable: InlierPrior, matches: MatchErrors, equations: MatchEquations
) -> None:
    """Compute the errors of the matches of a term and their normal equations.

    Args:
        usable: (N,) matches that may be inliers, or the probability of each to be one.
        matches: of all terms; the part of this term is filled.
        equations: filled.
    """
    matrix, right, parallax_gradient, squares, noise = equations
    lanes, weighted = np.empty(VALUES_PER_MATCH * LANES), np.empty(LANES)
    matrix[:], right[:], parallax_gradient[:], squares[:], noise[:] = 0.0, 0.0, 0.0, 0.0, 0.0
    along, across = np.zeros((13, 13, N_PARTIAL_SUMS)), np.zeros((7, 7, N_PARTIAL_SUMS))
    for start in range(term.first, term.last, LANES):
        count = min(LANES, term.last - start)
        _compute_batch(stack, usable, start, count, term, lanes, matches)
        _add_products(lanes, ALONG_ROW, 13, 10, weighted, along)
        _add_products(lanes, ACROSS_ROW, 7, 11, weighted, across)
        squares[0] += _add_parallax_gradient(lanes, count, term, parallax_gradient)
        if noise.shape[0] > 0:
            _add_noise_information(lanes, count, term, noise)
    for k in range(12):
        right[k] = _sum_parts(along[12, k])
        for j in range(k + 1):
            matrix[k, j] = _sum_parts(along[k, j])
    for k in range(6):
        right[k] += _sum_parts(across[6, k])
        for j in range(k + 1):
            matrix[k, j] += _sum_parts(across[k, j])


@leaf
def _compute_errors(term: Term, lanes: FloatArray) -> None:
    """Compute the errors of a batch of matches and their derivatives by (w, d, α).

    The first five of the `VALUES_PER_MATCH` values are the input, all others are computed.
    """
    _, _, rc, tc, rotated_center, unit, per_spread, anchor, depth_model, tolerance = term
    variance, residual_depth, shared_residual_depth, cutoff = tolerance
    anchor0, anchor1 = anchor[0], anchor[1]
    a0, a1, a2 = depth_model[0], depth_model[1], depth_model[2]
    a3, a4, a5 = depth_model[3], depth_model[4], depth_model[5]
    r00, r01, r02 = rc[0, 0], rc[0, 1], rc[0, 2]
    r10, r11, r12 = rc[1, 0], rc[1, 1], rc[1, 2]
    r20, r21, r22 = rc[2, 0], rc[2, 1], rc[2, 2]
    t0, t1, t2, g0, g1, g2 = tc[0], tc[1], tc[2], rotated_center[0], rotated_center[1], rotated_center[2]
    per_cutoff, per_variance = 1.0 / (cutoff * cutoff), 1.0 / variance
    for k in range(LANES):
        x0, x1 = lanes[k], lanes[1 * LANES + k]
        p, q = (x0 - anchor0) * per_spread, (x1 - anchor1) * per_spread
        rho = unit * (a0 + a1 * p + a2 * q + a3 * p * p + a4 * p * q + a5 * q * q)
        # Derivative with respect to the image point in the reference frame: the depth changes with the slope of the
        # depth model.
        rho0 = (a1 + 2.0 * a3 * p + a4 * q) * per_spread
        rho1 = (a2 + a4 * p + 2.0 * a5 * q) * per_spread
        v0, v1, v2 = r00 * x0 + r01 * x1 + r02, r10 * x0 + r11 * x1 + r12, r20 * x0 + r21 * x1 + r22
        z = v2 + rho * t2
        in_front = z > 1e-6
        per_z = 1.0 / (z if in_front else 1.0)
        u, v = (v0 + rho * t0) * per_z, (v1 + rho * t1) * per_z
        e0, e1 = lanes[2 * LANES + k] - u, lanes[3 * LANES + k] - v
        # Jρ, per unit of g's inverse depth, and Jx.
        b0, b1 = unit * (t0 - u * t2) * per_z, unit * (t1 - v * t2) * per_z
        j00, j01 = (r00 - u * r20) * per_z + b0 * rho0, (r01 - u * r21) * per_z + b0 * rho1
        j10, j11 = (r10 - v * r20) * per_z + b1 * rho0, (r11 - v * r21) * per_z + b1 * rho1
        s00, s01, s11 = 1.0 + j00 * j00 + j01 * j01, j00 * j10 + j01 * j11, 1.0 + j10 * j10 + j11 * j11
        length = np.sqrt(b0 * b0 + b1 * b1)
        has_parallax = length > 0.0
        per_length = 1.0 / (length if has_parallax else 1.0)
        b0, b1 = (b0 * per_length if has_parallax else 1.0), (b1 * per_length if has_parallax else 0.0)
        noise_n = b1 * b1 * s00 - 2.0 * b0 * b1 * s01 + b0 * b0 * s11
        noise_b = b0 * b0 * s00 + 2.0 * b0 * b1 * s01 + b1 * b1 * s11
        per_noise, per_root = 1.0 / noise_n, 1.0 / np.sqrt(noise_b)
        along_error, across_error = b0 * e0 + b1 * e1, b0 * e1 - b1 * e0
        depth_variance = (residual_depth * length) * (residual_depth * length)
        per_both = 1.0 / (variance * noise_b + depth_variance)
        distance = across_error * across_error * per_noise * per_variance + along_error * along_error * per_both
        inside = 1.0 - distance * per_cutoff
        weight = lanes[4 * LANES + k] * (inside * inside if in_front and inside > 0.0 else 0.0)
        lanes[5 * LANES + k] = distance if in_front else np.inf
        lanes[6 * LANES + k] = across_error * np.sqrt(per_noise) if in_front else np.inf
        lanes[7 * LANES + k] = along_error * per_root if in_front else np.inf
        lanes[8 * LANES + k] = length * per_root if in_front else 0.0
        lanes[9 * LANES + k] = weight
        # Along the line: at the depth of the model.
        shared_depth_sd = shared_residual_depth * length
        lanes[10 * LANES + k] = weight / (variance * noise_b + shared_depth_sd * shared_depth_sd)
        h0, h1 = b0 * per_z, b1 * per_z
        h2 = -(h0 * u + h1 * v)
        s0, s1, s2 = v0 + rho * g0, v1 + rho * g1, v2 + rho * g2
        i = ALONG_ROW * LANES + k
        lanes[i], lanes[i + LANES], lanes[i + 2 * LANES] = s1 * h2 - s2 * h1, s2 * h0 - s0 * h2, s0 * h1 - s1 * h0
        lanes[i + 3 * LANES], lanes[i + 4 * LANES], lanes[i + 5 * LANES] = rho * h0, rho * h1, rho * h2
        lanes[i + 6 * LANES], lanes[i + 7 * LANES], lanes[i + 8 * LANES] = length, length * p, length * q
        lanes[i + 9 * LANES], lanes[i + 10 * LANES] = length * p * p, length * p * q
        lanes[i + 11 * LANES] = length * q * q
        lanes[i + 12 * LANES] = along_error
        lanes[12 * LANES + k], lanes[13 * LANES + k], lanes[14 * LANES + k], lanes[15 * LANES + k] = h0, h1, h2, length
        # Across it: at the match's own depth, as far as its parallax exceeds the noise. Used along the line as well,
        # the noise in that depth would appear as motion.
        depth_gain = depth_variance * per_both
        depth_step = unit * depth_gain * along_error * per_length
        depth_step = depth_step if depth_step > -0.5 * rho else -0.5 * rho
        depth_step = depth_step if depth_step < 2.0 * rho else 2.0 * rho
        rho += depth_step if has_parallax else 0.0
        z = v2 + rho * t2
        behind = not z > 1e-6
        per_z = 1.0 / (1.0 if behind else z)
        u, v = (v0 + rho * t0) * per_z, (v1 + rho * t1) * per_z
        lanes[11 * LANES + k] = 0.0 if behind else weight * per_variance * per_noise
        h0, h1 = -b1 * per_z, b0 * per_z
        h2 = -(h0 * u + h1 * v)
        s0, s1, s2 = v0 + rho * g0, v1 + rho * g1, v2 + rho * g2
        i = ACROSS_ROW * LANES + k
        lanes[i], lanes[i + LANES], lanes[i + 2 * LANES] = s1 * h2 - s2 * h1, s2 * h0 - s0 * h2, s0 * h1 - s1 * h0
        lanes[i + 3 * LANES], lanes[i + 4 * LANES], lanes[i + 5 * LANES] = rho * h0, rho * h1, rho * h2
        lanes[i + 6 * LANES] = across_error
        lanes[16 * LANES + k], lanes[17 * LANES + k], lanes[18 * LANES + k] = h0, h1, h2
        lanes[19 * LANES + k] = depth_gain * np.sqrt(variance * noise_b) * (per_length if has_parallax else 0.0)


@leaf
def _add_products(
    lanes: FloatArray, first: int, size: int, weight: int, weighted: FloatArray, sums: FloatArray
) -> None:
    """Add the weighted products of all pairs of `size` rows, the lower triangle, to sums (size, size, LANES / 4).

    Each sum is kept in as many parts as are processed at once. The number of parts is read from the array: a constant
    would make the compiler unroll the loop instead.
    """
    parts = sums.shape[2]
    for k in range(size):
        for i in range(LANES):
            weighted[i] = lanes[weight * LANES + i] * lanes[(first + k) * LANES + i]
        for j in range(k + 1):
            row, target = lanes[(first + j) * LANES : (first + j + 1) * LANES], sums[k, j]
            for i in range(parts):
                target[i] += (weighted[i] * row[i] + weighted[N_PARTIAL_SUMS + i] * row[N_PARTIAL_SUMS + i]) + (
                    weighted[2 * N_PARTIAL_SUMS + i] * row[2 * N_PARTIAL_SUMS + i]
                    + weighted[3 * N_PARTIAL_SUMS + i] * row[3 * N_PARTIAL_SUMS + i]
                )


@leaf
def _sum_parts(parts: FloatArray) -> float:
    """Return the sum of the parts."""
    return float(((parts[0] + parts[4]) + (parts[1] + parts[5])) + ((parts[2] + parts[6]) + (parts[3] + parts[7])))


@leaf
def _add_parallax_gradient(lanes: FloatArray, count: int, term: Term, gradient: FloatArray) -> float:
    """Add W Jρ² ∂log|Jρ| by (w, d) of some matches to `gradient` (6,); return W Jρ²."""
    rotated_center, unit = term.rotated_center, term.inverse_depth
    h0, h1, h2, squares = 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        length = lanes[15 * LANES + k]
        share = lanes[10 * LANES + k] * length
        h0 += share * lanes[12 * LANES + k]
        h1 += share * lanes[13 * LANES + k]
        h2 += share * lanes[14 * LANES + k]
        squares += share * length
    gradient[0] += unit * (rotated_center[1] * h2 - rotated_center[2] * h1)
    gradient[1] += unit * (rotated_center[2] * h0 - rotated_center[0] * h2)
    gradient[2] += unit * (rotated_center[0] * h1 - rotated_center[1] * h0)
    gradient[3] += unit * h0
    gradient[4] += unit * h1
    gradient[5] += unit * h2
    return squares


@kernel
def _add_noise_information(lanes: FloatArray, count: int, term: Term, noise: FloatArray) -> None:
    """Add the expected square of the effect of noise in x (both coordinates) and in ρ on the rows of some matches.

    A change c in the camera's axes moves the image by h·c, and the rotation part of the row by c × h. The products of
    h, summed over the matches, are therefore sufficient.
    """
    rc, rotated_center, unit, variance = term.rc, term.rotated_center, term.inverse_depth, term.tolerance.variance
    h, cross, by = np.zeros((2, 3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for k in range(count):
        for across in range(2):
            w = lanes[(10 + across) * LANES + k]
            depth_sd = unit * lanes[19 * LANES + k]
            for i in range(3):
                x = w * lanes[(12 + 4 * across + i) * LANES + k]
                for j in range(i + 1):
                    square = x * lanes[(12 + 4 * across + j) * LANES + k]
                    h[0, i, j] += variance * square
                    if across == 1:
                        h[1, i, j] += depth_sd * depth_sd * square
    for source in range(3):
        column = rotated_center if source == 2 else rc[:, source]
        c0, c1, c2 = column[0], column[1], column[2]
        cross[0, 1], cross[0, 2], cross[1, 2] = -c2, c1, -c0
        cross[1, 0], cross[2, 0], cross[2, 1] = c2, -c1, c0
        moments = h[1] if source == 2 else h[0]
        for i in range(3):
            for j in range(i):
                moments[j, i] = moments[i, j]
        for i in range(3):
            for j in range(3):
                by[i, j] = cross[i, 0] * moments[0, j] + cross[i, 1] * moments[1, j] + cross[i, 2] * moments[2, j]
        for i in range(3):
            for j in range(3):
                noise[i, j] += by[i, 0] * cross[j, 0] + by[i, 1] * cross[j, 1] + by[i, 2] * cross[j, 2]
                if source == 2:
                    noise[i, 3 + j] += by[i, j]
                    noise[3 + j, i] += by[i, j]
                    noise[3 + i, 3 + j] += moments[i, j]
