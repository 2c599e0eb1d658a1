"""One camera as a node: it sees its own images, tells the others numbers, and comes to the same poses as they do."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar, cast

from sylpose.frames import Box, FrameSet
from sylpose.landmarks.alignment import FIRST_PX, Aligned, OneOfMany, Sights
from sylpose.methods import FEATURES, METHODS
from sylpose.network.codec import packed, unpacked
from sylpose.numerics.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import Tracking

__all__ = ["Node", "track_by_node"]

T = TypeVar("T")

# Tells the others something, and returns what each of those told that take part, this camera included.
Round = Callable[[bytes], Mapping[int, bytes]]


class Node:
    """A crew of which one camera is here (`tracking.crew.Crew`).

    Args:
        camera: which one, of so many cameras of the rig.
        tell: one agreed round. What this camera told comes back with the others' words: it goes on with what they heard.

    Attributes:
        camera: as given.
        refused: camera -> why its first word of no meaning was taken for nothing.
    """

    def __init__(self, camera: int, cameras: int, tell: Round) -> None:
        self.camera, self.cameras, self._tell = camera, cameras, tell
        self.refused: dict[int, str] = {}

    def each(self, do: Callable[[int], T], *, long: bool = False) -> list[T]:  # noqa: ARG002
        """See `Crew`."""
        mine = do(self.camera)
        return [mine if c == self.camera else cast(T, None) for c in range(self.cameras)]

    def ask(self, do: Callable[[int], T], nothing: T) -> list[T]:
        """See `Crew`."""
        return self._told(do(self.camera), nothing)

    def align(
        self, sights: Sequence[Sights], rotation: FloatArray, shift: FloatArray, first_px: float = FIRST_PX
    ) -> tuple[Aligned, list[tuple[FloatArray, FloatArray]]]:
        """See `Crew`."""
        found = OneOfMany(sights[self.camera], self.camera, self._told).align(rotation, shift, first_px)
        return found, self.each(lambda _: (found.weights[0], found.residuals[0]))

    def _told(self, mine: T, nothing: T, /) -> list[T]:
        heard = self._tell(packed(mine))
        return [self._read(c, heard.get(c), nothing) for c in range(self.cameras)]

    def _read(self, camera: int, data: bytes | None, nothing: T) -> T:
        """What a camera told, as far as it means anything."""
        if data is None:
            return nothing
        try:
            return unpacked(data, nothing)
        except ValueError as error:
            self.refused.setdefault(camera, str(error))
            return nothing


def track_by_node(
    node: Node,
    rig: Rig,
    frames: Iterable[FrameSet],
    boxes: Mapping[str, Box] | None = None,
    *,
    method: str = METHODS[0],
    features: str = FEATURES[0],
    offsets: Mapping[str, float] | None = None,
    seed: int = 0,
) -> Iterator[TrackedFrame]:
    """`track`, by one camera that knows its own images alone; of the others' no use is made.

    Args:
        node: the camera among all of the rig, each of which calls this with the same other arguments.
        rig, frames, boxes, method, features, offsets, seed: as `track`.

    Raises:
        ValueError: as `track`.
    """
    parts = [cast(CameraPart, CameraPart(c, own) if c == node.camera else None) for c, own in enumerate(rig)]
    tracking = Tracking(rig, parts, node, boxes, method=method, features=features, offsets=offsets, seed=seed)
    for frame in frames:
        images = tuple(image if c == node.camera else None for c, image in enumerate(frame.images))
        masks = tuple(mask if c == node.camera else None for c, mask in enumerate(frame.masks))
        yield from tracking.step(replace(frame, images=images, masks=masks))
    yield from tracking.flush()
