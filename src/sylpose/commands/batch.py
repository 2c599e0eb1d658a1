"""`sylpose batch`: track many recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from sylpose.commands.app import INPUT, OUTPUT, command, exit_with_failures, option, pick
from sylpose.commands.options import (
    MethodOptions,
    Overlay,
    RefineCalibration,
    Seed,
    Smooth,
    StopFrame,
    Unit,
    World,
)


@dataclass(frozen=True, kw_only=True)
class BatchOptions(MethodOptions):
    """Options of `sylpose batch`.

    Attributes:
        source: Folders or object-store URLs with recordings below them, or manifests (.toml, .csv).
        out: Write one folder per recording below this folder or URL.
        jobs: Run N local processes; default: limited by cores and memory.
        ray: Run on a Ray cluster instead: auto, or HOST:6379.
        shard: Track only every N-th recording from the K-th on: 1/N to N/N.
        status: Only report progress and write the summary.
        retry_failed: Retry unchanged recordings that failed with wrong input.
        threads: Use N threads per recording.
        memory: Limit the memory per recording; default: its share of the available memory.
        scratch: Process recordings in this folder; default: the system's temporary folder.
        calibration: Use this calibration for recordings without one.
        smooth: Refine all poses jointly at the end.
        start: Start at this frame.
        every: Track every N-th frame.
    """

    source: Annotated[tuple[str, ...], typer.Argument(metavar="SOURCE...", show_default=False)] = ()
    out: Annotated[str, option("--out DEST", OUTPUT)] = ""
    jobs: Annotated[int | None, option("--jobs N", min=1)] = None
    ray: Annotated[str | None, option("--ray ADDRESS")] = None
    shard: Annotated[str | None, option("--shard K/N")] = None
    status: Annotated[bool, option("--status")] = False
    retry_failed: Annotated[bool, option("--retry-failed")] = False
    threads: Annotated[int, option("--threads N", min=1)] = 1
    memory: Annotated[float | None, option("--memory GB", min=0.1)] = None
    scratch: Annotated[str | None, option("--scratch DIR")] = None
    calibration: Annotated[str | None, option("--calibration FILE", INPUT)] = None
    smooth: Smooth = None
    refine_calibration: RefineCalibration = False
    start: Annotated[int, option("--start N", INPUT, min=0)] = 0
    stop: StopFrame = None
    every: Annotated[int, option("--every N", INPUT, min=1)] = 1
    overlay: Overlay = True
    unit: Unit = None
    world: World = None
    seed: Seed = 0

    def __post_init__(self) -> None:
        """Check that there is something to do, in one way, and somewhere to write."""
        super().__post_init__()
        if not self.out:
            raise ValueError("--out DEST is missing: the folder or URL for the results")
        if not self.source and not self.status:
            raise ValueError("SOURCE is missing: folders or URLs with recordings, or manifests")
        if self.jobs is not None and self.ray is not None:
            raise ValueError("--jobs (this computer) and --ray (a cluster) exclude each other: give only one")
        if self.stop is not None and self.stop <= self.start:
            raise ValueError(f"--stop must be greater than --start ({self.start}), got {self.stop}")


@command("Track many recordings.")
def batch(options: BatchOptions) -> None:
    """Track all recordings below folders or object-store URLs, or in manifests, each as with sylpose track.

    Repeating the command skips finished recordings; a failed recording does not stop the others. DEST gets one folder
    per recording and summary.csv. Exit code 0: all done; 1: some failed; 2: wrong input.

    Examples:
        sylpose batch archive --out results
        sylpose batch recordings.csv --out results --jobs 8
        sylpose batch s3://lab/recordings --out s3://lab/results --ray auto
        sylpose batch archive --out results --shard 3/100
        sylpose batch --status --out results
    """
    from sylpose.archive.batch_command import BatchWorkers, run_batch_command, run_status_command
    from sylpose.archive.contract import RunSettings
    from sylpose.archive.recordings import TrackingOptions, find_recordings
    from sylpose.archive.stores import open_store
    from sylpose.archive.worker import track_recording

    destination, found = open_store(options.out), None
    if options.source:
        tracking = TrackingOptions(**{name: getattr(options, name) for name in TrackingOptions.__struct_fields__})
        found = find_recordings(options.source, tracking, options.calibration, destination)
    if options.status or found is None:
        run_status_command(destination, None if found is None else found[0])
        return
    memory = None if options.memory is None else int(options.memory * 2**30)
    settings = pick(options, RunSettings, destination=destination, work=track_recording)
    workers = BatchWorkers(options.jobs, options.ray, options.shard, memory)
    summaries = run_batch_command(*found, settings, workers)
    if failed := sum(summary.status != "done" for summary in summaries.values()):
        exit_with_failures([f"{failed} of {len(summaries)} recordings without a trajectory"])
