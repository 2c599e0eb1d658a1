"""Context of all tracking steps: the rig, this process's cameras, their exchange of reports, a frame and its result.

A list that is "per camera, local" has one entry for each camera of this process: all of the rig, or in a distributed
run one. A step is a loop over these cameras. What they have to share is gathered: then it has an entry for each camera
of the rig, and is identical on all of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol, TypeVar, cast

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import AlignmentResult, AlignmentStart, LandmarkMatches, align_locally
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.status import FrameStatus
from sylpose.tracking.camera_side.camera import CameraTracker, TrackedFeatures
from sylpose.tracking.camera_side.frame import (
    REGION_MARGIN,
    CameraFrame,
    CameraPairs,
    DetectedFeatures,
    LandmarkObservations,
    Region,
    drop_background,
    project_outline,
)
from sylpose.tracking.joint_side.joint_state import JointState, Nudge
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.search_clock import SearchClock

T = TypeVar("T")
# A pose and, per camera, local: (weights, residuals) of its observations.
Alignment = tuple[AlignmentResult, list[tuple[FloatArray, FloatArray]]]


class CameraExecutor(Protocol):
    """Interface between the local cameras and all others.

    Every participating camera runs the same program and calls these methods in the same order. So only results are
    sent, never requests.
    """

    @property
    def local(self) -> Sequence[int]:
        """Indices in the rig of the local cameras."""

    def run(self, function: Callable[..., T], *arguments: Iterable[object]) -> list[T]:
        """Run a function that takes milliseconds for each local camera, as `map`; cameras in one process in parallel.

        Args:
            function: uses and changes only that camera's data.
            arguments: each per camera, local.
        """

    def gather(self, reports: Sequence[T], default: T) -> list[T]:
        """Share the local cameras' reports with all cameras.

        Args:
            reports: per camera, local: `reports`, numbers or arrays.
            default: report of a camera without an image, also used in place of an excluded camera's.

        Returns:
            per camera, in the rig's order: the reports, identical on all cameras.
        """

    def align(self, observations: Sequence[LandmarkMatches], starts: Sequence[AlignmentStart]) -> list[Alignment]:
        """Estimate the pose that best fits all cameras' observations, from each start (`landmarks.alignment`).

        Args:
            observations: per camera, local: observations of landmarks.
            starts: initial poses.
        """


class LocalExecutor:
    """Executor for all cameras in one process, with worker threads."""

    def __init__(self, cameras: int, workers: int) -> None:
        self.local: Sequence[int] = range(cameras)
        self._n_helpers = min(workers, cameras) - 1  # besides the calling thread
        self._pool = ThreadPoolExecutor(max(self._n_helpers, 1), "camera")

    def close(self) -> None:
        """Shut down the worker threads."""
        self._pool.shutdown()

    def run(self, function: Callable[..., T], *arguments: Iterable[object]) -> list[T]:
        """See `CameraExecutor`."""
        calls = list(zip(*arguments, strict=False))
        results, errors = dict[int, T](), dict[int, BaseException]()
        remaining = iter(range(len(calls)))

        def work() -> None:
            for k in remaining:  # in order; each call is taken by one thread
                try:
                    results[k] = function(*calls[k])
                except BaseException as error:
                    errors[k] = error
                    deque(remaining, maxlen=0)  # no more calls begin

        helpers = [self._pool.submit(work) for _ in range(min(self._n_helpers, len(calls) - 1))]
        work()
        for helper in helpers:
            if not helper.cancel():  # it has begun
                helper.result()
        if errors:
            raise errors[min(errors)]
        return [results[k] for k in range(len(calls))]

    def gather(self, reports: Sequence[T], default: T) -> list[T]:  # noqa: ARG002
        """See `CameraExecutor`."""
        return list(reports)

    def align(self, observations: Sequence[LandmarkMatches], starts: Sequence[AlignmentStart]) -> list[Alignment]:
        """See `CameraExecutor`."""
        aligned = align_locally(observations, starts)
        return [(one, list(zip(one.weights, one.residuals, strict=True))) for one in aligned]


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame whose pose is searched for.

    Attributes:
        number: frames are numbered consecutively.
        images: the images and masks.
        time_offsets: (C,) seconds after `time` at which each camera took its image.
        regions: per camera, local: search region; None: the whole images.
        cameras: per camera, local: its data; empty until features are detected.
        tracked: per camera, local: its tracked features, which come first; None without KLT.
        has_new_features: whether it has newly detected features, to be matched by descriptors.
    """

    number: int
    images: FrameSet
    time_offsets: FloatArray
    regions: Sequence[Region] | None = None
    cameras: Sequence[CameraFrame] = ()
    tracked: Sequence[TrackedFeatures] | None = None
    has_new_features: bool = True

    @property
    def time(self) -> float:
        """Seconds."""
        return self.images.time

    @property
    def features(self) -> list[Features]:
        """Features; per camera, local."""
        return [own.features for own in self.cameras]


def is_rival(ratio: float, n_cameras: int, options: TrackingOptions) -> bool:
    """Return whether a body with this share of the largest one's matches may be the object as well."""
    return ratio > (options.max_rival_ratio if n_cameras > 1 else options.max_rival_ratio_monocular)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A body that moves and might be the object.

    Attributes:
        first, last: indices of the frame sets between which its motion is known best, from the earliest one on.
        outlines: (C,) per camera its convex outline (k, 2) in the first of them, pixels; None where it is not seen.
        features: (C,) per camera its features (n, 2) in the first of them, pixels.
        displacements_px: (C,) their median displacement until the second one, pixels; NaN without any.
        n_matches: number of its matches, in all cameras and windows.
        rival_ratio: matches of the largest other body in the windows in which both move, as a share of its own there.
        later_ratio: matches of the largest other body in windows in which it does not move, as a share of its own.
        f_ratio: by which the cameras contradict each other, pooled over the recording; NaN if unknown.
        is_chosen: whether the user knows that it is the object.
    """

    first: int
    last: int
    outlines: tuple[Region, ...]
    features: tuple[FloatArray, ...]
    displacements_px: FloatArray
    n_matches: int
    rival_ratio: float
    later_ratio: float = 0.0
    f_ratio: float = np.nan
    is_chosen: bool = False

    def is_ambiguous(self, options: TrackingOptions) -> bool:
        """Return whether another body might be the object as well."""
        return is_rival(max(self.rival_ratio, self.later_ratio), len(self.outlines), options) and not self.is_chosen


@dataclass(frozen=True, eq=False)
class Context:
    """Fixed settings and components of one tracking run.

    Attributes:
        rig: C cameras.
        cameras: per camera, local: its state and feature detection.
        executor: connects the cameras.
        method: of `frame_solvers`.
        uses_klt: whether features are tracked by KLT between anchor frames.
        refines_window: whether recent frames are refined jointly during tracking (`window`).
        time_offsets: (C,) seconds by which each camera's images are later than its time stamps.
        seed: random seed of outlier rejection.
        options: limits and sizes.
        candidate: the body to be tracked; None: with boxes, or the largest one.
        f_ratio: by which the cameras contradict each other in what was searched in advance; NaN if unknown.
        search_clock: limits the time of searches during live tracking; None: results do not depend on time.
    """

    rig: Rig
    cameras: Sequence[CameraTracker]
    executor: CameraExecutor
    method: str
    uses_klt: bool
    refines_window: bool
    time_offsets: FloatArray
    seed: int
    options: TrackingOptions = field(default_factory=TrackingOptions)
    candidate: Candidate | None = None
    f_ratio: float = np.nan
    search_clock: SearchClock | None = None

    @property
    def is_contradicted(self) -> bool:
        """Whether the cameras contradict each other in most of what was searched: then the rig is wrong in all frames."""
        return self.f_ratio > self.options.max_pooled_f_ratio

    def share_of_search(self, kind: str) -> float:
        """Return the share of a search's pixels for which there is time. See `SearchClock.share`."""
        return 1.0 if self.search_clock is None else self.search_clock.share(kind)

    def has_time_for(self, kind: str) -> bool:
        """Return whether there is time for a search that cannot be shortened."""
        return self.search_clock is None or self.search_clock.share(kind, 1.0) >= 1.0

    def measure_search(self, kind: str, share: float) -> AbstractContextManager[None]:
        """Measure a search during live tracking. See `SearchClock.measure`."""
        return nullcontext() if self.search_clock is None else self.search_clock.measure(kind, share)

    def create_rng(self) -> np.random.Generator:
        """Create a random generator that gives each frame the same sequence."""
        return np.random.default_rng(self.seed)

    def spread(self, values: Iterable[T]) -> tuple[T, ...]:
        """Return per camera of the rig the local cameras' values; None stands for those of the others."""
        by_index = dict(zip(self.executor.local, values, strict=True))
        return tuple(cast(T, by_index.get(c)) for c in range(len(self.rig)))

    def with_features(self, frame: Frame, features: Sequence[Features]) -> Frame:
        """Return a frame with each local camera's features."""
        own = [camera.create_frame(found) for camera, found in zip(self.cameras, features, strict=True)]
        return replace(frame, cameras=own)

    def create_frame(self, number: int, images: FrameSet) -> Frame:
        """Create a frame from its images, without features."""
        times = [images.time if time is None else time for time in images.times]
        return Frame(number, images, np.array(times) - images.time + self.time_offsets)

    def project_regions(self, state: JointState, world_from_object: RigidTransform) -> list[Region]:
        """Project the object at a pose into each camera.

        Returns:
            per camera, local: its region; None if out of view.
        """
        points = world_from_object.apply(state.object.points)
        return [project_outline(camera.camera, points, REGION_MARGIN) for camera in self.cameras]

    def object_radius_px(self, state: JointState, world_from_object: RigidTransform) -> list[float]:
        """Return per camera of the rig the object's radius in its image at a pose, pixels."""
        center = world_from_object.translation
        depths = [max(float(camera.camera_from_world.apply(center)[2]), 1e-12) for camera in self.rig]
        return [state.object.radius / depth * camera.focal for camera, depth in zip(self.rig, depths, strict=True)]

    def detect(
        self, frame: Frame, max_features: int | None = None, *, faint: bool, max_pixels: int | None = None
    ) -> list[Features]:
        """Detect features in a frame's regions; per camera, local. See `CameraTracker.detect`."""
        assert frame.regions is not None
        max_features = max_features or self.options.max_features
        settings: dict[str, Any] = {"max_features": max_features, "faint": faint, "max_pixels": max_pixels}
        detect_in = partial(CameraTracker.detect_in, images=frame.images, **settings)
        return self.executor.run(detect_in, self.cameras, frame.regions)

    def detect_everywhere(
        self, images: FrameSet, max_features: int, *, faint: bool = False, max_pixels: int | None
    ) -> list[Features]:
        """Detect features in the whole images; per camera, local. See `CameraTracker.detect`."""
        views = [camera.view_of(images) for camera in self.cameras]
        detect_all = partial(
            CameraTracker.detect, area=None, max_features=max_features, faint=faint, max_pixels=max_pixels
        )
        return self.executor.run(detect_all, self.cameras, views)

    def drop_static_matches(
        self, state: JointState, frame: Frame, pairs: CameraPairs, predicted_pose: RigidTransform
    ) -> CameraPairs:
        """Remove matches that are background according to the predicted motion; per camera, local.

        Args:
            predicted_pose: predicted world_from_object.
        """
        motion = state.motion_to(predicted_pose)
        return [
            drop_background(own, current, camera.camera, motion)
            for camera, own, current in zip(self.cameras, pairs, frame.cameras, strict=True)
        ]


# --- result of a frame ------------------------------------------------------------------------------------------------


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


# The state after a frame, and the frame's result.
FrameResult = tuple[JointState, TrackedFrame]


def create_unsolved_frame(
    context: Context,
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
