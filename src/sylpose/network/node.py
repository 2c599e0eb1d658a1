"""One camera as a node: it sees its own images, tells the others numbers, and comes to the same poses as they do."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar, cast

import numpy as np

from sylpose.frames import Box, FrameSet
from sylpose.landmarks.alignment import FIRST_PX, Aligned, OneOfMany, Sights
from sylpose.methods import FEATURES, METHODS, features_of
from sylpose.network.codec import packed, unpacked
from sylpose.numerics.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.frame_solvers import SOLVERS
from sylpose.tracking.joint import Joint
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.team import Team
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
        refused: camera -> why its first word of no meaning was taken for nothing.
    """

    def __init__(self, camera: int, cameras: int, tell: Round) -> None:
        self._camera, self._cameras, self._tell = camera, cameras, tell
        self.refused: dict[int, str] = {}

    def each(self, do: Callable[[int], T], *, long: bool = False) -> list[T]:  # noqa: ARG002
        """See `Crew`."""
        mine = do(self._camera)
        return [mine if c == self._camera else cast(T, None) for c in range(self._cameras)]

    def ask(self, do: Callable[[int], T], nothing: T) -> list[T]:
        """See `Crew`."""
        return self._told(do(self._camera), nothing)

    def align(
        self, sights: Sequence[Sights], rotation: FloatArray, shift: FloatArray, first_px: float = FIRST_PX
    ) -> tuple[Aligned, list[tuple[FloatArray, FloatArray]]]:
        """See `Crew`."""
        found = OneOfMany(sights[self._camera], self._camera, self._told).align(rotation, shift, first_px)
        return found, self.each(lambda _: (found.weights[0], found.residuals[0]))

    def _told(self, mine: T, nothing: T, /) -> list[T]:
        heard = self._tell(packed(mine))
        return [self._read(c, heard.get(c), nothing) for c in range(self._cameras)]

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
    camera: int,
    rig: Rig,
    frames: Iterable[FrameSet],
    tell: Round,
    boxes: Mapping[str, Box] | None = None,
    *,
    method: str = METHODS[0],
    features: str = FEATURES[0],
    offsets: Mapping[str, float] | None = None,
    seed: int = 0,
) -> Iterator[TrackedFrame]:
    """`track`, by one camera that knows its own images alone; of the others' no use is made.

    Args:
        camera: its index in the rig.
        tell: one agreed round with the other cameras, each of which calls this with the same arguments.
        rig, frames, boxes, method, features, offsets, seed: as `track`.

    Raises:
        ValueError: as `track`.
    """
    follows = features_of(method, features) == "klt"
    parts = [cast(CameraPart, CameraPart(c, own) if c == camera else None) for c, own in enumerate(rig)]
    late = np.array([(offsets or {}).get(name, 0.0) for name in rig.names])
    team = Team(rig, parts, Node(camera, len(rig), tell), SOLVERS[method], follows, late, seed, method == METHODS[0])
    tracking = Tracking(team, Joint(ObjectModel.in_boxes(rig, boxes) if boxes else ObjectModel()))
    for frame in frames:
        images = tuple(image if c == camera else None for c, image in enumerate(frame.images))
        masks = tuple(mask if c == camera else None for c, mask in enumerate(frame.masks))
        yield from tracking.step(replace(frame, images=images, masks=masks))
    yield from tracking.flush()
