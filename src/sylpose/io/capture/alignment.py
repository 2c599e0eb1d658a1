"""Alignment of videos by the time stamps of their frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.io.capture.sources import Source
from sylpose.io.capture.time_tables import EPOCH

# Frame rates that differ by less than this factor are one (choice: 29.97 and 30, which recorders confuse).
MAX_RATE_RATIO = 1.01
# Time stamps are as precise as this, seconds (derived: the unit of Matroska and of names in milliseconds).
RESOLUTION = 1e-3
# Units of time stamps in the names of images, seconds.
NAME_UNITS = (1e-3, 1e-6, 1e-9)
# Clocks are one if this share of the shortest recording's time is common to all cameras (choice).
MIN_OVERLAP = 0.5


def read_clocks(sources: Sequence[Source], offsets: Mapping[str, int], warnings: list[str]) -> list[FloatArray] | None:
    """Return when each camera's frames were taken by the files' time stamps.

    Args:
        sources: one per camera.
        offsets: given frame offsets by camera, which replace the differences of the first time stamps.
        warnings: messages are appended.

    Returns:
        per camera its times, seconds since frame set 0, which is where the last camera starts; None if a file has no
        time stamps, or if all are at one constant rate and start together: then they are nominal.
    """
    clocks = [source.stamps for source in sources]
    known = [clock for clock in clocks if clock is not None]
    if len(known) < len(sources):
        return None
    intervals = [_measure_interval(clock) for clock in known]
    interval = min(intervals)
    if not np.isfinite(interval):
        return None
    if offsets:
        starts = [offsets.get(source.camera, 0) * interval for source in sources]
        known = [clock - clock[0] + start for clock, start in zip(known, starts, strict=True)]
    elif not _do_overlap(known):
        warnings.append("The videos' time stamps have no time in common; their first frames are taken as simultaneous.")
        known = [clock - clock[0] for clock in known]
    begin = 0.0 if offsets else max(float(clock[0]) for clock in known)
    is_together = bool(offsets) or begin - min(float(clock[0]) for clock in known) < interval / 2
    if is_together and max(intervals) <= MAX_RATE_RATIO * interval and all(map(_is_uniform, known)):
        return None
    return [clock - begin for clock in known]


def read_name_clocks(sources: Sequence[Source]) -> list[FloatArray] | None:
    """Return when each camera's images were taken if the numbers in their names are time stamps.

    Returns:
        per camera its times, seconds since the last camera's first image; None for other numbers, and for videos.
    """
    known = [source.numbers for source in sources if source.numbers is not None and len(source.numbers) > 1]
    if len(known) < len(sources):
        return None
    units = [
        unit for unit in NAME_UNITS if all(EPOCH[0] <= its[0] * unit and its[-1] * unit <= EPOCH[1] for its in known)
    ]
    if not units:
        return None
    # Differences first: nanoseconds since 1970 have more digits than floating-point numbers.
    begin = max(its[0] for its in known)
    return [np.array([number - begin for number in its], float) * units[0] for its in known]


def align(
    sources: Sequence[Source], clocks: Sequence[FloatArray], warnings: list[str]
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Form frame sets by time.

    They are at the times of a camera with most frames per second, of several cameras the second fastest: what one camera
    alone shows in between is not used. Another camera's frame belongs to the nearest of them, unless it is farther away
    than half an interval: where that camera has lost frames, a set is added.

    Args:
        sources: C cameras.
        clocks: of `read_clocks`; earlier frames than 0 are not used.
        warnings: messages are appended.

    Returns:
        (n, C) frame number of each camera in each frame set, -1 for none; (n,) times and (n, C) stamps, NaN for none,
        seconds since the first frame set.
    """
    intervals = [_measure_interval(clock) for clock in clocks]
    interval = sorted(intervals)[min(1, len(intervals) - 1)]
    interval = interval if np.isfinite(interval) else min(intervals)
    reach = MAX_RATE_RATIO * interval / 2
    fastest = [
        c for c, own in enumerate(intervals) if interval <= own * MAX_RATE_RATIO and own <= interval * MAX_RATE_RATIO
    ]
    times = clocks[max(fastest, key=lambda c: len(clocks[c]))]
    for clock in clocks:
        times = np.union1d(times, clock[np.abs(clock - times[_find_nearest(times, clock)]) > reach])
    shape = len(times), len(clocks)
    frames, stamps = np.full(shape, -1, np.int64), np.full(shape, np.nan)
    for c, (source, clock) in enumerate(zip(sources, clocks, strict=True)):
        nearest = _find_nearest(times, clock)
        distances = np.abs(clock - times[nearest])
        order = np.lexsort((distances, nearest))
        taken = order[np.unique(nearest[order], return_index=True)[1]]  # of several frames the nearest one
        frames[nearest[taken], c], stamps[nearest[taken], c] = taken, clock[taken]
        if len(taken) < len(clock):
            text = f"{source.camera}: {len(clock) - len(taken)} frames are not used"
            warnings.append(f"{text}: others of it are nearer in time to those of the other cameras.")
    begun = times >= -reach
    early = [f"{source.camera} {n}" for source, n in zip(sources, (frames[~begun] >= 0).sum(axis=0), strict=True) if n]
    if early:
        listed = ", ".join(early)
        warnings.append(
            f"The cameras start at different times; frames before the last one starts are not used: {listed}."
        )
    frames, stamps, times = frames[begun], stamps[begun], times[begun]
    # Stamps of one instant differ by their rounding.
    stamps = np.where(np.abs(stamps - times[:, None]) <= min(RESOLUTION, interval / 4), times[:, None], stamps)
    return frames, times - times[0], stamps - times[0]


def _measure_interval(clock: FloatArray) -> float:
    """Return the usual time between frames, seconds; infinity for a single one."""
    if len(clock) < 2:
        return np.inf
    return float(np.ptp(clock)) / (len(clock) - 1) if _is_uniform(clock) else float(np.median(np.diff(clock)))


def _is_uniform(clock: FloatArray) -> bool:
    """Return whether frames are at a constant rate, up to the rounding of their time stamps; not if one is missing."""
    if len(clock) < 3:
        return True
    tolerance = min(RESOLUTION, float(np.median(np.diff(clock))) / 4)
    return bool(np.abs(clock - np.linspace(clock[0], clock[-1], len(clock))).max() <= tolerance)


def _do_overlap(clocks: Sequence[FloatArray]) -> bool:
    """Return whether the cameras' time stamps can be of one clock."""
    common = min(clock[-1] for clock in clocks) - max(clock[0] for clock in clocks)
    return bool(common >= MIN_OVERLAP * min(np.ptp(clock) for clock in clocks))


def _find_nearest(times: FloatArray, stamps: FloatArray) -> IntArray:
    """Return the index (n,) of the nearest of increasing times (m,) to each stamp (n,)."""
    after = np.clip(np.searchsorted(times, stamps), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(stamps - times[before]) <= np.abs(times[after] - stamps), before, after)
