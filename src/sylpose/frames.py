"""What the cameras saw at one instant, and where in it an object is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sylpose.geometry.arrays import BoolArray, Image
from sylpose.geometry.validation import kind_of, number, shown
from sylpose.rig import Camera

__all__ = ["Box", "FrameSet", "check_frames"]


@dataclass(frozen=True)
class Box:
    """A region of an image as recorded (distorted): left, top, width, height in pixels.

    Raises:
        ValueError: naming what is no finite number.
    """

    x: float
    y: float
    width: float
    height: float

    def __post_init__(self) -> None:
        for name in ("x", "y", "width", "height"):
            number(getattr(self, name), name)


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


def check_frames(frames: Any, cameras: Iterable[Camera]) -> None:
    """That a frame set is of these cameras.

    Raises:
        TypeError, ValueError: naming what is wrong: another thing; not as many images or masks, or of another size or kind.
    """
    kind_of(frames, FrameSet, "frames")
    number(frames.time, "frames: time", most=np.inf)
    known = list(cameras)
    for name, given in (("images", frames.images), ("masks", frames.masks)):
        if len(kind_of(given, (tuple, list), f"frames: {name}")) != len(known):
            raise ValueError(
                f"frames: {len(given)} {name} for {len(known)} cameras; give one for each, in the rig's order"
            )
    for camera, image, mask in zip(known, frames.images, frames.masks, strict=True):
        size = camera.size[::-1]
        for what, array, kind in (("image", image, np.uint8), ("mask", mask, np.bool_)):
            if array is None:
                continue
            if not isinstance(array, np.ndarray) or array.dtype != kind or array.shape[:2] != size:
                wanted = f"{kind.__name__} of {size[0]} rows and {size[1]} columns"
                raise ValueError(f"frames: camera {camera.name}: the {what} must be {wanted}, got {shown(array)}")
            if array.shape[2:] not in ((3,), ()) or (what == "mask" and array.ndim != 2):
                raise ValueError(
                    f"frames: camera {camera.name}: the {what} must be (h, w, 3) or (h, w), got {shown(array)}"
                )
