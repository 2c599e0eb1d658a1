"""Single frames of a recording, in any order, to be looked at; `Session.frames` reads all of them one after the other."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Self

import av.error
import numpy as np
from av.video.frame import VideoFrame

from sylpose.capture.images import read_image
from sylpose.capture.session import Session
from sylpose.capture.sources import Source, open_video
from sylpose.geometry.arrays import Image, IntArray

__all__ = ["SingleFrames"]

# So many frames ahead are rather decoded one after the other than sought by the key frame before them (choice).
AHEAD = 40


class SingleFrames:
    """The images of a recording at single instants; a context manager. For one thread at a time.

    Raises:
        OSError, ValueError: a video that cannot be opened any more.
    """

    def __init__(self, session: Session) -> None:
        self._frames = session.timeline.frames
        with ExitStack() as stack:
            self._cameras = [
                stack.enter_context(_Video(source)) if source.kind == "video" else _Images(source)
                for source in session.sources
            ]
            self._open = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._open.close()

    def at(self, index: int) -> tuple[Image | None, ...]:
        """By camera, the image (h, w, 3) BGR of an instant; None for one that has none or whose image cannot be read.

        Raises:
            ValueError: an instant that the recording does not have.
        """
        if not 0 <= index < len(self._frames):
            raise ValueError(f"index must be in 0 ... {len(self._frames) - 1} (the session's frames), got {index}")
        row = self._frames[index].tolist()
        return tuple(None if k < 0 else camera.read(k) for camera, k in zip(self._cameras, row, strict=True))


class _Images:
    def __init__(self, source: Source) -> None:
        self._source = source

    def read(self, k: int) -> Image | None:
        with suppress(ValueError, OSError):
            return read_image(self._source.files[k], self._source.size)
        return None


class _Video:
    """Frame k is the one with the k-th of all packets' times of showing: so it is found again after a jump."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._container, self._stream = open_video(source.path)
        self._decoded = self._decode()
        self._last: tuple[int, VideoFrame | None] = (-1, None)
        self._times: IntArray | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._decoded.close()
        self._container.close()

    def read(self, k: int) -> Image | None:
        if k != self._last[0]:
            frame = None
            if not self._last[0] < k <= self._last[0] + AHEAD:
                frame = self._sought(k)
            self._last = (k, frame if frame is not None else self._counted(k))
        frame = self._last[1]
        if frame is None or frame.is_corrupt or (frame.width, frame.height) != self._source.size:
            return None
        return np.asarray(frame.to_ndarray(format="bgr24"), dtype=np.uint8)

    def _counted(self, k: int) -> VideoFrame | None:
        """By decoding all frames up to it, from the last one or from the first."""
        position = self._last[0]
        if position >= k:
            self._restart()
            position = -1
        frame = None
        while position < k:
            frame = next(self._decoded, None)
            if frame is None:
                return None
            position += 1
        return frame

    def _sought(self, k: int) -> VideoFrame | None:
        """By the key frame before it; None where the times do not tell."""
        if self._times is None:
            self._times = self._told_times()
        if k >= len(self._times):
            return None
        wanted = int(self._times[k])
        self._restart()
        with suppress(av.error.FFmpegError):
            self._container.seek(wanted, stream=self._stream)
            for frame in self._decoded:
                if frame.pts is None or frame.pts > wanted:
                    break
                if frame.pts == wanted:
                    return frame
        self._restart()
        self._last = (-1, None)
        return None

    def _told_times(self) -> IntArray:
        """Of all packets that are shown, in order; none where one has none, or two have the same."""
        times = []
        self._restart()
        with suppress(av.error.FFmpegError):
            for packet in self._container.demux(self._stream):
                if packet.size and not packet.is_discard:
                    times.append(packet.pts)
        self._last = (-1, None)
        told = [time for time in times if time is not None]
        if len(told) < len(times) or len(set(told)) < len(told):
            return np.empty(0, np.int64)
        return np.array(sorted(told), np.int64)

    def _restart(self) -> None:
        self._decoded.close()
        self._container.close()
        self._container, self._stream = open_video(self._source.path)
        self._decoded = self._decode()

    def _decode(self) -> Generator[VideoFrame, None, None]:
        with suppress(av.error.FFmpegError):
            for packet in self._container.demux(self._stream):
                yield from packet.decode()
