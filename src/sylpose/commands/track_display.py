"""Display of a run in a terminal: warnings, progress bar, interrupts, live page, pose stream and summary."""

from __future__ import annotations

import re
import shlex
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from sylpose.commands.options import DisplayOptions
from sylpose.input_limits import print_message
from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.report.files import format_pose_line
from sylpose.runs import console_output
from sylpose.runs.check import boxes_hint, check_session, list_errors, locate_object
from sylpose.runs.options import RunOptions
from sylpose.runs.precompile import compile_with_progress
from sylpose.runs.progress import TrackingProgress
from sylpose.runs.results_folder import EARLIER
from sylpose.runs.run import name_known_objects, output_path, result_units, track_session
from sylpose.runs.run_result import Run
from sylpose.tracking.context import TrackedFrame

if TYPE_CHECKING:
    from sylpose.browser.viewer import LivePage


STDOUT = "-"
_UDP = re.compile(r"udp://(\[[0-9a-fA-F:.%\w]+\]|[^\[\]/:]+):(\d{1,5})")


def track_in_terminal(
    session: Session | LiveSession,
    out: Path | None,
    options: RunOptions,
    shown: DisplayOptions,
    *,
    on_frame: Callable[[TrackedFrame], None] | None = None,
    on_end: Callable[[Run], None] | None = None,
) -> Run:
    """Run `track_session` with terminal output.

    The first Ctrl-C ends the run after the current frame, the second one immediately. A live session ends as if its
    cameras had stopped. If poses are streamed to stdout, all other output goes to stderr.

    Args:
        session, out, options: as in `track_session`.
        shown: what is shown, and where.
        on_frame: called with each frame of each object.
        on_end: called with the run after its summary; the last line, after that, names the page to open.

    Returns:
        The result of `track_session`.

    Raises:
        KeyboardInterrupt: with a message.
        ValueError, OSError: as `track_session`; an invalid stream destination.
    """
    with ExitStack() as stack:
        display = _RunDisplay(session, output_path(session, out), options, shown)

        def show_frame(name: str, tracked: TrackedFrame) -> None:
            display.on_frame(name, tracked)
            if on_frame is not None:
                on_frame(tracked)

        if shown.stream is not None:
            display.send = stack.enter_context(open_pose_stream(shown.stream))
        if shown.show:
            display.page = stack.enter_context(display.serve_live_page())
        display.start()
        with display.progress, _defer_interrupts(session) as is_interrupted:
            try:
                run = track_session(
                    session,
                    out,
                    options,
                    on_resume=display.on_resume,
                    on_frame=show_frame,
                    on_smoothing=display.on_smoothing,
                    on_problem=display.on_problem,
                    interrupted=is_interrupted,
                )
            except BaseException as error:
                display.print_stop(error)
                raise
        display.print_end(run)
        if on_end is not None:
            on_end(run)
        display.print_page_hint(run)
    return run


class _RunDisplay:
    """Terminal output of a run, its live page and its pose stream.

    Args:
        session, options, shown: as for `track_in_terminal`.
        folder: folder of the results.

    Attributes:
        send: sends a line of the pose stream; None without one.
    """

    progress: TrackingProgress
    page: LivePage | None = None
    send: Callable[[str], None] | None = None

    def __init__(
        self, session: Session | LiveSession, folder: Path, options: RunOptions, shown: DisplayOptions
    ) -> None:
        self._session, self._folder, self._options = session, folder, options
        self._shown, self._to_stderr = shown, shown.stream == STDOUT
        self._console = console_output.make_console(stderr=self._to_stderr, quiet=shown.quiet)
        self._warning_console = console_output.make_console(stderr=True) if shown.quiet else self._console
        ends = [end for end in (session.n_frames, options.stop) if end is not None]
        self._total = len(range(options.start, min(ends), max(options.every, 1))) if ends else None
        self._known = name_known_objects(session, options.known)
        self._units = result_units(session, self._known, has_mesh=options.mesh is not None)
        self._is_live = session.n_frames is None
        self._problems: list[str] = []

    def start(self) -> None:
        """Print the session and its warnings, compile the kernels if necessary, and create the progress bar.

        Raises:
            ValueError: boxes that cannot belong to one object.
        """
        session = self._session
        # Boxes of known ones are not used.
        measured = [name for name in session.objects if name not in self._known and self._options.mesh is None]
        locations = {name: locate_object(session.select_object(name)) for name in measured}
        if errors := list_errors(locations):
            raise ValueError(f"{'; '.join(errors)}; correct the boxes: {boxes_hint(session)}")
        self._console.print(console_output.format_headline(session))
        if session.world is not None:
            self._console.print(f"World: {session.world.description or 'from a file'}.", highlight=False)
        self._print_warnings(check_session(session, self._options.start))
        console_output.print_offsets(self._console, self._options.offsets or {})
        compile_with_progress(self._console)
        quiet = self._shown.quiet
        self.progress = TrackingProgress(len(session.rig), self._total, len(session.objects), quiet=quiet)

    def _print_warnings(self, warnings: Sequence[str]) -> None:
        console_output.print_warnings(self._warning_console, warnings)

    @contextmanager
    def serve_live_page(self) -> Iterator[LivePage]:
        """Serve a page that shows the run while it is tracked."""
        from sylpose.browser.server import open_browser, serve_viewer
        from sylpose.browser.viewer import LivePage

        session, console = self._session, console_output.make_console(stderr=self._to_stderr)
        with (
            serve_viewer(port=self._shown.port) as (server, url),
            LivePage(server, session.rig, self._units, session.path.resolve().name) as page,
        ):
            opened = self._shown.browser and open_browser(url)
            console.print(f"{'Opened' if opened else 'Open'} {url} in a browser.", soft_wrap=True)
            yield page
        if page.error:
            print_message(page.error)
        console.print(f"To see it again: sylpose show {shlex.quote(str(self._folder))}", soft_wrap=True)

    def on_problem(self, problem: str) -> None:
        """Store a problem; of a live session, which may run for hours, print it at once."""
        self._problems.append(problem)
        if self._is_live:
            self._print_warnings([problem])

    def on_frame(self, name: str, tracked: TrackedFrame) -> None:
        """Show and stream a frame of one object."""
        self.progress.update(tracked)
        if self.page is not None:
            self.page.update(name, tracked)
        of = name if len(self._session.objects) > 1 else ""
        cameras, unit = self._session.rig.names, self._units[name]
        if self._shown.verbose:
            line = console_output.format_frame_line(of, tracked.pose, cameras, unit)
            self._console.print(line, soft_wrap=True)
        if self.send is not None:
            self.send(format_pose_line(tracked.pose, cameras, unit, **({"object": of} if of else {})))

    def on_smoothing(self, number: int) -> None:
        """Show a round of the joint refinement."""
        self.progress.report_smoothing_round(number)
        if self.page is not None:
            self.page.show_status("All poses are refined jointly.")

    def on_resume(self, done: int) -> None:
        """Show the frames of the interrupted run."""
        self._console.print(f"Resuming after {done} of {self._total} frames.")
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
            print_message(f"stopped {text}")

    def print_end(self, run: Run) -> None:
        """Print the summary of a finished run."""
        self._console.print()
        console_output.print_summary(self._console, run, self.progress.tracked)
        if self._shown.quiet and not self._is_live:
            self._print_warnings(run.problems)

    def print_page_hint(self, run: Run) -> None:
        """Print which file to open."""
        console_output.print_page_hint(self._console, run.files)


@contextmanager
def _defer_interrupts(session: Session | LiveSession) -> Iterator[Callable[[], bool]]:
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


@contextmanager
def open_pose_stream(destination: str) -> Iterator[Callable[[str], None]]:
    """Open a stream; yield a function that sends one line.

    Args:
        destination: "-" for stdout, or udp://HOST:PORT for one datagram per line; a receiver is not required.

    Raises:
        ValueError: neither of these, or an unknown host.
        BrokenPipeError: while sending, if the reader of stdout has closed it.
    """
    if destination == STDOUT:
        yield _print_line
        return
    match = _UDP.fullmatch(destination)
    if match is None or not 0 < int(match[2]) < 1 << 16:
        raise ValueError(f"--stream: expected - for stdout or udp://HOST:PORT, got {destination!r}")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            match[1].strip("[]"), int(match[2]), type=socket.SOCK_DGRAM
        )[0]
    except (OSError, UnicodeError):
        raise ValueError(f"--stream {destination}: no such host") from None
    with socket.socket(family, kind, protocol) as out:
        out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

        def send(line: str) -> None:
            with suppress(OSError):  # no receiver, or the network is down: the next line may arrive
                out.sendto(line.encode(), address)

        yield send


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
