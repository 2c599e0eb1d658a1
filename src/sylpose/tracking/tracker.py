"""Tracker: the object's pose in every frame, against several earlier frames; its state, for cameras that join."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import NamedTuple, TypedDict, Unpack

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import UNNUMBERED, Box, FrameSet, check_frame_set
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import MAX_TIME_OFFSET, check_integer, check_number, check_type, format_value
from sylpose.input_limits import to_one_line
from sylpose.methods import FEATURES, METHODS, resolve_features
from sylpose.rig import Rig
from sylpose.tracking.bodies import WINDOW_FRAMES, compare_cameras, find_candidates, select_windows
from sylpose.tracking.camera_side.camera import CameraTracker, create_anchor
from sylpose.tracking.camera_side.frame import CameraFrame
from sylpose.tracking.context import CameraExecutor, Candidate, Context, Frame, LocalExecutor, TrackedFrame
from sylpose.tracking.initialization import (
    MAX_BUFFERED_BYTES,
    BufferedFrame,
    finish_initialization,
)
from sylpose.tracking.joint_side.joint_state import JointState, SolvedFrame
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.known_object import (
    KnownObject,
    TransferredObject,
    build_known_object,
    initialize_from_object,
    transfer_object,
)
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.search_clock import SearchClock
from sylpose.tracking.state_machine import add_nudge_faults, process_frame


class TrackerSnapshot(NamedTuple):
    """Complete tracker state between two frames: shared state and that of each local camera."""

    state: JointState
    buffered: Sequence[BufferedFrame]
    next_number: int
    camera_trackers: Sequence[CameraTracker]


@dataclass(frozen=True, eq=False)
class BufferedRecord:
    """Shared data of a buffered frame, and its motion since the first buffered one, if any.

    Attributes:
        index, time: as in `FrameSet`.
        times: (C,) as in `FrameSet`; NaN for a camera without time stamp.
        number, time_offsets: as in `Frame`.
    """

    index: int
    time: float
    times: FloatArray
    number: int
    time_offsets: FloatArray
    motion: RigidTransform | None

    @classmethod
    def from_frame(cls, frame: Frame, motion: RigidTransform | None) -> BufferedRecord:
        """Return the shared data of a buffered frame."""
        images = frame.images
        times = np.array([np.nan if time is None else time for time in images.times])
        return cls(images.index, images.time, times, frame.number, frame.time_offsets, motion)

    def to_frame(self, cameras: Sequence[CameraFrame]) -> BufferedFrame:
        """Return the buffered frame without images, with the local cameras' data."""
        times = tuple(None if np.isnan(time) else float(time) for time in self.times)
        no_images = (None,) * len(times)
        images = FrameSet(self.index, self.time, times, no_images, no_images)
        return BufferedFrame(Frame(self.number, images, self.time_offsets, cameras=cameras), self.motion)


@dataclass(frozen=True, eq=False)
class Handover:
    """Complete shared state between two frames.

    Attributes:
        state: the shared state.
        buffered: records of the buffered frames.
        number: of the next frame.
    """

    state: JointState
    buffered: tuple[BufferedRecord, ...]
    number: int


def check_handover(handover: Handover, cameras: int) -> None:
    """Check that a handover is consistent with a rig of so many cameras.

    Raises:
        ValueError: it is not.
    """
    state, n = handover.state, cameras
    last, keyframes, anchor = state.frames.last, state.frames.keyframes, state.frames.anchor
    optional = (last, state.refinement.last, None if anchor is None else anchor.frame)
    frames = [frame for frame in (*keyframes, *state.frames.recent, *optional) if frame is not None]
    is_consistent = all(
        len(f.time_offsets) == len(f.viewpoints) == len(f.is_visible) == n and f.number >= 0 for f in frames
    )
    is_consistent &= all(len(w.times) == len(w.time_offsets) == n for w in handover.buffered) and handover.number >= 0
    is_consistent &= bool(keyframes) == (last is not None) and not (frames and last is None)
    is_consistent &= all(0 <= nudge.camera < n for nudge in state.nudges)
    if not is_consistent:
        raise ValueError(f"the shared state is not that of {n} cameras")


class TrackerArguments(TypedDict, total=False):
    """Arguments of a tracker besides its cameras, see `track`."""

    method: str
    features: str
    offsets: Mapping[str, float] | None
    seed: int
    options: TrackingOptions | None
    known_object: KnownObject | None
    candidate: Candidate | None
    f_ratio: float
    search_clock: SearchClock | None


def track(
    frames: Iterable[FrameSet],
    rig: Rig,
    boxes: Mapping[str, Box] | None = None,
    *,
    method: str = METHODS[0],
    features: str = FEATURES[0],
    offsets: Mapping[str, float] | None = None,
    workers: int | None = None,
    seed: int = 0,
    known_object: KnownObject | None = None,
    lookahead: int = TrackingOptions.max_buffered_frames,
    options: TrackingOptions | None = None,
) -> Iterator[TrackedFrame]:
    """Track one rigid object and yield its pose frame by frame.

    Args:
        frames: of the recording, in order: `session.frames()`, or `FrameSet.of(images, time)` for images in memory.
        rig: C cameras. With one camera the object is placed at distance 1 from it, and the status of every frame
            reports that the scale is not observable.
        boxes: per camera, the object's box in the first frame, pixels; None: the body that moves with the most
            features is tracked, with the status `ambiguous` if another one moves as well.
        method: "landmarks" (landmark positions on the object are refined over time; least drift), "epipolar" (epipolar
            geometry against several reference frames), one of the paper's frame-to-frame estimators (as in
            `estimate_motion`), or "known-depth" (Sylvester's equation for landmarks of known depth).
        features: "sift" (SIFT in every frame, as in the paper), "klt" (KLT tracking between frames, SIFT only where
            that is not enough: several times faster and more precise; not for the paper's estimators, which need
            matches with the previous frame) or "auto": "klt" for the method "landmarks", else "sift".
        offsets: per camera, seconds by which its images are later than its time stamps.
        known_object: the object as learned from another recording (`load_object`); poses are expressed in its frame
            and start with the first frame in which it is found.
        lookahead: number of frames that are read in advance to see which bodies move and whether the cameras agree,
            with boxes fewer; a sequence is searched as a whole. 0 for live cameras.
        workers: threads for detection and matching; None: one per core, at most one per camera.
        seed: of outlier rejection. Equal input and seed give equal output for any number of threads.
        options: limits and sizes; None: the default ones.

    Yields:
        One `TrackedFrame` per frame. Without boxes the first ones are held back until the object has moved.

    Raises:
        ValueError: unknown method; negative seed; boxes of cameras that are not in the rig, or that do not intersect in
            space; a known object observed by other cameras, combined with boxes or with another method than
            "landmarks".
    """
    arguments = TrackerArguments(
        method=method, features=features, offsets=offsets, seed=seed, options=options, known_object=known_object
    )
    with Tracker(rig, boxes, workers=workers, **arguments) as tracker:
        if not isinstance(frames, Iterable) or isinstance(frames, (str, bytes, Mapping)):
            raise TypeError(f"frames must be a sequence of FrameSet, got {format_value(frames)}")
        if check_integer(lookahead, "lookahead", minimum=0) and known_object is None:
            known, frames = _read_ahead(frames, min(lookahead, WINDOW_FRAMES) if boxes else lookahead)
            tracker.look_ahead(known, boxes, workers)
        for frame_set in frames:
            yield from tracker.step(frame_set)
        yield from tracker.flush()


def _number(frames: FrameSet, number: int) -> FrameSet:
    """Return a frame set with a number, if it has none."""
    return replace(frames, index=number) if frames.index == UNNUMBERED else frames


def _read_ahead(frames: Iterable[FrameSet], count: int) -> tuple[Sequence[FrameSet], Iterable[FrameSet]]:
    """Return all frames of a sequence, or the first ones of an iterator, and an iterable of all."""
    if isinstance(frames, Sequence):
        return frames, frames
    iterator, known, n_bytes = iter(frames), list[FrameSet](), 0
    for frame_set in islice(iterator, count):
        known.append(frame_set)
        n_bytes += sum(image.nbytes for image in getattr(frame_set, "images", ()) if image is not None)
        if n_bytes > MAX_BUFFERED_BYTES:
            break
    return known, chain(known, iterator)


class TrackerBase:
    """Tracker core, independent of how the cameras are connected.

    Args:
        cameras: per camera, local: its tracker.
        executor: connects the cameras.
        rig, boxes, method, features, offsets, seed, options, known_object: see `track`.
        candidate, f_ratio: found in advance, see `Context`.
        search_clock: for live cameras, so that a search for a lost object does not delay poses; None: results do not
            depend on the machine's speed.

    Raises:
        ValueError: as `track`.
    """

    def __init__(
        self,
        rig: Rig,
        cameras: Sequence[CameraTracker],
        executor: CameraExecutor,
        boxes: Mapping[str, Box] | None,
        *,
        method: str = METHODS[0],
        features: str = FEATURES[0],
        offsets: Mapping[str, float] | None = None,
        seed: int = 0,
        options: TrackingOptions | None = None,
        known_object: KnownObject | None = None,
        candidate: Candidate | None = None,
        f_ratio: float = np.nan,
        search_clock: SearchClock | None = None,
    ) -> None:
        uses_klt = resolve_features(method, features) == "klt"
        check_integer(seed, "seed")
        offsets = check_type({} if offsets is None else offsets, Mapping, "offsets")
        for name, value in offsets.items():
            if name not in rig.names:
                raise ValueError(
                    f"offsets: no camera {format_value(name)} in the rig ({to_one_line(', '.join(rig.names), 200)})"
                )
            check_number(value, f"offsets: {name}", minimum=-MAX_TIME_OFFSET, maximum=MAX_TIME_OFFSET)
        for name, box in check_type({} if boxes is None else boxes, Mapping, "boxes").items():
            check_type(box, Box, f"boxes: {format_value(name)}")
        time_offsets = np.array([offsets.get(name, 0.0) for name in rig.names])
        options = TrackingOptions() if options is None else check_type(options, TrackingOptions, "options")
        settings = method, uses_klt, method == METHODS[0], time_offsets, seed, options, candidate, f_ratio, search_clock
        self._context = Context(rig, cameras, executor, *settings)
        self._rig = rig
        self._state = JointState(ObjectModel.from_boxes(rig, boxes) if boxes else ObjectModel())
        if known_object is not None:
            check_type(known_object, KnownObject, "known_object")
            if boxes:
                raise ValueError("boxes: not allowed for a known object")
            if method != METHODS[0]:
                raise ValueError(f"method: a known object needs {METHODS[0]!r}, got {method!r}")
        # The known object as these cameras would have observed it.
        self.transferred_object: TransferredObject | None = (
            None if known_object is None else transfer_object(known_object, rig, options)
        )
        self._buffered: Sequence[BufferedFrame] = []
        self.next_number = 0  # of the next frame

    def step(self, frames: FrameSet) -> list[TrackedFrame]:
        """Process the next frame.

        Returns:
            The frames decided by now, in order: usually this one. Without boxes none until the object has moved, then
            all buffered frames and this one.
        """
        check_frame_set(frames, self._rig)
        if self._context.search_clock is not None:
            self._context.search_clock.begin_frame(frames.time, frames.interval)
        transferred, note = self.transferred_object, ""
        if transferred is not None and not self.next_number:
            note = transferred.note
            self._state = initialize_from_object(transferred, self._rig, self._context.cameras, frames.time)
            self.next_number = len(transferred.keyframes)
        index, self.next_number = self.next_number, self.next_number + 1
        frames = _number(frames, index - (0 if transferred is None else len(transferred.keyframes)))
        self._state, self._buffered, decided = process_frame(self._context, self._state, self._buffered, index, frames)
        if transferred is None:
            return decided
        convert = transferred.converter.convert
        return [
            replace(tracked, pose=convert(tracked.pose), learned_pose=tracked.pose, note=tracked.note or note)
            for tracked in decided
        ]

    @property
    def snapshot(self) -> TrackerSnapshot:
        """The current state, including local cameras; `step` modifies parts of it in place."""
        return TrackerSnapshot(self._state, self._buffered, self.next_number, self._context.cameras)

    def copy_snapshot(self) -> TrackerSnapshot:
        """Copy the current state, so that it outlives the next `step`."""
        # Immutable objects need not be copied: images, descriptors, calibrations.
        constants: list[object] = [frame.images for frame, _ in self._buffered]
        constants += [own for camera in self._context.cameras for own in camera.list_immutable()]
        constants += [features for frame, _ in self._buffered for features in frame.features]
        mutable = self._context.cameras, list(self._buffered)
        camera_trackers, buffered = copy.deepcopy(mutable, {id(constant): constant for constant in constants})
        return TrackerSnapshot(self._state, buffered, self.next_number, camera_trackers)

    def restore(self, snapshot: TrackerSnapshot) -> None:
        """Restore an earlier state; each `TrackerSnapshot` may be restored once."""
        self._state, self._buffered, self.next_number, camera_trackers = snapshot
        for camera_tracker, its in zip(self._context.cameras, camera_trackers, strict=True):
            vars(camera_tracker).update(vars(its))

    def build_known_object(self) -> KnownObject | None:
        """Build a known object for another recording; None while too little is known."""
        initial = None if self.transferred_object is None else self.transferred_object.known_object
        return build_known_object(self._rig, self._state, self._context.cameras, initial)

    def create_handover(self) -> Handover:
        """Create the handover for a camera that joins at the next frame."""
        # Observations are shared again, and pending background work is restarted.
        frames = replace(self._state.frames, next_anchor_number=None)
        refinement = replace(self._state.refinement, shared=(), pending=None)
        buffered = tuple(BufferedRecord.from_frame(*own) for own in self._buffered)
        return Handover(replace(self._state, frames=frames, refinement=refinement), buffered, self.next_number)

    def apply_handover(self, handover: Handover, *, is_new: bool) -> None:
        """Continue from a handover.

        Args:
            handover: the shared state.
            is_new: whether the local cameras join now, without any observations so far.
        """
        self._state, self.next_number = handover.state, handover.number
        if not is_new:
            # The transmitted motion is rounded: all cameras continue with the same value.
            both = zip(self._buffered, handover.buffered, strict=True)
            self._buffered = [own._replace(motion=record.motion) for own, record in both]
            return
        frames = self._state.frames
        for camera in self._context.cameras:
            camera.reset()
            camera.frames = {number: camera.create_empty_frame() for number in frames.by_number}
            if frames.anchor is not None:
                number = frames.anchor.frame.number
                camera.anchor = create_anchor(number, camera.frames[number], None, None)
        self._buffered = [
            record.to_frame([camera.create_empty_frame() for camera in self._context.cameras])
            for record in handover.buffered
        ]

    @property
    def has_observations(self) -> bool:
        """Whether a local camera has observations by which it could recognize the object."""
        return any(camera.has_observations for camera in self._context.cameras)

    @property
    def first_frame(self) -> SolvedFrame | None:
        """The frame whose pose defines the object's frame; None before the first pose."""
        return self._state.frames.first if self._state.frames.keyframes else None

    def restart(self) -> None:
        """Restart if a pose exists of an object that no camera could recognize.

        The next moving object is then tracked, and its first pose defines the object's frame.
        """
        if self._state.frames.last is not None:
            self._state = JointState(nudges=self._state.nudges)
            for camera_tracker in self._context.cameras:
                camera_tracker.reset()

    def flush(self) -> list[TrackedFrame]:
        """Return the frames still undecided at the recording's end: the object moved little or never."""
        buffered, self._buffered = self._buffered, []
        return add_nudge_faults(self._context, self._state, finish_initialization(self._context, buffered))


class Tracker(TrackerBase):
    """Single-process tracker of one rigid object; a context manager for its worker threads.

    Args:
        rig, boxes, method, features, offsets, known_object, workers, seed, options: see `track`.
        search_clock: see `TrackerBase`.

    Raises:
        ValueError: as `track`.
    """

    def __init__(
        self,
        rig: Rig,
        boxes: Mapping[str, Box] | None = None,
        *,
        workers: int | None = None,
        **arguments: Unpack[TrackerArguments],
    ) -> None:
        check_type(rig, Rig, "rig")
        if workers is not None:
            check_integer(workers, "workers", minimum=0)
        self._executor = LocalExecutor(len(rig), workers or min(len(rig), os.cpu_count() or 1))
        cameras = [CameraTracker(c, camera) for c, camera in enumerate(rig)]
        super().__init__(rig, cameras, self._executor, boxes, **arguments)

    def look_ahead(
        self, frames: Sequence[FrameSet], boxes: Mapping[str, Box] | None, workers: int | None = None
    ) -> None:
        """Search frames before the first step: do the cameras agree and, without boxes, which moving body is largest?"""
        for frame_set in frames:
            check_frame_set(frame_set, self._rig)
        context, offsets = self._context, self._context.time_offsets
        if boxes:
            f_ratio = compare_cameras(
                self._rig, frames, boxes, time_offsets=offsets, workers=workers, options=context.options
            )
            self._context = replace(context, f_ratio=f_ratio)
            return
        numbered = list(map(_number, frames, range(len(frames))))
        windows = (numbered[window.start : window.stop] for window in select_windows(len(frames)))
        candidates = find_candidates(
            self._rig, windows, time_offsets=offsets, seed=context.seed, workers=workers, options=context.options
        )
        if candidates:
            self._context = replace(context, candidate=candidates[0], f_ratio=candidates[0].f_ratio)

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Shut down the worker threads."""
        self._executor.close()
