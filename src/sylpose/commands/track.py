"""`sylpose track`: warnings, progress bar, interrupts, live page, pose stream and summary of a run."""

from __future__ import annotations

import re
import shlex
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from sylpose.commands.app import (
    ADVANCED,
    INPUT,
    LIVE,
    OBJECT,
    OUTPUT,
    command,
    exit_with_failures,
    option,
    pick,
    print_message,
)
from sylpose.commands.options import (
    BoxesFile,
    EulerAxes,
    FrameOffset,
    MethodOptions,
    OutFolder,
    Overlay,
    PageOptions,
    PlotFormat,
    RangeOptions,
    RecordingOptions,
    RefineCalibration,
    Seed,
    Smooth,
    WorldOptions,
)
from sylpose.methods import MODES, format_methods_table

if TYPE_CHECKING:
    from sylpose.browser.viewer import LivePage
    from sylpose.io.capture import Session
    from sylpose.io.capture.live import LiveSession
    from sylpose.runs.options import RunOptions
    from sylpose.runs.run_result import Run

__all__ = ["TrackOptions", "open_pose_stream", "track", "track_in_terminal"]

STDOUT = "-"
_UDP = re.compile(r"udp://(\[[0-9a-fA-F:.%\w]+\]|[^\[\]/:]+):(\d{1,5})")


@dataclass(frozen=True, kw_only=True)
class TrackOptions(PageOptions, MethodOptions, WorldOptions, RangeOptions, RecordingOptions):
    """Options of `sylpose track`.

    Attributes:
        known: Express poses in the frame of an object.npz from another recording; for several objects, repeat with
            NAME=FILE.
        offsets: Read the cameras' time offsets in seconds (TOML); default: SESSION/offsets.toml if present.
        every: Track every N-th frame.
        quiet: Print only warnings, on stderr.
        verbose: Print one line per frame.
        follow: Track image folders that a recorder is still writing.
        no_drop: With --follow, track all frames, regardless of the delay.
        stream: Stream poses as JSON lines to stdout (-) or udp://HOST:PORT.
        show: Show the run in 3D on a page in the browser; see sylpose show.
        distributed: Run one node per camera over a simulated network: exact as in one process, or compact in fewer
            rounds.
        resume: Continue an interrupted run; requires the same options.
        checkpoint_seconds: Set the time between checkpoints for --resume.
    """

    boxes: BoxesFile = None
    known: Annotated[tuple[str, ...], option("--object [NAME=]FILE", OBJECT)] = ()
    frame_offset: FrameOffset = ()
    offsets: Annotated[Path | None, option("--offsets FILE", INPUT)] = None
    every: Annotated[int, option("--every N", INPUT)] = 1
    out: OutFolder = None
    overlay: Overlay = True
    angles: EulerAxes = None
    plot_format: PlotFormat = "png"
    quiet: Annotated[bool, option("--quiet -q", OUTPUT)] = False
    verbose: Annotated[bool, option("--verbose -v", OUTPUT)] = False
    follow: Annotated[bool, option("--follow", LIVE)] = False
    no_drop: Annotated[bool, option("--no-drop", LIVE)] = False
    stream: Annotated[str | None, option("--stream TO", LIVE)] = None
    show: Annotated[bool, option("--show", LIVE)] = False
    smooth: Smooth = None
    refine_calibration: RefineCalibration = False
    distributed: Annotated[str | None, option(f"--simulate-nodes {'|'.join(MODES)}", ADVANCED)] = None
    resume: Annotated[bool, option("--resume", ADVANCED)] = False
    checkpoint_seconds: Annotated[float, option("--checkpoint SEC", ADVANCED, min=0)] = 20.0
    seed: Seed = 0

    def __post_init__(self) -> None:
        """Check the options that exclude each other."""
        super().__post_init__()
        if self.quiet and self.verbose:
            raise ValueError("--quiet and --verbose exclude each other")

    def open_session(self) -> Session | LiveSession:
        """Open the recording, or with `follow` or a live.toml the live session, in the requested world and unit.

        Raises:
            ValueError, OSError: as `open_session` and `open_live`; options that do not apply to the kind of session.
        """
        from sylpose.io.capture.live import is_live, open_live

        if not (self.follow or is_live(self.session)):
            if self.no_drop:
                raise ValueError("--no-drop requires --follow (growing folders)")
            return self.apply_to(self.open(self.boxes, self.frame_offset))
        for name, value, reason in (
            (
                "exclude-camera",
                self.exclude_camera,
                "of live cameras and growing folders, all cameras of the calibration are used",
            ),
            ("video", self.video, "live.toml assigns live cameras, and growing folders are assigned by name"),
            (
                "frame-offset",
                self.frame_offset,
                "frames of live cameras are matched by their timestamps; set delays with --offsets FILE",
            ),
            ("resume", self.resume, "a live session cannot be resumed"),
        ):
            if value:
                raise ValueError(f"--{name}: {reason}")
        live = open_live(
            self.session,
            calibration=self.calibration,
            boxes=self.boxes,
            masks=self.masks,
            follow=self.follow,
            lossless=self.no_drop,
            rate=self.rate,
        )
        return self.apply_to(live)

    def run_options(self, session: Session | LiveSession) -> RunOptions:
        """Return the options of the run, with the files of objects and time offsets read.

        Raises:
            ValueError, OSError: as `load_known_objects`, `find_offsets` and `RunOptions`.
        """
        from sylpose.io.object_files import load_known_objects
        from sylpose.runs.options import RunOptions
        from sylpose.sync.offsets import find_offsets

        known = load_known_objects(self.known, session.objects, session.rig)
        return pick(self, RunOptions, offsets=find_offsets(session, self.offsets), known=known)


@command("Track an object in a recording or live cameras.", notes=f"\b\n{format_methods_table()}\n")
def track(options: TrackOptions) -> None:
    """Track the pose of an object in a recording or in live cameras (a folder with live.toml).

    Writes trajectory.tum (time tx ty tz qx qy qz qw), trajectory.csv (with angles, uncertainty, status, inliers and
    residuals), report.html, report.png and overlay.mp4 into OUT; several objects get one folder each. Without boxes and
    masks, whatever moves against the static background is tracked.

    Examples:
        sylpose track recording
        sylpose track recording --boxes first_frame.toml --out results
        sylpose track recording --start 100 --stop 400 --every 2 --frame-offset cam_2=5
    """
    from sylpose.runs.check import check_session, describe_axis_miss, explain_failures
    from sylpose.runs.run import has_finished, output_path

    session = options.open_session()
    if options.resume and has_finished(session, options.out):
        print(f"{output_path(session, options.out)}: the run there has ended; there is nothing to resume")
        return
    run = track_in_terminal(session, options)
    missing = explain_failures(session, run)
    # Warnings from the start of the run may be the cause and have scrolled away: repeat them.
    hints = (*check_session(session, options.start), describe_axis_miss(session.rig)) if missing else ()
    sentences = [sentence for sentence in (*missing, *hints) if sentence]
    if len(missing) == len(run.trajectories):
        exit_with_failures(sentences)
    for sentence in sentences:
        print_message(sentence)


def track_in_terminal(session: Session | LiveSession, options: TrackOptions) -> Run:
    """Run `track_session` with terminal output.

    The first Ctrl-C ends the run after the current frame, the second one immediately. A live session ends as if its
    cameras had stopped. If poses are streamed to stdout, all other output goes to stderr.

    Args:
        session: as in `track_session`.
        options: those of the command; the session is open already.

    Returns:
        The result of `track_session`.

    Raises:
        KeyboardInterrupt: with a message.
        ValueError, OSError: as `track_session`; an invalid stream destination.
    """
    from sylpose.runs.precompile import compile_with_progress
    from sylpose.runs.run import track_session
    from sylpose.runs.run_display import RunDisplay, defer_interrupts

    run_options = options.run_options(session)
    with ExitStack() as stack:
        send = None if options.stream is None else stack.enter_context(open_pose_stream(options.stream))
        page = stack.enter_context(_serve_live_page(session, options, run_options)) if options.show else None
        display = RunDisplay(
            session,
            options.out,
            run_options,
            quiet=options.quiet,
            verbose=options.verbose,
            to_stderr=options.stream == STDOUT,
            send=send,
            page=page,
        )
        display.print_start()
        compile_with_progress(display.console)
        with display.progress, defer_interrupts(session) as is_interrupted:
            try:
                run = track_session(
                    session,
                    options.out,
                    run_options,
                    on_resume=display.on_resume,
                    on_frame=display.on_frame,
                    on_smoothing=display.on_smoothing,
                    on_problem=display.on_problem,
                    interrupted=is_interrupted,
                )
            except BaseException as error:
                display.print_stop(error)
                raise
        display.print_end(run)
    return run


@contextmanager
def _serve_live_page(
    session: Session | LiveSession, options: TrackOptions, run_options: RunOptions
) -> Iterator[LivePage]:
    """Serve a page that shows the run while it is tracked."""
    from sylpose.browser.server import open_browser, serve_viewer
    from sylpose.browser.viewer import LivePage
    from sylpose.rig import Rig
    from sylpose.runs import console_output
    from sylpose.runs.run import name_known_objects, output_path, result_units

    units = result_units(session, name_known_objects(session, run_options.known))
    rig = Rig(session.rig.cameras, next(iter(units.values())))
    with (
        serve_viewer(port=options.port) as (server, url),
        LivePage(server, rig, session.objects, session.path.resolve().name) as page,
    ):
        opened = options.browser and open_browser(url)
        console = console_output.make_console(stderr=options.stream == STDOUT)
        console.print(f"{'Opened' if opened else 'Open'} {url} in a browser.", soft_wrap=True)
        yield page
    if page.error:
        console_output.print_to_stderr(page.error)
    folder = shlex.quote(str(output_path(session, options.out)))
    console.print(f"To see it again: sylpose show {folder}", soft_wrap=True)


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
