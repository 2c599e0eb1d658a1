"""`sylpose track`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.cli.common import (
    Axes,
    BoxesFile,
    Browser,
    CalibrationFile,
    CameraFiles,
    MasksFolder,
    Offsets,
    OutFolder,
    Overlay,
    PlotFormat,
    Port,
    Rate,
    RefineCalibration,
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
    one_of,
    say,
    spoken,
)
from sylpose.methods import FEATURES, METHODS, MODES, features_of, summary

__all__ = ["track"]


@app.command(
    epilog=f"\b\n{summary()}\n\n"
    + examples(
        "sylpose track recording",
        "sylpose track recording --boxes first_frame.toml --out results",
        "sylpose track recording --start 100 --stop 400 --every 2 --frame-offset cam_2=5",
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
        typer.Option(metavar="|".join(METHODS), help="How it is estimated; see below.", callback=one_of(METHODS)),
    ] = METHODS[0],
    features: Annotated[
        str,
        typer.Option(
            metavar="|".join(FEATURES),
            help="SIFT in every frame, or KLT between SIFT keyframes: faster and finer; auto: KLT for landmarks, else SIFT.",
            callback=one_of(FEATURES),
        ),
    ] = FEATURES[0],
    known: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            metavar="[NAME=]FILE",
            help="object.npz of another take: poses are told in its frame; of several objects, NAME=FILE for each.",
        ),
    ] = None,
    smooth: Annotated[
        bool | None, typer.Option("--smooth/--no-smooth", help="Refine all poses together at the end: recordings are.")
    ] = None,
    refine_calibration: RefineCalibration = False,
    start: Annotated[int, typer.Option(metavar="N", help="The first frame to track.")] = 0,
    stop: Stop = None,
    every: Annotated[int, typer.Option(metavar="N", help="Track every n-th frame.")] = 1,
    overlay: Overlay = True,
    distributed: Annotated[
        str | None,
        typer.Option(
            "--simulate-nodes",
            metavar="|".join(MODES),
            help="Run one node per camera over a simulated network: exact as in one process, or compact in fewer rounds.",
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with an interrupted run; give the same options as then.")
    ] = False,
    checkpoint: Annotated[
        float, typer.Option(metavar="SEC", min=0, help="Time between two checkpoints, from which --resume can go on.")
    ] = 20.0,
    follow: Annotated[
        bool, typer.Option("--follow", help="SESSION has folders of images that a recorder is still filling.")
    ] = False,
    lossless: Annotated[bool, typer.Option("--no-drop", help="With --follow: track all frames, however late.")] = False,
    rate: Rate = None,
    camera: CameraFiles = None,
    without: Without = None,
    unit: Unit = None,
    world: World = None,
    world_frame: WorldFrame = None,
    world_from: WorldFrom = None,
    angles: Axes = None,
    poses: Annotated[
        str | None,
        typer.Option("--stream", metavar="TO", help="Stream poses as JSON lines to stdout (-) or udp://HOST:PORT."),
    ] = None,
    show: Annotated[
        bool, typer.Option("--show", help="Show it in 3D meanwhile, on a page in the browser: see sylpose show.")
    ] = False,
    port: Port = 0,
    browser: Browser = True,
    plot_format: PlotFormat = "png",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say only what looks wrong, on stderr.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Say a line for each frame.")] = False,
    seed: Seed = 0,
) -> None:
    """The object's pose in every frame of a recording, or of live cameras (a folder with live.toml).

    Writes trajectory.tum (time tx ty tz qx qy qz qw), trajectory.csv (with angles, uncertainty, status, inliers and
    residuals), report.html, report.png and overlay.mp4 into OUT; of several objects, each into a folder of its own.
    Without boxes and masks, the object is what moves against the standing background.
    """
    from sylpose.app.check import axes_miss, concerns
    from sylpose.app.object_files import known_objects
    from sylpose.app.run import has_ended, output_path
    from sylpose.app.session_options import open_asked
    from sylpose.app.track_command import track_aloud, why_nothing
    from sylpose.app.world import asked_world
    from sylpose.sync.offsets import find_offsets

    features_of(method, features)
    opened = open_asked(
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
        world=asked_world(world, world_frame, world_from),
        without=without,
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
        distributed=distributed,
        resume=resume,
        checkpoint_seconds=checkpoint,
        seed=seed,
        plot_format=plot_format,
        angles=angles,
        known=known_objects(known, opened.objects, opened.rig),
        quiet=quiet,
        verbose=verbose,
        poses=poses,
        show=show,
        port=port,
        browser=browser,
    )
    missing = why_nothing(opened, run)
    # What looked wrong from the start may be why, and has gone by long ago.
    sentences = [*missing, *((*concerns(opened, start), axes_miss(opened.rig)) if missing else ())]
    if len(missing) == len(run.trajectories):
        fail(list(filter(None, sentences)))
    for sentence in filter(None, sentences):
        say(sentence)
