"""Pose solvers: estimate one frame's pose from its matches with earlier frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import FIRST_PX, SCHEDULE_PX, LandmarkMatches, select_hypothesis, subtract_uncertainty
from sylpose.landmarks.landmark_filter import KNOWN_DEPTH_RATIO
from sylpose.relative_pose.limits import HALF_DIGITS, MAX_ROUNDS
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.sylvester_methods import ESTIMATORS, UNBIASED_METHODS, apply_estimator
from sylpose.relative_pose.terms import MIN_MATCHES, Fit, TermData
from sylpose.rig import Rig
from sylpose.status import Status
from sylpose.sylvester.known_depth import solve_2d3d
from sylpose.tracking.camera_side.frame import (
    STATIC_WEIGHT,
    CameraFrame,
    CameraPairs,
    FrameMatches,
    MatchWeights,
    build_observations,
    compute_depth_smear,
    compute_full_weight_age,
    compute_inlier_statistics,
    compute_support,
    has_enough_motion,
    is_explained_by_chance,
    split_by_pair,
    weight_observations,
)
from sylpose.tracking.context import Alignment, CameraExecutor
from sylpose.tracking.joint_side.joint_state import SolvedFrame
from sylpose.tracking.joint_side.object_model import MIN_SURFACE_POINTS
from sylpose.tracking.reports import CameraTerms, InlierStatistics, KnownDepthMatches, LandmarkAges

Hypothesis = tuple[FloatArray, FloatArray]

# Initial noise level of another start, pixels, the last of the usual one's: the first rounds at large assumed noise may
# converge to another minimum even from the true pose (derived).
NARROW_START_PX = SCHEDULE_PX[-1]
# A depth is known if its standard deviation moves the landmark's image by less than this, pixels (choice). The 2D-3D
# equation needs as many such landmarks as a surface.
MAX_DEPTH_SMEAR_PX = 1.0


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
    pairs: CameraPairs

    @property
    def center(self) -> FloatArray:
        """(3,) g."""
        return np.asarray(self.previous.world_from_object.translation)


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """A frame's motion since the last solved one.

    Attributes:
        rotation: (3, 3) R.
        translation: (3,) d.
        information: (6, 6) of (w, d).
        match_weights: per camera, local: weights and residuals of its matches.
        variance_inflation: (C,) variance inflation factor per camera, see `AlignmentResult`.
        faults: a sentence for each camera identified as faulty.
        is_static: whether the object did not move measurably.
        is_biased: whether the object's surface biases the motion, so that errors accumulate with rotation.
    """

    rotation: FloatArray
    translation: FloatArray
    information: FloatArray
    match_weights: Sequence[MatchWeights]
    variance_inflation: FloatArray
    faults: tuple[str, ...] = ()
    is_static: bool = False
    is_biased: bool = False


# Returns None without a pose.
Solver = Callable[[CameraExecutor, PoseProblem], PoseSolution | None]


# --- epipolar geometry, and the paper's estimators --------------------------------------------------------------------


def gather_terms(terms_by_camera: Sequence[Sequence[TermData]]) -> list[TermData]:
    """Gather all cameras' terms, for centralized estimators."""
    return [term for terms in terms_by_camera for term in terms]


def scatter_fit(
    executor: CameraExecutor, fit: Fit, terms_by_camera: Sequence[Sequence[TermData]]
) -> list[MatchWeights]:
    """Scatter the result of a fit to `gather_terms` terms back to the cameras; per camera, local."""
    results = iter(zip(fit.weights, fit.residuals, strict=True))
    by_camera = [[next(results) for _ in terms] for terms in terms_by_camera]
    return [by_camera[c] for c in executor.local]


def compute_reference_motion(
    pair: FrameMatches, previous: SolvedFrame, known_frames: Mapping[int, SolvedFrame]
) -> RigidTransform | None:
    """Return the object's motion from a pair's reference frame to the last solved one.

    Returns:
        argument `previous_from_reference` of `FrameMatches.to_term`; None if both are the same frame.
    """
    if pair.reference == previous.number:
        return None
    return previous.world_from_object * known_frames[pair.reference].world_from_object.inv()


def _exchange_terms(
    executor: CameraExecutor, problem: PoseProblem, *, previous_only: bool = False
) -> list[tuple[TermData, ...]]:
    """Exchange all cameras' terms; with `previous_only` only those relative to the last solved frame."""
    previous, known_frames = problem.previous, problem.known_frames
    own_terms = [
        CameraTerms(
            tuple(
                pair.to_term(c, problem.rig.cameras[c], compute_reference_motion(pair, previous, known_frames))
                for pair in pairs
                if not previous_only or pair.reference == previous.number
            )
        )
        for c, pairs in zip(executor.local, problem.pairs, strict=True)
    ]
    return [found.terms for found in executor.gather(own_terms, CameraTerms())]


def _fit_epipolar(problem: PoseProblem, data: Sequence[TermData]) -> Fit:
    return fit_terms(data, problem.center, problem.radius, [problem.guess], np.random.default_rng(problem.seed))


def _create_solution(problem: PoseProblem, fit: Fit, match_weights: Sequence[MatchWeights]) -> PoseSolution | None:
    if not fit.status.has_pose:
        return None
    estimate, no_inflation = (fit.rotation, fit.translation, fit.information), np.ones(len(problem.rig))
    return PoseSolution(*estimate, match_weights, no_inflation, fit.faults, fit.status is Status.NO_MOTION)


def solve_epipolar(executor: CameraExecutor, problem: PoseProblem) -> PoseSolution | None:
    """Solve by epipolar geometry against all references at once, without using landmark depths."""
    terms = _exchange_terms(executor, problem)
    fit = _fit_epipolar(problem, gather_terms(terms))
    return _create_solution(problem, fit, scatter_fit(executor, fit, terms))


def solve_paper(method: str, executor: CameraExecutor, problem: PoseProblem) -> PoseSolution | None:
    """Solve by one of the paper's estimators, against the last solved frame alone."""
    terms = _exchange_terms(executor, problem, previous_only=True)
    data = gather_terms(terms)
    fit = _fit_epipolar(problem, data)
    if fit.status is Status.OK:
        fit = apply_estimator(method, data, fit, problem.center, problem.rig.names)
    match_weights = []
    for pairs, scattered in zip(problem.pairs, scatter_fit(executor, fit, terms), strict=True):
        own = iter(scattered)
        zeros = [(np.zeros(len(pair)), np.zeros(len(pair))) for pair in pairs]
        is_used = [pair.reference == problem.previous.number for pair in pairs]
        match_weights.append([next(own) if used else none for used, none in zip(is_used, zeros, strict=True)])
    solution = _create_solution(problem, fit, match_weights)
    return None if solution is None else replace(solution, is_biased=method not in UNBIASED_METHODS)


# --- alignment with landmarks -----------------------------------------------------------------------------------------


def solve_landmarks(executor: CameraExecutor, problem: PoseProblem) -> PoseSolution | None:
    """Solve by alignment with the landmarks of all references.

    A start at low assumed noise is tried too, and one from epipolar geometry while depths are guesses.
    """
    solved = _align_landmarks(executor, problem)
    return None if solved is None else solved[0]


def _align_landmarks(
    executor: CameraExecutor, problem: PoseProblem
) -> tuple[PoseSolution, list[LandmarkMatches], FloatArray] | None:
    """Align with landmarks; also return the observations and the solution's possible offset.

    Returns:
        the solution of `solve_landmarks`; per camera, local: the observations used; (6,) (w, d) possible offset
        (`select_hypothesis`); None without a solution.
    """
    observations, ages = _exchange_observations(executor, problem)
    if not sum(a.counts.sum() for a in ages) >= MIN_MATCHES:
        return None
    is_depth_guessed = _median_depth_sd(ages) > KNOWN_DEPTH_RATIO * problem.radius
    alignments = executor.align(observations, [(*problem.guess, px) for px in (FIRST_PX, NARROW_START_PX)])
    best, offset = select_hypothesis([candidate for candidate, _ in alignments], *problem.guess)
    pose, found = alignments[best]
    if is_depth_guessed:
        # The opposite rotation with reversed depths fits nearly as well. Epipolar geometry is independent of depths: it
        # provides another start, and its distances decide.
        tried = executor.align(observations, _create_epipolar_starts(executor, problem))
        support, *others = _sum_support(executor, observations, [(pose, found), *alignments, *tried])
        for (other, weights), other_support in zip([*alignments, *tried], others, strict=True):
            if other_support > support:
                pose, found, support, offset = other, weights, other_support, np.zeros(6)
    if not pose.converged:
        return None
    statistics = executor.gather(
        [
            compute_inlier_statistics(own, *weights, pose, frame)
            for own, weights, frame in zip(observations, found, problem.frames, strict=True)
        ],
        InlierStatistics(),
    )
    if sum(one.n_inlier_matches for one in statistics) < MIN_MATCHES or is_explained_by_chance(statistics):
        return None
    match_weights = [split_by_pair(*weights, pairs) for weights, pairs in zip(found, problem.pairs, strict=True)]
    information = subtract_uncertainty(pose.information, offset)
    solution = PoseSolution(pose.rotation, pose.translation, information, match_weights, pose.variance_inflation)
    return solution, observations, offset


def _exchange_observations(
    executor: CameraExecutor, problem: PoseProblem
) -> tuple[list[LandmarkMatches], list[LandmarkAges]]:
    """Build the cameras' observations, weighted by all cameras' landmark ages.

    Returns:
        per camera, local: observations; per camera of the rig: ages.
    """
    unweighted = [
        build_observations(problem.rig.cameras[c], pairs, frame, problem.previous)
        for c, pairs, frame in zip(executor.local, problem.pairs, problem.frames, strict=True)
    ]
    ages = executor.gather([own for *_, own in unweighted], LandmarkAges())
    # If all old landmarks vanish at once, something else is in view: the typical age in the last frame counts too.
    full_weight_age = max(compute_full_weight_age(ages), problem.previous.landmark_age)
    # Static landmarks that never moved get almost no weight once others move: undetected background is consistent with
    # itself, as the object is, and often larger.
    static_weight = STATIC_WEIGHT if has_enough_motion(ages) else 1.0
    weights = full_weight_age, static_weight
    return [weight_observations(own, is_moving, *weights) for own, is_moving, _ in unweighted], ages


def _create_epipolar_starts(
    executor: CameraExecutor, problem: PoseProblem
) -> list[tuple[FloatArray, FloatArray, float]]:
    """Create the start of the alignment from epipolar geometry; none if that fails."""
    fit = _fit_epipolar(problem, gather_terms(_exchange_terms(executor, problem)))
    return [(fit.rotation, fit.translation, NARROW_START_PX)] if fit.status is Status.OK else []


def _sum_support(
    executor: CameraExecutor, observations: Sequence[LandmarkMatches], alignments: Sequence[Alignment]
) -> list[float]:
    """Sum `compute_support` over all cameras, for several alignments."""
    supports = executor.gather(
        [tuple(compute_support(own, *weights[k]) for _, weights in alignments) for k, own in enumerate(observations)],
        (0.0,) * len(alignments),
    )
    return [sum(camera_supports) for camera_supports in zip(*supports, strict=True)]


def _median_depth_sd(ages: Sequence[LandmarkAges]) -> float:
    """Return the median over cameras of the landmarks' depth standard deviation."""
    known = [a.depth_sd for a in ages if np.isfinite(a.depth_sd)]
    return float(np.median(known)) if known else np.inf


# --- landmarks of known depth -----------------------------------------------------------------------------------------


def solve_known_depth(executor: CameraExecutor, problem: PoseProblem) -> PoseSolution | None:
    """Solve Sylvester's equation for landmarks of known depth (2D-3D).

    The inliers are those of `solve_landmarks`, whose solution is kept if they are too few or give a mirrored result.

    The equation assumes orthographic views: each image point is scaled by its landmark's depth under the current
    motion, and the two are alternated (POSIT: D. DeMenthon, L. Davis, 1995).
    """
    solved = _align_landmarks(executor, problem)
    if solved is None:
        return None
    solution, observations, offset = solved
    records = executor.gather(
        [
            _select_known_depth(own, weights, solution)
            for own, weights in zip(observations, solution.match_weights, strict=True)
        ],
        KnownDepthMatches(),
    )
    cameras, weights = [record.observations for record in records], [record.weights for record in records]
    if sum(int((w > 0).sum()) for w in weights) < MIN_SURFACE_POINTS:
        return solution
    rotations, centers = np.array([s.rotation for s in cameras]), np.array([s.center for s in cameras])
    points = [s.points for s in cameras]
    R, translation = problem.guess
    for _ in range(MAX_ROUNDS):
        images = [s.image * ((s.points @ R.T + translation - s.center) @ s.rotation[2])[:, None] for s in cameras]
        s = solve_2d3d(rotations, points, images, centers=centers, weights=weights)
        if s.status is not Status.OK:
            return solution
        change = np.abs(s.rotation - R).max()
        R, translation = s.rotation, s.translation
        if change < HALF_DIGITS:
            break
    # Convert from the translation of the points' mean to that of the object's center, here the origin.
    center_from_mean = np.eye(6)
    center_from_mean[3:, :3] = -np.cross(np.eye(3), R @ s.center)
    information = center_from_mean.T @ block_diag(s.information, s.center_translation_information) @ center_from_mean
    return replace(solution, rotation=R, translation=translation, information=subtract_uncertainty(information, offset))


def _select_known_depth(
    observations: LandmarkMatches, match_weights: MatchWeights, solution: PoseSolution
) -> KnownDepthMatches:
    """Select one camera's landmarks of known depth."""
    weights = np.concatenate([np.empty(0), *(w for w, _ in match_weights)])
    smear_px = observations.focal * compute_depth_smear(observations, solution.rotation, solution.translation)
    return KnownDepthMatches(observations, np.where(smear_px < MAX_DEPTH_SMEAR_PX, weights, 0.0))


SOLVERS: dict[str, Solver] = {
    "landmarks": solve_landmarks,
    "epipolar": solve_epipolar,
    **{method: partial(solve_paper, method) for method in ESTIMATORS},
    "known-depth": solve_known_depth,
}
# Methods whose poses the cameras' own motions may contradict: the others are approximations, and have errors of their own.
MAXIMUM_LIKELIHOOD = {"landmarks", "epipolar"}
