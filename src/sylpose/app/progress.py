"""How far a run has come: as a bar in a terminal, as a line in a notebook, or told to whoever asks."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from sylpose.app.console import make_console, say
from sylpose.results import FrameStatus
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["Progress", "TrackingProgress", "Watcher", "watched"]

# Is called with the numbers of frames that are tracked and that there are, None where nobody knows.
Watcher = Callable[[int, int | None], None]
# A notebook's line changes no more often than this, seconds (choice).
OFTEN = 0.2
# Characters of a notebook's bar (choice).
WIDTH = 30
# Seconds between two lines of progress where there is no terminal (choice).
BETWEEN_LINES = 20.0


class Progress(Protocol):
    """What is told of a run."""

    def skip(self, frames: int) -> None:
        """Frames that an earlier run has tracked."""

    def update(self, tracked: TrackedFrame) -> None:
        """One frame of one object more."""

    def smoothing(self, number: int) -> None:
        """One round more in which all poses are refined together."""


class Counted:
    """Calls somebody after each frame.

    Args:
        watcher: is called.
        frames: how many there are, or None.
        objects: `update` is called for each of them.
    """

    def __init__(self, watcher: Watcher, frames: int | None, objects: int) -> None:
        self._watcher, self._frames, self._objects = watcher, frames, objects
        self._skipped, self._updates = 0, 0

    def skip(self, frames: int) -> None:
        self._skipped = frames
        self._watcher(frames, self._frames)

    def update(self, tracked: TrackedFrame) -> None:  # noqa: ARG002
        self._updates += 1
        if self._updates % self._objects == 0:
            self._watcher(self._skipped + self._updates // self._objects, self._frames)

    def smoothing(self, number: int) -> None:
        pass


class TrackingProgress:
    """A progress bar on stderr, where that is no terminal a line every twenty seconds: frames, frames per second, inliers.

    A context manager; `update` is what `track_session` takes as `on_frame`.

    Args:
        cameras: how many.
        frames: how many, with those that are skipped; None when nobody knows.
        objects: `update` is called for each of them.
        quiet: nothing is shown.
    """

    def __init__(self, cameras: int, frames: int | None, objects: int = 1, *, quiet: bool = False) -> None:
        self._updates, self._skipped, self._objects = 0, 0, objects
        self._said = time.monotonic()
        console = make_console(stderr=True, quiet=quiet)
        self._quiet = quiet
        self._progress = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(f"{cameras} camera{'s' if cameras > 1 else ''}"),
            TextColumn("{task.fields[rate]}"),
            TextColumn("{task.fields[inliers]}"),
            TimeRemainingColumn(compact=True),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._progress.add_task("Tracking", total=frames, rate="", inliers="")

    def __enter__(self) -> TrackingProgress:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Takes the bar away; twice does no harm."""
        self._progress.stop()

    @property
    def tracked(self) -> int:
        """Frames that all objects are tracked in."""
        return self._updates // self._objects

    @property
    def done(self) -> int:
        """Frames, those included that an earlier run has tracked."""
        return self._skipped + self.tracked

    def skip(self, frames: int) -> None:
        """Frames that an earlier run has tracked."""
        self._skipped = frames
        self._progress.update(self._task, completed=frames)

    def smoothing(self, number: int) -> None:
        """One round more in which all poses are refined together."""
        self._progress.update(self._task, description="Refining", total=None, rate=f"round {number}", inliers="")

    def update(self, tracked: TrackedFrame) -> None:
        """One frame of one object more."""
        self._updates += 1
        pose = tracked.pose
        measured = pose.measured and pose.status is not FrameStatus.FIRST
        inliers = f"{int(pose.inliers.sum())} inliers" if measured else pose.reason or pose.status.value
        elapsed = self._progress.tasks[0].elapsed
        rate = f"{self.tracked / elapsed:.1f} frames/s" if elapsed else ""
        self._progress.update(self._task, completed=self.done, rate=rate, inliers=inliers)
        now = time.monotonic()
        if self._progress.disable and not self._quiet and now - self._said >= BETWEEN_LINES:
            self._said = now
            total = self._progress.tasks[0].total
            of = "" if total is None else f" of {total:.0f}"
            say(f"tracked {self.done}{of} frames, {rate or 'no rate yet'}, {inliers}")


class NotebookLine(Counted):
    """A line in a notebook's output that changes: neither a terminal's control characters nor a widget are needed."""

    def __init__(self, frames: int | None, objects: int) -> None:
        super().__init__(self._tell, frames, objects)
        self._began = self._said = time.monotonic()
        self._shown = _display(_Line("Tracking"))

    def _tell(self, done: int, frames: int | None) -> None:
        now = time.monotonic()
        if now - self._said < OFTEN and done != frames:
            return
        self._said = now
        filled = WIDTH * done // frames if frames else 0
        bar = f"{'█' * filled}{'░' * (WIDTH - filled)} {done} of {frames}" if frames else str(done)
        rate = (done - self._skipped) / max(now - self._began, 1e-9)
        self._shown.update(_Line(f"Tracking {bar} frames, {rate:.1f} per second"))

    def smoothing(self, number: int) -> None:
        self._shown.update(_Line(f"Refining all poses together, round {number}"))

    def end(self) -> None:
        """The last that is said."""
        done, seconds = self._skipped + self._updates // self._objects, time.monotonic() - self._began
        self._shown.update(_Line(f"{done} frames in {seconds:.1f} s"))


class _Line:
    """Text that a notebook shows as it is."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


def _display(line: _Line) -> Any:
    """Shows it; gives what it can be changed by."""
    from IPython.display import display

    return display(line, display_id=True)


@contextmanager
def watched(progress: bool | Watcher | None, cameras: int, frames: int | None, objects: int) -> Iterator[Progress]:
    """What is told of a run, while it lasts.

    Args:
        progress: True for a bar, None or False for none, or whom to call.
        cameras: how many.
        frames: how many, with those that an earlier run has tracked; None when nobody knows.
        objects: how many.

    Raises:
        TypeError: progress is nothing of that kind.
    """
    if progress is None or progress is False:
        yield Counted(lambda done, frames: None, frames, objects)  # noqa: ARG005
    elif callable(progress):
        yield Counted(progress, frames, objects)
    elif progress is not True:
        raise TypeError(f"progress must be True, None or a function, got an object of type {type(progress).__name__}")
    elif "ipykernel" in sys.modules:
        line = NotebookLine(frames, objects)
        try:
            yield line
        finally:
            line.end()
    else:
        with TrackingProgress(cameras, frames, objects) as bar:
            yield bar
