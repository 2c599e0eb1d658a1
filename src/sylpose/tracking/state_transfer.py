"""Transfer of the shared tracker state to a camera that joins a running system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.tracking.camera import CameraTracker
from sylpose.tracking.camera_executor import CameraExecutor
from sylpose.tracking.frame import Frame
from sylpose.tracking.joint_state import JointState
from sylpose.tracking.klt_frontend import create_anchor
from sylpose.tracking.state_machine import BufferedFrame

__all__ = ["BufferedRecord", "Handover", "build_handover", "check_handover", "restore_handover"]


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


def build_handover(state: JointState, buffered: Sequence[BufferedFrame], number: int) -> Handover:
    """Create a handover between two frames."""

    def create_record(w: BufferedFrame) -> BufferedRecord:
        times = np.array([np.nan if t is None else t for t in w.frames.times])
        return BufferedRecord(w.frames.index, w.frames.time, times, w.frame.number, w.frame.time_offsets, w.motion)

    # Observations are shared again, and pending background work is restarted.
    return Handover(
        replace(state, shared_observations=(), next_anchor_number=None, pending_refinement=None),
        tuple(create_record(w) for w in buffered),
        number,
    )


def check_handover(handover: Handover, cameras: int) -> None:
    """Check that a handover is consistent with a rig of so many cameras.

    Raises:
        ValueError: it is not.
    """
    state, n = handover.state, cameras
    anchor = () if state.anchor is None else (state.anchor.frame,)
    frames = (*state.keyframes, *state.recent, *anchor, *(f for f in (state.last, state.last_refined) if f is not None))
    is_consistent = all(
        len(f.time_offsets) == len(f.viewpoints) == len(f.is_visible) == n and f.number >= 0 for f in frames
    )
    is_consistent &= all(len(w.times) == len(w.time_offsets) == n for w in handover.buffered) and handover.number >= 0
    is_consistent &= bool(state.keyframes) == (state.last is not None) and not (frames and state.last is None)
    is_consistent &= all(0 <= nudge.camera < n for nudge in state.nudges)
    if not is_consistent:
        raise ValueError(f"the shared state is not that of {n} cameras")


def restore_handover(
    handover: Handover,
    executor: CameraExecutor,
    camera_trackers: Sequence[CameraTracker],
    local_frames: Sequence[BufferedFrame] | None,
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
    no_images = (None,) * len(camera_trackers)

    def restore_camera(c: int) -> None:
        camera_tracker = camera_trackers[c]
        camera_tracker.reset()
        camera_tracker.frames = (
            {number: camera_tracker.create_empty_frame() for number in state.known_frames}
            if state.last is not None
            else {}
        )
        if state.anchor is not None:
            number = state.anchor.frame.number
            camera_tracker.anchor = create_anchor(number, camera_tracker.frames[number], None, None)

    def create_buffered_frame(w: BufferedRecord) -> BufferedFrame:
        times = tuple(None if np.isnan(t) else float(t) for t in w.times)
        frame = Frame(
            w.number, w.time, w.time_offsets, executor.map_cameras(lambda c: camera_trackers[c].create_empty_frame())
        )
        return BufferedFrame(frame, FrameSet(w.index, w.time, times, no_images, no_images), w.motion)

    executor.map_cameras(restore_camera)
    return state, [create_buffered_frame(w) for w in records], handover.number
