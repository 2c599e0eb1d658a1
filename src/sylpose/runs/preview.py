"""Preview of what will be tracked without boxes: the tracker is run on the first frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.io.capture import Session
from sylpose.results import FrameStatus
from sylpose.runs.session_warnings import boxes_hint
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import Tracker

__all__ = ["Preview", "box_outlines", "preview_moving_object"]

# Number of frames that are tracked (choice).
PREVIEW_FRAMES = 30
# Directions of the points on the object whose motion in the images is reported (derived).
DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True, eq=False)
class Preview:
    """Preview of the tracked object.

    Attributes:
        frames: the first frame, for drawing; None for a recording without frames.
        outlines: by camera, outline (k, 2) in pixels, or None if the object is not visible or unknown.
        description: description.
        warnings: warnings.
    """

    frames: FrameSet | None
    outlines: tuple[FloatArray | None, ...]
    description: str
    warnings: tuple[str, ...] = ()


def preview_moving_object(session: Session, n_frames: int = PREVIEW_FRAMES) -> Preview:
    """Find what moves against the static background in the first frames, as `track` does."""
    names, tracked, first = session.rig.names, list[TrackedFrame](), None
    with Tracker(session.rig) as tracker:
        for frames in islice(session.frames(), n_frames):
            first = frames if first is None else first
            tracked += tracker.step(frames)
            if any(f.pose.is_observed for f in tracked[1:]):
                break
        else:
            tracked += tracker.flush()
    solved = [f for f in tracked if f.pose.is_observed]
    if len(solved) < 2:
        statuses = [f.pose.status for f in tracked]
        why = statuses[-1].text if statuses else FrameStatus.TOO_FEW_MATCHES.text
        range_text = f"the first {len(tracked)} frames" if len(tracked) > 1 else "the first frame"
        description = (
            f"Without boxes, the moving object is tracked, but nothing trackable moves within {range_text}. {why} "
            f"Select the object with boxes: {boxes_hint(session)}."
        )
        return Preview(first, (None,) * len(names), "nothing yet", (description,))
    begin, end = solved[0], solved[-1]
    displacements = _median_displacements(session, begin, end)
    counts = [
        f"{name} {n} features, {px:.0f} px"
        for name, n, px in zip(names, end.pose.inliers.tolist(), displacements, strict=True)
        if n
    ]
    description = f"what moves from frame {begin.pose.index} to {end.pose.index}: {', '.join(counts)}"
    return Preview(begin.frames, begin.regions, description, (begin.note,) if begin.note else ())


def _median_displacements(session: Session, begin: TrackedFrame, end: TrackedFrame) -> Sequence[float]:
    """Return the median displacement of the object's surface in each camera's images, pixels."""
    first_pose, last_pose = begin.pose.world_from_object, end.pose.world_from_object
    assert first_pose is not None
    assert last_pose is not None
    points = begin.radius * DIRECTIONS
    displacements = [
        camera.project(last_pose.apply(points)) - camera.project(first_pose.apply(points)) for camera in session.rig
    ]
    return [float(np.median(np.linalg.norm(shift, axis=1))) for shift in displacements]


def box_outlines(session: Session, boxes: Mapping[str, Box]) -> tuple[FloatArray | None, ...]:
    """Return the corners (4, 2) of each camera's box, or None without one."""

    def corners(box: Box) -> FloatArray:
        right, bottom = box.x + box.width - 1, box.y + box.height - 1
        return np.array([[box.x, box.y], [right, box.y], [right, bottom], [box.x, bottom]], float)

    return tuple(corners(boxes[name]) if name in boxes else None for name in session.rig.names)
