"""From matches to one robust motion, compiled from end to end: seeds, search, re-weighting."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.numerics.arrays import BoolArray, FloatArray
from sylpose.numerics.compiled import kernel
from sylpose.two_frames.fit import MIN_MATCHES
from sylpose.two_frames.moments_cost import Sums, moments_into
from sylpose.two_frames.reweight import SETTLED, Reweighted, nothing_yet, reweight
from sylpose.two_frames.search import no_minima, search
from sylpose.two_frames.seeds import hyperplane_inliers
from sylpose.two_frames.terms import Guesses, Stack, copy_into

__all__ = ["KEEP", "Settled", "fitted", "robust_fit"]


# Quadruples that a term's seeds are drawn with, at most (choice).
QUADRUPLES = 300
# Distance from the affine epipolar constraint that perspective and noise explain (choice).
SEED_PX = 1.0
# Where less than this share of a camera's matches are seeds, a wider band is tried, by this factor; it is believed when
# it holds a majority, which outliers alone do not fill (choice).
SEED_SHARE, SEED_WIDE, SEED_MAJORITY = 0.4, 4.0, 0.65
# Fewer matches than this have no wider band (choice).
WIDENED = 12
# Noise of the seeds, pixels: bounds of what is read off their distances from the hyperplane (choice).
SEED_SIGMA_PX = (0.15, 1.5)
# Minima that may be refined, and how near their log-likelihood must come to the best one's: the moments, with their
# denominators at the mean rays, misjudge it by some tens where the turn is large (choice).
KEEP = 4
SECOND_CHANCE = 60.0


class Settled(NamedTuple):
    """The minima that were refined, of K at most: what one another's rivals are.

    Attributes:
        rotations: (K, 3, 3), shifts: (K, 3).
        costs: (K,) negative log-likelihoods, infinite where there is none.
        inliers: (K,) numbers of them.
    """

    rotations: FloatArray
    shifts: FloatArray
    costs: FloatArray
    inliers: FloatArray


@kernel
def robust_fit(
    stack: Stack, usable: FloatArray, picks: FloatArray, guesses: Guesses, fit: Reweighted, found: Settled
) -> tuple[int, float]:
    """One robust motion: seeds per term, minima of all seeds together, the best of them re-weighted.

    Args:
        usable: (N,) 1 for matches that may be inliers, else 0.
        picks: (h, 4) in [0, 1): draw the seeds' quadruples.
        fit: filled.
        found: filled.

    Returns:
        iterations of the solver; what its last step promised (`reweight`), infinite where there is no fit.
    """
    n, trial = stack.focal.shape[0], nothing_yet(stack)
    sums, first_sigma = Sums(np.empty((n, 9, 9)), np.empty(n)), np.empty(n)
    _seed(stack, usable, picks, trial.weights, first_sigma)
    for t in range(n):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        moments_into(stack.x[first:last], stack.y[first:last], trial.weights[first:last], sums.moments[t])
        # A term without a seed has no say, but a count.
        if not sums.moments[t, 8, 8] > 0.0:
            sums.moments[t, 8, 8] = 1e-9
        sums.variance[t] = (first_sigma[t] / stack.focal[t]) ** 2
    minima = no_minima(KEEP, n)
    iterations = search(stack, sums, guesses, minima)
    best, promise = np.inf, np.inf
    found.costs[:] = np.inf
    for k in range(KEEP):
        # Others are refined as well where they are nearly as likely, or where the first led nowhere.
        if not minima.likelihoods[k] > (minima.likelihoods[0] - SECOND_CHANCE if promise < SETTLED else -np.inf):
            continue
        trial.sigma_px[:] = first_sigma
        trial.weights[:] = 0.0
        trial.candidate.rotation[:], trial.candidate.shift[:] = minima.rotations[k], minima.shifts[k]
        trial.candidate.surface[:] = stack.surface_mean
        for t in range(n):
            for j in range(1, 3):
                trial.candidate.surface[t, j] = minima.surfaces[k, t, j]
        done, promised, cost = reweight(stack, usable, trial)
        iterations += done
        found.rotations[k], found.shifts[k] = trial.candidate.rotation, trial.candidate.shift
        found.costs[k], found.inliers[k] = cost, (trial.weights > 0.0).sum()
        if cost < best:
            best, promise = cost, promised
            copy_into(fit.candidate, trial.candidate)
            fit.sigma_px[:], fit.weights[:], fit.across[:] = trial.sigma_px, trial.weights, trial.across
            fit.information[:], fit.without_depth[:], fit.noise[:] = trial.information, trial.without_depth, trial.noise
            fit.relief[:], fit.place[:] = trial.relief, trial.place
    return iterations, promise


def fitted(
    stack: Stack, usable: BoolArray, guesses: Guesses, rng: np.random.Generator
) -> tuple[Reweighted, Settled, int, float]:
    """`robust_fit` with quadruples drawn from rng: the fit, without inliers where there is none, all minima, and what it
    returns."""
    fit = nothing_yet(stack)
    found = Settled(np.zeros((KEEP, 3, 3)), np.zeros((KEEP, 3)), np.empty(KEEP), np.zeros(KEEP))
    # Probabilities, as of a mixture: one compiled version does.
    some = usable.astype(np.float64)
    iterations, promise = robust_fit(stack, some, rng.random((QUADRUPLES, 4)), guesses, fit, found)
    return fit, found, iterations, promise


@kernel
def _seed(stack: Stack, usable: FloatArray, picks: FloatArray, weights: FloatArray, sigma_px: FloatArray) -> None:
    """Each term's matches that one motion can explain: weights (N,) of 1 or 0, and their noise (T,)."""
    n, n_matches = stack.focal.shape[0], stack.x.shape[0]
    x, y, index = np.empty((n_matches, 2)), np.empty((n_matches, 2)), np.empty(n_matches, np.int64)
    mine, wide = np.empty(n_matches), np.empty(n_matches)
    lower, upper = SEED_SIGMA_PX
    usual, known = 0.0, 0
    for t in range(n):
        count = 0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            weights[i] = 0.0
            if usable[i] > 0.0:
                x[count, 0], x[count, 1] = stack.x[i, 0], stack.x[i, 1]
                y[count, 0], y[count, 1] = stack.y[i, 0], stack.y[i, 1]
                index[count] = i
                count += 1
        rms = hyperplane_inliers(x[:count], y[:count], SEED_PX / stack.focal[t], picks, mine[:count])
        kept = 0
        for k in range(count):
            kept += mine[k] > 0.0
        bound = upper
        if count >= WIDENED and kept < SEED_SHARE * count:
            # Outliers, or noise: a wider band tells.
            wide_rms = hyperplane_inliers(
                x[:count], y[:count], SEED_WIDE * SEED_PX / stack.focal[t], picks, wide[:count]
            )
            wide_kept = 0
            for k in range(count):
                wide_kept += wide[k] > 0.0
            if wide_kept > SEED_MAJORITY * count:
                mine[:count], rms, bound = wide[:count], wide_rms, SEED_WIDE * upper
        kept = 0
        for k in range(count):
            weights[index[k]] = mine[k]
            kept += mine[k] > 0.0
        sigma_px[t] = 0.0
        if kept >= MIN_MATCHES:
            # The hyperplane spans both frames' coordinates, as Sampson's distance does.
            sigma_px[t] = min(max(rms * stack.focal[t], lower), bound)
            usual += sigma_px[t]
            known += 1
    for t in range(n):
        if sigma_px[t] == 0.0:
            sigma_px[t] = usual / known if known > 0 else 1.0
