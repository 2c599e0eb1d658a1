"""Object regions: a bounding box per camera in the first frame set, and masks."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sylpose.frames import Box
from sylpose.geometry.arrays import BoolArray, IntArray
from sylpose.input_limits import input_errors, parse_toml, read_text
from sylpose.io.capture.images import read_mask
from sylpose.io.capture.names import (
    IMAGE_SUFFIXES,
    image_files,
    image_numbers,
    invert_unique,
    match_all_names,
    match_names,
)
from sylpose.io.capture.sources import Source
from sylpose.rig import Rig

# Name of a single unnamed object.
DEFAULT_OBJECT_NAME = "object"


@dataclass(frozen=True, eq=False)
class Masks:
    """Masks of one object in one camera: one static mask, files by frame number, or none."""

    static: BoolArray | None = None
    files: dict[int, Path] = field(default_factory=dict)


def merge_object_names(
    boxes: Mapping[str, object], masks: Mapping[str, object], boxes_path: Path | None, masks_path: Path | None
) -> tuple[str, ...]:
    """Return the object names of a session, in the order of the boxes or else of the masks.

    Args:
        boxes, masks: by object; empty for none.
        boxes_path, masks_path: their files, named in messages.

    Returns:
        The names; `DEFAULT_OBJECT_NAME` without boxes and masks.

    Raises:
        ValueError: boxes and masks are of different objects.
    """
    if boxes and masks and set(boxes) != set(masks):
        raise ValueError(
            f"{boxes_path} has boxes of {', '.join(boxes)}, but {masks_path} has masks of {', '.join(masks)}: both "
            f"must contain the same objects (an unnamed object is called {DEFAULT_OBJECT_NAME})"
        )
    return tuple(boxes or masks) or (DEFAULT_OBJECT_NAME,)


def load_boxes(path: Path, rig: Rig, others: Sequence[str] = ()) -> dict[str, dict[str, Box]]:
    """Read boxes: TOML, `camera = [x, y, width, height]` for each camera that sees the object in the first frame.

    Several objects have one table each, such as `[mug]`.

    Args:
        path: the file.
        rig: the cameras.
        others: names of cameras that are excluded, whose boxes are ignored.

    Returns:
        Boxes by object and camera, the objects in the file's order, `DEFAULT_OBJECT_NAME` for one without a table;
        empty for an empty file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown camera, not four finite numbers, no area, a box outside the image, boxes both inside and
            outside tables, an invalid object name, or an object without boxes; the message names object and camera.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file of boxes")
    return parse_boxes(read_text(path), rig, path, others)


def parse_boxes(text: str, rig: Rig, path: Path, others: Sequence[str] = ()) -> dict[str, dict[str, Box]]:
    """Parse boxes from TOML text, as `load_boxes`; `path` is named in messages.

    Raises:
        ValueError: as `load_boxes`.
    """
    with input_errors(path):
        raw = parse_toml(text)
        tables = [name for name, value in raw.items() if isinstance(value, dict)]
        if not tables:
            return {DEFAULT_OBJECT_NAME: _convert_boxes(raw, rig, others, str(path))} if raw else {}
        if outside := [name for name in raw if name not in tables]:
            raise ValueError(
                f"{path}: {', '.join(outside)} is outside the tables of {', '.join(tables)}: either one object without "
                "tables or one table per object is expected"
            )
        _check_object_names(tables, [*rig.names, *others], path)
        if empty := [name for name in tables if not raw[name]]:
            raise ValueError(f"{path}: [{empty[0]}] has no box in any camera")
        return {name: _convert_boxes(raw[name], rig, others, f"{path}: [{name}]") for name in tables}


def find_masks(
    folder: Path, cameras: Sequence[str], sources: tuple[Source, ...]
) -> tuple[dict[str, tuple[Masks, ...]], list[str]]:
    """Find the masks of all objects.

    A camera has one image for all frames (`cam_0.png`), or a folder (`cam_0/`) of one image per frame with the frame
    number in its name: the number of the image for image folders, counted from 0 for videos. Several objects have one
    folder each, whose name is not a camera's.

    Args:
        folder: the folder.
        cameras: names of all cameras that may have masks.
        sources: of the cameras whose masks are returned.

    Returns:
        Masks by object, one per source, and warnings.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: no masks, an unknown camera, two masks for one camera, camera and object folders mixed, an invalid
            object name, no usable numbers, a size that differs from the image, or an empty static mask; the message
            names the file or folder.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of masks")
    warnings: list[str] = []
    objects = _find_object_folders(folder, cameras)
    if not objects:
        return {DEFAULT_OBJECT_NAME: _find_object_masks(folder, cameras, sources, warnings)}, warnings
    _check_object_names([f.name for f in objects], cameras, folder)
    for object_folder in objects:
        # Frame numbers would match camera names: `cam_8/0000.png` is not a mask of cam_0 for an object cam_8.
        images = [f for f in _list_mask_entries(object_folder) if f.is_file()]
        if frames := [f.name for f in images if f.stem.isdigit() and f.stem not in cameras]:
            raise ValueError(
                f"{object_folder}: neither a camera of the calibration ({', '.join(cameras)}) nor an object, whose "
                f"masks would be named like cameras, not {frames[0]}"
            )
    return {f.name: _find_object_masks(f, cameras, sources, warnings) for f in objects}, warnings


def check_first_masks(masks: tuple[Masks, ...], sources: tuple[Source, ...], frames: IntArray) -> None:
    """Read one object's masks up to the first frame set in which the object appears.

    Args:
        masks: one per camera.
        sources: one per camera.
        frames: (n, C) frame of each camera in each frame set, -1 for none.

    Raises:
        ValueError: a file of a wrong size, or all masks empty; the message names the files.
    """
    if not any(m.files for m in masks):
        return
    has_object = any(m.static is not None for m in masks)
    first: list[Path] = []
    for row in frames:
        read_files = []
        for m, source, k in zip(masks, sources, row.tolist(), strict=True):
            file = m.files.get(source.frame_number(k)) if k >= 0 else None
            if file is not None:
                read_files.append(file)
                has_object |= bool(read_mask(file, source.size).any())
        first = first or read_files
        if read_files and has_object:
            return
    if first:
        raise ValueError(f"{', '.join(map(str, first))}: this and all later masks are empty; the object must be white")


def _convert_boxes(raw: Mapping[str, Any], rig: Rig, others: Sequence[str], where: str) -> dict[str, Box]:
    """Return one object's boxes by camera, in the rig's order."""
    boxes = {}
    for name, camera in match_all_names(raw, [*rig.names, *others], where).items():
        if camera not in rig:
            continue
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


def _check_object_names(names: Sequence[str], cameras: Sequence[str], where: Path) -> None:
    """Check that object names are valid file names on any system and differ from camera names."""
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise ValueError(f"{where}: an object name must consist of letters, digits, - and _, got {name!r}")
        if match_names([name], cameras):
            raise ValueError(f"{where}: the object {name} has a camera's name ({', '.join(cameras)})")
    by_lower_case: dict[str, str] = {}
    for name in names:
        if (other := by_lower_case.setdefault(name.lower(), name)) != name:
            raise ValueError(f"{where}: the objects {other} and {name} differ in case only")


def _list_mask_entries(folder: Path) -> list[Path]:
    """Return the folders and images, which may be masks."""
    files = sorted(folder.iterdir())
    return [f for f in files if f.name[0] != "." and (f.is_dir() or f.suffix.lower() in IMAGE_SUFFIXES)]


def _entry_name(entry: Path) -> str:
    return entry.name if entry.is_dir() else entry.stem


def _is_camera(entry: Path, cameras: Sequence[str]) -> bool:
    """Return whether an entry is named like a camera, and not merely like a frame number."""
    name = _entry_name(entry)
    return not name.isdigit() and (name in cameras or (entry.is_dir() and bool(match_names([name], cameras))))


def _find_object_folders(folder: Path, cameras: Sequence[str]) -> list[Path]:
    """Return the object folders of a mask folder; none if its entries are images or named like cameras."""
    entries = _list_mask_entries(folder)
    matched = match_names(dict.fromkeys(map(_entry_name, entries)), cameras, folder)
    others = [f for f in entries if _entry_name(f) not in matched]
    for f in (f for f in entries if f.is_dir() and f not in others):
        if camera_like := [g.name for g in _list_mask_entries(f) if _is_camera(g, cameras)]:
            raise ValueError(
                f"{f}: named like camera {matched[f.name]}, but contains {', '.join(camera_like)} like an "
                "object folder: choose a name that no camera has"
            )
    if not others or not all(f.is_dir() for f in others):
        return []
    if len(others) < len(entries):
        matching = ", ".join(f.name for f in entries if f not in others)
        raise ValueError(
            f"{folder}: {', '.join(f.name for f in others)} is not a camera of {', '.join(cameras)}, and "
            f"{matching} is not an object folder: either all must be named like cameras or all must be objects"
        )
    return others


def _find_object_masks(
    folder: Path, cameras: Sequence[str], sources: tuple[Source, ...], warnings: list[str]
) -> tuple[Masks, ...]:
    """Return one object's masks, one per camera."""
    found = _list_mask_entries(folder)
    if not found:
        raise ValueError(f"{folder}: contains no masks, neither CAMERA.png nor CAMERA/FRAME.png")
    matched = match_all_names(dict.fromkeys(map(_entry_name, found)), cameras, folder)
    by_camera = invert_unique({entry: matched[_entry_name(entry)] for entry in found}, folder)
    return tuple(_read_masks(by_camera.get(source.camera), source, warnings) for source in sources)


def _read_masks(path: Path | None, source: Source, warnings: list[str]) -> Masks:
    """Return the masks of a camera: in an image, in a folder, or none."""
    if path is None:
        return Masks()
    if path.is_dir():
        return Masks(files=_masks_by_frame_number(path, source, warnings))
    static = read_mask(path, source.size)
    if not static.any():
        raise ValueError(f"{path}: the mask is empty; the object must be white")
    return Masks(static)


def _masks_by_frame_number(folder: Path, source: Source, warnings: list[str]) -> dict[int, Path]:
    files = image_files(folder)
    numbers = image_numbers(files)
    if numbers is None:
        raise ValueError(f"{folder}: masks with frame numbers in their names are expected")
    frames = set(range(source.n_frames) if source.numbers is None else source.numbers)
    unused = sorted(set(numbers) - frames)
    if len(unused) == len(numbers):
        raise ValueError(f"{folder}: no mask number matches a frame ({min(frames)} to {max(frames)})")
    if unused:
        warnings.append(f"{folder}: {len(unused)} masks match no frame, the first is number {unused[0]}.")
    return dict(zip(numbers, files, strict=True))
