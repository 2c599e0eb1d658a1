"""Tables of the times at which cameras took their frames: sylpose's own and those of other recorders."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors, open_regular_file, read_text
from sylpose.io.capture.names import match_all_names, match_names

TIMESTAMPS = "timestamps.csv"
# Folder of a table for each camera, of FreeMoCap.
TABLE_FOLDER = "timestamps"
# Columns of other recorders: Caliscope (cam_id or port, frame_time, sync_index), FreeMoCap.
CAMERA_COLUMNS = ("cam_id", "camera_id", "camera", "cam", "port")
TIME_COLUMNS = (
    "frame_time",
    "timestamp",
    "timestamps",
    "time",
    "timestamp_unix_seconds",
    "timestamp_unix_seconds_utc",
    "from_recording_start",
    "timestamp_perf_counter_ns",
)
# Words of file names that do not belong to a camera's name.
TABLE_WORDS = ("timestamps", "timestamp", "ts", "times")
# Longest time between frames of a camera, seconds (choice); with it, the unit follows: seconds, then milliseconds to
# nanoseconds if the numbers are 1000 times as large, and so on.
MAX_INTERVAL = 1.0
UNITS = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
# Shortest time between frames, seconds (choice: 100,000 frames per second).
MIN_INTERVAL = 1e-5
# Seconds since 1970 of the years 2001 to 2096, which show the unit whatever the interval (derived).
EPOCH = (1e9, 4e9)

# A row of a table with its line number.
_Row = tuple[int, list[str]]


@dataclass(frozen=True, eq=False)
class TimeTable:
    """Times of a recording's frames, seconds.

    Attributes:
        origin: the file's or the folder's name.
        stamps: (n, C) time of each camera's frame in each frame set, NaN for none; None if cameras are not aligned.
        clocks: per camera (n_c,) the times of its frames; None if they are aligned.
        warning: what is assumed of the unit; "" if it is seconds.
    """

    origin: str
    stamps: FloatArray | None
    clocks: tuple[FloatArray, ...] | None
    warning: str = ""


def find_time_table(folder: Path, cameras: Sequence[str], without: Sequence[str] = ()) -> TimeTable | None:
    """Find and read the times of a recording's frames.

    Read are timestamps.csv with a column `frame` and a column for each camera, or with a row for each frame of each
    camera (Caliscope), else a file for each camera in the folder or in its folder timestamps (FreeMoCap: .csv,
    DeepLabCut-live: .npy, Raspberry Pi and mkvmerge: .txt).

    Args:
        folder: of the recording.
        cameras: in the order of the result.
        without: excluded cameras, whose times are optional and left out.

    Returns:
        the times; None without a file.

    Raises:
        ValueError: a table of another form, invalid numbers, times that do not increase, or of no usual unit; the message
            names the file and line.
    """
    path = folder / TIMESTAMPS
    if path.is_file():
        return _to_seconds(_read_table(path, cameras, without), path)
    names = [*cameras, *without]
    for place in (folder, folder / TABLE_FOLDER):
        files = _find_camera_files(place, names) if place.is_dir() else {}
        if set(files) >= set(cameras):
            clocks = tuple(_read_clock(files[name]) for name in cameras)
            origin = files[cameras[0]].name if place == folder else TABLE_FOLDER
            return _to_seconds(TimeTable(origin, None, clocks), place)
    return None


def _to_seconds(table: TimeTable, path: Path) -> TimeTable:
    """Convert times to seconds: the unit follows from their size, or from the frame rates that cameras have.

    Raises:
        ValueError: no unit gives a frame rate that a camera can have.
    """
    columns = list(table.clocks or ())
    if table.stamps is not None:
        columns = [column[~np.isnan(column)] for column in table.stamps.T]
    intervals = [float(np.median(np.diff(column))) for column in columns if len(column) > 1]
    first = min(float(column[0]) for column in columns if len(column))
    if not intervals:
        return table
    interval = min(intervals)
    by_epoch = [unit for unit, scale in UNITS.items() if EPOCH[0] <= first * scale <= EPOCH[1]]
    by_rate = [unit for unit, scale in UNITS.items() if interval * scale <= MAX_INTERVAL]
    unit = (by_epoch or by_rate or [""])[0]
    if not unit or not MIN_INTERVAL <= interval * UNITS[unit] <= MAX_INTERVAL * 1e3:
        raise ValueError(
            f"{path}: times of {interval:.3g} between frames, which is no camera's interval in seconds to nanoseconds; "
            "write the times in seconds"
        )
    if unit == "seconds":
        return table
    scale, warning = UNITS[unit], f"{table.origin} is read as {unit}: {interval * UNITS[unit]:.3g} s between frames."
    stamps = None if table.stamps is None else table.stamps * scale
    clocks = None if table.clocks is None else tuple(clock * scale for clock in table.clocks)
    return TimeTable(table.origin, stamps, clocks, warning)


def _read_table(path: Path, cameras: Sequence[str], without: Sequence[str]) -> TimeTable:
    """Read a table of all cameras."""
    rows = _read_rows(path)
    header = [name.strip().lower() for name in rows[0][1]] if rows else []
    with input_errors(path):
        if set(header) & set(CAMERA_COLUMNS) and set(header) & set(TIME_COLUMNS):
            by_camera = _parse_long(rows, header, [*cameras, *without], path)
            return TimeTable(path.name, None, tuple(by_camera[: len(cameras)]))
        try:
            return TimeTable(path.name, _parse_rows(rows, cameras, path), None)
        except ValueError:
            if not without:
                raise
        stamps = _parse_rows(rows, [*cameras, *without], path)[:, : len(cameras)]
        return TimeTable(path.name, stamps[np.isfinite(stamps).any(axis=1)], None)


def _read_rows(path: Path) -> list[_Row]:
    text = read_text(path, MAX_TABLE_BYTES)
    with input_errors(path):
        try:
            delimiter = _find_delimiter(text)
            reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
            rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
            while len(rows) > 1 and rows[0][1][0].startswith("# timecode format"):
                rows = rows[1:]
        except csv.Error as error:
            raise ValueError(f"cannot be read as CSV ({error})") from None
    if delimiter == ",":
        return rows
    # Spreadsheets of other languages write decimal commas.
    return [*rows[:1], *((line, [cell.replace(",", ".") for cell in row]) for line, row in rows[1:])]


def _find_delimiter(text: str) -> str:
    """Return what separates the columns in the first line: a semicolon or a tab if it has no comma."""
    header = text.lstrip().partition("\n")[0]
    return next((delimiter for delimiter in (",", ";", "\t") if delimiter in header), ",")


def _parse_long(rows: Sequence[_Row], header: Sequence[str], cameras: Sequence[str], path: Path) -> list[FloatArray]:
    """Return the times of each camera's frames from a table with a row for each of them."""
    camera_column = next(k for k, name in enumerate(header) if name in CAMERA_COLUMNS)
    time_column = next(k for k, name in enumerate(header) if name in TIME_COLUMNS)
    times = dict[str, list[float]]()
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise ValueError(f"{path}: line {line}: {len(header)} columns are expected, got {len(row)}")
        times.setdefault(row[camera_column].strip(), []).append(_parse_time(row[time_column], f"{path}: line {line}"))
    matched = match_all_names(times, cameras, path)
    by_camera = {camera: np.array(times[name]) for name, camera in matched.items()}
    missing = [camera for camera in cameras if camera not in by_camera]
    if missing:
        raise ValueError(f"{path}: no times of {', '.join(missing)} in the column {header[camera_column]}")
    return [_check_clock(by_camera[camera], f"{path}: {camera}") for camera in cameras]


def _find_camera_files(folder: Path, cameras: Sequence[str]) -> dict[str, Path]:
    """Return the file of times of each camera, of those that have one."""
    found = dict[str, Path]()
    for file in sorted(folder.iterdir()):
        words = file.stem.replace("-", "_").split("_")
        kept = [word for word in words if word.lower() not in TABLE_WORDS]
        is_named = len(kept) < len(words) or folder.name == TABLE_FOLDER
        if is_named and file.suffix.lower() in (".csv", ".txt", ".npy") and file.is_file():
            found["_".join(kept)] = file
    matched = match_names(found, cameras, folder)
    return {camera: found[name] for name, camera in matched.items()}


def _read_clock(path: Path) -> FloatArray:
    """Read the times of one camera's frames."""
    with input_errors(path):
        if path.suffix.lower() == ".npy":
            with open_regular_file(path, MAX_TABLE_BYTES) as file:
                times = np.lib.format.read_array(file, allow_pickle=False)
            if times.ndim != 1 or times.dtype.kind not in "fiu":
                raise ValueError(f"a row of numbers is expected, got {times.ndim} dimensions of type {times.dtype}")
            return _check_clock(times.astype(float), str(path))
        rows = _read_rows(path)
        header = [name.strip().lower() for name in rows[0][1]] if rows else []
        column = next((k for k, name in enumerate(header) if name in TIME_COLUMNS), None)
        if column is None and len(header) == 1:
            column, rows = 0, rows if _is_number(header[0]) else rows[1:]
        elif column is None:
            raise ValueError(
                f"a column of times is expected ({', '.join(TIME_COLUMNS[:4])}), got {', '.join(header[:8])}"
            )
        else:
            rows = rows[1:]
        times = np.array(
            [_parse_time(row[column] if column < len(row) else "", f"{path}: line {n}") for n, row in rows]
        )
        return _check_clock(times, str(path))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _parse_time(text: str, where: str) -> float:
    if not _is_number(text) or not np.isfinite(float(text)):
        raise ValueError(f"{where}: a time is expected, got {text!r}")
    return float(text)


def _check_clock(times: FloatArray, where: str) -> FloatArray:
    if not len(times):
        raise ValueError(f"{where}: no times in this file")
    if not np.isfinite(times).all():
        raise ValueError(f"{where}: times that increase from frame to frame are expected")
    if (late := np.flatnonzero(np.diff(times) <= 0)).size:
        k = int(late[0]) + 1
        raise ValueError(
            f"{where}: times that increase from frame to frame are expected, but frame {k} has {times[k]:.16g} after "
            f"{times[k - 1]:.16g}; remove what is there twice"
        )
    return times


def _parse_rows(rows: Sequence[_Row], cameras: Sequence[str], path: Path) -> FloatArray:
    """Return (n, C) numbers of a table with a column for each camera."""
    header = [name.strip() for name in rows[0][1]] if rows else []
    if header[:1] != ["frame"] or len(header) > len(cameras) + 100:
        raise ValueError(f"{path}: line 1: the columns frame, {', '.join(cameras)} are expected")
    matched = match_all_names(header[1:], cameras, f"{path}: line 1")
    if len(set(header)) < len(header) or set(matched.values()) != set(cameras):
        raise ValueError(f"{path}: line 1: one column for each of {', '.join(cameras)} is expected")
    order = [list(cameras).index(matched[name]) for name in header[1:]]
    if not rows[1:]:
        raise ValueError(f"{path}: no timestamps in this file")

    stamps = np.full((len(rows) - 1, len(cameras)), np.nan)
    last, last_mean = np.full(len(cameras), -np.inf), -np.inf
    for i, (line, row) in enumerate(rows[1:]):
        where = f"{path}: line {line}"
        stamps[i, order] = _parse_row(row, i, len(header), where)
        is_present = np.isfinite(stamps[i])
        if not is_present.any():
            raise ValueError(f"{where}: no camera has a timestamp")
        # The mean is the frame set's time. It can decrease if the clocks differ and one camera is missing.
        mean = stamps[i, is_present].mean()
        if (stamps[i, is_present] <= last[is_present]).any() or mean <= last_mean:
            raise ValueError(f"{where}: the timestamps must increase from row to row")
        last[is_present], last_mean = stamps[i, is_present], mean
    return stamps


def _parse_row(row: list[str], frame: int, columns: int, where: str) -> FloatArray:
    if len(row) != columns:
        raise ValueError(f"{where}: {columns} columns are expected, got {len(row)}")
    if row[0].strip() != str(frame):
        raise ValueError(f"{where}: frame {frame} is expected, got {row[0]!r}")
    try:
        numbers = np.array([float(cell) if cell.strip() else np.nan for cell in row[1:]])
    except ValueError:
        raise ValueError(f"{where}: timestamps in seconds are expected, got {', '.join(row[1:])}") from None
    if any(cell.strip() and not np.isfinite(n) for cell, n in zip(row[1:], numbers, strict=True)):
        raise ValueError(f"{where}: timestamps must be finite, got {', '.join(row[1:])}")
    return numbers
