"""One camera's side of the alignment, with the others elsewhere: all that take part come to the same answer, to the bit.

Exact: the rounds of `alignment`, whatever has to be solved side by side, one message for all of it.

Economical, the paper's order, "iterative refinement of the independent solution obtained for each camera": each camera first
runs the schedule of noise levels alone, the start being a weak prior, without which a camera that sees little could end
anywhere. It tells what its matches say around its own solution, an information and a gradient as in any round, moved to the
common start: the prior is not told, and who sees little says little. All of this together is the first joint step, in which
cameras that went astray are doubted as in any other; a few more rounds follow from where it leads, at the noise that each
has by then. No camera is left out in turn. What has not settled after a few rounds goes on; where nothing comes of it, or
most cameras lose most of what agreed with their own solutions, the exact rounds follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import Aligned, Job, Sights, Start, agreed, aligned, first_job, judged, stack
from sylpose.landmarks.camera_terms import Own, camera_terms, noise_of, own_of, take_step
from sylpose.landmarks.joint_step import (
    MAX_ROUNDS,
    SETTLED,
    SETTLING_ROUNDS,
    Round,
    first_round,
    joint_step,
    measures_noise,
)
from sylpose.landmarks.messages import Exchange, Judges, Says

__all__ = ["OneOfMany"]

# How far the start may be off, for a camera alone: radians, and a share of its landmarks' distance from the object's
# centre (choice).
PRIOR_TURN, PRIOR_SHIFT = 0.3, 0.3
# Rounds in the compact mode, the first one included: a step of a quarter of its own standard deviation is good enough
# then, and only what is farther off goes on (choice).
FEW_ROUNDS, NEAR = 5, 0.25**2
# From this round on noise and doubt are held: for `joint_step` it is so many rounds later (choice).
HELD_FROM, HELD = 4, SETTLING_ROUNDS
# Poses less than this apart after the first round are the same one, in standard deviations, squared (choice).
SAME = 1.0
# A camera loses too much where less than this share of its matches' weights is left of what its own solution had (choice).
LEFT = 0.5


@dataclass(eq=False)
class _Run:
    """A job in progress: where all cameras stand, and what this one keeps to itself."""

    at: Round
    own: Own
    schedule: FloatArray
    heard: bool = True
    count: int = 0
    settled: bool = False
    last: bool = False
    over: bool = False
    mass: FloatArray = field(default_factory=lambda: np.zeros(0))


class OneOfMany:
    """One camera among others (`alignment._Cameras`).

    Args:
        sights: its own.
        index: its number, among so many.
        exchange: with the others.
        compact: see above.
    """

    def __init__(self, sights: Sights, index: int, count: int, exchange: Exchange, *, compact: bool = False) -> None:
        self._stacked, self._index, self.count, self._exchange = stack([sights]), index, count, exchange
        self._compact = compact

    def align(self, starts: Sequence[Start]) -> list[Aligned]:
        """See `alignment.agreed`; the weights, residuals and surface are this camera's alone."""
        return self._refined(starts) if self._compact else agreed(self, starts)

    def solve(self, jobs: Sequence[Job]) -> list[Aligned]:
        """See `alignment._Cameras`."""
        runs = [
            _Run(
                first_round(job.rotation, job.shift, job.doubt, job.schedule[0]),
                own_of(self._stacked),
                np.array(job.schedule, float),
                heard=self._index != job.left_out,
            )
            for job in jobs
        ]
        while live := [run for run in runs if not run.over]:
            self._step(live, [self._says(run) for run in live])
        return self._aligned(runs, self._judged(runs))

    def _says(self, run: _Run) -> Says:
        """What this camera says of where a run has come to."""
        run.count += 1
        at, reduced, sigma_px = run.at, np.empty((6, 7)), float(run.at.sigma_px[self._index])
        mass = camera_terms(self._stacked, 0, at.rotation, at.shift, sigma_px, run.heard, run.own, reduced)
        noise = measures_noise(run.count, len(run.schedule))
        return Says.of(reduced, mass, noise_of(self._stacked, 0, run.own) if noise else np.nan)

    def _step(self, runs: Sequence[_Run], said: Sequence[Says]) -> None:
        """One round of some runs."""
        said = [one.coarse() for one in said] if self._compact else said
        told = self._exchange(tuple(said), (Says(np.zeros(27), 0.0, np.nan),) * len(said))
        for run, by_camera in zip(runs, zip(*told, strict=True), strict=True):
            reduced = np.array([t.reduced for t in by_camera])
            mass, level = np.array([t.mass for t in by_camera]), np.array([t.level_px for t in by_camera])
            stepped, negligible = joint_step(run.at, reduced, mass, level, run.schedule, run.count, run.last)
            run.over, run.mass = not stepped, mass
            if stepped:
                run.settled = negligible
                run.last = negligible or run.count == MAX_ROUNDS
                take_step(0, run.at.step, run.own)

    def _judged(self, runs: Sequence[_Run]) -> list[tuple[Judges, ...]]:
        """Of each run, what all cameras say of the pose that was found."""
        if not runs:
            return []
        mine = tuple(judged(self._stacked, 0, run.at, run.own, self._index, run.heard) for run in runs)
        return list(zip(*self._exchange(mine, (Judges(0.0, 0.0, 0, 0, 0.0),) * len(mine)), strict=True))

    def _aligned(self, runs: Sequence[_Run], told: Sequence[Sequence[Judges]]) -> list[Aligned]:
        return [
            aligned(run.at, min(run.count, MAX_ROUNDS), run.settled, judges, self._stacked, run.own)
            for run, judges in zip(runs, told, strict=True)
        ]

    # --- compact ---------------------------------------------------------------------------------------------------

    def _refined(self, starts: Sequence[Start]) -> list[Aligned]:
        """From each start, this camera's own solution, and then everybody's in a few rounds."""
        if not starts:
            return []
        jobs = [first_job(start, self.count) for start in starts]
        every, said = zip(*(self._alone(job) for job in jobs), strict=True)
        self._step(every, said)
        alone = [run.mass for run in every]
        # Which way led there does not matter where several lead to the same.
        runs: list[_Run] = []
        same = []
        for run in every:
            k = next((k for k, other in enumerate(runs) if _are_the_same(run.at, other.at)), len(runs))
            runs += [run] if k == len(runs) else []
            same.append(k)
        for count in range(2, MAX_ROUNDS + 1):
            if not (live := [run for run in runs if not run.over]):
                break
            for run in live:
                run.count += HELD if count == HELD_FROM else 0
            self._step(live, [self._says(run) for run in live])
            for run in live:
                size = float(run.at.step @ run.at.information @ run.at.step)
                run.settled = not run.over and (run.settled or size < (SETTLED if count < FEW_ROUNDS else NEAR))
                run.over |= run.settled
        found = self._aligned(runs, self._judged(runs))
        first = [same.index(k) for k in range(len(runs))]
        poor = [k for k, i in enumerate(first) if not found[k].converged or _lost(alone[i], runs[k].mass)]
        for k, again in zip(poor, self.solve([jobs[first[k]] for k in poor]), strict=True):
            found[k] = again
        return [found[k] for k in same]

    def _alone(self, job: Job) -> tuple[_Run, Says]:
        """The run from here on, with this camera's own solution in it, and what it says of where all started."""
        stacked, schedule = self._stacked, np.array(job.schedule, float)
        own, at = own_of(stacked), first_round(job.rotation, job.shift, np.ones(1), job.schedule[0])
        reduced, with_prior, off, mass, count, last = (
            np.empty((1, 6, 7)),
            np.empty((1, 6, 7)),
            np.zeros(6),
            0.0,
            0,
            False,
        )
        prior = _prior(stacked.points)
        for count in range(1, MAX_ROUNDS + 2):
            pose, sigma_px = (at.rotation, at.shift), float(at.sigma_px[0])
            mass = camera_terms(stacked, 0, *pose, sigma_px, True, own, reduced[0])
            off = _off(at.rotation, at.shift, job.rotation, job.shift)
            with_prior[0] = reduced[0] + np.column_stack([np.diag(prior), prior * off])
            level = np.array([noise_of(stacked, 0, own)])
            stepped, settled = joint_step(at, with_prior, np.array([mass]), level, schedule, count, last)
            if not stepped:
                break
            last = settled or count == MAX_ROUNDS
            take_step(0, at.step, own)
        reduced[0, :, 6] -= reduced[0, :, :6] @ off
        run = _Run(first_round(job.rotation, job.shift, job.doubt, job.schedule[-1]), own, schedule[-1:], count=1)
        # Its surface is where its own solution has it: steps are taken from there.
        for k in range(3):
            own.gains[0, k, 6] -= own.gains[0, k, :6] @ off
        return run, Says.of(reduced[0], mass, noise_of(stacked, 0, own))


def _prior(points: FloatArray) -> FloatArray:
    """(6,) information of (w, d) of the start, for a camera with these landmarks (n, 3)."""
    size = float(np.sqrt(np.mean(np.sum(points**2, axis=1)))) if len(points) else 1.0
    return np.repeat([PRIOR_TURN, PRIOR_SHIFT * max(size, 1e-12)], 3) ** -2.0


def _off(rotation: FloatArray, shift: FloatArray, from_rotation: FloatArray, from_shift: FloatArray) -> FloatArray:
    """(6,) (w, d) from one pose to another."""
    return np.concatenate([Rotation.from_matrix(rotation @ from_rotation.T).as_rotvec(), shift - from_shift])


def _lost(alone: FloatArray, together: FloatArray) -> bool:
    """Whether of most cameras' matches most fell away, by the sums (C,) of their weights."""
    voices = alone > 0.0
    return bool(voices.any() and np.median(together[voices] / alone[voices]) < LEFT)


def _are_the_same(one: Round, other: Round) -> bool:
    off = _off(one.rotation, one.shift, other.rotation, other.shift)
    return float(off @ other.information @ off) < SAME
