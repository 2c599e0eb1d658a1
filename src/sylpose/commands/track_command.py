"""`sylpose track` in a terminal: warnings, progress bar, interrupts and summary."""

from __future__ import annotations

import shlex
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.report.json_lines import format_pose_line
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.runs import console_output
from sylpose.runs.check import check_session, list_errors, locate_object
from sylpose.runs.pose_stream import STDOUT, open_pose_stream
from sylpose.runs.precompile import compile_with_progress
from sylpose.runs.progress import TrackingProgress
from sylpose.runs.results_folder import EARLIER
from sylpose.runs.run import Run, output_path, result_unit, track_session
from sylpose.runs.session_warnings import boxes_hint
from sylpose.tracking.tracked_frame import TrackedFrame

if TYPE_CHECKING:
    from sylpose.browser.live_page import LivePage

__all__ = ["run_track_command"]


def run_track_command(
    session: Session | LiveSession,
    out: Path | None,
    *,
    quiet: bool = False,
    verbose: bool = False,
    poses: str | None = None,
    show: bool = False,
    port: int = 0,
    browser: bool = True,
    **options: Any,
) -> Run:
    """Run `track_session` with terminal output.

    The first Ctrl-C ends the run after the current frame, the second one immediately. A live session ends as if its
    cameras had stopped.

    Args:
        session: as in `track_session`.
        out: as in `track_session`.
        quiet: print only warnings, on stderr.
        verbose: print one line per frame.
        poses: destination of the pose stream (`runs.pose_stream`); if it is stdout, all other output goes to stderr.
        show: show the run on a page in the browser (`browser.live_page`).
        port: port of that page.
        browser: open the page in the browser.
        options: the options of `track_session`.

    Returns:
        The result of `track_session`.

    Raises:
        KeyboardInterrupt: with a message.
        ValueError, OSError: as `track_session`; both quiet and verbose; an invalid stream destination.
    """
    if quiet and verbose:
        raise ValueError("--quiet and --verbose exclude each other")
    with ExitStack() as stack:
        stream_pose = None if poses is None else stack.enter_context(open_pose_stream(poses))
        known = next(iter((options.get("known") or {}).values()), None)
        rig = Rig(session.rig.cameras, result_unit(session.rig, known))
        page = (
            stack.enter_context(_serve_live_page(session, rig, out, port, browser, poses == STDOUT)) if show else None
        )
        return _track_with_output(session, out, stream_pose, page, poses == STDOUT, quiet, verbose, options)


@contextmanager
def _serve_live_page(
    session: Session | LiveSession, rig: Rig, out: Path | None, port: int, browser: bool, to_stdout: bool
) -> Iterator[LivePage]:
    """Serve a page that shows the run while it is tracked; `rig` has the unit of its poses."""
    from sylpose.browser.live_page import LivePage
    from sylpose.browser.server import open_browser, serve_viewer

    with (
        serve_viewer(port=port) as (server, url),
        LivePage(server, rig, session.objects, session.path.resolve().name) as page,
    ):
        opened = browser and open_browser(url)
        console = console_output.make_console(stderr=to_stdout)
        console.print(f"{'Opened' if opened else 'Open'} {url} in a browser.", soft_wrap=True)
        yield page
    if page.error:
        console_output.print_to_stderr(page.error)
    console.print(f"To see it again: sylpose show {shlex.quote(str(output_path(session, out)))}", soft_wrap=True)


def _track_with_output(
    session: Session | LiveSession,
    out: Path | None,
    stream_pose: Callable[[str], None] | None,
    page: LivePage | None,
    to_stdout: bool,
    quiet: bool,
    verbose: bool,
    options: dict[str, Any],
) -> Run:
    console = console_output.make_console(stderr=to_stdout, quiet=quiet)
    warning_console = console_output.make_console(stderr=True) if quiet else console
    known = options.get("known") or {}  # their boxes are not used
    object_boxes = {name: locate_object(session.select_object(name)) for name in session.objects if name not in known}
    if errors := list_errors(object_boxes):
        raise ValueError(f"{'; '.join(errors)}; correct the boxes: {boxes_hint(session)}")
    console.print(console_output.format_headline(session))
    if session.world is not None:
        console.print(f"World: {session.world.description or 'from a file'}.", highlight=False)
    start, stop, every = options.get("start", 0), options.get("stop"), options.get("every", 1)
    console_output.print_warnings(warning_console, check_session(session, start))
    if offsets := {name: seconds for name, seconds in (options.get("offsets") or {}).items() if seconds}:
        offsets_text = ", ".join(f"{name} {1000 * seconds:.4g} ms" for name, seconds in offsets.items())
        console.print(f"Time offsets: {offsets_text} (from --offsets, or offsets.toml in the recording).")
    frames = None
    if session.n_frames is not None:
        frames = len(range(start, session.n_frames if stop is None else min(stop, session.n_frames), max(every, 1)))
    elif stop is not None:
        frames = len(range(start, stop, max(every, 1)))
    problems: list[str] = []
    last: TrackedFrame | None = None
    units = {name: result_unit(session.rig, known.get(name)) for name in session.objects}
    compile_with_progress(console)
    with (
        TrackingProgress(len(session.rig), frames, len(session.objects), quiet=quiet) as progress,
        _defer_interrupts(session) as is_interrupted,
    ):

        def on_problem(problem: str) -> None:
            problems.append(problem)
            if isinstance(session, LiveSession):  # report at once: it may run for hours
                console_output.print_warnings(warning_console, [problem])

        def on_frame(tracked: TrackedFrame) -> None:
            nonlocal last
            last = tracked
            progress.update(tracked)

        def on_pose(name: str, pose: FramePose) -> None:
            if page is not None and last is not None:
                page.update(name, last)  # `last` is the same frame
            of = name if len(session.objects) > 1 else ""
            if verbose:
                console.print(
                    console_output.format_frame_line(of, pose, session.rig.names, units[name]), soft_wrap=True
                )
            if stream_pose is not None:
                stream_pose(format_pose_line(pose, session.rig.names, units[name], **({"object": of} if of else {})))

        def on_smoothing(number: int) -> None:
            progress.report_smoothing_round(number)
            if page is not None:
                page.show_status("All poses are refined jointly.")

        def on_resume(done: int) -> None:
            console.print(f"Resuming after {done} of {frames} frames.")
            progress.skip(done)

        try:
            run = track_session(
                session,
                out,
                on_resume=on_resume,
                on_frame=on_frame,
                on_pose=on_pose,
                on_smoothing=on_smoothing,
                on_problem=on_problem,
                interrupted=is_interrupted,
                **options,
            )
        except BaseException as error:
            progress.stop()
            if not isinstance(session, LiveSession):
                console_output.print_warnings(warning_console, problems)
            of = "" if frames is None else f" of {frames}"
            folder = output_path(session, out)
            progress_text = f"after {progress.done}{of} frames; the results so far are in {folder}"
            if (folder / EARLIER).exists():
                progress_text += f", earlier results in {folder / EARLIER}"
            if isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt(f"interrupted {progress_text}") from None
            if progress.tracked:
                console_output.print_to_stderr(f"stopped {progress_text}")
            raise
    console.print()
    console_output.print_summary(console, run, progress.tracked)
    if quiet and not isinstance(session, LiveSession):
        console_output.print_warnings(warning_console, run.problems)
    return run


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
