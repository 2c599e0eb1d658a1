"""An archive tracked for a terminal: one line of progress, failures as they come, a table at the end."""

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

from sylpose.app import console_output
from sylpose.archive.contract import How, Summary
from sylpose.archive.processes import Processes, default_jobs
from sylpose.archive.ray_cluster import RayWorkers
from sylpose.archive.recordings import Found, Recording
from sylpose.archive.run import run_all, shard_of
from sylpose.archive.stores import Place
from sylpose.archive.summary import Row, finished_before, gathered, row_of, write_summary

__all__ = ["batch_aloud", "status_aloud"]

# Rows of the table that is printed, those with something to say first; all are in summary.csv (choice: a screen).
SHOWN = 30
HEADER = ("Recording", "status", "frames", "found", "residual", "time")


def batch_aloud(
    found: Found,
    destination: Place,
    how: How,
    *,
    jobs: int | None = None,
    ray: str | None = None,
    shard: str | None = None,
    memory: int | None = None,
) -> list[Row]:
    """Tracks all recordings and says what became of them; how each stands at the end.

    Args:
        jobs: processes; None: as many as there are cores and memory for.
        ray: address of a cluster, instead of processes.
        shard: "3/100": only these; then no summary is written, since others are at work on theirs.
        memory: bytes for each.

    Raises:
        KeyboardInterrupt: with a sentence; SIGTERM too, by which SLURM ends what takes too long.
        ValueError, OSError: wrong options; the destination cannot be written.
    """
    console = console_output.make_console()
    recordings = list(found.recordings) if shard is None else shard_of(found.recordings, shard)
    # A destination that cannot be written is better found out now than a thousand times.
    destination.write("batch.txt", b"Results of sylpose batch, a folder for each recording: docs/archive.md\n")
    console_output.print_warnings(console, found.remarks)
    how = replace(how, run=how.run or uuid.uuid4().hex)
    jobs = jobs or default_jobs(how.threads)
    where = f"Ray at {ray}" if ray else f"{min(jobs, max(len(recordings), 1))} at a time"
    part = f", shard {shard} of {len(found.recordings)}" if shard else ""
    n = len(recordings)
    console.print(
        Text.assemble((f"{n} recording{'' if n == 1 else 's'}", "bold"), f"{part}, {where} -> {destination.url}")
    )
    before = finished_before(recordings, destination, how)
    rows = {name: row_of(name, summary) for name, summary in before.items()}
    if before:
        console.print(f"{len(before)} of them {'is' if len(before) == 1 else 'are'} finished already.")
    left = [recording for recording in recordings if recording.name not in before]
    with _Line(n, list(rows.values())) as line, _interrupted_by_sigterm():

        def take(recording: Recording, summary: Summary) -> None:
            rows[recording.name] = row_of(recording.name, summary)
            line.take(rows[recording.name])

        try:
            with (
                RayWorkers(destination, how, ray, memory)
                if ray
                else Processes(destination, how, jobs, memory) as workers
            ):
                run_all(left, destination, how, workers, take, line.look)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"interrupted after {len(rows)} of {n}; what is finished stays, the same command goes on"
            ) from None
    ordered = [rows[recording.name] for recording in recordings]
    _print_rows(console, ordered)
    if shard is None:
        _print_written(console, write_summary(destination, ordered))
    else:
        console.print(f"All shards in one table: sylpose batch --status --out {destination.url}", soft_wrap=True)
    return ordered


def status_aloud(destination: Place, recordings: Sequence[Recording] | None) -> list[Row]:
    """Says how all recordings stand, and writes the summary anew.

    Raises:
        ValueError: nothing there.
    """
    rows = gathered(destination, recordings)
    if not rows:
        raise ValueError(f"{destination.url}: no results of sylpose batch in it")
    console = console_output.make_console()
    _print_rows(console, rows)
    _print_written(console, write_summary(destination, rows))
    return rows


class _Line:
    """The line of progress, and a line for each failure; where nobody looks (a log) a line for each recording."""

    def __init__(self, n: int, before: list[Row]) -> None:
        self._n, self._rows = n, before
        self._console = console_output.make_console(stderr=True)
        self._progress = Progress(
            TextColumn("Tracking"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[said]}"),
            TimeRemainingColumn(compact=True),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("", total=n, completed=len(before), said="")

    def __enter__(self) -> _Line:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def take(self, row: Row) -> None:
        self._rows.append(row)
        self._progress.update(self._task, completed=len(self._rows))
        if row.error or not self._console.is_terminal:
            said = row.error or f"{row.frames} frames, found in {_share(row)}, {row.seconds:.0f} s"
            style = "" if row.status == "done" else "bold yellow"
            line = Text.assemble(f"{len(self._rows)}/{self._n} {row.recording}: ", (row.status, style), f": {said}")
            self._console.print(line, soft_wrap=True)

    def look(self, running: int, held: int) -> None:
        wrong = sum(row.status != "done" for row in self._rows)
        parts = [f"{running} running"] + [f"{held} held by others"] * bool(held) + [f"{wrong} failed"] * bool(wrong)
        self._progress.update(self._task, said=", ".join(parts))


def _print_rows(console: Console, rows: Sequence[Row]) -> None:
    said = [row for row in rows if row.status != "done" or row.error or row.faults]
    shown = list(rows) if len(rows) <= SHOWN else said[:SHOWN]
    if shown:
        console.print()
        console_output.print_table(console, HEADER, (_cells(row) for row in shown))
    notes = [f"{row.recording}: {'; '.join(filter(None, (row.error, row.faults)))}" for row in shown if row in said]
    if any(not note.endswith(": ") for note in notes):
        console.print()
        console_output.print_warnings(console, [note for note in notes if not note.endswith(": ")])
    console.print()
    counts = Counter(row.status for row in rows)
    parts = [f"{n} {status}" for status, n in sorted(counts.items(), key=lambda item: (item[0] != "done", item[0]))]
    facts = [("Recordings", f"{len(rows)}: {', '.join(parts)}")]
    if len(shown) < len(rows):
        facts.append(("Not shown", f"{len(rows) - len(shown)}: see summary.csv"))
    if seconds := sum(row.seconds or 0.0 for row in rows):
        facts.append(("Time", f"{_duration(seconds)} of work in all"))
    console_output.print_facts(console, facts)


def _print_written(console: Console, files: Sequence[str]) -> None:
    console_output.print_facts(console, [("Files" if k == 0 else "", file) for k, file in enumerate(files)])


def _cells(row: Row) -> tuple[str, ...]:
    return (
        row.recording,
        row.status,
        "-" if row.frames is None else str(row.frames),
        _share(row),
        "-" if row.residual_px is None else f"{row.residual_px:.2f} px",
        "-" if row.seconds is None else _duration(row.seconds),
    )


def _share(row: Row) -> str:
    # Downwards: 100% is said of all frames only.
    return "-" if row.coverage is None else f"{int(100 * row.coverage)}%"


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, hours = round(seconds / 60), int(seconds // 3600)
    return f"{minutes} min" if minutes < 100 else f"{hours} h {minutes - 60 * hours} min"


@contextlib.contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
