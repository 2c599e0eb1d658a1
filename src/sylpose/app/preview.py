"""What a recording's object is without boxes: what moves at first, looked for as the tracker does, in a few frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from sylpose.app.session_warnings import boxes_by
from sylpose.capture import Session
from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.results import FrameStatus
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import Tracker

__all__ = ["Follows", "box_outlines", "what_moves"]

# So many frames are looked at (choice).
LOOKED_AT = 30
# The object's directions by which its motion in the images is told (derived).
AROUND = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True, eq=False)
class Follows:
    """What will be followed.

    Attributes:
        frames: the first frame, which is what is drawn into; None for a recording without any.
        outlines: by camera (k, 2) pixels in it, None where the object is not seen or not known.
        said: a sentence.
        wrong: sentences for what looks wrong with it.
    """

    frames: FrameSet | None
    outlines: tuple[FloatArray | None, ...]
    said: str
    wrong: tuple[str, ...] = ()


def what_moves(session: Session, looked_at: int = LOOKED_AT) -> Follows:
    """What moves against the standing background in the first frames, as `track` would begin with it."""
    names, decided, first = session.rig.names, list[TrackedFrame](), None
    with Tracker(session.rig) as tracker:
        for frames in islice(session.frames(), looked_at):
            first = frames if first is None else first
            decided += tracker.step(frames)
            if any(f.pose.seen for f in decided[1:]):
                break
        else:
            decided += tracker.flush()
    solved = [f for f in decided if f.pose.seen]
    if len(solved) < 2:
        statuses = [f.pose.status for f in decided]
        why = statuses[-1].text if statuses else FrameStatus.TOO_FEW_MATCHES.text
        within = f"the first {len(decided)} frames" if len(decided) > 1 else "the first frame"
        said = (
            f"Without boxes, the object is what moves, and nothing that could be followed does within {within}. {why} "
            f"Boxes would say what it is: {boxes_by(session)}."
        )
        return Follows(first, (None,) * len(names), "nothing yet", (said,))
    begin, end = solved[0], solved[-1]
    moved = _moved(session, begin, end)
    seen = [
        f"{name} {n} features, {px:.0f} px"
        for name, n, px in zip(names, end.pose.inliers.tolist(), moved, strict=True)
        if n
    ]
    said = f"what moves from frame {begin.pose.index} to {end.pose.index}: {', '.join(seen)}"
    return Follows(begin.frames, begin.regions, said, (begin.note,) if begin.note else ())


def _moved(session: Session, begin: TrackedFrame, end: TrackedFrame) -> Sequence[float]:
    """By camera, by how much the object's surface is displaced in the images, pixels, in the middle."""
    before, now = begin.pose.world_from_object, end.pose.world_from_object
    assert before is not None
    assert now is not None
    points = begin.radius * AROUND
    shifts = [camera.project(now.apply(points)) - camera.project(before.apply(points)) for camera in session.rig]
    return [float(np.median(np.linalg.norm(shift, axis=1))) for shift in shifts]


def box_outlines(session: Session, boxes: Mapping[str, Box]) -> tuple[FloatArray | None, ...]:
    """By camera (4, 2) the corners of its box, or None."""

    def corners(box: Box) -> FloatArray:
        right, bottom = box.x + box.width - 1, box.y + box.height - 1
        return np.array([[box.x, box.y], [right, box.y], [right, bottom], [box.x, bottom]], float)

    return tuple(corners(boxes[name]) if name in boxes else None for name in session.rig.names)
