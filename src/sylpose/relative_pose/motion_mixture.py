"""Mixture of two motions in one set of matches: its detection and its fit.

Two adjacent bodies that move nearly alike can be explained by one motion and a bent depth model. The residuals are then
slightly too large, which a robust weight does not detect. But residuals across epipolar lines are independent noise,
whereas a wrong motion causes similar errors for neighbors (`correlate_neighbors`).

If both motions are known, many matches of one are near the epipolar lines of the other. Each match is then assigned to
one of them with a probability (`fit_motion_mixture`).

Source: contiguity, Moran, Biometrika 37, 1950; mixtures by expectation maximization, McLachlan & Krishnan, "The EM
Algorithm and Extensions", chapters 2 and 4; missing information, Louis, Journal of the Royal
Statistical Society B 44, 1982, equation 3.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.relative_pose.irls import (
    CUTOFF,
    GAIN,
    SIGMA_FLOOR_PX,
    IrlsFit,
    make_empty_irls_fit,
    make_joint_equations,
    make_schur_workspace,
    make_tolerance,
    reduce_term,
    run_irls,
)
from sylpose.relative_pose.match_cost import (
    Tolerance,
    build_match_equations,
    compute_distances,
    make_match_equations,
    make_match_errors,
)
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE, Stack

# With this probability a match is anywhere in a square of so many spreads (choice).
MISMATCH_RANGE, MISMATCH_PROBABILITY = 4.0, 0.05
# Number of image neighbors that a match's residual is compared with, and maximum number of matches per camera (choice).
N_NEIGHBORS, MAX_COMPARED = 3, 120
# Least weight for the comparison; matches below may belong to another motion (choice).
MIN_COMPARED_WEIGHT = 0.3
# Cameras with fewer matches are skipped (choice).
MIN_JUDGED_MATCHES = 8
# Residuals are correlated if their correlation exceeds zero by so many standard deviations, of about 1.3 (measured: 150
# scenes of each of ten settings of benchmarks/nees.py, 4.2 at most), and the second value: with many matches, small
# calibration errors are detected too (choice).
MIN_CORRELATION_SIGMAS, MIN_CORRELATION = 5.0, 0.15
# If a motion is weakly observed (`compute_size_if_curved`) or the assignment of matches is uncertain, a motion between
# two bodies is more frequent, and this is sufficient (measured: of 7,508 right answers 13 that are weakly observed are
# beyond, of 82 wrong ones 16).
MIN_SIGMAS_UNCERTAIN = 2.5
# Their shared error must also exceed this, pixels: smaller ones are rounding, lenses and keypoints (choice).
MIN_SHARED_ERROR_PX = 0.1
# Maximum number of EM rounds, and the largest change of an assignment at convergence; one motion's noise is at least
# the last share of the other's (choice).
MAX_ROUNDS, CONVERGED_CHANGE = 40, 0.02
MIN_SIGMA_RATIO = 0.9


@kernel
def correlate_neighbors(stack: Stack, fit: IrlsFit) -> tuple[float, float, float]:
    """Correlate the residuals of neighboring matches.

    Returns:
        the correlation; its number of standard deviations; the covariance, square pixels.
    """
    total, shared, pairs = 0.0, 0.0, 0
    index, nearest, squares = np.empty(MAX_COMPARED, np.int64), np.empty(N_NEIGHBORS, np.int64), np.empty(N_NEIGHBORS)
    u, v = np.empty(MAX_COMPARED), np.empty(MAX_COMPARED)
    for t in range(stack.focal.shape[0]):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        n, stride = 0, 1 + (last - first) // MAX_COMPARED
        for i in range(first, last, stride):
            if fit.weights[i] > MIN_COMPARED_WEIGHT:
                # Sort from left to right, so that neighbors are found first.
                k = n
                while k > 0 and u[k - 1] > stack.x[i, 0]:
                    index[k], u[k], v[k] = index[k - 1], u[k - 1], v[k - 1]
                    k -= 1
                index[k], u[k], v[k] = i, stack.x[i, 0], stack.x[i, 1]
                n += 1
        if n < MIN_JUDGED_MATCHES:
            continue
        for k in range(n):
            i = index[k]
            squares[:], nearest[:] = np.inf, i
            for direction in range(-1, 2, 2):
                j = k + direction
                while 0 <= j < n:
                    horizontal = (u[k] - u[j]) ** 2
                    if not horizontal < squares[N_NEIGHBORS - 1]:
                        break
                    far = horizontal + (v[k] - v[j]) ** 2
                    # A duplicate match is no evidence.
                    if far < squares[N_NEIGHBORS - 1] and far > 0.0:
                        place = N_NEIGHBORS - 1
                        while place > 0 and far < squares[place - 1]:
                            squares[place], nearest[place] = squares[place - 1], nearest[place - 1]
                            place -= 1
                        squares[place], nearest[place] = far, index[j]
                    j += direction
            for place in range(N_NEIGHBORS):
                if squares[place] < np.inf:
                    product = fit.residuals_px[i] * fit.residuals_px[nearest[place]]
                    shared += product
                    total += product / fit.sigma_px[t] ** 2
                    pairs += 1
    if pairs == 0:
        return 0.0, 0.0, 0.0
    return total / pairs, total / np.sqrt(pairs), shared / pairs


@kernel
def is_mixed(correlation: float, deviations: float, covariance: float, is_uncertain: bool) -> bool:
    """Return whether the correlation of neighbors exceeds what one motion and noise explain.

    Args:
        correlation, deviations, covariance: of `correlate_neighbors`.
        is_uncertain: whether the motion is weakly observed, or the assignment of matches is uncertain.
    """
    significant = deviations > (MIN_SIGMAS_UNCERTAIN if is_uncertain else MIN_CORRELATION_SIGMAS)
    return bool(significant and correlation > MIN_CORRELATION and covariance > MIN_SHARED_ERROR_PX**2)


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
    out, gain, rotation_blocks = np.zeros((6, 6)), np.zeros((DEPTH_MODEL_SIZE, 8)), np.zeros((6, 6))
    matches, equations = make_match_errors(len(stack.x)), make_match_equations(False, True)
    joint, workspace = make_joint_equations(), make_schur_workspace()
    for t in range(len(stack.focal)):
        mass = fit.weights[stack.offsets[t] : stack.offsets[t + 1]].sum()
        tolerance = make_tolerance(stack, t, fit, float(mass), CUTOFF)
        build_match_equations(stack, t, probabilities, fit.candidate, tolerance, matches, equations)
        if not reduce_term(stack, t, fit.candidate, fit.distance_offset, equations, 1.0, joint, gain, workspace):
            continue
        # Derivative of motion and depth model, (12,), with respect to the motion in world axes.
        rotation_blocks[:3, :3] = rotation_blocks[3:, 3:] = stack.qy[t]
        jacobian = np.vstack([rotation_blocks, -gain[:, :6]])
        out += GAIN * (jacobian.T @ equations.missing_information @ jacobian)
    return out


class MotionMixture(NamedTuple):
    """Mixture of two motions.

    Attributes:
        fits: the two motions; their weights include the assignment probabilities.
        probabilities: (2, N) the assignment probabilities.
        cost: negative log-likelihood of the matches.
        predicted_decrease: the predicted decrease of the last steps (`run_irls`), the larger of the two.
        iterations: of the solver.
    """

    fits: tuple[IrlsFit, IrlsFit]
    probabilities: FloatArray
    cost: float
    predicted_decrease: float
    iterations: int


def fit_motion_mixture(
    stack: Stack, starts: Sequence[tuple[FloatArray, FloatArray]], inliers: Sequence[BoolArray]
) -> MotionMixture:
    """Fit a mixture of two motions by expectation maximization.

    Args:
        starts: two motions (R, d).
        inliers: (N,) their inliers, which may overlap.
    """
    fits, probabilities = (make_empty_irls_fit(stack), make_empty_irls_fit(stack)), np.zeros((2, len(stack.x)))
    decreases, iterations = [np.inf, np.inf], 0
    for k, ((rotation, translation), own_inliers) in enumerate(zip(starts, inliers, strict=True)):
        fits[k].candidate.rotation[:], fits[k].candidate.translation[:] = rotation, translation
        iterations += run_irls(stack, (own_inliers & ~inliers[1 - k]).astype(float), fits[k], SIGMA_FLOOR_PX)[0]
    shares, all_usable = np.full(2, 0.5), np.ones(len(stack.x), dtype=bool)
    mismatch_density = MISMATCH_PROBABILITY * compute_mismatch_density(stack)
    for _ in range(MAX_ROUNDS):
        densities = [compute_motion_density(stack, f) for f in fits]
        joint = np.stack([s * (1.0 - MISMATCH_PROBABILITY) * d for s, d in zip(shares, densities, strict=True)])
        previous, probabilities = probabilities, joint / (joint.sum(axis=0) + mismatch_density)
        shares = probabilities.sum(axis=1) / max(float(probabilities.sum()), 1e-300)
        for k in range(2):
            # Bound the noise ratio: otherwise a few accidental matches with little noise would form a body.
            min_sigma_px = MIN_SIGMA_RATIO * float(np.median(fits[1 - k].sigma_px))
            done, decreases[k], _ = run_irls(stack, probabilities[k], fits[k], min_sigma_px)
            iterations += done
        if np.abs(probabilities - previous).max() < CONVERGED_CHANGE or not max(decreases) < np.inf:
            break
    density = shares[0] * compute_motion_density(stack, fits[0]) + shares[1] * compute_motion_density(stack, fits[1])
    return MotionMixture(fits, probabilities, compute_cost(stack, all_usable, density), max(decreases), iterations)
