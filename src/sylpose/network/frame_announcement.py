"""Frame announcements: before each frame, members agree on its number, on newcomers and on leaving the group."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["ABSENT", "FRAME_PENDING", "NO_FRAME", "FrameAnnouncement", "choose_frame", "find_common_newcomers"]

# Frame numbers without a frame: at the end of a recording, and while none is available (derived).
NO_FRAME, FRAME_PENDING = -1, -2


@dataclass(frozen=True, eq=False)
class FrameAnnouncement:
    """Announcement of one camera before a frame.

    Attributes:
        newest: number of its newest frame, at least the requested one; `NO_FRAME` at the end, `FRAME_PENDING` if none
            is available yet.
        time: timestamp of that frame, seconds; NaN without one.
        newcomers: nodes that it would admit.
        is_outranked: whether it would leave for a larger group.
        has_object: whether it has landmarks by which it could relocalize the object.
    """

    newest: int
    time: float
    newcomers: tuple[int, ...]
    is_outranked: bool
    has_object: bool


# Announcement of a camera that is not a member.
ABSENT = FrameAnnouncement(NO_FRAME, np.nan, (), False, False)


def choose_frame(announcements: Sequence[FrameAnnouncement], wanted: int) -> int:
    """Choose the next frame: the median of the newest frames, among cameras with any from `wanted` on.

    Returns:
        Its number; `FRAME_PENDING` if no camera has one yet, `NO_FRAME` at the end of all.
    """
    newest = sorted(announcement.newest for announcement in announcements if announcement.newest >= wanted)
    if newest:
        return newest[(len(newest) - 1) // 2]
    return FRAME_PENDING if any(announcement.newest == FRAME_PENDING for announcement in announcements) else NO_FRAME


def find_common_newcomers(announcements: Sequence[FrameAnnouncement]) -> frozenset[int]:
    """Return the newcomers that all members would admit."""
    return frozenset.intersection(*(frozenset(announcement.newcomers) for announcement in announcements))
