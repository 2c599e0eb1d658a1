"""Timeline of a session: frame of each camera and time of each frame set."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors, read_text
from sylpose.io.capture.alignment import MAX_RATE_RATIO, align, read_clocks
from sylpose.io.capture.names import match_all_names
from sylpose.io.capture.sources import Source


@dataclass(frozen=True, eq=False)
class Timeline:
    """Timeline of a session with n frame sets and C cameras in the rig's order.

    Attributes:
        frames: (n, C) frame number of each camera in each frame set, counted from 0; -1 for none.
        times: (n,) seconds; frame-set numbers without timestamps and frame rate.
        stamps: (n, C) timestamp of each camera, seconds; NaN for none.
        rate: average number of frame sets per second, or None.
        offsets: given frame offsets by camera, positive for a camera that starts late.
        origin: where the timestamps are from; "" without.
    """

    frames: IntArray
    times: FloatArray
    stamps: FloatArray
    rate: float | None
    offsets: Mapping[str, int] = field(default_factory=dict)
    origin: str = ""


def load_timestamps(path: Path, cameras: Sequence[str], without: Sequence[str] = ()) -> FloatArray:
    """Read timestamps.csv: a column `frame`, counted from 0, and one column of seconds per camera.

    Empty cells mean no frame.

    Args:
        path: the CSV file.
        cameras: the cameras, in the order of the result.
        without: excluded cameras, whose columns are optional; rows with no other camera are dropped.

    Returns:
        (n, C) seconds in the order of `cameras`; NaN if a camera has no frame.

    Raises:
        ValueError: unexpected columns, invalid numbers, times that do not increase, or a row without times; the message
            names the file and line.
    """
    text = read_text(path, MAX_TABLE_BYTES)
    with input_errors(path):
        try:
            return _parse_timestamps(text, cameras, path)
        except ValueError:
            if not without:
                raise
        stamps = _parse_timestamps(text, [*cameras, *without], path)[:, : len(cameras)]
        return np.asarray(stamps[np.isfinite(stamps).any(axis=1)])


def _parse_timestamps(text: str, cameras: Sequence[str], path: Path) -> FloatArray:
    try:
        reader = csv.reader(io.StringIO(text, newline=""))
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise ValueError(f"cannot be read as CSV ({error})") from None
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


def build_timeline(
    sources: tuple[Source, ...],
    stamps: FloatArray | None = None,
    offsets: Mapping[str, int] | None = None,
    rate: float | None = None,
) -> tuple[Timeline, list[str]]:
    """Build the timeline of a session.

    With timestamps, each row is a frame set, and a camera's next frame belongs to its next non-empty row. Otherwise
    videos are aligned by the time stamps in the files, if these differ from a constant rate that all have in common:
    frames are lost, rates or starts differ. Else frame k of a camera belongs to frame set k + offset; image folders with
    common numbers are aligned by them.

    Args:
        sources: one per camera.
        stamps: (n, C) of `load_timestamps`.
        offsets: frames by camera; positive for a camera that starts late.
        rate: frames per second of image folders.

    Returns:
        The timeline, and warnings.

    Raises:
        ValueError: a rate that is not positive, or given for videos or timestamps; an unknown camera in `offsets`, an
            offset that is not an integer or exceeds the number of frames; both offsets and timestamps; no frame left.
    """
    warnings: list[str] = []
    if rate is not None:
        if not (np.isfinite(rate) and rate > 0):
            raise ValueError(f"rate: frames per second, a positive number, are expected, got {rate}")
        if stamps is not None or any(source.kind == "video" for source in sources):
            origin = "timestamps.csv" if stamps is not None else "the videos"
            raise ValueError(f"rate: only for image folders without timestamps; here the times come from {origin}")
    if stamps is not None:
        if offsets:
            raise ValueError("offsets cannot be combined with timestamps, which already contain the time of each frame")
        frames = _assign_by_timestamps(sources, stamps, warnings)
    elif (clocks := read_clocks(sources, _check_offsets(sources, offsets or {}, warnings), warnings)) is not None:
        frames, times, stamps = align(sources, clocks, warnings)
        frame_rate = (len(times) - 1) / float(times[-1]) if len(times) > 1 else None
        return Timeline(frames, times, stamps, frame_rate, dict(offsets or {}), "the videos' time stamps"), warnings
    else:
        frames = _assign_by_count(sources, offsets or {}, warnings)
    used = np.flatnonzero((frames >= 0).any(axis=1))
    if not len(used):
        raise ValueError("no frame set contains any frame with these offsets")
    frames = frames[: used[-1] + 1]
    if stamps is not None:
        stamps = stamps[: len(frames)]
        times = np.nanmean(stamps, axis=1)
        frame_rate = float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 else None
    else:
        stamps = np.full(frames.shape, np.nan)
        rates = {source.camera: source.rate for source in sources if source.rate}
        frame_rate = next(iter(rates.values()), rate)
        if rates and max(rates.values()) > MAX_RATE_RATIO * min(rates.values()):
            listed = ", ".join(f"{camera} {value:.6g}" for camera, value in rates.items())
            warnings.append(
                f"The videos' frame rates differ ({listed}); {frame_rate:.6g} per second is used for the times."
            )
        times = np.arange(len(frames)) / (frame_rate or 1.0)
    origin = "" if np.isnan(stamps).all() else "timestamps.csv"
    return Timeline(frames, times, stamps, frame_rate, dict(offsets or {}), origin), warnings


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


def _assign_by_timestamps(sources: tuple[Source, ...], stamps: FloatArray, warnings: list[str]) -> IntArray:
    frames = np.full(stamps.shape, -1, dtype=np.int64)
    for c, source in enumerate(sources):
        rows = np.flatnonzero(np.isfinite(stamps[:, c]))
        if len(rows) != source.n_frames:
            warnings.append(f"{source.camera} has {len(rows)} timestamps and {source.n_frames} frames.")
        n = min(len(rows), source.n_frames)
        frames[rows[:n], c] = np.arange(n)
    return frames


def _check_offsets(sources: tuple[Source, ...], offsets: Mapping[str, int], warnings: list[str]) -> Mapping[str, int]:
    names = [source.camera for source in sources]
    for camera, offset in offsets.items():
        if camera not in names:
            raise ValueError(f"offsets: {camera} is not a camera of the calibration ({', '.join(names)})")
        if not isinstance(offset, int | np.integer):
            raise ValueError(f"offsets: the offset of {camera} must be a whole number of frames, got {offset!r}")
        longest = max(source.n_frames for source in sources)
        if abs(offset) > longest:
            raise ValueError(f"offsets: the offset of {camera}, {offset}, exceeds the number of frames, {longest}")
        if offset < 0:
            warnings.append(f"{camera}: its first {-offset} frames precede frame set 0 and are not used.")
    return offsets


def _assign_by_count(sources: tuple[Source, ...], offsets: Mapping[str, int], warnings: list[str]) -> IntArray:
    names = [source.camera for source in sources]
    if len({source.n_frames for source in sources}) > 1:
        counts = ", ".join(f"{source.camera} {source.n_frames}" for source in sources)
        warnings.append(f"The cameras have different numbers of frames: {counts}.")
    slots = _align_slots(sources, warnings)
    set_indices = [slot + int(offsets.get(name, 0)) for slot, name in zip(slots, names, strict=True)]
    n = max(0, *(int(i[-1]) + 1 for i in set_indices))
    frames = np.full((n, len(sources)), -1, dtype=np.int64)
    for c, i in enumerate(set_indices):
        frames[i[i >= 0], c] = np.flatnonzero(i >= 0)
    return frames


def _align_slots(sources: tuple[Source, ...], warnings: list[str]) -> list[IntArray]:
    """Return the frame-set index of each frame of each camera, before offsets."""
    slots = [np.arange(source.n_frames) for source in sources]
    numbers = {c: source.numbers for c, source in enumerate(sources) if source.kind == "images"}
    usable = [set(values) for values in numbers.values() if values is not None]
    if len(numbers) < 2 or not usable:
        return slots
    if len(usable) < len(numbers) or not set.intersection(*usable):
        warnings.append("The image folders have no common frame numbers: their images are numbered in order.")
        return slots
    # Equal numbers are one frame set, so that an image missing from one folder does not shift later ones.
    union = sorted(set.union(*usable))
    slot_of_number = {number: k for k, number in enumerate(union)}  # numbers may exceed the integers of arrays
    for c, values in numbers.items():
        missing = sorted(set(union) - set(values or ()))
        if missing:
            warnings.append(
                f"{sources[c].camera}: {len(missing)} images are missing that other cameras have, "
                f"the first is number {missing[0]} (frame sets are matched by number)."
            )
        slots[c] = np.array([slot_of_number[number] for number in values or ()], dtype=np.int64)
    return slots
