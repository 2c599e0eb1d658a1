"""A tracker's state, as stored in a checkpoint."""

from __future__ import annotations

from sylpose.runs.checkpoint_schema import SERIALIZER
from sylpose.tracking.tracker import Tracker, TrackerSnapshot

__all__ = ["dump_state", "restore_state"]


def dump_state(tracker: Tracker) -> bytes:
    """Return the state as data."""
    return b"".join(SERIALIZER.dump(tracker.snapshot))


def restore_state(tracker: Tracker, data: bytes) -> None:
    """Restore a tracker's stored state."""
    memory: TrackerSnapshot = SERIALIZER.load(memoryview(data), TrackerSnapshot)
    tracker.restore(memory)
