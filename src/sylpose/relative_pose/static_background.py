"""What stands still behind an object that moves by little.

Where an object moves by a few pixels, what stands still lies near the epipolar lines of its motion, too. There every match
is taken to stand still with some probability, and the motion is fitted to those that move (`parted`). Who stands still is
then not certain, and the information is less by what that takes away: what a match says of the motion, squared, times the
probabilities that it is the motion's and that it is not.

Source: mixtures by expectation and maximisation, McLachlan & Krishnan, "The EM Algorithm and Extensions", chapters 2 and 4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel, rotation_of, rotvec_of
from sylpose.relative_pose.fit import MIN_MATCHES
from sylpose.relative_pose.irls import Reweighted, nothing_yet, reweight
from sylpose.relative_pose.match_likelihood import WRONG, anywhere, cost_of, going
from sylpose.relative_pose.observability import is_consistent
from sylpose.relative_pose.robust_fit import Settled, Uniform, fitted
from sylpose.relative_pose.terms import Candidate, Guesses, Stack, copy_into

__all__ = ["LARGER", "LIKELIER", "Parted", "hidden", "may_stand", "parted", "some_move"]

# Of what has moved by a little, in units of noise, between these squares, chance has no more than this share and so many
# (chi-squared of two degrees of freedom: 1 %, and three times it; choice).
MOVES, NEARBY, MOVE_BY_CHANCE, MOVERS = 9.2, 200.0, 0.03, 6
# A background is looked for where so large a share of the matches, and so many, may stand still (choice).
BACKGROUND = 0.08
# What goes farther does not stand still whatever the noise; what goes farther than the second tells nothing of it, pixels
# (choice).
QUIET_PX, FAR_PX = 6.0, 18.0
# Bounds of what the noise of what stands still may be, pixels, and of its share of all matches, some of which are wrong
# (choice).
SIGMA_PX, SHARES = (0.02, 3.0), (1e-3, 0.999 - WRONG)
# Rounds of two kinds of displacements, and of the mixture, at most, which has settled where no more than this of a match
# changes sides (choice).
APART, ROUNDS, SETTLED = 50, 15, 0.02
# Displacements that two kinds are told by, about, and by how little their share still changes then (choice).
COMPARED, SAME_SHARE = 256, 1e-6
# What moves is no noisier than this times what stands still, which may be exact: two frames of a pause (choice).
NOISIER, EXACT_PX = 5.0, 0.1
# A motion is another's start where it is within three of its standard deviations (choice).
NEAR = 9.0
# By how much a mixture must be likelier than one motion (measured: docs/benchmarks.md#hard-pairs; of what moves by 1 to 4 px
# before nothing, 2.1 at most in 24 scenes), and so many matches move, at least (choice).
LIKELIER, LEAST = 3.0, 2 * MIN_MATCHES
# By how much larger a motion may be than that of all matches, where it is that of some; rounds that tell their share; and
# what is nearly as likely: two standard deviations (choice).
LARGER, SHARED, AS_LIKELY = (1.25, 1.5, 2.0, 3.0, 5.0, 8.0), 8, 2.0
# What moves has at least so much of the noise of what stands still, and that has no more than so much of that of all matches
# (choice).
LESS_NOISE, MORE_NOISE = 0.9, 1.2


class Parted(NamedTuple):
    """A motion and the background that it was told from.

    Attributes:
        found: of what moves, its weights times the probability that they do.
        minima: where mixtures from several starts came to; iterations: of all.
        promise: of its last step (`reweight`).
        moving: (N,) the probabilities.
        gain: by how much this is likelier than that all have one motion.
    """

    found: Reweighted
    minima: Settled
    iterations: int
    promise: float
    moving: FloatArray
    gain: float

    def rivals(self, cost: float) -> Settled:
        """The minima, where that of the one motion has this cost."""
        return self.minima._replace(costs=self.minima.costs - self.minima.costs.min() + cost - self.gain)


class _Mixture(NamedTuple):
    """Where expectation and maximisation came to: the motion, how likely each match is to have it, and to stand still, the
    noise of what does, and what `reweight` says of the last round; its cost is that of the mixture."""

    found: Reweighted
    moving: FloatArray
    still: FloatArray
    sigma: float
    cost: float
    promise: float
    iterations: int


def some_move(stack: Stack, usable: BoolArray, one: Reweighted) -> bool:
    """Whether more matches have moved by a little than would if all stood still; mismatches go farther."""
    off = _displacements(stack)
    squares = 0.5 * off / _still_sigma(off, usable, one) ** 2
    moved = int((usable & (squares > MOVES) & (squares < NEARBY)).sum())
    return bool(moved > MOVE_BY_CHANCE * usable.sum() + MOVERS)


def parted(
    stack: Stack,
    usable: BoolArray,
    one: Reweighted,
    likelier: float,
    guesses: Guesses,
    rng: Uniform,
) -> Parted | None:
    """A motion of some of the matches while others stand still; None where one motion does for all.

    Args:
        usable: (N,) matches that may be inliers.
        one: the motion of all of them, which may be none.
        likelier: by how much a background is, as `hidden` has it, which finds that there may be one.
    """
    off = _displacements(stack)
    sigma, still = _two_kinds(off, usable)
    if not still[usable].sum() >= _background(off):
        return None
    # Where even what moves least moves by more than noise, nothing stands still.
    if one.weights.any() and not likelier > 0.0 and sigma > MORE_NOISE * float(np.median(one.sigma_px)):
        return None
    starts, iterations = [one] if one.weights.any() else [], 0
    moves = usable & (still < 0.5)
    if moves.sum() >= LEAST:
        found, _, iterations, _ = fitted(stack, moves, guesses, rng)
        starts = [found, *starts] if found.weights.any() else starts
    mixtures: list[_Mixture] = []
    for start in starts:
        # From where another one has come to, nothing else is found.
        if not any(_is_near(mixture.found, start) for mixture in mixtures):
            mixtures.append(_mixture(stack, usable, start, off, sigma, still))
    mixtures = [mixture for mixture in mixtures if _holds(stack, usable, mixture)]
    if not mixtures:
        return None
    best = min(mixtures, key=lambda mixture: mixture.cost)
    minima = Settled(
        np.array([mixture.found.candidate.rotation for mixture in mixtures]),
        np.array([mixture.found.candidate.shift for mixture in mixtures]),
        np.array([mixture.cost for mixture in mixtures]),
        np.full(len(mixtures), float(usable.sum())),
    )
    iterations += sum(mixture.iterations for mixture in mixtures)
    alone = going(stack, one) if one.weights.any() else _standing(off, best.sigma)
    gain = cost_of(stack, usable, alone) - best.cost
    return Parted(best.found, minima, iterations, best.promise, best.moving, gain)


def hidden(stack: Stack, usable: BoolArray, one: Reweighted) -> tuple[float, float]:
    """By how much larger than that of all matches the motion may be, if some of them are a background that stands still: 1
    where it cannot be larger, and `LARGER`'s last where nothing tells; and by how much likelier a background is than none,
    minus infinity where there cannot be one.

    Half of the matches that move by twice as much are the same in the mean, and more scattered.
    """
    off = _displacements(stack)
    larger = nothing_yet(stack)
    larger.sigma_px[:], larger.relief[:] = one.sigma_px, one.relief
    return _larger(stack, usable, one.candidate, larger, _standing(off, float(np.median(one.sigma_px))))


@kernel
def _larger(
    stack: Stack, usable: BoolArray, one: Candidate, larger: Reweighted, standing: FloatArray
) -> tuple[float, float]:
    """What `hidden` says, of a motion and the densities (N,) if all stand still; larger has the noise, and is room."""
    turn, most, alone, least = np.empty(3), 1.0, 0.0, np.inf
    rotvec_of(one.rotation, turn)
    for k in range(1 + len(LARGER)):
        factor = LARGER[k - 1] if k > 0 else 1.0
        copy_into(larger.candidate, one)
        rotation_of(factor * turn, larger.candidate.rotation)
        larger.candidate.shift[:] = factor * one.shift
        along = going(stack, larger)
        if k == 0:
            alone = cost_of(stack, usable, along)
        share = max(1.0 - 1.0 / factor, BACKGROUND)
        for _ in range(SHARED):
            total, count = 0.0, 0
            for i in range(len(along)):
                if usable[i]:
                    both = share * standing[i] + (1.0 - share) * along[i]
                    total += share * standing[i] / max(both, 1e-300)
                    count += 1
            share = total / count
        cost = cost_of(stack, usable, share * standing + (1.0 - share) * along)
        # The first of all costs is that of no background.
        if cost > min(least, alone) + AS_LIKELY:
            return most, alone - min(least, cost)
        least, most = min(least, cost), factor
    return most, alone - least


def _still_sigma(off: FloatArray, usable: BoolArray, one: Reweighted) -> float:
    """The noise of what stands still, pixels: that of the motion's inliers, unless what hardly moves has less."""
    sigma = float(np.median(one.sigma_px)) if one.weights.any() else np.inf
    some = np.sort(off[usable])
    # Half of a square of two coordinates, of twice the variance, is below its median half of the time.
    least = some[: max(len(some) // 4, 1)]
    quarter = float(np.sqrt(least[-1] / (4.0 * -np.log(0.75)))) if len(least) else 1.0
    return max(min(sigma, quarter if np.isfinite(quarter) and quarter > 0 else sigma, 3.0), 0.02)


@kernel
def _displacements(stack: Stack) -> FloatArray:
    """(N,) their squares, square pixels."""
    out = np.empty(len(stack.x))
    for t in range(len(stack.focal)):
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            dx, dy = stack.y[i, 0] - stack.x[i, 0], stack.y[i, 1] - stack.x[i, 1]
            out[i] = (dx * dx + dy * dy) * stack.focal[t] ** 2
    return out


@kernel
def may_stand(stack: Stack, usable: BoolArray) -> bool:
    """Whether so many matches have moved by so little that a background may be among them. Of terms with other references
    than the motion's (earlier frames, moved along by what is known) a displacement says nothing of it."""
    quiet = 0
    for t in range(len(stack.focal)):
        for i in range(3):
            if stack.a1[t, i] != stack.a2[t, i]:
                return False
            for j in range(3):
                if stack.qx[t, i, j] != stack.qy[t, i, j]:
                    return False
        far = (QUIET_PX / stack.focal[t]) ** 2
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            dx, dy = stack.y[i, 0] - stack.x[i, 0], stack.y[i, 1] - stack.x[i, 1]
            quiet += usable[i] and dx * dx + dy * dy < far
    return quiet >= max(MIN_MATCHES, BACKGROUND * len(stack.x))


def _background(off: FloatArray) -> float:
    """The number of matches that a background has, at least."""
    return max(MIN_MATCHES, BACKGROUND * len(off))


def _two_kinds(off: FloatArray, usable: BoolArray) -> tuple[float, FloatArray]:
    """Squares of displacements (N,) as two kinds of noise, one larger: the less, as a standard deviation in pixels of a
    keypoint, and (N,) the probability of each match to be of it. What goes far is of neither."""
    near = off < FAR_PX**2
    some = np.sort(off[usable & near])
    # A square of two coordinates is exponential; its mean is four times the variance of one keypoint's coordinate.
    least, most = (max(float(part.mean()), 1e-12) for part in np.array_split(some, 2))
    # Of many each so manieth tells as much.
    share, least, most = _shares(some[:: 1 + len(some) // COMPARED], least, most)
    odds = (1.0 - share) / share * least / most
    still = 1.0 / (1.0 + odds * np.exp(np.minimum(off * (1.0 / least - 1.0 / most), 700.0)))
    return float(np.sqrt(least / 4.0)), np.where(near, still, 0.0)


@kernel
def _shares(some: FloatArray, least: float, most: float) -> tuple[float, float, float]:
    """The share of the less of two exponential distributions, and the means of both, from those of the halves."""
    share, n = 0.5, len(some)
    for _ in range(APART):
        odds, rate = (1.0 - share) / share * least / most, 1.0 / least - 1.0 / most
        mass, square, rest = 0.0, 0.0, 0.0
        for i in range(n):
            p = 1.0 / (1.0 + odds * np.exp(min(some[i] * rate, 700.0)))
            mass += p
            square += p * some[i]
            rest += (1.0 - p) * some[i]
        before, share = share, min(max(mass / n, 1e-3), 1.0 - 1e-3)
        least = max(square / mass, 4.0 * SIGMA_PX[0] ** 2)
        most = max(rest / max(n - mass, 1e-300), least)
        if abs(share - before) < SAME_SHARE:
            break
    return share, least, most


def _mixture(
    stack: Stack, usable: BoolArray, start: Reweighted, off: FloatArray, sigma: float, still: FloatArray
) -> _Mixture:
    """Expectation and maximisation from one motion, the noise of what stands still, and the probabilities (N,) of that."""
    found = nothing_yet(stack)
    copy_into(found.candidate, start.candidate)
    found.sigma_px[:], found.relief[:] = start.sigma_px, start.relief
    share, moving, promise, iterations = float(np.clip(still[usable].mean(), *SHARES)), np.zeros(len(off)), np.inf, 0
    each, wrong = np.zeros((3, len(off))), anywhere(stack)
    for _ in range(ROUNDS):
        each = np.stack([share * _standing(off, sigma), (1 - WRONG - share) * going(stack, found), WRONG * wrong])
        each = np.where(usable, each / each.sum(axis=0), 0.0)
        share = float(np.clip(each[0].sum() / usable.sum(), *SHARES))
        # What stands still has the noise of what moves, or less: that of the motion holds what it does not explain, too.
        sigma = float(np.clip(np.sqrt((each[0] * off).sum() / max(4.0 * each[0].sum(), 1e-300)), *SIGMA_PX))
        change = float(np.abs(each[1] - moving).max())
        moving = each[1]
        # Else some few that agree by chance, nearly without noise, would be what moves.
        done, promise, _ = reweight(stack, moving, found, LESS_NOISE * sigma)
        iterations += done
        if change < SETTLED or not promise < np.inf:
            break
    share /= 1.0 - WRONG
    cost = cost_of(stack, usable, share * _standing(off, sigma) + (1.0 - share) * going(stack, found))
    return _Mixture(found, moving, each[0], sigma, cost, promise, iterations)


def _is_near(found: Reweighted, start: Reweighted) -> bool:
    """Whether a start is, for all that can be said, the motion that was found."""
    turn = np.empty(3)
    rotvec_of(start.candidate.rotation @ found.candidate.rotation.T, turn)
    step = np.concatenate([turn, start.candidate.shift - found.candidate.shift])
    return bool(step @ found.information @ step < NEAR)


def _holds(stack: Stack, usable: BoolArray, mixture: _Mixture) -> bool:
    """Whether enough of what does not stand still has the motion, more than would by chance, and about as exactly as what
    stands still does."""
    if float(np.median(mixture.found.sigma_px)) > NOISIER * max(mixture.sigma, EXACT_PX):
        return False
    others = usable & (mixture.still < 0.5)
    found = mixture.found._replace(weights=np.where(others, mixture.found.weights, 0.0))
    return bool(mixture.moving.sum() >= LEAST and is_consistent(stack, others, found))


@kernel
def _standing(off: FloatArray, sigma: float) -> FloatArray:
    """(N,) densities if all stand still, per square pixel."""
    out = np.empty(len(off))
    for i in range(len(off)):
        out[i] = np.exp(-0.25 * off[i] / sigma**2) / (4.0 * np.pi * sigma**2)
    return out
