"""`sylpose check`, `sylpose box` and `sylpose sync`."""

from __future__ import annotations

from collections.abc import Sequence
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
    BoxesFile,
    Browser,
    CalibrationFile,
    CameraFiles,
    ExcludedCameras,
    FrameOffsets,
    MasksFolder,
    OutFolder,
    Port,
    Rate,
    Seed,
    SessionPath,
    StopFrame,
    Unit,
    World,
    WorldFrame,
    WorldFrom,
)

__all__ = ["box", "check", "sync"]


@app.command(
    cls=GroupedCommand,
    short_help="Validate a recording and report problems.",
    epilog=format_examples("sylpose check recording", "sylpose check recording --calibration rig.toml --out results"),
)
@report_errors
def check(
    session: SessionPath,
    calibration: CalibrationFile = None,
    boxes: BoxesFile = None,
    masks: MasksFolder = None,
    offset: FrameOffsets = None,
    out: OutFolder = None,
    camera: CameraFiles = None,
    without: ExcludedCameras = None,
    rate: Rate = None,
    unit: Unit = None,
    world: World = None,
    world_frame: WorldFrame = None,
    world_from: WorldFrom = None,
) -> None:
    """Validate a recording and report problems.

    Plots the rig from above and from the side in OUT/rig.png, and with --world the world axes in OUT/world.png.
    """
    from sylpose.runs.check import run_check_command
    from sylpose.runs.session_options import open_recording
    from sylpose.runs.world import parse_world_option

    world_spec = parse_world_option(world, world_frame, world_from)
    run_check_command(
        open_recording(session, calibration, boxes, masks, offset, camera, rate, unit, world_spec, without), out
    )


@app.command(
    cls=GroupedCommand,
    short_help="Draw object boxes on a page in the browser.",
    epilog=format_examples("sylpose box recording", "sylpose box recording --start 100 --out at_100.toml"),
)
@report_errors
def box(
    session: SessionPath,
    calibration: CalibrationFile = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the boxes here; default: SESSION/boxes.toml.", rich_help_panel=OUTPUT),
    ] = None,
    masks: MasksFolder = None,
    offset: FrameOffsets = None,
    camera: CameraFiles = None,
    without: ExcludedCameras = None,
    rate: Rate = None,
    start: Annotated[
        int, typer.Option(metavar="N", help="Draw in this frame, the first to track.", rich_help_panel=INPUT)
    ] = 0,
    port: Port = 0,
    browser: Browser = True,
) -> None:
    """Draw boxes of one or several objects in the first frame of each camera, on a page in the browser.

    The page shows where the object of one box can be in the other cameras; from two boxes it suggests the rest.
    Existing boxes are loaded. Only this computer can open the page.
    """
    from sylpose.commands.box import run_box_command
    from sylpose.io.capture.live import is_live
    from sylpose.runs.session_options import open_recording

    if is_live(session):
        raise ValueError(f"{session}: has live cameras; boxes can only be drawn in recordings")
    existing = out if out is not None and out.exists() else None
    opened = open_recording(session, calibration, existing, masks, offset, camera, rate, without=without)
    option_values: dict[str, Sequence[object] | None] = {
        "--calibration": [calibration],
        "--masks": [masks],
        "--frame-offset": offset,
        "--video": camera,
        "--rate": [rate],
    }
    pairs = [
        (name, str(value)) for name, values in option_values.items() for value in values or () if value is not None
    ]
    options = [word for pair in pairs for word in pair]
    run_box_command(opened, out, options, start=start, port=port, browser=browser)


@app.command(
    cls=GroupedCommand,
    short_help="Estimate the time offsets between the cameras.",
    epilog=format_examples("sylpose sync recording", "sylpose sync recording --max-lag 10 --start 200 --stop 600"),
)
@report_errors
def sync(
    session: SessionPath,
    calibration: CalibrationFile = None,
    boxes: BoxesFile = None,
    masks: MasksFolder = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the offsets here; default: SESSION/offsets.toml.", rich_help_panel=OUTPUT
        ),
    ] = None,
    camera: CameraFiles = None,
    without: ExcludedCameras = None,
    rate: Rate = None,
    max_lag: Annotated[
        float,
        typer.Option(metavar="SEC", help="Limit the time offset between two cameras.", rich_help_panel=ADVANCED),
    ] = 3.0,
    start: Annotated[int, typer.Option(metavar="N", help="Start at this frame.", rich_help_panel=INPUT)] = 0,
    stop: StopFrame = None,
    seed: Seed = 0,
) -> None:
    """Estimate the time offsets between the cameras from the recorded motion.

    Writes offsets.toml, which sylpose track reads.
    """
    from sylpose.commands.sync import OffsetPrecision, run_sync_command
    from sylpose.runs.session_options import open_recording

    opened = open_recording(session, calibration, boxes, masks, None, camera, rate, without=without)
    if set(run_sync_command(opened, out, max_lag=max_lag, start=start, stop=stop, seed=seed).precision) == {
        OffsetPrecision.UNOBSERVABLE
    }:
        exit_with_failures(["no time offset could be estimated; nothing was written"])
