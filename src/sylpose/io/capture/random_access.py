"""Random access to single frames of a recording; `Session.frames` reads them sequentially."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, closing, suppress
from types import TracebackType
from typing import Self

import av.error
import numpy as np
from av.video.frame import VideoFrame

from sylpose.geometry.arrays import Image, IntArray
from sylpose.io.capture.frame_readers import FrameReader
from sylpose.io.capture.session import Session
from sylpose.io.capture.sources import Source, open_video

# Up to this many frames ahead are decoded sequentially instead of seeking to a keyframe (choice).
MAX_SEQUENTIAL_FRAMES = 40


class RandomAccessReader:
    """Random-access reader of a recording's images; a context manager, for one thread at a time.

    Raises:
        OSError, ValueError: a video can no longer be opened.
    """

    def __init__(self, session: Session) -> None:
        self._frames = session.timeline.frames
        with ExitStack() as stack:
            self._cameras = [
                stack.enter_context(closing((_SeekableVideo if source.kind == "video" else FrameReader)(source)))
                for source in session.sources
            ]
            self._open = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._open.close()

    def read_frame_set(self, index: int) -> tuple[Image | None, ...]:
        """Read the images of one frame set.

        Args:
            index: number of the frame set.

        Returns:
            One image (h, w, 3) BGR per camera; None without a frame or if it is unreadable.

        Raises:
            ValueError: the index is outside the recording.
        """
        if not 0 <= index < len(self._frames):
            raise ValueError(f"index must be in 0 ... {len(self._frames) - 1} (the session's frames), got {index}")
        row = self._frames[index].tolist()
        images = tuple(None if k < 0 else camera.read(k) for camera, k in zip(self._cameras, row, strict=True))
        for camera in self._cameras:
            if isinstance(camera, FrameReader):
                camera.problems.clear()  # an unreadable image is None, whatever the reason
        return images


class _SeekableVideo:
    """Random access to a video: frame k has the k-th presentation timestamp of all packets, also after seeking."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._container, self._stream = open_video(source.path)
        self._decoded = self._decode()
        self._last: tuple[int, VideoFrame | None] = (-1, None)
        self._times: IntArray | None = None

    def close(self) -> None:
        self._decoded.close()
        self._container.close()

    def read(self, k: int) -> Image | None:
        if k != self._last[0]:
            frame = None
            if not self._last[0] < k <= self._last[0] + MAX_SEQUENTIAL_FRAMES:
                frame = self._seek(k)
            self._last = (k, frame if frame is not None else self._decode_until(k))
        frame = self._last[1]
        if frame is None or frame.is_corrupt or (frame.width, frame.height) != self._source.size:
            return None
        return np.asarray(frame.to_ndarray(format="bgr24"), dtype=np.uint8)

    def _decode_until(self, k: int) -> VideoFrame | None:
        """Decode sequentially up to frame k, from the last frame or from the first."""
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

    def _seek(self, k: int) -> VideoFrame | None:
        """Seek to the keyframe before frame k and decode; None if the timestamps are unusable."""
        if self._times is None:
            self._times = self._read_packet_times()
        if k >= len(self._times):
            return None
        target = int(self._times[k])
        self._restart()
        with suppress(av.error.FFmpegError):
            self._container.seek(target, stream=self._stream)
            for frame in self._decoded:
                if frame.pts is None or frame.pts > target:
                    break
                if frame.pts == target:
                    return frame
        self._restart()
        self._last = (-1, None)
        return None

    def _read_packet_times(self) -> IntArray:
        """Return the sorted timestamps of all shown packets; empty if any is missing or repeated."""
        times = []
        self._restart()
        with suppress(av.error.FFmpegError):
            for packet in self._container.demux(self._stream):
                if packet.size and not packet.is_discard:
                    times.append(packet.pts)
        self._last = (-1, None)
        known_times = [time for time in times if time is not None]
        if len(known_times) < len(times) or len(set(known_times)) < len(known_times):
            return np.empty(0, np.int64)
        return np.array(sorted(known_times), np.int64)

    def _restart(self) -> None:
        self.close()
        self._container, self._stream = open_video(self._source.path)
        self._decoded = self._decode()

    def _decode(self) -> Generator[VideoFrame, None, None]:
        with suppress(av.error.FFmpegError):
            for packet in self._container.demux(self._stream):
                yield from packet.decode()
