"""The cameras as the joint part sees them, wherever they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import Aligned, Sights, Start, align

__all__ = ["Alignment", "Crew", "OneProcess"]

T = TypeVar("T")

# A pose; by camera, each its own, (weights, residuals) of its sights.
Alignment = tuple[Aligned, list[tuple[FloatArray, FloatArray]]]


class Crew(Protocol):
    """What the joint part can have the cameras do. Each camera is named by its index in the rig.

    Every camera that takes part runs the same joint part with the same questions in the same order, so a question need not
    be sent: it is known what is asked. Answers are sent.
    """

    def each(self, do: Callable[[int], T], *, long: bool = False) -> list[T]:
        """Each camera does something with what is its own, and keeps what comes of it.

        Args:
            long: whether that takes milliseconds: cameras in one process do it side by side.

        Returns:
            by camera what came of it. Where a camera is elsewhere so is this: it may be handed on to that camera alone.
        """

    def ask(self, do: Callable[[int], T], nothing: T) -> list[T]:
        """Each camera tells all others something: `records`, or plain numbers and arrays.

        Args:
            nothing: what a camera says that sees nothing, and what is taken for the word of one that is not heard.

        Returns:
            by camera, in the rig's order, the same everywhere.
        """

    def align(self, sights: Sequence[Sights], starts: Sequence[Start]) -> list[Alignment]:
        """From each start the pose that all cameras' sights agree on best (`landmarks.alignment`).

        Args:
            sights: by camera, each its own.
        """


class OneProcess:
    """All cameras in one process, which work side by side in threads."""

    def __init__(self, cameras: int, workers: int) -> None:
        self._cameras = range(cameras)
        self._pool = ThreadPoolExecutor(workers)

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def each(self, do: Callable[[int], T], *, long: bool = False) -> list[T]:
        """See `Crew`. What is brief takes less time than handing it to a thread would."""
        return list(self._pool.map(do, self._cameras)) if long else [do(c) for c in self._cameras]

    def ask(self, do: Callable[[int], T], nothing: T) -> list[T]:  # noqa: ARG002
        """See `Crew`."""
        return [do(c) for c in self._cameras]

    def align(self, sights: Sequence[Sights], starts: Sequence[Start]) -> list[Alignment]:
        """See `Crew`."""
        found = [align(sights, *start) for start in starts]
        return [(one, list(zip(one.weights, one.residuals, strict=True))) for one in found]
