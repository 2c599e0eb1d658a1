"""Timeline of a session: frame of each camera and time of each frame set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.io.capture.alignment import MAX_RATE_RATIO, align, read_clocks, read_name_clocks
from sylpose.io.capture.names import MIN_COMMON_NUMBERS
from sylpose.io.capture.sources import Source
from sylpose.io.capture.time_tables import TimeTable


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


def build_timeline(
    sources: tuple[Source, ...],
    table: TimeTable | None = None,
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
        table: time stamps in a file; None without.
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
        if table is not None or any(source.kind == "video" for source in sources):
            origin = table.origin if table is not None else "the videos"
            raise ValueError(f"rate: only for image folders without timestamps; here the times come from {origin}")
    if table is not None and offsets:
        raise ValueError(
            f"offsets cannot be combined with {table.origin}, which already contains the time of each frame"
        )
    if table is not None and table.warning:
        warnings.append(table.warning)
    stamps = None if table is None else table.stamps
    if stamps is not None:
        frames = _assign_by_timestamps(sources, stamps, warnings)
    elif (clocks := _find_clocks(sources, table, offsets, rate, warnings)) is not None:
        frames, times, stamps = align(sources, clocks.stamps, warnings)
        frame_rate = (len(times) - 1) / float(times[-1]) if len(times) > 1 else None
        return Timeline(frames, times, stamps, frame_rate, dict(offsets or {}), clocks.origin), warnings
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
    origin = "" if table is None else table.origin
    return Timeline(frames, times, stamps, frame_rate, dict(offsets or {}), origin), warnings


class _Clocks(NamedTuple):
    """Times of each camera's frames, seconds since frame set 0, and where they are from."""

    stamps: Sequence[FloatArray]
    origin: str


def _find_clocks(
    sources: tuple[Source, ...],
    table: TimeTable | None,
    offsets: Mapping[str, int] | None,
    rate: float | None,
    warnings: list[str],
) -> _Clocks | None:
    """Find when each camera's frames were taken; None if they are numbered."""
    given = _check_offsets(sources, offsets or {}, warnings)
    if table is not None and table.clocks is not None:
        return _Clocks(_fit_clocks(sources, table.clocks, warnings), table.origin)
    if rate is None and not given and (names := read_name_clocks(sources)) is not None:
        return _Clocks(names, "the images' names")
    videos = read_clocks(sources, given, warnings)
    return None if videos is None else _Clocks(videos, "the videos' time stamps")


def _fit_clocks(sources: Sequence[Source], clocks: Sequence[FloatArray], warnings: list[str]) -> list[FloatArray]:
    """Return clocks that begin where the last camera starts, with a time for each frame of a camera at most."""
    for source, clock in zip(sources, clocks, strict=True):
        if len(clock) != source.n_frames:
            warnings.append(f"{source.camera} has {len(clock)} timestamps and {source.n_frames} frames.")
    begin = max(float(clock[0]) for clock in clocks)
    return [clock[: source.n_frames] - begin for source, clock in zip(sources, clocks, strict=True)]


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
    # Some numbers may be equal by chance, and the first ones of clocks that were started together are.
    if len(usable) < len(numbers) or len(set.intersection(*usable)) < MIN_COMMON_NUMBERS * min(map(len, usable)):
        warnings.append("The image folders have few common frame numbers: their images are numbered in order.")
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
