"""Pose solvers: estimate one frame's pose from its matches with earlier frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.rigid import rotvec
from sylpose.landmarks.alignment import FIRST_PX, LandmarkMatches
from sylpose.landmarks.hypothesis_selection import select_hypothesis, subtract_uncertainty
from sylpose.relative_pose.observability import is_more_than_chance
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.sylvester_methods import ESTIMATORS, UNBIASED_METHODS, apply_paper_method
from sylpose.relative_pose.terms import MIN_MATCHES, Fit, TermData, make_failed_fit
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.sylvester.known_depth import solve_2d3d
from sylpose.tracking.camera_executor import CameraExecutor
from sylpose.tracking.frame import CameraFrame, FrameMatches, SolvedFrame, compute_reference_motion
from sylpose.tracking.observations import (
    STATIC_WEIGHT,
    build_observations,
    compute_depth_smear,
    compute_full_weight_age,
    compute_inlier_statistics,
    compute_support,
    split_by_pair,
    summarize_ages,
    weight_observations,
)
from sylpose.tracking.reports import CameraTerms, InlierStatistics, KnownDepthMatches, LandmarkAges, expand_ages

__all__ = ["SOLVERS", "MatchWeights", "PoseProblem", "PoseSolution", "gather_terms", "scatter_fit"]

Hypothesis = tuple[FloatArray, FloatArray]
# For one camera: (weights, residuals in pixels) of each of its pairs.
MatchWeights = list[tuple[FloatArray, FloatArray]]

# Above this mean robust cost most landmarks contradict the pose from this start, and other starts are tried (choice).
MAX_GOOD_COST = 0.6
# Initial noise levels for alternative starts, pixels. Such a start was fitted to the same matches, and a tolerant
# solver may slide back (choice).
ALTERNATIVE_START_PX = (4.0, 1.0)
# The first rounds, at large assumed noise, may converge to another minimum even from the true pose: 32 degrees off
# after a jump, where most depths are guesses (measured: benchmarks/kinds.py, jumps-25), or in one camera that views a
# board edge-on (stands-fast 31). So smaller initial noise levels are tried too, pixels: the last one where depths are
# known, all of them after a rotation larger than this since the last solved frame, radians (choice).
LARGE_ROTATION, NARROW_START_PX = np.radians(8.0), (8.0, 2.0)
# An inlier share this large does not occur by chance (choice).
MIN_CERTAIN_INLIER_RATIO = 0.8
# A landmark's depth counts as a guess after so many observations or fewer, or while it is not known better than this
# share of the object's radius: observations of an object at rest add nothing (choice).
MAX_YOUNG_AGE, GUESSED_DEPTH_RATIO = 3, 0.1
# A depth is known if its standard deviation moves the landmark's image by less than this, pixels. The 2D-3D equation
# needs so many such landmarks (choice).
MAX_DEPTH_SMEAR_PX, MIN_KNOWN_LANDMARKS = 1.0, 30
# Motion is more than noise if this share of all landmarks moves (choice).
MIN_MOVING_RATIO = 0.06
# Maximum number of alternations between depths and motion; they end when the rotation changes by less (choice).
POSIT_ROUNDS, POSIT_TOLERANCE = 20, 1e-6


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """Input of a pose solver.

    Attributes:
        rig: the cameras with their poses at this frame.
        previous: the last solved frame, from which the motion is estimated.
        known_frames: all solved frames that matches may refer to, by number.
        radius: of the object.
        guess: (R, d) of the motion since then: X -> R (X - g) + g + d about the object's center g at that time.
        seed: of the outlier rejection.
        frames: per camera, local: its data of the frame.
        pairs: per camera, local: its matches.
    """

    rig: Rig
    previous: SolvedFrame
    known_frames: Mapping[int, SolvedFrame]
    radius: float
    guess: Hypothesis
    seed: int
    frames: Sequence[CameraFrame]
    pairs: Sequence[Sequence[FrameMatches]]

    @property
    def center(self) -> FloatArray:
        """(3,) g."""
        return np.asarray(self.previous.world_from_object.translation)

    def create_rng(self) -> np.random.Generator:
        """Create a random generator that gives each frame the same sequence."""
        return np.random.default_rng(self.seed)


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """A frame's motion since the last solved one.

    Attributes:
        status: see `Status`.
        rotation: (3, 3) R; undefined without `status.has_pose`.
        translation: (3,) d, likewise.
        information: (6, 6) of (w, d).
        iterations: of the solver.
        match_weights: per camera, local: weights and residuals of its matches.
        variance_inflation: (C,) variance inflation factor per camera, see `AlignmentResult`.
        faults: a sentence for each camera identified as faulty.
        is_biased: whether the object's surface biases the motion, so that errors accumulate with rotation.
    """

    status: Status
    rotation: FloatArray
    translation: FloatArray
    information: FloatArray
    iterations: int
    match_weights: Sequence[MatchWeights]
    variance_inflation: FloatArray
    faults: tuple[str, ...] = ()
    is_biased: bool = False


Solver = Callable[[CameraExecutor, PoseProblem], PoseSolution]


def gather_terms(terms_by_camera: Sequence[Sequence[TermData]]) -> list[TermData]:
    """Gather all cameras' terms, for centralized estimators."""
    return [term for terms in terms_by_camera for term in terms]


def scatter_fit(fit: Fit, terms_by_camera: Sequence[Sequence[TermData]]) -> list[MatchWeights]:
    """Scatter the result of a fit to `gather_terms` terms back to the cameras."""
    results = iter(zip(fit.weights, fit.residuals, strict=True))
    return [[next(results) for _ in terms] for terms in terms_by_camera]


def _gather_terms(
    executor: CameraExecutor, problem: PoseProblem, *, previous_only: bool = False
) -> list[tuple[TermData, ...]]:
    """Gather all cameras' terms; with `previous_only` only those relative to the last solved frame."""

    def collect_terms(c: int) -> CameraTerms:
        camera, previous, known = problem.rig.cameras[c], problem.previous, problem.known_frames
        pairs = [pair for pair in problem.pairs[c] if not previous_only or pair.reference == previous.number]
        terms = [pair.to_term(c, camera, compute_reference_motion(pair, previous, known)) for pair in pairs]
        return CameraTerms(tuple(terms))

    return [found.terms for found in executor.all_gather(collect_terms, CameraTerms())]


def _create_solution(problem: PoseProblem, fit: Fit, match_weights: Sequence[MatchWeights]) -> PoseSolution:
    no_inflation = np.ones(len(problem.rig))
    return PoseSolution(
        fit.status,
        fit.rotation,
        fit.translation,
        fit.information,
        fit.iterations,
        match_weights,
        no_inflation,
        fit.faults,
    )


def _create_failure(executor: CameraExecutor, problem: PoseProblem, status: Status) -> PoseSolution:
    """Create a solution without a pose."""

    def create_zero_weights(c: int) -> MatchWeights:
        return [(np.zeros(len(pair)), np.zeros(len(pair))) for pair in problem.pairs[c]]

    return _create_solution(problem, make_failed_fit([], status), executor.map_cameras(create_zero_weights))


def solve_epipolar(executor: CameraExecutor, problem: PoseProblem) -> PoseSolution:
    """Solve by epipolar geometry against all references at once, without using landmark depths."""
    terms = _gather_terms(executor, problem)
    fit = fit_terms(gather_terms(terms), problem.center, problem.radius, [problem.guess], problem.create_rng())
    return _create_solution(problem, fit, scatter_fit(fit, terms))


def solve_paper(method: str, executor: CameraExecutor, problem: PoseProblem) -> PoseSolution:
    """Solve by one of the paper's estimators, against the last solved frame alone."""
    terms = _gather_terms(executor, problem, previous_only=True)
    data = gather_terms(terms)
    fit = fit_terms(data, problem.center, problem.radius, [problem.guess], problem.create_rng())
    if fit.status is Status.OK:
        fit = apply_paper_method(method, data, fit, problem.center, problem.rig.names)
    scattered = scatter_fit(fit, terms)

    def assign_weights(c: int) -> MatchWeights:
        mine = iter(scattered[c])
        nothing = [(np.zeros(len(pair)), np.zeros(len(pair))) for pair in problem.pairs[c]]
        previous = problem.previous.number
        return [
            next(mine) if pair.reference == previous else no for pair, no in zip(problem.pairs[c], nothing, strict=True)
        ]

    return replace(
        _create_solution(problem, fit, executor.map_cameras(assign_weights)), is_biased=method not in UNBIASED_METHODS
    )


def solve_landmarks(executor: CameraExecutor, problem: PoseProblem) -> PoseSolution:
    """Solve by alignment with the landmarks of all references.

    Other starts are tried if the guess fits badly.
    """
    return _align_landmarks(executor, problem)[0]


def _align_landmarks(
    executor: CameraExecutor, problem: PoseProblem
) -> tuple[PoseSolution, list[LandmarkMatches], FloatArray]:
    """Align with landmarks; also return the observations and the solution's possible offset.

    Returns:
        the solution of `solve_landmarks`; per camera, local: the observations used; (6,) (w, d) possible offset
        (`select_hypothesis`).
    """
    frames, pairs, cameras = problem.frames, problem.pairs, problem.rig.cameras
    unweighted = executor.map_cameras(lambda c: build_observations(cameras[c], pairs[c], frames[c], problem.previous))
    ages = executor.all_gather(
        lambda c: summarize_ages(*unweighted[c], pairs[c]), LandmarkAges.from_frame_counts(np.empty(0))
    )
    all_ages = expand_ages(ages)
    # If all old landmarks vanish at once, something else is in view: the typical age in the last frame counts too.
    full_weight_age = max(compute_full_weight_age(all_ages), problem.previous.landmark_age)
    # Static landmarks that never moved get almost no weight once others move: undetected background is consistent with
    # itself, as the object is, and often larger.
    has_motion = _has_enough_motion(ages)
    static_weight = STATIC_WEIGHT if has_motion else 1.0
    observations = executor.map_cameras(lambda c: weight_observations(*unweighted[c], full_weight_age, static_weight))
    if len(all_ages) < MIN_MATCHES:
        return _create_failure(executor, problem, Status.TOO_FEW_MATCHES), observations, np.zeros(6)
    is_depth_guessed = (
        max(a.oldest for a in ages) <= MAX_YOUNG_AGE or _median_depth_sd(ages) > GUESSED_DEPTH_RATIO * problem.radius
    )
    # Where depths are guesses, so are the fit and the prediction.
    start_px = (FIRST_PX,) if is_depth_guessed else (FIRST_PX, NARROW_START_PX[-1])
    alignments = executor.align(observations, [(*problem.guess, px) for px in start_px])
    best, offset = select_hypothesis([candidate for candidate, _ in alignments], *problem.guess)
    pose, found = alignments[best]
    # While all depths are guesses, the opposite rotation with reversed depths fits nearly as well (mirrored solution of
    # few cameras and small rotations). Epipolar geometry provides an independent start.
    is_large_rotation = max(_rotation_angle(problem.guess[0]), _rotation_angle(pose.rotation)) > LARGE_ROTATION
    if is_depth_guessed or pose.cost > MAX_GOOD_COST or is_large_rotation:
        data = gather_terms(_gather_terms(executor, problem))
        epipolar_fit = fit_terms(data, problem.center, problem.radius, [problem.guess], problem.create_rng())
        starts = [
            (epipolar_fit.rotation, epipolar_fit.translation, px)
            for px in ALTERNATIVE_START_PX
            if epipolar_fit.status is Status.OK
        ]
        starts += [(*problem.guess, px) for px in NARROW_START_PX if px not in start_px] if is_large_rotation else []
        tried = executor.align(observations, starts) + (alignments[1:] if is_large_rotation else [])
        # Support uses epipolar distances alone, independent of guessed depths.
        support, *others = _compute_support(
            executor, observations, [found, *(candidate_weights for _, candidate_weights in tried)]
        )
        for (candidate_pose, candidate_weights), candidate_support in zip(tried, others, strict=True):
            if candidate_support > support:
                pose, found, support, offset = candidate_pose, candidate_weights, candidate_support, np.zeros(6)
    chances = executor.all_gather(
        lambda c: compute_inlier_statistics(observations[c], *found[c], pose.rotation, pose.translation, frames[c]),
        InlierStatistics(0, 0, 0, 0.0, 0),
    )
    status = Status.OK if pose.converged else Status.NOT_CONVERGED
    if sum(chance.n_inlier_matches for chance in chances) < MIN_MATCHES or (
        status.has_pose and _is_explained_by_chance(chances)
    ):
        return _create_failure(executor, problem, Status.NOT_CONSISTENT), observations, offset
    match_weights = executor.map_cameras(lambda c: split_by_pair(*found[c], pairs[c]))
    information = subtract_uncertainty(pose.information, offset)
    solution = PoseSolution(
        status, pose.rotation, pose.translation, information, pose.iterations, match_weights, pose.variance_inflation
    )
    return solution, observations, offset


def _compute_support(
    executor: CameraExecutor,
    observations: Sequence[LandmarkMatches],
    alignments: Sequence[Sequence[tuple[FloatArray, FloatArray]]],
) -> list[float]:
    """Sum `compute_support` over all cameras, for several alignments."""
    supports = executor.all_gather(
        lambda c: tuple(compute_support(observations[c], *alignment[c]) for alignment in alignments),
        (0.0,) * len(alignments),
    )
    return [sum(camera_supports) for camera_supports in zip(*supports, strict=True)]


def _median_depth_sd(ages: Sequence[LandmarkAges]) -> float:
    """Return the median over cameras of the landmarks' depth standard deviation."""
    known = [a.depth_sd for a in ages if np.isfinite(a.depth_sd)]
    return float(np.median(known)) if known else np.inf


def _rotation_angle(rotation: FloatArray) -> float:
    """Return the angle of a rotation (3, 3), radians."""
    return float(np.linalg.norm(rotvec(rotation)))


def _has_enough_motion(ages: Sequence[LandmarkAges]) -> bool:
    """Return whether enough landmarks have moved for static ones to be background.

    At least two cameras must see it, if there are two, since something may pass in front of one.
    """
    total = [float(a.counts.sum()) for a in ages]
    seeing = [a.n_moving for a, n in zip(ages, total, strict=True) if n >= MIN_MATCHES]
    cameras = sum(2 * moving >= MIN_MATCHES for moving in seeing)
    return sum(seeing) >= max(MIN_MATCHES, MIN_MOVING_RATIO * sum(total)) and cameras >= min(2, len(seeing))


def _is_explained_by_chance(chances: Sequence[InlierStatistics]) -> bool:
    """Return whether random matches would agree with a pose about as often.

    The pose has six unknowns, plus those of each camera's depth model.
    """
    inliers, tried = sum(chance.n_inlier_features for chance in chances), sum(chance.n_features for chance in chances)
    n_unknowns, expected_by_chance = (
        6 + sum(chance.n_unknowns for chance in chances),
        sum(chance.expected_by_chance for chance in chances),
    )
    return inliers < MIN_CERTAIN_INLIER_RATIO * tried and not is_more_than_chance(
        inliers, expected_by_chance, n_unknowns
    )


def solve_known_depth(executor: CameraExecutor, problem: PoseProblem) -> PoseSolution:
    """Solve Sylvester's equation for landmarks of known depth (2D-3D).

    The inliers are those of `solve_landmarks`, whose solution is kept if they are too few or give a mirrored result.

    The equation assumes orthographic views: each image point is scaled by its landmark's depth under the current
    motion, and the two are alternated (POSIT: D. DeMenthon, L. Davis, 1995).
    """
    solution, observations, offset = _align_landmarks(executor, problem)
    if solution.status is not Status.OK:
        return solution

    def select_known_depth(c: int) -> KnownDepthMatches:
        weights = np.concatenate([np.empty(0), *(w for w, _ in solution.match_weights[c])])
        smear_px = observations[c].focal * compute_depth_smear(observations[c], solution.rotation, solution.translation)
        return KnownDepthMatches(observations[c], np.where(smear_px < MAX_DEPTH_SMEAR_PX, weights, 0.0))

    records = executor.all_gather(select_known_depth, KnownDepthMatches.empty())
    cameras, weights = [record.observations for record in records], [record.weights for record in records]
    if sum(int((w > 0).sum()) for w in weights) < MIN_KNOWN_LANDMARKS:
        return solution
    rotations, centers = np.array([s.rotation for s in cameras]), np.array([s.center for s in cameras])
    points = [s.points for s in cameras]
    R, translation = problem.guess
    rounds = 0
    for _ in range(POSIT_ROUNDS):
        images = [s.image * ((s.points @ R.T + translation - s.center) @ s.rotation[2])[:, None] for s in cameras]
        s = solve_2d3d(rotations, points, images, centers=centers, weights=weights)
        rounds += s.iterations
        if s.status is not Status.OK:
            return solution
        change = np.abs(s.rotation - R).max()
        R, translation = s.rotation, s.translation
        if change < POSIT_TOLERANCE:
            break
    # Convert from the translation of the points' mean to that of the object's center, here the origin.
    center_from_mean = np.eye(6)
    center_from_mean[3:, :3] = -np.cross(np.eye(3), R @ s.center)
    information = subtract_uncertainty(
        center_from_mean.T @ block_diag(s.information, s.center_translation_information) @ center_from_mean, offset
    )
    return replace(
        solution, rotation=R, translation=translation, information=information, iterations=solution.iterations + rounds
    )


SOLVERS: dict[str, Solver] = {
    "landmarks": solve_landmarks,
    "epipolar": solve_epipolar,
    **{method: partial(solve_paper, method) for method in ESTIMATORS},
    "known-depth": solve_known_depth,
}
