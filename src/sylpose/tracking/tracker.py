"""Single-process tracker: the object's pose in every frame, against several earlier frames."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sylpose.frames import Box, FrameSet, check_frame_set
from sylpose.geometry.validation import check_integer, check_number, check_type, format_value
from sylpose.input_limits import to_one_line
from sylpose.methods import FEATURES, METHODS, resolve_features
from sylpose.rig import Rig
from sylpose.tracking.camera_motion_correction import add_nudge_faults
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.context import CameraExecutor, LocalExecutor, TrackerContext
from sylpose.tracking.initialization import BufferedFrame, finish_initialization
from sylpose.tracking.joint_side.joint_state import JointState
from sylpose.tracking.joint_side.keyframes import SolvedFrame
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.known_object import KnownObject, build_known_object
from sylpose.tracking.object_transfer import TransferredObject, initialize_from_object, transfer_object
from sylpose.tracking.state_machine import process_frame
from sylpose.tracking.state_transfer import Handover, TrackerSnapshot, build_handover, restore_handover
from sylpose.tracking.tracked_frame import TrackedFrame

MAX_TIME_OFFSET = 1e6  # seconds: cameras of one recording start within days of each other (choice)


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
) -> Iterator[TrackedFrame]:
    """Track one rigid object and yield its pose frame by frame.

    Args:
        frames: of the recording, in order: `session.frames()`.
        rig: C cameras. With one camera the object is placed at distance 1 from it, and the status of every frame
            reports that the scale is not observable.
        boxes: per camera, the object's box in the first frame, pixels; None: whatever moves against the static
            background is tracked.
        method: "landmarks" (landmark positions on the object are refined over time; least drift), "epipolar" (epipolar
            geometry against several reference frames), one of the paper's frame-to-frame estimators (as in
            `estimate_motion`), or "known-depth" (Sylvester's equation for landmarks of known depth).
        features: "sift" (SIFT in every frame, as in the paper), "klt" (KLT tracking between frames, SIFT only where
            that is not enough: several times faster and more precise; not for the paper's estimators, which need
            matches with the previous frame) or "auto": "klt" for the method "landmarks", else "sift".
        offsets: per camera, seconds by which its images are later than its time stamps.
        known_object: the object as learned from another recording (`load_object`); poses are expressed in its frame
            and start with the first frame in which it is found.
        workers: threads for detection and matching; None: one per core, at most one per camera.
        seed: of outlier rejection. Equal input and seed give equal output for any number of threads.

    Yields:
        One `TrackedFrame` per frame. Without boxes the first ones are held back until the object has moved.

    Raises:
        ValueError: unknown method; negative seed; boxes of cameras that are not in the rig, or that do not intersect in
            space; a known object observed by other cameras, combined with boxes or with another method than
            "landmarks".
    """
    with Tracker(
        rig,
        boxes,
        method=method,
        features=features,
        offsets=offsets,
        workers=workers,
        seed=seed,
        known_object=known_object,
    ) as tracker:
        for frame_set in _check_frame_sequence(frames):
            yield from tracker.step(frame_set)
        yield from tracker.flush()


def _check_frame_sequence(frames: Iterable[FrameSet]) -> Iterable[FrameSet]:
    if not isinstance(frames, Iterable) or isinstance(frames, (str, bytes, Mapping)):
        raise TypeError(f"frames must be a sequence of FrameSet, got {format_value(frames)}")
    return frames


class TrackerBase:
    """Tracker core, independent of how the cameras are connected.

    Args:
        cameras: per camera, local: its tracker.
        executor: connects the cameras.
        rig, boxes, method, features, offsets, seed, known_object: see `track`.

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
        method: str,
        features: str,
        offsets: Mapping[str, float] | None,
        seed: int,
        known_object: KnownObject | None = None,
    ) -> None:
        uses_klt = resolve_features(method, features) == "klt"
        check_integer(seed, "seed")
        for name, value in check_type({} if offsets is None else offsets, Mapping, "offsets").items():
            if name not in rig.names:
                raise ValueError(
                    f"offsets: no camera {format_value(name)} in the rig ({to_one_line(', '.join(rig.names), 200)})"
                )
            check_number(value, f"offsets: {name}", minimum=-MAX_TIME_OFFSET, maximum=MAX_TIME_OFFSET)
        for name, box in check_type({} if boxes is None else boxes, Mapping, "boxes").items():
            check_type(box, Box, f"boxes: {format_value(name)}")
        time_offsets = np.array([(offsets or {}).get(name, 0.0) for name in rig.names])
        self._context = TrackerContext(rig, cameras, executor, method, uses_klt, time_offsets, seed)
        self._rig = rig
        self._state = JointState(ObjectModel.from_boxes(rig, boxes) if boxes else ObjectModel())
        if known_object is not None:
            check_type(known_object, KnownObject, "known")
            if boxes:
                raise ValueError("boxes: not allowed for a known object")
            if method != METHODS[0]:
                raise ValueError(f"method: a known object needs {METHODS[0]!r}, got {method!r}")
        # The known object as these cameras would have observed it.
        self.transferred_object: TransferredObject | None = (
            None if known_object is None else transfer_object(known_object, rig)
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
        transferred, note = self.transferred_object, ""
        if transferred is not None and not self.next_number:
            note = transferred.note
            self._state = initialize_from_object(transferred, self._rig, self._context.cameras, frames.time)
            self.next_number = len(transferred.keyframes)
        index, self.next_number = self.next_number, self.next_number + 1
        self._state, self._buffered, decided = process_frame(self._context, self._state, self._buffered, index, frames)
        if transferred is None:
            return decided
        return [
            replace(
                tracked,
                pose=transferred.converter.convert(tracked.pose),
                learned_pose=tracked.pose,
                note=tracked.note or note,
            )
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
        return build_known_object(
            self._rig,
            self._state,
            self._context.cameras,
            None if self.transferred_object is None else self.transferred_object.known_object,
        )

    def create_handover(self) -> Handover:
        """Create the handover for a camera that joins at the next frame."""
        return build_handover(self.snapshot)

    def apply_handover(self, handover: Handover, *, is_new: bool) -> None:
        """Continue from a handover.

        Args:
            handover: the shared state.
            is_new: whether the local cameras join now, without any observations so far.
        """
        local_frames = None if is_new else self._buffered
        self._state, self._buffered, self.next_number = restore_handover(handover, self._context, local_frames)

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
        rig, boxes, method, features, offsets, known, workers, seed: see `track`.

    Raises:
        ValueError: as `track`.
    """

    def __init__(
        self,
        rig: Rig,
        boxes: Mapping[str, Box] | None = None,
        *,
        method: str = METHODS[0],
        features: str = FEATURES[0],
        offsets: Mapping[str, float] | None = None,
        workers: int | None = None,
        seed: int = 0,
        known_object: KnownObject | None = None,
    ) -> None:
        check_type(rig, Rig, "rig")
        if workers is not None:
            check_integer(workers, "workers", minimum=0)
        self._executor = LocalExecutor(len(rig), workers or min(len(rig), os.cpu_count() or 1))
        cameras = [CameraTracker(c, camera) for c, camera in enumerate(rig)]
        options: dict[str, Any] = {"method": method, "features": features, "offsets": offsets, "seed": seed}
        super().__init__(rig, cameras, self._executor, boxes, **options, known_object=known_object)

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Shut down the worker threads."""
        self._executor.close()
