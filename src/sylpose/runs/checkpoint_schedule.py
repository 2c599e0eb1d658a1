"""Schedule of a run's checkpoints, and their validation when a run is resumed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sylpose.io.capture import Session
from sylpose.runs.checkpoint import CHECKPOINT, RESTART_HINT, compute_fingerprint, load_checkpoint, save_checkpoint
from sylpose.runs.checkpoint_schema import RunState
from sylpose.runs.run_result import StageTimer

__all__ = ["CheckpointWriter"]

# Largest share of the running time spent on checkpoints (choice: an acceptable slowdown).
MAX_TIME_SHARE = 0.05


@dataclass(eq=False)
class CheckpointWriter:
    """Writer of periodic checkpoints.

    A run does not start without its first checkpoint. A failure to write a later one is only reported.

    Attributes:
        folder: folder of the run's results.
        options: the run's options by name.
        recording: the recording that is tracked.
        seconds: time between two checkpoints.
        on_message: callback for messages.
        clock: timer that accounts for the time of "saving".
    """

    folder: Path
    options: Mapping[str, object]
    recording: Session
    seconds: float
    on_message: Callable[[str], None]
    clock: StageTimer
    _next: float = field(default=0.0, init=False)
    _failed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._option_texts = {name: "none" if value is None else str(value) for name, value in self.options.items()}
        self._session = compute_fingerprint(self.recording)

    @property
    def is_due(self) -> bool:
        return time.monotonic() >= self._next

    def begin(self, state: RunState) -> None:
        """Write the first checkpoint; raise OSError, which names the file, if that fails."""
        with self.clock.measure("saving"):
            save_checkpoint(self.folder / CHECKPOINT, self._option_texts, self._session, state)
        self._next = time.monotonic() + self.seconds

    def save(self, state: Callable[[], RunState]) -> None:
        begin = time.monotonic()
        with self.clock.measure("saving"):
            try:
                save_checkpoint(self.folder / CHECKPOINT, self._option_texts, self._session, state())
            except OSError as error:
                if not self._failed:
                    self.on_message(f"{error}; --resume can only continue from an earlier checkpoint.")
                self._failed = True
        end = time.monotonic()
        self._next = end + max(self.seconds, (end - begin) / MAX_TIME_SHARE if self.seconds else 0.0)

    def load(self) -> RunState:
        """Return the state to resume from.

        Raises:
            FileNotFoundError: there is no interrupted run.
            ValueError: the checkpoint is damaged or belongs to another run; the message names the file.
        """
        path = self.folder / CHECKPOINT
        if not path.exists():
            raise FileNotFoundError(f"{self.folder}: no interrupted run to resume (there is no {CHECKPOINT})")
        state = load_checkpoint(path, self._option_texts, self._session)
        objects, cameras = set(self.recording.objects), len(self.recording.rig)
        parts = [[part.index for part in memory.camera_trackers] for memory in state.trackers.values()]
        if {*state.trackers} != objects or {*state.outputs} != objects or parts != [[*range(cameras)]] * len(parts):
            raise ValueError(f"{path}: objects or cameras changed since the interrupted run{RESTART_HINT}")
        return state
