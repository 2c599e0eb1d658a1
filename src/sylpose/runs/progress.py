"""Progress of a run: a bar in a terminal, a line in a notebook, or calls of a function."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from sylpose.input_limits import print_message
from sylpose.runs.console_output import make_console
from sylpose.status import FrameStatus
from sylpose.tracking.context import TrackedFrame

# Called with the number of tracked frames and the total, or None if it is unknown.
ProgressCallback = Callable[[int, int | None], None]
# Shortest time between two updates of a notebook's line, seconds (choice).
MIN_UPDATE_SECONDS = 0.2
# Characters of a notebook's bar (choice).
BAR_WIDTH = 30
# Seconds between two progress lines without a terminal (choice).
SECONDS_BETWEEN_LINES = 20.0


class Progress:
    """Count of tracked frames, which calls a function after each.

    Args:
        frames: total number of frames, including those of an interrupted run; None if unknown.
        objects: number of objects, for each of which `update` is called.
        callback: the function; None for none.
    """

    def __init__(self, frames: int | None, objects: int, callback: ProgressCallback | None = None) -> None:
        self._frames, self._objects, self._callback = frames, objects, callback
        self._skipped, self._updates = 0, 0

    @property
    def tracked(self) -> int:
        """Return the number of frames in which all objects are tracked."""
        return self._updates // self._objects

    @property
    def done(self) -> int:
        """Return the number of tracked frames, including those of an interrupted run."""
        return self._skipped + self.tracked

    def skip(self, frames: int) -> None:
        """Set the number of frames that an interrupted run has tracked."""
        self._skipped = frames
        self._report()

    def update(self, tracked: TrackedFrame) -> None:  # noqa: ARG002
        """Count one more frame of one object."""
        self._updates += 1
        if self._updates % self._objects == 0:
            self._report()

    def _report(self) -> None:
        if self._callback is not None:
            self._callback(self.done, self._frames)

    def report_smoothing_round(self, number: int) -> None:
        """Report a round of the joint refinement of all poses."""


class TrackingProgress(Progress):
    """Progress bar on stderr with frames, frame rate and inliers; without a terminal, a line every twenty seconds.

    A context manager.

    Args:
        cameras: number of cameras.
        frames: total number of frames, including skipped ones; None if unknown.
        objects: number of objects, for each of which `update` is called.
        quiet: show nothing.
    """

    def __init__(self, cameras: int, frames: int | None, objects: int = 1, *, quiet: bool = False) -> None:
        super().__init__(frames, objects)
        self._last_line_time = time.monotonic()
        console = make_console(stderr=True, quiet=quiet)
        self._last_activity = quiet
        count = TextColumn(f"{cameras} camera{'s' if cameras > 1 else ''}")
        rate, inliers = TextColumn("{task.fields[rate]}"), TextColumn("{task.fields[inliers]}")
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), count, rate, inliers
        hidden = quiet or not console.is_terminal
        remaining = TimeRemainingColumn(compact=True)
        self._progress = Bar(*columns, remaining, console=console, transient=True, disable=hidden)
        self._task = self._progress.add_task("Searching", total=frames, rate="", inliers="")

    def __enter__(self) -> TrackingProgress:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Remove the bar; may be called twice."""
        self._progress.stop()

    def _report(self) -> None:
        self._progress.update(self._task, completed=self.done)

    def report_smoothing_round(self, number: int) -> None:
        """Show a round of the joint refinement of all poses."""
        self._progress.update(self._task, description="Refining", total=None, rate=f"round {number}", inliers="")

    def update(self, tracked: TrackedFrame) -> None:
        """Count one more frame of one object and update the bar."""
        super().update(tracked)
        pose = tracked.pose
        measured = pose.is_measured and pose.status is not FrameStatus.FIRST
        inliers = f"{int(pose.inliers.sum())} inliers" if measured else pose.reason or pose.status.value
        elapsed = self._progress.tasks[0].elapsed
        rate = f"{self.tracked / elapsed:.1f} frames/s" if elapsed and self.tracked > 1 else ""
        self._progress.update(self._task, description="Tracking", rate=rate, inliers=inliers)
        now = time.monotonic()
        if self._progress.disable and not self._last_activity and now - self._last_line_time >= SECONDS_BETWEEN_LINES:
            self._last_line_time = now
            total = self._progress.tasks[0].total
            of = "" if total is None else f" of {total:.0f}"
            print_message(f"tracked {self.done}{of} frames, {rate or 'no rate yet'}, {inliers}")


class NotebookProgress(Progress):
    """Progress line in a notebook's output, without control characters or widgets."""

    def __init__(self, frames: int | None, objects: int) -> None:
        from IPython.display import display

        super().__init__(frames, objects)
        self._started = self._last_update = time.monotonic()
        self._line: Any = display(_Line("Tracking"), display_id=True)  # the handle that updates it

    def _report(self) -> None:
        done, frames, now = self.done, self._frames, time.monotonic()
        if now - self._last_update < MIN_UPDATE_SECONDS and done != frames:
            return
        self._last_update = now
        filled = BAR_WIDTH * done // frames if frames else 0
        bar = f"{'█' * filled}{'░' * (BAR_WIDTH - filled)} {done} of {frames}" if frames else str(done)
        rate = (done - self._skipped) / max(now - self._started, 1e-9)
        self._line.update(_Line(f"Tracking {bar} frames, {rate:.1f} per second"))

    def report_smoothing_round(self, number: int) -> None:
        self._line.update(_Line(f"Refining all poses jointly, round {number}"))

    def end(self) -> None:
        """Show the final number of frames and the time."""
        seconds = time.monotonic() - self._started
        self._line.update(_Line(f"{self.done} frames in {seconds:.1f} s"))


class _Line:
    """Text that a notebook shows without quotes."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


@contextmanager
def show_progress(
    progress: bool | ProgressCallback | None, cameras: int, frames: int | None, objects: int
) -> Iterator[Progress]:
    """Show the progress of a run within a `with` block.

    Args:
        progress: True for a bar or notebook line, None or False for nothing, or a function to call.
        cameras: number of cameras.
        frames: total number of frames, including those of an interrupted run; None if unknown.
        objects: number of objects.

    Raises:
        TypeError: another type of `progress`.
    """
    if progress is None or progress is False:
        yield Progress(frames, objects)
    elif callable(progress):
        yield Progress(frames, objects, progress)
    elif progress is not True:
        raise TypeError(f"progress must be True, None or a function, got an object of type {type(progress).__name__}")
    elif "ipykernel" in sys.modules:
        line = NotebookProgress(frames, objects)
        try:
            yield line
        finally:
            line.end()
    else:
        with TrackingProgress(cameras, frames, objects) as bar:
            yield bar
