"""Map update: accept a frame's pose and update landmarks, background and model with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.matches import STATIC_PX
from sylpose.relative_pose.observability import classify_observability
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.results import FramePose, FrameStatus, Observability, Status
from sylpose.tracking.context import Region, TrackerContext
from sylpose.tracking.frame import (
    DetectedFeatures,
    Frame,
    FrameMatches,
    SolvedFrame,
    collect_detected_features,
    mark_others_as_background,
    triangulate,
)
from sylpose.tracking.initialization import FirstMotion, estimate_first_motion, is_continuing_motion
from sylpose.tracking.joint_state import JointState, add_reference_covariance
from sylpose.tracking.keyframes import compute_viewpoints
from sylpose.tracking.klt_frontend import Anchor
from sylpose.tracking.observations import compute_full_weight_age
from sylpose.tracking.pose_search import PoseCandidate, drop_static_matches
from sylpose.tracking.reobserved import ReobservedFeatures
from sylpose.tracking.reports import expand_ages, quantize_positions
from sylpose.tracking.tracked_frame import (
    LandmarkObservations,
    TrackedFrame,
    create_unsolved_frame,
    record_observations,
    select_shown_matches,
)
from sylpose.tracking.window import enlarge_covariance, is_refinement_due, refine_window

__all__ = [
    "accept_first_frame",
    "accept_frame",
    "estimate_first_points",
    "find_muted_cameras",
    "handle_missing_object",
    "triangulate_inliers",
    "update_from_matches",
]

# A single camera cannot distinguish a rotation from its mirror image, concave from convex. An object in a box is
# assumed convex: the middle of its surface is nearer than its center by this share of its radius (choice).
CONVEX_BULGE_RATIO = 0.5
# A camera is rejected as a whole if at most this share of its matches are inliers, while in another camera at least
# this share are (choice).
MAX_REJECTED_INLIER_RATIO, MIN_INLIER_RATIO_OTHERS = 0.2, 0.5
# A camera whose variance inflation exceeds this does not update landmarks in that frame (choice).
MAX_UPDATE_INFLATION = 30.0
# Relative error of a rotation while all depths are guesses (choice).
MIRROR_ERROR_RATIO = 0.5
# Minimum number of points that describe an object's surface (choice).
MIN_SURFACE_POINTS = 20


def accept_first_frame(
    context: TrackerContext,
    state: JointState,
    frames: FrameSet,
    frame: Frame,
    background_features: Sequence[Features],
    center: FloatArray,
    regions: Sequence[Region],
) -> tuple[JointState, TrackedFrame]:
    """Accept the frame whose pose defines the object's frame.

    Args:
        background_features: per camera, local: features around the object.
        center: (3,) of the object, world.
        regions: per camera, local: outlines of the object.

    Returns:
        the state; the result.
    """
    executor, camera_trackers, model = context.executor, context.camera_trackers, state.object
    pose = RigidTransform.from_translation(center)
    is_visible = np.array(executor.all_gather(lambda c: len(frame.cameras[c].features) > 0, False))
    first = SolvedFrame(
        frame.number,
        frame.time,
        frame.time_offsets,
        pose,
        np.zeros((6, 6)),
        compute_viewpoints(context.rig, pose),
        is_visible,
    )
    bulge = CONVEX_BULGE_RATIO if model.is_bounded and len(context.rig) == 1 else 0.0

    def update_camera(c: int) -> None:
        camera_tracker, current = camera_trackers[c], frame.cameras[c]
        camera_tracker.initialize(frame.number, current, background_features[c], (frames.images[c], frames.masks[c]))
        camera_tracker.update_landmarks(
            current, camera_tracker.camera, pose, ReobservedFeatures.empty(), model.points, model.radius, bulge
        )

    executor.map_cameras(update_camera)
    state = state.set_first_frame(first)
    if context.uses_klt:
        executor.map_cameras(lambda c: camera_trackers[c].set_anchor(frame.number, frames.images[c], None))
        state = replace(state, anchor=Anchor(first))
    n = len(context.rig)
    no_inliers = np.zeros(n, np.int64), np.full(n, np.nan)
    result = FramePose(frames.index, frames.time, FrameStatus.FIRST, pose, first.covariance, *no_inliers)
    observations = executor.map_cameras(lambda c: record_observations([], frame.cameras[c]))
    return state, TrackedFrame(
        result, frames, (None,) * n, tuple(regions), model.radius, tuple(observations), frame.time_offsets
    )


def accept_frame(
    context: TrackerContext, state: JointState, frames: FrameSet, candidate: PoseCandidate
) -> tuple[JointState, TrackedFrame]:
    """Accept a solved frame: update landmarks, background, anchor and state.

    Args:
        candidate: the pose candidate.

    Returns:
        the state; the result.
    """
    executor, camera_trackers, last_frame, solution = (
        context.executor,
        context.camera_trackers,
        state.last_frame,
        candidate.solution,
    )
    # Landmarks of a rejected camera would agree with its own images, and it would be accepted again.
    variance_inflation = _compute_inflation(candidate)
    # Other cameras may see another object.
    has_matches = np.array([a.n_known_moved for a in candidate.agreements]) >= MIN_MATCHES
    # Nor are landmarks updated while all may still be background: they would follow a slowly moving object halfway.
    has_moved = state.is_motion_verified(candidate.agreements)
    is_muted = find_muted_cameras(variance_inflation, has_matches) | (not has_moved)
    cameras = executor.map_cameras(
        lambda c: camera_trackers[c].create_empty_frame() if is_muted[c] else candidate.frame.cameras[c]
    )
    frame = replace(candidate.frame, cameras=cameras)
    known_frames, radius = state.known_frames, state.object.radius
    pose = candidate.motion * last_frame.world_from_object
    is_static = solution.status is Status.NO_MOTION  # the pose and its error are those of the last frame
    covariance = last_frame.covariance if has_moved else state.keyframes[0].covariance
    if not is_static:
        correlation = _compute_rotation_continuity(state, candidate) if solution.is_biased else 0.0
        covariance = add_reference_covariance(
            solution.information, pose, candidate.agreements, known_frames, radius, correlation
        )
        if state.refined_covariance is not None and not state.n_missed:
            covariance = enlarge_covariance(covariance, state.refined_covariance)
    if not has_moved:
        covariance = covariance + _undetected_motion_covariance(context, pose, radius)
    if state.object.is_depth_guessed:
        # With all depths guessed, the mirrored rotation fits nearly as well.
        rotation = (pose.rotation * state.keyframes[0].world_from_object.rotation.inv()).magnitude()
        covariance = covariance + np.diag(np.repeat([(MIRROR_ERROR_RATIO * rotation) ** 2, 0.0], 3))
    solved = SolvedFrame(
        frame.number,
        frame.time,
        frame.time_offsets,
        pose,
        covariance,
        compute_viewpoints(context.rig, pose),
        np.array([a.has_features for a in candidate.agreements]) & ~is_muted,
        compute_full_weight_age(expand_ages([a.ages for a in candidate.agreements])),
    )

    def collect_reobserved(c: int) -> ReobservedFeatures:
        if candidate.first_landmarks is not None:
            camera_trackers[c].table.update(candidate.first_landmarks[c])
        if is_muted[c]:
            return ReobservedFeatures.empty()
        if candidate.has_new_features:
            camera_trackers[c].learn_background(candidate.pairs[c], frame.cameras[c], pose, known_frames, radius)
        camera_trackers[c].update_noise(candidate.agreements[c].residual_px)
        return ReobservedFeatures.from_matches(
            candidate.pairs[c], solution.match_weights[c], frame.cameras[c].static_px, radius
        )

    reobserved = executor.map_cameras(collect_reobserved)
    model = state.object
    if not model.is_bounded:
        for surface in executor.all_gather(
            lambda c: quantize_positions(reobserved[c].surface_points, radius), np.empty((0, 3))
        ):
            model = model.add_points(surface, context.seed)
    status = FrameStatus.RELOCALIZED if state.n_missed else FrameStatus.TRACKED
    new_state = replace(state, object=model).add_solved_frame(
        solved, candidate.motion, has_new_features=candidate.has_new_features, agreements=candidate.agreements
    )
    # After relocalization little is known of the other features: the next frame is matched with the keyframes too.
    begins_anchor = candidate.has_new_features and context.uses_klt and status is FrameStatus.TRACKED
    if begins_anchor:
        # Right after the first frame, new features in the boxes are not tracked: they may be background.
        after_first = last_frame.number == state.keyframes[0].number
        new_state = replace(new_state, anchor=Anchor(solved, is_sparse=state.object.is_bounded and after_first))
    kept_numbers = set(new_state.known_frames)

    def update_camera(c: int) -> tuple[tuple[FloatArray, FloatArray] | None, LandmarkObservations, DetectedFeatures]:
        camera_tracker, current = camera_trackers[c], frame.cameras[c]
        tracked = None if candidate.tracked is None else candidate.tracked[c]
        camera_tracker.update_landmarks(current, candidate.rig.cameras[c], pose, reobserved[c], model.points, radius)
        if tracked is not None and not candidate.has_new_features:
            # Until the object has moved, disagreeing features may be the object's and the others background.
            is_judged = new_state.has_moved and not is_muted[c]
            weights = [w for w, _ in solution.match_weights[c]]
            camera_tracker.advance_anchor(
                tracked, candidate.pairs[c] if is_judged else [], weights if is_judged else []
            )
        camera_tracker.store_frame(frame.number, current, kept_numbers, (frames.images[c], frames.masks[c]))
        if begins_anchor:
            camera_tracker.set_anchor(frame.number, frames.images[c], None if is_muted[c] else tracked)
        before = None if tracked is None else tracked.previous_pixels
        detected = collect_detected_features(
            candidate.frame.cameras[c].features, candidate.pairs[c], [w for w, _ in solution.match_weights[c]]
        )
        return (
            select_shown_matches(reobserved[c].inliers, current, last_frame.number, before),
            record_observations(reobserved[c].inliers, current),
            detected,
        )

    updates = executor.map_cameras(update_camera, is_slow=candidate.has_new_features)
    if context.refines_window and is_refinement_due(new_state):
        new_state = refine_window(context, new_state)
    last = new_state.add_scale_uncertainty(new_state.last_frame)
    observable = Observability.NO_TRANSLATION_SCALE if new_state.path_scale_sd else Observability.ALL
    result = FramePose(
        frames.index,
        frames.time,
        status,
        last.world_from_object,
        last.covariance,
        np.array([a.n_inlier_features for a in candidate.agreements], np.int64),
        np.array([a.residual_px for a in candidate.agreements]),
        Observability.NO_SCALE if len(context.rig) == 1 else observable,
        variance_inflation,
        solution.faults,
        np.array([a.n_features for a in candidate.agreements], np.int64),
    )
    matches, landmark_observations = (
        executor.map_cameras(lambda c: updates[c][0]),
        executor.map_cameras(lambda c: updates[c][1]),
    )
    detections = executor.map_cameras(lambda c: updates[c][2])
    return replace(new_state, last=last), TrackedFrame(
        result.update_uncertain_status(),
        frames,
        tuple(matches),
        tuple(candidate.regions),
        model.radius,
        tuple(landmark_observations),
        frame.time_offsets,
        detections=tuple(detections),
    )


def find_muted_cameras(variance_inflation: FloatArray, has_matches: BoolArray) -> BoolArray:
    """Find cameras (C,) whose landmarks are not updated in a frame.

    If most cameras disagree it is unclear which are wrong, so none is muted. Otherwise the remaining one would confirm
    its own observations with false certainty.

    Args:
        variance_inflation: (C,) variance inflation as in `FramePose`.
        has_matches: (C,) which cameras have enough matches to be judged.
    """
    is_inflated = has_matches & (variance_inflation > MAX_UPDATE_INFLATION)
    is_majority = 2 * np.count_nonzero(is_inflated) > np.count_nonzero(has_matches)
    return np.zeros_like(is_inflated) if is_majority else is_inflated


def _undetected_motion_covariance(context: TrackerContext, pose: RigidTransform, radius: float) -> FloatArray:
    """Return the covariance (6, 6) of (w, d) of an undetected motion.

    It applies while most features may be background, so that only a static scene is established.
    """
    pixel_sizes = np.array(
        [camera.camera_from_world.apply(pose.translation)[2] / camera.focal for camera in context.rig]
    )
    translation = STATIC_PX * float(np.median(np.abs(pixel_sizes)))
    return np.diag(np.repeat([(translation / radius) ** 2, translation**2], 3))


def _compute_rotation_continuity(state: JointState, candidate: PoseCandidate) -> float:
    """Return the cosine between the axes of the total and the latest rotation; 0 if it reverses.

    A surface biases a rotation in proportion to its angle: errors accumulate while the object keeps rotating.
    """
    total = (
        state.last_frame.world_from_object.rotation * state.keyframes[0].world_from_object.rotation.inv()
    ).as_rotvec()
    step = candidate.motion.rotation.as_rotvec()
    lengths = float(np.linalg.norm(total) * np.linalg.norm(step))
    return max(0.0, float(total @ step) / lengths) if lengths > 0 else 0.0


def _compute_inflation(candidate: PoseCandidate) -> FloatArray:
    """Return the variance inflation (C,) as in `FramePose`; NaN for cameras with too few matches to judge."""
    shares = np.array([a.n_inlier_matches / max(a.n_matches, 1) for a in candidate.agreements])
    is_judged = np.array([a.n_matches for a in candidate.agreements]) >= MIN_MATCHES
    is_rejected = is_judged & (shares < MAX_REJECTED_INLIER_RATIO) & (shares.max() > MIN_INLIER_RATIO_OTHERS)
    return np.where(is_rejected, np.inf, np.where(is_judged, candidate.solution.variance_inflation, np.nan))


def handle_missing_object(
    context: TrackerContext,
    state: JointState,
    frames: FrameSet,
    predicted_pose: RigidTransform,
    regions: Sequence[Region],
) -> tuple[JointState, TrackedFrame]:
    """Handle a frame in which the object was not found.

    The pose is extrapolated until it becomes too uncertain. If only static features agreed with a pose, none is
    reported.

    Args:
        predicted_pose: predicted world_from_object.
        regions: search regions.

    Returns:
        the state; the result.
    """
    is_background_only = state.is_background_only
    state, covariance = state.coast(frames.time)
    detections, radius = (
        context.executor.map_cameras(lambda c: context.camera_trackers[c].detections),
        state.object.radius,
    )
    if is_background_only:
        return state, create_unsolved_frame(context, frames, FrameStatus.BACKGROUND_ONLY, detections, regions, radius)
    if state.is_lost:
        return state, create_unsolved_frame(context, frames, FrameStatus.LOST, detections, regions, radius)
    return state, create_unsolved_frame(
        context, frames, FrameStatus.COASTING, detections, regions, radius, predicted_pose, covariance
    )


def update_from_matches(
    context: TrackerContext,
    state: JointState,
    frame: Frame,
    pairs: Sequence[Sequence[FrameMatches]],
    guess: RigidTransform,
) -> tuple[JointState, RigidTransform | None, RigidTransform, Sequence[Sequence[FrameMatches]]]:
    """Update depth and motion from a frame's matches.

    Nothing is done unless depth is known from boxes only or the motion is unknown.

    Args:
        frame: not solved yet.
        pairs: per camera, local: its matches.
        guess: of its pose, world_from_object.

    Returns:
        the state; the pose estimated from the matches, or None; that pose or else the guess; per camera, local: the
        remaining matches, with frames that are still known and without background.
    """
    if not state.object.is_depth_guessed and state.velocity.n_frames:
        return state, None, guess, pairs
    was_guessed = state.object.is_depth_guessed
    state, initial_motion = _update_depth(context, state, frame, pairs)

    def drop_background(c: int) -> list[FrameMatches]:
        known = [pair for pair in pairs[c] if pair.reference in state.known_frames]
        return [pair.subset(~frame.cameras[c].background[pair.indices[:, 1]]) for pair in known]

    if initial_motion is None:
        return state, None, guess, context.executor.map_cameras(drop_background)
    pose = initial_motion.motion * state.keyframes[0].world_from_object
    is_depth_new = was_guessed and not state.object.is_depth_guessed
    if state.velocity.n_frames and not is_depth_new:
        return state, pose, pose, context.executor.map_cameras(drop_background)
    # The first motion that determines depth also separates the background: whatever does not take part, however much of
    # the boxes it fills. Static features near points where the object barely moves may agree with it, so only moving
    # features are kept. Other methods need every match.
    if not context.refines_window:
        return (
            state,
            pose,
            pose,
            drop_static_matches(context, state, frame, context.executor.map_cameras(drop_background), pose),
        )
    if state.object.is_bounded:
        # New features in the boxes may be background: the next frames decide.
        context.executor.map_cameras(lambda c: mark_others_as_background(initial_motion.inliers[c], frame.cameras[c]))
    return state, pose, pose, initial_motion.inliers


def _update_depth(
    context: TrackerContext, state: JointState, frame: Frame, pairs: Sequence[Sequence[FrameMatches]]
) -> tuple[JointState, FirstMotion | None]:
    """Replace depths guessed from boxes by those of a motion since the first frame.

    Boxes allow far more depth than the object has. Epipolar geometry needs no depth: its motion determines the surface,
    and the landmarks are reinitialized with it.

    Args:
        frame: not solved yet; background is marked in it.
        pairs: per camera, local: its matches.

    Returns:
        the state; the motion, or None. If depth is already known, only the motion is estimated.
    """
    executor, first = context.executor, state.keyframes[0]
    initial_motion = estimate_first_motion(executor, context.rig, pairs, first.number, context.create_rng())
    # Something may pass by behind the object.
    is_far = np.linalg.norm(initial_motion.inlier_center - first.world_from_object.translation) > state.object.radius
    if (
        not initial_motion.is_significant
        or initial_motion.fit.is_mixed
        or initial_motion.fit.alternative is not None
        or is_far
    ):
        return state, None
    first_pose, current_pose = first.world_from_object, initial_motion.motion * first.world_from_object

    def mark_background(c: int) -> None:
        """Mark static features as background: boxes may contain more background than object."""
        known = {first.number: first}
        context.camera_trackers[c].learn_background(
            [pair for pair in pairs[c] if pair.reference == first.number],
            frame.cameras[c],
            current_pose,
            known,
            initial_motion.radius,
        )

    executor.map_cameras(mark_background)
    accepted_statuses = (Status.OK,) if len(context.rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
    if classify_observability(initial_motion.fit, state.object.radius)[0].status not in accepted_statuses:
        return state, None
    # With two cameras a planar object has a second solution, which differs in each frame.
    if initial_motion.n_cameras == 2 and not is_continuing_motion(state.first_motion, initial_motion.motion):
        return replace(state, first_motion=initial_motion.motion), None
    if not state.object.is_depth_guessed:
        return state, initial_motion
    points = np.concatenate(
        executor.all_gather(
            lambda c: quantize_positions(
                triangulate_inliers(context, c, initial_motion.inliers[c], first_pose, current_pose),
                initial_motion.radius,
            ),
            np.empty((0, 3)),
        )
    )
    if len(points) < MIN_SURFACE_POINTS:
        return state, initial_motion
    state = state.reset_to_first_frame(initial_motion.radius)

    def reinitialize_camera(c: int) -> None:
        camera_tracker, camera = context.camera_trackers[c], context.rig.cameras[c]
        camera_tracker.table.update(
            camera_tracker.reinitialize_landmarks(first.number, camera, first_pose, points, initial_motion.radius)
        )

    executor.map_cameras(reinitialize_camera)
    return state, initial_motion


def estimate_first_points(
    context: TrackerContext,
    c: int,
    inliers: Sequence[FrameMatches],
    first_pose: RigidTransform,
    current_pose: RigidTransform,
) -> FloatArray:
    """Estimate positions (m, 3) of a camera's inliers on the object.

    If the motion determines too few depths, all are placed at the depth of the object's center.
    """
    points = triangulate_inliers(context, c, inliers, first_pose, current_pose)
    count = sum(map(len, inliers))
    if 2 * len(points) > count or not count:
        return points
    camera = context.rig.cameras[c]
    depth = camera.camera_from_world.apply(first_pose.translation)[2]
    rays = np.concatenate([np.column_stack([pair.normalized_i, np.ones(len(pair))]) for pair in inliers])
    return np.asarray(first_pose.inv().apply(camera.camera_from_world.inv().apply(depth * rays)))


def triangulate_inliers(
    context: TrackerContext,
    c: int,
    inliers: Sequence[FrameMatches],
    first_pose: RigidTransform,
    current_pose: RigidTransform,
) -> FloatArray:
    """Triangulate a camera's inliers on the object, (m, 3). See `frame.triangulate`."""
    points = [triangulate(pair, context.rig.cameras[c], first_pose, current_pose) for pair in inliers]
    return np.concatenate([np.empty((0, 3)), *points])
