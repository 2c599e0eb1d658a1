"""The command line: `sylpose track`, `check`, `sync`, `view`, `demo`, `experiments` and `calibration convert`."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NoReturn, ParamSpec

import typer

from sylpose import __version__
from sylpose.methods import FEATURES, METHODS, features_of, summary

# Everything else is imported where it is used: the tracker and matplotlib take a second each, which `--help` does not need.

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
        except BrokenPipeError:  # nobody reads any more, which Typer handles
            raise
        except (ValueError, OSError) as error:
            if type(error).__name__ == "LinAlgError":  # a bug
                raise
            _say(_sentence(error))
            raise typer.Exit(WRONG_INPUT) from None

    return run


def _say(sentence: str) -> None:
    print(f"sylpose: {sentence}", file=sys.stderr)


def _sentence(error: ValueError | OSError) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return str(error) or type(error).__name__


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


def _one_of(choices: Sequence[str]) -> Callable[[str], str]:
    def check(name: str) -> str:
        if name not in choices:
            raise typer.BadParameter(f"{name!r} is not one of {', '.join(choices)}")
        return name

    return check


@app.command(
    epilog=f"\b\n{summary()}\n\n"
    + examples(
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
    offsets: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Seconds by which cameras are late, in TOML; SESSION/offsets.toml if there is one."
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(metavar="|".join(METHODS), help="How it is estimated; see below.", callback=_one_of(METHODS)),
    ] = METHODS[0],
    features: Annotated[
        str,
        typer.Option(
            metavar="|".join(FEATURES),
            help="SIFT in every frame, or KLT between SIFT keyframes: faster and finer; auto: KLT for landmarks, else SIFT.",
            callback=_one_of(FEATURES),
        ),
    ] = FEATURES[0],
    smooth: Annotated[
        bool | None, typer.Option("--smooth/--no-smooth", help="Refine all poses together at the end: recordings are.")
    ] = None,
    refine_calibration: Annotated[
        bool, typer.Option("--refine-calibration", help="Smooth; write calibration.refined.toml, too.")
    ] = False,
    start: Annotated[int, typer.Option(metavar="N", help="The first frame to track.")] = 0,
    stop: Annotated[int | None, typer.Option(metavar="N", help="The frame to stop before; all by default.")] = None,
    every: Annotated[int, typer.Option(metavar="N", help="Track every n-th frame.")] = 1,
    overlay: Annotated[bool, typer.Option("--overlay/--no-overlay", help="Write overlay.mp4.")] = True,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with an interrupted run; give the same options as then.")
    ] = False,
    checkpoint: Annotated[
        float, typer.Option(metavar="SEC", min=0, help="Time between two checkpoints, from which --resume can go on.")
    ] = 20.0,
    follow: Annotated[
        bool, typer.Option("--follow", help="SESSION has folders of images that a recorder is still filling.")
    ] = False,
    lossless: Annotated[
        bool, typer.Option("--lossless", help="With --follow: track all frames, however late.")
    ] = False,
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="With --follow: frames per second; for times in seconds.")
    ] = None,
    seed: Seed = 0,
) -> None:
    """The object's pose in every frame of a recording, or of live cameras (a folder with live.toml).

    Writes trajectory.tum (time tx ty tz qx qy qz qw), trajectory.csv (with angles, uncertainty, status, inliers and
    residuals), report.png and overlay.mp4 into OUT; of several objects, each into a folder of its own. Without boxes and
    masks, the object is what moves against the standing background.
    """
    from sylpose.app.aloud import track_aloud, why_nothing
    from sylpose.app.opening import open_asked
    from sylpose.app.run import has_ended, output_path
    from sylpose.sync.offsets import find_offsets

    features_of(method, features)
    opened = open_asked(
        session, calibration, boxes, masks, offset, resume=resume, follow=follow, lossless=lossless, rate=rate
    )
    if resume and has_ended(opened, out):
        print(f"{output_path(opened, out)}: the run there has ended; there is nothing to resume")
        return
    run = track_aloud(
        opened,
        out,
        method=method,
        features=features,
        offsets=find_offsets(opened, offsets),
        smooth=smooth,
        refine_calibration=refine_calibration,
        start=start,
        stop=stop,
        every=every,
        overlay=overlay,
        resume=resume,
        checkpoint_seconds=checkpoint,
        seed=seed,
    )
    missing = why_nothing(opened, run)
    if len(missing) == len(run.trajectories):
        _fail(missing)
    for sentence in missing:
        _say(sentence)


def _fail(sentences: Sequence[str]) -> NoReturn:
    for sentence in sentences:
        _say(sentence)
    raise typer.Exit(FAILED)


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
    from sylpose.app.check import check_aloud
    from sylpose.app.opening import open_recorded

    check_aloud(open_recorded(session, calibration, boxes, masks, offset), out)


@app.command(
    short_help="How far apart in time the cameras are.",
    epilog=examples("sylpose sync recording", "sylpose sync recording --max-lag 10 --start 200 --stop 600"),
)
@spoken
def sync(
    session: SessionPath,
    calibration: CalibrationFile = None,
    boxes: BoxesFile = None,
    masks: MasksFolder = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the offsets go; SESSION/offsets.toml by default.")
    ] = None,
    max_lag: Annotated[float, typer.Option(metavar="SEC", help="How far apart two cameras may be.")] = 3.0,
    start: Annotated[int, typer.Option(metavar="N", help="The first frame to look at.")] = 0,
    stop: Annotated[int | None, typer.Option(metavar="N", help="The frame to stop before; all by default.")] = None,
    seed: Seed = 0,
) -> None:
    """How far apart in time the cameras are, from the recorded motion. Writes offsets.toml, which track uses."""
    from sylpose.app.sync import Known, sync_aloud
    from sylpose.capture import open_session

    opened = open_session(session, calibration=calibration, boxes=boxes, masks=masks)
    if set(sync_aloud(opened, out, max_lag=max_lag, start=start, stop=stop, seed=seed).known) == {Known.NOT}:
        _fail(["no offset could be found; nothing was written"])


@app.command(
    short_help="Render, track, compare with the truth.",
    epilog=examples("sylpose demo", "sylpose demo --turn 120 --cameras 3 --out block"),
)
@spoken
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where recording and results go.")] = Path("sylpose_demo"),
    frames: Annotated[int, typer.Option(metavar="N", help="How many, at 30 per second.")] = 60,
    turn: Annotated[float, typer.Option(metavar="DEG", help="By how much the object turns in all.")] = 90.0,
    cameras: Annotated[int, typer.Option(metavar="N", help="How many.")] = 4,
    seed: Seed = 0,
) -> None:
    """Render a recording with known truth, track it from its videos and compare.

    A painted block turns and drifts in front of some cameras. Exit code 0 when its motion was found in all frames to
    within 2 degrees.
    """
    from sylpose.app.demo import demo_aloud

    if failures := demo_aloud(out, frames=frames, turn_deg=turn, n_cameras=cameras, seed=seed):
        _fail(failures)


@app.command(
    short_help="A trajectory as a camera sees it, also a virtual one.",
    epilog=examples(
        "sylpose view recording/sylpose cam_2",
        "sylpose view results top --calibration virtual.toml",
        "sylpose view results top --from 0 -2 0 --at 0 0 0",
    ),
)
@spoken
def view(
    result: Annotated[
        Path, typer.Argument(metavar="RESULT", help="Folder that sylpose track wrote, or its trajectory.csv.")
    ],
    camera: Annotated[str, typer.Argument(metavar="CAMERA", help="A camera's name; with --from, a name for the view.")],
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Where CAMERA is looked up; by default beside RESULT, in its session."),
    ] = None,
    eye: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--from", metavar="X Y Z", help="A virtual camera: where it stands, in the world."),
    ] = None,
    at: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--at", metavar="X Y Z", help="What it looks at; where the object was first by default."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Where the view goes; RESULT by default.")] = None,
) -> None:
    """A finished trajectory in the axes of a camera: one of the rig, one that saw nothing, or a virtual one.

    Writes view_CAMERA.tum (camera_from_object), view_CAMERA.csv and view_CAMERA.png.
    """
    from sylpose.app.view import view_aloud

    view_aloud(result, camera, calibration, eye, at, out)


@app.command(
    short_help="The paper's experiments: tables and figures.",
    epilog=examples("sylpose experiments", "sylpose experiments --only noise --only cameras --out noise --quick"),
)
@spoken
def experiments(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where tables and figures go.")] = Path(
        "sylpose_experiments"
    ),
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="STUDY", help="Only this one; may be given several times. A wrong name lists them."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few trials: half a minute instead of five.")] = False,
    seed: Seed = 0,
) -> None:
    """Simulated studies of the paper's estimators: how exact they are, what they withstand, how long they take.

    Writes paper_STUDY.csv and paper_STUDY.png for each study and paper_index.md into OUT, and leaves other files there
    alone.
    """
    from sylpose.app import text
    from sylpose.app.experiments import chosen, run_studies

    files = run_studies(chosen(only or []), out, seed=seed, quick=quick)
    text.print_files(text.make_console(), "Files", files)


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
