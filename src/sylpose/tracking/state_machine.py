"""Tracking state machine: each frame passes through `initialize_tracking`, `track_frame` or `recover`.

Each is a function of the shared state and of the cameras' reports, and returns the new state. First a pose is searched
for. If one is accepted, the map is updated; otherwise the frame has no pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import MAX_FEATURES, Features
from sylpose.frames import FrameSet
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.results import FrameStatus
from sylpose.tracking import anchor_preparation
from sylpose.tracking.box_motion import count_center_features, is_box_center_static, select_static_matches
from sylpose.tracking.camera_motion_correction import add_nudge_faults, compensate_camera_motion
from sylpose.tracking.context import (
    MAX_REGION_MARGIN,
    REGION_MARGIN,
    Region,
    TrackerContext,
    collect_features,
    project_regions,
    split_by_region,
)
from sylpose.tracking.fallback_search import is_weakly_supported, search_with_all_features
from sylpose.tracking.frame import Frame, FrameMatches, find_background, match_frames
from sylpose.tracking.initialization import (
    FirstMotion,
    estimate_first_motion,
    estimate_jitter,
    is_ambiguous,
    is_continuing_motion,
)
from sylpose.tracking.joint_state import JointState
from sylpose.tracking.klt_frontend import MIN_TRACKED_RATIO, Anchor, TrackedFeatures
from sylpose.tracking.map_update import (
    accept_first_frame,
    accept_frame,
    estimate_first_points,
    handle_missing_object,
    update_from_matches,
)
from sylpose.tracking.motion_model import VelocityModel
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.pose_search import (
    PoseCandidate,
    detect_in_regions,
    is_fast,
    is_near_start,
    is_partly_visible,
    match_references,
    relocalize,
    solve_pose,
    track_from_anchor,
)
from sylpose.tracking.reports import quantize_positions
from sylpose.tracking.tracked_frame import TrackedFrame, create_unsolved_frame, wrap_unmatched_features
from sylpose.tracking.window import collect_refinement

__all__ = ["BufferedFrame", "finish_initialization", "initialize_tracking", "process_frame", "recover", "track_frame"]

# Without boxes the object is unknown until it moves: up to so many frames are buffered with their features (choice),
MAX_BUFFERED_FRAMES = 60
# and with their images up to so many bytes (choice).
MAX_BUFFERED_BYTES = 1 << 29
# A motion that is not fully observable (length of a translation, small rotation) is replaced by a later one with this
# median displacement, pixels, if possible (choice).
MIN_FIRST_MOTION_PX = 8.0
# A first motion with little support is accepted up to this rotation, radians (choice).
MAX_FIRST_ROTATION = np.radians(3.0)
# While depth is known from boxes only, the first so many frames are matched with the first one, then every
# `FIRST_MATCH_INTERVAL`th (choice).
N_FIRST_MATCHED, FIRST_MATCH_INTERVAL = 6, 4
AMBIGUITY_NOTE = (
    "Without boxes, the largest moving object is tracked, but another moved nearly as much. Provide a box or a mask "
    "to select the object."
)
# Low-contrast features are detected too where boxes have fewer features in their center than this, averaged over
# cameras: near the border most may be background (choice).
MIN_CENTER_FEATURES = 40
# Interval of frames in which large images are searched at full resolution for a lost object, which may be small
# (choice).
FULL_SEARCH_INTERVAL = 4
# Maximum number of features per camera while the object may be anywhere in the image (choice).
MAX_START_FEATURES = 4000


class BufferedFrame(NamedTuple):
    """A buffered frame before the first pose; its motion since the first buffered frame, if any."""

    frame: Frame
    frames: FrameSet
    motion: RigidTransform | None = None


def process_frame(
    context: TrackerContext, state: JointState, buffered: Sequence[BufferedFrame], number: int, frames: FrameSet
) -> tuple[JointState, Sequence[BufferedFrame], list[TrackedFrame]]:
    """Process the next frame in the current state; see `initialize_tracking`."""
    state, frames = compensate_camera_motion(context, state, frames)
    context.executor.map_cameras(lambda c: context.camera_trackers[c].begin_frame())
    state = collect_refinement(context, state, number)
    if state.last is None:
        state, buffered, decided = initialize_tracking(context, state, buffered, number, frames)
    else:
        state, tracked = (recover if state.n_missed else track_frame)(context, state, number, frames)
        buffered, decided = [], [tracked]
    return state, buffered, add_nudge_faults(context, state, decided)


# --- every frame but the first ones -----------------------------------------------------------------------------------


def track_frame(
    context: TrackerContext, state: JointState, number: int, frames: FrameSet
) -> tuple[JointState, TrackedFrame]:
    """Track an object that was found in the previous frame: near the prediction, else anywhere."""
    state = anchor_preparation.join_anchor(context, state, number)
    predicted_pose = state.predict_pose(frames.time)
    regions = project_regions(context, state, predicted_pose)
    klt_tracks, candidate, needs_anchor_soon = None, None, False
    if state.anchor is not None:
        klt_tracks, total, is_enough, needs_anchor_soon = track_from_anchor(
            context, state, frames, predicted_pose, regions
        )
        # The first motion is unknown: features that are tracked easily may be static.
        if is_enough and state.velocity.n_frames and not is_matched_with_first(state, number):
            frame = context.create_frame(number, frames, collect_features(context, klt_tracks))
            state, candidate = _find_pose(
                context, state, frame, predicted_pose, regions, klt_tracks, has_new_features=False
            )
            if candidate is not None and not candidate.n_matches > MIN_TRACKED_RATIO * total:
                candidate = None
    if candidate is None:
        frame = context.create_frame(
            number, frames, detect_in_regions(context, state, frames, predicted_pose, regions, klt_tracks)
        )
        state, candidate = _find_pose(context, state, frame, predicted_pose, regions, klt_tracks)
    if candidate is None or is_weakly_supported(context, state, candidate):
        state, fallback = _find_pose_by_fallback(context, state, number, frames, predicted_pose, regions)
        candidate = (
            fallback if fallback is not None or not _is_plausible(state, candidate, predicted_pose) else candidate
        )
    if candidate is None:
        state, candidate = _find_pose_anywhere(context, state, number, frames)
    if candidate is None:
        return handle_missing_object(context, state, frames, predicted_pose, regions)
    state, tracked = accept_frame(context, state, frames, candidate)
    if needs_anchor_soon and not candidate.has_new_features and anchor_preparation.can_prepare(state):
        state = anchor_preparation.begin_preparation(context, state, frames, candidate)
    return state, tracked


def _is_plausible(state: JointState, candidate: PoseCandidate | None, predicted_pose: RigidTransform) -> bool:
    """Return whether a weakly supported pose is plausible nevertheless.

    That is a very small first motion, or a slow object near its predicted pose.
    """
    if candidate is None:
        return False
    if not state.velocity.n_frames:
        return bool(candidate.motion.rotation.magnitude() < MAX_FIRST_ROTATION)
    return not is_fast(state, predicted_pose) and is_near_start(state, candidate, predicted_pose)


def recover(
    context: TrackerContext, state: JointState, number: int, frames: FrameSet
) -> tuple[JointState, TrackedFrame]:
    """Search for an object missed in the previous frame: near the prediction, else anywhere.

    A pose is accepted only if solving again from it confirms it.
    """
    predicted_pose = state.predict_pose(frames.time)
    regions: Sequence[Region] = [None] * len(context.rig)
    candidate = None
    if not state.is_lost or not state.velocity.n_frames:  # before its first motion it may be anywhere nearby
        regions = project_regions(
            context, state, predicted_pose, min(REGION_MARGIN * (1 + state.n_missed), MAX_REGION_MARGIN)
        )
        features = detect_in_regions(context, state, frames, predicted_pose, regions, None)
        state, near = _find_pose(
            context, state, context.create_frame(number, frames, features), predicted_pose, regions
        )
        if near is not None:
            pose = near.motion * state.last_frame.world_from_object
            state, candidate = _confirm_pose(context, state, number, frames, features, pose)
        if candidate is None:
            state, near = _find_pose_by_fallback(context, state, number, frames, predicted_pose, regions)
            if near is not None:
                pose = near.motion * state.last_frame.world_from_object
                features = collect_features(context, near.frame.cameras)
                state, candidate = _confirm_pose(context, state, number, frames, features, pose)
    if candidate is None:
        state, candidate = _find_pose_anywhere(context, state, number, frames)
    return (
        handle_missing_object(context, state, frames, predicted_pose, regions)
        if candidate is None
        else accept_frame(context, state, frames, candidate)
    )


def is_matched_with_first(state: JointState, number: int) -> bool:
    """Return whether a frame is matched with the first one even if enough features are tracked.

    Only matches with the first frame determine depth, and until depth is known a pose is uncertain.
    """
    age = number - state.keyframes[0].number
    # A motion that two cameras detect needs confirmation by the next frame.
    needs_confirmation = state.first_motion is not None
    return state.object.is_depth_guessed and (
        age <= N_FIRST_MATCHED or age % FIRST_MATCH_INTERVAL == 0 or needs_confirmation
    )


def _find_pose(
    context: TrackerContext,
    state: JointState,
    frame: Frame,
    guess: RigidTransform,
    regions: Sequence[Region],
    tracked: Sequence[TrackedFeatures] | None = None,
    *,
    has_new_features: bool = True,
) -> tuple[JointState, PoseCandidate | None]:
    """Search for the frame's pose near a guess."""
    matches = match_references(context, state, frame, guess, tracked, has_new_features=has_new_features)
    if state.object.is_bounded and not state.has_moved and is_box_center_static(context, state, frame, matches):
        # Something other than the object moves in the boxes.
        rest = select_static_matches(context, frame, matches)
        candidate = solve_pose(
            context,
            state,
            frame,
            rest,
            state.last_frame.world_from_object,
            regions,
            tracked,
            has_new_features=has_new_features,
        )
        return state, None if candidate is None else candidate.as_static()
    state, _, guess, pairs = update_from_matches(context, state, frame, matches, guess)
    candidate = solve_pose(context, state, frame, pairs, guess, regions, tracked, has_new_features=has_new_features)
    if candidate is not None and state.may_be_background(candidate.agreements):
        return replace(state, is_background_only=True), None
    return state, candidate.as_static() if candidate is not None and state.is_static(
        candidate.agreements
    ) else candidate


def _find_pose_by_fallback(
    context: TrackerContext,
    state: JointState,
    number: int,
    frames: FrameSet,
    predicted_pose: RigidTransform,
    regions: Sequence[Region],
) -> tuple[JointState, PoseCandidate | None]:
    """Search for the frame's pose with all features, by `fallback_search`."""
    frame = context.create_frame(number, frames, context.detect(frames, regions, faint=True))
    return search_with_all_features(context, state, frame, predicted_pose, regions)


def _find_pose_anywhere(
    context: TrackerContext, state: JointState, number: int, frames: FrameSet
) -> tuple[JointState, PoseCandidate | None]:
    """Search for the object in the whole images: by the strongest features, then by all."""
    reduced = (state.n_missed + 1) % FULL_SEARCH_INTERVAL != 0
    for faint in (False, True):
        features = context.detect(frames, None, MAX_FEATURES, faint=faint, reduced=reduced)
        pose = relocalize(context, state, context.create_frame(number, frames, features), faint=faint)
        if pose is not None:
            features = context.detect_at_full_res(frames, features, project_regions(context, state, pose), faint=faint)
            state, candidate = _confirm_pose(context, state, number, frames, features, pose)
            # If it was detected, but not well enough, wait for the next frame.
            if candidate is not None or state.n_reobserved:
                return state, candidate
    return state, None


def _confirm_pose(
    context: TrackerContext,
    state: JointState,
    number: int,
    frames: FrameSet,
    features: Sequence[Features],
    pose: RigidTransform,
) -> tuple[JointState, PoseCandidate | None]:
    """Solve the frame again from a relocalized pose, with features inside the object's region only."""
    regions = project_regions(context, state, pose)
    inside, _ = split_by_region(context, features, regions)
    state, candidate = _find_pose(context, state, context.create_frame(number, frames, inside), pose, regions)
    if candidate is None or not is_near_start(state, candidate, pose) or is_weakly_supported(context, state, candidate):
        return state, None
    if is_partly_visible(state, candidate):
        return replace(state, n_reobserved=state.n_reobserved + 1), None
    return state, candidate


# --- the first frames -------------------------------------------------------------------------------------------------


def initialize_tracking(
    context: TrackerContext, state: JointState, buffered: Sequence[BufferedFrame], number: int, frames: FrameSet
) -> tuple[JointState, list[BufferedFrame], list[TrackedFrame]]:
    """Process a frame before the first pose.

    With boxes, the object is what is visible in them; without, it is what moves.

    Returns:
        the state; the buffered frames; the decided frames.
    """
    model = state.object
    if model.center is not None:
        regions = project_regions(context, state, RigidTransform.from_translation(model.center))
        features = context.detect(frames, regions, MAX_FEATURES)
        n_center = sum(
            context.executor.all_gather(lambda c: count_center_features(context, c, features[c], regions[c]), 0)
        )
        state = replace(state, is_feature_poor=n_center < MIN_CENTER_FEATURES * len(context.rig))
        detected = context.detect(frames, regions, faint=True) if state.is_feature_poor else features
        if sum(context.executor.all_gather(lambda c: len(detected[c]), 0)) < MIN_MATCHES:
            detections = wrap_unmatched_features(context, detected)
            return (
                state,
                [],
                [
                    create_unsolved_frame(
                        context, frames, FrameStatus.TOO_FEW_MATCHES, detections, regions, model.radius
                    )
                ],
            )
        around = context.detect_surroundings(frames, regions, faint=state.is_feature_poor)
        frame = context.create_frame(number, frames, detected)
        state, first = accept_first_frame(context, state, frames, frame, around, model.center, regions)
        return state, [], [first]
    features = context.detect(frames, None, MAX_START_FEATURES, reduced=True)
    if not buffered and sum(context.executor.all_gather(lambda c: len(features[c]), 0)) < MIN_MATCHES:
        # Later frames need one to be compared with.
        return (
            state,
            [],
            [
                create_unsolved_frame(
                    context, frames, FrameStatus.TOO_FEW_MATCHES, wrap_unmatched_features(context, features)
                )
            ],
        )
    buffered = [*buffered, BufferedFrame(context.create_frame(number, frames, features), frames)]
    status = FrameStatus.NO_MOTION
    if len(buffered) > 1:
        pairs, initial_motion = _match_first_motion(context, buffered)
        is_full = len(buffered) > MAX_BUFFERED_FRAMES
        if initial_motion.is_significant:
            buffered[-1] = buffered[-1]._replace(motion=initial_motion.motion)
            is_clear = (
                initial_motion.is_observable or initial_motion.displacement_px > MIN_FIRST_MOTION_PX
            ) and is_continuing_motion(buffered[-2].motion, initial_motion.motion)
            initialized = (
                _initialize_from_motion(context, buffered, pairs, initial_motion) if is_clear or is_full else None
            )
            if initialized is not None:
                return replace(initialized[0], nudges=state.nudges), [], initialized[1]
        status = initial_motion.failure_status
    if len(buffered) <= MAX_BUFFERED_FRAMES:
        return state, _limit_memory(buffered), []
    # Motions since the dropped frame are no longer defined.
    remaining = [buffered_frame._replace(motion=None) for buffered_frame in buffered[1:]]
    return state, remaining, [_drop_buffered_frame(context, buffered[0], status)]


def _drop_buffered_frame(context: TrackerContext, frame: BufferedFrame, status: FrameStatus) -> TrackedFrame:
    return create_unsolved_frame(
        context, frame.frames, status, wrap_unmatched_features(context, collect_features(context, frame.frame.cameras))
    )


def finish_initialization(context: TrackerContext, buffered: Sequence[BufferedFrame]) -> list[TrackedFrame]:
    """Decide the frames buffered at the recording's end; a smaller motion is accepted now."""
    status = FrameStatus.NO_MOTION
    if len(buffered) > 1:
        pairs, initial_motion = _match_first_motion(context, buffered)
        initialized = (
            _initialize_from_motion(context, buffered, pairs, initial_motion) if initial_motion.is_significant else None
        )
        if initialized is not None:
            return initialized[1]
        status = initial_motion.failure_status
    return [_drop_buffered_frame(context, buffered_frame, status) for buffered_frame in buffered]


def _limit_memory(buffered: Sequence[BufferedFrame]) -> list[BufferedFrame]:
    """Drop images of buffered frames, oldest but the first, above the memory limit."""
    total = [
        sum(image.nbytes for image in buffered_frame.frames.images if image is not None) for buffered_frame in buffered
    ]
    total_bytes, limited = sum(total), list(buffered)
    for k in range(1, len(buffered)):
        if total_bytes <= MAX_BUFFERED_BYTES:
            break
        frames = buffered[k].frames
        limited[k] = buffered[k]._replace(frames=replace(frames, images=(None,) * len(frames.images)))
        total_bytes -= total[k]
    return limited


def _match_first_motion(
    context: TrackerContext, buffered: Sequence[BufferedFrame]
) -> tuple[list[list[FrameMatches]], FirstMotion]:
    """Match the last buffered frame with the first and estimate the motion."""
    first, current = buffered[0].frame, buffered[-1].frame

    def match_camera(c: int) -> list[FrameMatches]:
        pair = match_frames(first.number, first.cameras[c], current.cameras[c])
        return [pair] if len(pair) else []

    pairs = context.executor.map_cameras(match_camera, is_slow=True)
    return pairs, estimate_first_motion(context.executor, context.rig, pairs, first.number, context.create_rng())


def _initialize_from_motion(
    context: TrackerContext,
    buffered: Sequence[BufferedFrame],
    pairs: Sequence[Sequence[FrameMatches]],
    initial_motion: FirstMotion,
) -> tuple[JointState, list[TrackedFrame]] | None:
    """Initialize the object from the first motion and solve all buffered frames.

    The last frame is solved first; with the landmarks it provides, those between are solved in order.

    Args:
        pairs: per camera, local: matches of the last frame with the first.
        initial_motion: the motion between them.

    Returns:
        the state and the results; None if what moved was not a rigid body.
    """
    executor, rig, camera_trackers = context.executor, context.rig, context.camera_trackers
    (first, first_frames, _), *between = buffered
    first_pose = RigidTransform.from_translation(initial_motion.inlier_center)
    end_pose = initial_motion.motion * first_pose
    # If a second motion fits as well, depth depends on which one is true.
    model = ObjectModel(
        initial_motion.inlier_center, initial_motion.radius, is_depth_guessed=initial_motion.fit.alternative is not None
    )
    points = executor.all_gather(
        lambda c: quantize_positions(
            estimate_first_points(context, c, initial_motion.inliers[c], first_pose, end_pose), initial_motion.radius
        ),
        np.empty((0, 3)),
    )
    state = JointState(model.add_points(np.concatenate(points), context.seed))
    regions = project_regions(context, state, first_pose)

    def split_foreground(c: int) -> tuple[Features, Features]:
        """Split the first frame's features into object candidates and static or surrounding ones."""
        camera_tracker, features = camera_trackers[c], first.cameras[c].features
        for pair in pairs[c]:
            camera_tracker.update_noise(estimate_jitter(pair))
        is_static = np.zeros(len(features), bool)
        for pair in pairs[c]:
            still = find_background(
                pair,
                camera_tracker.create_frame(Features.empty()),
                camera_tracker.camera,
                first_pose,
                end_pose,
                initial_motion.radius,
            )
            is_static[pair.indices[still, 0]] = True
        return camera_tracker.split_foreground(
            first_frames.images[c], first_frames.masks[c], features, regions[c], is_static
        )

    features_by_side = executor.map_cameras(split_foreground)
    inside, around = (
        executor.map_cameras(lambda c: features_by_side[c][0]),
        executor.map_cameras(lambda c: features_by_side[c][1]),
    )
    frame = context.create_frame(first.number, first_frames, inside)
    state, tracked = accept_first_frame(
        context, state, first_frames, frame, around, initial_motion.inlier_center, regions
    )
    decided, start_frame, end_frame = [tracked], state.last_frame, between.pop()
    state, tracked = _solve_buffered_frame(context, state, end_frame, end_pose)
    if not (state.has_moved and tracked.pose.is_observed):
        # No rigid motion that lasted: wait for another one.
        executor.map_cameras(lambda c: camera_trackers[c].reset())
        return None
    end, last = state.last_frame, tracked
    # The velocity is unknown for the frames between.
    state = replace(state, last=start_frame, keyframes=(start_frame, end), anchor=None, velocity=VelocityModel())
    for buffered_frame in between:
        state, tracked = _solve_buffered_frame(
            context, state, buffered_frame, state.predict_pose(buffered_frame.frames.time)
        )
        decided.append(tracked)
    if end.number in state.known_frames:
        motion = end.world_from_object * state.last_frame.world_from_object.inv()
        state = state.add_solved_frame(end, motion, has_new_features=False)
        state = replace(state, keyframes=tuple(sorted(state.keyframes, key=lambda k: k.number)))
        if context.uses_klt:
            executor.map_cameras(lambda c: camera_trackers[c].set_anchor(end.number, end_frame.frames.images[c], None))
            state = replace(state, anchor=Anchor(end))
    else:  # one of them determined the depth: the end frame, based on guessed depth, was discarded
        state, last = _solve_buffered_frame(context, state, end_frame, state.predict_pose(end_frame.frames.time))
    if is_ambiguous(executor, rig, pairs, first.number, initial_motion, context.create_rng()):
        decided[0] = replace(decided[0], note=AMBIGUITY_NOTE)
    return state, [*decided, last]


def _solve_buffered_frame(
    context: TrackerContext, state: JointState, buffered_frame: BufferedFrame, pose: RigidTransform
) -> tuple[JointState, TrackedFrame]:
    """Solve a buffered frame from a guess of its pose (world_from_object).

    Its features cover the whole image: static surroundings would seem to belong to an object at rest.
    """
    regions = project_regions(context, state, pose)
    inside = context.detect_at_full_res(
        buffered_frame.frames, collect_features(context, buffered_frame.frame.cameras), regions
    )
    state, candidate = _find_pose(
        context, state, context.create_frame(buffered_frame.frame.number, buffered_frame.frames, inside), pose, regions
    )
    if candidate is None:
        return handle_missing_object(context, state, buffered_frame.frames, pose, regions)
    return accept_frame(context, state, buffered_frame.frames, candidate)
