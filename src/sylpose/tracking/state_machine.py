"""Tracking state machine: each frame passes through `initialize_tracking`, `track_frame` or `recover`.

Each is a function of the shared state and of the cameras' reports, and returns the new state. First a pose is searched
for. If one is accepted, the map is updated; otherwise the frame has no pose.

Before that, motion of the cameras is corrected. A camera whose background shows a rotation
(`camera_side.camera_motion`) is ignored until two consecutive frames give the same rotation. From then on its images
are rotated back before any processing: its calibration and all landmarks stay valid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.frames import FrameSet
from sylpose.tracking.anchor_preparation import begin_preparation, can_prepare, join_anchor
from sylpose.tracking.context import Context, Frame, FrameResult, TrackedFrame
from sylpose.tracking.initialization import BufferedFrame, initialize_tracking
from sylpose.tracking.joint_side.joint_state import MIN_TRACKED_RATIO, RETRY_FRAMES, JointState, Nudge
from sylpose.tracking.map_update import accept_frame, handle_missing_object
from sylpose.tracking.pose_search import (
    detect_in_regions,
    find_pose,
    is_weakly_supported,
    track_from_anchor,
)
from sylpose.tracking.relocalization import search_again, search_lost_object
from sylpose.tracking.reports import CameraMotionReport
from sylpose.tracking.window import apply_refinement


def process_frame(
    context: Context, state: JointState, buffered: Sequence[BufferedFrame], number: int, images: FrameSet
) -> tuple[JointState, Sequence[BufferedFrame], list[TrackedFrame]]:
    """Process the next frame in the current state; see `initialize_tracking`."""
    state, images = compensate_camera_motion(context, state, images)
    frame = context.create_frame(number, images)
    for camera in context.cameras:
        camera.begin_frame()
    # Results of background work.
    if state.is_refinement_ready(number, is_live=context.search_clock is not None):
        state = apply_refinement(context, state)
    if state.frames.is_next_anchor_due(number):
        state = join_anchor(context, state)
    if state.frames.last is None:
        state, buffered, decided = initialize_tracking(context, state, buffered, frame)
    else:
        state, tracked = (recover if state.motion.n_missed else track_frame)(context, state, frame)
        buffered, decided = [], [tracked]
    return state, buffered, add_nudge_faults(context, state, decided) if state.nudges else decided


# --- an object that was found in the previous frame -------------------------------------------------------------------


def track_frame(context: Context, state: JointState, frame: Frame) -> FrameResult:
    """Track an object that was found in the previous frame: near the prediction."""
    predicted_pose = state.predict_pose(frame.time)
    frame = replace(frame, regions=context.project_regions(state, predicted_pose))
    candidate, needs_anchor_soon = None, False
    if state.frames.anchor is not None:
        frame, n_tracked, is_enough, needs_anchor_soon = track_from_anchor(context, state, frame, predicted_pose)
        if is_enough:
            state, candidate = find_pose(context, state, frame, predicted_pose)
        if candidate is not None and (
            sum(a.n_inlier_matches for a in candidate.agreements) <= MIN_TRACKED_RATIO * n_tracked
            or is_weakly_supported(context, state, candidate)
        ):
            candidate = None
    if candidate is None:
        frame = detect_in_regions(context, state, frame, predicted_pose)
        state, candidate = find_pose(context, state, frame, predicted_pose)
    if candidate is None or is_weakly_supported(context, state, candidate):
        state, candidate = search_again(context, state, frame, predicted_pose, candidate)
    if candidate is None:
        return handle_missing_object(context, state, frame, predicted_pose)
    state, tracked = accept_frame(context, state, candidate)
    if needs_anchor_soon and not candidate.frame.has_new_features and can_prepare(state):
        state = begin_preparation(context, state, candidate)
    return state, tracked


# --- an object that was missed in the previous frame ------------------------------------------------------------------


def recover(context: Context, state: JointState, frame: Frame) -> FrameResult:
    """Search for an object missed in the previous frame, with bounded work (`relocalization`)."""
    predicted_pose = state.predict_pose(frame.time)
    state, candidate = search_lost_object(context, state, frame, predicted_pose)
    if candidate is None:
        return handle_missing_object(context, state, frame, predicted_pose)
    return accept_frame(context, state, candidate)


# --- motion of the cameras --------------------------------------------------------------------------------------------


def compensate_camera_motion(context: Context, state: JointState, images: FrameSet) -> tuple[JointState, FrameSet]:
    """Compensate camera rotations in the images and record newly confirmed ones.

    Images of cameras with an unconfirmed rotation are removed.

    Returns:
        the state; the images.
    """
    views = {camera.index: camera.motion_detector.stabilize(*camera.view_of(images)) for camera in context.cameras}
    center, points = state.object.center, state.object.points
    if center is not None:
        points = points + center if state.frames.last is None else state.predict_pose(images.time).apply(points)
    own_reports = [
        camera.motion_detector.detect(views[camera.index][0], None if center is None else points, images.index)
        for camera in context.cameras
    ]
    reports = context.executor.gather(own_reports, CameraMotionReport())
    rotated = [c for c, report in enumerate(reports) if np.linalg.norm(report.rotation) > 0]
    moving = [camera for camera in context.cameras if camera.index in rotated]
    # Motion in most cameras at once is that of the object, or of all cameras. With one camera the two cannot be
    # distinguished until the object's position is known.
    n_changed, n = sum(report.has_changed for report in reports), len(context.rig)
    if rotated and (n_changed > max(n // 2, 1) or (n == 1 and center is None)):
        for camera in moving:
            camera.motion_detector.restart(RETRY_FRAMES)
        rotated, moving = [], []
    for camera in moving:
        if reports[camera.index].is_confirmed:
            camera.motion_detector.apply_correction()
            views[camera.index] = camera.motion_detector.stabilize(*camera.view_of(images))
        else:
            views[camera.index] = (None, None)
    confirmed = [(c, reports[c]) for c in rotated if reports[c].is_confirmed]
    nudges = tuple(Nudge(c, report.first_frame, report.rotation, report.sd) for c, report in confirmed)
    corrected = replace(
        images,
        images=context.spread(image for image, _ in views.values()),
        masks=context.spread(mask for _, mask in views.values()),
    )
    return replace(state, nudges=(*state.nudges, *nudges)) if nudges else state, corrected


def add_nudge_faults(context: Context, state: JointState, decided: Sequence[TrackedFrame]) -> list[TrackedFrame]:
    """Add camera rotations up to each frame as faults, and their uncertainty to its pose."""
    out = []
    for tracked in decided:
        before = [nudge for nudge in state.nudges if nudge.frame <= tracked.pose.index]
        pose = tracked.pose
        for nudge in before:
            camera = context.rig.cameras[nudge.camera]
            covariance = pose.covariance
            if pose.world_from_object is not None:
                distance = np.linalg.norm(pose.world_from_object.translation - camera.center)
                covariance = covariance + np.diag(np.repeat([nudge.sd**2, (nudge.sd * distance) ** 2], 3))
            fault = (
                f"camera {camera.name} was nudged at frame {nudge.frame}: the background turned by "
                f"{np.degrees(nudge.angle):.2g} degrees"
            )
            pose = replace(pose, covariance=covariance, faults=(*pose.faults, fault))
        out.append(replace(tracked, pose=pose, nudges=tuple(before)) if before else tracked)
    return out
