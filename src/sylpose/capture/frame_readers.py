"""One camera's frames one after the other, with whatever is wrong with them said and not raised."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol

import av.error
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter

from sylpose.capture.boxes import Masks
from sylpose.capture.images import read_image, read_mask
from sylpose.capture.sources import Source, open_video
from sylpose.geometry.arrays import BoolArray, Image

__all__ = ["CameraReader", "Reading", "check_readable"]

# A jump of a video's own clock by more than this many frames is said: a recorder or a damaged file lost some (choice:
# a frame or two are not worth a word).
CLOCK_JUMP = 3.5


@dataclass(frozen=True, eq=False)
class Reading:
    """What one camera gives at one instant, masks by object; `ended` when it will not give anything any more."""

    image: Image | None
    masks: dict[str, BoolArray | None]
    problems: tuple[str, ...]
    ended: bool


class _Reader(Protocol):
    problems: list[str]
    ended: bool

    def read(self, k: int) -> Image | None: ...

    def close(self) -> None: ...


def check_readable(source: Source) -> None:
    """Read the first frame of a video.

    Raises:
        ValueError: naming a video none of whose frames can be read.
    """
    if source.kind == "video":
        with closing(_VideoReader(source)) as reader:
            reader.read(0)
        if reader.ended:
            raise ValueError(f"{source.path}: no frame of this video can be read")


class CameraReader:
    """The frames and masks of one camera, for increasing frame numbers; `masks` by object."""

    def __init__(self, source: Source, masks: Mapping[str, Masks]) -> None:
        self._source, self._masks = source, masks
        self._reader: _Reader = _VideoReader(source) if source.kind == "video" else _ImageReader(source)

    def read(self, k: int) -> Reading:
        """Frame k and its masks; a negative k reads nothing."""
        image = self._reader.read(k) if k >= 0 else None
        read = {name: None if image is None else self._mask(masks, k) for name, masks in self._masks.items()}
        problems, self._reader.problems = tuple(self._reader.problems), []
        return Reading(image, read, problems, self._reader.ended)

    def close(self) -> None:
        self._reader.close()

    def _mask(self, masks: Masks, k: int) -> BoolArray | None:
        file = masks.files.get(self._source.frame_number(k))
        if file is None:
            return masks.static
        try:
            return read_mask(file, self._source.size)
        except (ValueError, OSError) as error:
            self._reader.problems.append(f"{self._source.camera}: {error}; the frame has no mask.")
            return None


class _ImageReader:
    def __init__(self, source: Source) -> None:
        self._source = source
        self.problems: list[str] = []
        self.ended = False

    def read(self, k: int) -> Image | None:
        try:
            return read_image(self._source.files[k], self._source.size)
        except (ValueError, OSError) as error:
            self.problems.append(f"{self._source.camera}: {error}; this camera misses the frame.")
            return None

    def close(self) -> None:
        pass


class _VideoReader:
    def __init__(self, source: Source) -> None:
        self._source = source
        self.problems: list[str] = []
        self.ended = False
        self._container, self._stream = open_video(source.path)
        self._reformatter = VideoReformatter()
        self._frames = self._decode()
        self._position = 0
        self._time: float | None = None
        self._broken: str | None = None
        self._said: set[str] = set()

    def read(self, k: int) -> Image | None:
        frame = None
        while self._position <= k and not self.ended:
            frame = next(self._frames, None)
            if frame is None:
                self._end()
                return None
            self._check_clock(frame)
            self._position += 1
        return None if frame is None else self._convert(frame)

    def close(self) -> None:
        self._frames.close()
        self._container.close()

    def _decode(self) -> Generator[VideoFrame, None, None]:
        """All frames up to the first that cannot be read: frames after a gap of unknown length would be out of step."""
        try:
            for packet in self._container.demux(self._stream):
                if packet.is_corrupt:  # cut off by the end of the file
                    yield from self._stream.decode(None)
                    self._broken = "the file is cut or damaged there"
                    return
                yield from packet.decode()
        except av.error.FFmpegError as error:
            self._broken = error.strerror

    def _end(self) -> None:
        self.ended = True
        if self._broken or self._position < self._source.n_frames:
            self.problems.append(
                f"{self._source.camera}: {self._source.path.name} breaks off after {self._position} of "
                f"{self._source.n_frames} frames ({self._broken or 'the file ends'}); this camera gives no more."
            )

    def _convert(self, frame: VideoFrame) -> Image | None:
        where = f"{self._source.camera}: {self._source.path.name}, frame {self._position - 1}"
        if frame.is_corrupt:
            self._say("damaged", f"{where} is damaged and left out, and so are later ones that are.")
            return None
        if (frame.width, frame.height) != self._source.size:
            size = self._source.size
            self._say(
                "size",
                f"{where} is {frame.width}x{frame.height}, not {size[0]}x{size[1]}; it is left out, "
                "and so are later ones of another size.",
            )
            return None
        return np.asarray(self._reformatter.reformat(frame, format="bgr24").to_ndarray(), dtype=np.uint8)

    def _check_clock(self, frame: VideoFrame) -> None:
        if self._source.rate and self._time is not None and frame.time is not None:
            jump = frame.time - self._time
            if jump * self._source.rate > CLOCK_JUMP:
                self._say(
                    "clock",
                    f"{self._source.camera}: {self._source.path.name} jumps by {jump:.2f} s after frame "
                    f"{self._position - 1}: frames may be lost there; those after it are counted as they come.",
                )
        self._time = frame.time

    def _say(self, kind: str, sentence: str) -> None:
        """Said once per kind: a damaged recording can have thousands."""
        if kind not in self._said:
            self._said.add(kind)
            self.problems.append(sentence)
