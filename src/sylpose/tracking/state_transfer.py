"""Transfer of the shared tracker state to a camera that joins a running system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.camera_side.klt_frontend import create_anchor
from sylpose.tracking.context import Frame, TrackerContext
from sylpose.tracking.initialization import BufferedFrame
from sylpose.tracking.joint_side.joint_state import JointState


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


def build_handover(snapshot: TrackerSnapshot) -> Handover:
    """Create a handover between two frames."""
    state = snapshot.state
    # Observations are shared again, and pending background work is restarted.
    state = replace(
        state,
        frames=replace(state.frames, next_anchor_number=None),
        refinement=replace(state.refinement, shared=(), pending=None),
    )
    buffered = tuple(_create_record(frame, motion) for frame, motion in snapshot.buffered)
    return Handover(state, buffered, snapshot.next_number)


def _create_record(frame: Frame, motion: RigidTransform | None) -> BufferedRecord:
    images = frame.images
    times = np.array([np.nan if time is None else time for time in images.times])
    return BufferedRecord(images.index, images.time, times, frame.number, frame.time_offsets, motion)


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


def restore_handover(
    handover: Handover, context: TrackerContext, local_frames: Sequence[BufferedFrame] | None
) -> tuple[JointState, list[BufferedFrame], int]:
    """Restore state, buffered frames and next frame number from a handover.

    Args:
        local_frames: buffered frames of local cameras that took part so far; None for cameras that join now, which have
            no features of the earlier frames.
    """
    state, records = handover.state, handover.buffered
    if local_frames is not None:
        # The transmitted motion is rounded: all cameras continue with the same value.
        return state, [w._replace(motion=t.motion) for w, t in zip(local_frames, records, strict=True)], handover.number
    for camera in context.cameras:
        camera.reset()
        if state.frames.last is not None:
            camera.frames = {number: camera.create_empty_frame() for number in state.frames.by_number}
        if state.frames.anchor is not None:
            number = state.frames.anchor.frame.number
            camera.anchor = create_anchor(number, camera.frames[number], None, None)
    no_images = (None,) * len(context.rig)
    buffered = list[BufferedFrame]()
    for record in records:
        times = tuple(None if np.isnan(time) else float(time) for time in record.times)
        images = FrameSet(record.index, record.time, times, no_images, no_images)
        empty = [camera.create_empty_frame() for camera in context.cameras]
        buffered.append(BufferedFrame(Frame(record.number, images, record.time_offsets, cameras=empty), record.motion))
    return state, buffered, handover.number
