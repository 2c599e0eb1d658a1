"""Sequential readers of one camera's frames and masks, which report problems instead of raising."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import closing
from dataclasses import dataclass

import av.error
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter

from sylpose.geometry.arrays import BoolArray, Image
from sylpose.io.capture.boxes import Masks
from sylpose.io.capture.images import read_image, read_mask
from sylpose.io.capture.sources import Source, open_video

# Jumps of a video's timestamps by more than this many frames are reported: the recorder or a damaged file lost frames
# (choice: one or two frames are negligible).
MAX_CLOCK_JUMP_FRAMES = 3.5


@dataclass(frozen=True, eq=False)
class FrameReading:
    """One camera's image and masks (by object) in one frame set; `ended` after the camera's last frame."""

    image: Image | None
    masks: dict[str, BoolArray | None]
    problems: tuple[str, ...]
    ended: bool


class FrameReader:
    """Reader of one camera's frames: images of a folder in any order."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.problems: list[str] = []
        self.ended = False

    def read(self, k: int) -> Image | None:
        """Read image k of a folder; None if it is unreadable."""
        try:
            return read_image(self._source.files[k], self._source.size)
        except (ValueError, OSError) as error:
            self.problems.append(f"{self._source.camera}: {error}; this frame is missing.")
            return None

    def close(self) -> None:
        """Close the video; image files are not kept open."""


def check_readable(source: Source) -> None:
    """Check that the first frame of a video is readable.

    Raises:
        ValueError: no frame is readable; the message names the video.
    """
    if source.kind == "video":
        with closing(_VideoReader(source)) as reader:
            reader.read(0)
        if reader.ended:
            raise ValueError(f"{source.path}: no frame of this video is readable")


class CameraReader:
    """Reader of one camera's frames and masks (by object), for increasing frame numbers."""

    def __init__(self, source: Source, masks: Mapping[str, Masks]) -> None:
        self._source, self._masks = source, masks
        self._reader = _VideoReader(source) if source.kind == "video" else FrameReader(source)

    def read(self, k: int) -> FrameReading:
        """Read frame k and its masks; nothing for a negative k."""
        image = self._reader.read(k) if k >= 0 else None
        read = {name: None if image is None else self._mask(masks, k) for name, masks in self._masks.items()}
        problems, self._reader.problems = tuple(self._reader.problems), []
        return FrameReading(image, read, problems, self._reader.ended)

    def close(self) -> None:
        self._reader.close()

    def _mask(self, masks: Masks, k: int) -> BoolArray | None:
        file = masks.files.get(self._source.frame_number(k))
        if file is None:
            return masks.static
        try:
            return read_mask(file, self._source.size)
        except (ValueError, OSError) as error:
            self._reader.problems.append(f"{self._source.camera}: {error}; this frame has no mask.")
            return None


class _VideoReader(FrameReader):
    """Reader of a video's frames, by increasing numbers."""

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self._container, self._stream = open_video(source.path)
        self._reformatter = VideoReformatter()
        self._frames = self._decode()
        self._position = 0
        self._time: float | None = None
        self._failure: str | None = None
        self._reported_kinds: set[str] = set()

    def read(self, k: int) -> Image | None:
        frame = None
        while self._position <= k and not self.ended:
            frame = next(self._frames, None)
            if frame is None:
                self._finish()
                return None
            self._check_clock(frame)
            self._position += 1
        return None if frame is None else self._convert(frame)

    def close(self) -> None:
        self._frames.close()
        self._container.close()

    def _decode(self) -> Generator[VideoFrame, None, None]:
        """Decode all frames up to the first unreadable one: later frames would be out of sync by an unknown gap."""
        try:
            for packet in self._container.demux(self._stream):
                if packet.is_corrupt:  # truncated by the end of the file
                    yield from self._stream.decode(None)
                    self._failure = "the file is truncated or damaged there"
                    return
                yield from packet.decode()
        except av.error.FFmpegError as error:
            self._failure = error.strerror

    def _finish(self) -> None:
        self.ended = True
        if self._failure or self._position < self._source.n_frames:
            self.problems.append(
                f"{self._source.camera}: {self._source.path.name} is cut off after {self._position} of "
                f"{self._source.n_frames} frames ({self._failure or 'the file ends'}); this camera has no more frames."
            )

    def _convert(self, frame: VideoFrame) -> Image | None:
        where = f"{self._source.camera}: {self._source.path.name}, frame {self._position - 1}"
        if frame.is_corrupt:
            self._report_once("damaged", f"{where} is damaged; damaged frames are skipped.")
            return None
        if (frame.width, frame.height) != self._source.size:
            size = "{}x{}".format(*self._source.size)
            problem = f"is {frame.width}x{frame.height}, not {size}; frames of another size are skipped."
            self._report_once("size", f"{where} {problem}")
            return None
        return np.asarray(self._reformatter.reformat(frame, format="bgr24").to_ndarray(), dtype=np.uint8)

    def _check_clock(self, frame: VideoFrame) -> None:
        if self._source.rate and self._time is not None and frame.time is not None:
            jump = frame.time - self._time
            if jump * self._source.rate > MAX_CLOCK_JUMP_FRAMES:
                self._report_once(
                    "clock",
                    f"{self._source.camera}: {self._source.path.name} jumps by {jump:.2f} s after frame "
                    f"{self._position - 1}: frames may be lost there; later frames are numbered consecutively.",
                )
        self._time = frame.time

    def _report_once(self, kind: str, message: str) -> None:
        """Report a problem once per kind; a damaged recording can have thousands."""
        if kind not in self._reported_kinds:
            self._reported_kinds.add(kind)
            self.problems.append(message)
