"""Map update: accept a frame's pose and update landmarks, background and model with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.camera_parameters import MEAN_DEPTH_RADII
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import enlarge_covariance, invert_information
from sylpose.relative_pose.camera_evidence import (
    EXPECTED_RATIO,
    MIN_KEPT_POOLED,
    MIN_POOLED,
    compute_f_ratio,
    pool_f_ratios,
)
from sylpose.relative_pose.irls import MAX_REJECTED_SHARE
from sylpose.relative_pose.limits import MOST
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.results import FramePose
from sylpose.status import DOUBTFUL, FrameStatus, Observability
from sylpose.tracking.box_motion import OUTSIDE_REASON, bound_pose, is_mostly_outside
from sylpose.tracking.camera_side.camera import AcceptedPose, CameraTracker
from sylpose.tracking.camera_side.frame import ReobservedFeatures, compute_full_weight_age, record_observations
from sylpose.tracking.context import Context, Frame, FrameResult, TrackedFrame, create_unsolved_frame
from sylpose.tracking.frame_solvers import MAXIMUM_LIKELIHOOD
from sylpose.tracking.joint_side.joint_state import (
    Anchor,
    JointState,
    SolvedFrame,
    add_reference_covariance,
    compute_pose_change,
    compute_viewpoints,
)
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.pose_search import PoseCandidate
from sylpose.tracking.reports import Agreements, quantize_positions
from sylpose.tracking.window import refine_window


def accept_first_frame(
    context: Context, state: JointState, frame: Frame, around: Sequence[Features], center: FloatArray
) -> FrameResult:
    """Accept the frame whose pose defines the object's frame.

    Args:
        frame: with features and regions of the object.
        around: per camera, local: features around the object.
        center: (3,) of the object, world.

    Returns:
        the state; the result.
    """
    assert frame.regions is not None
    model, n = state.object, len(context.rig)
    pose = RigidTransform.from_translation(center)
    is_visible = np.array(context.executor.gather([len(found) > 0 for found in frame.features], False))
    viewpoints = compute_viewpoints(context.rig, pose)
    first = SolvedFrame(frame.number, frame.time, frame.time_offsets, pose, np.zeros((6, 6)), viewpoints, is_visible)
    # A single camera cannot distinguish a rotation from its mirror image, concave from convex: an object in a box is
    # assumed convex.
    bulge = MEAN_DEPTH_RADII if model.is_bounded and n == 1 else 0.0
    for camera, current, background in zip(context.cameras, frame.cameras, around, strict=True):
        camera.initialize(first, current, background, frame.images)
        camera.update_landmarks(current, camera.camera, pose, ReobservedFeatures.empty(), model, bulge)
        if context.uses_klt:
            camera.set_anchor(first.number, frame.images, None)
    anchor = Anchor(first) if context.uses_klt else None
    state = replace(state, frames=replace(state.frames, last=first, keyframes=(first,), anchor=anchor))
    result = FramePose(
        frame.images.index,
        frame.time,
        FrameStatus.FIRST,
        pose,
        first.covariance,
        np.zeros(n, np.int64),
        np.full(n, np.nan),
    )
    return state, TrackedFrame(
        result,
        frame.images,
        (None,) * n,
        context.spread(frame.regions),
        model.radius,
        context.spread(record_observations([], current) for current in frame.cameras),
        frame.time_offsets,
    )


def accept_frame(context: Context, state: JointState, candidate: PoseCandidate) -> FrameResult:
    """Accept a solved frame: update landmarks, background, anchor and state.

    Args:
        candidate: the pose candidate.

    Returns:
        the state; the result.
    """
    frame, agreements = candidate.frame, candidate.agreements
    moves_first = candidate.has_moved and not state.motion.has_moved
    if moves_first and state.object.is_bounded and is_mostly_outside(context, state, frame, candidate.pose):
        state = replace(state, ambiguity=OUTSIDE_REASON)
    inflation, f_ratio = _compute_inflation(candidate), measure_f_ratio(agreements)
    state, pooled, n_pooled = _pool_evidence(context, state, agreements)
    accepted = _accept_pose(context, state, candidate)
    # Each camera: features that were observed before.
    reobserved = [
        camera.collect_reobserved(own, accepted) for camera, own in zip(context.cameras, candidate.cameras, strict=True)
    ]
    model = state.object
    if not model.is_bounded:
        points = [quantize_positions(own.surface_points, model.radius) for own in reobserved]
        for surface in context.executor.gather(points, np.empty((0, 3))):
            model = model.add_points(surface, context.seed)
    # All cameras: the next state.
    status = FrameStatus.RELOCALIZED if state.motion.n_missed else FrameStatus.TRACKED
    new_state = replace(state, object=model).add_solved_frame(
        accepted.solved,
        candidate.motion,
        context.options,
        has_new_features=frame.has_new_features,
        agreements=agreements,
    )
    # After relocalization little is known of the other features: the next frame is matched with the keyframes too.
    is_known = status is FrameStatus.TRACKED and not accepted.is_uncertain
    begins_anchor = frame.has_new_features and context.uses_klt and is_known
    if begins_anchor:
        # Right after the first frame, new features in the boxes are not tracked: they may be background.
        is_sparse = model.is_bounded and state.last.number == state.frames.first.number
        anchor = Anchor(accepted.solved, is_sparse=is_sparse)
        new_state = replace(new_state, frames=replace(new_state.frames, anchor=anchor))
    # Each camera: landmarks and anchor.
    kept = set(new_state.frames.by_number)
    update = partial(CameraTracker.update_map, accepted=accepted, model=model, kept=kept, begins_anchor=begins_anchor)
    records = context.executor.run(update, context.cameras, candidate.cameras, reobserved)
    if context.refines_window and not accepted.is_uncertain and new_state.is_refinement_due(context.options):
        new_state = refine_window(context, new_state)
    last = new_state.last
    observable = Observability.NO_TRANSLATION_SCALE if new_state.refinement.rests_on_prior else Observability.ALL
    result = FramePose(
        frame.images.index,
        frame.time,
        status,
        last.world_from_object,
        # Disagreement of the cameras shows errors of the rig that residuals do not (Birge).
        last.covariance * np.fmax(1.0, pooled),
        np.array([a.n_inlier_features for a in agreements], np.int64),
        np.array([a.residual_px for a in agreements]),
        Observability.NO_SCALE if len(context.rig) == 1 else observable,
        inflation,
        candidate.solution.faults,
        np.array([a.n_features for a in agreements], np.int64),
        f_ratio=pooled,
    ).mark_uncertain()
    is_rig_contradicted = _is_rig_contradicted(context, state)
    is_mostly = pooled > context.options.max_pooled_f_ratio
    if state.ambiguity and not is_rig_contradicted:  # under a wrong rig one body looks like several
        result = replace(result, status=FrameStatus.AMBIGUOUS, reason=state.ambiguity)
    elif accepted.solved.is_contradicted or is_mostly or is_rig_contradicted:
        reason = _describe_contradiction(context, state, f_ratio, pooled, n_pooled)
        result = replace(result, status=FrameStatus.CONTRADICTED, reason=reason)
    new_state = replace(new_state, is_unreliable=result.status in DOUBTFUL)
    matches, observations, detections = (context.spread(parts) for parts in zip(*records, strict=True))
    parts = matches, context.spread(frame.regions or ()), model.radius, observations, frame.time_offsets
    return new_state, TrackedFrame(result, frame.images, *parts, detections=detections)


def _pool_evidence(context: Context, state: JointState, agreements: Agreements) -> tuple[JointState, float, int]:
    """Add the F ratio of a pose.

    Where the object was found again it may be found wrongly, whatever the frames before show: those since then count on
    their own as well.

    Returns:
        the state; the pooled ratio, NaN if unknown; the number of ratios that it is of.
    """
    f_ratio = measure_f_ratio(agreements, MIN_KEPT_POOLED)
    known = add_f_ratio(state.f_ratios, f_ratio, context.options)
    n_before = 0 if state.motion.n_missed else state.n_new_f_ratios
    n_new = min(n_before + (not np.isnan(f_ratio)), len(known))
    new = known[len(known) - n_new :]
    # Two cameras need more: right after the object was found its landmarks are least known, and no camera can be left out.
    pooled = new if len(context.rig) >= MIN_KEPT_POOLED and pool_known(new) > pool_known(known) else known
    return replace(state, f_ratios=known, n_new_f_ratios=n_new), pool_known(pooled), len(pooled)


def _describe_contradiction(context: Context, state: JointState, f_ratio: float, pooled: float, n_pooled: int) -> str:
    """Describe why a frame with an F ratio, its own and the one pooled over so many frames, is contradicted."""
    if _is_rig_contradicted(context, state):
        return "in most of the recording the cameras see different motions"
    limit = context.options.max_f_ratio
    if f_ratio > limit:
        return f"the cameras see different motions (F ratio {f_ratio:.0f}; the limit is {limit:.0f})"
    if pooled > context.options.max_pooled_f_ratio:
        return f"in most of the last {n_pooled} frames with evidence the cameras see different motions"
    return "tracked from frames in which the cameras see different motions"


def _accept_pose(context: Context, state: JointState, candidate: PoseCandidate) -> AcceptedPose:
    """Accept a pose, with its covariance and the evidence against it."""
    agreements, pose, frame = candidate.agreements, candidate.pose, candidate.frame
    rotation_sd = np.sqrt(np.diag(invert_information(candidate.solution.information))[:3].max())
    # Except at the start with a known object, nothing is learned from poses of a missing object until one is certain, or
    # until enough frames show whether the cameras agree.
    n_uncertain = 0 if state.motion.n_missed else state.last.n_uncertain
    is_found_again = state.motion.n_missed > 0 or 0 < n_uncertain < MIN_POOLED
    is_rough = rotation_sd > context.options.max_relocalized_rotation_sd
    is_uncertain = bool(is_found_again and is_rough and not state.last.is_fixed)
    solved = SolvedFrame(
        frame.number,
        frame.time,
        frame.time_offsets,
        pose,
        _compute_covariance(context, state, candidate),
        compute_viewpoints(context.rig, pose),
        np.array([a.has_features for a in agreements]) & (candidate.has_moved and not is_uncertain),
        compute_full_weight_age([a.ages for a in agreements]),
        is_contradicted=is_contradicted(agreements, state.frames.by_number, state.last, context.options),
        n_uncertain=n_uncertain + 1 if is_uncertain else 0,
        twist=candidate.twist,
    )
    return AcceptedPose(
        solved,
        frame.images,
        candidate.rig,
        state.motion_to(pose),
        state.last.number,
        agreements,
        candidate.has_moved,
        is_uncertain,
        frame.has_new_features,
    )


def _is_rig_contradicted(context: Context, state: JointState) -> bool:
    """Return whether the cameras contradict each other in most of the recording, which was searched in advance.

    That is known of all that moves, of a camera that was nudged or of other bodies as well, and replaced by what the
    frames that were tracked show of the object: at once if three cameras agree on it, as they do not with a wrong rig. In
    boxes most of these frames have to, since an arm may cross them; without boxes all, since what is tracked may be another
    body, which two of the cameras see.
    """
    if context.method not in MAXIMUM_LIKELIHOOD or not context.is_contradicted:
        return False
    known = np.array(state.f_ratios)
    agree = False
    if len(context.rig) >= MIN_KEPT_POOLED and len(known) >= MIN_POOLED:
        agree = (pool_f_ratios(known) if state.object.is_bounded else known.max()) < EXPECTED_RATIO
    return not agree and len(known) < context.options.n_pooled_f_ratios


def _compute_covariance(context: Context, state: JointState, candidate: PoseCandidate) -> FloatArray:
    """Return the covariance (6, 6) of (w, d) of a candidate's pose."""
    solution, pose, radius, first = candidate.solution, candidate.pose, state.object.radius, state.frames.first
    if state.object.is_depth_guessed:
        known = state.motion.independent_pose or bound_pose(context, state, 0.0 if solution.is_static else np.nan)
        # The guess biases the pose: its difference from what is known independently of it may be the guess's error.
        error = compute_pose_change(known.world_from_object, pose)
        return first.covariance + known.covariance + np.outer(error, error)
    if solution.is_static:  # the pose and its error are those of the last frame
        covariance = state.last.covariance if candidate.has_moved else first.covariance
    else:
        correlation = _compute_rotation_continuity(state, candidate) if solution.is_biased else 0.0
        covariance = add_reference_covariance(
            solution.information,
            pose,
            candidate.agreements,
            state.frames.by_number,
            radius,
            correlation,
        )
        if state.refinement.covariance is not None and not state.motion.n_missed:
            covariance = enlarge_covariance(covariance, state.refinement.covariance)
    if not candidate.has_moved:
        covariance = covariance + bound_pose(context, state).covariance
    return covariance


def is_contradicted(
    agreements: Agreements, known_frames: Mapping[int, SolvedFrame], last: SolvedFrame, options: TrackingOptions
) -> bool:
    """Return whether the cameras contradict a pose, or those of all earlier frames that support it.

    A pose is as reliable as the earlier frames that the evidence connects it with. Where fewer than two cameras have
    evidence, as for an object that rests, it is as reliable as the last one.
    """
    if measure_f_ratio(agreements) > options.max_f_ratio:
        return True
    numbers = [a.evidence_reference for a in agreements if np.isfinite(a.evidence.excess)]
    if len(numbers) < 2:
        return last.is_contradicted
    return sum(not known_frames[number].is_contradicted for number in numbers if number in known_frames) < 2


def add_f_ratio(f_ratios: tuple[float, ...], f_ratio: float, options: TrackingOptions) -> tuple[float, ...]:
    """Return the last known F ratios with that of one more frame, if it is known."""
    return f_ratios if np.isnan(f_ratio) else (*f_ratios, f_ratio)[-options.n_pooled_f_ratios :]


def pool_known(f_ratios: tuple[float, ...]) -> float:
    """Return the pooled ratio of known F ratios; NaN of too few."""
    return float(pool_f_ratios(np.array(f_ratios))) if len(f_ratios) >= MIN_POOLED else np.nan


def measure_f_ratio(agreements: Agreements, min_kept: int = 2) -> float:
    """Return the F ratio of a pose; NaN without evidence.

    Where the object hardly moves as seen from a camera, its matches are no evidence, but agree: it has no excess. Any two
    cameras nearly agree: where more are needed and no other follows their motion, that is no evidence for it.
    """
    excess = np.array([agreement.evidence.excess for agreement in agreements])
    counts = np.array([(agreement.n_inlier_matches, agreement.n_matches) for agreement in agreements])
    agrees = (counts[:, 0] >= MIN_MATCHES) & (counts[:, 0] > MOST * counts[:, 1])
    evidence, n_silent = np.sort(excess[~np.isnan(excess)]), int(np.count_nonzero(agrees & np.isnan(excess)))
    n_known = len(evidence) + n_silent
    if n_known < min(min_kept, len(agreements)):
        return np.nan
    kept = evidence[:-1] if n_known > min_kept else evidence
    if not len(kept):
        return np.nan
    # Only as many as are needed: more of them would dilute the others' excess.
    n_added = max(0, min(n_silent, min_kept - len(kept)))
    return float(compute_f_ratio(np.append(kept, np.zeros(n_added)), len(agreements)))


def _compute_rotation_continuity(state: JointState, candidate: PoseCandidate) -> float:
    """Return the cosine between the axes of the total and the latest rotation; 0 if it reverses.

    A surface biases a rotation in proportion to its angle: errors accumulate while the object keeps rotating.
    """
    first, last = state.frames.first.world_from_object, state.last.world_from_object
    total = (last.rotation * first.rotation.inv()).as_rotvec()
    step = candidate.motion.rotation.as_rotvec()
    lengths = float(np.linalg.norm(total) * np.linalg.norm(step))
    return max(0.0, float(total @ step) / lengths) if lengths > 0 else 0.0


def _compute_inflation(candidate: PoseCandidate) -> FloatArray:
    """Return the variance inflation (C,) as in `FramePose`; NaN for cameras with too few matches to judge."""
    shares = np.array([a.n_inlier_matches / max(a.n_matches, 1) for a in candidate.agreements])
    is_judged = np.array([a.n_matches for a in candidate.agreements]) >= MIN_MATCHES
    is_rejected = is_judged & (shares < MAX_REJECTED_SHARE) & (shares.max() > MOST)
    return np.where(is_rejected, np.inf, np.where(is_judged, candidate.solution.variance_inflation, np.nan))


def handle_missing_object(
    context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> FrameResult:
    """Handle a frame in which the object was not found.

    The pose is extrapolated until it becomes too uncertain. None is reported if only static features agreed with one, or if
    the last one is not to be relied on.

    Args:
        frame: with its search regions.
        predicted_pose: predicted world_from_object.

    Returns:
        the state; the result.
    """
    is_background_only = state.motion.is_background_only
    state, covariance = state.coast(frame.time, context.options)
    detections, radius = [camera.detections for camera in context.cameras], state.object.radius
    if is_background_only or state.motion.is_lost or state.is_unreliable:
        status = FrameStatus.BACKGROUND_ONLY if is_background_only else FrameStatus.LOST
        return state, create_unsolved_frame(context, frame, status, detections, radius)
    coasting = FrameStatus.COASTING
    return state, create_unsolved_frame(context, frame, coasting, detections, radius, predicted_pose, covariance)
