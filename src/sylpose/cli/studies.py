"""`sylpose demo`, `sylpose show`, `sylpose view`, `sylpose report` and `sylpose experiments`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import (
    INPUT,
    LIVE,
    OUTPUT,
    GroupedCommand,
    app,
    exit_with_failures,
    format_examples,
    report_errors,
)
from sylpose.commands.options import Browser, EulerAxes, PlotFormat, Port, Seed

__all__ = ["demo", "experiments", "report", "show", "view"]


@app.command(
    cls=GroupedCommand,
    short_help="Render and track a recording with ground truth.",
    epilog=format_examples("sylpose demo", "sylpose demo --turn 120 --cameras 3 --out block"),
)
@report_errors
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Write the recording and the results here.")] = Path(
        "sylpose_demo"
    ),
    frames: Annotated[int, typer.Option(metavar="N", help="Render N frames at 30 per second.")] = 60,
    turn: Annotated[float, typer.Option(metavar="DEG", help="Set the object's total rotation.")] = 90.0,
    cameras: Annotated[int, typer.Option(metavar="N", help="Set the number of cameras.")] = 4,
    seed: Seed = 0,
) -> None:
    """Render a recording with ground truth, track it from its videos and compare.

    A textured block rotates and drifts in front of the cameras. Exit code 0 if the rotation error is below 2 degrees in
    all frames.
    """
    from sylpose.commands.demo import run_demo_command

    if failures := run_demo_command(out, frames=frames, turn_deg=turn, n_cameras=cameras, seed=seed):
        exit_with_failures(failures)


@app.command(
    cls=GroupedCommand,
    short_help="Show a result in 3D on a page in the browser.",
    epilog=format_examples("sylpose show recording/sylpose", "sylpose show recording/sylpose --save scene.html"),
)
@report_errors
def show(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Folder that sylpose track wrote.")],
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Read this calibration; default: the one of the run.", rich_help_panel=INPUT),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Read the images from here if the recording was moved.", rich_help_panel=INPUT
        ),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Write a self-contained page and exit.", rich_help_panel=OUTPUT),
    ] = None,
    host: Annotated[
        str,
        typer.Option(
            metavar="HOST",
            help="Serve the page at this address; 0.0.0.0: also for other computers.",
            rich_help_panel=LIVE,
        ),
    ] = "127.0.0.1",
    port: Port = 0,
    browser: Browser = True,
) -> None:
    """Show the cameras with their images, the object and its path in 3D on a page in the browser. Ctrl-C stops it.

    Requires the extra `viewer`: pip install 'sylpose[viewer]'.
    """
    from sylpose.commands.show import run_show_command

    run_show_command(result, calibration, recording, save=save, host=host, port=port, browser=browser)


@app.command(
    cls=GroupedCommand,
    short_help="Express a trajectory in a real or virtual camera's frame.",
    epilog=format_examples(
        "sylpose view recording/sylpose cam_2",
        "sylpose view results top --calibration virtual.toml",
        "sylpose view results top --from 0 -2 0 --at 0 0 0",
    ),
)
@report_errors
def view(
    result: Annotated[
        Path, typer.Argument(metavar="RESULT", help="Folder that sylpose track wrote, or its trajectory.csv.")
    ],
    camera: Annotated[str, typer.Argument(metavar="CAMERA", help="A camera's name; with --from, a name for the view.")],
    calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Look up CAMERA in this calibration; default: that of the run.", rich_help_panel=INPUT
        ),
    ] = None,
    eye: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            "--from", metavar="X Y Z", help="Place a virtual camera at this world position.", rich_help_panel=INPUT
        ),
    ] = None,
    at: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            "--at",
            metavar="X Y Z",
            help="Point the virtual camera here; default: the object's first position.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write the view here; default: RESULT.", rich_help_panel=OUTPUT),
    ] = None,
    plot_format: PlotFormat = "png",
    angles: EulerAxes = None,
) -> None:
    """Express a finished trajectory in the frame of a camera: of the rig, of another calibration, or virtual.

    Writes view_CAMERA.tum (camera_from_object), view_CAMERA.csv and view_CAMERA.png.
    """
    from sylpose.runs.view import run_view_command

    run_view_command(result, camera, calibration, eye, at, out, plot_format, angles)


@app.command(
    short_help="Rebuild the report page of a finished run.",
    epilog=format_examples("sylpose report recording/sylpose"),
)
@report_errors
def report(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Folder that sylpose track wrote.")],
) -> None:
    """Rebuild report.html of a finished run, for example after editing its files or after an update of sylpose.

    It is built from the files in the folder; images come from the existing page, or else from the recording.
    """
    from sylpose.commands.report import run_report_command

    run_report_command(result)


@app.command(
    cls=GroupedCommand,
    short_help="Run the paper's experiments: tables and figures.",
    epilog=format_examples(
        "sylpose experiments", "sylpose experiments --only noise --only cameras --out noise --quick"
    ),
)
@report_errors
def experiments(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Write tables and figures here.")] = Path(
        "sylpose_experiments"
    ),
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="STUDY", help="Run only this study. Repeatable; an unknown name lists them."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Use few trials: half a minute instead of five.")] = False,
    seed: Seed = 0,
) -> None:
    """Simulate the paper's estimators: accuracy, robustness and computing time.

    Writes paper_STUDY.csv and paper_STUDY.png for each study and paper_index.md into OUT; other files there are kept.
    """
    from sylpose.commands.experiments import run_studies, select_studies
    from sylpose.runs import console_output

    files = run_studies(select_studies(only or []), out, seed=seed, quick=quick)
    console_output.print_files(console_output.make_console(), "Files", files)
