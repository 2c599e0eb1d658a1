"""Robust fit from matches to one motion, fully compiled: RANSAC seeds, search, re-weighting."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import betaln

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.relative_pose.affine_ransac import N_QUADRUPLES, SEED_THRESHOLD_PX, find_inliers
from sylpose.relative_pose.irls import (
    N_MOTION,
    IrlsFit,
    copy_fit,
    has_uniform_residuals,
    make_empty_irls_fit,
    run_constrained_irls,
)
from sylpose.relative_pose.limits import (
    CONVERGED_DECREASE,
    DECREASE_OF_ONE_SD,
    HALF_DIGITS,
    MAX_ROUNDS,
    MAX_SIGMA_GROWTH,
    MIN_ERROR_PX,
    MOST,
    SIGMA_FLOOR_PX,
)
from sylpose.relative_pose.moments_cost import MomentSums, compute_moments
from sylpose.relative_pose.planes import fit_edge_on
from sylpose.relative_pose.search import MAX_HYPOTHESES, Minima, make_minima, search_minima
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE, MIN_MATCHES, InitialMotions, Stack

# How far the log-likelihood of a minimum to refine may be below the best: the moments, with denominators at the mean rays,
# misjudge it by some tens for large rotations (choice).
MAX_LIKELIHOOD_GAP = 60.0
# Number of fits to permuted matches, and the factor by which the log-likelihood, relative to mismatches, exceeds the best of
# them (measured: three wrong motions of benchmarks/honesty.py with 12 matches have at most 0.9, right ones with 12 to 64 at
# least 2.2), or what it takes to describe a choice among mismatches, which is far more.
N_PERMUTED_FITS, CHANCE_LIKELIHOOD_FACTOR = 3, 2.0


class RefinedMinima(NamedTuple):
    """Refined minima, at most K: the candidates for alternative motions.

    Attributes:
        rotations: (K, 3, 3).
        translations: (K, 3).
        costs: (K,) negative log-likelihoods, infinite for unused entries.
        inliers: (K,) numbers of inliers.
    """

    rotations: FloatArray
    translations: FloatArray
    costs: FloatArray
    inliers: FloatArray


class RobustFit(NamedTuple):
    """Likeliest motion of a search.

    Attributes:
        fit: without inliers if none was found.
        minima: all refined minima.
        iterations: of the solver.
        decrease: the predicted decrease of its last step (`run_irls`), infinite without a fit.
        is_noisy: whether the noise of a camera reaches the bound, twice the largest noise of the cameras' seeds: two motions
            may be fitted as one.
    """

    fit: IrlsFit
    minima: RefinedMinima
    iterations: int
    decrease: float
    is_noisy: bool


@kernel
def fit_robust_motion(stack: Stack, usable: FloatArray, picks: FloatArray, guesses: InitialMotions) -> RobustFit:
    """Fit one robust motion: seeds per term, minima of all seeds together, re-weighting of the best.

    Args:
        usable: (N,) 1 for matches that may be inliers, else 0.
        picks: (h, 4) in [0, 1): random numbers that select the seeds' quadruples.
        guesses: initial motions in addition to the built-in ones.
    """
    n, trial = stack.focal.shape[0], make_empty_irls_fit(stack)
    sums, first_sigma = MomentSums(np.empty((n, 9, 9)), np.empty(n)), np.empty(n)
    minima = make_minima(MAX_HYPOTHESES, n)
    _select_seeds(stack, usable, picks, trial.weights, first_sigma)
    for t in range(n):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        compute_moments(stack.x[first:last], stack.y[first:last], trial.weights[first:last], sums.moments[t])
        # A term without seeds contributes nothing, but its count must be positive.
        if not sums.moments[t, 8, 8] > 0.0:
            sums.moments[t, 8, 8] = HALF_DIGITS
        sums.variance[t] = (first_sigma[t] / stack.focal[t]) ** 2
    iterations, is_complete = search_minima(stack, sums, guesses, minima, False)
    result = _fit_minima(stack, usable, first_sigma, iterations, minima, trial)
    if not is_complete and (result.is_noisy or not result.decrease < DECREASE_OF_ONE_SD):
        # A likelier motion may have been missed.
        iterations, _ = search_minima(stack, sums, guesses, minima, True)
        result = _fit_minima(stack, usable, first_sigma, iterations + result.iterations, minima, trial)
    return result


@kernel
def _fit_minima(
    stack: Stack, usable: FloatArray, first_sigma: FloatArray, iterations: int, minima: Minima, trial: IrlsFit
) -> RobustFit:
    """Refine the likeliest minima with all matches.

    Args:
        usable: (N,) 1 for matches that may be inliers, else 0.
        first_sigma: (T,) noise of the seeds, pixels.
        iterations: of the search.
        trial: work arrays.
    """
    fit, k = make_empty_irls_fit(stack), MAX_HYPOTHESES
    refined = RefinedMinima(np.zeros((k, 3, 3)), np.zeros((k, 3)), np.full(k, np.inf), np.zeros(k))
    best, decrease = np.inf, np.inf
    for m in range(MAX_HYPOTHESES):
        # Refine further minima if they are nearly as likely, or if the first did not converge.
        if not minima.likelihoods[m] > (
            minima.likelihoods[0] - MAX_LIKELIHOOD_GAP if decrease < CONVERGED_DECREASE else -np.inf
        ):
            continue
        for n_known in range(2):
            # Start at the minimum, with everything else at its prior; if that diverges, at its distances, too.
            trial.sigma_px[:], trial.weights[:] = first_sigma, 0.0
            trial.candidate.rotation[:], trial.candidate.translation[:] = minima.rotations[m], minima.translations[m]
            trial.candidate.depth_model[:] = stack.depth_model_mean
            trial.candidate.depth_model[:, 1 - n_known : 3] = minima.depth_models[m, :, 1 - n_known :]
            done, new_decrease, cost = fit_edge_on(stack, usable, trial, True)
            iterations += done
            if cost < np.inf:
                break
        refined.rotations[m], refined.translations[m] = trial.candidate.rotation, trial.candidate.translation
        refined.costs[m], refined.inliers[m] = cost, (trial.weights > 0.0).sum()
        if cost < best:
            best, decrease = cost, new_decrease
            copy_fit(fit, trial)
    max_sigma = MAX_SIGMA_GROWTH * first_sigma.max()
    if best < np.inf:
        done, new_decrease, cost = _refit_with_more_noise(stack, usable, fit, max_sigma, best, trial)
        iterations += done
        if cost < best:
            decrease, k = new_decrease, int(np.argmin(refined.costs))
            copy_fit(fit, trial)
            refined.rotations[k], refined.translations[k] = fit.candidate.rotation, fit.candidate.translation
            refined.costs[k], refined.inliers[k] = cost, (fit.weights > 0.0).sum()
    # A given noise may exceed the bound.
    is_bounded = best < np.inf and max_sigma > max(stack.min_sigma_px, SIGMA_FLOOR_PX)
    is_noisy = is_bounded and bool((fit.sigma_px > (1.0 - HALF_DIGITS) * max_sigma).any())
    return RobustFit(fit, refined, iterations, decrease, is_noisy)


@kernel
def _refit_with_more_noise(
    stack: Stack, usable: FloatArray, fit: IrlsFit, sigma_bound: float, best: float, trial: IrlsFit
) -> tuple[int, float, float]:
    """Refit with a higher noise bound if the bound is active in most cameras and the result is likelier.

    An active bound selects matches that need not belong to any motion. If only some cameras reach it, these may be
    faulty. If the inliers' residuals are uniform, they are not noise. The result is in trial.

    Returns:
        as `run_irls`; an infinite cost without an improvement.
    """
    iterations, decrease, cost = 0, np.inf, np.inf
    copy_fit(trial, fit)
    for _ in range(MAX_ROUNDS):
        if 2 * (trial.sigma_px > (1.0 - HALF_DIGITS) * sigma_bound).sum() <= len(trial.sigma_px):
            break
        sigma_bound = MAX_SIGMA_GROWTH * trial.sigma_px.max()
        done, new_decrease, new_cost = run_constrained_irls(stack, usable, trial, SIGMA_FLOOR_PX, np.zeros(6))
        iterations += done
        if not new_cost < best:
            return iterations, np.inf, np.inf
        decrease, cost, best = new_decrease, new_cost, new_cost
    return iterations, decrease, np.inf if has_uniform_residuals(trial.weights) else cost


def draw_and_fit(stack: Stack, usable: BoolArray, guesses: InitialMotions, rng: np.random.Generator) -> RobustFit:
    """Run `fit_robust_motion` with quadruples drawn from rng."""
    # Pass probabilities, as for a mixture: a single compiled version is sufficient.
    return fit_robust_motion(stack, usable.astype(np.float64), rng.random((N_QUADRUPLES, 4)), guesses)


def exceeds_chance(
    stack: Stack, usable: BoolArray, cost: float, inliers: int, guesses: InitialMotions, rng: np.random.Generator
) -> bool:
    """Return whether usable matches (N,) agree with a fit better than mismatches would.

    Of mismatches the likeliest inliers and unknowns are found by chance. If what it takes to describe that choice (of the
    inliers, by their number, and of the unknowns, by Schwarz's criterion) is not far less than the gain, the likelihood is
    compared with that of fits to permuted matches, of which any is chance.

    Args:
        cost: negative log-likelihood of the fit, relative to mismatches.
        inliers: number of its inliers.
    """
    if not cost < np.inf:
        return False
    n = int(np.count_nonzero(usable))
    # As many inliers as unknowns can be selected, and as many again.
    if inliers >= MOST * n and inliers > 2 * N_MOTION:
        return True
    indices = [first + np.flatnonzero(usable[first:last]) for first, last in pairwise(stack.offsets.tolist())]
    unknowns = N_MOTION + sum(len(index) > 0 for index in indices) * (DEPTH_MODEL_SIZE + 1)
    choices = -betaln(inliers + 1.0, n - inliers + 1.0) - np.log(n + 1.0)
    if -cost > CHANCE_LIKELIHOOD_FACTOR * (choices + 0.5 * unknowns * np.log(n)):
        return True
    # One or two matches of a camera cannot be permuted.
    permuted, is_permuted = [index for index in indices if len(index) > 2], np.zeros(len(usable), bool)
    for index in permuted:
        is_permuted[index] = True
    costs = list[float]()
    if is_permuted.sum() < MIN_MATCHES:
        return False
    # A search that finds no motion at all shows nothing.
    for _ in range(2 * N_PERMUTED_FITS):
        y = stack.y.copy()
        for index in permuted:
            y[index] = y[rng.permutation(index)]
        found = draw_and_fit(stack._replace(y=y), is_permuted, guesses, rng)
        costs += [float(found.minima.costs.min())] if found.minima.costs.min() < np.inf else []
        if len(costs) == N_PERMUTED_FITS:
            break
    return bool(costs) and cost < CHANCE_LIKELIHOOD_FACTOR * min(*costs, 0.0)


@kernel
def _select_seeds(stack: Stack, usable: FloatArray, picks: FloatArray, weights: FloatArray, sigma: FloatArray) -> None:
    """Select each term's seeds, matches that one motion can explain: weights (N,) of 1 or 0, and their noise (T,)."""
    n, n_matches = stack.focal.shape[0], stack.x.shape[0]
    x, y, index = np.empty((n_matches, 2)), np.empty((n_matches, 2)), np.empty(n_matches, np.int64)
    inliers, sigma_sum, sigma_count = np.empty(n_matches), 0.0, 0
    for t in range(n):
        count = 0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            weights[i] = 0.0
            if usable[i] > 0.0:
                x[count, 0], x[count, 1] = stack.x[i, 0], stack.x[i, 1]
                y[count, 0], y[count, 1] = stack.y[i, 0], stack.y[i, 1]
                index[count] = i
                count += 1
        rms = find_inliers(x[:count], y[:count], SEED_THRESHOLD_PX / stack.focal[t], picks, inliers[:count])
        kept = 0
        for k in range(count):
            weights[index[k]] = inliers[k]
            kept += inliers[k] > 0.0
        sigma[t] = 0.0
        if kept >= MIN_MATCHES:
            # The hyperplane is in both frames' coordinates, as is Sampson's distance.
            sigma[t] = max(rms * stack.focal[t], MIN_ERROR_PX)
            sigma_sum += sigma[t]
            sigma_count += 1
    for t in range(n):
        if sigma[t] == 0.0:
            sigma[t] = sigma_sum / sigma_count if sigma_count > 0 else 1.0
