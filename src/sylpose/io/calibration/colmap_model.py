"""COLMAP model files, text and binary: lenses, and images with poses. Points are skipped."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors, open_regular_file, to_one_line
from sylpose.rig import MAX_LENGTH

__all__ = ["Image", "Lens", "Model", "is_model", "read_model"]

# Maximum number of lenses and of images of a model (choice: a rig of a hundred cameras, a thousand images of each).
MAX_IMAGES = 100_000
# Bytes of a line with an image's pose and name (choice: eight numbers with all digits, and the longest path).
MAX_LINE = 8192
# Maximum number of parameters in a line of cameras.txt or a binary entry (choice: COLMAP's models have 16).
MAX_PARAMS = 100
_FILES = ("cameras", "images", "points3d", "rigs", "frames")
# Model names and parameter counts, indexed by COLMAP's model IDs in binary files.
_MODELS_BY_ID = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8)),
    *(("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12)),
    *(
        ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
        ("SIMPLE_DIVISION", 4),
        ("DIVISION", 5),
        ("SIMPLE_FISHEYE", 3),
        ("FISHEYE", 4),
    ),
    *(("EUCM", 6), ("EQUIRECTANGULAR", 2)),
)


class Lens(NamedTuple):
    """Entry of COLMAP's cameras."""

    model: str
    size: tuple[int, int]
    params: FloatArray


class Image(NamedTuple):
    """Image with pose camera_from_world: (4,) quaternion, w last, and (3,) translation; `camera` is its lens ID."""

    name: str
    camera: int
    quaternion: FloatArray
    translation: FloatArray


class Model(NamedTuple):
    """Lenses by ID, and images."""

    lenses: dict[int, Lens]
    images: list[Image]


def is_model(path: Path) -> bool:
    """Return whether a file has the name of a COLMAP model file."""
    return path.stem.lower() in _FILES and path.suffix.lower() in (".txt", ".bin")


def read_model(path: Path) -> Model:
    """Read the model that a file is part of.

    Raises:
        OSError: a file that cannot be read.
        ValueError: naming the file and the invalid line or entry; cameras without images.
    """
    found = {(file.stem.lower(), file.suffix.lower()): file for file in path.parent.iterdir() if is_model(file)}
    # If a model exists in both forms, prefer the suffix of the given file, then binary, as COLMAP does.
    for suffix in dict.fromkeys((path.suffix.lower(), ".bin", ".txt")):
        if ("cameras", suffix) in found and ("images", suffix) in found:
            cameras, images = found["cameras", suffix], found["images", suffix]
            break
    else:
        missing = [name for name in ("cameras", "images") if not any(name == stem for stem, _ in found)]
        raise ValueError(
            f"{path}: this is part of a COLMAP model, whose lenses are in cameras.txt and poses in images.txt, or in "
            f".bin; {' and '.join(missing) or 'both of one kind'} must be next to it"
        )
    with input_errors(cameras):
        lenses = _read_text_lenses(cameras) if suffix == ".txt" else _read_binary_lenses(cameras)
    with input_errors(images):
        return Model(lenses, list(_read_text_images(images) if suffix == ".txt" else _read_binary_images(images)))


# Text


def _read_text_lenses(path: Path) -> dict[int, Lens]:
    lenses = {}
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        for number, line in _iterate_lines(file):
            words = line.split(maxsplit=MAX_PARAMS)
            if not words or words[0].startswith("#"):
                continue
            try:
                key, size = int(words[0]), (int(words[2]), int(words[3]))
                lenses[key] = Lens(words[1], size, np.array([float(word) for word in words[4:]]))
            except (ValueError, IndexError):
                raise ValueError(
                    f"line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] of a COLMAP model"
                ) from None
            if len(lenses) > MAX_IMAGES:
                raise ValueError(f"more than {MAX_IMAGES} cameras")
    return lenses


def _read_text_images(path: Path) -> Iterator[Image]:
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        lines = _iterate_lines(file)
        count = 0
        for number, line in lines:
            words = line.split(maxsplit=9)
            if not words or words[0].startswith("#"):
                continue
            try:
                values = [float(word) for word in words[1:8]]
                image = _make_image(words[9].strip(), int(words[8]), np.array(values))
            except (ValueError, IndexError) as error:
                what = (
                    str(error)
                    if str(error).startswith("image ")
                    else "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
                )
                raise ValueError(f"line {number}: {what}") from None
            yield image
            next(lines, None)  # its points, possibly none
            count += 1
            if count > MAX_IMAGES:
                raise ValueError(f"more than {MAX_IMAGES} images")


def _iterate_lines(file: BinaryIO) -> Iterator[tuple[int, str]]:
    """Yield number and beginning of each line, however long it is."""
    number = 0
    while line := file.readline(MAX_LINE):
        number += 1
        rest = line
        while not rest.endswith(b"\n") and (rest := file.readline(2**16)):
            pass
        yield number, line.decode("utf-8", "replace")


# Binary


def _read_binary_lenses(path: Path) -> dict[int, Lens]:
    lenses = {}
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        for _ in range(_read_count(file)):
            key, model, width, height = _unpack(file, "<IiQQ")
            if not 0 <= model < len(_MODELS_BY_ID):
                raise ValueError(f"camera {key}: COLMAP's model number {model} is unknown")
            name, n = _MODELS_BY_ID[model]
            lenses[key] = Lens(name, (width, height), np.array(_unpack(file, f"<{n}d")))
    return lenses


def _read_binary_images(path: Path) -> Iterator[Image]:
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        for _ in range(_read_count(file)):
            _, *values, camera = _unpack(file, "<I7dI")
            name = bytearray()
            while (byte := file.read(1)) != b"\0":
                name += byte
                if not byte or len(name) > MAX_LINE:
                    raise ValueError("the file is truncated in an image's name")
            yield _make_image(name.decode("utf-8", "replace"), camera, np.array(values))
            (points,) = _unpack(file, "<Q")
            # Each point has x, y and the ID of a 3D point.
            if points > MAX_TABLE_BYTES:
                raise ValueError(f"an image has an implausible number of points, {points}")
            file.seek(24 * points, 1)


def _read_count(file: BinaryIO) -> int:
    (count,) = _unpack(file, "<Q")
    if count > MAX_IMAGES:
        raise ValueError(f"more than {MAX_IMAGES} entries")
    return int(count)


def _unpack(file: BinaryIO, layout: str) -> tuple[Any, ...]:
    data = file.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise ValueError("the file is truncated: not a complete binary file of a COLMAP model")
    return struct.unpack(layout, data)


def _make_image(name: str, camera: int, values: FloatArray) -> Image:
    """Build an image from quaternion, w first, and translation."""
    if not np.abs(values).max() <= MAX_LENGTH or not abs(np.linalg.norm(values[:4]) - 1.0) < 1e-3:
        raise ValueError(
            f"image {to_one_line(name, 100)}: its pose is not a unit quaternion, w first, and a translation"
        )
    return Image(name, camera, np.roll(values[:4], -1), values[4:])
