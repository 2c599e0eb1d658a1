"""Assembly of asynchronous frames into frame sets on a common clock."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

from sylpose.geometry.arrays import Image

# Largest number of pending frames per camera.
MAX_PENDING = 64
# Consecutive frame sets without a camera after which it is not waited for until its next frame (choice).
MAX_MISSED_SETS = 3
# Frames over which the interval and delay of a stream are measured (choice: two seconds, shorter than clocks drift).
CLOCK_WINDOW = 64
# Frame rate assumed before it is given or measured (choice: the usual one).
ASSUMED_RATE = 30.0
# A larger jump of a stream's clock, in seconds, means that the clock was reset (choice: longer than any queue).
MAX_CLOCK_JUMP_S = 2.0
# Seconds between reports of the counts: initially, and at most.
MIN_REPORT_INTERVAL, MAX_REPORT_INTERVAL = 5.0, 300.0
# Polling interval for pending frame sets and for the stop request, seconds.
POLL_INTERVAL = 0.02


@dataclass(frozen=True, eq=False)
class Grab:
    """A frame as delivered by a device.

    Attributes:
        size: (width, height), pixels.
        pixels: returns the image (h, w, 3), BGR.
        pts: presentation timestamp on the device's clock, seconds; None without one.
    """

    size: tuple[int, int]
    pixels: Callable[[], Image]
    pts: float | None = None


@dataclass(frozen=True, eq=False)
class TimedFrame:
    """A frame of one camera with its capture time on the host's monotonic clock, seconds."""

    time: float
    pixels: Callable[[], Image]


@dataclass(eq=False)
class DropCounter:
    """Dropped and missed frames by camera, reported at growing intervals.

    Attributes:
        dropped: received frames that are in no frame set.
        missed: frame sets without the camera.
        clock: monotonic time, seconds.
    """

    dropped: dict[str, int]
    missed: dict[str, int]
    clock: Callable[[], float] = time.monotonic
    _report_interval: float = MIN_REPORT_INTERVAL
    _reported: tuple[int, int] = (0, 0)
    _next_report: float = -np.inf

    def reset(self) -> None:
        """Reset all counts and the reporting interval."""
        for counts in (self.dropped, self.missed):
            counts.update(dict.fromkeys(counts, 0))
        self._reported, self._next_report, self._report_interval = (0, 0), -np.inf, MIN_REPORT_INTERVAL

    def report_if_due(self) -> str | None:
        """Return a report if the counts have changed and the last report is old enough, else None.

        The interval doubles after each report.
        """
        now = (sum(self.dropped.values()), sum(self.missed.values()))
        if now == self._reported or self.clock() < self._next_report:
            return None
        self._reported, self._next_report = now, self.clock() + self._report_interval
        self._report_interval = min(2 * self._report_interval, MAX_REPORT_INTERVAL)
        return f"Left out so far: {self._describe()}."

    def final_report(self) -> str | None:
        """Return the final report, or None if nothing was left out."""
        left_out = any(self.dropped.values()) or any(self.missed.values())
        return f"Left out in total: {self._describe()}." if left_out else None

    def _describe(self) -> str:
        dropped = ", ".join(f"{n} of {camera}" for camera, n in self.dropped.items() if n)
        missed = ", ".join(f"{n} without {camera}" for camera, n in self.missed.items() if n)
        parts = [f"frames dropped as too late or without a partner: {dropped}"] if dropped else []
        return "; ".join([*parts, f"frame sets without a delayed frame: {missed}"] if missed else parts)


class StreamClock:
    """Conversion of a stream's timestamps to the host's clock.

    Transport only delays a frame, so the smallest recent difference of arrival and timestamp estimates the offset of
    the two clocks; the rest is jitter. A constant delay is not observable.
    """

    def __init__(self) -> None:
        self._last: float | None = None
        self._offsets: deque[float] = deque(maxlen=CLOCK_WINDOW)
        self._intervals: deque[float] = deque(maxlen=CLOCK_WINDOW)

    def to_host_time(self, pts: float | None, arrival: float) -> float | None:
        """Return the capture time of a frame on the host's clock, or None for a repeated frame.

        The time never exceeds the arrival and increases from frame to frame.
        """
        stamp = arrival if pts is None else pts
        if stamp == self._last:
            return None
        if self._last is not None and abs(stamp - self._last) < MAX_CLOCK_JUMP_S and stamp > self._last:
            self._intervals.append(stamp - self._last)
        else:
            self._offsets.clear()
        self._last = stamp
        self._offsets.append(arrival - stamp)
        return stamp + min(self._offsets)

    @property
    def interval(self) -> float | None:
        """Median interval between frames, seconds; None until it can be measured."""
        return median(self._intervals) if len(self._intervals) >= 8 else None


class FrameAssembler:
    """Groups asynchronous frames into frame sets; all times on one clock, cameras by number.

    A set is anchored at the earliest pending frame and takes from each other camera the nearest frame within
    `tolerance` seconds (None: half of the shortest frame interval). It is returned as soon as every camera has a
    pending frame, at the latest `max_delay` after its anchor. Frames not requested within one more frame interval are
    dropped.
    """

    def __init__(
        self, counter: DropCounter, max_delay: float = 0.2, tolerance: float | None = None, rate: float | None = None
    ) -> None:
        self._counter, self._names = counter, list(counter.dropped)
        self._max_delay, self._tolerance, self._rate = max_delay, tolerance, rate
        n = len(self._names)
        self._clocks = [StreamClock() for _ in range(n)]
        self._pending: list[deque[TimedFrame]] = [deque() for _ in range(n)]
        self._missed_sets = [0] * n  # consecutive sets without the camera
        self._latest = -np.inf  # time of the last frame returned, or dropped as too late
        self._latest_mean_time = -np.inf  # time of the last set

    def add(self, c: int, grab: Grab, arrival: float) -> None:
        """Add a frame of camera c and drop its expired ones, whether or not sets are requested."""
        capture_time = self._clocks[c].to_host_time(grab.pts, arrival)
        if capture_time is None:
            return
        self._missed_sets[c] = 0
        self._pending[c].append(TimedFrame(capture_time, grab.pixels))
        self._drop_expired(c, arrival)
        if len(self._pending[c]) > MAX_PENDING:
            self._drop(c)

    def mark_unavailable(self, c: int) -> None:
        """Mark camera c as unavailable, so that it is not waited for."""
        self._missed_sets[c] = MAX_MISSED_SETS

    def has_pending(self, c: int) -> bool:
        """Return whether a frame of camera c is pending."""
        return bool(self._pending[c])

    def discard_backlog(self) -> None:
        """Discard all but the newest frame of each camera, which arrived before all cameras were ready."""
        self._counter.reset()
        for pending in self._pending:
            while len(pending) > 1:
                pending.popleft()

    @property
    def interval(self) -> float:
        """Frame interval of the fastest camera, seconds."""
        measured = [clock.interval for clock in self._clocks]
        nominal = 1.0 / (self._rate or ASSUMED_RATE)
        return min((i for i in measured if i is not None), default=nominal)

    def next_set(self, now: float) -> list[TimedFrame | None] | None:
        """Return the next set, one frame or None per camera; None if no set is final yet."""
        for c in range(len(self._names)):
            self._drop_expired(c, now)
        tolerance = self.interval / 2 if self._tolerance is None else self._tolerance
        for _ in range(len(self._names) * MAX_PENDING):
            heads = {c: pending[0] for c, pending in enumerate(self._pending) if pending}
            if not heads:
                return None
            anchor = min(shot.time for shot in heads.values())
            awaited = [c for c, missed_sets in enumerate(self._missed_sets) if missed_sets < MAX_MISSED_SETS]
            if now < anchor + self._max_delay and not heads.keys() >= set(awaited):
                return None
            chosen = {c: shot for c, shot in heads.items() if shot.time - anchor <= tolerance}
            # A frame without all of its partners, directly after a set: that time has been returned already. It is the
            # surplus of a camera that is faster than the others, or a frame that arrived too late for its set.
            surplus = anchor - self._latest <= tolerance and not chosen.keys() >= set(awaited)
            if surplus or anchor <= self._latest_mean_time:
                for c in chosen:
                    self._drop(c)
                continue
            return self._take_set(chosen)
        return None

    def _take_set(self, chosen: dict[int, TimedFrame]) -> list[TimedFrame | None]:
        for c, name in enumerate(self._names):
            if c in chosen:
                self._pending[c].popleft()
            else:
                self._missed_sets[c] += 1
                self._counter.missed[name] += 1
        times = [shot.time for shot in chosen.values()]
        self._latest, self._latest_mean_time = max(self._latest, *times), fmean(times)
        return [chosen.get(c) for c in range(len(self._names))]

    def _drop_expired(self, c: int, now: float) -> None:
        oldest_allowed = now - self._max_delay - max(self.interval, 2 * POLL_INTERVAL)
        while self._pending[c] and self._pending[c][0].time < oldest_allowed:
            # Its partners in other cameras, which may be just in time, no longer form a set.
            self._latest = max(self._latest, self._pending[c][0].time)
            self._drop(c)

    def _drop(self, c: int) -> None:
        self._pending[c].popleft()
        self._counter.dropped[self._names[c]] += 1
