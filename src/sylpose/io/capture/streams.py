"""Camera and network streams: one thread per stream, whose frames are assembled into frame sets."""

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

from sylpose.frames import FrameSet
from sylpose.io.capture.frame_assembly import POLL_INTERVAL, FrameAssembler, Grab, TimedFrame
from sylpose.io.capture.frame_readers import MAX_UNDECODABLE, convert_frame
from sylpose.io.capture.image_sizes import describe_size_mismatch
from sylpose.io.capture.sources import METADATA_OPTIONS
from sylpose.rig import Camera

# Seconds after which a stream that cannot be opened or delivers nothing counts as dead; also the longest wait for the
# first frames of all cameras.
TIMEOUT = 5.0
# Seconds between attempts to reopen a failed camera; after the last attempt it is abandoned.
RETRY_DELAYS = (0.5, 1.0, 2.0, 4.0, 8.0)
# A connection that lasted longer than this, in seconds, resets the sequence of pauses.
STABLE_SECONDS = 10.0
# No buffering in FFmpeg: no read-ahead, no reordering, half a second of probing instead of five.
FFMPEG_OPTIONS = {
    "fflags": "nobuffer+discardcorrupt",
    "flags": "low_delay",
    "analyzeduration": "500000",
}


class Device(Protocol):
    """An open camera. `read` blocks until the next frame; None at the end, OSError if the connection breaks."""

    def read(self) -> Grab | None: ...

    def close(self) -> None: ...


Opener = Callable[[], Device]


class _NetworkStream:
    """Network stream decoded by FFmpeg. Every frame is decoded, since most codecs cannot skip frames."""

    def __init__(self, url: str) -> None:
        options = FFMPEG_OPTIONS | ({"rtsp_transport": "tcp"} if url.startswith("rtsp") else {})
        try:
            self._container = av.open(url, options=options, timeout=(TIMEOUT, TIMEOUT), **METADATA_OPTIONS)
        except av.error.FFmpegError as error:
            raise OSError(_error_reason(error)) from None
        if not self._container.streams.video:
            self._container.close()
            raise OSError("the stream contains no video")
        self._stream = self._container.streams.video[0]
        self._stream.codec_context.thread_count = 1  # more threads delay frames
        self._reformatter = VideoReformatter()
        self._frames = self._decode()

    def read(self) -> Grab | None:
        try:
            frame = next(self._frames, None)
        except av.error.FFmpegError as error:
            raise OSError(_error_reason(error)) from None
        if frame is None:
            return None
        return Grab((frame.width, frame.height), partial(convert_frame, frame, self._reformatter), frame.time)

    def close(self) -> None:
        self._frames.close()
        self._container.close()

    def _decode(self) -> Generator[VideoFrame, None, None]:
        bad = 0
        for packet in self._container.demux(self._stream):
            try:
                frames = packet.decode()
            except av.error.InvalidDataError:  # a lost packet; decoding recovers at the next keyframe
                bad += 1
                if bad > MAX_UNDECODABLE:
                    raise
                continue
            bad = 0 if frames else bad
            yield from (frame for frame in frames if not frame.is_corrupt)


class _LocalCamera:
    """Local camera read by OpenCV, set to the calibration's image size."""

    def __init__(self, source: int | str, size: tuple[int, int], rate: float | None) -> None:
        self._capture = cv2.VideoCapture(source)
        if not self._capture.isOpened():
            self._capture.release()
            raise OSError("no such camera, or another program uses it")
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if rate is not None:
            self._capture.set(cv2.CAP_PROP_FPS, rate)

    def read(self) -> Grab | None:
        good, image = self._capture.read()
        if not good:
            raise OSError("it no longer delivers frames")
        pixels = np.asarray(image, dtype=np.uint8)
        return Grab((pixels.shape[1], pixels.shape[0]), lambda: pixels)

    def close(self) -> None:
        self._capture.release()


def open_device(source: int | str, size: tuple[int, int], rate: float | None = None) -> Device:
    """Open a camera by number or device path, or a stream by its URL.

    Args:
        source: device number, device path or URL.
        size: (width, height) to set on a local camera, pixels.
        rate: frame rate to set on a local camera, frames per second.

    Raises:
        OSError: it cannot be opened; the message contains the reason.
    """
    return _NetworkStream(source) if isinstance(source, str) and "://" in source else _LocalCamera(source, size, rate)


def _error_reason(error: av.error.FFmpegError) -> str:
    if isinstance(error, av.error.ExitError):
        return f"no data for {TIMEOUT:g} s"
    return (error.strerror or type(error).__name__).lower()  # not str(error): its URL may contain a password


class _CameraThread:
    """Thread of one camera: opens it, forwards its frames and reconnects after failures."""

    def __init__(self, camera: Camera, opener: Opener, hub: _StreamHub) -> None:
        self._camera, self._open, self._hub = camera, opener, hub
        self.has_tried = self.has_ended = self._is_down = False
        self.rejection: str | None = None  # reason why it is unusable
        self._thread = threading.Thread(target=self._run, name=f"sylpose-live-{camera.name}", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait for the thread; a hanging device can block it for its own timeout."""
        self._thread.join(2 * TIMEOUT)

    def _run(self) -> None:
        failures = 0
        try:
            while not self._hub.stopped.is_set():
                begin = time.monotonic()
                reason = self._forward_frames()
                if self.rejection:
                    self._hub.add_message(f"{self.rejection}; this camera is not used any more.", is_last=True)
                if self.rejection or self._hub.stopped.is_set():
                    return
                if time.monotonic() - begin > STABLE_SECONDS:
                    failures = 0
                can_retry = failures < len(RETRY_DELAYS)
                if failures == 0 or not can_retry:
                    consequence = "reconnecting" if can_retry else "this camera is not used any more"
                    self._hub.add_message(f"{self._camera.name}: {reason}; {consequence}.", is_last=not can_retry)
                    self._is_down = True
                if not can_retry or self._hub.stopped.wait(RETRY_DELAYS[failures]):
                    return
                failures += 1
        finally:
            self.has_ended = True
            self._hub.mark_lost(self._camera.name)

    def _forward_frames(self) -> str:
        """Forward frames until the stream ends; return the reason why it ended."""
        try:
            with closing(self._open()) as device:
                while not self._hub.stopped.is_set():
                    grab = device.read()
                    if grab is None:
                        return "the stream has ended"
                    if grab.size != self._camera.size:
                        self.rejection = (
                            f"{self._camera.name}: frames of {grab.size[0]}x{grab.size[1]}, but this camera is "
                            f"calibrated at {self._camera.size[0]}x{self._camera.size[1]}: "
                            f"{describe_size_mismatch(grab.size, self._camera.size)}"
                        )
                        return ""
                    self._hub.add(self._camera.name, grab)
                    if self._is_down:
                        self._is_down = False
                        self._hub.add_message(f"{self._camera.name}: reconnected.")
            return ""
        except (OSError, ValueError, cv2.error) as error:
            return f"it cannot be read ({error})"
        finally:
            self.has_tried = True
            self._hub.mark_lost(self._camera.name)


class _StreamHub:
    """Shared state of the camera threads and the reader, guarded by `changed`."""

    def __init__(self, assembler: FrameAssembler, names: Sequence[str], stopped: threading.Event) -> None:
        self.assembler, self.stopped = assembler, stopped
        self.changed = threading.Condition()
        self._number = {name: c for c, name in enumerate(names)}
        self._messages: deque[tuple[str, bool]] = deque(maxlen=100)

    def add(self, name: str, grab: Grab) -> None:
        arrival = time.monotonic()
        with self.changed:
            self.assembler.add(self._number[name], grab, arrival)
            self.changed.notify()

    def mark_lost(self, name: str) -> None:
        with self.changed:
            self.assembler.mark_unavailable(self._number[name])
            self.changed.notify()

    def add_message(self, problem: str, *, is_last: bool = False) -> None:
        """Queue a message for the user; `is_last` marks the final one of a camera."""
        with self.changed:
            self._messages.append((problem, is_last))
            self.changed.notify()

    def take_messages(self) -> list[tuple[str, bool]]:
        with self.changed:
            messages = [*self._messages]
            self._messages.clear()
            return messages


class _SetReader:
    """Reader of frame sets from camera threads, which forwards their messages while it waits."""

    def __init__(self, hub: _StreamHub, threads: Sequence[_CameraThread], on_problem: Callable[[str], None]) -> None:
        self._hub, self._threads, self._on_problem = hub, threads, on_problem
        self.has_started = False
        self.final_messages: list[str] = []  # before the first set: without one they go into the error only

    def wait_for_cameras(self) -> None:
        """Wait until every camera has delivered a frame or failed, at most TIMEOUT seconds."""
        deadline = time.monotonic() + TIMEOUT
        while time.monotonic() < deadline and not self._hub.stopped.is_set():
            self.forward_messages()
            with self._hub.changed:
                if all(self._hub.assembler.has_pending(c) or t.has_tried for c, t in enumerate(self._threads)):
                    break
                self._hub.changed.wait(POLL_INTERVAL)
        with self._hub.changed:
            self._hub.assembler.discard_backlog()

    def wait_for_set(self) -> list[TimedFrame | None] | None:
        """Wait for the next set; None when all cameras have ended or the reader is stopped."""
        while not self._hub.stopped.is_set():
            self.forward_messages()
            with self._hub.changed:
                has_ended = all(thread.has_ended for thread in self._threads)
                shots = self._hub.assembler.next_set(time.monotonic())
                if shots is not None or has_ended:
                    return shots
                self._hub.changed.wait(POLL_INTERVAL)
        return None

    def forward_messages(self) -> None:
        for problem, is_last in self._hub.take_messages():
            if is_last and not self.has_started:
                self.final_messages.append(problem)
            else:
                self._on_problem(problem)

    def check_rejections(self) -> None:
        if rejections := [thread.rejection for thread in self._threads if thread.rejection]:
            raise ValueError("; ".join(rejections))


def read_streams(
    cameras: Iterable[Camera],
    openers: Sequence[Opener],
    assemble: Callable[[], FrameAssembler],
    indices: range,
    on_problem: Callable[[str], None],
    stopped: threading.Event,
) -> Generator[FrameSet, None, None]:
    """Open cameras and yield their frame sets, without masks; the cameras are closed at the end.

    Starts when every camera has delivered a frame or failed, at the latest after TIMEOUT seconds. Times are in seconds
    since the first set. Sets whose number is not in `indices` are skipped.

    Args:
        cameras: the rig's cameras.
        openers: functions that open the devices, one per camera.
        assemble: returns what groups the frames into sets.
        indices: numbers of the frame sets to yield.
        on_problem: called with messages, in the caller's thread.
        stopped: ends the iteration when set.

    Raises:
        ValueError: a camera's frames differ from the calibration's size.
        OSError: no camera delivers any frame.
    """
    cameras = list(cameras)
    hub = _StreamHub(assemble(), [camera.name for camera in cameras], stopped)
    threads = [_CameraThread(camera, opener, hub) for camera, opener in zip(cameras, openers, strict=True)]
    reader, start_time = _SetReader(hub, threads, on_problem), 0.0
    try:
        reader.wait_for_cameras()
        for index in range(indices.stop):
            shots = reader.wait_for_set()
            if not reader.has_started:
                reader.check_rejections()
            reader.forward_messages()
            if shots is None:
                if not reader.has_started and not stopped.is_set():
                    raise OSError(f"no camera delivers any frame: {' '.join(reader.final_messages)}")
                return
            while reader.final_messages:
                on_problem(reader.final_messages.pop(0))
            reader.has_started = True
            times = [None if shot is None else shot.time for shot in shots]
            mean = fmean(t for t in times if t is not None)
            start_time = mean if index == 0 else start_time
            if index in indices:
                yield FrameSet(
                    index,
                    mean - start_time,
                    tuple(None if t is None else t - start_time for t in times),
                    tuple(None if shot is None else shot.pixels() for shot in shots),
                    (None,) * len(shots),
                    interval=indices.step * hub.assembler.interval,
                )
    finally:
        stopped.set()
        for thread in threads:
            thread.join()
