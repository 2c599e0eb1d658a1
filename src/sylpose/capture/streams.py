"""Cameras and network streams: a thread for each, whose frames are put together into frame sets."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from functools import partial
from statistics import fmean
from typing import Protocol

import av
import av.error
import cv2
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter

from sylpose.capture.frame_assembly import TICK, Assembler, Grab, Shot
from sylpose.capture.sources import ANY_TITLE
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import Image
from sylpose.rig import Camera

__all__ = ["Device", "Grab", "Opener", "open_device", "read_streams"]


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


class Device(Protocol):
    """An open camera: `read` waits for the next frame; None at the end, OSError when the connection breaks."""

    def read(self) -> Grab | None: ...

    def close(self) -> None: ...


Opener = Callable[[], Device]


class _Stream:
    """A network stream, decoded by FFmpeg; all of it, since most codecs cannot leave frames out."""

    def __init__(self, url: str) -> None:
        options = OPTIONS if url.startswith("rtsp") else {k: v for k, v in OPTIONS.items() if k != "rtsp_transport"}
        try:
            self._container = av.open(url, options=options, timeout=(TIMEOUT, TIMEOUT), **ANY_TITLE)
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
                    self._hub.say(f"{self.refused}; this camera gives no more.", last=True)
                if self.refused or self._hub.stopped.is_set():
                    return
                if time.monotonic() - begin > STEADY:
                    failures = 0
                again = failures < len(self._pauses)
                if failures == 0 or not again:
                    then = "it is tried again" if again else "this camera gives no more"
                    self._hub.say(f"{self._camera.name}: {reason}; {then}.", last=not again)
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
        self._said: deque[tuple[str, bool]] = deque(maxlen=100)

    def add(self, name: str, grab: Grab) -> None:
        arrival = time.monotonic()
        with self.changed:
            self.assembler.add(self._number[name], grab, arrival)
            self.changed.notify()

    def lost(self, name: str) -> None:
        with self.changed:
            self.assembler.gone(self._number[name])
            self.changed.notify()

    def say(self, problem: str, *, last: bool = False) -> None:
        """A sentence for people; `last` of this camera."""
        with self.changed:
            self._said.append((problem, last))
            self.changed.notify()

    def heard(self) -> list[tuple[str, bool]]:
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
    ends: list[str] = []  # of cameras, before the first set: where there is none they are in the error, and said once

    def tell() -> None:
        for problem, last in hub.heard():
            if last and index < 0:
                ends.append(problem)
            else:
                on_problem(problem)

    try:
        _await_first(hub, feeds, tell)
        while index + 1 < instants.stop:
            shots = _next_set(hub, feeds, tell)
            if index < 0:
                _check_refused(feeds)
            tell()
            if shots is None:
                if index < 0 and not stopped.is_set():
                    raise OSError(f"no camera gives any frame: {' '.join(ends)}")
                return
            while ends:
                on_problem(ends.pop(0))
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


def _await_first(hub: _Hub, feeds: Sequence[_Feed], tell: Callable[[], None]) -> None:
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline and not hub.stopped.is_set():
        tell()
        with hub.changed:
            if all(hub.assembler.seen(c) or feed.tried for c, feed in enumerate(feeds)):
                break
            hub.changed.wait(TICK)
    with hub.changed:
        hub.assembler.begin()


def _next_set(hub: _Hub, feeds: Sequence[_Feed], tell: Callable[[], None]) -> list[Shot | None] | None:
    """The next set as soon as there is one; None when all cameras have ended, or the reader is stopped. What is said
    meanwhile is told at once."""
    while not hub.stopped.is_set():
        tell()
        with hub.changed:
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
