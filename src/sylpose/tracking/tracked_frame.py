"""What the tracker says about each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import FrameSet
from sylpose.numerics.arrays import FloatArray, IntArray
from sylpose.results import FramePose, Status
from sylpose.tracking.frame import Pair, Reference
from sylpose.two_frames.fit import Fit

__all__ = ["Sightings", "TrackedFrame", "solved_frame", "unsolved_frame"]

Regions = Sequence[FloatArray | None]


@dataclass(frozen=True, eq=False)
class Sightings:
    """What one camera saw of the object in one frame: what a joint refinement of all poses needs.

    Attributes:
        landmark: (n,) numbers; the same feature of the object seen in several frames has the same one.
        normalized: (n, 2) where each was seen, undistorted.
        place: (n, 3) where it is on the object, as far as is known by then, object's frame.
    """

    landmark: IntArray
    normalized: FloatArray
    place: FloatArray


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame's pose and what it rests on.

    Attributes:
        pose: the result.
        frames: the images it was found in.
        matches: per camera (previous pixels (n, 2), current pixels (n, 2)) of the inliers against the last solved
            frame, or None.
        regions: per camera the outline (k, 2) that was searched, pixels; None for the whole image or none of it.
        radius: of the object, length units; NaN while unknown.
        sightings: per camera, empty where the frame was not solved.
        late: (C,) seconds after `frames.time` at which each camera saw it.
        note: a sentence, where there is something to be said of this frame.
    """

    pose: FramePose
    frames: FrameSet
    matches: tuple[tuple[FloatArray, FloatArray] | None, ...]
    regions: tuple[FloatArray | None, ...]
    radius: float
    sightings: tuple[Sightings, ...] = ()
    late: FloatArray = field(default_factory=lambda: np.empty(0))
    note: str = ""


def solved_frame(
    current: Reference,
    frames: FrameSet,
    status: Status,
    regions: Regions,
    radius: float,
    pairs: Sequence[Pair] = (),
    fit: Fit | None = None,
    base: Reference | None = None,
    before: Sequence[FloatArray] | None = None,
) -> TrackedFrame:
    """Of a frame with a pose.

    Args:
        pairs: its matches, weighted by the fit.
        base: the last solved frame.
        before: per camera (m, 2) where the first m features were in the last solved frame, if they were followed.
    """
    n = len(current.features)
    used: list[set[int]] = [set() for _ in range(n)]
    squares: list[FloatArray] = [np.empty(0)] * n
    shown: list[tuple[FloatArray, FloatArray] | None] = [None] * n
    for pair, w, r in zip(pairs, fit.weights if fit else (), fit.residuals if fit else (), strict=True):
        used[pair.camera].update(pair.indices[w > 0, 1].tolist())
        squares[pair.camera] = np.append(squares[pair.camera], r[w > 0] ** 2)
        if pair.reference is base:
            shown[pair.camera] = (pair.pixels_i[w > 0], pair.pixels_j[w > 0])
    if before is not None:
        for c, (then, u) in enumerate(zip(before, used, strict=True)):
            index = np.array(sorted(i for i in u if i < len(then)), np.int64)
            index = index[np.isfinite(then[index]).all(axis=1)]
            shown[c] = (then[index], current.features[c].pixels[index])
    if n == 1 and status is not Status.FIRST:
        status = Status.SCALE_NOT_OBSERVABLE
    pose = FramePose(
        frames.index,
        frames.time,
        status,
        current.world_from_object,
        current.covariance,
        np.array([len(u) for u in used], np.int64),
        np.array([np.sqrt(s.mean()) if len(s) else np.nan for s in squares]),
    )
    # What was used, and what was seen for the first time.
    sightings = []
    for features, landmarks, u in zip(current.features, current.landmarks, used, strict=True):
        index = np.union1d(np.array([*u], np.int64), np.flatnonzero(landmarks.seen == 1))
        sightings.append(Sightings(landmarks.id[index], features.normalized[index], landmarks.mean[index]))
    return TrackedFrame(pose, frames, tuple(shown), tuple(regions), radius, tuple(sightings), current.late)


def unsolved_frame(
    frames: FrameSet,
    status: Status,
    regions: Regions | None = None,
    radius: float = np.nan,
    world_from_object: RigidTransform | None = None,
    covariance: FloatArray | None = None,
) -> TrackedFrame:
    """Of a frame in which the object was not found; the pose is where it is thought to be, if anywhere."""
    n = len(frames.images)
    covariance = np.full((6, 6), np.nan) if covariance is None else covariance
    nothing = np.zeros(n, np.int64), np.full(n, np.nan)
    pose = FramePose(frames.index, frames.time, status, world_from_object, covariance, *nothing)
    return TrackedFrame(pose, frames, (None,) * n, tuple(regions or [None] * n), radius)
