"""`sylpose batch`."""

from __future__ import annotations

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
    make_choice_check,
    report_errors,
)
from sylpose.commands.options import Overlay, RefineCalibration, Seed, StopFrame, Unit, World
from sylpose.methods import FEATURES, METHODS, resolve_features

__all__ = ["batch"]


@app.command(
    cls=GroupedCommand,
    short_help="Track many recordings.",
    epilog=format_examples(
        "sylpose batch archive --out results",
        "sylpose batch recordings.csv --out results --jobs 8",
        "sylpose batch s3://lab/recordings --out s3://lab/results --ray auto",
        "sylpose batch archive --out results --shard 3/100",
        "sylpose batch --status --out results",
    ),
)
@report_errors
def batch(
    source: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="SOURCE...",
            help="Folders or object-store URLs with recordings below them, or manifests (.toml, .csv).",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        str,
        typer.Option(
            metavar="DEST", help="Write one folder per recording below this folder or URL.", rich_help_panel=OUTPUT
        ),
    ] = "",
    jobs: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Run N local processes; default: limited by cores and memory."),
    ] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Run on a Ray cluster instead: auto, or HOST:6379.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="K/N", help="Track only every N-th recording from the K-th on: 1/N to N/N.")
    ] = None,
    status: Annotated[bool, typer.Option("--status", help="Only report progress and write the summary.")] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Retry unchanged recordings that failed with wrong input.")
    ] = False,
    threads: Annotated[int, typer.Option(metavar="N", min=1, help="Use N threads per recording.")] = 1,
    memory: Annotated[
        float | None,
        typer.Option(
            metavar="GB", min=0.1, help="Limit the memory per recording; default: its share of the available memory."
        ),
    ] = None,
    scratch: Annotated[
        str | None,
        typer.Option(metavar="DIR", help="Process recordings in this folder; default: the system's temporary folder."),
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Use this calibration for recordings without one.", rich_help_panel=INPUT),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Select the estimation method; see sylpose track.",
            callback=make_choice_check(METHODS),
            rich_help_panel=ADVANCED,
        ),
    ] = METHODS[0],
    features: Annotated[
        str,
        typer.Option(
            metavar="|".join(FEATURES),
            help="Select the features; see sylpose track.",
            callback=make_choice_check(FEATURES),
            rich_help_panel=ADVANCED,
        ),
    ] = FEATURES[0],
    smooth: Annotated[
        bool | None,
        typer.Option("--smooth/--no-smooth", help="Refine all poses jointly at the end.", rich_help_panel=ADVANCED),
    ] = None,
    refine_calibration: RefineCalibration = False,
    start: Annotated[int, typer.Option(metavar="N", min=0, help="Start at this frame.", rich_help_panel=INPUT)] = 0,
    stop: StopFrame = None,
    every: Annotated[int, typer.Option(metavar="N", min=1, help="Track every N-th frame.", rich_help_panel=INPUT)] = 1,
    overlay: Overlay = True,
    unit: Unit = None,
    world: World = None,
    seed: Seed = 0,
) -> None:
    """Track all recordings below folders or object-store URLs, or in manifests, each as with sylpose track.

    Repeating the command skips finished recordings; a failed recording does not stop the others. DEST gets one folder
    per recording and summary.csv. Exit code 0: all done; 1: some failed; 2: wrong input.
    """
    if not out:
        raise ValueError("--out DEST is missing: the folder or URL for the results")
    if not source and not status:
        raise ValueError("SOURCE is missing: folders or URLs with recordings, or manifests")
    if jobs is not None and ray is not None:
        raise ValueError("--jobs (this computer) and --ray (a cluster) exclude each other: give only one")
    if stop is not None and stop <= start:
        raise ValueError(f"--stop must be greater than --start ({start}), got {stop}")
    resolve_features(method, features)

    from sylpose.archive.batch_command import BatchWorkers, run_batch_command, run_status_command
    from sylpose.archive.contract import RunSettings
    from sylpose.archive.recordings import TrackingOptions, find_recordings
    from sylpose.archive.stores import open_store
    from sylpose.archive.worker import track_recording

    destination = open_store(out)
    found = None
    if source:
        options = TrackingOptions(
            method=method,
            features=features,
            smooth=smooth,
            refine_calibration=refine_calibration,
            start=start,
            stop=stop,
            every=every,
            overlay=overlay,
            seed=seed,
            unit=unit,
            world=world,
        )
        found = find_recordings(source, options, calibration, destination)
    if status or found is None:
        run_status_command(destination, None if found is None else found[0])
        return
    settings = RunSettings(destination, track_recording, threads=threads, scratch=scratch, retry_failed=retry_failed)
    workers = BatchWorkers(jobs, ray, shard, None if memory is None else int(memory * 2**30))
    summaries = run_batch_command(*found, settings, workers)
    if failed := sum(summary.status != "done" for summary in summaries.values()):
        exit_with_failures([f"{failed} of {len(summaries)} recordings without a trajectory"])
