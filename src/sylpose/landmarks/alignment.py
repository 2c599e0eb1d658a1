"""Alignment of landmarks of uncertain depth with their current observations.

Each match is a landmark X with a small uncertainty across the ray of its first observation and a larger one, of
standard deviation s, along it, and an image point y. Depths have two kinds of errors: individual ones, and a common one
of all landmarks of a camera, because the assumed surface is wrong. So the landmark is at X + s r (a1 + a2 u + a3 v +
ε), with r the ray, (u, v) the image position, ε and the camera's three a's of unit variance. The a's are unknowns in
addition to the six of the motion; ε is part of the covariance V = σ² I + J s² r r' J' of the image residual. A landmark
observed once constrains only across its epipolar line, a well known one constrains both directions as in solvePnP, with
a smooth transition in between. There is no local minimum at the identity and no degenerate object. V is constant within
an iteration (quasi-likelihood): a cost that trades V against the residuals is biased towards too much motion
(docs/method/4-tracking.md, "Landmark alignment").

Three measures prevent overconfidence from many matches. Depths of neighbors have correlated errors, so along their
lines only a few of a camera's matches count as independent. Each camera has an individual noise σ. And a camera that
disagrees with the others, because it was moved or is badly calibrated, has its variance inflated by the chi-squared of
its pose against theirs, a smooth function without a threshold. If cameras disagree, each is left out once, and of the
resulting poses the one with the best agreement of all cameras but one is selected.

Each iteration consists of the cameras' parts (`compute_camera_terms`), which need only that camera's matches, and a
joint step (`take_joint_step`), which needs a few numbers from each: `align` runs both in one process,
`landmarks.distributed_alignment` runs one camera of several in separate processes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.matrices import rotvec
from sylpose.geometry.numba_linalg import kernel
from sylpose.landmarks.camera_terms import (
    CameraState,
    StackedMatches,
    compute_camera_terms,
    estimate_camera_noise,
    evaluate_pose,
    update_depth_model,
)
from sylpose.landmarks.joint_step import MAX_ITERATIONS, AlignmentState, is_noise_estimated, take_joint_step
from sylpose.landmarks.messages import EvaluationMessage

# A rotation (3, 3), a translation (3,), and the noise assumed in the first iteration, pixels: the pose should be
# correct within a few times that.
AlignmentStart = tuple[FloatArray, FloatArray, float]

# Noise assumed in the first, tolerant iterations, pixels: from a bad prediction to the noise of keypoints (choice).
SCHEDULE_PX = (32.0, 16.0, 8.0, 4.0, 2.0, 1.0)
FIRST_PX = SCHEDULE_PX[0]
# Cameras disagree if one has its variance inflated by this factor, has this many times the rig's noise, or an inlier
# ratio below this fraction of another's (choice).
MAX_INFLATION, MAX_NOISE_RATIO, MIN_INLIER_RATIO = 3.0, 2.0, 0.6
# Another pose than the first must be better by this difference of the mean robust cost (choice).
COST_MARGIN = 0.01
# Minimum number of matches of a camera to be compared: as many as determine a pose (derived).
MIN_MATCHES = 3
# Initial variance inflation of a camera that was left out, when it is included again (choice).
LEFT_OUT_INFLATION = 1e4
# Upper limits of the noise that defines inliers, pixels and relative to the rig's, however bad the camera (choice).
MAX_INLIER_NOISE_PX, MAX_INLIER_NOISE_RATIO = 1.0, 3.0
# Poses whose mean robust costs differ by less explain the matches equally well (choice).
MAX_COST_DIFFERENCE = 0.01
# Squared distance, in standard deviations, below which poses are the same: the first is used (choice).
SAME_POSE_DISTANCE = 1.0


@dataclass(frozen=True, eq=False)
class LandmarkMatches:
    """One camera's matches between landmarks and the current frame.

    Attributes:
        points: (n, 3) landmarks relative to g, world axes, at the pose that the motion starts from.
        depth_error: (n, 3) s r: the direction of each one's largest uncertainty, one standard deviation long, away from
            the camera.
        image: (n, 2) normalized points in the current frame.
        feature: (n,) feature of the current frame of each match. A feature may match landmarks of several keyframes:
            they share its weight, and one that contradicts the pose rejects all of them.
        prior_weight: (n,) in (0, 1], multiplies the weights.
        rotation: (3, 3) Q of camera_from_world.
        center: (3,) the camera's center relative to g.
        focal: pixels per normalized unit.
    """

    points: FloatArray
    depth_error: FloatArray
    image: FloatArray
    feature: IntArray
    prior_weight: FloatArray
    rotation: FloatArray
    center: FloatArray
    focal: float

    @classmethod
    def empty(cls) -> LandmarkMatches:
        """Return the matches of a camera without observations."""
        empty_rows = np.empty((0, 3))
        return cls(
            empty_rows, empty_rows, np.empty((0, 2)), np.empty(0, np.int64), np.empty(0), np.eye(3), np.zeros(3), 1.0
        )


@dataclass(frozen=True, eq=False)
class AlignmentResult:
    """Motion X -> R (X - g) + g + d that aligns the landmarks.

    Attributes:
        rotation, translation: (3, 3) R and (3,) d.
        information: (6, 6) of (w, d).
        cost: robust mean over the matches, weighted by `prior_weight`, between 0 and 1.
        reference_cost: the same at one fixed noise (`REFERENCE_NOISE_PX`), by which poses from the same matches are
            compared.
        reference_costs: (C,) the same of each camera's matches.
        converged: whether the last step was negligible and at least three matches are inliers.
        iterations: of Gauss-Newton.
        matches: (C,) number of matches.
        sigma_px: (C,) each camera's noise.
        variance_inflation: (C,) variance inflation factor per camera; 1 if it agrees with the others.
        inliers: (C,) number of inliers.
        weights: per camera (n,), 0 for outliers. This and what follows is for the local cameras only.
        residuals: per camera (n,) pixels, across the line of unknown depth: the epipolar distance.
        depth_model: (C, 3) a.
    """

    rotation: FloatArray
    translation: FloatArray
    information: FloatArray
    cost: float
    reference_cost: float
    reference_costs: FloatArray
    converged: bool
    iterations: int
    matches: IntArray
    sigma_px: FloatArray
    variance_inflation: FloatArray
    inliers: IntArray
    weights: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    depth_model: FloatArray


def align(
    matches: Sequence[LandmarkMatches], rotation: FloatArray, translation: FloatArray, first_px: float = FIRST_PX
) -> AlignmentResult:
    """Align landmarks by robust Gauss-Newton from one start.

    Args:
        matches: of all cameras.
        rotation, translation: (3, 3) and (3,), the start.
        first_px: noise assumed in the first iteration; the start should be correct within a few times that.

    Raises:
        ValueError: no cameras.
    """
    return align_locally(matches, [(np.asarray(rotation, float), np.asarray(translation, float), first_px)])[0]


def align_locally(matches: Sequence[LandmarkMatches], starts: Sequence[AlignmentStart]) -> list[AlignmentResult]:
    """Align landmarks of all cameras in one process, from each start. See `align`."""
    if not matches:
        raise ValueError("alignment needs at least one camera, got none")
    return align_from_starts(_LocalCameras(stack_matches(matches)), starts)


class AlignmentJob(NamedTuple):
    """An alignment problem: Gauss-Newton from one start.

    Attributes:
        schedule: noise assumed in the first iterations, pixels.
        rotation, translation: the start.
        variance_inflation: (C,) the initial variance inflation.
        left_out: a camera that is ignored; -1: none.
    """

    schedule: Sequence[float]
    rotation: FloatArray
    translation: FloatArray
    variance_inflation: FloatArray
    left_out: int = -1


def make_camera_state(stacked: StackedMatches) -> CameraState:
    """Return the initial state of the local cameras, with a zero depth model."""
    n, cameras = len(stacked.prior_weight), len(stacked.focal)
    return CameraState(
        depth_model=np.zeros((cameras, 3)),
        gains=np.zeros((cameras, 3, 7)),
        weights=np.zeros(n),
        projections=np.empty((n, 13)),
        distance=np.zeros(n),
        cross_residual=np.zeros(n),
        equations=np.empty((9, 10)),
        feature_weights=np.empty((int(stacked.feature.max(initial=-1)) + 1, 2)),
        buffer=np.empty(n),
    )


class AlignmentRun:
    """A job in progress.

    Args:
        job: the problem.
        stacked: matches of the local cameras.

    Attributes:
        state, camera_state: shared by all cameras; of the local cameras.
        schedule: (S,) noise assumed in the first iterations, pixels.
        left_out: as in the job.
        iteration, converged: number of iterations so far; whether the last one was negligible.
    """

    def __init__(self, job: AlignmentJob, stacked: StackedMatches) -> None:
        inflation, sigma_px = job.variance_inflation.copy(), np.full(len(job.variance_inflation), job.schedule[0])
        pose, steps = (job.rotation.copy(), job.translation.copy()), (np.zeros(6), np.zeros(6))
        self.state = AlignmentState(*pose, sigma_px, np.array([job.schedule[0]]), inflation, np.zeros((6, 6)), *steps)
        self.stacked, self.camera_state = stacked, make_camera_state(stacked)
        self.schedule, self.left_out = np.array(job.schedule, float), job.left_out
        self.iteration, self.converged = 0, False

    def evaluate(self, c: int, number: int) -> EvaluationMessage:
        """Evaluate the final pose with one camera's matches.

        Args:
            c: index among the local cameras.
            number: index among all cameras.
        """
        stacked, state = self.stacked, self.state
        # The noise that defines inliers is limited by the rig's.
        limit = max(MAX_INLIER_NOISE_PX, MAX_INLIER_NOISE_RATIO * state.rig_px[0])
        noise_px, is_used = float(min(state.sigma_px[number], limit)), number != self.left_out
        cost, reference_cost, inliers = evaluate_pose(
            stacked, c, state.rotation, state.translation, noise_px, is_used, self.camera_state
        )
        matches = slice(stacked.offsets[c], stacked.offsets[c + 1])
        weight = float(stacked.prior_weight[matches].sum())
        return EvaluationMessage(cost, reference_cost, int(inliers), matches.stop - matches.start, weight)

    def make_result(self, evaluations: Sequence[EvaluationMessage]) -> AlignmentResult:
        """Combine the cameras' evaluations of the final pose with the local cameras' data."""
        state, splits = self.state, self.stacked.offsets[1:-1]
        reference_costs = np.array([t.reference_cost for t in evaluations])
        prior_weights = np.array([t.prior_weight for t in evaluations])
        inliers, total = np.array([t.inliers for t in evaluations], np.int64), max(float(prior_weights.sum()), 1e-12)
        return AlignmentResult(
            rotation=state.rotation,
            translation=state.translation,
            information=state.information,
            cost=sum((t.cost for t in evaluations), 0.0) / total,
            reference_cost=float(reference_costs.sum()) / total,
            reference_costs=reference_costs / np.maximum(prior_weights, 1e-12),
            converged=self.converged and int(inliers.sum()) >= MIN_MATCHES,
            iterations=min(self.iteration, MAX_ITERATIONS),
            matches=np.array([t.matches for t in evaluations], np.int64),
            sigma_px=state.sigma_px,
            variance_inflation=state.variance_inflation,
            inliers=inliers,
            weights=tuple(np.split(self.camera_state.weights, splits)),
            residuals=tuple(np.split(self.camera_state.cross_residual, splits)),
            depth_model=self.camera_state.depth_model,
        )


class _CameraGroup(Protocol):
    """All cameras, local or remote, with their number."""

    @property
    def count(self) -> int: ...

    def solve(self, jobs: Sequence[AlignmentJob]) -> list[AlignmentResult]:
        """Solve independent jobs; remote cameras work on them in parallel."""


def make_first_job(start: AlignmentStart, n_cameras: int) -> AlignmentJob:
    """Return the job of one start, without variance inflation."""
    rotation, translation, first_px = start
    schedule = [s for s in SCHEDULE_PX if s <= first_px] or SCHEDULE_PX[-1:]
    return AlignmentJob(schedule, rotation, translation, np.ones(n_cameras))


def align_from_starts(cameras: _CameraGroup, starts: Sequence[AlignmentStart]) -> list[AlignmentResult]:
    """Return the joint pose for each start; if cameras disagree, that of the best leave-one-out.

    Of the poses without one camera, the one on which all cameras but one agree best is selected.
    """
    jobs = [make_first_job(start, cameras.count) for start in starts]
    out = cameras.solve(jobs)
    if not out:
        return []
    eligible = np.flatnonzero(out[0].matches >= MIN_MATCHES).tolist()
    inconsistent = [k for k, joint in enumerate(out) if len(eligible) > 2 and _has_disagreement(joint, eligible)]
    reduced_results = iter(cameras.solve([jobs[k]._replace(left_out=c) for k in inconsistent for c in eligible]))
    final_jobs = []
    for _ in inconsistent:
        for c in eligible:
            result, inflation = next(reduced_results), np.where(np.arange(cameras.count) == c, LEFT_OUT_INFLATION, 1.0)
            final_jobs.append(AlignmentJob(SCHEDULE_PX[-1:], result.rotation, result.translation, inflation))
    final_results = iter(cameras.solve(final_jobs))
    for k in inconsistent:
        candidates = [out[k], *(next(final_results) for _ in eligible)]
        # One vote per camera, whatever its number of matches; the worst is ignored.
        costs = [float(np.mean(np.sort(candidate.reference_costs[eligible])[:-1])) for candidate in candidates]
        costs[0] -= COST_MARGIN
        out[k] = candidates[int(np.argmin(costs))]
    return out


def _has_disagreement(joint: AlignmentResult, eligible: Sequence[int]) -> bool:
    inlier_ratios, noise = joint.inliers[eligible] / joint.matches[eligible], joint.sigma_px[eligible]
    return bool(
        joint.variance_inflation.max() > MAX_INFLATION
        or noise.max() > MAX_NOISE_RATIO * np.median(noise)
        or inlier_ratios.min() < MIN_INLIER_RATIO * inlier_ratios.max()
    )


# --- all cameras here -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _LocalCameras:
    """All cameras in one process: the iterations are compiled as a whole."""

    stacked: StackedMatches

    @property
    def count(self) -> int:
        return len(self.stacked.focal)

    def solve(self, jobs: Sequence[AlignmentJob]) -> list[AlignmentResult]:
        """Solve the jobs, see `_CameraGroup`."""
        runs = [AlignmentRun(job, self.stacked) for job in jobs]
        for run in runs:
            run.iteration, run.converged = _run_iterations(
                self.stacked, run.schedule, run.left_out, run.state, run.camera_state
            )
        return [run.make_result([run.evaluate(c, c) for c in range(self.count)]) for run in runs]


@kernel
def _run_iterations(
    stacked: StackedMatches, schedule: FloatArray, left_out: int, state: AlignmentState, camera_state: CameraState
) -> tuple[int, bool]:
    """Iterate until convergence, in place.

    Returns:
        number of iterations; whether they converged.
    """
    n = len(state.variance_inflation)
    reduced, weight_sums, noise = np.empty((n, 6, 7)), np.empty(n), np.empty(n)
    iteration, converged, is_last = 0, False, False
    for iteration in range(1, MAX_ITERATIONS + 2):
        for c in range(n):
            rotation, translation, sigma_px = state.rotation, state.translation, state.sigma_px[c]
            weight_sums[c] = compute_camera_terms(
                stacked, c, rotation, translation, sigma_px, c != left_out, camera_state, reduced[c]
            )
            noise[c] = np.nan
            if is_noise_estimated(iteration, len(schedule)):
                noise[c] = estimate_camera_noise(stacked, c, camera_state)
        stepped, negligible = take_joint_step(state, reduced, weight_sums, noise, schedule, iteration, is_last)
        if not stepped:
            break
        converged = negligible
        is_last = converged or iteration == MAX_ITERATIONS
        for c in range(n):
            update_depth_model(c, state.step, camera_state)
    return min(iteration, MAX_ITERATIONS), converged


# --- arrays -----------------------------------------------------------------------------------------------------------


def stack_matches(matches: Sequence[LandmarkMatches]) -> StackedMatches:
    """Concatenate all cameras' matches."""
    arrays = {
        name: np.ascontiguousarray(np.concatenate([getattr(s, name) for s in matches]), float)
        for name in ("points", "depth_error", "image", "prior_weight")
    }
    arrays |= {name: np.array([getattr(s, name) for s in matches], float) for name in ("rotation", "center", "focal")}
    feature = np.concatenate([s.feature for s in matches]).astype(np.int64)
    basis = np.concatenate([_depth_basis(s.image) for s in matches])
    offsets = np.cumsum([0, *(len(s.image) for s in matches)], dtype=np.int64)
    return StackedMatches(**arrays, feature=feature, basis=basis, offsets=offsets)


def _depth_basis(image: FloatArray) -> FloatArray:
    """Return (n, 3): 1, u, v, the image position in units of its spread."""
    if len(image) == 0:
        return np.empty((0, 3))
    spread = max(float(np.linalg.norm(image.std(axis=0))), 1e-12)
    return np.column_stack([np.ones(len(image)), (image - np.median(image, axis=0)) / spread])


# --- selection among several starts -------------------------------------------------------------------------------------


def select_hypothesis(
    hypotheses: Sequence[AlignmentResult], rotation: FloatArray, translation: FloatArray
) -> tuple[int, FloatArray]:
    """Select the alignment that explains the matches best.

    Of equally good distinct ones, the one nearest to a prediction is selected.

    Args:
        hypotheses: of the same matches, from different starts.
        rotation, translation: (3, 3) and (3,), the predicted pose.

    Returns:
        its index; (6,) (w, d) from it to the farthest equally good one: an uncertainty in addition to its covariance.
    """
    lowest = min(range(len(hypotheses)), key=lambda k: hypotheses[k].reference_cost)
    equivalent = [
        k
        for k, one in enumerate(hypotheses)
        if one.reference_cost < hypotheses[lowest].reference_cost + MAX_COST_DIFFERENCE and one.converged
    ]
    # Distances use one common information matrix, so that an uncertain pose does not appear nearer.
    scale = hypotheses[lowest].information
    best = equivalent[0] if equivalent else lowest
    for k in equivalent:
        distance = _squared_distance(
            _pose_difference(hypotheses[best], hypotheses[k].rotation, hypotheses[k].translation), scale
        )
        is_nearer = _squared_distance(
            _pose_difference(hypotheses[k], rotation, translation), scale
        ) < _squared_distance(_pose_difference(hypotheses[best], rotation, translation), scale)
        best = k if is_nearer and distance > SAME_POSE_DISTANCE else best
    differences = [
        _pose_difference(hypotheses[best], hypotheses[k].rotation, hypotheses[k].translation) for k in equivalent
    ]
    difference = max(differences, key=lambda difference: _squared_distance(difference, scale), default=np.zeros(6))
    return best, difference if _squared_distance(difference, scale) > SAME_POSE_DISTANCE else np.zeros(6)


def subtract_uncertainty(information: FloatArray, difference: FloatArray) -> FloatArray:
    """Return (6, 6) information of (w, d) reduced by a possible difference (6,).

    It is the inverse of the covariance plus difference difference'.
    """
    projection = information @ difference
    return np.asarray(information - np.outer(projection, projection) / (1.0 + difference @ projection))


def _pose_difference(hypothesis: AlignmentResult, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the (6,) difference (w, d) from an alignment to a pose."""
    return np.concatenate([rotvec(rotation @ hypothesis.rotation.T), translation - hypothesis.translation])


def _squared_distance(difference: FloatArray, information: FloatArray) -> float:
    return float(difference @ information @ difference)
