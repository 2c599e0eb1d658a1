"""Random access to single frames of a recording; `Session.frames` reads them sequentially."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Generator
from contextlib import ExitStack, closing, suppress
from types import TracebackType
from typing import Self, cast

import av.error
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter

from sylpose.geometry.arrays import Image
from sylpose.io.capture.frame_readers import READERS, FrameReader, convert_frame
from sylpose.io.capture.images import orient
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
                stack.enter_context(
                    closing((_SeekableVideo if source.kind == "video" else READERS[source.kind])(source))
                )
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
    """Random access to a video; the time stamps show which frame a decoded one is, also after seeking."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._restart()

    def close(self) -> None:
        self._decoded.close()
        self._container.close()

    def read(self, k: int) -> Image | None:
        if not self._number <= k <= self._number + MAX_SEQUENTIAL_FRAMES:
            self.close()
            self._restart()
            self._seek(k)
        self._advance(k)
        frame = self._frame
        if self._number != k or frame is None or frame.is_corrupt:
            return None
        if (frame.width, frame.height) != self._source.coded_size:
            return None
        return orient(convert_frame(frame, VideoReformatter()), self._source.orientation)

    def _seek(self, k: int) -> None:
        """Seek to the keyframe before frame k if there is one, else to the start."""
        pts = self._source.pts
        if pts is None or not MAX_SEQUENTIAL_FRAMES < k < len(pts):
            return
        with suppress(av.error.FFmpegError):
            self._container.seek(pts[k], stream=self._stream)
            self._frame = next(self._decoded, None)
        if self._frame is not None and self._frame.pts is not None and self._frame.pts <= pts[k]:
            self._number = bisect_left(pts, self._frame.pts)
        else:
            self.close()
            self._restart()

    def _advance(self, k: int) -> None:
        """Decode up to frame k, or to a later one if it cannot be decoded."""
        while self._number < k:
            self._frame = next(self._decoded, None)
            if self._frame is None:
                self._number = self._source.n_frames
                return
            self._number += 1
            if self._source.pts is not None and self._frame.pts is not None:
                self._number = bisect_left(self._source.pts, self._frame.pts, lo=self._number)

    def _restart(self) -> None:
        self._container, self._stream = open_video(self._source.path)
        self._decoded = self._decode()
        self._number, self._frame = -1, cast(VideoFrame | None, None)  # the last one that was decoded

    def _decode(self) -> Generator[VideoFrame, None, None]:
        with suppress(av.error.FFmpegError):
            for packet in self._container.demux(self._stream):
                with suppress(av.error.InvalidDataError):
                    yield from packet.decode()
