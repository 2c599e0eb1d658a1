"""Schur complement of a term's depth model, and the prior on depth models (compiled)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import add_rotated, eliminate_block, rotate_rows
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.match_cost import MatchEquations
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE, Stack

__all__ = ["SchurWorkspace", "compute_depth_prior", "make_schur_workspace", "reduce_term"]

# Fitting α to noise makes the parallax, and so the motion, look larger than it is. Integrating α out of the likelihood
# removes this bias if surfaces are as curved as the prior, and overcorrects if they are flatter. This share of the
# correction is a compromise, hardly worse than either at its best (measured: docs/history/benchmarks.md#two-frames).
MARGINALIZED_SHARE = 0.5
# The prior of the slopes is a two-dimensional Cauchy distribution, Student's with one degree of freedom: 1 + 2
# (derived).
STUDENT_EXPONENT = 3.0


class SchurWorkspace(NamedTuple):
    """Work arrays of `reduce_term`, allocated once for all terms: `block`, `inverse` (6, 6), `reduced` (7, 8)."""

    block: FloatArray
    inverse: FloatArray
    reduced: FloatArray


@kernel
def make_schur_workspace() -> SchurWorkspace:
    """Allocate the work arrays."""
    return SchurWorkspace(
        np.empty((DEPTH_MODEL_SIZE, DEPTH_MODEL_SIZE)), np.empty((DEPTH_MODEL_SIZE, DEPTH_MODEL_SIZE)), np.empty((7, 8))
    )


@leaf
def reduce_term(
    stack: Stack,
    t: int,
    depth_model: FloatArray,
    distance_offset: float,
    prior: FloatArray,
    equations: MatchEquations,
    total: FloatArray,
    right: FloatArray,
    gain: FloatArray,
    workspace: SchurWorkspace,
) -> bool:
    """Add term t's equations, its depth model eliminated, to total (7, 7) and right (7,), in world axes.

    The unknowns are (w, d) and the distance offset z, which adds `stack.distance_gain[t]` z to the first mean of α.
    gain (6, 8) receives the response of the depth model: α changes by gain[:, 7] - gain[:, :7] (w, d, z).

    Returns:
        whether the elimination succeeded.
    """
    block, inverse, reduced = workspace
    for i in range(7):
        for j in range(8):
            reduced[i, j] = 0.0
    q, distance_gain = stack.qy[t], stack.distance_gain[t]
    rotate_rows(equations.matrix[DEPTH_MODEL_SIZE:], q, gain)
    add_rotated(equations.matrix, q, reduced)
    reduced[6, 6] = distance_gain * distance_gain * prior[0, 0]
    for k in range(DEPTH_MODEL_SIZE):
        gain[k, 6] = -distance_gain * prior[k, 0]
        gain[k, 7] = equations.right[6 + k]
        for j in range(DEPTH_MODEL_SIZE):
            deviation = (
                depth_model[j] - stack.depth_model_mean[t, j] - (distance_gain * distance_offset if j == 0 else 0.0)
            )
            gain[k, 7] -= prior[k, j] * deviation
            if k == 0:
                reduced[6, 7] += distance_gain * prior[0, j] * deviation
            block[k, j] = equations.matrix[6 + k, 6 + j] + prior[k, j]
    if not eliminate_block(block, gain, reduced):
        return False
    # Number of unknowns in α that the data determine: trace of block^-1 (block - prior).
    unknowns = float(DEPTH_MODEL_SIZE)
    for c in range(DEPTH_MODEL_SIZE):
        # Column c of the factor's inverse, times its own products.
        for i in range(c, DEPTH_MODEL_SIZE):
            s = 1.0 if i == c else 0.0
            for k in range(c, i):
                s -= block[i, k] * inverse[k, c]
            inverse[i, c] = s / block[i, i]
    for i in range(DEPTH_MODEL_SIZE):
        for j in range(i + 1):
            s = 0.0
            for k in range(i, DEPTH_MODEL_SIZE):
                s += inverse[k, i] * inverse[k, j]
            unknowns -= (1.0 if i == j else 2.0) * s * prior[i, j]
    # The derivative of log det(block) / 2, from the likelihood with α integrated out.
    correction = MARGINALIZED_SHARE * unknowns / max(equations.parallax_squares[0], 1e-300)
    for i in range(6):
        h, j = i // 3, i % 3
        for a in range(3):
            right[i] += q[a, j] * (equations.right[3 * h + a] - correction * equations.parallax_gradient[3 * h + a])
    for i in range(7):
        right[i] += reduced[i, 7]
        for j in range(7):
            total[i, j] += reduced[i, j]
    return True


@leaf
def compute_depth_prior(
    stack: Stack, t: int, depth_model: FloatArray, distance_offset: float, prior: FloatArray
) -> float:
    """Set prior (6, 6), the prior information of α, and return the prior cost.

    Slopes have heavy tails (a Cauchy distribution in two dimensions): a plane may be seen at a grazing angle.
    """
    slope_square, cost, mean, information = 0.0, 0.0, stack.depth_model_mean[t], stack.depth_model_information[t]
    mean_offset = stack.distance_gain[t] * distance_offset
    for k in range(DEPTH_MODEL_SIZE):
        part, deviation = 0.0, depth_model[k] - mean[k] - (mean_offset if k == 0 else 0.0)
        for j in range(DEPTH_MODEL_SIZE):
            prior[k, j] = information[k, j]
            part += prior[k, j] * (depth_model[j] - mean[j] - (mean_offset if j == 0 else 0.0))
        if k == 1 or k == 2:
            slope_square += part * deviation
        else:
            cost += 0.5 * part * deviation
    for k in range(1, 3):
        prior[k, k] *= STUDENT_EXPONENT / (1.0 + slope_square)
    return float(cost + 0.5 * STUDENT_EXPONENT * np.log(1.0 + slope_square))
