"""The pose that best aligns landmarks of uncertain depth with where their features are now.

Each match is a landmark X, known well across the ray it was first seen along and less well, by a standard deviation s,
along it, and an image point y. Depths are off in two ways: each for itself, and all of a camera's together, since the
object's surface is not where it was thought to be. So the landmark is at X + s r (a1 + a2 u + a3 v + ε), with r the ray,
(u, v) the place in the image, ε and the camera's three a's of unit variance. The a's are unknowns beside the six of the
motion; ε goes into the weight V = σ² I + J s² r r' J' of the image residual. A landmark that was seen once constrains only
across its epipolar line, one that is well known constrains both ways as in solvePnP, and everything in between is in
between. There is no identity trap and no degenerate object. V is held fixed within an iteration (quasi-likelihood):
letting the cost trade V against the residuals is biased towards too much motion (docs/method.md, "Better than two
frames").

Three things keep many matches from being believed too much. Neighbours' depths are off alike, so along their lines only a
few of a camera's matches count as independent. Each camera has its own noise σ. And a camera that disagrees with the
others, as one does that was moved or calibrated badly, is believed the less the more it disagrees: by the chi-squared of
its pose against theirs, a smooth function without a cliff. Should they disagree, each camera is left out once, and of the
poses so found the one is taken that all cameras but one agree on best.

Each round is one camera's part (`camera_terms`), which needs that camera's matches alone, and a joint step (`joint_step`),
which needs a few numbers from each: `align` runs both in one process, `OneOfMany` runs one camera among others elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sylpose.landmarks.camera_terms import (
    Own,
    Stacked,
    camera_terms,
    judge,
    noise_of,
    own_of,
    take_step,
)
from sylpose.landmarks.joint_step import MAX_ROUNDS, Round, first_round, joint_step, measures_noise
from sylpose.landmarks.told import Exchange, Has, Judges, Says
from sylpose.numerics.arrays import FloatArray, IntArray
from sylpose.numerics.compiled import kernel

__all__ = ["FIRST_PX", "Aligned", "OneOfMany", "Sights", "align"]

# Noise that the first, forgiving rounds assume, pixels: from a bad prediction to a keypoint's own noise (choice).
SCHEDULE_PX = (32.0, 16.0, 8.0, 4.0, 2.0, 1.0)
FIRST_PX = SCHEDULE_PX[0]
# Cameras disagree when one of them is doubted by this factor, has this many times the rig's noise, or this much less of its
# matches agree than of another's (choice).
DOUBTED, NOISY, FEWER = 3.0, 2.0, 0.6
# By so much of the mean robust cost another pose than the first has to be better (choice).
VOTE_MARGIN = 0.01
# A camera with fewer matches has no opinion of its own; as many are the least that fix a pose (derived).
MIN_VOTES = 3
# Doubt in a camera that was left out, when it is heard again (choice).
LEFT_OUT = 1e4
# A match farther off than this, by its camera's noise or by this much noise, pixels or the rig's, is no inlier, however
# bad its camera (choice).
INLIER_PX, INLIER_RIG = 1.0, 3.0


@dataclass(frozen=True, eq=False)
class Sights:
    """One camera's matches between landmarks and the current frame.

    Attributes:
        points: (n, 3) landmarks relative to g, world axes, at the pose that the motion starts from.
        depth_error: (n, 3) s r: the direction in which each is least known, one standard deviation long, away from the
            camera.
        image: (n, 2) normalised points in the current frame.
        feature: (n,) which feature of the current frame each is about. A feature may be matched with landmarks of several
            references: they then share its weight, and one that contradicts the pose takes all of them with it.
        trust: (n,) in (0, 1], multiplies the weights.
        rotation: (3, 3) Q of camera_from_world.
        center: (3,) the camera's centre relative to g.
        focal: pixels per normalised unit.
    """

    points: FloatArray
    depth_error: FloatArray
    image: FloatArray
    feature: IntArray
    trust: FloatArray
    rotation: FloatArray
    center: FloatArray
    focal: float

    @classmethod
    def none(cls) -> Sights:
        """Of a camera that sees nothing."""
        no = np.empty((0, 3))
        return cls(no, no, np.empty((0, 2)), np.empty(0, np.int64), np.empty(0), np.eye(3), np.zeros(3), 1.0)


@dataclass(frozen=True, eq=False)
class Aligned:
    """The motion X -> R (X - g) + g + d that aligns them.

    Attributes:
        rotation: (3, 3); shift: (3,).
        information: (6, 6) of (w, d).
        cost: robust, mean over the matches by trust, between 0 and 1; vote: the same at one noise (`VOTE_PX`), whatever was
            fitted: poses of the same sights are compared by it; votes: (C,) the same of each camera's matches.
        converged: whether the last step was negligible and three matches at least agree.
        iterations: of Gauss-Newton.
        sigma_px: (C,) each camera's noise.
        doubt: (C,) 1, or more for cameras that disagree with the others: what they say has so many times the variance that
            their matches give it.
        inliers: (C,) number of matches that agree.
        weights: per camera (n,), 0 for outliers. This and what follows is of the cameras that are here.
        residuals: per camera (n,) pixels, across the direction that unknown depth leaves open: the epipolar distance.
        surface: (C, 3) a.
    """

    rotation: FloatArray
    shift: FloatArray
    information: FloatArray
    cost: float
    vote: float
    votes: FloatArray
    converged: bool
    iterations: int
    sigma_px: FloatArray
    doubt: FloatArray
    inliers: IntArray
    weights: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    surface: FloatArray


def align(sights: Sequence[Sights], rotation: FloatArray, shift: FloatArray, first_px: float = FIRST_PX) -> Aligned:
    """Robust Gauss-Newton from one start.

    Args:
        rotation: (3, 3) and shift: (3,), the start.
        first_px: noise that the first round assumes; the start should be right within a few times that.

    Raises:
        ValueError: no cameras.
    """
    if not sights:
        raise ValueError("alignment needs the sights of one camera at least, got none")
    return _agreed(_Here(stack(sights)), rotation, shift, first_px)


class _Cameras(Protocol):
    """All cameras, here or elsewhere; matches: (C,) how many each has."""

    @property
    def matches(self) -> IntArray: ...

    def solve(
        self, schedule: Sequence[float], rotation: FloatArray, shift: FloatArray, doubt: FloatArray, left_out: int = -1
    ) -> Aligned:
        """Gauss-Newton from one start, with the noise (S,) that the first rounds assume, pixels, the doubt (C,) there is,
        and without a camera."""


def _agreed(cameras: _Cameras, rotation: FloatArray, shift: FloatArray, first_px: float) -> Aligned:
    """The pose of all cameras; should they disagree, the one that all but one agree on best."""
    schedule = [s for s in SCHEDULE_PX if s <= first_px] or list(SCHEDULE_PX[-1:])
    start = np.asarray(rotation, float), np.asarray(shift, float)
    no_doubt = np.ones(len(cameras.matches))
    joint = cameras.solve(schedule, *start, no_doubt)
    voters = np.flatnonzero(cameras.matches >= MIN_VOTES).tolist()
    if len(voters) < 3 or not _disagree(joint, cameras.matches, voters):
        return joint
    candidates = [joint]
    for c in voters:
        without = cameras.solve(schedule, *start, no_doubt, left_out=c)
        doubt = np.where(np.arange(len(no_doubt)) == c, LEFT_OUT, 1.0)
        candidates.append(cameras.solve(SCHEDULE_PX[-1:], without.rotation, without.shift, doubt))
    # One vote each, however many matches they have; the worst does not count.
    costs = [float(np.mean(np.sort(candidate.votes[voters])[:-1])) for candidate in candidates]
    costs[0] -= VOTE_MARGIN
    return candidates[int(np.argmin(costs))]


def _disagree(joint: Aligned, matches: IntArray, voters: Sequence[int]) -> bool:
    shares, noise = joint.inliers[voters] / matches[voters], joint.sigma_px[voters]
    return bool(
        joint.doubt.max() > DOUBTED or noise.max() > NOISY * np.median(noise) or shares.min() < FEWER * shares.max()
    )


@kernel
def _level(at: Round, c: int) -> float:
    """Noise that decides who is an inlier, pixels: that is a matter of the rig's as well."""
    return float(min(at.sigma_px[c], max(INLIER_PX, INLIER_RIG * at.rig_px[0])))


def _aligned(
    at: Round,
    rounds: int,
    settled: bool,
    cost: float,
    votes: FloatArray,
    trust: FloatArray,
    inliers: IntArray,
    stacked: Stacked,
    own: Own,
) -> Aligned:
    cuts = stacked.offsets[1:-1]
    return Aligned(
        at.rotation,
        at.shift,
        at.information,
        cost / max(float(trust.sum()), 1e-12),
        float(votes.sum()) / max(float(trust.sum()), 1e-12),
        votes / np.maximum(trust, 1e-12),
        settled and int(inliers.sum()) >= MIN_VOTES,
        rounds,
        at.sigma_px,
        at.doubt,
        inliers,
        tuple(np.split(own.weights, cuts)),
        tuple(np.split(own.across, cuts)),
        own.surface,
    )


# --- all cameras here -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Here:
    """All cameras in one process: the rounds are compiled from end to end."""

    stacked: Stacked

    @property
    def matches(self) -> IntArray:
        return np.diff(self.stacked.offsets)

    def solve(
        self, schedule: Sequence[float], rotation: FloatArray, shift: FloatArray, doubt: FloatArray, left_out: int = -1
    ) -> Aligned:
        """See `_Cameras`."""
        own, at = own_of(self.stacked), first_round(rotation, shift, doubt, schedule[0])
        inliers, votes = np.zeros(len(doubt), np.int64), np.empty(len(doubt))
        rounds, settled, cost = _rounds(self.stacked, np.array(schedule, float), left_out, at, own, inliers, votes)
        return _aligned(at, rounds, settled, cost, votes, _trusts(self.stacked), inliers, self.stacked, own)


@kernel
def _rounds(
    stacked: Stacked, schedule: FloatArray, left_out: int, at: Round, own: Own, inliers: IntArray, votes: FloatArray
) -> tuple[int, bool, float]:
    """Rounds until they settle, in place; inliers and votes: (C,), filled.

    Returns:
        their number; whether they settled; the sum of all costs.
    """
    n = len(inliers)
    reduced, mass, level = np.empty((n, 6, 7)), np.empty(n), np.empty(n)
    count, settled, last = 0, False, False
    for count in range(1, MAX_ROUNDS + 2):
        for c in range(n):
            mass[c] = camera_terms(stacked, c, at.rotation, at.shift, at.sigma_px[c], c != left_out, own, reduced[c])
            level[c] = noise_of(stacked, c, own) if measures_noise(count, len(schedule)) else np.nan
        stepped, negligible = joint_step(at, reduced, mass, level, schedule, count, last)
        if not stepped:
            break
        settled = negligible
        last = settled or count == MAX_ROUNDS
        for c in range(n):
            take_step(c, at.step, own)
    cost = 0.0
    for c in range(n):
        part, votes[c], inliers[c] = judge(stacked, c, at.rotation, at.shift, _level(at, c), c != left_out, own)
        cost += part
    return min(count, MAX_ROUNDS), settled, cost


# --- one camera among others ------------------------------------------------------------------------------------------


class OneOfMany:
    """One camera's side of `align`, with the others elsewhere: all that take part come to the same answer, to the bit.

    Args:
        sights: its own.
        index: its number among all.
        exchange: with the others.
    """

    def __init__(self, sights: Sights, index: int, exchange: Exchange) -> None:
        self._stacked, self._index, self._exchange = stack([sights]), index, exchange
        self._own = own_of(self._stacked)
        told = exchange(Has(len(sights.image), float(_trusts(self._stacked)[0])), Has(0, 0.0))
        self.matches = np.array([t.matches for t in told], np.int64)
        self._trust = np.array([t.trust for t in told])

    def align(self, rotation: FloatArray, shift: FloatArray, first_px: float = FIRST_PX) -> Aligned:
        """See `align`; the weights, residuals and surface are this camera's alone."""
        return _agreed(self, rotation, shift, first_px)

    def solve(
        self, schedule: Sequence[float], rotation: FloatArray, shift: FloatArray, doubt: FloatArray, left_out: int = -1
    ) -> Aligned:
        """See `_Cameras`."""
        stacked, me, heard = self._stacked, self._index, self._index != left_out
        own = self._own = own_of(stacked)
        at, noise = first_round(rotation, shift, doubt, schedule[0]), np.array(schedule, float)
        count, settled, last = 0, False, False
        for count in range(1, MAX_ROUNDS + 2):
            reduced, pose = np.empty((6, 7)), (at.rotation, at.shift)
            mass = camera_terms(stacked, 0, *pose, float(at.sigma_px[me]), heard, own, reduced)
            level = noise_of(stacked, 0, own) if measures_noise(count, len(noise)) else np.nan
            told = self._exchange(Says.of(reduced, mass, level), Says(np.zeros(27), 0.0, np.nan))
            all_said = np.array([t.reduced for t in told])
            masses, levels = np.array([t.mass for t in told]), np.array([t.level_px for t in told])
            stepped, negligible = joint_step(at, all_said, masses, levels, noise, count, last)
            if not stepped:
                break
            settled = negligible
            last = settled or count == MAX_ROUNDS
            take_step(0, at.step, own)
        cost, vote, inliers = judge(stacked, 0, at.rotation, at.shift, _level(at, me), heard, own)
        judged = self._exchange(Judges(cost, vote, int(inliers)), Judges(0.0, 0.0, 0))
        agree = np.array([t.inliers for t in judged], np.int64)
        costs, votes = sum((t.cost for t in judged), 0.0), np.array([t.vote for t in judged])
        rounds = min(count, MAX_ROUNDS)
        return _aligned(at, rounds, settled, costs, votes, self._trust, agree, stacked, own)


# --- arrays -----------------------------------------------------------------------------------------------------------


def stack(sights: Sequence[Sights]) -> Stacked:
    """All cameras' matches after each other."""
    points, error, image, trust = (
        np.ascontiguousarray(np.concatenate(part), float)
        for part in zip(*((s.points, s.depth_error, s.image, s.trust) for s in sights), strict=True)
    )
    return Stacked(
        points=points,
        depth_error=error,
        image=image,
        trust=trust,
        feature=np.concatenate([s.feature for s in sights]).astype(np.int64),
        basis=np.concatenate([_basis(s.image) for s in sights]),
        offsets=np.cumsum([0, *(len(s.image) for s in sights)], dtype=np.int64),
        rotation=np.array([s.rotation for s in sights], float),
        center=np.array([s.center for s in sights], float),
        focal=np.array([s.focal for s in sights], float),
    )


def _trusts(stacked: Stacked) -> FloatArray:
    """(C,) the sums of the cameras' trust."""
    return np.array([part.sum() for part in np.split(stacked.trust, stacked.offsets[1:-1])])


def _basis(image: FloatArray) -> FloatArray:
    """(n, 3): 1, u, v, the place in the image in units of its spread."""
    if len(image) == 0:
        return np.empty((0, 3))
    spread = max(float(np.linalg.norm(image.std(axis=0))), 1e-12)
    return np.column_stack([np.ones(len(image)), (image - np.median(image, axis=0)) / spread])
