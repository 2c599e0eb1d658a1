"""Small pictures of some frames of a run, spread evenly over it however long it turns out to be."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sylpose.frames import FrameSet
from sylpose.report.pictures import thumbnail
from sylpose.report.scene import Stills

__all__ = ["FEWEST", "Album", "step_after"]

# So many frames are kept at least, where there are as many, and below twice as many (choice: one a second or two of a usual
# recording).
FEWEST = 24


class Album:
    """Keeps every frame at first, and every second one of what there is whenever it has twice as many as it should.

    What is kept depends on how many frames there were, and on nothing else.

    Args:
        cameras: how many.
    """

    def __init__(self, cameras: int) -> None:
        self._cameras = cameras
        self._step = 1
        self._kept: list[tuple[int, tuple[bytes | None, ...]]] = []
        self._position = 0

    def put(self, frames: FrameSet) -> None:
        """The next frame of the run."""
        if self._position % self._step == 0:
            self._kept.append((frames.index, tuple(thumbnail(image, self._cameras) for image in frames.images)))
        self._position += 1
        if len(self._kept) == 2 * FEWEST:
            self._kept, self._step = self._kept[::2], 2 * self._step

    def go_on(self, position: int, again: Iterable[FrameSet]) -> None:
        """As if the first `position` frames of a run had been put in.

        Args:
            again: every `step_after(position)`-th of them.
        """
        self._step = step_after(position)
        for frames in again:
            self._kept.append((frames.index, tuple(thumbnail(image, self._cameras) for image in frames.images)))
        self._position = position

    def stills(self) -> Stills:
        """What there is by now."""
        index = np.array([number for number, _ in self._kept], np.int64)
        return Stills(index, tuple(images for _, images in self._kept))


def step_after(position: int) -> int:
    """Of so many frames every how many-th is kept."""
    step = 1
    while -(-position // step) >= 2 * FEWEST:
        step *= 2
    return step
