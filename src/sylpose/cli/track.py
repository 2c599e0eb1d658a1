"""`sylpose track`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import (
    ADVANCED,
    INPUT,
    LIVE,
    OBJECT,
    OUTPUT,
    GroupedCommand,
    app,
    exit_with_failures,
    format_examples,
    make_choice_check,
    print_message,
    report_errors,
)
from sylpose.commands.options import (
    BoxesFile,
    Browser,
    CalibrationFile,
    CameraFiles,
    EulerAxes,
    ExcludedCameras,
    FrameOffsets,
    MasksFolder,
    OutFolder,
    Overlay,
    PlotFormat,
    Port,
    Rate,
    RefineCalibration,
    Seed,
    SessionPath,
    StopFrame,
    Unit,
    World,
    WorldFrame,
    WorldFrom,
)
from sylpose.methods import FEATURES, METHODS, MODES, format_methods_table, resolve_features

__all__ = ["track"]


@app.command(
    cls=GroupedCommand,
    short_help="Track an object in a recording or live cameras.",
    epilog=f"\b\n{format_methods_table()}\n\n"
    + format_examples(
        "sylpose track recording",
        "sylpose track recording --boxes first_frame.toml --out results",
        "sylpose track recording --start 100 --stop 400 --every 2 --frame-offset cam_2=5",
    ),
)
@report_errors
def track(
    session: SessionPath,
    calibration: CalibrationFile = None,
    boxes: BoxesFile = None,
    masks: MasksFolder = None,
    offset: FrameOffsets = None,
    out: OutFolder = None,
    offsets: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Read the cameras' time offsets in seconds (TOML); default: SESSION/offsets.toml if present.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Select the estimation method; see below.",
            callback=make_choice_check(METHODS),
            rich_help_panel=ADVANCED,
        ),
    ] = METHODS[0],
    features: Annotated[
        str,
        typer.Option(
            metavar="|".join(FEATURES),
            help="Match SIFT in every frame, or track KLT between SIFT keyframes (faster, more precise); auto: KLT for "
            "landmarks, else SIFT.",
            callback=make_choice_check(FEATURES),
            rich_help_panel=ADVANCED,
        ),
    ] = FEATURES[0],
    known: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            metavar="[NAME=]FILE",
            help="Express poses in the frame of an object.npz from another recording; for several objects, repeat with "
            "NAME=FILE.",
            rich_help_panel=OBJECT,
        ),
    ] = None,
    smooth: Annotated[
        bool | None,
        typer.Option(
            "--smooth/--no-smooth",
            help="Refine all poses jointly at the end; default: for recordings.",
            rich_help_panel=ADVANCED,
        ),
    ] = None,
    refine_calibration: RefineCalibration = False,
    start: Annotated[int, typer.Option(metavar="N", help="Start at this frame.", rich_help_panel=INPUT)] = 0,
    stop: StopFrame = None,
    every: Annotated[int, typer.Option(metavar="N", help="Track every N-th frame.", rich_help_panel=INPUT)] = 1,
    overlay: Overlay = True,
    distributed: Annotated[
        str | None,
        typer.Option(
            "--simulate-nodes",
            metavar="|".join(MODES),
            help="Run one node per camera over a simulated network: exact as in one process, or compact in fewer rounds.",
            rich_help_panel=ADVANCED,
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume", help="Continue an interrupted run; requires the same options.", rich_help_panel=ADVANCED
        ),
    ] = False,
    checkpoint: Annotated[
        float,
        typer.Option(
            metavar="SEC", min=0, help="Set the time between checkpoints for --resume.", rich_help_panel=ADVANCED
        ),
    ] = 20.0,
    follow: Annotated[
        bool,
        typer.Option("--follow", help="Track image folders that a recorder is still writing.", rich_help_panel=LIVE),
    ] = False,
    lossless: Annotated[
        bool,
        typer.Option(
            "--no-drop",
            help="With --follow, track all frames, regardless of the delay.",
            rich_help_panel=LIVE,
        ),
    ] = False,
    rate: Rate = None,
    camera: CameraFiles = None,
    without: ExcludedCameras = None,
    unit: Unit = None,
    world: World = None,
    world_frame: WorldFrame = None,
    world_from: WorldFrom = None,
    angles: EulerAxes = None,
    poses: Annotated[
        str | None,
        typer.Option(
            "--stream",
            metavar="TO",
            help="Stream poses as JSON lines to stdout (-) or udp://HOST:PORT.",
            rich_help_panel=LIVE,
        ),
    ] = None,
    show: Annotated[
        bool,
        typer.Option(
            "--show", help="Show the run in 3D on a page in the browser; see sylpose show.", rich_help_panel=LIVE
        ),
    ] = False,
    port: Port = 0,
    browser: Browser = True,
    plot_format: PlotFormat = "png",
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print only warnings, on stderr.", rich_help_panel=OUTPUT)
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print one line per frame.", rich_help_panel=OUTPUT)
    ] = False,
    seed: Seed = 0,
) -> None:
    """Track the pose of an object in a recording or in live cameras (a folder with live.toml).

    Writes trajectory.tum (time tx ty tz qx qy qz qw), trajectory.csv (with angles, uncertainty, status, inliers and
    residuals), report.html, report.png and overlay.mp4 into OUT; several objects get one folder each. Without boxes and
    masks, whatever moves against the static background is tracked.
    """
    from sylpose.commands.track_command import run_track_command
    from sylpose.io.object_files import load_known_objects
    from sylpose.runs.check import check_session, describe_axis_miss
    from sylpose.runs.run import has_finished, output_path
    from sylpose.runs.session_options import open_from_options
    from sylpose.runs.session_warnings import explain_failures
    from sylpose.runs.world import parse_world_option
    from sylpose.sync.offsets import find_offsets

    resolve_features(method, features)
    opened = open_from_options(
        session,
        calibration,
        boxes,
        masks,
        offset,
        resume=resume,
        follow=follow,
        lossless=lossless,
        rate=rate,
        camera=camera,
        unit=unit,
        world=parse_world_option(world, world_frame, world_from),
        without=without,
    )
    if resume and has_finished(opened, out):
        print(f"{output_path(opened, out)}: the run there has ended; there is nothing to resume")
        return
    run = run_track_command(
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
        distributed=distributed,
        resume=resume,
        checkpoint_seconds=checkpoint,
        seed=seed,
        plot_format=plot_format,
        angles=angles,
        known=load_known_objects(known, opened.objects, opened.rig),
        quiet=quiet,
        verbose=verbose,
        poses=poses,
        show=show,
        port=port,
        browser=browser,
    )
    missing = explain_failures(opened, run)
    # Warnings from the start of the run may be the cause and have scrolled away: repeat them.
    sentences = [*missing, *((*check_session(opened, start), describe_axis_miss(opened.rig)) if missing else ())]
    if len(missing) == len(run.trajectories):
        exit_with_failures(list(filter(None, sentences)))
    for sentence in filter(None, sentences):
        print_message(sentence)
