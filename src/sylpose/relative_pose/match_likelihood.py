"""Likelihood of each match under a motion, and the information lost to uncertain match assignment.

Source: missing information, Louis, Journal of the Royal Statistical Society B 44, 1982, equation 3.1.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.relative_pose.irls import CUTOFF, GAIN, INDEPENDENT_MATCHES, IrlsFit
from sylpose.relative_pose.match_cost import (
    Tolerance,
    build_match_equations,
    compute_distances,
    make_match_equations,
    make_match_errors,
)
from sylpose.relative_pose.schur import compute_depth_prior, make_schur_workspace, reduce_term
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE, Stack

__all__ = [
    "MISMATCH_PROBABILITY",
    "compute_cost",
    "compute_mismatch_density",
    "compute_missing_information",
    "compute_motion_density",
]

# With this probability a match is anywhere in a square of so many spreads (choice).
MISMATCH_RANGE, MISMATCH_PROBABILITY = 4.0, 0.05


@kernel
def compute_motion_density(stack: Stack, fit: IrlsFit) -> FloatArray:
    """Return (N,) densities of the matches under the motion, per square pixel."""
    n_matches = len(stack.x)
    out, all_usable, matches = np.empty(n_matches), np.ones(n_matches), make_match_errors(n_matches)
    for t in range(len(stack.focal)):
        variance, residual_depth = (fit.sigma_px[t] / stack.focal[t]) ** 2, fit.residual_depth[t]
        compute_distances(
            stack, t, all_usable, fit.candidate, Tolerance(variance, residual_depth, residual_depth, CUTOFF), matches
        )
        peak_density = 1.0 / (4.0 * np.pi * fit.sigma_px[t] ** 2)
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            spread = np.sqrt(1.0 + (residual_depth * matches.parallax[i]) ** 2 / variance)
            out[i] = peak_density * np.exp(-0.5 * min(matches.distance[i], 1e3)) / spread
    return out


def compute_mismatch_density(stack: Stack) -> FloatArray:
    """Return (N,) densities of the matches as mismatches, per square pixel."""
    return np.repeat(1.0 / (MISMATCH_RANGE * stack.spread * stack.focal) ** 2, np.diff(stack.offsets))


@kernel
def compute_cost(stack: Stack, usable: BoolArray, density: FloatArray) -> float:
    """Return the negative log-likelihood of densities (N,) per square pixel, comparable to the cost of `run_irls`."""
    cost = 0.0
    for t in range(len(stack.focal)):
        least = 0.5 / (MISMATCH_RANGE * stack.spread[t] * stack.focal[t]) ** 2
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if usable[i] and density[i] > least:
                cost -= np.log(density[i] / least)
    return cost


def compute_missing_information(stack: Stack, fit: IrlsFit, probabilities: FloatArray) -> FloatArray:
    """Return (6, 6) Louis's missing information about (w, d); the depth models follow the motion as in the fit."""
    n_matches, total = len(stack.x), np.zeros((7, 7))
    out, right, gain, prior = (
        np.zeros((6, 6)),
        np.zeros(7),
        np.zeros((DEPTH_MODEL_SIZE, 8)),
        np.zeros((DEPTH_MODEL_SIZE, DEPTH_MODEL_SIZE)),
    )
    matches, equations, rotation_blocks = (
        make_match_errors(n_matches),
        make_match_equations(False, True),
        np.zeros((6, 6)),
    )
    workspace = make_schur_workspace()
    for t in range(len(stack.focal)):
        mass = fit.weights[stack.offsets[t] : stack.offsets[t + 1]].sum()
        shared_residual_depth = fit.residual_depth[t] * np.sqrt(max(1.0, mass / INDEPENDENT_MATCHES))
        tolerance = Tolerance(
            (fit.sigma_px[t] / stack.focal[t]) ** 2, fit.residual_depth[t], shared_residual_depth, CUTOFF
        )
        build_match_equations(stack, t, probabilities, fit.candidate, tolerance, matches, equations)
        compute_depth_prior(stack, t, fit.candidate.depth_model[t], fit.distance_offset[0], prior)
        depth_model = fit.candidate.depth_model[t]
        if not reduce_term(
            stack, t, depth_model, fit.distance_offset[0], prior, equations, total, right, gain, workspace
        ):
            continue
        # Derivative of motion and depth model, (12,), with respect to the motion in world axes.
        rotation_blocks[:3, :3] = rotation_blocks[3:, 3:] = stack.qy[t]
        jacobian = np.vstack([rotation_blocks, -gain[:, :6]])
        out += GAIN * (jacobian.T @ equations.missing_information @ jacobian)
    return out
