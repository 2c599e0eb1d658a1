"""How one frame's pose is found from its matches with earlier frames: the methods of the tracker."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.rigid import rotvec
from sylpose.landmarks.alignment import FIRST_PX, Sights
from sylpose.landmarks.hypothesis_selection import chosen, doubted
from sylpose.relative_pose.fit import MIN_MATCHES, Fit, no_fit
from sylpose.relative_pose.observability import more_than_chance
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.sylvester_methods import ESTIMATORS, UNBIASED, paper_fit
from sylpose.relative_pose.terms import TermData
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.sylvester.known_depth import solve_2d3d
from sylpose.tracking.camera_executor import Crew
from sylpose.tracking.frame import CameraFrame, Pair, SolvedFrame, base_from_reference
from sylpose.tracking.observations import (
    STILL_TRUST,
    ages_of,
    chance_of,
    cut,
    sights_of,
    smear,
    support_of,
    usual_age,
    with_trust,
)
from sylpose.tracking.reports import Ages, Chance, Known, total_ages

__all__ = ["SOLVERS", "Agreement", "Problem", "Solution", "dealt", "gathered"]

Hypothesis = tuple[FloatArray, FloatArray]
# Of one camera, (weights, residuals in pixels) of each of its pairs.
Agreement = list[tuple[FloatArray, FloatArray]]

# Above this mean robust cost most landmarks contradict the pose that was started from: other starts are tried (choice).
POOR_COST = 0.6
# Noises that another start is given, pixels: it was fitted to the same matches, and a forgiving one may slide back (choice).
OTHER_START_PX = (4.0, 1.0)
# The forgiving first rounds may slide into another minimum, from the true pose, too: 32 degrees off after a jump, where most
# depths are guesses (measured: benchmarks/kinds.py, jumps-25), or in one camera that sees a board from its side (stands-fast
# 31). So less forgiving ones are tried as well, with these noises, pixels: the last one where depths are known, all of them
# after a turn by more than this since the last solved frame, radians (choice).
JUMP, NARROW_PX = np.radians(8.0), (8.0, 2.0)
# So large a share of inliers is not had by chance (choice).
CERTAIN_SHARE = 0.8
# So many sights of a feature leave its depth a guess, and so does any number of them that show the object at rest: known no
# better than to this share of the object's radius (choice).
YOUNG, GUESSED = 3, 0.1
# A depth is known where it moves the landmark's image by less than this, pixels; the 2D-3D equation wants so
# many (choice).
KNOWN_PX, KNOWN = 1.0, 30
# What moves is not merely noise where it is this share of all landmarks (choice).
MOVING_SHARE = 0.06
# Depths and motion are found in turns so often at most, until the rotation changes by less (choice).
POSIT_ROUNDS, POSIT_SETTLED = 20, 1e-6


@dataclass(frozen=True, eq=False)
class Problem:
    """What is known before a frame is solved.

    Attributes:
        rig: the cameras as they stand for this frame.
        base: the last solved frame: the motion sought starts from it.
        known: all solved frames that matches may refer to, by number.
        radius: of the object.
        guess: (R, d) from the base: X -> R (X - g) + g + d about the object's centre g in the base frame.
        seed: of the outlier rejection.
        frames, pairs: by camera, each its own: what it sees, and its matches.
    """

    rig: Rig
    base: SolvedFrame
    known: Mapping[int, SolvedFrame]
    radius: float
    guess: Hypothesis
    seed: int
    frames: Sequence[CameraFrame]
    pairs: Sequence[Sequence[Pair]]

    @property
    def center(self) -> FloatArray:
        """(3,) g."""
        return np.asarray(self.base.world_from_object.translation)

    def rng(self) -> np.random.Generator:
        """The same for the same frame, whatever came before."""
        return np.random.default_rng(self.seed)


@dataclass(frozen=True, eq=False)
class Solution:
    """A frame's motion since the base.

    Attributes:
        status: see `Status`.
        rotation: (3, 3) R and shift: (3,) d; meaningless without `status.has_pose`.
        information: (6, 6) of (w, d).
        iterations: of the solver.
        agreement: by camera, each its own.
        doubt: (C,) 1, or more for cameras that disagree with the others, see `Aligned`.
        faults: a sentence for each camera that is recognised to be at fault.
        biased: by the object's surface, so that the error goes on as the turn does.
    """

    status: Status
    rotation: FloatArray
    shift: FloatArray
    information: FloatArray
    iterations: int
    agreement: Sequence[Agreement]
    doubt: FloatArray
    faults: tuple[str, ...] = ()
    biased: bool = False


Solver = Callable[[Crew, Problem], Solution]


def gathered(of_cameras: Sequence[Sequence[TermData]]) -> list[TermData]:
    """All cameras' terms, for estimators that want them at one place."""
    return [term for terms in of_cameras for term in terms]


def dealt(fit: Fit, of_cameras: Sequence[Sequence[TermData]]) -> list[Agreement]:
    """By camera what a fit to `gathered` terms says of them."""
    parts = iter(zip(fit.weights, fit.residuals, strict=True))
    return [[next(parts) for _ in terms] for terms in of_cameras]


def _terms(crew: Crew, problem: Problem, *, near: bool = False) -> list[list[TermData]]:
    """By camera the terms of its pairs; `near`: of those with the base alone."""

    def of(c: int) -> list[TermData]:
        camera, base, known = problem.rig.cameras[c], problem.base, problem.known
        pairs = [pair for pair in problem.pairs[c] if not near or pair.reference == base.number]
        return [pair.term(c, camera, base_from_reference(pair, base, known)) for pair in pairs]

    return crew.ask(of, [])


def _solution(problem: Problem, fit: Fit, agreement: Sequence[Agreement]) -> Solution:
    no_doubt = np.ones(len(problem.rig))
    return Solution(
        fit.status, fit.rotation, fit.shift, fit.information, fit.iterations, agreement, no_doubt, fit.faults
    )


def _nothing(crew: Crew, problem: Problem, status: Status) -> Solution:
    """Of a status without a pose."""

    def of(c: int) -> Agreement:
        return [(np.zeros(len(pair)), np.zeros(len(pair))) for pair in problem.pairs[c]]

    return _solution(problem, no_fit([], status), crew.each(of))


def solve_epipolar(crew: Crew, problem: Problem) -> Solution:
    """Epipolar geometry against all references at once; what is known of the features' depth is not used."""
    terms = _terms(crew, problem)
    fit = fit_terms(gathered(terms), problem.center, problem.radius, [problem.guess], problem.rng())
    return _solution(problem, fit, dealt(fit, terms))


def solve_paper(method: str, crew: Crew, problem: Problem) -> Solution:
    """One of the paper's estimators, against the last solved frame alone; the other references are left out."""
    terms = _terms(crew, problem, near=True)
    data = gathered(terms)
    fit = fit_terms(data, problem.center, problem.radius, [problem.guess], problem.rng())
    if fit.status is Status.OK:
        fit = paper_fit(method, data, fit, problem.center, problem.rig.names)
    near = dealt(fit, terms)

    def of(c: int) -> Agreement:
        mine = iter(near[c])
        nothing = [(np.zeros(len(pair)), np.zeros(len(pair))) for pair in problem.pairs[c]]
        base = problem.base.number
        return [
            next(mine) if pair.reference == base else no for pair, no in zip(problem.pairs[c], nothing, strict=True)
        ]

    return replace(_solution(problem, fit, crew.each(of)), biased=method not in UNBIASED)


def solve_landmarks(crew: Crew, problem: Problem) -> Solution:
    """Alignment with the landmarks of all references; from other starts where the guess is contradicted."""
    return _aligned(crew, problem)[0]


def _aligned(crew: Crew, problem: Problem) -> tuple[Solution, list[Sights], FloatArray]:
    """`solve_landmarks`; by camera, each its own, the sights that it used; (6,) (w, d) by what it may be off (`chosen`)."""
    frames, pairs, cameras = problem.frames, problem.pairs, problem.rig.cameras
    seen = crew.each(lambda c: sights_of(cameras[c], pairs[c], frames[c], problem.base))
    ages = crew.ask(lambda c: ages_of(*seen[c], pairs[c]), Ages.of(np.empty(0)))
    all_ages = total_ages(ages)
    # Where all that is old has vanished at once, something else is seen: what was usual in the last frame counts, too.
    usual = max(usual_age(all_ages), problem.base.age)
    # A landmark that stands still and was never seen to move gets next to no trust once others do: a background that is not
    # known as such yet agrees with itself as well as the object does, and is often larger.
    others_move = _others_move(ages)
    of_still = STILL_TRUST if others_move else 1.0
    sights = crew.each(lambda c: with_trust(*seen[c], usual, of_still))
    if len(all_ages) < MIN_MATCHES:
        return _nothing(crew, problem, Status.TOO_FEW_MATCHES), sights, np.zeros(6)
    guessed = max(a.oldest for a in ages) <= YOUNG or _depth_sd(ages) > GUESSED * problem.radius
    # Where depths are guesses, so is what explains them, and the prediction.
    first = (FIRST_PX,) if guessed else (FIRST_PX, NARROW_PX[-1])
    ways = crew.align(sights, [(*problem.guess, px) for px in first])
    best, off = chosen([way for way, _ in ways], *problem.guess)
    pose, found = ways[best]
    # While all depths are guesses, a turn the other way with the depths reversed explains nearly as much (the mirrored
    # solution of few cameras and small turns); epipolar geometry is asked for its opinion.
    jumps = max(_angle(problem.guess[0]), _angle(pose.rotation)) > JUMP
    if guessed or pose.cost > POOR_COST or jumps:
        data = gathered(_terms(crew, problem))
        other = fit_terms(data, problem.center, problem.radius, [problem.guess], problem.rng())
        starts = [(other.rotation, other.shift, px) for px in OTHER_START_PX if other.status is Status.OK]
        starts += [(*problem.guess, px) for px in NARROW_PX if px not in first] if jumps else []
        tried = crew.align(sights, starts) + (ways[1:] if jumps else [])
        # By epipolar distances alone: what is guessed of depths has no say in whether it is right.
        support, *others = _support(crew, sights, [found, *(found_again for _, found_again in tried)])
        for (again, found_again), more in zip(tried, others, strict=True):
            if more > support:
                pose, found, support, off = again, found_again, more, np.zeros(6)
    chances = crew.ask(
        lambda c: chance_of(sights[c], *found[c], pose.rotation, pose.shift, frames[c]), Chance(0, 0, 0, 0.0, 0)
    )
    status = Status.OK if pose.converged else Status.NOT_CONVERGED
    if sum(chance.matches for chance in chances) < MIN_MATCHES or (status.has_pose and _by_chance(chances)):
        return _nothing(crew, problem, Status.NOT_CONSISTENT), sights, off
    agreement = crew.each(lambda c: cut(*found[c], pairs[c]))
    information = doubted(pose.information, off)
    solution = Solution(status, pose.rotation, pose.shift, information, pose.iterations, agreement, pose.doubt)
    return solution, sights, off


def _support(
    crew: Crew, sights: Sequence[Sights], found: Sequence[Sequence[tuple[FloatArray, FloatArray]]]
) -> list[float]:
    """`support_of` all cameras, of several alignments."""
    told = crew.ask(lambda c: tuple(support_of(sights[c], *of[c]) for of in found), (0.0,) * len(found))
    return [sum(of_one) for of_one in zip(*told, strict=True)]


def _depth_sd(ages: Sequence[Ages]) -> float:
    """How well the depth of landmarks is known, standard deviation, in the camera in the middle."""
    known = [a.depth_sd for a in ages if np.isfinite(a.depth_sd)]
    return float(np.median(known)) if known else np.inf


def _angle(rotation: FloatArray) -> float:
    """Radians that a rotation (3, 3) turns by."""
    return float(np.linalg.norm(rotvec(rotation)))


def _others_move(ages: Sequence[Ages]) -> bool:
    """Whether enough landmarks move, or did, for the others to be background: in two cameras, if there are two, since
    something may pass by in front of one."""
    total = [float(a.counts.sum()) for a in ages]
    seeing = [a.moving for a, n in zip(ages, total, strict=True) if n >= MIN_MATCHES]
    cameras = sum(2 * moving >= MIN_MATCHES for moving in seeing)
    return sum(seeing) >= max(MIN_MATCHES, MOVING_SHARE * sum(total)) and cameras >= min(2, len(seeing))


def _by_chance(chances: Sequence[Chance]) -> bool:
    """Whether random matches would agree with a pose about as often; its unknowns are six, and those of each camera's
    surface."""
    inliers, tried = sum(chance.inliers for chance in chances), sum(chance.tried for chance in chances)
    unknowns, by_chance = 6 + sum(chance.unknowns for chance in chances), sum(chance.by_chance for chance in chances)
    return inliers < CERTAIN_SHARE * tried and not more_than_chance(inliers, by_chance, unknowns)


def solve_known_depth(crew: Crew, problem: Problem) -> Solution:
    """Sylvester's equation for points known in 3D (2D-3D), of the landmarks that `solve_landmarks` finds to agree and whose
    depth is known by now; where these are too few or leave a mirrored answer, that of `solve_landmarks` stands.

    The equation is of orthographic views: each image point is scaled by its landmark's depth, as the motion so far has it,
    and the two are found in turns (POSIT: D. DeMenthon, L. Davis, 1995).
    """
    solution, sights, off = _aligned(crew, problem)
    if solution.status is not Status.OK:
        return solution

    def known(c: int) -> Known:
        weights = np.concatenate([np.empty(0), *(w for w, _ in solution.agreement[c])])
        moves = sights[c].focal * smear(sights[c], solution.rotation, solution.shift)
        return Known(sights[c], np.where(moves < KNOWN_PX, weights, 0.0))

    records = crew.ask(known, Known.none())
    cameras, weights = [record.sights for record in records], [record.weights for record in records]
    if sum(int((w > 0).sum()) for w in weights) < KNOWN:
        return solution
    rotations, centers = np.array([s.rotation for s in cameras]), np.array([s.center for s in cameras])
    points = [s.points for s in cameras]
    R, shift = problem.guess
    rounds = 0
    for _ in range(POSIT_ROUNDS):
        images = [s.image * ((s.points @ R.T + shift - s.center) @ s.rotation[2])[:, None] for s in cameras]
        s = solve_2d3d(rotations, points, images, centers=centers, weights=weights)
        rounds += s.iterations
        if s.status is not Status.OK:
            return solution
        change = np.abs(s.rotation - R).max()
        R, shift = s.rotation, s.translation
        if change < POSIT_SETTLED:
            break
    # From the displacement of the points' mean to that of the object's centre, here the origin.
    about = np.eye(6)
    about[3:, :3] = -np.cross(np.eye(3), R @ s.center)
    information = doubted(about.T @ block_diag(s.information, s.displacement_information) @ about, off)
    return replace(solution, rotation=R, shift=shift, information=information, iterations=solution.iterations + rounds)


SOLVERS: dict[str, Solver] = {
    "landmarks": solve_landmarks,
    "epipolar": solve_epipolar,
    **{method: partial(solve_paper, method) for method in ESTIMATORS},
    "known-depth": solve_known_depth,
}
