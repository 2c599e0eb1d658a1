"""Tracking result of one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.results import FramePose, FrameStatus
from sylpose.tracking.context import TrackerContext
from sylpose.tracking.frame import CameraFrame, DetectedFeatures, FrameMatches, collect_detected_features
from sylpose.tracking.joint_state import Nudge

__all__ = [
    "LandmarkObservations",
    "TrackedFrame",
    "create_unsolved_frame",
    "explain_missing_pose",
    "record_observations",
    "select_shown_matches",
    "wrap_unmatched_features",
]


@dataclass(frozen=True, eq=False)
class LandmarkObservations:
    """One camera's landmark observations in one frame, input to the joint refinement of all poses.

    Attributes:
        landmark_ids: (n,) landmark numbers, unique per camera and object feature.
        normalized: (n, 2) undistorted normalized image points.
        positions: (n, 3) estimated landmark positions, object's frame.
        has_moved: (n,) whether the landmark is known to have moved with the object; otherwise it may be background.
    """

    landmark_ids: IntArray
    normalized: FloatArray
    positions: FloatArray
    has_moved: BoolArray


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


def select_shown_matches(
    inliers: Sequence[FrameMatches], current: CameraFrame, previous: int, previous_pixels: FloatArray | None
) -> tuple[FloatArray, FloatArray] | None:
    """Return one camera's inliers against the last solved frame, for `TrackedFrame.matches`.

    Args:
        inliers: matches with earlier frames that agree with the pose.
        current: the camera's current frame.
        previous: the last solved frame's number.
        previous_pixels: (m, 2) pixels of the first m features in that frame, if they were tracked by KLT.
    """
    if previous_pixels is not None:
        index = np.unique(np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in inliers)]))
        index = index[index < len(previous_pixels)]
        index = index[np.isfinite(previous_pixels[index]).all(axis=1)]
        return previous_pixels[index], current.features.pixels[index]
    with_previous = [pair for pair in inliers if pair.reference == previous]
    return (with_previous[0].pixels_i, with_previous[0].pixels_j) if with_previous else None


def record_observations(inliers: Sequence[FrameMatches], current: CameraFrame) -> LandmarkObservations:
    """Collect one camera's observations: inlier features and newly observed ones."""
    used = np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in inliers)])
    landmarks = current.landmarks
    index = np.union1d(used, np.flatnonzero(landmarks.n_observations == 1))
    return LandmarkObservations(
        landmarks.id[index], current.features.normalized[index], landmarks.mean[index], landmarks.has_moved[index]
    )


def wrap_unmatched_features(context: TrackerContext, features: Sequence[Features]) -> list[DetectedFeatures]:
    """Wrap features without matches as `DetectedFeatures`; per camera, local."""
    return context.executor.map_cameras(lambda c: collect_detected_features(features[c]))


def create_unsolved_frame(
    context: TrackerContext,
    frames: FrameSet,
    status: FrameStatus,
    detections: Sequence[DetectedFeatures],
    regions: Sequence[FloatArray | None] | None = None,
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
    n = len(frames.images)
    covariance = np.full((6, 6), np.nan) if covariance is None else covariance
    no_inliers = np.zeros(n, np.int64), np.full(n, np.nan)
    counts = context.executor.all_gather(
        lambda c: np.array([len(detections[c].features), len(detections[c].rejected)]), np.zeros(2, np.int64)
    )
    features, matches = np.array(counts).T
    pose = FramePose(
        frames.index,
        frames.time,
        status,
        world_from_object,
        covariance,
        *no_inliers,
        matches=matches,
        reason=explain_missing_pose(status, int(features.sum()), int(matches.sum())),
    )
    none = (None,) * n
    return TrackedFrame(pose, frames, none, tuple(regions or none), radius, detections=tuple(detections))


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
