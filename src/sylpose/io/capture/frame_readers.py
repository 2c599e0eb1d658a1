"""Readers of one camera's frames and masks, in any order, which report problems instead of raising."""

from __future__ import annotations

import sys
from bisect import bisect_left
from collections.abc import Generator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import cast

import av.error
import cv2
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter

from sylpose.geometry.arrays import BoolArray, Image
from sylpose.io.capture.boxes import Masks
from sylpose.io.capture.images import orient, read_image, read_mask, reduce_depth
from sylpose.io.capture.page_stacks import PageStack
from sylpose.io.capture.sources import Source, open_video

# Packets in a row that cannot be decoded, after which a video is not read on (choice: several seconds).
MAX_UNDECODABLE = 250
# Up to this many frames ahead are decoded sequentially instead of seeking to a key frame (choice).
MAX_SEQUENTIAL_FRAMES = 40
# Frames by which a frame is decoded before it is shown, at most (H.264, A.3.1; H.265, A.4.2: 16 decoded pictures).
MAX_REORDERED_FRAMES = 16


@dataclass(frozen=True, eq=False)
class FrameReading:
    """One camera's image and masks (by object) in one frame set; `ended` after the camera's last frame."""

    image: Image | None
    masks: dict[str, BoolArray | None]
    problems: tuple[str, ...]
    ended: bool


class FrameReader:
    """Reader of one camera's frames in any order: here, images of a folder."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.problems: list[str] = []
        self.ended = False

    def read(self, k: int) -> Image | None:
        """Read image k of a folder; None if it is unreadable."""
        try:
            return read_image(self._source.files[k], self._source.size, self._source.orientation)
        except (ValueError, OSError) as error:
            self.problems.append(f"{self._source.camera}: {error}; this frame is missing.")
            return None

    def close(self) -> None:
        """Close the video or the page stack; image files are not kept open."""


class StackReader(FrameReader):
    """Reader of the pages of a stack in any order."""

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self._stack = PageStack(source.path)

    def read(self, k: int) -> Image | None:
        """Read page k; None if it is unreadable."""
        try:
            return self._stack.read(k)
        except ValueError as error:
            self.problems.append(f"{self._source.camera}: {error}; this frame is missing.")
            return None

    def close(self) -> None:
        """Close the page stack."""
        self._stack.close()


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


def convert_frame(frame: VideoFrame, reformatter: VideoReformatter) -> Image:
    """Convert a decoded frame to BGR (h, w, 3).

    Gray frames of 16 bits, which cameras of 10 to 14 bits write, are scaled as `read_image` does. Of interlaced frames,
    whose two fields show different moments, the upper field is used, and interpolated in between.
    """
    if frame.format.name in ("gray16le", "gray16be"):
        gray = reduce_depth(np.asarray(frame.reformat(format="gray16le").to_ndarray(), dtype=np.uint16))
        image = np.repeat(gray[:, :, None], 3, axis=2)
    else:
        image = np.asarray(reformatter.reformat(frame, format="bgr24").to_ndarray(), dtype=np.uint8)
    if frame.interlaced_frame:
        upper, lower = image[::2], image[1::2]
        following = np.concatenate([upper[1:], upper[-1:]])[: len(lower)]
        image = image.copy()
        image[1::2] = cv2.addWeighted(upper[: len(lower)], 0.5, following, 0.5, 0.0)
    return image


class CameraReader:
    """Reader of one camera's frames and masks (by object), for increasing frame numbers."""

    def __init__(self, source: Source, masks: Mapping[str, Masks]) -> None:
        self._source, self._masks = source, masks
        self._reader = READERS[source.kind](source)

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
    """Reader of a video's frames in any order. The time stamps show which one a decoded frame is, also after seeking."""

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self._reformatter = VideoReformatter()
        self._reported_kinds: set[str] = set()
        self._max_ahead = MAX_SEQUENTIAL_FRAMES  # more where seeking does not help
        self._open()

    def _open(self) -> None:
        self._container, self._stream = open_video(self._source.path)
        self._frames, self.ended = self._decode(), False
        self._number, self._frame = -1, cast(VideoFrame | None, None)  # the last one that was decoded
        self._previous = -1  # the one that was decoded before; those between them are damaged
        self._failure: str | None = None

    def read(self, k: int) -> Image | None:
        if self.ended and k > self._number:
            return None
        if not self._previous < k <= self._number + self._max_ahead:
            self._seek(k)
        while not self.ended and self._number < k:
            decoded = next(self._frames, None)
            if decoded is None:
                self._finish()
                return None
            self._previous, (self._number, self._frame) = self._number, decoded
        if self._number < k:
            return None
        if self._number > k or self._frame is None or self._frame.is_corrupt:
            where = f"{self._source.camera}: {self._source.path.name}, frame {k}"
            self._report_once("damaged", f"{where} is damaged; damaged frames are skipped.")
            return None
        return self._convert(k, self._frame)

    def _seek(self, k: int) -> None:
        """Continue at the last key frame before frame k, unless the present frame is between them."""
        number, pts, index, key = self._number, self._source.pts, self._stream.index_entries, -1
        if pts is not None and MAX_REORDERED_FRAMES < k < len(pts):
            # An index has decoding times, in some containers of a few frames only, or of none before the first seek.
            key = index.search_timestamp(pts[k - MAX_REORDERED_FRAMES]) if len(index) >= len(pts) else k
        if k > number and key <= max(number, 0):
            return
        self.close()
        self._open()
        if pts is None or key <= 0:
            return
        with suppress(av.error.FFmpegError):
            self._container.seek(pts[k - MAX_REORDERED_FRAMES], stream=self._stream)
            self._number, self._frame = next(self._frames, (k + 1, None))
        self._previous = self._number - 1
        is_found = self._frame is not None and self._frame.key_frame and self._number <= k
        if k > number and not (is_found and self._number > number):
            # It did not help; only seek farther ahead in this video, or no more if it cannot be sought in.
            self._max_ahead = k - self._number if is_found else sys.maxsize
        if not is_found:
            self.close()
            self._open()

    def close(self) -> None:
        self._frames.close()
        self._container.close()

    def _decode(self) -> Generator[tuple[int, VideoFrame], None, None]:
        """Decode all frames, with their numbers.

        Packets that cannot be decoded are skipped if the time stamps show which frames are missing, together with the
        frames up to the next keyframe, which are predicted from them.
        """
        n_bad, number, is_broken, is_intra = 0, -1, False, self._stream.codec_context.codec.intra_only
        packets = self._container.demux(self._stream)
        while n_bad <= MAX_UNDECODABLE:
            try:
                packet = next(packets, None)
                if packet is None:
                    broken = f"frame {self._number + 1} is damaged, and the later ones are predicted from it"
                    self._failure = broken if is_broken else None
                    return
                is_bad = packet.is_corrupt  # truncated by the end of the file, or lost in transmission
                frames = self._stream.decode(None) if is_bad and self._source.pts is None else packet.decode()
            except av.error.InvalidDataError as error:
                is_bad, frames, self._failure = True, [], error.strerror
            except av.error.FFmpegError as error:
                self._failure = error.strerror
                return
            n_bad = n_bad + 1 if is_bad else 0
            for frame in frames if self._source.pts is None or not is_bad else ():
                last, number = number, self._find_number(frame, number + 1)
                is_broken = (is_broken or number > last + 1) and not (is_intra or frame.key_frame)
                if not is_broken:
                    yield number, frame
                is_broken |= frame.is_corrupt and not is_intra
            if is_bad and self._source.pts is None:
                self._failure = self._failure or "the file is truncated or damaged there"
                return

    def _find_number(self, frame: VideoFrame, first: int) -> int:
        """Return the number of a decoded frame: the next one with its time stamp or a later one, from `first` on."""
        if self._source.pts is None or frame.pts is None:
            return first
        return bisect_left(self._source.pts, frame.pts, lo=min(first, len(self._source.pts)))

    def _finish(self) -> None:
        self.ended = True
        n_read = self._number + 1
        if self._failure or n_read < self._source.n_frames:
            self._report_once(
                "cut off",
                f"{self._source.camera}: {self._source.path.name} is cut off after {n_read} of "
                f"{self._source.n_frames} frames ({self._failure or 'the file ends'}); this camera has no more frames.",
            )

    def _convert(self, k: int, frame: VideoFrame) -> Image | None:
        where = f"{self._source.camera}: {self._source.path.name}, frame {k}"
        if (frame.width, frame.height) != self._source.coded_size:
            size = "{}x{}".format(*self._source.coded_size)
            problem = f"is {frame.width}x{frame.height}, not {size}; frames of another size are skipped."
            self._report_once("size", f"{where} {problem}")
            return None
        return orient(convert_frame(frame, self._reformatter), self._source.orientation)

    def _report_once(self, kind: str, message: str) -> None:
        """Report a problem once per kind; a damaged recording can have thousands."""
        if kind not in self._reported_kinds:
            self._reported_kinds.add(kind)
            self.problems.append(message)


# Readers by the kind of source.
READERS: dict[str, type[FrameReader]] = {"video": _VideoReader, "images": FrameReader, "pages": StackReader}
