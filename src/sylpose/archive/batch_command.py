"""Terminal interface of batch tracking: a progress line, failures as they occur, and a final table."""

from __future__ import annotations

import contextlib
import signal
import threading
import uuid
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from sylpose.archive.contract import RunSettings, Summary
from sylpose.archive.processes import ProcessWorkers, choose_default_jobs
from sylpose.archive.ray_cluster import RayWorkers
from sylpose.archive.recordings import FoundRecordings, Recording
from sylpose.archive.run import process_all, select_shard
from sylpose.archive.stores import Store
from sylpose.archive.summary import Row, collect_rows, find_finished_recordings, make_row, write_summary
from sylpose.runs import console_output

__all__ = ["run_batch_command", "run_status_command"]

# Largest number of printed rows, those with messages first; summary.csv contains all (choice: a screen).
MAX_ROWS = 30
HEADER = ("Recording", "status", "frames", "found", "residual", "time")


def run_batch_command(
    found: FoundRecordings,
    destination: Store,
    settings: RunSettings,
    *,
    jobs: int | None = None,
    ray: str | None = None,
    shard: str | None = None,
    memory: int | None = None,
) -> list[Row]:
    """Track all recordings and print the results.

    Args:
        found: the recordings.
        destination: where the results go.
        settings: settings of the run.
        jobs: number of processes; None: as many as cores and memory allow.
        ray: address of a Ray cluster, instead of processes.
        shard: "3/100": only this part; then no summary is written, since other shards run in parallel.
        memory: bytes for each recording.

    Returns:
        One row per recording, in their order.

    Raises:
        KeyboardInterrupt: with a message; also on SIGTERM, which SLURM sends at the time limit.
        ValueError, OSError: invalid options, or the destination is not writable.
    """
    console = console_output.make_console()
    recordings = list(found.recordings) if shard is None else select_shard(found.recordings, shard)
    # Fail now rather than once per recording if the destination is not writable.
    destination.write("batch.txt", b"Results of sylpose batch, a folder for each recording: docs/archive.md\n")
    console_output.print_warnings(console, found.remarks)
    settings = replace(settings, run=settings.run or uuid.uuid4().hex)
    jobs = jobs or choose_default_jobs(settings.threads)
    workers_text = f"Ray at {ray}" if ray else f"{min(jobs, max(len(recordings), 1))} at a time"
    shard_text = f", shard {shard} of {len(found.recordings)}" if shard else ""
    n = len(recordings)
    console.print(
        Text.assemble(
            (f"{n} recording{'' if n == 1 else 's'}", "bold"), f"{shard_text}, {workers_text} -> {destination.url}"
        )
    )
    finished_summaries = find_finished_recordings(recordings, destination, settings)
    rows = {name: make_row(name, summary) for name, summary in finished_summaries.items()}
    if finished_summaries:
        console.print(
            f"{len(finished_summaries)} of them {'is' if len(finished_summaries) == 1 else 'are'} already finished."
        )
    remaining = [recording for recording in recordings if recording.name not in finished_summaries]
    with _ProgressLine(n, list(rows.values())) as line, _sigterm_as_interrupt():

        def add_result(recording: Recording, summary: Summary) -> None:
            rows[recording.name] = make_row(recording.name, summary)
            line.add_row(rows[recording.name])

        try:
            with (
                RayWorkers(destination, settings, ray, memory)
                if ray
                else ProcessWorkers(destination, settings, jobs, memory) as workers
            ):
                process_all(remaining, destination, settings, workers, add_result, line.show_counts)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"interrupted after {len(rows)} of {n}; finished results are kept, repeat the command to resume"
            ) from None
    ordered = [rows[recording.name] for recording in recordings]
    _print_rows(console, ordered)
    if shard is None:
        _print_files(console, write_summary(destination, ordered))
    else:
        console.print(f"All shards in one table: sylpose batch --status --out {destination.url}", soft_wrap=True)
    return ordered


def run_status_command(destination: Store, recordings: Sequence[Recording] | None) -> list[Row]:
    """Print the status of all recordings and rewrite the summary.

    Args:
        destination: where the results are.
        recordings: None for all in the destination.

    Returns:
        One row per recording.

    Raises:
        ValueError: the destination contains no results.
    """
    rows = collect_rows(destination, recordings)
    if not rows:
        raise ValueError(f"{destination.url}: contains no results of sylpose batch")
    console = console_output.make_console()
    _print_rows(console, rows)
    _print_files(console, write_summary(destination, rows))
    return rows


class _ProgressLine:
    """Progress line with one line per failure; without a terminal (a log) one line per recording."""

    def __init__(self, n: int, before: list[Row]) -> None:
        self._n, self._rows = n, before
        self._console = console_output.make_console(stderr=True)
        self._progress = Progress(
            TextColumn("Tracking"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[counts]}"),
            TimeRemainingColumn(compact=True),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("", total=n, completed=len(before), counts="")

    def __enter__(self) -> _ProgressLine:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def add_row(self, row: Row) -> None:
        self._rows.append(row)
        self._progress.update(self._task, completed=len(self._rows))
        if row.error or not self._console.is_terminal:
            text = row.error or f"{row.frames} frames, found in {_format_coverage(row)}, {row.seconds:.0f} s"
            style = "" if row.status == "done" else "bold yellow"
            line = Text.assemble(f"{len(self._rows)}/{self._n} {row.recording}: ", (row.status, style), f": {text}")
            self._console.print(line, soft_wrap=True)

    def show_counts(self, running: int, held: int) -> None:
        n_failed = sum(row.status != "done" for row in self._rows)
        parts = (
            [f"{running} running"] + [f"{held} held by others"] * bool(held) + [f"{n_failed} failed"] * bool(n_failed)
        )
        self._progress.update(self._task, counts=", ".join(parts))


def _print_rows(console: Console, rows: Sequence[Row]) -> None:
    with_messages = [row for row in rows if row.status != "done" or row.error or row.faults]
    shown = list(rows) if len(rows) <= MAX_ROWS else with_messages[:MAX_ROWS]
    if shown:
        console.print()
        console_output.print_table(console, HEADER, (_format_row(row) for row in shown))
    notes = [
        f"{row.recording}: {'; '.join(filter(None, (row.error, row.faults)))}" for row in shown if row in with_messages
    ]
    if any(not note.endswith(": ") for note in notes):
        console.print()
        console_output.print_warnings(console, [note for note in notes if not note.endswith(": ")])
    console.print()
    counts = Counter(row.status for row in rows)
    count_texts = [
        f"{n} {status}" for status, n in sorted(counts.items(), key=lambda item: (item[0] != "done", item[0]))
    ]
    facts = [("Recordings", f"{len(rows)}: {', '.join(count_texts)}")]
    if len(shown) < len(rows):
        facts.append(("Not shown", f"{len(rows) - len(shown)}: see summary.csv"))
    if seconds := sum(row.seconds or 0.0 for row in rows):
        facts.append(("Time", f"{_format_duration(seconds)} in total, over all recordings"))
    console_output.print_facts(console, facts)


def _print_files(console: Console, files: Sequence[str]) -> None:
    console_output.print_facts(console, [("Files" if k == 0 else "", file) for k, file in enumerate(files)])


def _format_row(row: Row) -> tuple[str, ...]:
    return (
        row.recording,
        row.status,
        "-" if row.frames is None else str(row.frames),
        _format_coverage(row),
        "-" if row.residual_px is None else f"{row.residual_px:.2f} px",
        "-" if row.seconds is None else _format_duration(row.seconds),
    )


def _format_coverage(row: Row) -> str:
    # Rounded down: 100% means all frames.
    return "-" if row.coverage is None else f"{int(100 * row.coverage)}%"


def _format_duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, hours = round(seconds / 60), int(seconds // 3600)
    return f"{minutes} min" if minutes < 100 else f"{hours} h {minutes - 60 * hours} min"


@contextlib.contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    previous_handler = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous_handler)
