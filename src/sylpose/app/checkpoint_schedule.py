"""When checkpoints of a run are written, and what one has to have in common with the run that goes on from it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sylpose.app.checkpoint import CHECKPOINT, START_ANEW, fingerprint, load_checkpoint, save_checkpoint
from sylpose.app.checkpoint_schema import RunState
from sylpose.app.timing import Clock
from sylpose.capture import Session

__all__ = ["Saver"]

# Checkpoints take no more than this share of the time (choice: what one may lose).
CHECKPOINT_SHARE = 0.05


@dataclass(eq=False)
class Saver:
    """Writes checkpoints now and then: without the first one no run begins; that a later one cannot be written is a problem,
    but does not end it.

    Attributes:
        folder: of the run's results.
        options: what the run was asked to do.
        recording: of which recording.
        seconds: between two of them.
        said: called with a sentence.
        clock: counts the time of "saving".
    """

    folder: Path
    options: Mapping[str, object]
    recording: Session
    seconds: float
    said: Callable[[str], None]
    clock: Clock
    _next: float = field(default=0.0, init=False)
    _failed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._told = {name: "none" if value is None else str(value) for name, value in self.options.items()}
        self._session = fingerprint(self.recording)

    @property
    def is_due(self) -> bool:
        return time.monotonic() >= self._next

    def begin(self, state: RunState) -> None:
        """Raises OSError, naming the file, when it cannot be written."""
        with self.clock.part("saving"):
            save_checkpoint(self.folder / CHECKPOINT, self._told, self._session, state)
        self._next = time.monotonic() + self.seconds

    def save(self, state: Callable[[], RunState]) -> None:
        begin = time.monotonic()
        with self.clock.part("saving"):
            try:
                save_checkpoint(self.folder / CHECKPOINT, self._told, self._session, state())
            except OSError as error:
                if not self._failed:
                    self.said(f"{error}; --resume could only go on from an earlier checkpoint.")
                self._failed = True
        end = time.monotonic()
        self._next = end + max(self.seconds, (end - begin) / CHECKPOINT_SHARE if self.seconds else 0.0)

    def load(self) -> RunState:
        """What to go on from.

        Raises:
            FileNotFoundError: no interrupted run.
            ValueError: naming the file: damaged, or not of this run.
        """
        path = self.folder / CHECKPOINT
        if not path.exists():
            raise FileNotFoundError(f"{self.folder}: no interrupted run to resume (there is no {CHECKPOINT})")
        state = load_checkpoint(path, self._told, self._session)
        objects, cameras = set(self.recording.objects), len(self.recording.rig)
        parts = [[part.index for part in memory.parts] for memory in state.trackers.values()]
        if {*state.trackers} != objects or {*state.outputs} != objects or parts != [[*range(cameras)]] * len(parts):
            raise ValueError(f"{path}: of a run with other objects or cameras than there are now{START_ANEW}")
        return state
