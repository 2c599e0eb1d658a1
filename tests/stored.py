"""What a tracker knows, as it stands in a checkpoint."""

from __future__ import annotations

from sylpose.app.checkpoint_schema import FUNCTIONS, KINDS
from sylpose.app.serialization import decoded, encoded
from sylpose.tracking.tracker import Memory, Tracker

__all__ = ["go_on", "stored"]


def stored(tracker: Tracker) -> tuple[bytes, int]:
    """The data, and the length of its table."""
    table, *blocks = encoded(tracker.memory, KINDS, FUNCTIONS)
    return b"".join([table, *blocks]), len(table)


def go_on(tracker: Tracker, data: tuple[bytes, int]) -> None:
    """Puts a tracker where the one was that was stored."""
    memory: Memory = decoded(memoryview(data[0]), data[1], Memory, KINDS, FUNCTIONS)
    tracker.go_back(memory)
