"""A frame's pose as trajectories have it, of one that `estimate_pose` has found."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import IntArray
from sylpose.results import FramePose, FrameStatus, Motion, Observable, Status

__all__ = ["frame_pose"]

_STATUS = {
    Status.OK: FrameStatus.FOUND,
    Status.SCALE_NOT_OBSERVABLE: FrameStatus.FOUND,
    Status.TOO_FEW_MATCHES: FrameStatus.TOO_FEW_MATCHES,
    Status.TURN_NOT_OBSERVABLE: FrameStatus.NOT_OBSERVABLE,
}


def frame_pose(found: Motion, index: int, time: float, matches: IntArray) -> FramePose:
    """The pose of one frame, with the covariance about the object's origin.

    Args:
        found: of `estimate_pose`.
        index: of the frame; time: seconds.
        matches: (C,) points that each camera sees.
    """
    status = _STATUS.get(found.status, FrameStatus.NO_POSE)
    placed = found.motion is not None and status.has_pose
    center = RigidTransform.from_translation(np.nan_to_num(found.center))
    pose = FramePose(
        index,
        time,
        status,
        found.motion * center if found.motion is not None and placed else None,
        found.covariance if placed else np.full((6, 6), np.nan),
        found.n_inliers,
        found.residuals,
        Observable.NO_SCALE if found.status is Status.SCALE_NOT_OBSERVABLE else Observable.ALL,
        faults=found.faults,
        matches=matches,
        reason=""
        if status.has_pose
        else f"{matches.sum()} points seen; {found.status.text[0].lower()}{found.status.text[1:]}",
    )
    # Found about the middle of the points.
    return pose.of_frame(center).judged()
