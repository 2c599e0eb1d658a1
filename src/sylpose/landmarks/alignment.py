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
which needs a few numbers from each: `align` runs both in one process, `landmarks.distributed_alignment` one camera
among others that
are elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel
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
from sylpose.landmarks.messages import Judges

__all__ = [
    "FIRST_PX",
    "Aligned",
    "Job",
    "Sights",
    "Start",
    "agreed",
    "align",
    "aligned",
    "first_job",
    "judged",
    "stack",
]

# A rotation (3, 3), a shift (3,), and the noise that the first round assumes, pixels: the pose should be right within a few
# times that.
Start = tuple[FloatArray, FloatArray, float]

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
        matches: (C,) number of matches.
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
    matches: IntArray
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
    return agreed(_Here(stack(sights)), [(np.asarray(rotation, float), np.asarray(shift, float), first_px)])[0]


class Job(NamedTuple):
    """What is to be solved: Gauss-Newton from one start.

    Attributes:
        schedule: noise that the first rounds assume, pixels.
        rotation, shift: the start.
        doubt: (C,) the doubt there is.
        left_out: a camera that has no say; -1: all have.
    """

    schedule: Sequence[float]
    rotation: FloatArray
    shift: FloatArray
    doubt: FloatArray
    left_out: int = -1


class _Cameras(Protocol):
    """All cameras, here or elsewhere; so many."""

    @property
    def count(self) -> int: ...

    def solve(self, jobs: Sequence[Job]) -> list[Aligned]:
        """All of them, which have nothing to do with each other: cameras elsewhere work at them side by side."""


def first_job(start: Start, cameras: int) -> Job:
    """From one start, without a doubt in any camera."""
    rotation, shift, first_px = start
    return Job([s for s in SCHEDULE_PX if s <= first_px] or SCHEDULE_PX[-1:], rotation, shift, np.ones(cameras))


def agreed(cameras: _Cameras, starts: Sequence[Start]) -> list[Aligned]:
    """From each start the pose of all cameras; should they disagree, the one that all but one agree on best."""
    jobs = [first_job(start, cameras.count) for start in starts]
    out = cameras.solve(jobs)
    if not out:
        return []
    voters = np.flatnonzero(out[0].matches >= MIN_VOTES).tolist()
    odd = [k for k, joint in enumerate(out) if len(voters) > 2 and _disagree(joint, voters)]
    without = iter(cameras.solve([jobs[k]._replace(left_out=c) for k in odd for c in voters]))
    again = []
    for _ in odd:
        for c in voters:
            found, doubt = next(without), np.where(np.arange(cameras.count) == c, LEFT_OUT, 1.0)
            again.append(Job(SCHEDULE_PX[-1:], found.rotation, found.shift, doubt))
    heard_again = iter(cameras.solve(again))
    for k in odd:
        candidates = [out[k], *(next(heard_again) for _ in voters)]
        # One vote each, however many matches they have; the worst does not count.
        costs = [float(np.mean(np.sort(candidate.votes[voters])[:-1])) for candidate in candidates]
        costs[0] -= VOTE_MARGIN
        out[k] = candidates[int(np.argmin(costs))]
    return out


def _disagree(joint: Aligned, voters: Sequence[int]) -> bool:
    shares, noise = joint.inliers[voters] / joint.matches[voters], joint.sigma_px[voters]
    return bool(
        joint.doubt.max() > DOUBTED or noise.max() > NOISY * np.median(noise) or shares.min() < FEWER * shares.max()
    )


def _level(at: Round, c: int) -> float:
    """Noise that decides who is an inlier, pixels: that is a matter of the rig's as well."""
    return float(min(at.sigma_px[c], max(INLIER_PX, INLIER_RIG * at.rig_px[0])))


def aligned(at: Round, rounds: int, settled: bool, told: Sequence[Judges], stacked: Stacked, own: Own) -> Aligned:
    """What all cameras made of a pose: what each says of it, and what those have that are here."""
    cuts = stacked.offsets[1:-1]
    votes, trust = np.array([t.vote for t in told]), np.array([t.trust for t in told])
    inliers, total = np.array([t.inliers for t in told], np.int64), max(float(trust.sum()), 1e-12)
    return Aligned(
        at.rotation,
        at.shift,
        at.information,
        sum((t.cost for t in told), 0.0) / total,
        float(votes.sum()) / total,
        votes / np.maximum(trust, 1e-12),
        settled and int(inliers.sum()) >= MIN_VOTES,
        rounds,
        np.array([t.matches for t in told], np.int64),
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
    def count(self) -> int:
        return len(self.stacked.focal)

    def solve(self, jobs: Sequence[Job]) -> list[Aligned]:
        """See `_Cameras`."""
        return [self._solved(job) for job in jobs]

    def _solved(self, job: Job) -> Aligned:
        own, at = own_of(self.stacked), first_round(job.rotation, job.shift, job.doubt, job.schedule[0])
        rounds, settled = _rounds(self.stacked, np.array(job.schedule, float), job.left_out, at, own)
        told = [judged(self.stacked, c, at, own, c, c != job.left_out) for c in range(self.count)]
        return aligned(at, rounds, settled, told, self.stacked, own)


@kernel
def _rounds(stacked: Stacked, schedule: FloatArray, left_out: int, at: Round, own: Own) -> tuple[int, bool]:
    """Rounds until they settle, in place.

    Returns:
        their number; whether they settled.
    """
    n = len(at.doubt)
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
    return min(count, MAX_ROUNDS), settled


def judged(stacked: Stacked, c: int, at: Round, own: Own, number: int, heard: bool) -> Judges:
    """What one camera says of the pose that was found.

    Args:
        c: which of those here; number: of all.
        heard: whether it had a say.
    """
    cost, vote, inliers = judge(stacked, c, at.rotation, at.shift, _level(at, number), heard, own)
    matches = slice(stacked.offsets[c], stacked.offsets[c + 1])
    return Judges(cost, vote, int(inliers), matches.stop - matches.start, float(stacked.trust[matches].sum()))


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


def _basis(image: FloatArray) -> FloatArray:
    """(n, 3): 1, u, v, the place in the image in units of its spread."""
    if len(image) == 0:
        return np.empty((0, 3))
    spread = max(float(np.linalg.norm(image.std(axis=0))), 1e-12)
    return np.column_stack([np.ones(len(image)), (image - np.median(image, axis=0)) / spread])
