"""Tracking state machine: each frame passes through `initialize_tracking`, `track_frame` or `recover`.

Each is a function of the shared state and of the cameras' reports, and returns the new state. First a pose is searched
for. If one is accepted, the map is updated; otherwise the frame has no pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import MAX_FEATURES, Features
from sylpose.frames import FrameSet
from sylpose.tracking.anchor_preparation import begin_preparation, can_prepare, join_anchor
from sylpose.tracking.camera_motion_correction import add_nudge_faults, compensate_camera_motion
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.camera_side.region import REGION_MARGIN
from sylpose.tracking.context import (
    Frame,
    TrackerContext,
    create_frame,
    detect,
    detect_everywhere,
    project_regions,
)
from sylpose.tracking.fallback_search import search_with_all_features
from sylpose.tracking.initialization import BufferedFrame, initialize_tracking
from sylpose.tracking.joint_side.joint_state import JointState
from sylpose.tracking.joint_side.keyframes import MIN_TRACKED_RATIO
from sylpose.tracking.map_update import accept_frame, handle_missing_object
from sylpose.tracking.pose_search import (
    PoseCandidate,
    detect_in_regions,
    find_pose,
    is_fast,
    is_near_start,
    is_partly_visible,
    is_weakly_supported,
    relocalize,
    track_from_anchor,
)
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.window import apply_refinement

# A first motion with little support is accepted up to this rotation, radians (choice).
MAX_FIRST_ROTATION = np.radians(3.0)
# While depth is known from boxes only, the first so many frames are matched with the first one, then every
# `FIRST_MATCH_INTERVAL`th (choice).
N_FIRST_MATCHED, FIRST_MATCH_INTERVAL = 6, 4
# Interval of frames in which large images are searched at full resolution for a lost object, which may be small
# (choice).
FULL_SEARCH_INTERVAL = 4
# The margin of the search region grows while the object is lost, up to this share of its size (choice).
MAX_REGION_MARGIN = 1.0


def process_frame(
    context: TrackerContext, state: JointState, buffered: Sequence[BufferedFrame], number: int, images: FrameSet
) -> tuple[JointState, Sequence[BufferedFrame], list[TrackedFrame]]:
    """Process the next frame in the current state; see `initialize_tracking`."""
    state, images = compensate_camera_motion(context, state, images)
    for camera in context.cameras:
        camera.begin_frame()
    if state.is_refinement_ready(number):
        state = apply_refinement(context, state)
    frame = create_frame(context, number, images)
    if state.frames.last is None:
        state, buffered, decided = initialize_tracking(context, state, buffered, frame)
    else:
        state, tracked = (recover if state.motion.n_missed else track_frame)(context, state, frame)
        buffered, decided = [], [tracked]
    return state, buffered, add_nudge_faults(context, state, decided)


# --- an object that was found in the previous frame -------------------------------------------------------------------


def track_frame(context: TrackerContext, state: JointState, frame: Frame) -> tuple[JointState, TrackedFrame]:
    """Track an object that was found in the previous frame: near the prediction, else anywhere."""
    if state.frames.is_next_anchor_due(frame.number):
        state = join_anchor(context, state)
    predicted_pose = state.predict_pose(frame.time)
    frame = replace(frame, regions=project_regions(context, state, predicted_pose))
    candidate, needs_anchor_soon = None, False
    if state.frames.anchor is not None:
        frame, n_tracked, is_enough, needs_anchor_soon = track_from_anchor(context, state, frame, predicted_pose)
        # The first motion is unknown: features that are tracked easily may be static.
        if is_enough and state.motion.velocity.n_frames and not is_matched_with_first(state, frame.number):
            state, candidate = _find_pose_by_tracks(context, state, frame, predicted_pose, n_tracked)
    if candidate is None:
        frame = detect_in_regions(context, state, frame, predicted_pose)
        state, candidate = find_pose(context, state, frame, predicted_pose)
    if candidate is None or is_weakly_supported(context, state, candidate):
        state, fallback = _find_pose_by_fallback(context, state, frame, predicted_pose)
        if fallback is not None or not _is_plausible(state, candidate, predicted_pose):
            candidate = fallback
    if candidate is None:
        state, candidate = _find_pose_anywhere(context, state, frame)
    if candidate is None:
        return handle_missing_object(context, state, frame, predicted_pose)
    state, tracked = accept_frame(context, state, candidate)
    if needs_anchor_soon and not candidate.frame.has_new_features and can_prepare(state):
        state = begin_preparation(context, state, candidate)
    return state, tracked


def is_matched_with_first(state: JointState, number: int) -> bool:
    """Return whether a frame is matched with the first one even if enough features are tracked.

    Only matches with the first frame determine depth, and until depth is known a pose is uncertain.
    """
    age = number - state.frames.first.number
    # A motion that two cameras detect needs confirmation by the next frame.
    needs_confirmation = state.motion.first_motion is not None
    return state.object.is_depth_guessed and (
        age <= N_FIRST_MATCHED or age % FIRST_MATCH_INTERVAL == 0 or needs_confirmation
    )


def _find_pose_by_tracks(
    context: TrackerContext, state: JointState, frame: Frame, predicted_pose: RigidTransform, n_tracked: int
) -> tuple[JointState, PoseCandidate | None]:
    """Search for the pose by tracked features alone; None if too few of them agree with it."""
    assert frame.tracked is not None
    frame = context.with_features(replace(frame, has_new_features=False), [own.features for own in frame.tracked])
    state, candidate = find_pose(context, state, frame, predicted_pose)
    if candidate is None:
        return state, None
    n_inliers = sum(a.n_inlier_matches for a in candidate.agreements)
    return state, candidate if n_inliers > MIN_TRACKED_RATIO * n_tracked else None


def _is_plausible(state: JointState, candidate: PoseCandidate | None, predicted_pose: RigidTransform) -> bool:
    """Return whether a weakly supported pose is plausible nevertheless.

    That is a very small first motion, or a slow object near its predicted pose.
    """
    if candidate is None:
        return False
    if not state.motion.velocity.n_frames:
        return bool(candidate.motion.rotation.magnitude() < MAX_FIRST_ROTATION)
    return not is_fast(state, predicted_pose) and is_near_start(state, candidate, predicted_pose)


# --- an object that was missed in the previous frame ------------------------------------------------------------------


def recover(context: TrackerContext, state: JointState, frame: Frame) -> tuple[JointState, TrackedFrame]:
    """Search for an object missed in the previous frame: near the prediction, else anywhere.

    A pose is accepted only if solving again from it confirms it.
    """
    predicted_pose = state.predict_pose(frame.time)
    candidate = None
    if not state.motion.is_lost or not state.motion.velocity.n_frames:  # before its first motion it may be nearby
        margin = min(REGION_MARGIN * (1 + state.motion.n_missed), MAX_REGION_MARGIN)
        frame = replace(frame, regions=project_regions(context, state, predicted_pose, margin))
        current = detect_in_regions(context, state, frame, predicted_pose)
        state, near = find_pose(context, state, current, predicted_pose)
        if near is not None:
            state, candidate = _confirm_pose(context, state, frame, current.features, near.pose)
        if candidate is None:
            state, near = _find_pose_by_fallback(context, state, frame, predicted_pose)
            if near is not None:
                state, candidate = _confirm_pose(context, state, frame, near.frame.features, near.pose)
    if candidate is None:
        state, candidate = _find_pose_anywhere(context, state, frame)
    if candidate is None:
        return handle_missing_object(context, state, frame, predicted_pose)
    return accept_frame(context, state, candidate)


def _find_pose_by_fallback(
    context: TrackerContext, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> tuple[JointState, PoseCandidate | None]:
    """Search for the frame's pose with all features, by `fallback_search`."""
    frame = replace(frame, tracked=None, has_new_features=True)
    frame = context.with_features(frame, detect(context, frame, faint=True))
    return search_with_all_features(context, state, frame, predicted_pose)


def _find_pose_anywhere(
    context: TrackerContext, state: JointState, frame: Frame
) -> tuple[JointState, PoseCandidate | None]:
    """Search for the object in the whole images: by the strongest features, then by all."""
    reduced = (state.motion.n_missed + 1) % FULL_SEARCH_INTERVAL != 0
    for faint in (False, True):
        features = detect_everywhere(context, frame.images, MAX_FEATURES, faint=faint, reduced=reduced)
        pose = relocalize(context, state, context.with_features(frame, features), faint=faint)
        if pose is not None:
            regions = project_regions(context, state, pose)
            detect_inside = partial(CameraTracker.detect_at_full_res, images=frame.images, faint=faint)
            features = context.executor.run(detect_inside, context.cameras, features, regions)
            state, candidate = _confirm_pose(context, state, frame, features, pose)
            # If it was detected, but not well enough, wait for the next frame.
            if candidate is not None or state.motion.n_reobserved:
                return state, candidate
    return state, None


def _confirm_pose(
    context: TrackerContext, state: JointState, frame: Frame, features: Sequence[Features], pose: RigidTransform
) -> tuple[JointState, PoseCandidate | None]:
    """Solve the frame again from a relocalized pose, with features inside the object's region only."""
    regions = project_regions(context, state, pose)
    inside = [
        own.subset(camera.find_inside(own, region))
        for camera, own, region in zip(context.cameras, features, regions, strict=True)
    ]
    frame = context.with_features(replace(frame, regions=regions, tracked=None, has_new_features=True), inside)
    state, candidate = find_pose(context, state, frame, pose)
    if candidate is None or not is_near_start(state, candidate, pose) or is_weakly_supported(context, state, candidate):
        return state, None
    if is_partly_visible(state, candidate):
        return replace(state, motion=replace(state.motion, n_reobserved=state.motion.n_reobserved + 1)), None
    return state, candidate
