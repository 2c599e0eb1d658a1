"""From matches to one robust motion, compiled from end to end: seeds, search, re-weighting."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.relative_pose.affine_initialization import FEW
from sylpose.relative_pose.affine_ransac import hyperplane_inliers
from sylpose.relative_pose.fit import MIN_MATCHES
from sylpose.relative_pose.irls import (
    SETTLED,
    SIGMA_FLOOR_PX,
    SIGMA_GROWTH,
    Reweighted,
    nothing_yet,
    reweight,
    spread_evenly,
)
from sylpose.relative_pose.moments_cost import Sums, moments_into
from sylpose.relative_pose.search import Minima, no_minima, search
from sylpose.relative_pose.terms import Guesses, Stack, copy_into

__all__ = ["KEEP", "Seeded", "Settled", "Uniform", "fitted", "robust_fit"]


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
# Looks at them with few cameras; in the later ones those that turn like one that was refined, give or take this share of the
# turn, are not refined again (choice).
LOOKS, SAME_SHARE = 2, 0.1
MOST = LOOKS * KEEP
# Times that noise may double beyond what the seeds allow; it is held down by that where it comes so near (choice).
NOISIER, HELD = 4, 0.99


class Uniform(Protocol):
    """Draws numbers in [0, 1)."""

    def random(self, size: tuple[int, int]) -> FloatArray: ...


class Seeded:
    """Quadruples as `np.random.default_rng(seed)` draws them. As a rule the first are all that is asked for, and they are
    kept: to make a generator takes as long as to lay out all matches."""

    def __init__(self, seed: int) -> None:
        self._seed, self._drawn = seed, 0
        self._rng: np.random.Generator | None = None

    def random(self, size: tuple[int, int]) -> FloatArray:
        """The next ones, (h, 4); not to be written into."""
        self._drawn += 1
        if self._drawn == 1:
            return _first(self._seed, size)
        if self._rng is None:
            self._rng = np.random.default_rng(self._seed)
            self._rng.random(size)
        return self._rng.random(size)


@lru_cache(maxsize=8)
def _first(seed: int, size: tuple[int, int]) -> FloatArray:
    """The first numbers that a generator draws."""
    return np.random.default_rng(seed).random(size)


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
    stack: Stack, usable: FloatArray, picks: FloatArray, guesses: Guesses
) -> tuple[Reweighted, Settled, int, float]:
    """One robust motion: seeds per term, minima of all seeds together, the best of them re-weighted.

    Args:
        usable: (N,) 1 for matches that may be inliers, else 0.
        picks: (h, 4) in [0, 1): draw the seeds' quadruples.

    Returns:
        the fit, without inliers where there is none; all minima; iterations of the solver; what its last step promised
        (`reweight`), infinite where there is no fit.
    """
    fit = nothing_yet(stack)
    found = Settled(np.zeros((MOST, 3, 3)), np.zeros((MOST, 3)), np.empty(MOST), np.zeros(MOST))
    n, trial = stack.focal.shape[0], nothing_yet(stack)
    sums, first_sigma = Sums(np.empty((n, 9, 9)), np.empty(n)), np.empty(n)
    _seed(stack, usable, picks, trial.weights, first_sigma)
    best, promise, iterations = np.inf, np.inf, 0
    found.costs[:] = np.inf
    seeds, sigma_px, minima = trial.weights.copy(), first_sigma.copy(), no_minima(KEEP, n)
    # What the seeds hold of mismatches moves the minima that they show; few cameras leave many to be told apart, so there it
    # is looked again at what is left.
    for look in range(LOOKS if n <= FEW else 1):
        for t in range(n):
            first, last = stack.offsets[t], stack.offsets[t + 1]
            moments_into(stack.x[first:last], stack.y[first:last], seeds[first:last], sums.moments[t])
            # A term without a seed has no say, but a count.
            if not sums.moments[t, 8, 8] > 0.0:
                sums.moments[t, 8, 8] = 1e-9
            sums.variance[t] = (sigma_px[t] / stack.focal[t]) ** 2
        iterations += search(stack, sums, guesses, minima)
        for m in range(KEEP):
            # Others are refined as well where they are nearly as likely, or where the first led nowhere.
            if not minima.likelihoods[m] > (minima.likelihoods[0] - SECOND_CHANCE if promise < SETTLED else -np.inf):
                continue
            k = KEEP * look + m
            if look > 0 and _refined(minima.rotations[m], found, k):
                continue
            _start_at(stack, minima, m, first_sigma, trial)
            done, promised, cost = reweight(stack, usable, trial, SIGMA_FLOOR_PX)
            iterations += done
            found.rotations[k], found.shifts[k] = trial.candidate.rotation, trial.candidate.shift
            found.costs[k], found.inliers[k] = cost, (trial.weights > 0.0).sum()
            if cost < best:
                best, promise = cost, promised
                _become(fit, trial)
        if not best < np.inf:
            break
        for i in range(len(seeds)):
            seeds[i] = 1.0 if fit.weights[i] > 0.0 else 0.0
        sigma_px[:] = fit.sigma_px
    if best < np.inf:
        done, promised, cost = _noisier(stack, usable, fit, SIGMA_GROWTH * first_sigma.max(), best, trial)
        iterations += done
        if cost < best:
            promise, k = promised, int(np.argmin(found.costs))
            _become(fit, trial)
            found.rotations[k], found.shifts[k] = fit.candidate.rotation, fit.candidate.shift
            found.costs[k], found.inliers[k] = cost, (fit.weights > 0.0).sum()
    return fit, found, iterations, promise


@kernel
def _noisier(
    stack: Stack, usable: FloatArray, fit: Reweighted, most: float, best: float, trial: Reweighted
) -> tuple[int, float, float]:
    """trial becomes the fit with more noise than `most`, where noise is held down by that in most of the cameras and more is
    likelier: what is held down chooses matches that need not be any motion's. Of some of the cameras only, these may be at
    fault; and where what agrees is spread evenly, it is no noise.

    Returns:
        as `reweight`; a cost of infinity without one.
    """
    iterations, promise, cost = 0, np.inf, np.inf
    _become(trial, fit)
    for _ in range(NOISIER):
        if 2 * (trial.sigma_px > HELD * most).sum() <= len(trial.sigma_px):
            break
        most = SIGMA_GROWTH * trial.sigma_px.max()
        done, promised, cost_again = reweight(stack, usable, trial, SIGMA_FLOOR_PX)
        iterations += done
        if not cost_again < best:
            return iterations, np.inf, np.inf
        promise, cost, best = promised, cost_again, cost_again
    return iterations, promise, np.inf if spread_evenly(trial.weights) else cost


@kernel
def _become(to: Reweighted, source: Reweighted) -> None:
    """to becomes equal to source."""
    copy_into(to.candidate, source.candidate)
    to.sigma_px[:], to.weights[:], to.across[:] = source.sigma_px, source.weights, source.across
    to.information[:], to.without_depth[:] = source.information, source.without_depth
    to.noise[:], to.relief[:], to.place[:] = source.noise, source.relief, source.place


def fitted(stack: Stack, usable: BoolArray, guesses: Guesses, rng: Uniform) -> tuple[Reweighted, Settled, int, float]:
    """`robust_fit` with quadruples drawn from rng."""
    # Probabilities, as of a mixture: one compiled version does.
    return robust_fit(stack, usable.astype(np.float64), rng.random((QUADRUPLES, 4)), guesses)


@kernel
def _start_at(stack: Stack, minima: Minima, m: int, sigma_px: FloatArray, trial: Reweighted) -> None:
    """trial starts from one of the minima, with noise sigma_px (T,), all that it has no say of as it is believed."""
    trial.sigma_px[:] = sigma_px
    trial.weights[:] = 0.0
    trial.candidate.rotation[:], trial.candidate.shift[:] = minima.rotations[m], minima.shifts[m]
    trial.candidate.surface[:] = stack.surface_mean
    for t in range(len(sigma_px)):
        for j in range(1, 3):
            trial.candidate.surface[t, j] = minima.surfaces[m, t, j]


@kernel
def _refined(rotation: FloatArray, found: Settled, count: int) -> bool:
    """Whether one of the first minima that were refined is where a rotation (3, 3) leads."""
    turn = 3.0 - (rotation[0, 0] + rotation[1, 1] + rotation[2, 2])
    for k in range(count):
        if not found.costs[k] < np.inf:
            continue
        gap = 3.0
        for i in range(3):
            for j in range(3):
                gap -= rotation[i, j] * found.rotations[k, i, j]
        if gap < SAME_SHARE**2 * turn:
            return True
    return False


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
