"""Cameras and network streams: a thread for each, and frame sets of the frames that are nearest in time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from statistics import fmean, median
from typing import Protocol

import av
import av.error
import cv2
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from sylpose.capture.session import FrameSet
from sylpose.rig import Camera

__all__ = ["Assembler", "Device", "Grab", "Opener", "Shot", "StreamClock", "Tally", "open_device", "read_streams"]

Image = NDArray[np.uint8]

# Seconds after which a stream that cannot be opened, or gives nothing, is taken for dead; also the longest wait for all
# cameras to give their first frame.
TIMEOUT = 5.0
# Pauses before a broken camera is tried again, seconds; it is given up after the last.
PAUSES = (0.5, 1.0, 2.0, 4.0, 8.0)
# A connection that lasted so long, in seconds, was a good one: pauses start anew after it.
STEADY = 10.0
# Nothing that waits in FFmpeg: no read-ahead, no reordering, half a second of probing instead of five.
OPTIONS = {
    "fflags": "nobuffer+discardcorrupt",
    "flags": "low_delay",
    "analyzeduration": "500000",
    "rtsp_transport": "tcp",
}
# Packets in a row that cannot be decoded before a stream counts as broken.
MAX_UNDECODABLE = 250
# Of one camera, waiting to be put into a set.
MAX_PENDING = 64
# A camera that was left out of so many sets in a row is not waited for until it gives a frame again.
PATIENCE = 3
# Frames from which the interval and the delay of a stream are measured.
WINDOW = 64
# Frames per second of a camera before it can be measured, where nobody says it.
ASSUMED_RATE = 30.0
# A stream's clock that jumps by more than this, in seconds, has been set anew.
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


class Device(Protocol):
    """An open camera: `read` waits for the next frame; None at the end, OSError when the connection breaks."""

    def read(self) -> Grab | None: ...

    def close(self) -> None: ...


Opener = Callable[[], Device]


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


class _Stream:
    """A network stream, decoded by FFmpeg; all of it, since most codecs cannot leave frames out."""

    def __init__(self, url: str) -> None:
        options = OPTIONS if url.startswith("rtsp") else {k: v for k, v in OPTIONS.items() if k != "rtsp_transport"}
        try:
            self._container = av.open(url, options=options, timeout=(TIMEOUT, TIMEOUT), metadata_errors="replace")
        except av.error.FFmpegError as error:
            raise OSError(_reason(error)) from None
        if not self._container.streams.video:
            self._container.close()
            raise OSError("there is no video in the stream")
        self._stream = self._container.streams.video[0]
        self._stream.codec_context.thread_count = 1  # more threads hold frames back
        self._reformatter = VideoReformatter()
        self._frames = self._decode()

    def read(self) -> Grab | None:
        try:
            frame = next(self._frames, None)
        except av.error.FFmpegError as error:
            raise OSError(_reason(error)) from None
        if frame is None:
            return None
        return Grab((frame.width, frame.height), partial(self._convert, frame), frame.time)

    def close(self) -> None:
        self._frames.close()
        self._container.close()

    def _decode(self) -> Generator[VideoFrame, None, None]:
        bad = 0
        for packet in self._container.demux(self._stream):
            try:
                frames = packet.decode()
            except av.error.InvalidDataError:  # a lost packet; the next key frame mends it
                bad += 1
                if bad > MAX_UNDECODABLE:
                    raise
                continue
            bad = 0 if frames else bad
            yield from (frame for frame in frames if not frame.is_corrupt)

    def _convert(self, frame: VideoFrame) -> Image:
        return np.asarray(self._reformatter.reformat(frame, format="bgr24").to_ndarray(), dtype=np.uint8)


class _Capture:
    """A camera of this computer, read by OpenCV on every system; it is asked for the calibration's size."""

    def __init__(self, source: int | str, size: tuple[int, int], rate: float | None) -> None:
        self._capture = cv2.VideoCapture(source)
        if not self._capture.isOpened():
            self._capture.release()
            raise OSError("there is no such camera, or another program has it")
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if rate is not None:
            self._capture.set(cv2.CAP_PROP_FPS, rate)

    def read(self) -> Grab | None:
        good, image = self._capture.read()
        if not good:
            raise OSError("it gives no frames any more")
        pixels = np.asarray(image, dtype=np.uint8)
        return Grab((pixels.shape[1], pixels.shape[0]), lambda: pixels)

    def close(self) -> None:
        self._capture.release()


def open_device(source: int | str, size: tuple[int, int], rate: float | None = None) -> Device:
    """Open a camera by number or device path, or a stream by its URL.

    Raises:
        OSError: saying why it cannot be opened.
    """
    return _Stream(source) if isinstance(source, str) and "://" in source else _Capture(source, size, rate)


def _reason(error: av.error.FFmpegError) -> str:
    if isinstance(error, av.error.ExitError):
        return f"nothing came for {TIMEOUT:g} s"
    return (error.strerror or type(error).__name__).lower()  # not str(error): it holds the URL, perhaps with a password


class _Feed:
    """The thread of one camera: opens it, hands on every frame, and tries again a few times when it breaks."""

    def __init__(self, camera: Camera, opener: Opener, hub: _Hub, pauses: Sequence[float]) -> None:
        self._camera, self._open, self._hub, self._pauses = camera, opener, hub, pauses
        self.tried = self.ended = self._out = False
        self.refused: str | None = None  # why it cannot be used at all
        self._thread = threading.Thread(target=self._run, name=f"sylpose-live-{camera.name}", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait for the thread: a device that hangs can hold it for as long as its own timeout."""
        self._thread.join(2 * TIMEOUT)

    def _run(self) -> None:
        failures = 0
        try:
            while not self._hub.stopped.is_set():
                begin = time.monotonic()
                reason = self._serve()
                if self.refused:
                    self._hub.say(f"{self.refused}; this camera gives no more.")
                if self.refused or self._hub.stopped.is_set():
                    return
                if time.monotonic() - begin > STEADY:
                    failures = 0
                again = failures < len(self._pauses)
                if failures == 0 or not again:
                    then = "it is tried again" if again else "this camera gives no more"
                    self._hub.say(f"{self._camera.name}: {reason}; {then}.")
                    self._out = True
                if not again or self._hub.stopped.wait(self._pauses[failures]):
                    return
                failures += 1
        finally:
            self.ended = True
            self._hub.lost(self._camera.name)

    def _serve(self) -> str:
        """Hand on frames until there are no more; why that is."""
        try:
            with closing(self._open()) as device:
                while not self._hub.stopped.is_set():
                    grab = device.read()
                    if grab is None:
                        return "the stream has ended"
                    if grab.size != self._camera.size:
                        self.refused = (
                            f"{self._camera.name}: frames of {grab.size[0]}x{grab.size[1]}, but this camera is "
                            f"calibrated at {self._camera.size[0]}x{self._camera.size[1]}"
                        )
                        return ""
                    self._hub.add(self._camera.name, grab)
                    if self._out:
                        self._out = False
                        self._hub.say(f"{self._camera.name}: it is back.")
            return ""
        except (OSError, ValueError, cv2.error) as error:
            return f"it cannot be read ({error})"
        finally:
            self.tried = True
            self._hub.lost(self._camera.name)


class _Hub:
    """Where the cameras' threads and the reader meet; `changed` guards everything."""

    def __init__(self, assembler: Assembler, names: Sequence[str], stopped: threading.Event) -> None:
        self.assembler, self.stopped = assembler, stopped
        self.changed = threading.Condition()
        self._number = {name: c for c, name in enumerate(names)}
        self._said: deque[str] = deque(maxlen=100)

    def add(self, name: str, grab: Grab) -> None:
        arrival = time.monotonic()
        with self.changed:
            self.assembler.add(self._number[name], grab, arrival)
            self.changed.notify()

    def lost(self, name: str) -> None:
        with self.changed:
            self.assembler.gone(self._number[name])
            self.changed.notify()

    def say(self, problem: str) -> None:
        with self.changed:
            self._said.append(problem)

    def heard(self) -> list[str]:
        with self.changed:
            said = [*self._said]
            self._said.clear()
            return said


def read_streams(
    cameras: Iterable[Camera],
    openers: Sequence[Opener],
    assembler: Assembler,
    instants: range,
    on_problem: Callable[[str], None],
    stopped: threading.Event,
    pauses: Sequence[float] = PAUSES,
) -> Generator[FrameSet, None, None]:
    """Frame sets, without masks, of cameras that are opened here and closed at the end.

    Starts when every camera has given a frame or failed, at the latest after TIMEOUT seconds. Times are in seconds since
    the first set. Sets whose number is not in `instants` are passed over.

    Raises:
        ValueError: a camera whose frames are not of the calibration's size.
        OSError: no camera gives any frame.
    """
    cameras = list(cameras)
    hub = _Hub(assembler, [camera.name for camera in cameras], stopped)
    feeds = [_Feed(camera, opener, hub, pauses) for camera, opener in zip(cameras, openers, strict=True)]
    index, zero = -1, 0.0
    said: list[str] = []
    try:
        _await_first(hub, feeds)
        while index + 1 < instants.stop:
            shots = _next_set(hub, feeds)
            if index < 0:
                _check_refused(feeds)
            for problem in hub.heard():
                said += [problem] if index < 0 else []
                on_problem(problem)
            if shots is None:
                if index < 0 and not stopped.is_set():
                    raise OSError(f"no camera gives any frame: {' '.join(said)}")
                return
            index += 1
            times = [None if shot is None else shot.time for shot in shots]
            mean = fmean(t for t in times if t is not None)
            zero = mean if index == 0 else zero
            if index in instants:
                yield FrameSet(
                    index,
                    mean - zero,
                    tuple(None if t is None else t - zero for t in times),
                    tuple(None if shot is None else shot.pixels() for shot in shots),
                    (None,) * len(shots),
                )
    finally:
        stopped.set()
        for feed in feeds:
            feed.join()


def _await_first(hub: _Hub, feeds: Sequence[_Feed]) -> None:
    deadline = time.monotonic() + TIMEOUT
    with hub.changed:
        while time.monotonic() < deadline and not hub.stopped.is_set():
            if all(hub.assembler.seen(c) or feed.tried for c, feed in enumerate(feeds)):
                break
            hub.changed.wait(TICK)
        hub.assembler.begin()


def _next_set(hub: _Hub, feeds: Sequence[_Feed]) -> list[Shot | None] | None:
    """The next set as soon as there is one; None when all cameras have ended, or the reader is stopped."""
    with hub.changed:
        while not hub.stopped.is_set():
            ended = all(feed.ended for feed in feeds)
            shots = hub.assembler.pick(time.monotonic())
            if shots is not None or ended:
                return shots
            hub.changed.wait(TICK)
    return None


def _check_refused(feeds: Iterable[_Feed]) -> None:
    refused = [feed.refused for feed in feeds if feed.refused]
    if refused:
        raise ValueError("; ".join(refused))
