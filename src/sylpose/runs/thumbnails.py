"""Thumbnails of some frames of a run, evenly spread for any length of the run."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sylpose.frames import FrameSet
from sylpose.report.pictures import encode_thumbnail
from sylpose.report.scene import Thumbnails

__all__ = ["MIN_THUMBNAILS", "ThumbnailAlbum", "thumbnail_step"]

# Smallest number of frames that are kept, if the run has as many; at most twice as many (choice: one per second or two
# of a usual recording).
MIN_THUMBNAILS = 24


class ThumbnailAlbum:
    """Collection of thumbnails that drops every second frame whenever it has twice the intended number.

    The kept frames depend only on the number of frames.

    Args:
        cameras: number of cameras.
    """

    def __init__(self, cameras: int) -> None:
        self._cameras = cameras
        self._step = 1
        self._kept: list[tuple[int, tuple[bytes | None, ...]]] = []
        self._position = 0

    def put(self, frames: FrameSet) -> None:
        """Add the next frame of the run."""
        if self._position % self._step == 0:
            self._kept.append((frames.index, tuple(encode_thumbnail(image, self._cameras) for image in frames.images)))
        self._position += 1
        if len(self._kept) == 2 * MIN_THUMBNAILS:
            self._kept, self._step = self._kept[::2], 2 * self._step

    def restore(self, position: int, frames_kept: Iterable[FrameSet]) -> None:
        """Restore the state after the first `position` frames of a run.

        Args:
            position: number of frames.
            frames_kept: every `thumbnail_step(position)`-th of them.
        """
        self._step = thumbnail_step(position)
        for frames in frames_kept:
            self._kept.append((frames.index, tuple(encode_thumbnail(image, self._cameras) for image in frames.images)))
        self._position = position

    def stills(self) -> Thumbnails:
        """Return the thumbnails kept so far."""
        index = np.array([number for number, _ in self._kept], np.int64)
        return Thumbnails(index, tuple(images for _, images in self._kept))


def thumbnail_step(position: int) -> int:
    """Return the spacing of the frames kept after `position` frames."""
    step = 1
    while -(-position // step) >= 2 * MIN_THUMBNAILS:
        step *= 2
    return step
