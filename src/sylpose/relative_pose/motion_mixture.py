"""More than one motion among the matches that one motion was fitted to: bodies taken for one, and two of them apart.

Two bodies side by side that move nearly alike are explained by one motion and a bent surface, with residuals that are too
large by a little: nothing that a robust weight sees. But residuals across epipolar lines are noise, which neighbours do not
share, and a wrong motion is wrong for neighbours alike (`alike`).

Where both motions are known, many matches of one lie near the epipolar lines of the other's: every match has one of them, or
the other, with some probability (`apart`).

Source: contiguity, Moran, Biometrika 37, 1950; mixtures by expectation and maximisation, McLachlan & Krishnan, "The EM
Algorithm and Extensions", chapters 2 and 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX, Reweighted, nothing_yet, reweight
from sylpose.relative_pose.match_likelihood import WRONG, anywhere, cost_of, going
from sylpose.relative_pose.terms import Stack

__all__ = ["Apart", "alike", "apart", "is_mixed"]

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
# Where a motion is hardly seen (`unless_straight`), or it is not certain which matches have it, one of nobody's is found
# more often, and so much will do (measured: of 7,508 right answers 13 that are hardly seen are beyond, of 82 wrong ones 16).
ALIKE_UNSURE = 2.5
# ... and what they share is more than this, pixels: less is rounding, lenses and keypoints (choice).
ALIKE_PX = 0.1
# Rounds of a mixture, at most, which has settled where no more than this of a match changes sides; and one motion's noise is
# not less than so much of the other's (choice).
ROUNDS, SETTLED = 40, 0.02
LESS_NOISE = 0.9


@kernel
def alike(stack: Stack, found: Reweighted) -> tuple[float, float, float]:
    """How alike the residuals of neighbours are: their correlation, that in its standard deviations, and their covariance,
    square pixels."""
    total, shared, pairs = 0.0, 0.0, 0
    index, nearest, squares = np.empty(COMPARED, np.int64), np.empty(NEIGHBOURS, np.int64), np.empty(NEIGHBOURS)
    u, v = np.empty(COMPARED), np.empty(COMPARED)
    for t in range(stack.focal.shape[0]):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        n, stride = 0, 1 + (last - first) // COMPARED
        for i in range(first, last, stride):
            if found.weights[i] > COUNTS:
                # From left to right, so that neighbours are met first.
                k = n
                while k > 0 and u[k - 1] > stack.x[i, 0]:
                    index[k], u[k], v[k] = index[k - 1], u[k - 1], v[k - 1]
                    k -= 1
                index[k], u[k], v[k] = i, stack.x[i, 0], stack.x[i, 1]
                n += 1
        if n < JUDGED:
            continue
        for k in range(n):
            i = index[k]
            squares[:], nearest[:] = np.inf, i
            for way in range(-1, 2, 2):
                j = k + way
                while 0 <= j < n:
                    aside = (u[k] - u[j]) ** 2
                    if not aside < squares[NEIGHBOURS - 1]:
                        break
                    far = aside + (v[k] - v[j]) ** 2
                    # The same match again tells nothing.
                    if far < squares[NEIGHBOURS - 1] and far > 0.0:
                        place = NEIGHBOURS - 1
                        while place > 0 and far < squares[place - 1]:
                            squares[place], nearest[place] = squares[place - 1], nearest[place - 1]
                            place -= 1
                        squares[place], nearest[place] = far, index[j]
                    j += way
            for place in range(NEIGHBOURS):
                if squares[place] < np.inf:
                    both = found.across[i] * found.across[nearest[place]]
                    shared += both
                    total += both / found.sigma_px[t] ** 2
                    pairs += 1
    if pairs == 0:
        return 0.0, 0.0, 0.0
    return total / pairs, total / np.sqrt(pairs), shared / pairs


@kernel
def is_mixed(correlation: float, deviations: float, covariance: float, unsure: bool) -> bool:
    """Whether what neighbours share is more than one motion and noise explain.

    Args:
        correlation, deviations, covariance: of `alike`.
        unsure: whether the motion is hardly seen, or it is not certain which matches have it.
    """
    enough = deviations > (ALIKE_UNSURE if unsure else ALIKE)
    return bool(enough and correlation > ALIKE_AT_LEAST and covariance > ALIKE_PX**2)


class Apart(NamedTuple):
    """Two motions, each of some of the matches.

    Attributes:
        found: the two motions, their weights times the probabilities that they are the match's.
        having: (2, N) the probabilities.
        cost: negative log-likelihood of the matches.
        promise: what the last steps promised (`reweight`), the larger of the two.
        iterations: of the solver.
    """

    found: tuple[Reweighted, Reweighted]
    having: FloatArray
    cost: float
    promise: float
    iterations: int


def apart(stack: Stack, starts: Sequence[tuple[FloatArray, FloatArray]], inliers: Sequence[BoolArray]) -> Apart:
    """Expectation and maximisation from two motions (R, d) and (N,) their inliers, of which some are both's."""
    found, having = (nothing_yet(stack), nothing_yet(stack)), np.zeros((2, len(stack.x)))
    promises, iterations = [np.inf, np.inf], 0
    for k, ((rotation, shift), mine) in enumerate(zip(starts, inliers, strict=True)):
        found[k].candidate.rotation[:], found[k].candidate.shift[:] = rotation, shift
        iterations += reweight(stack, (mine & ~inliers[1 - k]).astype(float), found[k], SIGMA_FLOOR_PX)[0]
    shares, wrong, every = np.full(2, 0.5), anywhere(stack), np.ones(len(stack.x), dtype=bool)
    for _ in range(ROUNDS):
        each = np.stack([share * (1.0 - WRONG) * going(stack, f) for share, f in zip(shares, found, strict=True)])
        before, having = having, each / (each.sum(axis=0) + WRONG * wrong)
        shares = having.sum(axis=1) / max(float(having.sum()), 1e-300)
        for k in range(2):
            # Both have the same noise: else some few that agree by chance would be a body.
            least = LESS_NOISE * float(np.median(found[1 - k].sigma_px))
            done, promises[k], _ = reweight(stack, having[k], found[k], least)
            iterations += done
        if np.abs(having - before).max() < SETTLED or not max(promises) < np.inf:
            break
    both = shares[0] * going(stack, found[0]) + shares[1] * going(stack, found[1])
    return Apart(found, having, cost_of(stack, every, both), max(promises), iterations)
