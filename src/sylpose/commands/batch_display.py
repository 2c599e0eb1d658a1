"""Display of `sylpose batch` in a terminal: a progress line, failures as they occur, a final table, summary.csv."""

from __future__ import annotations

import csv
import io
from collections import Counter

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from sylpose.archive.contract import Summary
from sylpose.archive.recordings import Recording
from sylpose.io.stores import Store
from sylpose.runs import console_output

# Largest number of printed rows, those with messages first; summary.csv contains all (choice: a screen).
MAX_ROWS = 30
HEADER = ("Recording", "status", "frames", "found", "residual", "time")
FILE_COLUMNS = ("recording", "status", "frames", "coverage", "residual_px", "faults", "seconds", "error")
PROGRESS_COLUMNS = (TextColumn("Tracking"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[counts]}"))


class ProgressLine(Progress):
    """Progress line with one line per failure; without a terminal (a log) one line per recording.

    Args:
        n: number of recordings.
        summaries: those of the finished ones by name; further ones are added.
    """

    def __init__(self, n: int, summaries: dict[str, Summary]) -> None:
        console = console_output.make_console(stderr=True)
        columns = (*PROGRESS_COLUMNS, TimeRemainingColumn(compact=True))
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
        texts = [f"{n} {label}" for n, label in ((later, "waiting"), (n_failed, "failed")) if n]
        self.update(self._task, counts=", ".join([f"{running} running", *texts]))


def print_summaries(summaries: dict[str, Summary], destination: Store | None) -> None:
    """Print the summaries, and write them to `summary.csv` in a destination."""
    console = console_output.make_console()
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
        destination.write("summary.csv", _format_csv(summaries).encode())
        facts.append(("File", f"{destination.url}/summary.csv"))
    console_output.print_facts(console, facts)


def _format_csv(summaries: dict[str, Summary]) -> str:
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(FILE_COLUMNS)
    for name, s in summaries.items():
        seconds = None if s.seconds is None else round(s.seconds, 1)
        table.writerow([name, s.status, s.frames, s.coverage, s.residual_px, "; ".join(s.faults), seconds, s.error])
    return text.getvalue()


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
