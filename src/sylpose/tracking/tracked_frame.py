"""Tracking result of one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.results import FramePose
from sylpose.status import FrameStatus
from sylpose.tracking.camera_side.frame import DetectedFeatures, LandmarkObservations
from sylpose.tracking.context import Frame, TrackerContext
from sylpose.tracking.joint_side.joint_state import Nudge


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Pose of one frame with the data behind it.

    Attributes:
        pose: the result.
        frames: the images used; images of a camera that was nudged are rotated back.
        matches: per camera (previous pixels (n, 2), current pixels (n, 2)) of the inliers against the last solved
            frame, or None.
        regions: per camera the searched outline (k, 2), pixels; None for the whole image or none of it.
        radius: of the object, length units; NaN while unknown.
        observations: per camera landmark observations, empty where the frame was not solved.
        time_offsets: (C,) seconds after `frames.time` at which each camera took its image.
        note: a remark on this frame, or "".
        nudges: camera rotations detected so far, in order of time; later images of those cameras are rotated back.
        detections: per camera its detected features; empty in the first frame.
        learned_pose: pose in the frame that a known object was learned in, which `observations` refer to; None if it
            equals `pose`.
    """

    pose: FramePose
    frames: FrameSet
    matches: tuple[tuple[FloatArray, FloatArray] | None, ...]
    regions: tuple[FloatArray | None, ...]
    radius: float
    observations: tuple[LandmarkObservations, ...] = ()
    time_offsets: FloatArray = field(default_factory=lambda: np.empty(0))
    note: str = ""
    nudges: tuple[Nudge, ...] = ()
    detections: tuple[DetectedFeatures, ...] = ()
    learned_pose: FramePose | None = None


def create_unsolved_frame(
    context: TrackerContext,
    frame: Frame,
    status: FrameStatus,
    detections: Sequence[DetectedFeatures],
    radius: float = np.nan,
    world_from_object: RigidTransform | None = None,
    covariance: FloatArray | None = None,
) -> TrackedFrame:
    """Create the result of a frame in which the object was not found.

    Args:
        detections: per camera, local: the detected features.
        world_from_object: predicted pose, if any.
        covariance: (6, 6) of (w, d), its uncertainty.
    """
    n, images = len(context.rig), frame.images
    own_counts = [np.array([len(own.features), len(own.rejected)]) for own in detections]
    features, matches = np.array(context.executor.gather(own_counts, np.zeros(2, np.int64))).T
    pose = FramePose(
        images.index,
        images.time,
        status,
        world_from_object,
        np.full((6, 6), np.nan) if covariance is None else covariance,
        np.zeros(n, np.int64),
        np.full(n, np.nan),
        matches=matches,
        reason=explain_missing_pose(status, int(features.sum()), int(matches.sum())),
    )
    regions = (None,) * n if frame.regions is None else context.spread(frame.regions)
    return TrackedFrame(pose, images, (None,) * n, regions, radius, detections=context.spread(detections))


def explain_missing_pose(status: FrameStatus, features: int, matches: int) -> str:
    """Explain why a frame has no pose, for users.

    Args:
        features: number of features examined, over all cameras.
        matches: number of those that match known landmarks.
    """
    if status is FrameStatus.BACKGROUND_ONLY:
        return "features that agree with a pose are static and never moved"
    if features < MIN_MATCHES:
        return f"{_format_count(features, 'feature')} in the search regions of all cameras"
    if status is FrameStatus.NO_MOTION:
        return f"{_format_count(features, 'feature')}, too few of which moved far enough"
    if status is FrameStatus.NOT_CONSISTENT:
        return f"{_format_count(features, 'feature')}; no rigid motion lasted long enough"
    if matches < MIN_MATCHES:
        return f"{matches} of {_format_count(features, 'feature')} match known landmarks"
    return (
        f"no pose fits enough of the {_format_count(matches, 'match', 'matches')} "
        f"among {_format_count(features, 'feature')}"
    )


def _format_count(number: int, singular: str, plural: str | None = None) -> str:
    """Format a count with its noun."""
    return f"{number} {singular if number == 1 else plural or singular + 's'}"
