"""Frame sets: the images of all cameras at one timestamp, with masks of the object."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sylpose.geometry.arrays import BoolArray, Image
from sylpose.geometry.validation import check_number, check_sequence, check_type, format_value
from sylpose.rig import Camera

# Index of frame sets without a number of their own; the tracker numbers them consecutively.
UNNUMBERED = -1


@dataclass(frozen=True)
class Box:
    """Region of an image as recorded (distorted): left, top, width, height in pixels.

    Raises:
        ValueError: naming the value that is not a finite number.
    """

    x: float
    y: float
    width: float
    height: float

    def __post_init__(self) -> None:
        for name in ("x", "y", "width", "height"):
            check_number(getattr(self, name), name)


@dataclass(frozen=True, eq=False)
class FrameSet:
    """Images of all cameras at one timestamp, with object masks.

    Tuples are in the rig's order.

    Attributes:
        index: number of the timestamp in the session; -1: the tracker numbers the frames consecutively.
        time: seconds; the mean of the cameras' time stamps, else index / rate, else the index itself.
        times: each camera's time stamp, seconds; None without one.
        images: BGR (h, w, 3) as recorded; None for a camera without a frame at this timestamp.
        masks: (h, w), True on the object, or on any of several; None without an image, or if one object's mask is
            missing.
        object_masks: masks by object, where there are several with masks; see `for_object`.
        interval: seconds between the frames of a live camera, whether they were dropped or not; NaN if unknown.
    """

    index: int
    time: float
    times: tuple[float | None, ...]
    images: tuple[Image | None, ...]
    masks: tuple[BoolArray | None, ...]
    object_masks: Mapping[str, tuple[BoolArray | None, ...]] = field(default_factory=dict)
    interval: float = math.nan

    @classmethod
    def of(
        cls,
        images: Sequence[Image | None],
        time: float,
        masks: Sequence[BoolArray | None] | None = None,
        interval: float = math.nan,
    ) -> FrameSet:
        """Make a frame set of images in memory, taken at one time.

        Args:
            images: per camera, in the rig's order: (h, w, 3) BGR or (h, w), uint8, as recorded; None without an image.
            time: seconds.
            masks: per camera: (h, w) bool, True on the object, or None; None without any masks.
            interval: seconds between the frames of live cameras, which limits the time of a search; NaN: no limit.

        Raises:
            TypeError, ValueError: naming the argument: not a sequence of images or masks, or not one mask for each image;
                a time that is not finite, an interval that is not positive.
        """
        check_number(time, "time", maximum=np.inf)
        if not np.isnan(interval):
            check_number(interval, "interval", above=0.0)
        description = "list with one image for each camera"
        if getattr(images, "ndim", 4) < 4:  # an image, whose rows would count as images
            raise TypeError(f"images must be a {description}, got {format_value(images)}")
        of_images = check_sequence(images, "images", description=description)
        n = len(of_images)
        of_masks = [None] * n if masks is None else check_sequence(masks, "masks", n, "images")
        for name, arrays, dtype in (("images", of_images, np.uint8), ("masks", of_masks, np.bool_)):
            for k, array in enumerate(arrays):
                if array is not None and not (isinstance(array, np.ndarray) and array.dtype == dtype):
                    raise ValueError(f"{name}[{k}] must be an array of {dtype.__name__}, got {format_value(array)}")
        return cls(UNNUMBERED, float(time), (None,) * n, tuple(of_images), tuple(of_masks), interval=float(interval))

    def for_object(self, name: str) -> FrameSet:
        """Return these images with the masks of one object.

        Without masks by object, return the frame set itself.

        Raises:
            ValueError: masks are given by object, but not for this one.
        """
        if not self.object_masks:
            return self
        if name not in self.object_masks:
            raise ValueError(f"no object {name!r} in the frame set ({', '.join(self.object_masks)})")
        return replace(self, masks=self.object_masks[name], object_masks={})


def check_frame_set(frames: Any, cameras: Iterable[Camera]) -> None:
    """Check that a frame set fits these cameras.

    Raises:
        TypeError, ValueError: naming the error: not a frame set, or a wrong number, size or type of times, images or masks.
    """
    check_type(frames, FrameSet, "frames")
    check_number(frames.time, "frames: time", maximum=np.inf)
    camera_list = list(cameras)
    for name, parts in (("images", frames.images), ("times", frames.times), ("masks", frames.masks)):
        if len(check_type(parts, (tuple, list), f"frames: {name}")) != len(camera_list):
            raise ValueError(
                f"frames: {len(parts)} {name} for {len(camera_list)} cameras; give one for each, in the rig's order"
            )
    for camera, time in zip(camera_list, frames.times, strict=True):
        if time is not None:
            check_number(time, f"frames: camera {camera.name}: time", maximum=np.inf)
    for camera, image, mask in zip(camera_list, frames.images, frames.masks, strict=True):
        size = camera.size[::-1]
        for noun, array, dtype in (("image", image, np.uint8), ("mask", mask, np.bool_)):
            if array is None:
                continue
            if not isinstance(array, np.ndarray) or array.dtype != dtype or array.shape[:2] != size:
                expected = f"{dtype.__name__} of {size[0]} rows and {size[1]} columns"
                raise ValueError(
                    f"frames: camera {camera.name}: the {noun} must be {expected}, got {format_value(array)}"
                )
            if array.shape[2:] not in ((3,), ()) or (noun == "mask" and array.ndim != 2):
                raise ValueError(
                    f"frames: camera {camera.name}: the {noun} must be (h, w, 3) or (h, w), got {format_value(array)}"
                )
