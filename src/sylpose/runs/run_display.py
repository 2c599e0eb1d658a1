"""Display of a run in a terminal: warnings, progress bar, frames, interrupts and summary."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.report.files import format_pose_line
from sylpose.runs import console_output
from sylpose.runs.check import boxes_hint, check_session, list_errors, locate_object
from sylpose.runs.options import RunOptions
from sylpose.runs.progress import TrackingProgress
from sylpose.runs.results_folder import EARLIER
from sylpose.runs.run import name_known_objects, output_path, result_units
from sylpose.runs.run_result import Run
from sylpose.tracking.tracked_frame import TrackedFrame

if TYPE_CHECKING:
    from sylpose.browser.viewer import LivePage

__all__ = ["RunDisplay", "defer_interrupts"]


class RunDisplay:
    """Terminal output of a run, its live page and its pose stream.

    Args:
        session, out, options: as for `track_session`.
        quiet: print only warnings, on stderr.
        verbose: print one line per frame.
        to_stderr: print everything on stderr.
        send: sends a line of the pose stream; None without one.
        page: the live page; None without one.
    """

    def __init__(
        self,
        session: Session | LiveSession,
        out: Path | str | None,
        options: RunOptions,
        *,
        quiet: bool,
        verbose: bool,
        to_stderr: bool,
        send: Callable[[str], None] | None,
        page: LivePage | None,
    ) -> None:

        self._session, self._folder, self._options = session, output_path(session, out), options
        self._quiet, self._verbose, self._send, self._page = quiet, verbose, send, page
        self.console = console_output.make_console(stderr=to_stderr, quiet=quiet)
        self._warning_console = console_output.make_console(stderr=True) if quiet else self.console
        ends = [end for end in (session.n_frames, options.stop) if end is not None]
        self._total = len(range(options.start, min(ends), max(options.every, 1))) if ends else None
        self._known = name_known_objects(session, options.known)
        self._units = result_units(session, self._known)
        self._is_live = session.n_frames is None
        self._problems: list[str] = []
        self.progress = TrackingProgress(len(session.rig), self._total, len(session.objects), quiet=quiet)

    def print_start(self) -> None:
        """Print the session and its warnings.

        Raises:
            ValueError: boxes that cannot belong to one object.
        """
        session = self._session
        measured = [name for name in session.objects if name not in self._known]  # boxes of known ones are not used
        locations = {name: locate_object(session.select_object(name)) for name in measured}
        if errors := list_errors(locations):
            raise ValueError(f"{'; '.join(errors)}; correct the boxes: {boxes_hint(session)}")
        self.console.print(console_output.format_headline(session))
        if session.world is not None:
            self.console.print(f"World: {session.world.description or 'from a file'}.", highlight=False)
        self._print_warnings(check_session(session, self._options.start))
        if offsets := {name: seconds for name, seconds in (self._options.offsets or {}).items() if seconds}:
            text = ", ".join(f"{name} {1000 * seconds:.4g} ms" for name, seconds in offsets.items())
            self.console.print(f"Time offsets: {text} (from --offsets, or offsets.toml in the recording).")

    def _print_warnings(self, warnings: Sequence[str]) -> None:

        console_output.print_warnings(self._warning_console, warnings)

    def on_problem(self, problem: str) -> None:
        """Store a problem; of a live session, which may run for hours, print it at once."""
        self._problems.append(problem)
        if self._is_live:
            self._print_warnings([problem])

    def on_frame(self, name: str, tracked: TrackedFrame) -> None:
        """Show and stream a frame of one object."""
        self.progress.update(tracked)
        if self._page is not None:
            self._page.update(name, tracked)
        of = name if len(self._session.objects) > 1 else ""
        cameras, unit = self._session.rig.names, self._units[name]
        if self._verbose:
            line = console_output.format_frame_line(of, tracked.pose, cameras, unit)
            self.console.print(line, soft_wrap=True)
        if self._send is not None:
            self._send(format_pose_line(tracked.pose, cameras, unit, **({"object": of} if of else {})))

    def on_smoothing(self, number: int) -> None:
        """Show a round of the joint refinement."""
        self.progress.report_smoothing_round(number)
        if self._page is not None:
            self._page.show_status("All poses are refined jointly.")

    def on_resume(self, done: int) -> None:
        """Show the frames of the interrupted run."""
        self.console.print(f"Resuming after {done} of {self._total} frames.")
        self.progress.skip(done)

    def print_stop(self, error: BaseException) -> None:
        """Print what there is of a run that did not end.

        Raises:
            KeyboardInterrupt: with a message, if the run was interrupted.
        """
        self.progress.stop()
        if not self._is_live:
            self._print_warnings(self._problems)
        of = "" if self._total is None else f" of {self._total}"
        text = f"after {self.progress.done}{of} frames; the results so far are in {self._folder}"
        if (self._folder / EARLIER).exists():
            text += f", earlier results in {self._folder / EARLIER}"
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(f"interrupted {text}") from None
        if self.progress.tracked:
            console_output.print_to_stderr(f"stopped {text}")

    def print_end(self, run: Run) -> None:
        """Print the summary of a finished run."""
        self.console.print()
        console_output.print_summary(self.console, run, self.progress.tracked)
        if self._quiet and not self._is_live:
            self._print_warnings(run.problems)


@contextmanager
def defer_interrupts(session: Session | LiveSession) -> Iterator[Callable[[], bool]]:
    """Defer the first Ctrl-C; yield a function that returns whether it was pressed."""
    pressed = threading.Event()
    previous = signal.getsignal(signal.SIGINT)
    # Only the main thread can set handlers, and an application's own handler is kept.
    if threading.current_thread() is not threading.main_thread() or previous is not signal.default_int_handler:
        yield pressed.is_set
        return

    def handle(*_: object) -> None:
        signal.signal(signal.SIGINT, previous)
        if isinstance(session, LiveSession):
            session.stop()  # the regular end of a live session
        else:
            pressed.set()

    signal.signal(signal.SIGINT, handle)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, previous)
