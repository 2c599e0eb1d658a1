"""Summaries of all recordings of an archive, read from its destination, as a CSV table."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import PurePosixPath

from sylpose.archive.contract import DONE_FILE, FAILED_FILE, Summary, read_owner, read_record
from sylpose.archive.recordings import Recording
from sylpose.archive.stores import Store

# Number of parallel reads (choice: object stores have high latency).
N_PARALLEL_READS = 16
COLUMNS = ("recording", "status", "frames", "coverage", "residual_px", "faults", "seconds", "error")


def collect_summaries(destination: Store, recordings: Sequence[Recording] | None = None) -> dict[str, Summary]:
    """Collect the summaries of all recordings by name, sorted; their status may be that of work in progress.

    Args:
        destination: where the results are.
        recordings: None for all in the destination.
    """
    wanted: dict[str, Recording | None] = {recording.name: recording for recording in recordings or ()}
    if recordings is None:
        paths = [PurePosixPath(file.name) for file in destination.files()]
        names = [path for path in paths if path.name in (DONE_FILE, FAILED_FILE) or path.name.startswith("claim-")]
        wanted = dict.fromkeys(path.parent.as_posix() for path in names if len(path.parts) > 1)

    def collect(name: str) -> Summary:
        store, recording = destination.join(name), wanted[name]
        record, owner = read_record(store), read_owner(store)
        if owner:
            return Summary(status="running", error=f"by {owner}")
        if record is None:
            return Summary(status="waiting")
        if recording is not None and record.digest != recording.digest:
            message = "its files, the options or the version of sylpose have changed"
            return Summary(status="outdated", error=message)
        return record.summary

    with ThreadPoolExecutor(N_PARALLEL_READS) as pool:
        return dict(zip(sorted(wanted), pool.map(collect, sorted(wanted)), strict=True))


def write_summary(destination: Store, summaries: dict[str, Summary]) -> str:
    """Write summary.csv; return its location."""
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(COLUMNS)
    for name, s in summaries.items():
        seconds = None if s.seconds is None else round(s.seconds, 1)
        table.writerow([name, s.status, s.frames, s.coverage, s.residual_px, "; ".join(s.faults), seconds, s.error])
    destination.write("summary.csv", text.getvalue().encode())
    return f"{destination.url}/summary.csv"
