"""Random access to single frames of a recording; `Session.frames` reads them sequentially."""

from __future__ import annotations

from contextlib import ExitStack, closing
from types import TracebackType
from typing import Self

from sylpose.geometry.arrays import Image
from sylpose.io.capture.frame_readers import READERS
from sylpose.io.capture.session import Session


class RandomAccessReader:
    """Random-access reader of a recording's images; a context manager, for one thread at a time.

    Raises:
        OSError, ValueError: a video can no longer be opened.
    """

    def __init__(self, session: Session) -> None:
        self._frames = session.timeline.frames
        with ExitStack() as stack:
            self._cameras = [stack.enter_context(closing(READERS[source.kind](source))) for source in session.sources]
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
            camera.problems.clear()  # an unreadable image is None, whatever the reason
        return images
