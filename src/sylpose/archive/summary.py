"""Summary of all recordings of an archive, read from its destination, as a CSV and Parquet table."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from sylpose.archive.claims import CLAIM_PREFIX, is_alive, read_current_claim
from sylpose.archive.contract import DONE_FILE, FAILED_FILE, Record, RunSettings, Summary, find_finished, read_record
from sylpose.archive.recordings import Recording
from sylpose.archive.stores import Store

__all__ = ["Row", "collect_rows", "find_finished_recordings", "make_row", "write_summary"]

# Number of parallel reads (choice: object stores have high latency).
N_PARALLEL_READS = 16


@dataclass(frozen=True)
class Row:
    """Summary of a recording; the fields are the columns.

    Attributes:
        recording: its name.
        status: a `Summary`'s, or "waiting", "running", "outdated" (finished with other inputs, options or version).
        frames, coverage, residual_px, faults, seconds, error: as in `Summary`, the faults joined.
    """

    recording: str
    status: str
    frames: int | None = None
    coverage: float | None = None
    residual_px: float | None = None
    faults: str = ""
    seconds: float | None = None
    error: str = ""


COLUMNS = tuple(Row.__dataclass_fields__)


def make_row(name: str, summary: Summary) -> Row:
    tracked = summary.status in ("done", "nothing found")
    return Row(
        recording=name,
        status=summary.status,
        frames=summary.frames if tracked else None,
        coverage=summary.coverage,
        residual_px=summary.residual_px,
        faults="; ".join(summary.faults),
        seconds=round(summary.seconds, 1),
        error=summary.error,
    )


def find_finished_recordings(
    recordings: Sequence[Recording], destination: Store, settings: RunSettings
) -> dict[str, Summary]:
    """Return the summaries of recordings that need not be processed again, by name."""
    with ThreadPoolExecutor(N_PARALLEL_READS) as pool:
        known = pool.map(
            lambda recording: find_finished(destination.join(recording.name), recording, settings), recordings
        )
        return {r.name: summary for r, summary in zip(recordings, known, strict=True) if summary is not None}


def collect_rows(destination: Store, recordings: Iterable[Recording] | None = None) -> list[Row]:
    """Collect the status of all recordings, sorted by name.

    Args:
        destination: where the results are.
        recordings: None for all in the destination.
    """
    files = [f.name.rpartition("/") for f in destination.files()]
    with_record = {
        folder for folder, _, name in files if name in (DONE_FILE, FAILED_FILE) or name.startswith(CLAIM_PREFIX)
    } - {""}
    with_claim = {folder for folder, _, name in files if name.startswith(CLAIM_PREFIX)}
    wanted = (
        dict[str, Recording | None](dict.fromkeys(with_record))
        if recordings is None
        else {r.name: r for r in recordings}
    )

    def row(name: str) -> Row:
        store = destination.join(name)
        record = read_record(store) if name in with_record else None
        claim = read_current_claim(store) if name in with_claim else None
        if claim is not None and is_alive(claim):
            return Row(name, "running", error=f"by process {claim.pid} of {claim.host}")
        return _make_status_row(name, record, wanted[name])

    with ThreadPoolExecutor(N_PARALLEL_READS) as pool:
        return list(pool.map(row, sorted(wanted)))


def _make_status_row(name: str, record: Record | None, recording: Recording | None) -> Row:
    if record is None:
        return Row(name, "waiting")
    if recording is not None and record.digest != recording.digest:
        return Row(name, "outdated", error="its files, the options or the version of sylpose have changed")
    return make_row(name, record.summary)


def write_summary(destination: Store, rows: Sequence[Row]) -> list[str]:
    """Write summary.csv, and summary.parquet if PyArrow is installed; return their locations."""
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(COLUMNS)
    table.writerows([["" if (cell := getattr(row, name)) is None else cell for name in COLUMNS] for row in rows])
    destination.write("summary.csv", text.getvalue().encode())
    written = [f"{destination.url}/summary.csv"]
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return written
    numbers = {"frames": pyarrow.int64(), "coverage": pyarrow.float64(), "residual_px": pyarrow.float64()}
    types = {name: numbers.get(name, pyarrow.string()) for name in COLUMNS} | {"seconds": pyarrow.float64()}
    columns = [pyarrow.array([getattr(row, name) for row in rows], types[name]) for name in COLUMNS]
    with TemporaryDirectory() as folder:
        file = Path(folder) / "summary.parquet"
        parquet.write_table(pyarrow.table(columns, names=list(COLUMNS)), file)
        destination.write(file.name, file)
    return [*written, f"{destination.url}/summary.parquet"]
