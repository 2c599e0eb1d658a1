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
from sylpose.geometry.normal_equations import add_rotated, eliminate_block, rotate_rows
from sylpose.geometry.numba_linalg import cholesky, cholesky_solve, compute_sum, dot, kernel, leaf
from sylpose.geometry.robust_loss import RIG_PRIOR_MATCHES, bisquare_noise_response
from sylpose.relative_pose.limits import (
    CONVERGED_DECREASE,
    CUTOFF,
    HALF_DIGITS,
    MAX_ROTATION_STEP,
    MAX_ROUNDS,
    MAX_SIGMA_GROWTH,
    MIN_SHARE,
)
from sylpose.relative_pose.match_cost import (
    InlierPrior,
    MatchEquations,
    MatchErrors,
    Tolerance,
    build_match_equations,
    make_match_equations,
    make_term,
)
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE, MIN_MATCHES, Candidate, Stack, apply_step, copy_into

# The deficits of the weighted mean square and of the information that result from the cutoff of d (derived).
SHRINKAGE, GAIN = bisquare_noise_response(CUTOFF).shrinkage, bisquare_noise_response(CUTOFF).gain
# Mean weight of residuals that are uniform up to the cutoff (derived).
UNIFORM_MEAN_WEIGHT = 8.0 / 15.0
# The midpoint between it and the mean weight of noise (derived).
MAX_UNIFORM_WEIGHT = 0.5 * (UNIFORM_MEAN_WEIGHT + bisquare_noise_response(CUTOFF).weight)
# Cutoffs of the first rounds are wider by these factors: the initial motion comes from contaminated matches (choice).
EARLY_CUTOFF_FACTORS = (2.0, 1.5, 1.2)
# From this round on, steps are shortened more and more. They are also shortened by the second value where they grow, but not
# below the third one, and lengthen again by the fourth one (choice: with 2, motions that are hardly determined do not
# converge; without the third one, cameras keep a second motion).
FULL_STEP_ROUNDS, STEP_SHRINK_FACTOR, MIN_STEP_LENGTH, STEP_GROWTH_FACTOR = 12, 0.5, 0.1, 1.3
# Largest relative change of an inverse depth in one step (choice).
MAX_DEPTH_CHANGE = 0.5
# The prior of the slopes is a two-dimensional Cauchy distribution, Student's with one degree of freedom: 1 + 2
# (derived).
STUDENT_EXPONENT = 3.0
# One keypoint in ten is this many times as noisy as the others (choice). Otherwise a motion with more noise, which reaches
# some of these keypoints, would be likelier than the right one with less noise: the second plane of a flat object, for
# example.
COARSE_SIGMA_FACTOR = 5.0
# Its cost when motions are compared: minus the logarithm of its density in two directions over that of the others (derived).
COARSE_KEYPOINT_COST = float(2.0 * np.log(COARSE_SIGMA_FACTOR) + np.log(10.0))
# A mismatch is anywhere in a square around the object's image, as wide as its diameter: this many spreads (derived).
MISMATCH_RANGE = 4.0
# Unknowns of the motion (derived).
N_MOTION = 6
# They absorb a share of the squares; of the fewest matches that are fitted, this is left (derived). So is of a depth model,
# whose term may have fewer (choice).
MIN_FREEDOM_SHARE = 1.0 - N_MOTION / MIN_MATCHES
# A camera is rejected as a whole if at most this share of its matches are inliers, and it may be at fault if most of the
# others' are: otherwise two motions are about equally large (choice).
MAX_REJECTED_SHARE = 0.2


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


class JointSystem(NamedTuple):
    """Normal equations of T terms in (w, d) and the distance offset, with the depth models eliminated.

    Attributes:
        total, right: (7, 7), (7,) the equations.
        gains: (T, 6, 8) the responses of the depth models (`reduce_term`).
        block, inverse, prior, reduced: (6, 6), (6, 6), (6, 6), (7, 8) work arrays.
    """

    total: FloatArray
    right: FloatArray
    gains: FloatArray
    block: FloatArray
    inverse: FloatArray
    prior: FloatArray
    reduced: FloatArray


@kernel
def make_joint_system(n: int) -> JointSystem:
    """Allocate zero equations of n terms."""
    k, gains = DEPTH_MODEL_SIZE, np.zeros((n, DEPTH_MODEL_SIZE, 8))
    return JointSystem(
        np.zeros((7, 7)), np.zeros(7), gains, np.empty((k, k)), np.empty((k, k)), np.empty((k, k)), np.empty((7, 8))
    )


@kernel
def make_empty_irls_fit(stack: Stack) -> IrlsFit:
    """Return an identity motion without inliers."""
    n, m = stack.focal.shape[0], stack.x.shape[0]
    candidate = Candidate(np.eye(3), np.zeros(3), stack.depth_model_mean.copy())
    sigma_px, weights, residuals_px, residual_depth = np.ones(n), np.zeros(m), np.zeros(m), stack.residual_depth.copy()
    information, without_depth, noise = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    return IrlsFit(
        candidate, sigma_px, weights, residuals_px, information, without_depth, noise, residual_depth, np.zeros(1)
    )


@kernel
def copy_fit(target: IrlsFit, source: IrlsFit) -> None:
    """Copy the values of `source` into the arrays of `target`."""
    copy_into(target.candidate, source.candidate)
    target.sigma_px[:], target.weights[:], target.residuals_px[:] = source.sigma_px, source.weights, source.residuals_px
    target.information[:], target.information_without_depth[:] = source.information, source.information_without_depth
    target.noise_information[:], target.residual_depth[:] = source.noise_information, source.residual_depth
    target.distance_offset[:] = source.distance_offset


def make_irls_start(stack: Stack, candidate: Candidate, sigma_px: FloatArray) -> IrlsFit:
    """Return a fit that starts from a candidate and a noise (T,)."""
    fit = make_empty_irls_fit(stack)
    copy_into(fit.candidate, candidate)
    fit.sigma_px[:] = sigma_px
    return fit


def run_irls(stack: Stack, usable: InlierPrior, fit: IrlsFit, min_sigma_px: float) -> tuple[int, float, float]:
    """Run re-weighted least squares from one motion, in place: `run_constrained_irls` without a constraint."""
    return run_constrained_irls(stack, usable, fit, min_sigma_px, np.zeros(6))


class _Workspace(NamedTuple):
    """Work arrays of a fit of T terms and N matches.

    Attributes:
        matches: the errors of all matches; `across` and `weights` are the fit's own.
        equations, final_equations: of one term, the latter with the noise part.
        joint, joint_without_depth: of all terms, with the prior on the depth models and with hardly any.
        step: (7,).
        mass, active: (T,) the sums of the weights, and whether the term is used.
        sums: (2, N) terms of sums.
        complexity: (1,) cost of the depth models' unknowns (`_measure_complexity`).
    """

    matches: MatchErrors
    equations: MatchEquations
    final_equations: MatchEquations
    joint: JointSystem
    joint_without_depth: JointSystem
    step: FloatArray
    mass: FloatArray
    active: BoolArray
    sums: FloatArray
    complexity: FloatArray


@kernel
def _make_workspace(fit: IrlsFit) -> _Workspace:
    """Allocate the work arrays for a fit."""
    n, m = fit.sigma_px.shape[0], fit.weights.shape[0]
    matches = MatchErrors(np.empty(m), fit.residuals_px, np.empty(m), np.empty(m), fit.weights)
    equations, final_equations = make_match_equations(False), make_match_equations(True)
    joint, without_depth = make_joint_system(n), make_joint_system(n)
    step, mass, active, sums = np.empty(7), np.zeros(n), np.ones(n, np.bool_), np.empty((2, m))
    return _Workspace(matches, equations, final_equations, joint, without_depth, step, mass, active, sums, np.zeros(1))


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
    min_sigma_px, sigma_px, depth_model = max(min_sigma_px, stack.min_sigma_px), fit.sigma_px, fit.candidate.depth_model
    n, work = sigma_px.shape[0], _make_workspace(fit)
    step, right, gains = work.step, work.joint.right, work.joint.gains
    fit.residual_depth[:], fit.distance_offset[:] = stack.residual_depth, 0.0
    bound = max(MAX_SIGMA_GROWTH * sigma_px.max(), min_sigma_px)
    decrease, length, count, converged = np.inf, 1.0, 0, False
    for count in range(1, MAX_ROUNDS + 2):
        cutoff = CUTOFF * (EARLY_CUTOFF_FACTORS[count - 1] if count <= len(EARLY_CUTOFF_FACTORS) else 1.0)
        if not _sum_terms(stack, usable, fit, cutoff, converged, work):
            return count, np.inf, np.inf
        if converged:
            if decrease >= CONVERGED_DECREASE:
                decrease = _discount_noise(fit.noise_information, decrease, work)
            break
        if not _solve_step(constraint, work):
            return count, np.inf, np.inf
        last_decrease, decrease = decrease, 0.5 * dot(step, right)
        # Growing steps overshoot, and changing inliers cause cycles: shorter steps converge.
        growing = decrease > last_decrease and count > len(EARLY_CUTOFF_FACTORS) + 1
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
        apply_step(fit.candidate, fit.distance_offset, step, gains, length_now)
        for t in range(n):
            work.mass[t] = compute_sum(fit.weights[stack.offsets[t] : stack.offsets[t + 1]])
        # The first residuals are those of the start, not of a fit.
        if count > 1:
            _exclude_terms(stack, usable, fit.weights, work.active)
            _update_sigma(stack, fit, work)
            sigma_px[:] = np.minimum(np.maximum(sigma_px, min_sigma_px), bound)
            _update_residual_depth(stack, fit, work)
        converged = (count > len(EARLY_CUTOFF_FACTORS) and decrease < CONVERGED_DECREASE) or count == MAX_ROUNDS
    return count, decrease, _finish(stack, usable, fit, work)


@leaf
def make_tolerance(stack: Stack, t: int, fit: IrlsFit, mass: float, cutoff: float) -> Tolerance:
    """Return the noise model of term t's matches, whose weights add up to `mass`.

    Neighbors have similar residual depths. In this respect only as many matches of a term are independent as a depth model
    has coefficients: what these leave varies about as fast over the image.
    """
    shared_residual_depth = fit.residual_depth[t] * np.sqrt(max(1.0, mass / DEPTH_MODEL_SIZE))
    return Tolerance((fit.sigma_px[t] / stack.focal[t]) ** 2, fit.residual_depth[t], shared_residual_depth, cutoff)


@kernel
def _sum_terms(stack: Stack, usable: InlierPrior, fit: IrlsFit, cutoff: float, final: bool, work: _Workspace) -> bool:
    """Compute all errors, the joint equations and the information; return whether the depth models are determined.

    The last round, after convergence, only evaluates the information.
    """
    joint, without_depth, noise = work.joint, work.joint_without_depth, fit.noise_information
    joint.total[:], without_depth.total[:], joint.right[:], noise[:] = 0.0, 0.0, 0.0, 0.0
    # Prior of the distance offset: standard deviation 1.
    joint.total[6, 6], joint.right[6] = 1.0, -fit.distance_offset[0]
    work.complexity[0] = 0.0
    for t in range(stack.focal.shape[0]):
        equations, offset = work.final_equations if final else work.equations, fit.distance_offset[0]
        term = make_term(stack, t, fit.candidate, make_tolerance(stack, t, fit, work.mass[t], cutoff))
        build_match_equations(stack, term, usable, work.matches, equations)
        if not work.active[t]:
            joint.gains[t] = 0.0
            continue
        if final:
            # Just enough of the prior to determine the depth models.
            reduce_term(stack, t, fit.candidate, offset, equations, HALF_DIGITS, without_depth)
            add_rotated(equations.noise_information, stack.qy[t], noise)
        if not reduce_term(stack, t, fit.candidate, offset, equations, 1.0, joint):
            return False
        if final:
            work.complexity[0] += _measure_complexity(joint.block, stack.depth_model_information[t], joint.inverse)
    fit.information_without_depth[:] = without_depth.total[:6, :6]
    for i in range(6):
        for j in range(6):
            fit.information[i, j] = joint.total[i, j] - joint.total[i, 6] * joint.total[6, j] / joint.total[6, 6]
    return True


@leaf
def _measure_complexity(factor: FloatArray, prior: FloatArray, work: FloatArray) -> float:
    """Return log sqrt(det B / det P) of a depth model with information B and prior information P.

    It is the cost of the unknowns with which a likelihood is reached (Laplace's approximation of the marginal likelihood):
    a large rotation determines the depths of a surface better than a small one does, and so explains noise by them.

    Args:
        factor: (6, 6) Cholesky factor of B.
        prior: (6, 6) P.
        work: (6, 6) is overwritten.
    """
    for k in range(DEPTH_MODEL_SIZE):
        for j in range(DEPTH_MODEL_SIZE):
            work[k, j] = prior[k, j]
    if not cholesky(work):
        return np.inf
    total = 0.0
    for k in range(DEPTH_MODEL_SIZE):
        total += np.log(factor[k, k] / work[k, k])
    return total


@leaf
def _solve_step(constraint: FloatArray, work: _Workspace) -> bool:
    """Compute the step under the constraint; return False if it is undetermined."""
    total, step = work.joint.total, work.step
    # Rotations and translations have different units: each block is regularized by its own trace, which fixes
    # unobservable directions.
    rotation_trace = total[0, 0] + total[1, 1] + total[2, 2]
    translation_trace = total[3, 3] + total[4, 4] + total[5, 5]
    for i in range(3):
        total[i, i] += HALF_DIGITS * rotation_trace
        total[3 + i, 3 + i] += HALF_DIGITS * translation_trace
    largest = 0.0
    for i in range(6):
        largest = max(largest, total[i, i])
    for i in range(6):
        for j in range(6):
            total[i, j] += largest / HALF_DIGITS * constraint[i] * constraint[j]
    for i in range(7):
        step[i] = work.joint.right[i]
    return cholesky_solve(total, step)


@leaf
def _discount_noise(noise: FloatArray, decrease: float, work: _Workspace) -> float:
    """Return the predicted decrease without the information that noise causes.

    A rotation that is determined by noise alone never converges.
    """
    step, right = work.step, work.joint.right
    for i in range(7):
        step[i] = right[i]
    if not cholesky_solve(work.joint.total, step):
        return decrease
    decrease = 0.5 * step[6] * right[6]
    for i in range(6):
        decrease += 0.5 * step[i] * right[i]
        for j in range(6):
            decrease -= 0.5 * step[i] * noise[i, j] * step[j]
    return float(max(decrease, 0.0))


@leaf
def _finish(stack: Stack, usable: InlierPrior, fit: IrlsFit, work: _Workspace) -> float:
    """Scale residuals and information; return the negative log-likelihood of all usable matches."""
    cost, density = 0.5 * fit.distance_offset[0] ** 2 + stack.marginalized_share * work.complexity[0], 0.0
    distance, parallax = work.matches.distance, work.matches.parallax
    for t in range(stack.focal.shape[0]):
        cost += compute_depth_prior(stack, t, fit.candidate.depth_model[t], fit.distance_offset[0], work.joint.prior)
        f, variance = stack.focal[t], (fit.sigma_px[t] / stack.focal[t]) ** 2
        mismatch_density = np.log((MISMATCH_RANGE * stack.spread[t]) ** 2 / (2.0 * np.pi))
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if usable[i]:
                density = 0.5 * np.log(variance * (variance + (fit.residual_depth[t] * parallax[i]) ** 2))
                near = min(0.5 * distance[i], 0.5 * distance[i] / COARSE_SIGMA_FACTOR**2 + COARSE_KEYPOINT_COST)
                cost += usable[i] * (min(near + density, max(mismatch_density, density)) - mismatch_density)
            fit.residuals_px[i] *= f
            if not work.active[t]:
                fit.weights[i] = 0.0
    for i in range(6):
        for j in range(6):
            fit.information[i, j] *= GAIN
            fit.information_without_depth[i, j] *= GAIN
            fit.noise_information[i, j] *= GAIN
    return float(cost)


@leaf
def _update_residual_depth(stack: Stack, fit: IrlsFit, work: _Workspace) -> None:
    """Update `residual_depth` (T,): ζ by the method of moments, shrunk towards its prior.

    It is the excess of the squares along the epipolar lines over the noise. The prior dominates if the parallax is too
    small.
    """
    weights, residual_depth = fit.weights, fit.residual_depth
    along, parallax = work.matches.along, work.matches.parallax
    for t in range(residual_depth.shape[0]):
        variance = (fit.sigma_px[t] / stack.focal[t]) ** 2
        prior_variance, square = stack.residual_depth[t] ** 2, residual_depth[t] ** 2
        first, last = stack.offsets[t], stack.offsets[t + 1]
        w, p, residual, terms = weights[first:last], parallax[first:last], along[first:last], work.sums[:, first:last]
        for i in range(last - first):
            # The variance of a squared normal variable is twice the square of its variance.
            p2, is_inlier = p[i] * p[i], w[i] > 0.0
            weight = w[i] * p2 / (2.0 * (variance + square * p2) * (variance + square * p2))
            terms[0, i] = weight * (residual[i] * residual[i] / SHRINKAGE - variance) if is_inlier else 0.0
            terms[1, i] = weight * p2
        excess, certainty, mass = compute_sum(terms[0]), compute_sum(terms[1]), compute_sum(w)
        freedom = max(1.0 - DEPTH_MODEL_SIZE / max(mass, float(DEPTH_MODEL_SIZE)), MIN_FREEDOM_SHARE)
        z2 = (excess + 1.0 / prior_variance) / (freedom * certainty + 1.0 / prior_variance**2)
        residual_depth[t] = np.sqrt(max(z2, HALF_DIGITS * prior_variance))


@kernel
def _update_sigma(stack: Stack, fit: IrlsFit, work: _Workspace) -> None:
    """Update `sigma_px` (T,) from the weighted residuals."""
    weights, across, sigma_px, mass = fit.weights, fit.residuals_px, fit.sigma_px, work.mass
    n = sigma_px.shape[0]
    squares, inliers, rig, rig_mass = np.zeros(n), 0, 0.0, 0.0
    for t in range(n):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        w, residual, terms, count = weights[first:last], across[first:last], work.sums[0, first:last], 0
        for i in range(last - first):
            inside = w[i] > 0.0
            terms[i] = w[i] * residual[i] * residual[i] if inside else 0.0
            count += inside
        squares[t] = compute_sum(terms) * stack.focal[t] ** 2 / SHRINKAGE
        if work.active[t]:
            inliers += count
            rig += squares[t]
            rig_mass += mass[t]
    if inliers == 0:
        return
    freedom = max(1.0 - N_MOTION / inliers, MIN_FREEDOM_SHARE)
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
        if usable_mass >= MIN_MATCHES:
            share[t] = agreeing_mass / usable_mass
            best = max(best, share[t])
    for t in range(n):
        active[t] = best < 2.0 * MIN_SHARE or share[t] >= MIN_SHARE


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


@leaf
def reduce_term(
    stack: Stack,
    t: int,
    candidate: Candidate,
    offset: float,
    equations: MatchEquations,
    scale: float,
    joint: JointSystem,
) -> bool:
    """Add term t's equations, with the scaled prior of its depth model, which is eliminated, to the joint equations.

    The unknowns are (w, d) and the distance offset z, which adds `stack.distance_gain[t]` z to the first mean of α.
    They are in world axes. The joint equations receive the response of the depth model: α changes by
    gains[t, :, 7] - gains[t, :, :7] (w, d, z).

    Args:
        offset: z.
        scale: of the prior.

    Returns:
        whether the elimination succeeded.
    """
    gain, block, inverse, prior, reduced = joint.gains[t], joint.block, joint.inverse, joint.prior, joint.reduced
    depth_model = candidate.depth_model[t]
    compute_depth_prior(stack, t, depth_model, offset, prior)
    for k in range(DEPTH_MODEL_SIZE):
        for j in range(DEPTH_MODEL_SIZE):
            prior[k, j] *= scale
    reduced[:] = 0.0
    q, distance_gain = stack.qy[t], stack.distance_gain[t]
    rotate_rows(equations.matrix[DEPTH_MODEL_SIZE:], q, gain)
    add_rotated(equations.matrix, q, reduced)
    reduced[6, 6] = distance_gain * distance_gain * prior[0, 0]
    for k in range(DEPTH_MODEL_SIZE):
        gain[k, 6] = -distance_gain * prior[k, 0]
        gain[k, 7] = equations.right[6 + k]
        for j in range(DEPTH_MODEL_SIZE):
            deviation = depth_model[j] - stack.depth_model_mean[t, j] - (distance_gain * offset if j == 0 else 0.0)
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
    pull = stack.marginalized_share * unknowns / max(equations.parallax_squares[0], 1e-300)
    for i in range(6):
        h, j = i // 3, i % 3
        for a in range(3):
            joint.right[i] += q[a, j] * (equations.right[3 * h + a] - pull * equations.parallax_gradient[3 * h + a])
    for i in range(7):
        joint.right[i] += reduced[i, 7]
        for j in range(7):
            joint.total[i, j] += reduced[i, j]
    return True


@leaf
def compute_depth_prior(stack: Stack, t: int, depth_model: FloatArray, offset: float, prior: FloatArray) -> float:
    """Set prior (6, 6), the prior information of α, and return the prior cost.

    Slopes have heavy tails (a Cauchy distribution in two dimensions): a plane may be seen at a grazing angle.
    """
    slope_square, cost, mean, information = 0.0, 0.0, stack.depth_model_mean[t], stack.depth_model_information[t]
    mean_offset = stack.distance_gain[t] * offset
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
