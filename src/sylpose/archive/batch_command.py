"""Terminal interface of batch tracking: a progress line, failures as they occur, and a final table."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from sylpose.archive.contract import RunSettings, Summary, is_final
from sylpose.archive.recordings import Recording
from sylpose.archive.run import ProcessWorkers, RayWorkers, choose_default_jobs, process_all, select_shard
from sylpose.archive.stores import Store
from sylpose.archive.summary import collect_summaries, write_summary
from sylpose.runs import console_output

# Largest number of printed rows, those with messages first; summary.csv contains all (choice: a screen).
MAX_ROWS = 30
HEADER = ("Recording", "status", "frames", "found", "residual", "time")
COLUMNS = (TextColumn("Tracking"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[counts]}"))


@dataclass(frozen=True)
class BatchWorkers:
    """Who works on which part of the recordings.

    Attributes:
        jobs: number of processes; None: as many as cores and memory allow.
        ray: address of a Ray cluster, instead of processes.
        shard: "3/100": only this part; then no summary is written, since other shards run in parallel.
        memory: bytes for each recording.
    """

    jobs: int | None = None
    ray: str | None = None
    shard: str | None = None
    memory: int | None = None


def run_batch_command(
    all_recordings: Sequence[Recording], remarks: Sequence[str], settings: RunSettings, workers: BatchWorkers
) -> dict[str, Summary]:
    """Track all recordings and print the results.

    Args:
        all_recordings: the recordings.
        remarks: messages about further folders.
        settings: settings of the run.
        workers: who works.

    Returns:
        The summary of each recording by name, in their order.

    Raises:
        KeyboardInterrupt: with a message; also on SIGTERM, which SLURM sends at the time limit.
        ValueError, OSError: invalid options, or the destination is not writable.
    """
    console, shard, destination = console_output.make_console(), workers.shard, settings.destination
    recordings = all_recordings if shard is None else select_shard(all_recordings, shard)
    # Fail now rather than once per recording if the destination is not writable.
    destination.write("batch.txt", b"Results of sylpose batch, a folder for each recording: docs/archive.md\n")
    console_output.print_warnings(console, remarks)
    jobs, n = workers.jobs or choose_default_jobs(settings.threads), len(recordings)
    workers_text = f"Ray at {workers.ray}" if workers.ray else f"{min(jobs, max(n, 1))} at a time"
    shard_text = f", shard {shard} of {len(all_recordings)}" if shard else ""
    headline = f"{shard_text}, {workers_text} -> {destination.url}"
    console.print(Text.assemble((f"{n} recording{'' if n == 1 else 's'}", "bold"), headline))
    summaries = collect_summaries(destination, recordings)
    summaries = {name: summary for name, summary in summaries.items() if is_final(summary, settings)}
    if summaries:
        console.print(f"{len(summaries)} of them {'is' if len(summaries) == 1 else 'are'} already finished.")
    remaining = [recording for recording in recordings if recording.name not in summaries]
    previous_handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with (
            _ProgressLine(n, summaries) as line,
            RayWorkers(settings, workers.ray, workers.memory)
            if workers.ray
            else ProcessWorkers(settings, jobs, workers.memory) as driver,
        ):
            process_all(remaining, settings, driver, line.add_result, line.show_counts)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted after {len(summaries)} of {n}; finished results are kept, repeat the command to resume"
        ) from None
    finally:
        signal.signal(signal.SIGTERM, previous_handler)
    summaries = {recording.name: summaries[recording.name] for recording in recordings}
    _print_summaries(console, summaries, None if shard else destination)
    if shard:
        console.print(f"All shards in one table: sylpose batch --status --out {destination.url}", soft_wrap=True)
    return summaries


def run_status_command(destination: Store, recordings: Sequence[Recording] | None) -> None:
    """Print the status of all recordings and rewrite the summary.

    Args:
        destination: where the results are.
        recordings: None for all in the destination.

    Raises:
        ValueError: the destination contains no results.
    """
    summaries = collect_summaries(destination, recordings)
    if not summaries:
        raise ValueError(f"{destination.url}: contains no results of sylpose batch")
    _print_summaries(console_output.make_console(), summaries, destination)


class _ProgressLine(Progress):
    """Progress line with one line per failure; without a terminal (a log) one line per recording."""

    def __init__(self, n: int, summaries: dict[str, Summary]) -> None:
        console = console_output.make_console(stderr=True)
        columns = (*COLUMNS, TimeRemainingColumn(compact=True))
        super().__init__(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._n, self._summaries = n, summaries
        self._task = self.add_task("", total=n, completed=len(summaries), counts="")

    def add_result(self, recording: Recording, summary: Summary) -> None:
        self._summaries[recording.name] = summary
        self.update(self._task, completed=len(self._summaries))
        if summary.error or self.disable:
            _, _, frames, coverage, _, duration = _format_row(recording.name, summary)
            style = "" if summary.status == "done" else "bold yellow"
            text = f": {summary.error or f'{frames} frames, found in {coverage}, {duration}'}"
            start = f"{len(self._summaries)}/{self._n} {recording.name}: "
            self.console.print(Text.assemble(start, (summary.status, style), text), soft_wrap=True)

    def show_counts(self, running: int, later: int) -> None:
        n_failed = sum(summary.status != "done" for summary in self._summaries.values())
        texts = [f"{n} {label}" for n, label in ((later, "to retry"), (n_failed, "failed")) if n]
        self.update(self._task, counts=", ".join([f"{running} running", *texts]))


def _print_summaries(console: Console, summaries: dict[str, Summary], destination: Store | None) -> None:
    """Print the summaries, and write them to a destination."""
    messages = {name: "; ".join(filter(None, (s.error, *s.faults))) for name, s in summaries.items()}
    shown = list(summaries)
    if len(shown) > MAX_ROWS:
        shown = [name for name, summary in summaries.items() if summary.status != "done" or messages[name]][:MAX_ROWS]
    if shown:
        console.print()
        console_output.print_table(console, HEADER, (_format_row(name, summaries[name]) for name in shown))
    if notes := [f"{name}: {messages[name]}" for name in shown if messages[name]]:
        console.print()
        console_output.print_warnings(console, notes)
    console.print()
    counts = sorted(Counter(s.status for s in summaries.values()).items(), key=lambda c: (c[0] != "done", c[0]))
    facts = [("Recordings", f"{len(summaries)}: {', '.join(f'{n} {status}' for status, n in counts)}")]
    if len(shown) < len(summaries):
        facts.append(("Not shown", f"{len(summaries) - len(shown)}: see summary.csv"))
    if seconds := sum(summary.seconds or 0.0 for summary in summaries.values()):
        facts.append(("Time", f"{_format_duration(seconds)} in total, over all recordings"))
    if destination is not None:
        facts.append(("File", write_summary(destination, summaries)))
    console_output.print_facts(console, facts)


def _format_row(name: str, s: Summary) -> tuple[str, ...]:
    frames = "-" if s.frames is None else str(s.frames)
    # Rounded down: 100% means all frames.
    coverage = "-" if s.coverage is None else f"{int(100 * s.coverage)}%"
    residual = "-" if s.residual_px is None else f"{s.residual_px:.2f} px"
    return name, s.status, frames, coverage, residual, "-" if s.seconds is None else _format_duration(s.seconds)


def _format_duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, hours = round(seconds / 60), int(seconds // 3600)
    return f"{minutes} min" if minutes < 100 else f"{hours} h {minutes - 60 * hours} min"
