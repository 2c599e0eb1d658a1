"""Conversion of a result of `estimate_pose` to a trajectory's pose."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import IntArray
from sylpose.results import FramePose, FrameStatus, Motion, Observability, Status

__all__ = ["make_frame_pose"]

_STATUS = {
    Status.OK: FrameStatus.LOCALIZED,
    Status.SCALE_NOT_OBSERVABLE: FrameStatus.LOCALIZED,
    Status.TOO_FEW_MATCHES: FrameStatus.TOO_FEW_MATCHES,
    Status.ROTATION_NOT_OBSERVABLE: FrameStatus.ROTATION_NOT_OBSERVABLE,
}


def make_frame_pose(estimate: Motion, index: int, time: float, matches: IntArray) -> FramePose:
    """Return the pose of one frame, with the covariance about the object's origin.

    Args:
        estimate: result of `estimate_pose`.
        index: of the frame.
        time: seconds.
        matches: (C,) number of points that each camera observes.
    """
    status = _STATUS.get(estimate.status, FrameStatus.NO_CONSISTENT_POSE)
    has_pose = estimate.motion is not None and status.has_pose
    center = RigidTransform.from_translation(np.nan_to_num(estimate.center))
    pose = FramePose(
        index,
        time,
        status,
        estimate.motion * center if estimate.motion is not None and has_pose else None,
        estimate.covariance if has_pose else np.full((6, 6), np.nan),
        estimate.n_inliers,
        estimate.residuals,
        Observability.NO_SCALE if estimate.status is Status.SCALE_NOT_OBSERVABLE else Observability.ALL,
        faults=estimate.faults,
        matches=matches,
        reason=""
        if status.has_pose
        else f"{matches.sum()} points observed; {estimate.status.text[0].lower()}{estimate.status.text[1:]}",
    )
    # Estimated about the points' centroid.
    return pose.in_object_frame(center).update_uncertain_status()
