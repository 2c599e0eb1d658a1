"""Frames that come whenever they come: their times on one clock, put together into sets, and what is left out."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

from sylpose.geometry.arrays import Image

__all__ = ["Assembler", "Grab", "Shot", "StreamClock", "Tally"]


# Of one camera, waiting to be put into a set.
MAX_PENDING = 64
# A camera that was left out of so many sets in a row is not waited for until it gives a frame again (choice).
PATIENCE = 3
# Frames from which the interval and the delay of a stream are measured (choice: two seconds, shorter than clocks drift).
WINDOW = 64
# Frames per second of a camera before it can be measured, where nobody says it (choice: the usual one).
ASSUMED_RATE = 30.0
# A stream's clock that jumps by more than this, in seconds, has been set anew (choice: longer than any queue).
CLOCK_JUMP = 2.0
# Seconds until counts are said again: at first, and at last.
FIRST_PAUSE, LAST_PAUSE = 5.0, 300.0
# Seconds between two looks at whether a set is due, or the session was stopped.
TICK = 0.02


@dataclass(frozen=True, eq=False)
class Grab:
    """A frame as a device gives it: size (width, height), how to get its pixels (BGR), its own clock's seconds if any."""

    size: tuple[int, int]
    pixels: Callable[[], Image]
    pts: float | None = None


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame of one camera and when it was taken, on the host's monotonic clock in seconds."""

    time: float
    pixels: Callable[[], Image]


@dataclass(eq=False)
class Tally:
    """What was left out, by camera, and said in sentences at growing intervals.

    Attributes:
        dropped: frames that came and are in no frame set.
        missed: frame sets that were given without the camera.
    """

    dropped: dict[str, int]
    missed: dict[str, int]
    clock: Callable[[], float] = time.monotonic
    _pause: float = FIRST_PAUSE
    _told: tuple[int, int] = (0, 0)
    _next: float = -np.inf

    def reset(self) -> None:
        """Start anew."""
        for counts in (self.dropped, self.missed):
            counts.update(dict.fromkeys(counts, 0))
        self._told, self._next, self._pause = (0, 0), -np.inf, FIRST_PAUSE

    def news(self) -> str | None:
        """A sentence, if anything was left out since the last one and that is long enough ago; ever less often."""
        now = (sum(self.dropped.values()), sum(self.missed.values()))
        if now == self._told or self.clock() < self._next:
            return None
        self._told, self._next = now, self.clock() + self._pause
        self._pause = min(2 * self._pause, LAST_PAUSE)
        return f"Left out up to now: {self._words()}."

    def total(self) -> str | None:
        """The sentence for the end, or None when nothing was left out."""
        left_out = any(self.dropped.values()) or any(self.missed.values())
        return f"Left out in all: {self._words()}." if left_out else None

    def _words(self) -> str:
        dropped = ", ".join(f"{n} of {camera}" for camera, n in self.dropped.items() if n)
        missed = ", ".join(f"{n} without {camera}" for camera, n in self.missed.items() if n)
        said = [f"frames that nobody had time for or that had no partner: {dropped}"] if dropped else []
        return "; ".join([*said, f"frame sets that went on without a late frame: {missed}"] if missed else said)


class StreamClock:
    """A stream's own time stamps on the host's clock.

    What lies between a frame and its arrival only adds to its time: the smallest difference seen lately is the best
    guess of the two clocks' offset, and the rest is jitter. A constant delay cannot be told from it.
    """

    def __init__(self) -> None:
        self._last: float | None = None
        self._offsets: deque[float] = deque(maxlen=WINDOW)
        self._intervals: deque[float] = deque(maxlen=WINDOW)

    def host_time(self, pts: float | None, arrival: float) -> float | None:
        """When a frame was taken (never after its arrival, later than the one before); None for a frame given twice."""
        stamp = arrival if pts is None else pts
        if stamp == self._last:
            return None
        if self._last is not None and abs(stamp - self._last) < CLOCK_JUMP and stamp > self._last:
            self._intervals.append(stamp - self._last)
        else:
            self._offsets.clear()
        self._last = stamp
        self._offsets.append(arrival - stamp)
        return stamp + min(self._offsets)

    @property
    def interval(self) -> float | None:
        """Seconds between frames, once it can be measured."""
        return median(self._intervals) if len(self._intervals) >= 8 else None


class Assembler:
    """Frame sets from frames that come whenever they come; all times on one clock, cameras by number.

    A set is anchored at the earliest frame that waits; of each other camera it takes the nearest within `tolerance`
    seconds (None: half of the shortest frame interval). It is given as soon as every camera has a frame that waits, and
    at the latest `max_delay` after its anchor; what nobody has asked for a frame's interval later is dropped.
    """

    def __init__(
        self, tally: Tally, max_delay: float = 0.2, tolerance: float | None = None, rate: float | None = None
    ) -> None:
        self._tally, self._names = tally, list(tally.dropped)
        self._max_delay, self._tolerance, self._rate = max_delay, tolerance, rate
        n = len(self._names)
        self._clocks = [StreamClock() for _ in range(n)]
        self._pending: list[deque[Shot]] = [deque() for _ in range(n)]
        self._away = [0] * n  # sets in a row without the camera
        self._latest = -np.inf  # time of the last frame that was given, or dropped for being late
        self._mean = -np.inf  # time of the last set

    def add(self, c: int, grab: Grab, arrival: float) -> None:
        """A frame of camera c. What has waited for too long meanwhile is dropped, whether or not anyone asks for sets."""
        taken = self._clocks[c].host_time(grab.pts, arrival)
        if taken is None:
            return
        self._away[c] = 0
        self._pending[c].append(Shot(taken, grab.pixels))
        self._drop_late(c, arrival)
        if len(self._pending[c]) > MAX_PENDING:
            self._drop(c)

    def gone(self, c: int) -> None:
        """Camera c will not give anything for now: it is not waited for."""
        self._away[c] = PATIENCE

    def seen(self, c: int) -> bool:
        """Whether a frame of camera c waits."""
        return bool(self._pending[c])

    def begin(self) -> None:
        """Forget all but the newest frame of each camera: the others came before all cameras were there."""
        self._tally.reset()
        for pending in self._pending:
            while len(pending) > 1:
                pending.popleft()

    @property
    def interval(self) -> float:
        """Seconds between the frames of the fastest camera."""
        measured = [clock.interval for clock in self._clocks]
        nominal = 1.0 / (self._rate or ASSUMED_RATE)
        return min((i for i in measured if i is not None), default=nominal)

    def pick(self, now: float) -> list[Shot | None] | None:
        """The next set, one frame or None per camera; None when it is too early to say."""
        for c in range(len(self._names)):
            self._drop_late(c, now)
        tolerance = self.interval / 2 if self._tolerance is None else self._tolerance
        for _ in range(len(self._names) * MAX_PENDING):
            heads = {c: pending[0] for c, pending in enumerate(self._pending) if pending}
            if not heads:
                return None
            anchor = min(shot.time for shot in heads.values())
            awaited = [c for c, away in enumerate(self._away) if away < PATIENCE]
            if now < anchor + self._max_delay and not heads.keys() >= set(awaited):
                return None
            chosen = {c: shot for c, shot in heads.items() if shot.time - anchor <= tolerance}
            # A frame without all of its partners, right after a set: its instant has been given already. It is what a
            # camera has too many of that is faster than the others, or a frame that came too late for its set.
            surplus = anchor - self._latest <= tolerance and not chosen.keys() >= set(awaited)
            if surplus or anchor <= self._mean:
                for c in chosen:
                    self._drop(c)
                continue
            return self._give(chosen)
        return None

    def _give(self, chosen: dict[int, Shot]) -> list[Shot | None]:
        for c, name in enumerate(self._names):
            if c in chosen:
                self._pending[c].popleft()
            else:
                self._away[c] += 1
                self._tally.missed[name] += 1
        times = [shot.time for shot in chosen.values()]
        self._latest, self._mean = max(self._latest, *times), fmean(times)
        return [chosen.get(c) for c in range(len(self._names))]

    def _drop_late(self, c: int, now: float) -> None:
        late = now - self._max_delay - max(self.interval, 2 * TICK)
        while self._pending[c] and self._pending[c][0].time < late:
            # Its partners in other cameras, which may be just in time, make no set any more.
            self._latest = max(self._latest, self._pending[c][0].time)
            self._drop(c)

    def _drop(self, c: int) -> None:
        self._pending[c].popleft()
        self._tally.dropped[self._names[c]] += 1
