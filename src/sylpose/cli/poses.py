"""`sylpose pose`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import (
    ADVANCED,
    INPUT,
    OUTPUT,
    GroupedCommand,
    app,
    exit_with_failures,
    format_examples,
    report_errors,
)
from sylpose.commands.options import (
    CalibrationFile,
    CameraFiles,
    ExcludedCameras,
    PlotFormat,
    Rate,
    Seed,
    StopFrame,
    Unit,
)
from sylpose.units import METERS

__all__ = ["pose"]


@app.command(
    cls=GroupedCommand,
    short_help="Solve poses from known object points or markers.",
    epilog=format_examples(
        "sylpose pose cube.toml recording --out cube",
        "sylpose pose skull.csv pixels.csv --calibration rig.toml --rate 100 --out skull",
        "sylpose pose skull.csv cam_0DLC.csv cam_1DLC.csv --calibration rig.toml --is-in mm",
    ),
)
@report_errors
def pose(
    model: Annotated[
        Path,
        typer.Argument(metavar="MODEL", help="Object points (.csv: name,x,y,z; .toml; .ply, .obj) or markers (.toml)."),
    ],
    observations: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="OBSERVATIONS...",
            help="Recording, for markers; or tables of image points: camera,frame,name,u,v, or DeepLabCut's.",
            show_default=False,
        ),
    ] = None,
    calibration: CalibrationFile = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Write the results here.", rich_help_panel=OUTPUT)] = Path(
        "sylpose_pose"
    ),
    camera: CameraFiles = None,
    without: ExcludedCameras = None,
    rate: Rate = None,
    unit: Unit = None,
    is_in: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(METERS), help="Set the length unit of MODEL if the file has none.", rich_help_panel=INPUT
        ),
    ] = None,
    likelihood: Annotated[
        float,
        typer.Option(
            metavar="P", min=0, max=1, help="Ignore table points with a lower likelihood.", rich_help_panel=ADVANCED
        ),
    ] = 0.6,
    max_error: Annotated[
        float,
        typer.Option(
            metavar="PX",
            help="Reject points with larger residuals: five times the largest expected noise.",
            rich_help_panel=ADVANCED,
        ),
    ] = 12.0,
    start: Annotated[int, typer.Option(metavar="N", help="Start at this frame.", rich_help_panel=INPUT)] = 0,
    stop: StopFrame = None,
    every: Annotated[int, typer.Option(metavar="N", help="Use every N-th frame.", rich_help_panel=INPUT)] = 1,
    plot_format: PlotFormat = "png",
    seed: Seed = 0,
) -> None:
    """Solve the pose of an object with known points, robustly, in each frame separately (multi-camera PnP).

    The points are those of a CAD model or a marker layout, in the object's frame. Their image positions come from
    tables (manual or network annotation), or markers on the object (AprilTags, ArUco) are detected in a recording.
    Writes trajectory.tum, trajectory.csv (status, uncertainty, inliers and residuals per camera), report.png,
    report.html and the settings of the run (settings.toml).
    """
    from sylpose.commands.poses import run_pose_command
    from sylpose.runs import console_output

    run = run_pose_command(
        model,
        observations or [],
        out,
        calibration_file=calibration,
        cameras=camera,
        without=without,
        unit=unit,
        is_in=is_in,
        rate=rate,
        likelihood=likelihood,
        max_error_px=max_error,
        start=start,
        stop=stop,
        every=every,
        plot_format=plot_format,
        seed=seed,
    )
    if not console_output.select_solved_frames(run.trajectory):
        statuses = [frame.status for frame in run.trajectory]
        why = f" {max(statuses, key=statuses.count).text}" if statuses else ""
        exit_with_failures([f"the object was not found in any frame.{why}"])
