"""Correction of camera motion: detected rotations are reported and images rotated back.

A camera whose background shows a rotation (`camera_motion_detection`) is ignored until two consecutive frames give the
same rotation. From then on its images are rotated back before any processing: its calibration and all landmarks stay
valid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.tracking.camera_executor import CameraExecutor
from sylpose.tracking.camera_motion_detection import PAUSE_FRAMES, View
from sylpose.tracking.context import REGION_MARGIN, TrackerContext
from sylpose.tracking.joint_state import JointState, Nudge
from sylpose.tracking.region import project_outline
from sylpose.tracking.reports import CameraMotionReport
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["add_nudge_faults", "compensate_camera_motion"]


def compensate_camera_motion(
    context: TrackerContext, state: JointState, frames: FrameSet
) -> tuple[JointState, FrameSet]:
    """Compensate camera rotations in the images and record newly confirmed ones.

    Images of cameras with an unconfirmed rotation are removed.

    Returns:
        the state; the images.
    """
    executor, n = context.executor, len(context.rig)
    stabilized = executor.map_cameras(
        lambda c: context.camera_trackers[c].motion_detector.stabilize(frames.images[c], frames.masks[c])
    )
    center, points = state.object.center, state.object.points
    if center is not None:
        points = points + center if state.last is None else state.predict_pose(frames.time).apply(points)

    def detect_motion(c: int) -> CameraMotionReport:
        def project_region() -> FloatArray | None:
            return project_outline(context.rig.cameras[c], points, REGION_MARGIN) if center is not None else None

        return context.camera_trackers[c].motion_detector.detect(stabilized[c][0], project_region, frames.index)

    reports = executor.all_gather(detect_motion, CameraMotionReport())
    rotated = [c for c, report in enumerate(reports) if report.angle > 0]
    if not rotated:
        return state, _replace_images(executor, frames, stabilized)
    # Motion in most cameras at once is that of the object, or of all cameras. With one camera the two cannot be
    # distinguished until the object's position is known.
    if sum(report.has_changed for report in reports) > max(n // 2, 1) or (n == 1 and center is None):
        executor.map_cameras(
            lambda c: context.camera_trackers[c].motion_detector.restart(PAUSE_FRAMES) if c in rotated else None
        )
        return state, _replace_images(executor, frames, stabilized)
    confirmed = [c for c in rotated if reports[c].is_confirmed]

    def correct_view(c: int) -> View:
        if c in confirmed:
            context.camera_trackers[c].motion_detector.apply_correction()
            return context.camera_trackers[c].motion_detector.stabilize(frames.images[c], frames.masks[c])
        return (None, None) if c in rotated else stabilized[c]

    nudges = tuple(Nudge(c, reports[c].first_frame, reports[c].rotation, reports[c].sd) for c in confirmed)
    return replace(state, nudges=(*state.nudges, *nudges)), _replace_images(
        executor, frames, executor.map_cameras(correct_view)
    )


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


def _replace_images(executor: CameraExecutor, frames: FrameSet, views: Sequence[View]) -> FrameSet:
    images, masks = executor.map_cameras(lambda c: views[c][0]), executor.map_cameras(lambda c: views[c][1])
    return replace(frames, images=tuple(images), masks=tuple(masks))
