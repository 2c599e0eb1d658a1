"""Cameras that are bumped into while they record: named, and their images turned back.

A camera whose background says that it was nudged (`watch`) is not heard until that is so in two frames in a row. From then
on its images are turned back before anything else sees them: the camera stands where its calibration says, and all that was
learnt before holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.tracking.camera_executor import Crew
from sylpose.tracking.camera_motion_detection import PAUSE, View
from sylpose.tracking.context import REGION_GROWTH, Team
from sylpose.tracking.joint_state import Joint, Nudge
from sylpose.tracking.region import region_polygon
from sylpose.tracking.reports import Stance
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["steadied", "with_nudges"]


def steadied(team: Team, joint: Joint, frames: FrameSet) -> tuple[Joint, FrameSet]:
    """The images as if no camera had been nudged, without those of cameras that seem to have been just now; and with the
    nudges that have become certain."""
    crew, n = team.crew, len(team.rig)
    seen = crew.each(lambda c: team.parts[c].watch.seen(frames.images[c], frames.masks[c]))
    center, points = joint.object.center, joint.object.points
    if center is not None:
        points = points + center if joint.last is None else joint.predicted(frames.time).apply(points)

    def look(c: int) -> Stance:
        def region() -> FloatArray | None:
            return region_polygon(team.rig.cameras[c], points, REGION_GROWTH) if center is not None else None

        return team.parts[c].watch.look(seen[c][0], region, frames.index)

    told = crew.ask(look, Stance())
    turned = [c for c, stance in enumerate(told) if stance.angle > 0]
    if not turned:
        return joint, _with(crew, frames, seen)
    # What moves in most cameras at once is the object, or all of them; of one alone nobody knows, until it is known where
    # the object is.
    if sum(stance.odd for stance in told) > max(n // 2, 1) or (n == 1 and center is None):
        crew.each(lambda c: team.parts[c].watch.forget(PAUSE) if c in turned else None)
        return joint, _with(crew, frames, seen)
    certain = [c for c in turned if told[c].certain]

    def heard(c: int) -> View:
        if c in certain:
            team.parts[c].watch.turn_back()
            return team.parts[c].watch.seen(frames.images[c], frames.masks[c])
        return (None, None) if c in turned else seen[c]

    found = tuple(Nudge(c, told[c].since, told[c].turn, told[c].sd) for c in certain)
    return replace(joint, nudges=(*joint.nudges, *found)), _with(crew, frames, crew.each(heard))


def with_nudges(team: Team, joint: Joint, decided: Sequence[TrackedFrame]) -> list[TrackedFrame]:
    """Frames with the nudges up to then as faults; what is not known of how a camera was turned is not known of the pose."""
    out = []
    for tracked in decided:
        before = [nudge for nudge in joint.nudges if nudge.frame <= tracked.pose.index]
        pose = tracked.pose
        for nudge in before:
            camera = team.rig.cameras[nudge.camera]
            covariance = pose.covariance
            if pose.world_from_object is not None:
                far = np.linalg.norm(pose.world_from_object.translation - camera.center)
                covariance = covariance + np.diag(np.repeat([nudge.sd**2, (nudge.sd * far) ** 2], 3))
            said = (
                f"camera {camera.name} was nudged at frame {nudge.frame}: the background turned by "
                f"{np.degrees(nudge.angle):.2g} degrees"
            )
            pose = replace(pose, covariance=covariance, faults=(*pose.faults, said))
        out.append(replace(tracked, pose=pose, nudges=tuple(before)) if before else tracked)
    return out


def _with(crew: Crew, frames: FrameSet, seen: Sequence[View]) -> FrameSet:
    images, masks = crew.each(lambda c: seen[c][0]), crew.each(lambda c: seen[c][1])
    return replace(frames, images=tuple(images), masks=tuple(masks))
