"""Vectorized kernels of `match_cost`: errors and normal equations of a batch of matches.

They process 32 matches at a time, in loops over lanes of arrays with constant strides, so that the processor handles
several per instruction. Sums are taken in the same order on every machine.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE

__all__ = [
    "ACROSS_ROW",
    "ALONG_ROW",
    "LANES",
    "N_PARTIAL_SUMS",
    "VALUES_PER_MATCH",
    "DepthAnchor",
    "Tolerance",
    "add_missing_information",
    "add_noise_information",
    "add_parallax_gradient",
    "add_products",
    "compute_errors",
    "sum_parts",
]

# Matches of a batch, and the values of each: x, y, usable; distance, across, along, parallax, weight; the weights of
# its two rows; h of `compute_image_row` along the line and |Jρ|, h across it, standard deviation of ρ due to noise; the
# row along the line with its residual, and that across (derived).
LANES, N_PARTIAL_SUMS, ALONG_ROW, ACROSS_ROW = 32, 8, 20, 33
VALUES_PER_MATCH = ACROSS_ROW + 7


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


class DepthAnchor(NamedTuple):
    """Anchor of a term's depth model (`Stack`).

    Attributes:
        inverse_depth: of g.
        inverse_spread: inverse of the spread.
        anchor0, anchor1: the image of g.
    """

    inverse_depth: float
    inverse_spread: float
    anchor0: float
    anchor1: float


@leaf
def compute_errors(
    anchor: DepthAnchor,
    depth_model: FloatArray,
    tolerance: Tolerance,
    rc: FloatArray,
    tc: FloatArray,
    rotated_center: FloatArray,
    lanes: FloatArray,
) -> None:
    """Compute the errors of a batch of matches and their derivatives by (w, d, α).

    The first five of the `VALUES_PER_MATCH` values are the input, all others are computed.
    """
    variance, residual_depth, shared_residual_depth, cutoff = tolerance
    unit, per_spread, anchor0, anchor1 = anchor
    a0, a1, a2, a3, a4, a5 = (
        depth_model[0],
        depth_model[1],
        depth_model[2],
        depth_model[3],
        depth_model[4],
        depth_model[5],
    )
    r00, r01, r02 = rc[0, 0], rc[0, 1], rc[0, 2]
    r10, r11, r12 = rc[1, 0], rc[1, 1], rc[1, 2]
    r20, r21, r22 = rc[2, 0], rc[2, 1], rc[2, 2]
    t0, t1, t2 = tc[0], tc[1], tc[2]
    g0, g1, g2 = rotated_center[0], rotated_center[1], rotated_center[2]
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
        lanes[(ALONG_ROW) * LANES + k], lanes[(ALONG_ROW + 1) * LANES + k] = s1 * h2 - s2 * h1, s2 * h0 - s0 * h2
        lanes[(ALONG_ROW + 2) * LANES + k], lanes[(ALONG_ROW + 3) * LANES + k] = s0 * h1 - s1 * h0, rho * h0
        lanes[(ALONG_ROW + 4) * LANES + k], lanes[(ALONG_ROW + 5) * LANES + k] = rho * h1, rho * h2
        lanes[(ALONG_ROW + 6) * LANES + k], lanes[(ALONG_ROW + 7) * LANES + k], lanes[(ALONG_ROW + 8) * LANES + k] = (
            length,
            length * p,
            length * q,
        )
        lanes[(ALONG_ROW + 9) * LANES + k], lanes[(ALONG_ROW + 10) * LANES + k] = length * p * p, length * p * q
        lanes[(ALONG_ROW + 11) * LANES + k], lanes[(ALONG_ROW + 12) * LANES + k] = length * q * q, along_error
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
        lanes[(ACROSS_ROW) * LANES + k], lanes[(ACROSS_ROW + 1) * LANES + k] = s1 * h2 - s2 * h1, s2 * h0 - s0 * h2
        lanes[(ACROSS_ROW + 2) * LANES + k], lanes[(ACROSS_ROW + 3) * LANES + k] = s0 * h1 - s1 * h0, rho * h0
        (
            lanes[(ACROSS_ROW + 4) * LANES + k],
            lanes[(ACROSS_ROW + 5) * LANES + k],
            lanes[(ACROSS_ROW + 6) * LANES + k],
        ) = (
            rho * h1,
            rho * h2,
            across_error,
        )
        lanes[16 * LANES + k], lanes[17 * LANES + k], lanes[18 * LANES + k] = h0, h1, h2
        lanes[19 * LANES + k] = depth_gain * np.sqrt(variance * noise_b) * (per_length if has_parallax else 0.0)


@leaf
def add_products(lanes: FloatArray, first: int, size: int, weight: int, weighted: FloatArray, sums: FloatArray) -> None:
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
def sum_parts(parts: FloatArray) -> float:
    """Return the sum of the parts."""
    return float(((parts[0] + parts[4]) + (parts[1] + parts[5])) + ((parts[2] + parts[6]) + (parts[3] + parts[7])))


@leaf
def add_parallax_gradient(
    lanes: FloatArray, count: int, rotated_center: FloatArray, unit: float, gradient: FloatArray
) -> float:
    """Add W Jρ² ∂log|Jρ| by (w, d) of some matches to `gradient` (6,); return W Jρ²."""
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
def add_missing_information(lane: FloatArray, missing: FloatArray) -> None:
    """Add the missing information of a match with uncertain assignment."""
    score = np.empty(6 + DEPTH_MODEL_SIZE)
    for k in range(6 + DEPTH_MODEL_SIZE):
        score[k] = lane[10] * lane[ALONG_ROW + k] * lane[ALONG_ROW + 12]
        if k < 6:
            score[k] += lane[11] * lane[ACROSS_ROW + k] * lane[ACROSS_ROW + 6]
    if lane[11] > 0.0:
        for k in range(6 + DEPTH_MODEL_SIZE):
            for j in range(6 + DEPTH_MODEL_SIZE):
                missing[k, j] += (1.0 - lane[4]) / lane[4] * score[k] * score[j]


@kernel
def add_noise_information(
    lanes: FloatArray,
    count: int,
    variance: float,
    unit: float,
    rc: FloatArray,
    rotated_center: FloatArray,
    noise: FloatArray,
) -> None:
    """Add the expected square of the effect of noise in x (both coordinates) and in ρ on the rows of some matches.

    A change c in the camera's axes moves the image by h·c, and the rotation part of the row by c × h. The products of
    h, summed over the matches, are therefore sufficient.
    """
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
        c0, c1, c2 = (
            (rotated_center[0], rotated_center[1], rotated_center[2])
            if source == 2
            else (rc[0, source], rc[1, source], rc[2, source])
        )
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
