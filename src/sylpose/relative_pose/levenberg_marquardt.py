"""Levenberg-Marquardt on the cost of `moments_cost`, with the depth models eliminated term by term."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import eliminate_block
from sylpose.geometry.numba_linalg import apply_rotvec, cholesky_solve, kernel, leaf
from sylpose.relative_pose.moments_cost import (
    MomentSums,
    NormalEquations,
    build_view_equations,
    compute_term_cost,
    compute_view_misfit,
    estimate_view_variance,
)
from sylpose.relative_pose.plane_projection import TermView, make_term_view, update_view
from sylpose.relative_pose.terms import Candidate, Stack, copy_into

__all__ = [
    "INITIAL_DAMPING",
    "DescentWorkspace",
    "compute_log_likelihood",
    "descend",
    "evaluate_log_likelihood",
    "make_descent_workspace",
    "minimize",
    "minimize_from",
]


# A term whose mean square exceeds the median of the terms by this factor, or this value, is down-weighted in the search
# (choice).
MAX_COST_RATIO = 4.0
# Number of trial steps, each with more damping, before a start counts as converged; and the largest rotation of a step,
# radians: the range in which the derivatives are valid (choice).
MAX_TRIES, MAX_ROTATION_STEP = 8, 0.5
# Damping at first, and again after a rejected step (choice).
INITIAL_DAMPING = 1e-4


@leaf
def _eliminate_depth_model(
    normal: NormalEquations,
    t: int,
    damping: float,
    weight: float,
    gain: FloatArray,
    block: FloatArray,
    reduced: FloatArray,
    total: FloatArray,
    right: FloatArray,
) -> bool:
    """Add term t's normal equations, its depth model eliminated, to total (6, 6) and right (6,), the negative gradient.

    gain (3, 7) receives the response of the depth model: α changes by -(gain[:, 6] + gain[:, :6] (w, d)).
    `block` (3, 3) and `reduced` (6, 7) are work arrays.
    """
    hessian, gradient = normal.hessian[t], normal.gradient[t]
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
    return True


class DescentWorkspace(NamedTuple):
    """Work arrays of a search over T terms, allocated once.

    Attributes:
        normal, gain: normal equations and the responses of the depth models (T, 3, 7).
        kappa, costs, term_weights, squares: (T,) κ, costs, weights of the terms and their mean squares.
        total, right, step: (6, 6), (6,), (6,) the joint equations and a step.
        block, reduced: (3, 3), (6, 7) for the elimination of a depth model.
        trial, term_view: a candidate, and the view of one term.
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


@kernel
def make_descent_workspace(n: int) -> DescentWorkspace:
    """Allocate the work arrays for n terms."""
    return DescentWorkspace(
        NormalEquations(np.empty((n, 9, 9)), np.empty((n, 9))),
        np.empty((n, 3, 7)),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty((6, 6)),
        np.empty(6),
        np.empty(6),
        np.empty((3, 3)),
        np.empty((6, 7)),
        Candidate(np.empty((3, 3)), np.empty(3), np.empty((n, 3))),
        make_term_view(),
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


@kernel
def minimize(
    stack: Stack,
    sums: MomentSums,
    downweight: bool,
    plane_only: bool,
    iterations: int,
    tolerance: float,
    candidate: Candidate,
    damping: float,
) -> tuple[int, float, float]:
    """Run `descend` with newly allocated work arrays."""
    workspace = make_descent_workspace(stack.focal.shape[0])
    return descend(stack, sums, downweight, plane_only, iterations, tolerance, candidate, damping, workspace)


@leaf
def descend(
    stack: Stack,
    sums: MomentSums,
    downweight: bool,
    plane_only: bool,
    iterations: int,
    tolerance: float,
    candidate: Candidate,
    damping: float,
    workspace: DescentWorkspace,
) -> tuple[int, float, float]:
    """Run Levenberg-Marquardt from one start, which becomes the minimum in place.

    Args:
        downweight: whether terms that fit much worse than the others are down-weighted.
        plane_only: omit the epipolar part (κ = 0), as is necessary near the identity while the parallax is not yet
            explained.
        iterations: maximum number of iterations.
        tolerance: converged if the predicted decrease of the cost is below this: half the squared length of the step,
            in standard deviations of the motion.
        candidate: the start; receives the minimum.
        damping: of the first step.
        workspace: work arrays.

    Returns:
        number of iterations; the predicted decrease of the last step, below `tolerance` if converged; the current
        damping.
    """
    n, decrease = stack.focal.shape[0], np.inf
    normal, gain, kappa, costs, term_weights, squares, total, right, step, block, reduced, trial, view = workspace
    kappa[:] = 0.0
    term_weights[:] = 1.0
    for count in range(1, iterations + 1):
        cost = 0.0
        for t in range(n):
            update_view(stack, t, candidate, view)
            if not plane_only:
                kappa[t], _ = estimate_view_variance(stack, sums, t, view)
            costs[t] = build_view_equations(stack, sums, t, kappa[t], candidate.depth_model[t], view, normal)
        if downweight and n > 2:
            _update_term_weights(costs, sums.moments, term_weights, squares)
        for t in range(n):
            cost += term_weights[t] * costs[t]
        accepted = False
        for _ in range(MAX_TRIES):
            total[:] = 0.0
            right[:] = 0.0
            solvable = True
            for t in range(n):
                solvable = solvable and _eliminate_depth_model(
                    normal, t, damping, term_weights[t], gain[t], block, reduced, total, right
                )
            if solvable:
                # Rotations and translations have different units: each block is damped by its own trace.
                rotation_trace, translation_trace = (
                    total[0, 0] + total[1, 1] + total[2, 2],
                    total[3, 3] + total[4, 4] + total[5, 5],
                )
                for i in range(3):
                    total[i, i] += (damping + 1e-12) * rotation_trace
                    total[3 + i, 3 + i] += (damping + 1e-12) * translation_trace
                for i in range(6):
                    step[i] = right[i]
                solvable = cholesky_solve(total, step)
            if solvable:
                length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
                if length > MAX_ROTATION_STEP:
                    for i in range(6):
                        step[i] *= MAX_ROTATION_STEP / length
                apply_rotvec(step[:3], candidate.rotation, trial.rotation)
                decrease = 0.0
                for i in range(3):
                    trial.translation[i] = candidate.translation[i] + step[3 + i]
                for i in range(6):
                    decrease += 0.5 * step[i] * right[i]
                new = 0.0
                for t in range(n):
                    for i in range(3):
                        trial.depth_model[t, i] = candidate.depth_model[t, i] - gain[t, i, 6]
                        decrease += 0.5 * term_weights[t] * gain[t, i, 6] * normal.gradient[t, 6 + i]
                        for k in range(6):
                            trial.depth_model[t, i] -= gain[t, i, k] * step[k]
                    new += term_weights[t] * compute_term_cost(stack, sums, t, kappa[t], trial, view)
                if new <= cost * (1.0 + 1e-12):
                    accepted = True
                    break
            damping = max(10.0 * damping, INITIAL_DAMPING)
        if not accepted:
            return count, decrease, damping
        copy_into(candidate, trial)
        damping = max(0.1 * damping, 1e-9)
        if decrease < tolerance:
            return count, decrease, damping
    return iterations, decrease, damping


@kernel
def compute_log_likelihood(stack: Stack, sums: MomentSums, candidate: Candidate) -> float:
    """Evaluate `evaluate_log_likelihood` with newly allocated work arrays."""
    return evaluate_log_likelihood(stack, sums, candidate, make_descent_workspace(stack.focal.shape[0]))


@leaf
def evaluate_log_likelihood(stack: Stack, sums: MomentSums, candidate: Candidate, workspace: DescentWorkspace) -> float:
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


def minimize_from(
    stack: Stack, sums: MomentSums, start: Candidate, iterations: int = 60, tolerance: float = 1e-12
) -> tuple[Candidate, int, float]:
    """Run `minimize` on the full cost with equal term weights, without changing the start.

    Returns:
        the minimum; number of iterations; the predicted decrease of the last step.
    """
    candidate = start.copy()
    count, decrease, _ = minimize(stack, sums, False, False, iterations, tolerance, candidate, INITIAL_DAMPING)
    return candidate, count, decrease
