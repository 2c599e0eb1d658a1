"""Where the object is in the images: a box per camera in the first frame, and masks."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from sylpose.capture.images import read_mask
from sylpose.capture.names import IMAGE_SUFFIXES, belongs_to, image_files, image_numbers
from sylpose.capture.sources import Source
from sylpose.rig import Rig

__all__ = ["Box", "Masks", "check_first_masks", "find_masks", "load_boxes"]


@dataclass(frozen=True)
class Box:
    """A region of an image as recorded (distorted): left, top, width, height in pixels."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, eq=False)
class Masks:
    """The masks of one camera: one for all frames, or files by frame number, or none at all."""

    static: NDArray[np.bool_] | None = None
    files: dict[int, Path] = field(default_factory=dict)


def load_boxes(path: Path, rig: Rig) -> dict[str, Box]:
    """Read boxes: TOML, `camera = [x, y, width, height]` for each camera that sees the object in the first frame.

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the camera: unknown, not four finite numbers, no area, or a box that is not inside the image.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of boxes")
    try:
        raw = msgspec.toml.decode(path.read_bytes(), type=dict[str, tuple[float, float, float, float]])
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: camera = [x, y, width, height] is expected ({error})") from None
    boxes = {}
    for name, camera in belongs_to(raw, rig.names, path).items():
        x, y, width, height = raw[name]
        image_width, image_height = rig[camera].size
        if not np.isfinite(raw[name]).all() or width <= 0 or height <= 0:
            raise ValueError(f"{path}: the box of {name} must be finite with a positive width and height")
        if min(x, y) < -1 or x + width > image_width + 1 or y + height > image_height + 1:
            raise ValueError(
                f"{path}: the box of {name} {list(raw[name])} is not inside the image of {image_width}x{image_height}"
            )
        left, top = max(x, 0.0), max(y, 0.0)
        boxes[camera] = Box(left, top, min(x + width, image_width) - left, min(y + height, image_height) - top)
    return {camera: boxes[camera] for camera in rig.names if camera in boxes}


def find_masks(folder: Path, rig: Rig, sources: tuple[Source, ...]) -> tuple[tuple[Masks, ...], list[str]]:
    """The masks of each camera in the rig's order, and what looks wrong with them.

    A camera has one image for all frames (`cam_0.png`), or a folder (`cam_0/`) of one image per frame with the frame's
    number in its name: the number in the image's name for image folders, counted from 0 for videos.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: naming the file or folder: no masks, no such camera, two for one camera, no usable numbers, another
            size than the image, an empty mask for all frames, or empty masks in the first frame that has any.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of masks")
    found = [
        f for f in sorted(folder.iterdir()) if f.name[0] != "." and (f.is_dir() or f.suffix.lower() in IMAGE_SUFFIXES)
    ]
    if not found:
        raise ValueError(f"{folder}: holds no masks, neither CAMERA.png nor CAMERA/FRAME.png")
    names = {entry: entry.name if entry.is_dir() else entry.stem for entry in found}
    matched = belongs_to(dict.fromkeys(names.values()), rig.names, folder)
    by_camera: dict[str, Path] = {}
    for entry in found:
        camera = matched[names[entry]]
        if camera in by_camera:
            raise ValueError(f"{folder}: {by_camera[camera].name} and {entry.name} are both for camera {camera}")
        by_camera[camera] = entry

    masks: list[Masks] = []
    warnings: list[str] = []
    for source in sources:
        mask_path = by_camera.get(source.camera)
        if mask_path is None:
            masks.append(Masks())
        elif mask_path.is_dir():
            masks.append(Masks(files=_numbered(mask_path, source, warnings)))
        else:
            static = read_mask(mask_path, source.size)
            if not static.any():
                raise ValueError(f"{mask_path}: the mask is empty; white is the object")
            masks.append(Masks(static))
    return tuple(masks), warnings


def check_first_masks(masks: tuple[Masks, ...], sources: tuple[Source, ...], frames: NDArray[np.int64]) -> None:
    """Read the masks of the first instant that has any.

    Args:
        frames: (n, C) which frame each camera shows at each instant, -1 for none.

    Raises:
        ValueError: naming the file of a wrong size, or the files when all of them are empty.
    """
    if not any(m.files for m in masks):
        return
    for row in frames:
        files = {
            source.camera: m.files[source.frame_number(int(k))]
            for m, source, k in zip(masks, sources, row, strict=True)
            if k >= 0 and source.frame_number(int(k)) in m.files
        }
        if files:
            sizes = {source.camera: source.size for source in sources}
            read = [read_mask(file, sizes[camera]) for camera, file in files.items()]
            if not any(mask.any() for mask in read) and all(m.static is None for m in masks):
                raise ValueError(f"{', '.join(map(str, files.values()))}: empty; white is the object")
            return


def _numbered(folder: Path, source: Source, warnings: list[str]) -> dict[int, Path]:
    files = image_files(folder)
    numbers = image_numbers(files)
    if numbers is None:
        raise ValueError(f"{folder}: masks with the frame's number in their names are expected")
    frames = set(range(source.n_frames) if source.numbers is None else source.numbers)
    unused = sorted(set(numbers) - frames)
    if len(unused) == len(numbers):
        raise ValueError(f"{folder}: no mask has the number of a frame ({min(frames)} to {max(frames)})")
    if unused:
        warnings.append(f"{folder}: {len(unused)} masks have no frame of their number, the first is {unused[0]}.")
    return dict(zip(numbers, files, strict=True))
