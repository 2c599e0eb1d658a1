"""One camera's frames for a node, numbered alike at all cameras: of a recording that is played, or of a live camera."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from statistics import fmean

from sylpose.capture.frame_assembly import StreamClock
from sylpose.capture.frame_readers import CameraReader
from sylpose.capture.sources import Source
from sylpose.capture.streams import Device, open_device
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import Image
from sylpose.network.frame_announcement import NO_FRAME, WAITS
from sylpose.rig import Camera

__all__ = ["Live", "Played"]

# Frames of a live camera that are kept until all agree on which one is next; seconds to wait for one (choice).
KEPT, LONGEST = 16, 0.3
# Frames per second of a recording that does not say (choice: then its times are numbers of frames).
NO_RATE = 1.0


def _instant(
    camera: int, number: int, times: Sequence[float | None], otherwise: float, image: Image | None
) -> FrameSet:
    known = [t for t in times if t is not None]
    # Of equal times the mean may be another number, by rounding.
    when = otherwise if not known else known[0] if len(set(known)) == 1 else fmean(known)
    images = tuple(image if c == camera else None for c in range(len(times)))
    return FrameSet(number, when, tuple(times), images, (None,) * len(times))


class Played:
    """A recording, played at its speed, or as fast as it is asked for: no frame is left out.

    Args:
        camera: its number.
        rate: frames per second; None: as the recording says.
        speed: how many times as fast; 0: as fast as it is asked for.
    """

    def __init__(self, camera: int, source: Source, rate: float | None = None, speed: float = 1.0) -> None:
        self._camera, self._source, self._speed = camera, source, speed
        self._rate = rate or source.rate or NO_RATE
        self._paced = speed if rate or source.rate else 0.0
        self._reader = CameraReader(source, {})
        self._begun: float | None = None  # when frame 0 was, or would have been
        self._last = 0  # that was asked for

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """See `Shots`."""
        if wanted >= self._source.n_frames:
            return NO_FRAME, None
        if self._paced:
            since = wanted / (self._rate * self._paced)
            if self._begun is None or wanted not in (self._last, self._last + 1):  # it was taken in somewhere else
                self._begun = time.monotonic() - since
            self._last = wanted
            time.sleep(max(self._begun + since - time.monotonic(), 0.0))
        return wanted, self.time_of(wanted)

    def time_of(self, number: int) -> float | None:
        """See `Shots`."""
        return number / self._rate

    def frame_set(self, number: int, times: Sequence[float | None]) -> FrameSet:
        """See `Shots`."""
        image = self._reader.read(number).image if number < self._source.n_frames else None
        return _instant(self._camera, number, times, number / self._rate, image)

    def close(self) -> None:
        """Close the recording."""
        self._reader.close()


class Live:
    """A camera or a stream: frames are numbered by the clock, which all nodes have to have alike.

    Args:
        camera: its number, and what it is.
        source: its number or path, or its URL. rate: of all cameras, frames per second.
        opener: of the device.

    Raises:
        OSError: it cannot be opened.
    """

    def __init__(
        self,
        camera: int,
        of: Camera,
        source: int | str,
        rate: float,
        opener: Callable[[int | str, tuple[int, int], float | None], Device] = open_device,
    ) -> None:
        self._camera, self._rate, self._size, self._what = camera, rate, of.size, str(source)
        self._device = opener(source, of.size, rate)
        self._shots: OrderedDict[int, tuple[float, Image]] = OrderedDict()
        self._news = threading.Condition()
        self._ended, self._error, self._silent = False, "", False
        self._reader = threading.Thread(target=self._run, daemon=True)
        self._reader.start()

    def _run(self) -> None:
        try:
            self._read()
        except Exception as error:
            self._error = f"{self._what}: {error}"
        finally:
            self._device.close()
            with self._news:
                self._ended = True
                self._news.notify()

    def _read(self) -> None:
        clock = StreamClock()
        while not self._ended:
            grab = self._device.read()
            if grab is None:
                break
            if grab.size != self._size:
                self._error = f"{self._what}: images of {grab.size[0]}x{grab.size[1]}, calibrated are {self._size}"
                break
            taken = clock.host_time(grab.pts, time.time())
            if taken is None:
                continue
            with self._news:
                self._shots[round(taken * self._rate)] = taken, grab.pixels()
                while len(self._shots) > KEPT:
                    self._shots.popitem(last=False)
                self._news.notify()

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """See `Shots`.

        Raises:
            ValueError: the camera gave images of another size, or broke.
        """
        with self._news:
            # The others wait, too: not long for one that gives nothing for some time.
            longest = 1.0 / self._rate if self._silent else LONGEST
            self._news.wait_for(lambda: self._ended or max(self._shots, default=-1) >= wanted, longest)
            newest = max(self._shots, default=-1)
            self._silent = newest < wanted
            if newest >= wanted:
                return newest, self._shots[newest][0]
            if self._error:
                raise ValueError(self._error)
            return (NO_FRAME if self._ended else WAITS), None

    def time_of(self, number: int) -> float | None:
        """See `Shots`."""
        with self._news:
            return self._shots[number][0] if number in self._shots else None

    def frame_set(self, number: int, times: Sequence[float | None]) -> FrameSet:
        """See `Shots`."""
        with self._news:
            image = self._shots[number][1] if number in self._shots else None
        return _instant(self._camera, number, times, number / self._rate, image)

    def close(self) -> None:
        """Close the camera, once it has given what it is giving."""
        self._ended = True
        self._reader.join(LONGEST)
