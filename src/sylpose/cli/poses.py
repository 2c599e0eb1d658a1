"""`sylpose pose`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.cli.common import (
    CalibrationFile,
    CameraFiles,
    PlotFormat,
    Rate,
    Seed,
    Stop,
    Unit,
    Without,
    app,
    examples,
    fail,
    spoken,
)
from sylpose.units import METRES

__all__ = ["pose"]


@app.command(
    short_help="An object of known points or markers, frame by frame.",
    epilog=examples(
        "sylpose pose cube.toml recording --out cube",
        "sylpose pose skull.csv pixels.csv --calibration rig.toml --rate 100 --out skull",
        "sylpose pose skull.csv cam_0DLC.csv cam_1DLC.csv --calibration rig.toml --is-in mm",
    ),
)
@spoken
def pose(
    model: Annotated[
        Path,
        typer.Argument(
            metavar="MODEL", help="Points of the object (.csv: name,x,y,z; .toml; .ply, .obj) or markers (.toml)."
        ),
    ],
    seen: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SEEN...",
            help="A recording, for markers; or where cameras see the points: camera,frame,name,u,v, or DeepLabCut's tables.",
            show_default=False,
        ),
    ] = None,
    calibration: CalibrationFile = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the results go.")] = Path("sylpose_pose"),
    camera: CameraFiles = None,
    without: Without = None,
    rate: Rate = None,
    unit: Unit = None,
    is_in: Annotated[
        str | None, typer.Option(metavar="|".join(METRES), help="The unit of MODEL, which does not say it itself.")
    ] = None,
    likelihood: Annotated[
        float, typer.Option(metavar="P", min=0, max=1, help="Points of tables that are less likely count as not seen.")
    ] = 0.6,
    max_error: Annotated[
        float, typer.Option(metavar="PX", help="Points further off are wrong: five times the largest noise.")
    ] = 12.0,
    start: Annotated[int, typer.Option(metavar="N", help="The first frame of a recording.")] = 0,
    stop: Stop = None,
    every: Annotated[int, typer.Option(metavar="N", help="Every n-th frame of a recording.")] = 1,
    plot_format: PlotFormat = "png",
    seed: Seed = 0,
) -> None:
    """Where an object is whose points are known: solvePnP for many cameras, robust, in each frame by itself.

    Points are a CAD model's or a marker layout's, in the object's own frame. They are seen by people or networks (tables),
    or found: markers that are glued to it (AprilTags, ArUco) in a recording. Writes trajectory.tum, trajectory.csv (status,
    uncertainty, inliers and residuals per camera), report.png, report.html and what it was asked for (settings.toml).
    """
    from sylpose.app import console_output
    from sylpose.app.poses import pose_aloud

    run = pose_aloud(
        model,
        seen or [],
        out,
        given=calibration,
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
    if not console_output.solved(run.trajectory):
        statuses = [frame.status for frame in run.trajectory]
        why = f" {max(statuses, key=statuses.count).text}" if statuses else ""
        fail([f"the object was found in no frame.{why}"])
