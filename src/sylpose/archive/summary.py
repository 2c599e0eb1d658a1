"""What became of all recordings of an archive: read from its destination, as a table in CSV and Parquet."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from sylpose.archive.claims import CLAIM, holder, is_alive
from sylpose.archive.contract import DONE, FAILED, How, Record, Summary, finished, read_record
from sylpose.archive.recordings import Recording
from sylpose.archive.stores import Place

__all__ = ["Row", "finished_before", "gathered", "row_of", "write_summary"]

# Files that are read at once (choice: an object store's answers take a while each).
AT_ONCE = 16


@dataclass(frozen=True)
class Row:
    """A recording; the fields are the columns.

    Attributes:
        recording: its name.
        status: a `Summary`'s, or "waiting", "running", "outdated" (finished with other inputs, options or version).
        frames, coverage, residual_px, faults, seconds, error: as in `Summary`, the faults in one text.
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


def row_of(name: str, summary: Summary) -> Row:
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


def finished_before(recordings: Sequence[Recording], destination: Place, how: How) -> dict[str, Summary]:
    """By name, what is known of the recordings that need not be worked on again."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        known = pool.map(lambda recording: finished(destination.below(recording.name), recording, how), recordings)
        return {r.name: summary for r, summary in zip(recordings, known, strict=True) if summary is not None}


def gathered(destination: Place, recordings: Iterable[Recording] | None = None) -> list[Row]:
    """What is known of all recordings, sorted by name.

    Args:
        recordings: None for those that have something in the destination.
    """
    kept = [f.name.rpartition("/") for f in destination.files()]
    known = {folder for folder, _, name in kept if name in (DONE, FAILED) or name.startswith(CLAIM)} - {""}
    claimed = {folder for folder, _, name in kept if name.startswith(CLAIM)}
    wanted = (
        dict[str, Recording | None](dict.fromkeys(known)) if recordings is None else {r.name: r for r in recordings}
    )

    def row(name: str) -> Row:
        place = destination.below(name)
        record = read_record(place) if name in known else None
        claim = holder(place) if name in claimed else None
        if claim is not None and is_alive(claim):
            return Row(name, "running", error=f"by process {claim.pid} of {claim.host}")
        return _row(name, record, wanted[name])

    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(row, sorted(wanted)))


def _row(name: str, record: Record | None, recording: Recording | None) -> Row:
    if record is None:
        return Row(name, "waiting")
    if recording is not None and record.digest != recording.digest:
        return Row(name, "outdated", error="its files, the options or sylpose have changed since")
    return row_of(name, record.summary)


def write_summary(destination: Place, rows: Sequence[Row]) -> list[str]:
    """Writes summary.csv, and summary.parquet where PyArrow is installed; returns where."""
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
