"""`sylpose batch`."""

from __future__ import annotations

from typing import Annotated

import typer

from sylpose.cli.common import Overlay, RefineCalibration, Seed, Stop, Unit, World, app, examples, fail, one_of, spoken
from sylpose.methods import FEATURES, METHODS, features_of

__all__ = ["batch"]


@app.command(
    short_help="Track thousands of recordings.",
    epilog=examples(
        "sylpose batch archive --out results",
        "sylpose batch recordings.csv --out results --jobs 8",
        "sylpose batch s3://lab/recordings --out s3://lab/results --ray auto",
        "sylpose batch archive --out results --shard 3/100",
        "sylpose batch --status --out results",
    ),
)
@spoken
def batch(
    source: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="SOURCE...",
            help="Folders or object-store URLs with recordings below them, or manifests (.toml, .csv).",
            show_default=False,
        ),
    ] = None,
    out: Annotated[str, typer.Option(metavar="DEST", help="Folder or URL: a folder for each recording.")] = "",
    jobs: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Processes on this computer; as many as it has cores and memory for."),
    ] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="On a Ray cluster instead: auto, or HOST:6379.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="K/N", help="Only every N-th recording from the K-th on: 1/N to N/N.")
    ] = None,
    status: Annotated[bool, typer.Option("--status", help="Only say how far it is; write the summary.")] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Try again what failed as wrong input and has not changed.")
    ] = False,
    threads: Annotated[int, typer.Option(metavar="N", min=1, help="Of each recording.")] = 1,
    memory: Annotated[
        float | None,
        typer.Option(metavar="GB", min=0.1, help="Of each recording; by default its share of what there is."),
    ] = None,
    scratch: Annotated[
        str | None, typer.Option(metavar="DIR", help="Where recordings are worked on; the system's temporary folder.")
    ] = None,
    calibration: Annotated[
        str | None, typer.Option(metavar="FILE", help="Of all recordings that have none of their own.")
    ] = None,
    method: Annotated[
        str, typer.Option(metavar="NAME", help="As of track: see there.", callback=one_of(METHODS))
    ] = METHODS[0],
    features: Annotated[
        str, typer.Option(metavar="|".join(FEATURES), help="As of track.", callback=one_of(FEATURES))
    ] = FEATURES[0],
    smooth: Annotated[
        bool | None, typer.Option("--smooth/--no-smooth", help="Refine all poses together at the end.")
    ] = None,
    refine_calibration: RefineCalibration = False,
    start: Annotated[int, typer.Option(metavar="N", min=0, help="The first frame to track.")] = 0,
    stop: Stop = None,
    every: Annotated[int, typer.Option(metavar="N", min=1, help="Track every n-th frame.")] = 1,
    overlay: Overlay = True,
    unit: Unit = None,
    world: World = None,
    seed: Seed = 0,
) -> None:
    """All recordings below folders or object-store URLs, or listed in manifests, each as sylpose track would do it.

    What is finished is skipped when the command is given again; a recording that fails costs only itself. DEST has a folder
    for each, and summary.csv (summary.parquet where PyArrow is installed). Exit code 0: all done; 1: some failed; 2: wrong
    input.
    """
    if not out:
        raise ValueError("--out DEST is missing: the folder or URL for the results")
    if not source and not status:
        raise ValueError("SOURCE is missing: folders or URLs with recordings, or manifests")
    if jobs is not None and ray is not None:
        raise ValueError("--jobs is for this computer, --ray for a cluster: give one of them")
    if stop is not None and stop <= start:
        raise ValueError(f"--stop must be greater than --start ({start}), got {stop}")
    features_of(method, features)

    from sylpose.archive.batch_command import batch_aloud, status_aloud
    from sylpose.archive.contract import How
    from sylpose.archive.recordings import Options, find_recordings
    from sylpose.archive.stores import place

    destination = place(out)
    found = None
    if source:
        options = Options(
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
        status_aloud(destination, None if found is None else found.recordings)
        return
    how = How(run="", threads=threads, scratch=scratch, retry_failed=retry_failed)
    size = None if memory is None else int(memory * 2**30)
    rows = batch_aloud(found, destination, how, jobs=jobs, ray=ray, shard=shard, memory=size)
    if failed := sum(row.status != "done" for row in rows):
        fail([f"{failed} of {len(rows)} recordings without a trajectory"])
