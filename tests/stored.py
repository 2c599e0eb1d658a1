"""A tracker's state, as stored in a checkpoint."""

from __future__ import annotations

from sylpose.runs.checkpoint_schema import FUNCTIONS, RECORD_TYPES
from sylpose.serialization import deserialize, serialize
from sylpose.tracking.tracker import Tracker, TrackerSnapshot

__all__ = ["dump_state", "restore_state"]


def dump_state(tracker: Tracker) -> tuple[bytes, int]:
    """Return the data, and the length of its table."""
    table, *blocks = serialize(tracker.snapshot, RECORD_TYPES, FUNCTIONS)
    return b"".join([table, *blocks]), len(table)


def restore_state(tracker: Tracker, data: tuple[bytes, int]) -> None:
    """Restore a tracker's stored state."""
    memory: TrackerSnapshot = deserialize(memoryview(data[0]), data[1], TrackerSnapshot, RECORD_TYPES, FUNCTIONS)
    tracker.restore(memory)
