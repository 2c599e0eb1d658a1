"""The command line: `sylpose track`, `check`, `demo` and `calibration convert`."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ParamSpec

import numpy as np
import typer

from sylpose import __version__
from sylpose.tracking import METHODS

if TYPE_CHECKING:
    from sylpose.app.run import Run
    from sylpose.capture import Session

# Everything else is imported where it is used: matplotlib alone takes a second, which `--help` does not need.

__all__ = ["main"]

P = ParamSpec("P")

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130


def examples(*lines: str) -> str:
    """Lines below a help text that are not run together."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


app = typer.Typer(
    name="sylpose",
    help="How a rigid object moves in 3D, from the videos of several calibrated cameras.",
    epilog=examples("sylpose demo", "sylpose check recording", "sylpose track recording"),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
calibration_app = typer.Typer(help="Calibration files: convert.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(calibration_app, name="calibration")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0, 1 nothing found, 2 wrong input, 130 interrupted."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a terminal without "°" gets "?" and not a crash
            stream.reconfigure(errors="replace")
    try:
        app(args=None if argv is None else list(argv), prog_name="sylpose")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def spoken(command: Callable[P, None]) -> Callable[P, None]:
    """Wrong input and interrupts end a command with a sentence and an exit code; bugs keep their traceback."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except KeyboardInterrupt as interrupt:
            _say(str(interrupt) or "interrupted")
            raise typer.Exit(INTERRUPTED) from None
        except (np.linalg.LinAlgError, BrokenPipeError):  # a bug; nobody reads any more, which Typer handles
            raise
        except (ValueError, OSError) as error:
            _say(_sentence(error))
            raise typer.Exit(WRONG_INPUT) from None

    return run


def _sentence(error: ValueError | OSError) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return str(error) or type(error).__name__


def _say(sentence: str) -> None:
    print(f"sylpose: {sentence}", file=sys.stderr)


SessionPath = Annotated[
    Path,
    typer.Argument(metavar="SESSION", help="Folder with one video (cam_0.mp4) or one folder of images per camera."),
]
CalibrationFile = Annotated[
    Path | None, typer.Option("--calibration", metavar="FILE", help="Calibration; found in SESSION when it is there.")
]
BoxesFile = Annotated[
    Path | None,
    typer.Option("--boxes", metavar="FILE", help="The object's boxes in the first frame; SESSION/boxes.toml if any."),
]
MasksFolder = Annotated[
    Path | None, typer.Option("--masks", metavar="DIR", help="Masks of the object; SESSION/masks if there is one.")
]
Offsets = Annotated[
    list[str] | None,
    typer.Option("--offset", metavar="CAM=N", help="A camera that starts N frames late; may be given several times."),
]
OutFolder = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Where the results go; SESSION/sylpose by default.")
]
Seed = Annotated[
    int, typer.Option("--seed", metavar="N", help="Of everything random: the same seed gives the same result.")
]


def _version(asked: bool) -> None:
    if asked:
        print(f"sylpose {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Say the version and exit.", is_eager=True, callback=_version)
    ] = False,
) -> None:
    pass


def _method(name: str) -> str:
    if name not in METHODS:
        raise typer.BadParameter(f"{name!r} is not one of {', '.join(METHODS)}")
    return name


@app.command(
    epilog=examples(
        "sylpose track recording",
        "sylpose track recording --boxes first_frame.toml --out results",
        "sylpose track recording --start 100 --stop 400 --every 2 --offset cam_2=5",
    )
)
@spoken
def track(
    session: SessionPath,
    calibration: CalibrationFile = None,
    boxes: BoxesFile = None,
    masks: MasksFolder = None,
    offset: Offsets = None,
    out: OutFolder = None,
    method: Annotated[
        str, typer.Option(metavar="|".join(METHODS), help="How the motion is estimated.", callback=_method)
    ] = METHODS[0],
    start: Annotated[int, typer.Option(metavar="N", help="The first frame to track.")] = 0,
    stop: Annotated[int | None, typer.Option(metavar="N", help="The frame to stop before; all by default.")] = None,
    every: Annotated[int, typer.Option(metavar="N", help="Track every n-th frame.")] = 1,
    overlay: Annotated[
        bool, typer.Option("--overlay/--no-overlay", help="Write overlay.mp4: poses and images.")
    ] = True,
    seed: Seed = 0,
) -> None:
    """The object's pose in every frame of a recording.

    Writes trajectory.tum (time tx ty tz qx qy qz qw), trajectory.csv (with angles, uncertainty, status, inliers and
    residuals), report.png and overlay.mp4 into OUT. Without boxes and masks, the object is what moves against the
    standing background.
    """
    from sylpose.capture import open_session

    opened = open_session(session, calibration=calibration, boxes=boxes, masks=masks, offsets=_offsets(offset))
    _track(opened, out, method=method, start=start, stop=stop, every=every, overlay=overlay, seed=seed)


def _track(
    session: Session,
    out: Path | None,
    *,
    method: str = METHODS[0],
    start: int = 0,
    stop: int | None = None,
    every: int = 1,
    overlay: bool = True,
    seed: int = 0,
) -> Run:
    """`track_session` with everything that is said about it."""
    from sylpose.app import text
    from sylpose.app.run import notes, track_session
    from sylpose.fit import warm_up

    console = text.make_console()
    console.print(text.headline(session))
    found = notes(session, start)
    if found:
        text.print_warnings(console, found)
    frames = len(range(start, session.n_frames if stop is None else min(stop, session.n_frames), max(every, 1)))
    problems: list[str] = []
    with console.status("Loading (the first time after an installation: compiling, half a minute) ..."):
        warm_up()
    with text.TrackingProgress(len(session.rig), frames) as progress:
        try:
            run = track_session(
                session,
                out,
                method=method,
                start=start,
                stop=stop,
                every=every,
                overlay=overlay,
                seed=seed,
                on_frame=progress.update,
                on_problem=problems.append,
            )
        except BaseException as error:
            progress.stop()
            text.print_warnings(console, problems)
            where = session.path / "sylpose" if out is None else out
            said = f"after {progress.done} of {frames} frames; what was computed is in {where}"
            if isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt(f"interrupted {said}") from None
            if progress.done:
                _say(f"stopped {said}")
            raise
    console.print()
    text.print_summary(console, run)
    if not text.solved(run.trajectory):
        _say(_why_nothing(session, run))
        raise typer.Exit(FAILED)
    return run


def _why_nothing(session: Session, run: Run) -> str:
    statuses = [frame.status for frame in run.trajectory if frame.world_from_object is None]
    if not statuses:
        return "no motion could be found: there is only the first frame, to which all motion is relative"
    said = f"no frame could be solved. {max(statuses, key=statuses.count).text}"
    if not session.boxes and session.masks is None:
        said += " Boxes of the object in the first frame (--boxes) or masks (--masks) would help to find it."
    return said


def _offsets(given: list[str] | None) -> dict[str, int] | None:
    offsets = {}
    for text in given or ():
        camera, _, frames = text.rpartition("=")
        try:
            offsets[camera] = int(frames)
        except ValueError:
            camera = ""
        if not camera:
            raise ValueError(f"--offset: CAMERA=FRAMES is expected, such as cam_2=5, got {text!r}")
    return offsets or None


@app.command(
    short_help="What is understood, and what looks wrong.",
    epilog=examples("sylpose check recording", "sylpose check recording --calibration rig.toml --out results"),
)
@spoken
def check(
    session: SessionPath,
    calibration: CalibrationFile = None,
    boxes: BoxesFile = None,
    masks: MasksFolder = None,
    offset: Offsets = None,
    out: OutFolder = None,
) -> None:
    """What sylpose understands of a recording, and what looks wrong with it.

    Draws the rig from above and from the side into OUT/rig.png.
    """
    from sylpose.app import check, text
    from sylpose.capture import open_session
    from sylpose.report.files import output_folder
    from sylpose.report.rigview import describe_rig, plot_rig

    opened = open_session(session, calibration=calibration, boxes=boxes, masks=masks, offsets=_offsets(offset))
    picture = output_folder(opened.path / "sylpose" if out is None else out) / "rig.png"
    place = check.object_place(opened)
    console = text.make_console()
    console.print(text.headline(opened))
    console.print()
    text.print_table(console, text.RIG_HEADER, text.rig_rows(opened, describe_rig(opened.rig, place.center)))
    console.print()
    text.print_facts(console, check.facts(opened, place))
    plot_rig(opened.rig, picture, place.center if place.radius else None, place.radius)
    text.print_files(console, "Picture", [picture])
    console.print()
    found = check.warnings(opened, place)
    text.print_warnings(console, found)
    if place.obstacle:
        raise ValueError(place.obstacle)
    console.print("Ready to track." if not found else "Can be tracked; see the warnings above.")


@app.command(
    short_help="Render, track, compare with the truth.",
    epilog=examples("sylpose demo", "sylpose demo --turn 120 --cameras 3 --out block"),
)
@spoken
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the recording and the results go.")] = Path(
        "sylpose_demo"
    ),
    frames: Annotated[int, typer.Option(metavar="N", help="How many, at 30 per second.")] = 60,
    turn: Annotated[float, typer.Option(metavar="DEG", help="By how much the object turns in all.")] = 90.0,
    cameras: Annotated[int, typer.Option(metavar="N", help="How many.")] = 4,
    seed: Seed = 0,
) -> None:
    """Render a recording with known truth, track it from its videos and compare.

    A painted block turns and drifts in front of some cameras. Exit code 0 when its motion was found in all frames to
    within 2 degrees.
    """
    from sylpose.app import text
    from sylpose.app.demo import MAX_ERROR_DEG, render_demo, score
    from sylpose.capture import open_session
    from sylpose.report.files import read_tum

    console = text.make_console()
    with console.status(f"Rendering {frames} frames of {cameras} cameras ..."):
        truth = render_demo(out, frames=frames, turn_deg=turn, n_cameras=cameras, seed=seed)
    run = _track(open_session(out), None, seed=seed)
    result = score(
        *read_tum(run.files[0]), *read_tum(out / "groundtruth.tum"), center=truth.world_from_object[0].translation
    )
    console.print()
    text.print_score(console, result, run.trajectory.unit)
    if result.missing or result.rotation.max() > MAX_ERROR_DEG:
        _say(f"the demo did not come out right: {result.missing} frames missing, errors above")
        raise typer.Exit(FAILED)


@calibration_app.command(epilog=examples("sylpose calibration convert camera_array.toml calibration.yml"))
@spoken
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Calibration in any format that sylpose reads.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="A .toml (sylpose's), .yml, .json or .xml (OpenCV's).")],
) -> None:
    """Write a calibration in another format.

    Read are sylpose, Anipose and Caliscope TOML, and OpenCV FileStorage YAML, JSON and XML; written are sylpose TOML and
    OpenCV FileStorage.
    """
    from sylpose import calibration
    from sylpose.report.files import writing

    rig = calibration.load(source)
    with writing(target):
        calibration.save(rig, target)
    print(f"{target}: {len(rig)} cameras ({', '.join(rig.names)})")
