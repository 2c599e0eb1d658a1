"""Iteratively re-weighted least squares on the matches.

It alternates between the motion, the inlier weights and the noise until they converge.
Each round is a Gauss-Newton step on the distances of `match_cost`, with the depth models eliminated term by term. V is
fixed within a step (quasi-likelihood), and weights are bisquare in d. σ comes from the weighted residuals across the
epipolar lines, per term but shrunk towards that of the rig; ζ comes from the residuals along them. A mismatch that is
on its epipolar line by chance is rejected by its distance along the line.

Source: M-estimators of regression and scale, Huber & Ronchetti, "Robust Statistics", chapters 6 and 7;
docs/method/3-pose.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.normal_equations import add_rotated
from sylpose.geometry.numba_linalg import cholesky_solve, compute_sum, kernel, leaf
from sylpose.geometry.robust_loss import bisquare_noise_response
from sylpose.relative_pose.match_cost import (
    InlierPrior,
    MatchErrors,
    Tolerance,
    build_match_equations,
    make_match_equations,
)
from sylpose.relative_pose.schur import compute_depth_prior, make_schur_workspace, reduce_term
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE, Candidate, Stack, apply_step

__all__ = [
    "CONVERGED_DECREASE",
    "CUTOFF",
    "INDEPENDENT_MATCHES",
    "MAX_SIGMA_GROWTH",
    "SIGMA_FLOOR_PX",
    "IrlsFit",
    "has_uniform_residuals",
    "make_empty_irls_fit",
    "run_constrained_irls",
    "run_irls",
]


# Cutoff of d: 94 % efficient with Gaussian noise in both directions, where d² is chi-squared with two degrees of
# freedom (choice); the resulting deficits of the weighted mean square and of the information (derived).
CUTOFF = 5.0
SHRINKAGE, GAIN = bisquare_noise_response(CUTOFF).shrinkage, bisquare_noise_response(CUTOFF).gain
# Mean weight of residuals that are uniform up to the cutoff, and the midpoint between it and the mean weight of noise
# (derived).
UNIFORM_MEAN_WEIGHT = 8.0 / 15.0
MAX_UNIFORM_WEIGHT = 0.5 * (UNIFORM_MEAN_WEIGHT + bisquare_noise_response(CUTOFF).weight)
# Cutoffs of the first rounds are wider by these factors: the initial motion comes from contaminated matches (choice).
EARLY_CUTOFF_FACTORS = (2.0, 1.5, 1.2)
# Minimum number of rounds, while the noise level still changes, and maximum (choice).
MIN_ROUNDS, MAX_ROUNDS = 5, 40
# From this round on, the noise, the residual depths and the excluded cameras follow the residuals (choice).
FIRST_SCALE_ROUND = 2
# From this round on, steps are shortened more and more. After the first few rounds they are also halved, down to a
# tenth, whenever they grow; otherwise they lengthen again. No step rotates by more than the last value, radians
# (choice).
FULL_STEP_ROUNDS, FREE_GROWTH_ROUNDS = 12, 4
STEP_SHRINK_FACTOR, MIN_STEP_LENGTH, STEP_GROWTH_FACTOR = 0.5, 0.1, 1.3
MAX_ROTATION_STEP = 0.3
# Largest relative change of an inverse depth in one step (choice).
MAX_DEPTH_CHANGE = 0.5
# Added to the diagonal of a step's equations, relative to their trace (choice).
RIDGE = 1e-9
# Weight of the constraint, relative to the largest diagonal element of the information (choice).
CONSTRAINT_WEIGHT = 1e6
# Converged if the predicted decrease of the cost is below this: a thirtieth of a standard deviation (choice).
CONVERGED_DECREASE = 5e-4
# Weight of the rig's σ in that of a term, as a number of matches (choice).
RIG_PRIOR_MATCHES = 10.0
# Lower bound of the noise, pixels, and its upper bound relative to that of the seeds: otherwise noise would explain two
# motions, or none (choice).
SIGMA_FLOOR_PX = 0.02
MAX_SIGMA_GROWTH = 2.0
# Share of the depth prior that is kept for the information without it: just enough to determine the depth models
# (choice).
WEAK_PRIOR_SCALE = 1e-6
# One keypoint in ten is this many times as noisy as the others (choice). The resulting cost when motions are compared
# is minus the logarithm of its density in two directions over that of the others (derived). Otherwise a motion with
# more noise, which reaches some of these keypoints, would be likelier than the right one with less noise: the second
# plane of a flat object, for example.
COARSE_SIGMA_FACTOR = 5.0
COARSE_KEYPOINT_COST = float(2.0 * np.log(COARSE_SIGMA_FACTOR) + np.log(10.0))
# A mismatch is anywhere in a square of this many spreads (choice).
MISMATCH_RANGE = 4.0
# Smallest share of the squares left after fitting the unknowns, across the epipolar lines and along them (choice).
MIN_FREEDOM_SHARE, MIN_FREEDOM_SHARE_ALONG = 0.15, 0.1
# Lower bound of the squared residual depth, relative to its prior (choice).
MIN_RESIDUAL_DEPTH_RATIO = 1e-3
# Neighbors have similar residual depths: only this many of a term's matches are independent in this respect (choice).
INDEPENDENT_MATCHES = 6.0
# A camera with at least so many matches of which fewer than this share agree is excluded; junk alone reaches about a
# tenth. This requires another camera with high agreement, or it is undecided which one is right (choice).
MIN_JUDGED_MATCHES, CAMERA_MIN_SHARE = 6, 0.3
HIGH_AGREEMENT = 2.0 * CAMERA_MIN_SHARE


class IrlsFit(NamedTuple):
    """Result of the re-weighted fit: the motion, its inliers and its information (T terms, N matches).

    Attributes:
        candidate: the motion, with quadric depth models.
        sigma_px: (T,) noise, pixels.
        weights: (N,).
        residuals_px: (N,) signed epipolar distances, pixels.
        information: (6, 6) about (w, d).
        information_without_depth: (6, 6) the same without the prior on the depth models (distance and curvature).
        noise_information: (6, 6) the part of both that is caused by noise alone (`MatchEquations`).
        residual_depth: (T,) ζ, the residual depths.
        distance_offset: (1,) distance offset of the object (`Stack`).
    """

    candidate: Candidate
    sigma_px: FloatArray
    weights: FloatArray
    residuals_px: FloatArray
    information: FloatArray
    information_without_depth: FloatArray
    noise_information: FloatArray
    residual_depth: FloatArray
    distance_offset: FloatArray


@kernel
def make_empty_irls_fit(stack: Stack) -> IrlsFit:
    """Return an identity motion without inliers."""
    n, n_matches = stack.focal.shape[0], stack.x.shape[0]
    return IrlsFit(
        Candidate(np.eye(3), np.zeros(3), stack.depth_model_mean.copy()),
        np.ones(n),
        np.zeros(n_matches),
        np.zeros(n_matches),
        np.zeros((6, 6)),
        np.zeros((6, 6)),
        np.zeros((6, 6)),
        stack.residual_depth.copy(),
        np.zeros(1),
    )


@kernel
def run_irls(stack: Stack, usable: InlierPrior, fit: IrlsFit, min_sigma_px: float) -> tuple[int, float, float]:
    """Run re-weighted least squares from one motion, in place: `run_constrained_irls` without a constraint."""
    return run_constrained_irls(stack, usable, fit, min_sigma_px, np.zeros(6))


@kernel
def run_constrained_irls(
    stack: Stack, usable: InlierPrior, fit: IrlsFit, min_sigma_px: float, constraint: FloatArray
) -> tuple[int, float, float]:
    """Run re-weighted least squares from one motion under a linear constraint, in place.

    Args:
        usable: (N,) matches that may be inliers, or the probability of each to be one.
        fit: its candidate and noise are the start; all its arrays receive the result.
        min_sigma_px: lower bound of the noise in addition to the stack's; usually `SIGMA_FLOOR_PX`.
        constraint: (6,) c, the steps keep c' (w, d) constant; zero for no constraint. The information ignores the
            constraint.

    Returns:
        number of rounds; the predicted decrease of the last step, infinite if no match agreed; the negative
        log-likelihood of all usable matches, to compare hypotheses.
    """
    min_sigma_px = max(min_sigma_px, stack.min_sigma_px)
    candidate, sigma_px, weights, across, information, without_depth, noise, residual_depth, distance_offset = fit
    depth_model = candidate.depth_model
    n, n_matches = sigma_px.shape[0], weights.shape[0]
    distance, along, parallax = np.empty(n_matches), np.empty(n_matches), np.empty(n_matches)
    terms = np.empty((2, n_matches))
    matches = MatchErrors(distance, across, along, parallax, weights)
    step_equations, final_equations, gains = (
        make_match_equations(False, False),
        make_match_equations(True, False),
        np.empty((n, DEPTH_MODEL_SIZE, 8)),
    )
    total, right, step, prior = (
        np.empty((7, 7)),
        np.empty(7),
        np.empty(7),
        np.empty((DEPTH_MODEL_SIZE, DEPTH_MODEL_SIZE)),
    )
    weak_prior, total_without_depth = np.empty((DEPTH_MODEL_SIZE, DEPTH_MODEL_SIZE)), np.empty((7, 7))
    unused, mass, workspace = np.empty(7), np.zeros(n), make_schur_workspace()
    residual_depth[:], distance_offset[:] = stack.residual_depth, 0.0
    active = np.ones(n, np.bool_)
    bound = max(MAX_SIGMA_GROWTH * sigma_px.max(), min_sigma_px)
    decrease, length, count, converged = np.inf, 1.0, 0, False
    for count in range(1, MAX_ROUNDS + 2):
        cutoff = CUTOFF * (EARLY_CUTOFF_FACTORS[count - 1] if count <= len(EARLY_CUTOFF_FACTORS) else 1.0)
        total[:] = 0.0
        total_without_depth[:] = 0.0
        noise[:] = 0.0
        right[:] = 0.0
        # Prior of the distance offset: standard deviation 1.
        total[6, 6], right[6] = 1.0, -distance_offset[0]
        for t in range(n):
            equations = final_equations if converged else step_equations
            shared_residual_depth = residual_depth[t] * np.sqrt(max(1.0, mass[t] / INDEPENDENT_MATCHES))
            tolerance = Tolerance((sigma_px[t] / stack.focal[t]) ** 2, residual_depth[t], shared_residual_depth, cutoff)
            build_match_equations(stack, t, usable, candidate, tolerance, matches, equations)
            compute_depth_prior(stack, t, depth_model[t], distance_offset[0], prior)
            if converged and active[t]:
                # The last round only evaluates the information.
                for k in range(DEPTH_MODEL_SIZE):
                    for j in range(DEPTH_MODEL_SIZE):
                        weak_prior[k, j] = WEAK_PRIOR_SCALE * prior[k, j]
                reduce_term(
                    stack,
                    t,
                    depth_model[t],
                    distance_offset[0],
                    weak_prior,
                    equations,
                    total_without_depth,
                    unused,
                    gains[t],
                    workspace,
                )
                add_rotated(equations.noise_information, stack.qy[t], noise)
            if not active[t]:
                gains[t] = 0.0
            elif not reduce_term(
                stack, t, depth_model[t], distance_offset[0], prior, equations, total, right, gains[t], workspace
            ):
                return count, np.inf, np.inf
        without_depth[:] = total_without_depth[:6, :6]
        for i in range(6):
            for j in range(6):
                information[i, j] = total[i, j] - total[i, 6] * total[6, j] / total[6, 6]
        if converged:
            # A rotation that is determined by noise alone never converges: discount the information that noise causes.
            step[:] = right
            if decrease >= CONVERGED_DECREASE and cholesky_solve(total, step):
                decrease = 0.5 * step[6] * right[6]
                for i in range(6):
                    decrease += 0.5 * step[i] * right[i]
                    for j in range(6):
                        decrease -= 0.5 * step[i] * noise[i, j] * step[j]
                decrease = max(decrease, 0.0)
            break
        # Rotations and translations have different units: each block is regularized by its own trace, which fixes
        # unobservable directions.
        rotation_trace, translation_trace = (
            total[0, 0] + total[1, 1] + total[2, 2],
            total[3, 3] + total[4, 4] + total[5, 5],
        )
        for i in range(3):
            total[i, i] += RIDGE * rotation_trace
            total[3 + i, 3 + i] += RIDGE * translation_trace
        largest = 0.0
        for i in range(6):
            largest = max(largest, total[i, i])
        for i in range(6):
            for j in range(6):
                total[i, j] += CONSTRAINT_WEIGHT * largest * constraint[i] * constraint[j]
        step[:] = right
        if not cholesky_solve(total, step):
            return count, np.inf, np.inf
        last_decrease, decrease = decrease, 0.0
        for i in range(7):
            decrease += 0.5 * step[i] * right[i]
        # Growing steps overshoot, and changing inliers cause cycles: shorter steps converge.
        growing = decrease > last_decrease and count > FREE_GROWTH_ROUNDS
        length = max(STEP_SHRINK_FACTOR * length, MIN_STEP_LENGTH) if growing else min(STEP_GROWTH_FACTOR * length, 1.0)
        if count > FULL_STEP_ROUNDS:
            length = min(length, FULL_STEP_ROUNDS / count)
        angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        length_now = length * min(1.0, MAX_ROTATION_STEP / max(angle, 1e-300))
        for t in range(n):
            # Keep the object in front of its cameras.
            depth_change = gains[t, 0, 7]
            for j in range(7):
                depth_change -= gains[t, 0, j] * step[j]
            length_now = min(length_now, MAX_DEPTH_CHANGE * abs(depth_model[t, 0]) / max(abs(depth_change), 1e-300))
        apply_step(candidate, distance_offset, step, gains, length_now)
        for t in range(n):
            mass[t] = compute_sum(weights[stack.offsets[t] : stack.offsets[t + 1]])
        if count >= FIRST_SCALE_ROUND:
            _exclude_terms(stack, usable, weights, active)
            _update_sigma(stack, weights, across, active, sigma_px, mass, terms[0])
            sigma_px[:] = np.minimum(np.maximum(sigma_px, min_sigma_px), bound)
            _update_residual_depth(stack, weights, along, parallax, sigma_px, residual_depth, terms)
        converged = (count >= MIN_ROUNDS and decrease < CONVERGED_DECREASE) or count == MAX_ROUNDS
    cost, density = 0.5 * distance_offset[0] ** 2, 0.0
    for t in range(n):
        cost += compute_depth_prior(stack, t, depth_model[t], distance_offset[0], prior)
        f, variance = stack.focal[t], (sigma_px[t] / stack.focal[t]) ** 2
        mismatch_density = np.log((MISMATCH_RANGE * stack.spread[t]) ** 2 / (2.0 * np.pi))
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if usable[i]:
                density = 0.5 * np.log(variance * (variance + (residual_depth[t] * parallax[i]) ** 2))
                near = min(0.5 * distance[i], 0.5 * distance[i] / COARSE_SIGMA_FACTOR**2 + COARSE_KEYPOINT_COST)
                cost += usable[i] * (min(near + density, max(mismatch_density, density)) - mismatch_density)
            across[i] *= f
            if not active[t]:
                weights[i] = 0.0
    for i in range(6):
        for j in range(6):
            information[i, j] *= GAIN
            without_depth[i, j] *= GAIN
            noise[i, j] *= GAIN
    return count, decrease, cost


@leaf
def _update_residual_depth(
    stack: Stack,
    weights: FloatArray,
    along: FloatArray,
    parallax: FloatArray,
    sigma_px: FloatArray,
    residual_depth: FloatArray,
    work: FloatArray,
) -> None:
    """Update `residual_depth` (T,): ζ by the method of moments, shrunk towards its prior.

    It is the excess of the squares along the epipolar lines over the noise. The prior dominates if the parallax is too
    small. The work array `work` (2, N) is overwritten.
    """
    for t in range(residual_depth.shape[0]):
        variance = (sigma_px[t] / stack.focal[t]) ** 2
        prior_variance, square = stack.residual_depth[t] ** 2, residual_depth[t] ** 2
        first, last = stack.offsets[t], stack.offsets[t + 1]
        w, p, residual, terms = weights[first:last], parallax[first:last], along[first:last], work[:, first:last]
        for i in range(last - first):
            # The variance of a squared normal variable is twice the square of its variance.
            p2, is_inlier = p[i] * p[i], w[i] > 0.0
            weight = w[i] * p2 / (2.0 * (variance + square * p2) * (variance + square * p2))
            terms[0, i] = weight * (residual[i] * residual[i] / SHRINKAGE - variance) if is_inlier else 0.0
            terms[1, i] = weight * p2
        excess, certainty, mass = compute_sum(terms[0]), compute_sum(terms[1]), compute_sum(w)
        # The depth model's unknowns absorb a share of the squares.
        freedom = max(1.0 - DEPTH_MODEL_SIZE / max(mass, float(DEPTH_MODEL_SIZE)), MIN_FREEDOM_SHARE_ALONG)
        z2 = (excess + 1.0 / prior_variance) / (freedom * certainty + 1.0 / prior_variance**2)
        residual_depth[t] = np.sqrt(max(z2, MIN_RESIDUAL_DEPTH_RATIO * prior_variance))


@kernel
def _update_sigma(
    stack: Stack,
    weights: FloatArray,
    across: FloatArray,
    active: BoolArray,
    sigma_px: FloatArray,
    mass: FloatArray,
    work: FloatArray,
) -> None:
    """Update `sigma_px` (T,) from the weighted residuals.

    mass (T,) are the sums of the weights. The work array `work` (N,) is overwritten.
    """
    n = sigma_px.shape[0]
    squares, inliers, rig, rig_mass = np.zeros(n), 0, 0.0, 0.0
    for t in range(n):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        w, residual, terms, count = weights[first:last], across[first:last], work[first:last], 0
        for i in range(last - first):
            inside = w[i] > 0.0
            terms[i] = w[i] * residual[i] * residual[i] if inside else 0.0
            count += inside
        squares[t] = compute_sum(terms) * stack.focal[t] ** 2 / SHRINKAGE
        if active[t]:
            inliers += count
            rig += squares[t]
            rig_mass += mass[t]
    if inliers == 0:
        return
    # The motion's six unknowns absorb a share of the squares.
    freedom = max(1.0 - 6.0 / inliers, MIN_FREEDOM_SHARE)
    rig = rig / max(rig_mass, 1e-12) / freedom
    for t in range(n):
        square = (squares[t] / freedom + RIG_PRIOR_MATCHES * rig) / (mass[t] + RIG_PRIOR_MATCHES)
        sigma_px[t] = np.sqrt(square)


@kernel
def _exclude_terms(stack: Stack, usable: InlierPrior, weights: FloatArray, active: BoolArray) -> None:
    """Set `active` (T,): False for terms with few agreeing matches, if another term has many."""
    n = stack.focal.shape[0]
    share, best = np.ones(n), 0.0
    for t in range(n):
        agreeing_mass, usable_mass = 0.0, 0.0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            usable_mass += usable[i]
            agreeing_mass += usable[i] if weights[i] > 0.0 else 0.0
        if usable_mass >= MIN_JUDGED_MATCHES:
            share[t] = agreeing_mass / usable_mass
            best = max(best, share[t])
    for t in range(n):
        active[t] = best < HIGH_AGREEMENT or share[t] >= CAMERA_MIN_SHARE


@kernel
def has_uniform_residuals(weights: FloatArray) -> bool:
    """Return whether the weights (N,) indicate uniform residuals instead of noise.

    The inliers were then selected by the noise bound.
    """
    inliers, mass = 0, 0.0
    for w in weights:
        inliers += w > 0.0
        mass += w
    return bool(mass < MAX_UNIFORM_WEIGHT * inliers)
