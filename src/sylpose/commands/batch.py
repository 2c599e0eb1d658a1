"""`sylpose batch`: track many recordings."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

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

if TYPE_CHECKING:
    from sylpose.archive.contract import RunSettings, Summary
    from sylpose.archive.recordings import Recording


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
    from sylpose.archive.contract import RunSettings, collect_summaries
    from sylpose.archive.recordings import TrackingOptions, find_recordings
    from sylpose.archive.worker import track_recording
    from sylpose.commands.batch_display import print_summaries
    from sylpose.io.stores import open_store
    from sylpose.runs.console_output import make_console, print_warnings

    destination, recordings = open_store(options.out), None
    if options.source:
        tracking = TrackingOptions(**{name: getattr(options, name) for name in TrackingOptions.__struct_fields__})
        recordings, remarks = find_recordings(options.source, tracking, options.calibration, destination)
    if options.status or recordings is None:
        if not (summaries := collect_summaries(destination, recordings)):
            raise ValueError(f"{destination.url}: contains no results of sylpose batch")
        print_summaries(summaries, destination)
        return
    selected = select_shard(recordings, options.shard) if options.shard else recordings
    settings = pick(options, RunSettings, destination=destination, work=track_recording)
    # Fail now rather than once per recording if the destination is not writable.
    destination.write("batch.txt", b"Results of sylpose batch, a folder for each recording: docs/archive.md\n")
    print_warnings(make_console(), remarks)
    summaries = _track_all(selected, len(recordings), settings, options)
    print_summaries(summaries, None if options.shard else destination)
    if options.shard:
        text = f"All shards in one table: sylpose batch --status --out {destination.url}"
        make_console().print(text, soft_wrap=True)
    if failed := sum(summary.status != "done" for summary in summaries.values()):
        exit_with_failures([f"{failed} of {len(summaries)} recordings without a trajectory"])


def _track_all(
    recordings: Sequence[Recording], n_total: int, settings: RunSettings, options: BatchOptions
) -> dict[str, Summary]:
    """Track recordings, those of a shard or all of `n_total`, and return their summaries by name, in their order.

    Raises:
        KeyboardInterrupt: with a message; also on SIGTERM.
        ValueError: invalid options.
    """
    from rich.text import Text

    from sylpose.archive.contract import collect_summaries, is_final
    from sylpose.archive.run import ProcessWorkers, RayWorkers, process_all
    from sylpose.commands.batch_display import ProgressLine
    from sylpose.runs.console_output import make_console
    from sylpose.runs.system_resources import choose_default_jobs

    console, shard, destination = make_console(), options.shard, settings.destination
    shard_text = f", shard {shard} of {n_total}" if shard else ""
    jobs, n = options.jobs or choose_default_jobs(settings.threads), len(recordings)
    workers_text = f"Ray at {options.ray}" if options.ray else f"{min(jobs, max(n, 1))} at a time"
    headline = f"{shard_text}, {workers_text} -> {destination.url}"
    console.print(Text.assemble((f"{n} recording{'' if n == 1 else 's'}", "bold"), headline))
    summaries = collect_summaries(destination, recordings)
    summaries = {name: summary for name, summary in summaries.items() if is_final(summary, settings)}
    if summaries:
        console.print(f"{len(summaries)} of them {'is' if len(summaries) == 1 else 'are'} already finished.")
    remaining = [recording for recording in recordings if recording.name not in summaries]
    memory = None if options.memory is None else int(options.memory * 2**30)
    try:
        with (
            _interrupt_on_sigterm(),
            ProgressLine(n, summaries) as line,
            RayWorkers(settings, options.ray, memory)
            if options.ray
            else ProcessWorkers(settings, jobs, memory) as workers,
        ):
            process_all(remaining, settings, workers, line.add_result, line.show_counts)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted after {len(summaries)} of {n}; finished results are kept, repeat the command to resume"
        ) from None
    return {recording.name: summaries[recording.name] for recording in recordings}


@contextmanager
def _interrupt_on_sigterm() -> Iterator[None]:
    """Interrupt the block on SIGTERM, which SLURM sends at the time limit; only a main thread can receive signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous_handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


def select_shard(recordings: Sequence[Recording], shard: str) -> list[Recording]:
    """Return every N-th recording, starting with the K-th, for a shard "K/N".

    Raises:
        ValueError: not of this form, or K not in 1 ... N.
    """
    k, _, n = shard.partition("/")
    if not (k.isdigit() and n.isdigit() and 1 <= int(k) <= int(n)):
        raise ValueError(
            f"--shard: one of 1/N to N/N is expected, such as 3/100, got {shard!r} (for SLURM: --array=1-100)"
        )
    return list(recordings[int(k) - 1 :: int(n)])
