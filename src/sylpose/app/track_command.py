"""`track_session` for a terminal: what is known before, a progress bar, interrupts, what was found."""

from __future__ import annotations

import shlex
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sylpose.app import console_output
from sylpose.app.check import concerns, object_place, obstacles
from sylpose.app.pose_stream import STDOUT, listener
from sylpose.app.precompile import compile_aloud
from sylpose.app.progress import TrackingProgress
from sylpose.app.results_folder import EARLIER
from sylpose.app.run import Run, output_path, track_session, unit_of
from sylpose.app.session_warnings import boxes_by
from sylpose.capture import Session
from sylpose.capture.live import LiveSession
from sylpose.report.json_lines import pose_line
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.tracking.tracked_frame import TrackedFrame

if TYPE_CHECKING:
    from sylpose.app.live_page import LivePage

__all__ = ["track_aloud", "why_nothing"]


def track_aloud(
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
    """`track_session` with everything that is said about it; `options` are those of `track_session`.

    Ctrl-C ends the run after the present frame, twice at once. Live sessions end with it as if the cameras had ended.

    Args:
        quiet: only what looks wrong is said, on stderr.
        verbose: a line for each frame.
        poses: who is told each pose (`app.pose_stream`); where that is stdout, everything else goes to stderr.
        show: what is tracked is shown on a page meanwhile (`app.live_page`), at this port, in the browser.

    Raises:
        KeyboardInterrupt: with a sentence.
        ValueError, OSError: as `track_session`; both quiet and verbose; a listener that there cannot be.
    """
    if quiet and verbose:
        raise ValueError("--quiet and --verbose exclude each other")
    with ExitStack() as stack:
        tell = None if poses is None else stack.enter_context(listener(poses))
        known = next(iter((options.get("known") or {}).values()), None)
        rig = Rig(session.rig.cameras, unit_of(session.rig, known))
        page = stack.enter_context(_shown(session, rig, out, port, browser, poses == STDOUT)) if show else None
        return _track_aloud(session, out, tell, page, poses == STDOUT, quiet, verbose, options)


@contextmanager
def _shown(
    session: Session | LiveSession, rig: Rig, out: Path | None, port: int, browser: bool, to_stdout: bool
) -> Iterator[LivePage]:
    """A page on which a run is shown while it goes on; `rig` has its poses' unit."""
    from sylpose.app.live_page import LivePage
    from sylpose.app.local_page import open_browser
    from sylpose.app.viewer_server import viewer_server

    with (
        viewer_server(port=port) as (server, url),
        LivePage(server, rig, session.objects, session.path.resolve().name) as page,
    ):
        opened = browser and open_browser(url)
        console = console_output.make_console(stderr=to_stdout)
        console.print(f"{'Opened' if opened else 'Open'} {url} in a browser.", soft_wrap=True)
        yield page
    if page.failed:
        console_output.say(page.failed)
    console.print(f"To see it again: sylpose show {shlex.quote(str(output_path(session, out)))}", soft_wrap=True)


def _track_aloud(
    session: Session | LiveSession,
    out: Path | None,
    tell: Callable[[str], None] | None,
    page: LivePage | None,
    to_stdout: bool,
    quiet: bool,
    verbose: bool,
    options: dict[str, Any],
) -> Run:
    console = console_output.make_console(stderr=to_stdout, quiet=quiet)
    warned = console_output.make_console(stderr=True) if quiet else console
    known = options.get("known") or {}  # boxes of those are not used
    places = {name: object_place(session.of(name)) for name in session.objects if name not in known}
    if wrong := obstacles(places):
        raise ValueError(f"{'; '.join(wrong)} ({boxes_by(session)} anew)")
    console.print(console_output.headline(session))
    if session.world is not None:
        console.print(f"World: {session.world.said or 'of a file'}.", highlight=False)
    start, stop, every = options.get("start", 0), options.get("stop"), options.get("every", 1)
    console_output.print_warnings(warned, concerns(session, start))
    if offsets := {name: seconds for name, seconds in (options.get("offsets") or {}).items() if seconds}:
        late = ", ".join(f"{name} {1000 * seconds:.4g} ms" for name, seconds in offsets.items())
        console.print(f"Later than their times say: {late} (--offsets, or offsets.toml in the recording).")
    frames = None
    if session.n_frames is not None:
        frames = len(range(start, session.n_frames if stop is None else min(stop, session.n_frames), max(every, 1)))
    elif stop is not None:
        frames = len(range(start, stop, max(every, 1)))
    problems: list[str] = []
    last: TrackedFrame | None = None
    units = {name: unit_of(session.rig, known.get(name)) for name in session.objects}
    compile_aloud(console)
    with (
        TrackingProgress(len(session.rig), frames, len(session.objects), quiet=quiet) as progress,
        _interrupts(session) as asked,
    ):

        def on_problem(problem: str) -> None:
            problems.append(problem)
            if isinstance(session, LiveSession):  # it may go on for hours
                console_output.print_warnings(warned, [problem])

        def on_frame(tracked: TrackedFrame) -> None:
            nonlocal last
            last = tracked
            progress.update(tracked)

        def on_pose(name: str, pose: FramePose) -> None:
            if page is not None and last is not None:
                page.put(name, last)  # it is the same frame's
            of = name if len(session.objects) > 1 else ""
            if verbose:
                console.print(console_output.frame_line(of, pose, session.rig.names, units[name]), soft_wrap=True)
            if tell is not None:
                tell(pose_line(pose, session.rig.names, units[name], **({"object": of} if of else {})))

        def on_smoothing(number: int) -> None:
            progress.smoothing(number)
            if page is not None:
                page.say("All poses are refined together.")

        def on_resume(done: int) -> None:
            console.print(f"Going on after {done} of {frames} frames.")
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
                interrupted=asked,
                **options,
            )
        except BaseException as error:
            progress.stop()
            if not isinstance(session, LiveSession):
                console_output.print_warnings(warned, problems)
            of = "" if frames is None else f" of {frames}"
            folder = output_path(session, out)
            said = f"after {progress.done}{of} frames; what was computed is in {folder}"
            if (folder / EARLIER).exists():
                said += f", what was there before in {folder / EARLIER}"
            if isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt(f"interrupted {said}") from None
            if progress.tracked:
                console_output.say(f"stopped {said}")
            raise
    console.print()
    console_output.print_summary(console, run, progress.tracked)
    if quiet and not isinstance(session, LiveSession):
        console_output.print_warnings(warned, run.problems)
    return run


@contextmanager
def _interrupts(session: Session | LiveSession) -> Iterator[Callable[[], bool]]:
    """Within it the first Ctrl-C is only remembered; gives what tells whether there was one."""
    asked = threading.Event()
    before = signal.getsignal(signal.SIGINT)
    # Only the main thread may; and whoever ignores or handles interrupts has a reason.
    if threading.current_thread() is not threading.main_thread() or before is not signal.default_int_handler:
        yield asked.is_set
        return

    def remember(*_: object) -> None:
        signal.signal(signal.SIGINT, before)
        if isinstance(session, LiveSession):
            session.stop()  # the ordinary end of a live session
        else:
            asked.set()

    signal.signal(signal.SIGINT, remember)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def why_nothing(session: Session | LiveSession, run: Run) -> list[str]:
    """A sentence for each object that was found in no frame."""
    said = []
    for name, trajectory in run.trajectories.items():
        if console_output.solved(trajectory):
            continue
        prefix = f"{name}: " if len(run.trajectories) > 1 else ""
        statuses = [frame.status for frame in trajectory if frame.world_from_object is None]
        if not len(trajectory):
            said.append(f"{prefix}no frame was tracked")
        elif not statuses:
            said.append(f"{prefix}no motion could be found: there is only the first frame, to which all is relative")
        else:
            sentence = f"{prefix}no frame could be solved. {max(statuses, key=statuses.count).text}"
            if not session.of(name).boxes and session.masks is None:
                sentence += (
                    f" Boxes of the object in the first frame ({boxes_by(session)}) or masks (--masks) would help to find "
                    "it."
                )
            said.append(sentence)
    return said
