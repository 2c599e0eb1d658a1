"""What the cameras saw at one instant, and where in it an object is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from sylpose.numerics.arrays import BoolArray, Image

__all__ = ["Box", "FrameSet"]


@dataclass(frozen=True)
class Box:
    """A region of an image as recorded (distorted): left, top, width, height in pixels."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, eq=False)
class FrameSet:
    """The images of all cameras at one instant, and the masks of one object or of several; tuples are in the rig's order.

    Attributes:
        index: the instant's number in the session.
        time: seconds: the mean of the cameras' time stamps, else index / rate, else the index itself.
        times: each camera's own time stamp, seconds; None without one.
        images: BGR (h, w, 3) as recorded; None for a camera that has no frame at this instant.
        masks: (h, w), True on the object, or on any of several; None without an image or the mask of one of them.
        object_masks: the same by object, where there are several with masks; see `of`.
    """

    index: int
    time: float
    times: tuple[float | None, ...]
    images: tuple[Image | None, ...]
    masks: tuple[BoolArray | None, ...]
    object_masks: Mapping[str, tuple[BoolArray | None, ...]] = field(default_factory=dict)

    def of(self, name: str) -> FrameSet:
        """These images with the masks of one object; this frame set itself where masks are not given by object.

        Raises:
            ValueError: masks are given of several objects, and this is none of them.
        """
        if not self.object_masks:
            return self
        if name not in self.object_masks:
            raise ValueError(f"no object {name!r} in the frame set ({', '.join(self.object_masks)})")
        return replace(self, masks=self.object_masks[name], object_masks={})
