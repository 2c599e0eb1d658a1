"""Which frame each camera shows at each instant, and when that is."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sylpose.capture.names import belongs_to
from sylpose.capture.sources import Source
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.input_limits import MAX_TABLE, text_of, told

__all__ = ["Timeline", "build_timeline", "load_timestamps"]


@dataclass(frozen=True, eq=False)
class Timeline:
    """The instants of a session, for n instants and C cameras in the rig's order.

    Attributes:
        frames: (n, C) number of the frame that a camera shows at an instant, counted from 0; -1 for none.
        times: (n,) seconds; the instants' numbers when there are neither time stamps nor a frame rate.
        stamps: (n, C) each camera's own time stamp, seconds; NaN for none.
        rate: instants per second on average, or None.
        offsets: by camera, the frames by which it starts late, as they were given.
    """

    frames: IntArray
    times: FloatArray
    stamps: FloatArray
    rate: float | None
    offsets: Mapping[str, int] = field(default_factory=dict)


def load_timestamps(path: Path, cameras: Sequence[str], without: Sequence[str] = ()) -> FloatArray:
    """Read time stamps: CSV with columns `frame`, counted from 0, and one per camera, in seconds; empty for no frame.

    Args:
        without: cameras that may have a column or not; instants that they alone have are left out.

    Returns:
        (n, C) in the order of `cameras`; NaN where a camera has no frame.

    Raises:
        ValueError: naming file and line: other columns, no numbers, times that do not increase, a row without times.
    """
    text = text_of(path, MAX_TABLE)
    with told(path):
        try:
            return _stamps_in(text, cameras, path)
        except ValueError:
            if not without:
                raise
        stamps = _stamps_in(text, [*cameras, *without], path)[:, : len(cameras)]
        return np.asarray(stamps[np.isfinite(stamps).any(axis=1)])


def _stamps_in(text: str, cameras: Sequence[str], path: Path) -> FloatArray:
    try:
        reader = csv.reader(io.StringIO(text, newline=""))
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise ValueError(f"cannot be read as CSV ({error})") from None
    header = [name.strip() for name in rows[0][1]] if rows else []
    if header[:1] != ["frame"] or len(header) > len(cameras) + 100:
        raise ValueError(f"{path}: line 1: the columns frame, {', '.join(cameras)} are expected")
    matched = belongs_to(header[1:], cameras, f"{path}: line 1")
    if len(set(header)) < len(header) or set(matched.values()) != set(cameras):
        raise ValueError(f"{path}: line 1: one column for each of {', '.join(cameras)} is expected")
    order = [list(cameras).index(matched[name]) for name in header[1:]]
    if not rows[1:]:
        raise ValueError(f"{path}: no time stamps in this file")

    stamps = np.full((len(rows) - 1, len(cameras)), np.nan)
    last, last_mean = np.full(len(cameras), -np.inf), -np.inf
    for i, (line, row) in enumerate(rows[1:]):
        where = f"{path}: line {line}"
        stamps[i, order] = _numbers(row, i, len(header), where)
        shown = np.isfinite(stamps[i])
        if not shown.any():
            raise ValueError(f"{where}: no camera has a time stamp")
        # The mean is the instant's time: it can run back where the cameras' clocks differ and one of them is out.
        mean = stamps[i, shown].mean()
        if (stamps[i, shown] <= last[shown]).any() or mean <= last_mean:
            raise ValueError(f"{where}: the time stamps must increase from row to row")
        last[shown], last_mean = stamps[i, shown], mean
    return stamps


def build_timeline(
    sources: tuple[Source, ...],
    stamps: FloatArray | None = None,
    offsets: Mapping[str, int] | None = None,
    rate: float | None = None,
) -> tuple[Timeline, list[str]]:
    """The timeline of a session, and what looks wrong with it.

    With time stamps, instants are their rows, and a camera's next frame is at its next row that is not empty. Otherwise
    a camera's frame k is at instant k + offset; image folders whose numbers have some in common are aligned by them.

    Args:
        stamps: (n, C) of `load_timestamps`.
        offsets: frames by camera; positive for a camera that starts late.
        rate: frames per second of folders of images, which do not say it.

    Raises:
        ValueError: a rate that is no positive number, or of what says its own: videos, time stamps.
        ValueError: an unknown camera or a value in `offsets` that is no whole number, or more than there are frames; both
            offsets and time stamps; no frame left.
    """
    warnings: list[str] = []
    if rate is not None:
        if not (np.isfinite(rate) and rate > 0):
            raise ValueError(f"rate: frames per second, a positive number, are expected, got {rate}")
        if stamps is not None or any(source.kind == "video" for source in sources):
            its = "timestamps.csv says" if stamps is not None else "videos say themselves"
            raise ValueError(f"rate: is for folders of images without time stamps; {its} when frames were taken")
    if stamps is not None:
        if offsets:
            raise ValueError("offsets cannot be combined with time stamps, which already say when each frame was taken")
        frames = _by_stamps(sources, stamps, warnings)
    else:
        frames = _by_count(sources, offsets or {}, warnings)
    used = np.flatnonzero((frames >= 0).any(axis=1))
    if not len(used):
        raise ValueError("no camera has a frame at any instant: the offsets leave none")
    frames = frames[: used[-1] + 1]
    if stamps is not None:
        stamps = stamps[: len(frames)]
        times = np.nanmean(stamps, axis=1)
        its_rate = float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 else None
    else:
        stamps = np.full(frames.shape, np.nan)
        rates = {source.camera: source.rate for source in sources if source.rate}
        its_rate = next(iter(rates.values()), rate)
        if rates and max(rates.values()) > 1.01 * min(rates.values()):
            listed = ", ".join(f"{camera} {value:.6g}" for camera, value in rates.items())
            warnings.append(
                f"The videos' frame rates differ ({listed}); {its_rate:.6g} per second is used for the times."
            )
        times = np.arange(len(frames)) / (its_rate or 1.0)
    return Timeline(frames, times, stamps, its_rate, dict(offsets or {})), warnings


def _numbers(row: list[str], frame: int, columns: int, where: str) -> FloatArray:
    if len(row) != columns:
        raise ValueError(f"{where}: {columns} columns are expected, got {len(row)}")
    if row[0].strip() != str(frame):
        raise ValueError(f"{where}: frame {frame} is expected, got {row[0]!r}")
    try:
        numbers = np.array([float(cell) if cell.strip() else np.nan for cell in row[1:]])
    except ValueError:
        raise ValueError(f"{where}: time stamps in seconds are expected, got {', '.join(row[1:])}") from None
    if any(cell.strip() and not np.isfinite(n) for cell, n in zip(row[1:], numbers, strict=True)):
        raise ValueError(f"{where}: time stamps must be finite, got {', '.join(row[1:])}")
    return numbers


def _by_stamps(sources: tuple[Source, ...], stamps: FloatArray, warnings: list[str]) -> IntArray:
    frames = np.full(stamps.shape, -1, dtype=np.int64)
    for c, source in enumerate(sources):
        rows = np.flatnonzero(np.isfinite(stamps[:, c]))
        if len(rows) != source.n_frames:
            warnings.append(f"{source.camera} has {len(rows)} time stamps and {source.n_frames} frames.")
        n = min(len(rows), source.n_frames)
        frames[rows[:n], c] = np.arange(n)
    return frames


def _by_count(sources: tuple[Source, ...], offsets: Mapping[str, int], warnings: list[str]) -> IntArray:
    names = [source.camera for source in sources]
    for camera, offset in offsets.items():
        if camera not in names:
            raise ValueError(f"offsets: {camera} is no camera of the calibration ({', '.join(names)})")
        if not isinstance(offset, int | np.integer):
            raise ValueError(f"offsets: the offset of {camera} must be a whole number of frames, got {offset!r}")
        longest = max(source.n_frames for source in sources)
        if abs(offset) > longest:
            raise ValueError(
                f"offsets: the offset of {camera}, {offset}, is more than the {longest} frames that there are"
            )
        if offset < 0:
            warnings.append(f"{camera}: its first {-offset} frames lie before instant 0 and are not used.")
    if len({source.n_frames for source in sources}) > 1:
        counts = ", ".join(f"{source.camera} {source.n_frames}" for source in sources)
        warnings.append(f"The cameras have different numbers of frames: {counts}.")
    slots = _slots(sources, warnings)
    instants = [slot + int(offsets.get(name, 0)) for slot, name in zip(slots, names, strict=True)]
    n = max(0, *(int(i[-1]) + 1 for i in instants))
    frames = np.full((n, len(sources)), -1, dtype=np.int64)
    for c, i in enumerate(instants):
        frames[i[i >= 0], c] = np.flatnonzero(i >= 0)
    return frames


def _slots(sources: tuple[Source, ...], warnings: list[str]) -> list[IntArray]:
    """The place of each frame of each camera in a common count, before offsets."""
    slots = [np.arange(source.n_frames) for source in sources]
    numbers = {c: source.numbers for c, source in enumerate(sources) if source.kind == "images"}
    usable = [set(values) for values in numbers.values() if values is not None]
    if len(numbers) < 2 or not usable:
        return slots
    if len(usable) < len(numbers) or not set.intersection(*usable):
        warnings.append("The image folders have no frame numbers in common: their images are counted in order.")
        return slots
    # Equal numbers are one instant, so that an image missing from one folder does not shift those after it.
    union = sorted(set.union(*usable))
    place = {number: k for k, number in enumerate(union)}  # numbers may have more digits than integers of arrays
    for c, values in numbers.items():
        missing = sorted(set(union) - set(values or ()))
        if missing:
            warnings.append(
                f"{sources[c].camera}: {len(missing)} images that other cameras have are missing, "
                f"the first is number {missing[0]} (equal numbers are one instant)."
            )
        slots[c] = np.array([place[number] for number in values or ()], dtype=np.int64)
    return slots
