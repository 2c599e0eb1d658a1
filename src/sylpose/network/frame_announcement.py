"""What members of a group say to each other before each frame: which one it is, who joins, whether they leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["ABSENT", "NO_FRAME", "WAITS", "Roll", "common", "instant_of"]

# Numbers of no frame: at a recording's end, and where one may come yet (derived).
NO_FRAME, WAITS = -1, -2


@dataclass(frozen=True, eq=False)
class Roll:
    """One camera's word before a frame.

    Attributes:
        newest: number of the newest frame that it has, not before the one that all wait for; `NO_FRAME` where no more
            come, `WAITS` where there is none now.
        time: that it was taken at, seconds; NaN without a time stamp.
        newcomers: whom it would take in.
        outdone: whether it would leave for a larger group.
        knows: whether it has seen anything of the object that it would know again.
    """

    newest: int
    time: float
    newcomers: tuple[int, ...]
    outdone: bool
    knows: bool


# Of a camera that is no member.
ABSENT = Roll(NO_FRAME, np.nan, (), False, False)


def instant_of(rolls: Sequence[Roll], wanted: int) -> int:
    """The frame that is next: the newest that half of those have that have any from the `wanted` one on; `WAITS` where
    nobody has one now, and `NO_FRAME` where nobody will."""
    newest = sorted(roll.newest for roll in rolls if roll.newest >= wanted)
    if newest:
        return newest[(len(newest) - 1) // 2]
    return WAITS if any(roll.newest == WAITS for roll in rolls) else NO_FRAME


def common(rolls: Sequence[Roll]) -> frozenset[int]:
    """Whom all would take in."""
    return frozenset.intersection(*(frozenset(roll.newcomers) for roll in rolls))
