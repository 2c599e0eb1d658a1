"""Time for a search during live tracking: no pose is more than two frame intervals late because of one.

Lateness is measured on the local clock, against the earliest frame so far. What does not fit is left to the
next frames. Recordings are tracked without a clock, so that their results do not depend on the machine's speed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# A search may delay a pose by so many frame intervals (derived: docs/live.md promises it).
MAX_LATE_INTERVALS = 2.0
# The clocks of cameras and of this computer drift apart by at most this share (derived: crystals are off by 100 ppm at most,
# in opposite directions).
MAX_DRIFT = 2e-4
# A search is not worth doing on fewer than this share of its pixels (choice).
MIN_SHARE = 0.25
# Where a search would make even a punctual frame late, its duration is forgotten at this rate per frame, as the machine
# may have been busy (choice: by a factor of e in two seconds).
FORGETTING = 1.0 - 1.0 / 64


class SearchClock:
    """Measures how long searches take, and whether one still fits before a frame is late.

    Args:
        clock: monotonic time, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seconds: dict[str, float] = {}
        self._time = 0.0
        self._least_delay = self._allowance = self._deadline = math.inf

    def begin_frame(self, frame_time: float, interval: float) -> None:
        """Begin the next frame.

        Args:
            frame_time: of its images, seconds.
            interval: between the cameras' frames, seconds; NaN: unknown, so that searches are not limited.
        """
        drift, self._time = MAX_DRIFT * abs(frame_time - self._time), frame_time
        self._least_delay = min(self._least_delay + drift, self._clock() - frame_time)
        self._allowance = math.inf if math.isnan(interval) else MAX_LATE_INTERVALS * interval
        self._deadline = frame_time + self._least_delay + self._allowance

    def share(self, kind: str, min_share: float = MIN_SHARE) -> float:
        """Return the share of a search's pixels for which there is time: 0, or `min_share` to 1.

        Args:
            kind: of the search; each has its own duration.
            min_share: smallest share worth searching; 1 for a search that cannot be shortened.
        """
        if math.isinf(self._allowance):
            return 1.0
        # Unmeasured, half of the time is assumed to be enough: else it would never be tried.
        seconds = self._seconds.get(kind, 0.5 * self._allowance)
        if min_share * seconds > self._allowance:
            self._seconds[kind] = FORGETTING * seconds
        share = (self._deadline - self._clock()) / seconds
        return 0.0 if share < min_share else min(share, 1.0)

    @contextmanager
    def measure(self, kind: str, share: float) -> Iterator[None]:
        """Measure a search on this share of its pixels."""
        begin = self._clock()
        yield
        self._seconds[kind] = max((self._clock() - begin) / share, 1e-9)
