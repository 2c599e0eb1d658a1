"""`sylpose check`, `sylpose box` and `sylpose sync`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from sylpose.cli.common import (
    BoxesFile,
    Browser,
    CalibrationFile,
    CameraFiles,
    MasksFolder,
    Offsets,
    OutFolder,
    Port,
    Rate,
    Seed,
    SessionPath,
    Stop,
    Unit,
    Without,
    World,
    WorldFrame,
    WorldFrom,
    app,
    examples,
    fail,
    spoken,
)

__all__ = ["box", "check", "sync"]


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
    camera: CameraFiles = None,
    without: Without = None,
    rate: Rate = None,
    unit: Unit = None,
    world: World = None,
    world_frame: WorldFrame = None,
    world_from: WorldFrom = None,
) -> None:
    """What sylpose understands of a recording, and what looks wrong with it.

    Draws the rig from above and from the side into OUT/rig.png; with --world its axes into OUT/world.png.
    """
    from sylpose.app.check import check_aloud
    from sylpose.app.session_options import open_recorded
    from sylpose.app.world import asked_world

    asked = asked_world(world, world_frame, world_from)
    check_aloud(open_recorded(session, calibration, boxes, masks, offset, camera, rate, unit, asked, without), out)


@app.command(
    short_help="Draw boxes of the object on a page in the browser.",
    epilog=examples("sylpose box recording", "sylpose box recording --start 100 --out at_100.toml"),
)
@spoken
def box(
    session: SessionPath,
    calibration: CalibrationFile = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the boxes go; SESSION/boxes.toml by default.")
    ] = None,
    masks: MasksFolder = None,
    offset: Offsets = None,
    camera: CameraFiles = None,
    without: Without = None,
    rate: Rate = None,
    start: Annotated[int, typer.Option(metavar="N", help="The frame to draw into: the first to track.")] = 0,
    port: Port = 0,
    browser: Browser = True,
) -> None:
    """Draw boxes of the object, or of several, into the first frame of each camera, on a page in the browser.

    The box in one camera shows in all others where the object may be; two suggest the rest. Begins with the boxes that
    there are. Only this computer can open the page.
    """
    from sylpose.app.box import box_aloud
    from sylpose.app.session_options import open_recorded
    from sylpose.capture.live import is_live

    if is_live(session):
        raise ValueError(f"{session}: of live cameras; boxes are drawn into recordings")
    there = out if out is not None and out.exists() else None
    opened = open_recorded(session, calibration, there, masks, offset, camera, rate, without=without)
    given: dict[str, Sequence[object] | None] = {
        "--calibration": [calibration],
        "--masks": [masks],
        "--frame-offset": offset,
        "--video": camera,
        "--rate": [rate],
    }
    words = [(name, str(value)) for name, values in given.items() for value in values or () if value is not None]
    options = [word for pair in words for word in pair]
    box_aloud(opened, out, options, start=start, port=port, browser=browser)


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
    camera: CameraFiles = None,
    without: Without = None,
    rate: Rate = None,
    max_lag: Annotated[float, typer.Option(metavar="SEC", help="How far apart two cameras may be.")] = 3.0,
    start: Annotated[int, typer.Option(metavar="N", help="The first frame to look at.")] = 0,
    stop: Stop = None,
    seed: Seed = 0,
) -> None:
    """How far apart in time the cameras are, from the recorded motion. Writes offsets.toml, which track uses."""
    from sylpose.app.session_options import open_recorded
    from sylpose.app.sync import Known, sync_aloud

    opened = open_recorded(session, calibration, boxes, masks, None, camera, rate, without=without)
    if set(sync_aloud(opened, out, max_lag=max_lag, start=start, stop=stop, seed=seed).known) == {Known.NOT}:
        fail(["no offset could be found; nothing was written"])
