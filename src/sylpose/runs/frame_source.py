"""Frame sources of a node: one camera's frames, from a recording or a live camera, numbered the same at all nodes.

`arrival_time` of a source is the monotonic time at which its newest frame became available.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

import numpy as np

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.io.capture.frame_assembly import StreamClock
from sylpose.io.capture.frame_readers import CameraReader
from sylpose.io.capture.image_sizes import describe_size_mismatch
from sylpose.io.capture.sources import Source, open_source
from sylpose.io.capture.streams import Device, open_device
from sylpose.network.codec import FRAME_PENDING, NO_FRAME
from sylpose.rig import Camera

# Frames of a live camera that are kept until all nodes agree on the next one; seconds to wait for a frame (choice).
MAX_KEPT_FRAMES, MAX_WAIT = 16, 0.3
# Frames per second of a recording without a frame rate (choice: then its times are frame numbers).
DEFAULT_RATE = 1.0


def _make_frame_set(
    camera: int, number: int, times: Sequence[float | None], default_time: float, image: Image | None
) -> FrameSet:
    known = [t for t in times if t is not None]
    # By rounding, the mean of equal times may differ from them.
    timestamp = default_time if not known else known[0] if len(set(known)) == 1 else fmean(known)
    images = tuple(image if c == camera else None for c in range(len(times)))
    return FrameSet(number, timestamp, tuple(times), images, (None,) * len(times))


class RecordedSource:
    """Recording played at its frame rate, or as fast as frames are requested; no frame is dropped.

    Args:
        camera: index of the camera.
        source: its recording.
        rate: frames per second; None: the recording's own rate.
        speed: playback speed as a multiple of the rate; 0: as fast as frames are requested.
    """

    def __init__(self, camera: int, source: Source, rate: float | None = None, speed: float = 1.0) -> None:
        self._camera, self._source, self._speed = camera, source, speed
        self._rate = rate or source.rate or DEFAULT_RATE
        self._pace = speed if rate or source.rate else 0.0
        self._frames = number_frames(source.stamps, self._rate) if rate is None else {}
        self._n_frames = max(self._frames, default=source.n_frames - 1) + 1
        self._reader = CameraReader(source, {})
        self._start_time: float | None = None  # monotonic time of frame 0, shown or not
        self._last_requested = 0  # number of the last requested frame
        self.arrival_time = 0.0

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """See `CameraFrames`."""
        if wanted >= self._n_frames:
            return NO_FRAME, None
        if self._pace:
            elapsed = wanted / (self._rate * self._pace)
            # Otherwise the node joined at another frame.
            is_next = wanted in (self._last_requested, self._last_requested + 1)
            if self._start_time is None or not is_next:
                self._start_time = time.monotonic() - elapsed
            self._last_requested = wanted
            time.sleep(max(self._start_time + elapsed - time.monotonic(), 0.0))
        self.arrival_time = time.monotonic()
        return wanted, self.time_of(wanted)

    def time_of(self, number: int) -> float | None:
        """See `CameraFrames`."""
        return number / self._rate

    def frame_set(self, number: int, times: Sequence[float | None]) -> FrameSet:
        """See `CameraFrames`."""
        frame = self._frames.get(number, -1) if self._frames else number
        image = self._reader.read(frame).image if frame < self._source.n_frames else None
        return _make_frame_set(self._camera, number, times, number / self._rate, image)

    def close(self) -> None:
        """Close the recording."""
        self._reader.close()


def number_frames(stamps: FloatArray | None, rate: float) -> dict[int, int]:
    """Number the frames of a video by its time stamps (n,), seconds, so that lost ones do not shift later ones.

    Returns:
        the first frame of each number; empty without time stamps.
    """
    if stamps is None:
        return {}
    numbers = np.rint((stamps - stamps[0]) * rate).astype(int).tolist()
    return {number: k for k, number in reversed([*enumerate(numbers)])}


class LiveSource:
    """Live camera or stream whose frames are numbered by the clock; all nodes need synchronized clocks.

    Args:
        camera: index of the camera.
        model: its calibration.
        source: device number, path or URL.
        rate: frames per second, the same for all cameras.
        opener: function that opens the device.

    Raises:
        OSError: the device cannot be opened.
    """

    def __init__(
        self,
        camera: int,
        model: Camera,
        source: int | str,
        rate: float,
        opener: Callable[[int | str, tuple[int, int], float | None], Device] = open_device,
    ) -> None:
        self._camera, self._rate, self._size, self._name = camera, rate, model.size, str(source)
        self._device = opener(source, model.size, rate)
        self._frames: OrderedDict[int, tuple[float, Image]] = OrderedDict()
        self._condition = threading.Condition()
        self._ended, self._error, self._has_stalled, self.arrival_time = False, "", False, 0.0
        self._reader = threading.Thread(target=self._run, daemon=True)
        self._reader.start()

    def _run(self) -> None:
        try:
            self._read()
        except Exception as error:
            self._error = f"{self._name}: {error}"
        finally:
            self._device.close()
            with self._condition:
                self._ended = True
                self._condition.notify()

    def _read(self) -> None:
        clock = StreamClock()
        while not self._ended:
            grab = self._device.read()
            if grab is None:
                break
            if grab.size != self._size:
                self._error = (
                    f"{self._name}: images of {grab.size[0]}x{grab.size[1]}, the calibration has {self._size}: "
                    f"{describe_size_mismatch(grab.size, self._size)}"
                )
                break
            host_time = clock.to_host_time(grab.pts, time.time())
            if host_time is None:
                continue
            with self._condition:
                self._frames[round(host_time * self._rate)] = host_time, grab.pixels()
                while len(self._frames) > MAX_KEPT_FRAMES:
                    self._frames.popitem(last=False)
                self._condition.notify()

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """See `CameraFrames`.

        Raises:
            ValueError: the camera failed, or its images have another size than its calibration.
        """
        with self._condition:
            # The other nodes wait as well: wait only briefly for a camera that has stalled.
            timeout = 1.0 / self._rate if self._has_stalled else MAX_WAIT
            self._condition.wait_for(lambda: self._ended or max(self._frames, default=-1) >= wanted, timeout)
            newest = max(self._frames, default=-1)
            self._has_stalled, self.arrival_time = newest < wanted, time.monotonic()
            if newest >= wanted:
                return newest, self._frames[newest][0]
            if self._error:
                raise ValueError(self._error)
            return (NO_FRAME if self._ended else FRAME_PENDING), None

    def time_of(self, number: int) -> float | None:
        """See `CameraFrames`."""
        with self._condition:
            return self._frames[number][0] if number in self._frames else None

    def frame_set(self, number: int, times: Sequence[float | None]) -> FrameSet:
        """See `CameraFrames`."""
        with self._condition:
            image = self._frames[number][1] if number in self._frames else None
        return _make_frame_set(self._camera, number, times, number / self._rate, image)

    def close(self) -> None:
        """Close the camera after the frame that it is reading."""
        self._ended = True
        self._reader.join(MAX_WAIT)


def open_node_source(
    source: str, camera: int, model: Camera, rate: float | None, speed: float
) -> RecordedSource | LiveSource:
    """Open the source of a node: an existing file or folder, else a device or a URL.

    Args:
        source: value of `--source`.
        camera: index of the camera.
        model: its calibration.
        rate: frames per second; None: the recording's own rate.
        speed: playback speed of a recording.

    Raises:
        ValueError, OSError: the source cannot be read; a live camera without a rate.
    """
    path = Path(source)
    if path.is_dir() or (path.is_file() and not path.is_char_device()):
        return RecordedSource(camera, open_source(path, model), rate, speed)
    if not (source.isdigit() or "://" in source or path.exists()):
        raise ValueError(f"--source {source}: no such file or folder, and not a camera number or URL")
    if rate is None:
        raise ValueError("--rate HZ is needed with a camera or a stream: all nodes number frames by it")
    return LiveSource(camera, model, int(source) if source.isdigit() else source, rate)
