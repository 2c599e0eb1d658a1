"""Where the objects are in the images: a box per camera in the first frame, and masks."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sylpose.capture.images import read_mask
from sylpose.capture.names import IMAGE_SUFFIXES, belongs_to, image_files, image_numbers, match_names
from sylpose.capture.sources import Source
from sylpose.frames import Box
from sylpose.geometry.arrays import BoolArray, IntArray
from sylpose.input_limits import parsed_toml, text_of, told
from sylpose.rig import Rig

__all__ = ["UNNAMED", "Masks", "boxes_in", "check_first_masks", "find_masks", "load_boxes", "object_names"]

# The name of the only object where none is given.
UNNAMED = "object"


@dataclass(frozen=True, eq=False)
class Masks:
    """The masks of one object in one camera: one for all frames, or files by frame number, or none at all."""

    static: BoolArray | None = None
    files: dict[int, Path] = field(default_factory=dict)


def object_names(
    boxes: Mapping[str, object], masks: Mapping[str, object], boxes_path: Path | None, masks_path: Path | None
) -> tuple[str, ...]:
    """The names of a session's objects, in the order of the boxes, else of the masks; `UNNAMED` without either.

    Args:
        boxes, masks: by object; empty for none.

    Raises:
        ValueError: boxes and masks of different objects.
    """
    if boxes and masks and set(boxes) != set(masks):
        raise ValueError(
            f"{boxes_path} has boxes of {', '.join(boxes)}, but {masks_path} has masks of {', '.join(masks)}: both must "
            f"be of the same objects (one without a name is called {UNNAMED})"
        )
    return tuple(boxes or masks) or (UNNAMED,)


def load_boxes(path: Path, rig: Rig) -> dict[str, dict[str, Box]]:
    """Read boxes: TOML, `camera = [x, y, width, height]` for each camera that sees the object in the first frame.

    For several objects the same in a table per object, `[mug]`.

    Returns:
        Boxes by object and camera, the objects in the file's order, `UNNAMED` for one without a table; empty for an
        empty file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming object and camera: a camera that is unknown, not four finite numbers, no area, or a box that
            is not inside the image; boxes in and outside of tables; an object's name that is no name or has no boxes.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file of boxes")
    return boxes_in(text_of(path), rig, path)


def boxes_in(text: str, rig: Rig, path: Path) -> dict[str, dict[str, Box]]:
    """The same from a text: what is in a file, or will be.

    Raises:
        ValueError: as `load_boxes`.
    """
    with told(path):
        return _boxes_in(text, rig, path)


def _boxes_in(text: str, rig: Rig, path: Path) -> dict[str, dict[str, Box]]:
    try:
        raw = parsed_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"cannot be read as TOML ({error})") from None
    tables = [name for name, value in raw.items() if isinstance(value, dict)]
    if not tables:
        return {UNNAMED: _read_boxes(raw, rig, str(path))} if raw else {}
    outside = [name for name, value in raw.items() if not isinstance(value, dict)]
    if outside:
        raise ValueError(
            f"{path}: {', '.join(outside)} stands outside of the tables of {', '.join(tables)}: either one object without "
            "tables or one table per object is expected"
        )
    _check_names(tables, rig, path)
    for name in tables:
        if not raw[name]:
            raise ValueError(f"{path}: [{name}] has no box in any camera")
    return {name: _read_boxes(raw[name], rig, f"{path}: [{name}]") for name in tables}


def find_masks(folder: Path, rig: Rig, sources: tuple[Source, ...]) -> tuple[dict[str, tuple[Masks, ...]], list[str]]:
    """The masks by object, for each camera in the rig's order, and what looks wrong with them.

    A camera has one image for all frames (`cam_0.png`), or a folder (`cam_0/`) of one image per frame with the frame's
    number in its name: the number in the image's name for image folders, counted from 0 for videos. For several objects
    the same in a folder per object, whose name is no camera's.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: naming the file or folder: no masks, no such camera, two for one camera, folders of cameras and of
            objects side by side, an object's name that is no name, no usable numbers, another size than the image, an
            empty mask for all frames.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of masks")
    warnings: list[str] = []
    objects = _object_folders(folder, rig)
    if not objects:
        return {UNNAMED: _find_object(folder, rig, sources, warnings)}, warnings
    _check_names([f.name for f in objects], rig, folder)
    for each in objects:
        # Frames' numbers would pass for cameras' names: `cam_8/0000.png` is no mask of cam_0 of an object cam_8.
        frames = [f.name for f in _entries(each) if f.is_file() and f.stem.isdigit() and f.stem not in rig.names]
        if frames:
            raise ValueError(
                f"{each}: neither a camera of the calibration ({', '.join(rig.names)}) nor an object, whose masks would be "
                f"named like cameras, not {frames[0]}"
            )
    return {f.name: _find_object(f, rig, sources, warnings) for f in objects}, warnings


def check_first_masks(masks: tuple[Masks, ...], sources: tuple[Source, ...], frames: IntArray) -> None:
    """Read one object's masks up to the first instant at which it is in any: it may come later.

    Args:
        masks: one per camera.
        frames: (n, C) which frame each camera shows at each instant, -1 for none.

    Raises:
        ValueError: naming the file of a wrong size, or the first files when all of them are empty.
    """
    if not any(m.files for m in masks):
        return
    seen = any(m.static is not None for m in masks)
    first: list[Path] = []
    for row in frames:
        read = []
        for m, source, k in zip(masks, sources, row.tolist(), strict=True):
            file = m.files.get(source.frame_number(k)) if k >= 0 else None
            if file is not None:
                read.append(file)
                seen |= bool(read_mask(file, source.size).any())
        first = first or read
        if read and seen:
            return
    if first:
        raise ValueError(f"{', '.join(map(str, first))}: empty, as all that follow; white is the object")


def _read_boxes(raw: Mapping[str, Any], rig: Rig, where: str) -> dict[str, Box]:
    """One object's boxes by camera, in the rig's order."""
    boxes = {}
    for name, camera in belongs_to(raw, rig.names, where).items():
        try:
            x, y, width, height = msgspec.convert(raw[name], tuple[float, float, float, float])
        except msgspec.ValidationError as error:
            raise ValueError(f"{where}: {name} = [x, y, width, height] is expected ({error})") from None
        image_width, image_height = rig[camera].size
        if not np.isfinite([x, y, width, height]).all() or width <= 0 or height <= 0:
            raise ValueError(f"{where}: the box of {name} must be finite with a positive width and height")
        if min(x, y) < -1 or x + width > image_width + 1 or y + height > image_height + 1:
            raise ValueError(
                f"{where}: the box of {name} {raw[name]} is not inside the image of {image_width}x{image_height}"
            )
        left, top = max(x, 0.0), max(y, 0.0)
        boxes[camera] = Box(left, top, min(x + width, image_width) - left, min(y + height, image_height) - top)
    return {camera: boxes[camera] for camera in rig.names if camera in boxes}


def _check_names(names: Sequence[str], rig: Rig, where: Path) -> None:
    """That names of objects can be names of files, on any system, and are no cameras'."""
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise ValueError(f"{where}: an object's name is made of letters, digits, - and _, got {name!r}")
        if match_names([name], rig.names):
            raise ValueError(f"{where}: the object {name} has a camera's name ({', '.join(rig.names)})")
    lower: dict[str, str] = {}
    for name in names:
        if (other := lower.setdefault(name.lower(), name)) != name:
            raise ValueError(f"{where}: the objects {other} and {name} differ in capital letters only")


def _entries(folder: Path) -> list[Path]:
    """What may be masks: folders and images."""
    files = sorted(folder.iterdir())
    return [f for f in files if f.name[0] != "." and (f.is_dir() or f.suffix.lower() in IMAGE_SUFFIXES)]


def _name(entry: Path) -> str:
    return entry.name if entry.is_dir() else entry.stem


def _is_camera(entry: Path, rig: Rig) -> bool:
    """Named like a camera, and not only as frames' numbers are."""
    name = _name(entry)
    return not name.isdigit() and (name in rig.names or (entry.is_dir() and bool(match_names([name], rig.names))))


def _match(entries: Iterable[Path], rig: Rig, folder: Path) -> dict[str, str]:
    try:
        return match_names(dict.fromkeys(map(_name, entries)), rig.names)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from None


def _object_folders(folder: Path, rig: Rig) -> list[Path]:
    """The folders of objects in a folder of masks; none where its entries are named like cameras, or are images."""
    entries = _entries(folder)
    matched = _match(entries, rig, folder)
    others = [f for f in entries if _name(f) not in matched]
    for f in entries:
        inside = [g.name for g in _entries(f) if _is_camera(g, rig)] if f.is_dir() and f not in others else []
        if inside:
            raise ValueError(
                f"{f}: named like camera {matched[f.name]}, but with {', '.join(inside)} in it, as in the folder of an "
                "object: name it like no camera"
            )
    if not others or not all(f.is_dir() for f in others):
        return []
    if len(others) < len(entries):
        cameras = ", ".join(f.name for f in entries if f not in others)
        raise ValueError(
            f"{folder}: {', '.join(f.name for f in others)} is no camera of the calibration ({', '.join(rig.names)}), and "
            f"{cameras} beside it is no folder of an object: either all are named like cameras or all are objects"
        )
    return others


def _find_object(folder: Path, rig: Rig, sources: tuple[Source, ...], warnings: list[str]) -> tuple[Masks, ...]:
    """One object's masks, one per camera."""
    found = _entries(folder)
    if not found:
        raise ValueError(f"{folder}: holds no masks, neither CAMERA.png nor CAMERA/FRAME.png")
    matched = belongs_to(dict.fromkeys(map(_name, found)), rig.names, folder)
    by_camera: dict[str, Path] = {}
    for entry in found:
        camera = matched[_name(entry)]
        if camera in by_camera:
            raise ValueError(f"{folder}: {by_camera[camera].name} and {entry.name} are both for camera {camera}")
        by_camera[camera] = entry

    masks: list[Masks] = []
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
    return tuple(masks)


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
