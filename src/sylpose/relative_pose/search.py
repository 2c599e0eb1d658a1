"""Multi-start search for the minima of `moments_cost`: Levenberg-Marquardt, depth models eliminated term by term.

The planar part of the cost has no local minimum near the identity, so the search starts there. Few cameras, flat objects,
small rotations and transparent bodies cause other minima: mirror images, with the rotation across a camera's axis reversed
and near and far exchanged, and a family of motions that a plane hardly distinguishes. Random rotations are therefore tried
as well, with a standard deviation per axis of an eighth to twice the first minimum's angle, every other one after steps
with the planar part alone, and the likeliest wins. They end when another start would hardly find another minimum: if N of
them led to w minima, it does with an expected probability of w (w + 1) / (N (N - 1)).

Source: the bas-relief ambiguity, Belhumeur, Kriegman, Yuille 1999; the end of the starts, Boender & Rinnooy Kan, "Bayesian
stopping rules for multistart global optimization methods", 1987; the starts are ours (docs/method/3-pose.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import eliminate_block
from sylpose.geometry.numba_linalg import apply_rotvec, cholesky_solve, dot, kernel, leaf, so3_exp, so3_log
from sylpose.relative_pose.limits import (
    DECREASE_OF_ONE_SD,
    MAX_ROTATION_STEP,
    MAX_ROUNDS,
    MAX_SIGMA_GROWTH,
    MAX_STEPS,
    ROUGHLY_CONVERGED_DECREASE,
)
from sylpose.relative_pose.moments_cost import (
    MomentSums,
    NormalEquations,
    TermView,
    build_view_equations,
    compute_view_misfit,
    estimate_view_variance,
    evaluate_term,
    make_term_view,
    update_view,
)
from sylpose.relative_pose.terms import Candidate, InitialMotions, Stack, copy_into

# Steps after which a start is checked, and how far its log-likelihood may then be behind the best. Earlier checks lose true
# motions (measured: creeps in benchmarks/kinds.py, 48 degrees off); without one, two bodies are found as one motion
# (tests/tracking/test_bodies.py) (choice).
CHECK_STEPS, MAX_LIKELIHOOD_GAP = 3, 300.0
# Two minima are the same if their rotations, radians, and their translations, relative to their length, differ by less
# (choice).
SAME_MOTION = 0.01
# A term whose mean square exceeds the median of the terms by this factor, or this value, is down-weighted in the search
# (derived: the square of the largest growth of the noise).
MAX_COST_RATIO = MAX_SIGMA_GROWTH**2
# Damping at first, and again after a rejected step (choice).
INITIAL_DAMPING = 1e-4
# Maximum number of minima (choice: docs/history/benchmarks.md).
MAX_HYPOTHESES = 4
# Rotations to start from, in units of the first minimum's angle, with and without planar steps in turn (choice:
# docs/history/benchmarks.md, "Edge-on planes and random starts"). Their sizes are in van der Corput's order: the first ones,
# however many, contain all sizes.
RANDOM_ROTVECS = (2.0 ** np.linspace(-3.0, 1.0, 32)[:, None] * np.random.default_rng(0).normal(size=(32, 3)))[
    [2 * int(f"{k:04b}"[::-1], 2) + odd for k in range(16) for odd in (1, 0)]
]
# The starts end when another one would find another minimum with less than this probability (choice: sensitivity in
# docs/history/benchmarks.md, "When the starts end").
MAX_UNSEEN_SHARE = 0.01


class Workspace(NamedTuple):
    """Work arrays of a search over T terms, allocated once.

    Attributes:
        normal, gain: normal equations, and the responses of the depth models (T, 3, 7): α changes by
            -(gain[:, 6] + gain[:, :6] (w, d)).
        kappa, costs, term_weights, squares: (T,) κ, costs, weights of the terms and their mean squares.
        total, right, step: (6, 6), (6,), (6,) the joint equations and a step.
        block, reduced: (3, 3), (6, 7) for the elimination of a depth model.
        trial, term_view: a candidate, and the view of one term.
        tolerance: predicted decrease of the full cost at convergence.
    """

    normal: NormalEquations
    gain: FloatArray
    kappa: FloatArray
    costs: FloatArray
    term_weights: FloatArray
    squares: FloatArray
    total: FloatArray
    right: FloatArray
    step: FloatArray
    block: FloatArray
    reduced: FloatArray
    trial: Candidate
    term_view: TermView
    tolerance: float


@kernel
def make_workspace(n: int) -> Workspace:
    """Allocate the work arrays for n terms."""
    normal, gain = NormalEquations(np.empty((n, 9, 9)), np.empty((n, 9))), np.empty((n, 3, 7))
    kappa, costs, weights, squares = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    total, right, step, block, reduced = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((3, 3)), np.empty((6, 7))
    trial, view = Candidate(np.empty((3, 3)), np.empty(3), np.empty((n, 3))), make_term_view()
    return Workspace(
        normal,
        gain,
        kappa,
        costs,
        weights,
        squares,
        total,
        right,
        step,
        block,
        reduced,
        trial,
        view,
        ROUGHLY_CONVERGED_DECREASE,
    )


@leaf
def _lower_median(values: FloatArray) -> float:
    """Return the lower median of values (n,), which are sorted in place."""
    n = values.shape[0]
    for i in range(1, n):
        value, k = values[i], i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return float(values[(n - 1) // 2])


@leaf
def _update_term_weights(costs: FloatArray, moments: FloatArray, term_weights: FloatArray, squares: FloatArray) -> None:
    """Set the weight of each term: small if its mean square is far above the median."""
    n = costs.shape[0]
    for t in range(n):
        squares[t] = term_weights[t] = 2.0 * costs[t] / max(moments[t, 8, 8], 1.0)
    median = _lower_median(squares)
    for t in range(n):
        term_weights[t] = 1.0 / (1.0 + (term_weights[t] / (MAX_COST_RATIO * (median + 1.0))) ** 2)


@leaf
def _solve_step(damping: float, workspace: Workspace) -> bool:
    """Compute a damped step, the depth models eliminated term by term; return False if it is undetermined."""
    normal, total, right, step = workspace.normal, workspace.total, workspace.right, workspace.step
    block, reduced = workspace.block, workspace.reduced
    total[:] = 0.0
    right[:] = 0.0
    for t in range(workspace.gain.shape[0]):
        hessian, gradient = normal.hessian[t], normal.gradient[t]
        gain, weight = workspace.gain[t], workspace.term_weights[t]
        for k in range(3):
            for j in range(6):
                gain[k, j] = hessian[6 + k, j]
            for j in range(3):
                block[k, j] = hessian[6 + k, 6 + j]
            block[k, k] *= 1.0 + damping
            gain[k, 6] = gradient[6 + k]
        for i in range(6):
            for j in range(6):
                reduced[i, j] = hessian[i, j]
            reduced[i, 6] = gradient[i]
        if not eliminate_block(block, gain, reduced):
            return False
        for i in range(6):
            right[i] -= weight * reduced[i, 6]
            for j in range(6):
                total[i, j] += weight * reduced[i, j]
    # Rotations and translations have different units: each block is damped by its own trace.
    rotation_trace = total[0, 0] + total[1, 1] + total[2, 2]
    translation_trace = total[3, 3] + total[4, 4] + total[5, 5]
    for i in range(3):
        total[i, i] += (damping + 1e-12) * rotation_trace
        total[3 + i, 3 + i] += (damping + 1e-12) * translation_trace
    for i in range(6):
        step[i] = right[i]
    return cholesky_solve(total, step)


@leaf
def descend(
    stack: Stack, sums: MomentSums, planar: bool, steps: int, candidate: Candidate, damping: float, work: Workspace
) -> tuple[int, float, float]:
    """Run Levenberg-Marquardt from one start, which becomes the minimum in place.

    Terms that fit much worse than the others are down-weighted.

    Args:
        planar: omit the epipolar part (κ = 0), as is necessary near the identity while the parallax is not yet
            explained.
        steps: maximum number of iterations.
        candidate: the start; receives the minimum.
        damping: of the first step.
        work: work arrays.

    Returns:
        number of iterations; the predicted decrease of the last step: half the squared length of the step, in standard
        deviations of the motion, below the tolerance if converged, 0 if no step lowers the cost; the current damping.
    """
    n, decrease, tolerance = stack.focal.shape[0], np.inf, DECREASE_OF_ONE_SD if planar else work.tolerance
    normal, gain, kappa, costs, term_weights, squares, _, right, step, _, _, trial, view, _ = work
    kappa[:] = 0.0
    term_weights[:] = 1.0
    for count in range(1, steps + 1):
        cost = 0.0
        for t in range(n):
            update_view(stack, t, candidate, view)
            if not planar:
                kappa[t], _ = estimate_view_variance(stack, sums, t, view)
            costs[t] = build_view_equations(stack, sums, t, kappa[t], candidate.depth_model[t], view, normal)
        if n > 2:
            _update_term_weights(costs, sums.moments, term_weights, squares)
        for t in range(n):
            cost += term_weights[t] * costs[t]
        accepted = False
        for _ in range(MAX_ROUNDS):
            if _solve_step(damping, work):
                length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
                if length > MAX_ROTATION_STEP:
                    for i in range(6):
                        step[i] *= MAX_ROTATION_STEP / length
                apply_rotvec(step[:3], candidate.rotation, trial.rotation)
                new, decrease = 0.0, 0.5 * dot(step, right)
                for i in range(3):
                    trial.translation[i] = candidate.translation[i] + step[3 + i]
                for t in range(n):
                    for i in range(3):
                        trial.depth_model[t, i] = candidate.depth_model[t, i] - gain[t, i, 6]
                        decrease += 0.5 * term_weights[t] * gain[t, i, 6] * normal.gradient[t, 6 + i]
                        for k in range(6):
                            trial.depth_model[t, i] -= gain[t, i, k] * step[k]
                    new += term_weights[t] * evaluate_term(stack, sums, t, kappa[t], trial, view)
                if new <= cost * (1.0 + 1e-12):
                    accepted = True
                    break
            damping = max(10.0 * damping, INITIAL_DAMPING)
        if not accepted:
            return count, 0.0, damping
        copy_into(candidate, trial)
        damping = max(0.1 * damping, 1e-9)
        if decrease < tolerance:
            return count, decrease, damping
    return steps, decrease, damping


@leaf
def compute_log_likelihood(stack: Stack, sums: MomentSums, candidate: Candidate, workspace: Workspace) -> float:
    """Return the log-likelihood of a minimum up to a constant, to compare minima."""
    total, n = 0.0, stack.focal.shape[0]
    means, squares, view = workspace.costs, workspace.squares, workspace.term_view
    for t in range(n):
        variance, count = sums.variance[t], sums.moments[t, 8, 8]
        update_view(stack, t, candidate, view)
        _, v = estimate_view_variance(stack, sums, t, view)
        square = compute_view_misfit(sums, t, view) / variance
        square += count * np.log(v / (2.0 * variance))
        for j in range(3):
            square += ((candidate.depth_model[t, j] - stack.plane_mean[t, j]) / stack.plane_sd[t, j]) ** 2
        # Bound the cost of a faulty camera by a multiple of the median per match, so that it does not decide.
        means[t] = squares[t] = square / count
    median = _lower_median(squares)
    for t in range(n):
        bound = MAX_COST_RATIO * (max(median, 0.0) + 1.0) if n > 2 else np.inf
        total += min(means[t], bound) * sums.moments[t, 8, 8]
    return -0.5 * total


class Minima(NamedTuple):
    """The K likeliest minima, best first.

    Attributes:
        rotations: (K, 3, 3).
        translations: (K, 3).
        depth_models: (K, T, 3) planar depth models.
        likelihoods: (K,) log-likelihoods, -inf for unused entries.
    """

    rotations: FloatArray
    translations: FloatArray
    depth_models: FloatArray
    likelihoods: FloatArray


@kernel
def make_minima(max_minima: int, terms: int) -> Minima:
    """Allocate `max_minima` minima for the given number of terms."""
    n = max_minima
    return Minima(np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, terms, 3)), np.full(n, -np.inf))


@kernel
def search_minima(
    stack: Stack, sums: MomentSums, guesses: InitialMotions, minima: Minima, is_thorough: bool
) -> tuple[int, bool]:
    """Find minima from the identity, from initial motions and from random rotations of about the first minimum's size.

    What is far behind the best one is no minimum, but a start that leads there is one that finds no other.

    Args:
        minima: receives the likeliest, best first; unused entries have a likelihood of -inf.
        is_thorough: whether to use all starts.

    Returns:
        number of iterations; whether all starts were used.
    """
    n, n_guesses = stack.focal.shape[0], guesses.rotations.shape[0]
    candidate, workspace = Candidate(np.eye(3), np.zeros(3), np.empty((n, 3))), make_workspace(n)
    minima.likelihoods[:] = -np.inf
    angle, rotvec, first_translation, count = 0.0, np.empty(3), np.zeros(3), 0
    for start in range(1 + n_guesses + len(RANDOM_ROTVECS)):
        n_minima = np.isfinite(minima.likelihoods).sum()
        unseen_share = n_minima * (n_minima + 1) / max(start * (start - 1), 1)
        if start > n_guesses and 0.0 < unseen_share < MAX_UNSEEN_SHARE and not is_thorough:
            return count, False
        candidate.depth_model[:] = stack.plane_mean
        if start == 0:
            count, _, _ = descend(stack, sums, True, MAX_STEPS, candidate, INITIAL_DAMPING, workspace)
        elif start <= n_guesses:
            guess = start - 1
            candidate.rotation[:], candidate.translation[:] = guesses.rotations[guess], guesses.translations[guess]
        else:
            k = start - 1 - n_guesses
            for i in range(3):
                rotvec[i] = angle * RANDOM_ROTVECS[k, i]
            so3_exp(rotvec, candidate.rotation)
            candidate.translation[:] = first_translation
            if k % 2 == 0:
                done, _, _ = descend(stack, sums, True, CHECK_STEPS, candidate, INITIAL_DAMPING, workspace)
                count += done
        decrease, damping = np.inf, INITIAL_DAMPING
        dropped = _is_known(candidate, minima)
        for k in range(MAX_STEPS):
            # Stop a start that approaches a known minimum or is far behind the best.
            if dropped or decrease < ROUGHLY_CONVERGED_DECREASE:
                break
            done, decrease, damping = descend(stack, sums, False, 1, candidate, damping, workspace)
            count += done
            dropped = _is_known(candidate, minima)
            if k == CHECK_STEPS - 1:
                value = compute_log_likelihood(stack, sums, candidate, workspace)
                dropped = dropped or value < minima.likelihoods[0] - MAX_LIKELIHOOD_GAP
        if dropped:
            continue
        value = compute_log_likelihood(stack, sums, candidate, workspace)
        if start == 0:
            so3_log(candidate.rotation, rotvec)
            angle = np.sqrt(dot(rotvec, rotvec))
            first_translation[:] = candidate.translation
        if np.isfinite(value):
            _insert_minimum(candidate, value, minima)
    return count, True


@kernel
def _insert_minimum(candidate: Candidate, value: float, minima: Minima) -> None:
    """Insert a minimum into the sorted list unless it is a duplicate."""
    rotations, translations, depth_models, likelihoods = minima
    last = likelihoods.shape[0] - 1
    for k in range(last + 1):
        if likelihoods[k] > -np.inf and _is_same_motion(
            rotations[k], translations[k], candidate.rotation, candidate.translation
        ):
            if value <= likelihoods[k]:
                return
            last = k
            break
    if value <= likelihoods[last]:
        return
    k = last
    while k > 0 and value > likelihoods[k - 1]:
        rotations[k], translations[k], depth_models[k] = rotations[k - 1], translations[k - 1], depth_models[k - 1]
        likelihoods[k] = likelihoods[k - 1]
        k -= 1
    rotations[k], translations[k], depth_models[k] = candidate.rotation, candidate.translation, candidate.depth_model
    likelihoods[k] = value


@leaf
def _is_known(candidate: Candidate, minima: Minima) -> bool:
    """Return whether a candidate equals one of the minima."""
    for k in range(minima.likelihoods.shape[0]):
        if minima.likelihoods[k] > -np.inf and _is_same_motion(
            minima.rotations[k], minima.translations[k], candidate.rotation, candidate.translation
        ):
            return True
    return False


@leaf
def _is_same_motion(r1: FloatArray, d1: FloatArray, r2: FloatArray, d2: FloatArray) -> bool:
    """Return whether two minima are the same motion."""
    gap = 0.0
    for i in range(3):
        for j in range(3):
            gap += (r1[i, j] - r2[i, j]) ** 2
    distance = (d1[0] - d2[0]) ** 2 + (d1[1] - d2[1]) ** 2 + (d1[2] - d2[2]) ** 2
    length = d1[0] ** 2 + d1[1] ** 2 + d1[2] ** 2
    # Matrices of rotations that differ by a small angle have a distance of √2 times this angle.
    return gap < 2.0 * SAME_MOTION**2 and distance <= SAME_MOTION**2 * length
