"""Alignment by one camera node of several; all nodes obtain the same result, to the bit.

Exact mode: the iterations of `alignment`; independent jobs are solved in parallel, with one message for all of them.

Compact mode follows the paper: "iterative refinement of the independent solution obtained for each camera". Each camera
first runs the schedule of noise levels alone, with the start as a weak prior, without which a camera with few
observations could diverge. It sends the information and gradient of its matches at its own solution, as in any
iteration, moved to the common start. The prior is not sent, so cameras with few observations contribute little. The sum
of these is the first joint step, in which diverged cameras are down-weighted as in any other. A few more iterations
follow from there, with each camera's noise constant. There is no leave-one-out. Jobs that have not converged after a
few iterations continue. Where that fails, or most cameras lose most of the inliers of their own solutions, the exact
iterations follow.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import (
    AlignmentJob,
    AlignmentResult,
    AlignmentRun,
    AlignmentStart,
    LandmarkMatches,
    align_from_starts,
    make_first_job,
    stack_matches,
)
from sylpose.landmarks.camera_terms import compute_camera_terms, estimate_camera_noise, update_depth_model
from sylpose.landmarks.joint_step import (
    MAX_ITERATIONS,
    SETTLING_ITERATIONS,
    STEP_TOLERANCE,
    AlignmentState,
    is_noise_estimated,
    take_joint_step,
)
from sylpose.landmarks.messages import EvaluationMessage, Exchange, TermsMessage

# Prior standard deviations of the start for a single camera: radians, and a fraction of its landmarks' distance from
# the object's center (choice).
PRIOR_ROTATION_SD, PRIOR_TRANSLATION_RATIO = 0.3, 0.3
# Iterations of the compact mode, including the first one: from then on a step of a quarter of its standard deviation is
# sufficient, and only larger ones continue (choice).
COMPACT_ITERATIONS, COMPACT_TOLERANCE = 5, 0.25**2
# From this iteration on noise and variance inflation are constant: the iteration number for `take_joint_step` jumps by
# so many (choice).
FREEZE_ITERATION, SKIPPED_ITERATIONS = 4, SETTLING_ITERATIONS
# Squared distance, in standard deviations, below which poses after the first iteration are duplicates (choice).
SAME_POSE_DISTANCE = 1.0
# A camera loses too much if less than this fraction of the weights at its own solution remains (choice).
MIN_WEIGHT_RATIO = 0.5


class _NodeRun(AlignmentRun):
    """A job in progress on this node; attributes as in `take_joint_step`."""

    is_last = finished = False
    weight_sums: FloatArray = np.zeros(0)


class DistributedAligner:
    """One camera node of several (`alignment._CameraGroup`).

    Args:
        matches: its matches.
        index: its number.
        count: number of cameras.
        exchange: of messages with the others.
        compact: whether to use the compact mode, see above.
    """

    def __init__(
        self, matches: LandmarkMatches, index: int, count: int, exchange: Exchange, *, compact: bool = False
    ) -> None:
        self._matches, self._index, self.count, self._exchange = stack_matches([matches]), index, count, exchange
        self._is_compact = compact

    def align(self, starts: Sequence[AlignmentStart]) -> list[AlignmentResult]:
        """Align from the starts, see `alignment.align_from_starts`.

        The weights, residuals and depth model are this camera's only.
        """
        return self._align_compact(starts) if self._is_compact else align_from_starts(self, starts)

    def solve(self, jobs: Sequence[AlignmentJob]) -> list[AlignmentResult]:
        """Solve the jobs, see `alignment._CameraGroup`."""
        runs = [_NodeRun(job, self._matches) for job in jobs]
        while active := [run for run in runs if not run.finished]:
            self._run_iteration(active, [self._make_message(run) for run in active])
        return self._make_results(runs)

    def _make_message(self, run: _NodeRun) -> TermsMessage:
        """Return this camera's message for the current iteration of a run."""
        run.iteration += 1
        state, reduced, sigma_px = run.state, np.empty((6, 7)), float(run.state.sigma_px[self._index])
        pose, is_used, noise_px = (state.rotation, state.translation), self._index != run.left_out, np.nan
        weight_sum = compute_camera_terms(self._matches, 0, *pose, sigma_px, is_used, run.camera_state, reduced)
        if is_noise_estimated(run.iteration, len(run.schedule)):
            noise_px = estimate_camera_noise(self._matches, 0, run.camera_state)
        return TermsMessage.from_reduced(reduced, weight_sum, noise_px)

    def _run_iteration(self, runs: Sequence[_NodeRun], messages: Sequence[TermsMessage]) -> None:
        """Run one iteration of several runs."""
        messages = [message.to_single_precision() for message in messages] if self._is_compact else messages
        received = self._exchange(tuple(messages), (TermsMessage(np.zeros(27), 0.0, np.nan),) * len(messages))
        for run, by_camera in zip(runs, zip(*received, strict=True), strict=True):
            reduced = np.array([t.reduced for t in by_camera])
            weight_sums, noise = np.array([t.weight_sum for t in by_camera]), np.array([t.noise_px for t in by_camera])
            stepped, negligible = take_joint_step(
                run.state, reduced, weight_sums, noise, run.schedule, run.iteration, run.is_last
            )
            run.finished, run.weight_sums = not stepped, weight_sums
            if stepped:
                run.converged = negligible
                run.is_last = negligible or run.iteration == MAX_ITERATIONS
                update_depth_model(0, run.state.step, run.camera_state)

    def _make_results(self, runs: Sequence[_NodeRun]) -> list[AlignmentResult]:
        """Exchange the evaluations of each run's final pose, and return the results."""
        if not runs:
            return []
        own = tuple(run.evaluate(0, self._index) for run in runs)
        evaluations = self._exchange(own, (EvaluationMessage(0.0, 0.0, 0, 0, 0.0),) * len(own))
        return [run.make_result(by_camera) for run, *by_camera in zip(runs, *evaluations, strict=True)]

    # --- compact ---------------------------------------------------------------------------------------------------

    def _align_compact(self, starts: Sequence[AlignmentStart]) -> list[AlignmentResult]:
        """Compute this camera's own solution for each start, then the joint solution in a few iterations."""
        if not starts:
            return []
        jobs = [make_first_job(start, self.count) for start in starts]
        all_runs, messages = zip(*(self._solve_alone(job) for job in jobs), strict=True)
        self._run_iteration(all_runs, messages)
        own_weights = [run.weight_sums for run in all_runs]
        # Runs that reach the same pose are merged.
        runs: list[_NodeRun] = []
        run_indices = []
        for run in all_runs:
            k = next((k for k, other in enumerate(runs) if _is_same_pose(run.state, other.state)), len(runs))
            runs += [run] if k == len(runs) else []
            run_indices.append(k)
        for count in range(2, MAX_ITERATIONS + 1):
            if not (active := [run for run in runs if not run.finished]):
                break
            for run in active:
                run.iteration += SKIPPED_ITERATIONS if count == FREEZE_ITERATION else 0
            self._run_iteration(active, [self._make_message(run) for run in active])
            for run in active:
                size = float(run.state.step @ run.state.information @ run.state.step)
                run.converged = not run.finished and (
                    run.converged or size < (STEP_TOLERANCE if count < COMPACT_ITERATIONS else COMPACT_TOLERANCE)
                )
                run.finished |= run.converged
        results = self._make_results(runs)
        first = [run_indices.index(k) for k in range(len(runs))]
        failed = [
            k
            for k, i in enumerate(first)
            if not results[k].converged or _has_lost_matches(own_weights[i], runs[k].weight_sums)
        ]
        for k, result in zip(failed, self.solve([jobs[first[k]] for k in failed]), strict=True):
            results[k] = result
        return [results[k] for k in run_indices]

    def _solve_alone(self, job: AlignmentJob) -> tuple[_NodeRun, TermsMessage]:
        """Return the run that starts from this camera's own solution, and its message about the common start."""
        stacked, schedule = self._matches, np.array(job.schedule, float)
        alone = AlignmentRun(job._replace(variance_inflation=np.ones(1)), stacked)
        camera_state, state = alone.camera_state, alone.state
        reduced, with_prior, difference = np.empty((1, 6, 7)), np.empty((1, 6, 7)), np.zeros(6)
        weight_sum, iteration, is_last = 0.0, 0, False
        prior = _prior_information(stacked.points)
        for iteration in range(1, MAX_ITERATIONS + 2):
            pose, sigma_px = (state.rotation, state.translation), float(state.sigma_px[0])
            weight_sum = compute_camera_terms(stacked, 0, *pose, sigma_px, True, camera_state, reduced[0])
            difference = _pose_difference(state.rotation, state.translation, job.rotation, job.translation)
            with_prior[0] = reduced[0] + np.column_stack([np.diag(prior), prior * difference])
            noise = np.array([estimate_camera_noise(stacked, 0, camera_state)])
            stepped, converged = take_joint_step(
                state, with_prior, np.array([weight_sum]), noise, schedule, iteration, is_last
            )
            if not stepped:
                break
            is_last = converged or iteration == MAX_ITERATIONS
            update_depth_model(0, state.step, camera_state)
        reduced[0, :, 6] -= reduced[0, :, :6] @ difference
        run = _NodeRun(job._replace(schedule=job.schedule[-1:]), stacked)
        run.camera_state, run.iteration = camera_state, 1
        # Its depth model is that of its own solution, from which steps are taken.
        for k in range(3):
            camera_state.gains[0, k, 6] -= camera_state.gains[0, k, :6] @ difference
        return run, TermsMessage.from_reduced(reduced[0], weight_sum, estimate_camera_noise(stacked, 0, camera_state))


def _prior_information(points: FloatArray) -> FloatArray:
    """Return (6,) prior information of (w, d) at the start, for a camera with these landmarks (n, 3)."""
    size = float(np.sqrt(np.mean(np.sum(points**2, axis=1)))) if len(points) else 1.0
    return np.repeat([PRIOR_ROTATION_SD, PRIOR_TRANSLATION_RATIO * max(size, 1e-12)], 3) ** -2.0


def _pose_difference(
    rotation: FloatArray, translation: FloatArray, from_rotation: FloatArray, from_translation: FloatArray
) -> FloatArray:
    """Return the (6,) difference (w, d) from one pose to another."""
    return np.concatenate(
        [Rotation.from_matrix(rotation @ from_rotation.T).as_rotvec(), translation - from_translation]
    )


def _has_lost_matches(own_weights: FloatArray, joint_weights: FloatArray) -> bool:
    """Return whether most cameras lost most of their matches, by the sums (C,) of their weights."""
    is_active = own_weights > 0.0
    return bool(is_active.any() and np.median(joint_weights[is_active] / own_weights[is_active]) < MIN_WEIGHT_RATIO)


def _is_same_pose(first: AlignmentState, second: AlignmentState) -> bool:
    difference = _pose_difference(first.rotation, first.translation, second.rotation, second.translation)
    return float(difference @ second.information @ difference) < SAME_POSE_DISTANCE
