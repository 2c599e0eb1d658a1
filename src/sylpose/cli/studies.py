"""`sylpose demo`, `sylpose show`, `sylpose view`, `sylpose report` and `sylpose experiments`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.cli.common import Axes, Browser, PlotFormat, Port, Seed, app, examples, fail, spoken

__all__ = ["demo", "experiments", "report", "show", "view"]


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
        fail(failures)


@app.command(
    short_help="A result in 3D, on a page in the browser.",
    epilog=examples("sylpose show recording/sylpose", "sylpose show recording/sylpose --save scene.html"),
)
@spoken
def show(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Folder that sylpose track wrote.")],
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Of the cameras; the one that the run used by default.")
    ] = None,
    recording: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where the recording is now, if it was moved: for the images.")
    ] = None,
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page that plays it by itself, and end.")
    ] = None,
    host: Annotated[
        str, typer.Option(metavar="HOST", help="Where the page listens; 0.0.0.0 for other computers, too.")
    ] = "127.0.0.1",
    port: Port = 0,
    browser: Browser = True,
) -> None:
    """Cameras with their images, the object and its path, frame by frame, on a page in the browser. Ctrl-C ends it.

    Needs the extra `viewer`: pip install 'sylpose[viewer]'.
    """
    from sylpose.app.show import show_aloud

    show_aloud(result, calibration, recording, save=save, host=host, port=port, browser=browser)


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
        typer.Option(metavar="FILE", help="Where CAMERA is looked up; the one that the run used by default."),
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
    plot_format: PlotFormat = "png",
    angles: Axes = None,
) -> None:
    """A finished trajectory in the axes of a camera: one of the rig, one that saw nothing, or a virtual one.

    Writes view_CAMERA.tum (camera_from_object), view_CAMERA.csv and view_CAMERA.png.
    """
    from sylpose.app.view import view_aloud

    view_aloud(result, camera, calibration, eye, at, out, plot_format, angles)


@app.command(
    short_help="The page of a finished run, made anew.",
    epilog=examples("sylpose report recording/sylpose"),
)
@spoken
def report(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Folder that sylpose track wrote.")],
) -> None:
    """Make report.html of a finished run anew: after an edit, or of a run of an older version.

    It is made of the files in the folder. Its images are those of the page that is there, or of the recording where there
    is none.
    """
    from sylpose.app.report import report_aloud

    report_aloud(result)


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
    from sylpose.app import console_output
    from sylpose.app.experiments import chosen, run_studies

    files = run_studies(chosen(only or []), out, seed=seed, quick=quick)
    console_output.print_files(console_output.make_console(), "Files", files)
