"""What a camera has to know to take part from now on, where it was not there before: all that the others know alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.camera_executor import Crew
from sylpose.tracking.frame import Frame
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.klt_frontend import begin_anchor
from sylpose.tracking.state_machine import Waiting

__all__ = ["Handover", "Waited", "check_handover", "handed_over", "taken_over"]


@dataclass(frozen=True, eq=False)
class Waited:
    """A frame that waits for the object to move; the motion since the first of them, if any.

    Attributes:
        index, time: as in `FrameSet`; times: (C,) the same, NaN without one.
        number, late: as in `Frame`.
    """

    index: int
    time: float
    times: FloatArray
    number: int
    late: FloatArray
    motion: RigidTransform | None


@dataclass(frozen=True, eq=False)
class Handover:
    """All that is known alike. number: of the next frame."""

    joint: Joint
    waiting: tuple[Waited, ...]
    number: int


def handed_over(joint: Joint, waiting: Sequence[Waiting], number: int) -> Handover:
    """What is known alike between two frames."""

    def waited(w: Waiting) -> Waited:
        times = np.array([np.nan if t is None else t for t in w.frames.times])
        return Waited(w.frames.index, w.frames.time, times, w.frame.number, w.frame.late, w.motion)

    # What was told of sights is told again, and what is in the making is made anew.
    return Handover(replace(joint, told=(), renewal=None, pending=None), tuple(waited(w) for w in waiting), number)


def check_handover(handover: Handover, cameras: int) -> None:
    """Whether a handover is one of a rig of so many cameras.

    Raises:
        ValueError: it is not.
    """
    joint, n = handover.joint, cameras
    anchor = () if joint.anchor is None else (joint.anchor.frame,)
    frames = (*joint.keyframes, *joint.recent, *anchor, *(f for f in (joint.last, joint.together) if f is not None))
    good = all(len(f.late) == len(f.viewpoints) == len(f.sees) == n and f.number >= 0 for f in frames)
    good &= all(len(w.times) == len(w.late) == n for w in handover.waiting) and handover.number >= 0
    good &= bool(joint.keyframes) == (joint.last is not None) and not (frames and joint.last is None)
    good &= all(0 <= nudge.camera < n for nudge in joint.nudges)
    if not good:
        raise ValueError(f"what all know is not of {n} cameras")


def taken_over(
    handover: Handover, crew: Crew, parts: Sequence[CameraPart], mine: Sequence[Waiting] | None
) -> tuple[Joint, list[Waiting], int]:
    """The inverse: state, waiting frames, number of the next one.

    Args:
        mine: the frames that wait, where the cameras here were there all the time; None where they come: then they have
            seen nothing of the frames so far.
    """
    joint, told = handover.joint, handover.waiting
    if mine is not None:
        # What was sent is rounded: all go on with the same.
        return joint, [w._replace(motion=t.motion) for w, t in zip(mine, told, strict=True)], handover.number
    nothing = (None,) * len(parts)

    def begin(c: int) -> None:
        part = parts[c]
        part.forget()
        part.frames = {number: part.blind() for number in joint.known} if joint.last is not None else {}
        if joint.anchor is not None:
            number = joint.anchor.frame.number
            part.anchor = begin_anchor(number, part.frames[number], None, None)

    def waited(w: Waited) -> Waiting:
        times = tuple(None if np.isnan(t) else float(t) for t in w.times)
        frame = Frame(w.number, w.time, w.late, crew.each(lambda c: parts[c].blind()))
        return Waiting(frame, FrameSet(w.index, w.time, times, nothing, nothing), w.motion)

    crew.each(begin)
    return joint, [waited(w) for w in told], handover.number
