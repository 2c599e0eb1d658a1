"""More than one motion among the matches that one motion was fitted to: bodies taken for one, and a standing background.

Two bodies side by side that move nearly alike are explained by one motion and a bent surface, with residuals that are too
large by a little: nothing that a robust weight sees. But residuals across epipolar lines are noise, which neighbours do not
share, and a wrong motion is wrong for neighbours alike (`alike`).

Where an object moves by a few pixels, what stands still lies near the epipolar lines of its motion, too. There every match
is taken to stand still with some probability, and the motion is fitted to those that move (`parted`).

Source: contiguity, Moran, Biometrika 37, 1950; mixtures by expectation and maximisation, and what they do not tell,
McLachlan & Krishnan, "The EM Algorithm and Extensions", chapters 2 and 4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.numerics.arrays import BoolArray, FloatArray
from sylpose.numerics.compiled import kernel
from sylpose.two_frames.fit import MIN_MATCHES
from sylpose.two_frames.match_cost import Tolerance, matched
from sylpose.two_frames.reweight import CUTOFF, Reweighted, reweight
from sylpose.two_frames.robust_fit import Settled, fitted
from sylpose.two_frames.terms import Guesses, Stack
from sylpose.two_frames.verdict import is_consistent

__all__ = ["Parted", "alike", "is_mixed", "parted", "some_move"]

# Neighbours of a match in the image that its residual is compared with, and of a camera's matches so many at most (choice).
NEIGHBOURS, COMPARED = 3, 120
# Matches of less weight, which may be another's, are not compared (choice).
COUNTS = 0.3
# Cameras of fewer matches are not asked (choice).
JUDGED = 8
# Residuals are alike where their correlation exceeds nothing by so many standard deviations, of about 1.3 (measured: 150
# scenes of each of ten settings of benchmarks/nees.py, 4.2 at most), and this itself: with many matches calibrations that
# are off by a little show, too (choice).
ALIKE, ALIKE_AT_LEAST = 5.0, 0.15
# ... and what they share is more than this, pixels: less is rounding, lenses and keypoints (choice).
ALIKE_PX = 0.1
# Squares of displacements, of two coordinates in units of their noise, beyond which nothing stands still and below which all
# may (chi-squared of two degrees of freedom: once in a thousand and in ten times).
STILL, MAY_STAND = 13.8, 4.6
# Of what has moved by a little, between these squares, chance has no more than this share and so many (chi-squared of two
# degrees of freedom: 1 %, and three times it; choice).
MOVES, NEARBY, MOVE_BY_CHANCE, MOVERS = 9.2, 200.0, 0.03, 6
# A background is looked for where so large a share of the matches, and so many, may stand still (choice).
BACKGROUND = 0.08
# What goes farther does not stand still whatever the noise, pixels (choice).
QUIET_PX = 6.0
# Rounds of the mixture (choice), and by how much it must be likelier than one motion (choice: six unknowns more, and the
# best of two).
ROUNDS, LIKELIER = 6, 12.0
# A match of either kind may lie anywhere in a square of so many spreads, with this probability (choice).
ANYWHERE, WRONG = 4.0, 0.05


@kernel
def alike(stack: Stack, found: Reweighted) -> tuple[float, float, float]:
    """How alike the residuals of neighbours are: their correlation, that in its standard deviations, and their covariance,
    square pixels."""
    total, shared, pairs = 0.0, 0.0, 0
    index, nearest, squares = np.empty(COMPARED, np.int64), np.empty(NEIGHBOURS, np.int64), np.empty(NEIGHBOURS)
    for t in range(stack.focal.shape[0]):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        n, stride = 0, 1 + (last - first) // COMPARED
        for i in range(first, last, stride):
            if found.weights[i] > COUNTS:
                index[n] = i
                n += 1
        if n < JUDGED:
            continue
        for k in range(n):
            i = index[k]
            squares[:], nearest[:] = np.inf, i
            for k2 in range(n):
                j = index[k2]
                square = (stack.x[i, 0] - stack.x[j, 0]) ** 2 + (stack.x[i, 1] - stack.x[j, 1]) ** 2
                # The same match again tells nothing.
                if square < squares[NEIGHBOURS - 1] and square > 0.0:
                    place = NEIGHBOURS - 1
                    while place > 0 and square < squares[place - 1]:
                        squares[place], nearest[place] = squares[place - 1], nearest[place - 1]
                        place -= 1
                    squares[place], nearest[place] = square, j
            for place in range(NEIGHBOURS):
                if squares[place] < np.inf:
                    both = found.across[i] * found.across[nearest[place]]
                    shared += both
                    total += both / found.sigma_px[t] ** 2
                    pairs += 1
    if pairs == 0:
        return 0.0, 0.0, 0.0
    return total / pairs, total / np.sqrt(pairs), shared / pairs


def is_mixed(correlation: float, deviations: float, covariance: float) -> bool:
    """Whether what neighbours share is more than one motion and noise explain."""
    return bool(deviations > ALIKE and correlation > ALIKE_AT_LEAST and covariance > ALIKE_PX**2)


def some_move(stack: Stack, usable: BoolArray, one: Reweighted) -> bool:
    """Whether more matches have moved by a little than would if all stood still; mismatches go farther."""
    off = np.empty(len(stack.x))
    _displacements(stack, off)
    squares = 0.5 * off / _still_sigma(off, usable, one) ** 2
    moved = int((usable & (squares > MOVES) & (squares < NEARBY)).sum())
    return bool(moved > MOVE_BY_CHANCE * usable.sum() + MOVERS)


class Parted(NamedTuple):
    """A motion and the background that it was told from.

    Attributes:
        found: of what moves, its weights times the probability that they do.
        minima, iterations, promise: of `fitted`.
        moving: (N,) the probabilities.
        told: the part of the information that is left, since it is not certain which matches move.
    """

    found: Reweighted
    minima: Settled
    iterations: int
    promise: float
    moving: FloatArray
    told: float


def parted(
    stack: Stack,
    usable: BoolArray,
    one: Reweighted,
    guesses: Guesses,
    rng: np.random.Generator,
) -> Parted | None:
    """A motion of some of the matches while others stand still; None where one motion does for all.

    Args:
        usable: (N,) matches that may be inliers.
        one: the motion of all of them, which may be none.
    """
    off = np.empty(len(stack.x))
    background = max(MIN_MATCHES, BACKGROUND * len(off))
    if _displacements(stack, off) < background:
        return None
    sigma = _still_sigma(off, usable, one)
    squares = 0.5 * off / sigma**2
    still = int((usable & (squares < MAY_STAND)).sum())
    moves = usable & (squares > STILL)
    if still < background or moves.sum() < 2 * MIN_MATCHES:
        return None
    found, minima, iterations, promise = fitted(stack, moves, guesses, rng)
    if not (found.weights > 0).sum() >= 2 * MIN_MATCHES or not is_consistent(stack, moves, found):
        return None
    share, moving = still / usable.sum(), np.zeros(len(off))
    for _ in range(ROUNDS):
        standing, going, anywhere = _densities(stack, found, squares, sigma)
        each = np.stack([share * standing, (1 - WRONG - share) * going, WRONG * anywhere])
        moving = np.where(usable, each[1] / (each[0] + each[1]), 0.0)
        share = float(np.clip((each[0] / each.sum(axis=0))[usable].mean(), 1e-3, 1 - WRONG - 1e-3))
        done, promise, _ = reweight(stack, moving, found)
        iterations += done
    standing, going, anywhere = _densities(stack, found, squares, sigma)
    mixture = np.log(share * standing + (1 - WRONG - share) * going + WRONG * anywhere)
    _, alone, _ = _densities(stack, one, squares, sigma)
    single = np.log(
        (1 - WRONG) * np.maximum(alone, share * standing if not one.weights.any() else 0.0) + WRONG * anywhere
    )
    if not (mixture - single)[usable].sum() > LIKELIER:
        return None
    inside = found.weights > 0
    told = float((moving**2)[inside].sum() / max(moving[inside].sum(), 1e-12))
    minima.costs[:] = np.inf
    return Parted(found, minima, iterations, promise, moving, told)


@kernel
def _displacements(stack: Stack, off: FloatArray) -> int:
    """off (N,) becomes the squares of the displacements, square pixels; returns how many may be noise, at most."""
    quiet = 0
    for t in range(stack.focal.shape[0]):
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            square = (stack.y[i, 0] - stack.x[i, 0]) ** 2 + (stack.y[i, 1] - stack.x[i, 1]) ** 2
            off[i] = square * stack.focal[t] ** 2
            quiet += off[i] < QUIET_PX**2
    return quiet


def _still_sigma(off: FloatArray, usable: BoolArray, one: Reweighted) -> float:
    """The noise of what stands still, pixels: that of the motion's inliers, unless what hardly moves has less."""
    sigma = float(np.median(one.sigma_px)) if one.weights.any() else np.inf
    some = np.sort(off[usable])
    # Half of a square of two coordinates, of twice the variance, is below its median half of the time.
    least = some[: max(len(some) // 4, 1)]
    quarter = float(np.sqrt(least[-1] / (4.0 * -np.log(0.75)))) if len(least) else 1.0
    return max(min(sigma, quarter if np.isfinite(quarter) and quarter > 0 else sigma, 3.0), 0.02)


def _densities(
    stack: Stack, found: Reweighted, squares: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(N,) of each match if it stands still, if it moves along, and if it is wrong; per unit of the noise's square."""
    going = np.zeros(len(squares))
    anywhere = np.zeros(len(squares))
    every = np.ones(len(squares), dtype=bool)
    for t, (first, last) in enumerate(zip(stack.offsets, stack.offsets[1:], strict=False)):
        variance, relief = (found.sigma_px[t] / stack.focal[t]) ** 2, found.relief[t]
        m = matched(stack, t, found.candidate, Tolerance(variance, relief, relief, CUTOFF), every, noise=False)[0]
        spread = np.sqrt(1.0 + (relief * m.parallax) ** 2 / variance)
        ratio = (sigma / found.sigma_px[t]) ** 2
        going[first:last] = ratio * np.exp(-0.5 * np.minimum(m.distance, 1e3)) / spread
        anywhere[first:last] = 4.0 * np.pi * (sigma / stack.focal[t]) ** 2 / (ANYWHERE * stack.spread[t]) ** 2
    return np.exp(-0.5 * squares), going, np.maximum(anywhere, 1e-12)
