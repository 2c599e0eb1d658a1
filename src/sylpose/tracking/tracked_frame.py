"""What the tracker says about each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.relative_pose.fit import MIN_MATCHES
from sylpose.results import FramePose, FrameStatus
from sylpose.tracking.context import Team
from sylpose.tracking.frame import CameraFrame, Pair, Sought, sought_in
from sylpose.tracking.joint_state import Nudge

__all__ = ["Sightings", "TrackedFrame", "looks", "shown", "sightings", "unsolved_frame", "why_none"]


@dataclass(frozen=True, eq=False)
class Sightings:
    """What one camera saw of the object in one frame: what a joint refinement of all poses needs.

    Attributes:
        landmark: (n,) numbers; the same feature of the object seen in several frames by this camera has the same one.
        normalized: (n, 2) where each was seen, undistorted.
        place: (n, 3) where it is on the object, as far as is known by then, object's frame.
        moved: (n,) whether it is known by then to have moved with the object: else it may be background.
    """

    landmark: IntArray
    normalized: FloatArray
    place: FloatArray
    moved: BoolArray


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame's pose and what it rests on.

    Attributes:
        pose: the result.
        frames: the images it was found in, those of a camera that was nudged turned back.
        matches: per camera (previous pixels (n, 2), current pixels (n, 2)) of the inliers against the last solved
            frame, or None.
        regions: per camera the outline (k, 2) that was searched, pixels; None for the whole image or none of it.
        radius: of the object, length units; NaN while unknown.
        sightings: per camera, empty where the frame was not solved.
        late: (C,) seconds after `frames.time` at which each camera saw it.
        note: a sentence, where there is something to be said of this frame.
        nudges: of cameras up to now, in order of time; from each on that camera's images are turned back.
        sought: per camera what it looked at; empty in the first frame.
        learnt: of an object that is known from another take, the pose of the frame that it was learnt in, which
            `sightings` are told in; None: the same.
    """

    pose: FramePose
    frames: FrameSet
    matches: tuple[tuple[FloatArray, FloatArray] | None, ...]
    regions: tuple[FloatArray | None, ...]
    radius: float
    sightings: tuple[Sightings, ...] = ()
    late: FloatArray = field(default_factory=lambda: np.empty(0))
    note: str = ""
    nudges: tuple[Nudge, ...] = ()
    sought: tuple[Sought, ...] = ()
    learnt: FramePose | None = None


def shown(
    inliers: Sequence[Pair], current: CameraFrame, base: int, before: FloatArray | None
) -> tuple[FloatArray, FloatArray] | None:
    """One camera's inliers against the last solved frame, as `TrackedFrame.matches`.

    Args:
        base: the last solved frame's number.
        before: (m, 2) where the first m features were in it, if they were followed.
    """
    if before is not None:
        index = np.unique(np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in inliers)]))
        index = index[index < len(before)]
        index = index[np.isfinite(before[index]).all(axis=1)]
        return before[index], current.features.pixels[index]
    with_base = [pair for pair in inliers if pair.reference == base]
    return (with_base[0].pixels_i, with_base[0].pixels_j) if with_base else None


def sightings(inliers: Sequence[Pair], current: CameraFrame) -> Sightings:
    """One camera's features that were used, and those that were seen for the first time."""
    used = np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in inliers)])
    landmarks = current.landmarks
    index = np.union1d(used, np.flatnonzero(landmarks.seen == 1))
    return Sightings(
        landmarks.id[index], current.features.normalized[index], landmarks.mean[index], landmarks.moved[index]
    )


def looks(team: Team, features: Sequence[Features]) -> list[Sought]:
    """By camera, each its own: features that are compared with none."""
    return team.crew.each(lambda c: sought_in(features[c]))


def unsolved_frame(
    team: Team,
    frames: FrameSet,
    status: FrameStatus,
    sought: Sequence[Sought],
    regions: Sequence[FloatArray | None] | None = None,
    radius: float = np.nan,
    world_from_object: RigidTransform | None = None,
    covariance: FloatArray | None = None,
) -> TrackedFrame:
    """Of a frame in which the object was not found; the pose is where it is thought to be, if anywhere.

    Args:
        sought: by camera, each its own: what it looked at.
    """
    n = len(frames.images)
    covariance = np.full((6, 6), np.nan) if covariance is None else covariance
    nothing = np.zeros(n, np.int64), np.full(n, np.nan)
    told = team.crew.ask(lambda c: np.array([len(sought[c].features), len(sought[c].rejected)]), np.zeros(2, np.int64))
    features, matches = np.array(told).T
    pose = FramePose(
        frames.index,
        frames.time,
        status,
        world_from_object,
        covariance,
        *nothing,
        matches=matches,
        reason=why_none(status, int(features.sum()), int(matches.sum())),
    )
    none = (None,) * n
    return TrackedFrame(pose, frames, none, tuple(regions or none), radius, sought=tuple(sought))


def why_none(status: FrameStatus, features: int, matches: int) -> str:
    """Why a frame has no pose, for people, by how many features were looked at and how many of them match what is known of
    the object, in all cameras together."""
    if status is FrameStatus.ONLY_STILL:
        return "what agrees with a pose stands still and was never seen to move"
    if features < MIN_MATCHES:
        return f"{_counted(features, 'feature')} where it was looked for, in all cameras together"
    if status is FrameStatus.NO_MOTION:
        return f"{_counted(features, 'feature')}, too few of which moved, or by too little"
    if status is FrameStatus.NOT_CONSISTENT:
        return f"{_counted(features, 'feature')}; what moved was no rigid body, or not for long"
    if matches < MIN_MATCHES:
        return f"{matches} of {_counted(features, 'feature')} match what is known of the object"
    return f"no pose agrees with enough of the {_counted(matches, 'match', 'matches')} among {_counted(features, 'feature')}"


def _counted(number: int, one: str, many: str | None = None) -> str:
    """A number of things."""
    return f"{number} {one if number == 1 else many or one + 's'}"
