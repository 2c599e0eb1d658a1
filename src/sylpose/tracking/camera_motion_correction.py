"""Correction of camera motion: detected rotations are reported and images rotated back.

A camera whose background shows a rotation (`camera_side.camera_motion`) is ignored until two consecutive frames give the
same rotation. From then on its images are rotated back before any processing: its calibration and all landmarks stay
valid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.frames import FrameSet
from sylpose.tracking.camera_side.camera_motion import PAUSE_FRAMES
from sylpose.tracking.context import TrackerContext
from sylpose.tracking.joint_side.joint_state import JointState, Nudge
from sylpose.tracking.reports import CameraMotionReport
from sylpose.tracking.tracked_frame import TrackedFrame


def compensate_camera_motion(
    context: TrackerContext, state: JointState, images: FrameSet
) -> tuple[JointState, FrameSet]:
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
            camera.motion_detector.restart(PAUSE_FRAMES)
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


def add_nudge_faults(context: TrackerContext, state: JointState, decided: Sequence[TrackedFrame]) -> list[TrackedFrame]:
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
