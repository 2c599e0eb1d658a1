"""The files of a COLMAP model, text and binary: lenses, and images with poses. Points are passed over."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import MAX_TABLE, one_line, regular_file, told
from sylpose.rig import MAX_LENGTH

__all__ = ["Image", "Lens", "Model", "is_model", "read_model"]

# Lenses and images of a model (choice: a rig of a hundred cameras, a thousand images of each).
MAX_IMAGES = 100_000
# Bytes of a line with an image's pose and name (choice: its eight numbers with all digits, and the longest path).
MAX_LINE = 8192
# A line of cameras.txt or the entry of a binary one has no more parameters (choice: COLMAP's models have 16).
MAX_PARAMS = 100
_FILES = ("cameras", "images", "points3d", "rigs", "frames")
# By COLMAP's numbers, which its binary files have: name, number of parameters.
_NUMBERED = (
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
    """An entry of COLMAP's cameras."""

    model: str
    size: tuple[int, int]
    params: FloatArray


class Image(NamedTuple):
    """An image with a pose camera_from_world, of the lens with number `camera`: (4,) quaternion, w last, and (3,)."""

    name: str
    camera: int
    quaternion: FloatArray
    translation: FloatArray


class Model(NamedTuple):
    """Lenses by number, and images."""

    lenses: dict[int, Lens]
    images: list[Image]


def is_model(path: Path) -> bool:
    """Whether a file's name is one of those in a COLMAP model."""
    return path.stem.lower() in _FILES and path.suffix.lower() in (".txt", ".bin")


def read_model(path: Path) -> Model:
    """The model that a file is part of.

    Raises:
        OSError: a file that cannot be read.
        ValueError: naming the file and the line or entry that is not what it should be; cameras without images.
    """
    found = {(file.stem.lower(), file.suffix.lower()): file for file in path.parent.iterdir() if is_model(file)}
    # As COLMAP does, the binary ones, where a model is there in both; the suffix of the given file before that.
    for suffix in dict.fromkeys((path.suffix.lower(), ".bin", ".txt")):
        if ("cameras", suffix) in found and ("images", suffix) in found:
            cameras, images = found["cameras", suffix], found["images", suffix]
            break
    else:
        lacking = [name for name in ("cameras", "images") if not any(name == stem for stem, _ in found)]
        raise ValueError(
            f"{path}: this is part of a COLMAP model, whose lenses are in cameras.txt and poses in images.txt, or in .bin; "
            f"{' and '.join(lacking) or 'both of one kind'} must lie beside it"
        )
    with told(cameras):
        lenses = _lenses_of_text(cameras) if suffix == ".txt" else _lenses_of_binary(cameras)
    with told(images):
        return Model(lenses, list(_images_of_text(images) if suffix == ".txt" else _images_of_binary(images)))


# Text


def _lenses_of_text(path: Path) -> dict[int, Lens]:
    lenses = {}
    with regular_file(path, MAX_TABLE) as file:
        for number, line in _lines(file):
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


def _images_of_text(path: Path) -> Iterator[Image]:
    with regular_file(path, MAX_TABLE) as file:
        lines = _lines(file)
        count = 0
        for number, line in lines:
            words = line.split(maxsplit=9)
            if not words or words[0].startswith("#"):
                continue
            try:
                values = [float(word) for word in words[1:8]]
                image = _image(words[9].strip(), int(words[8]), np.array(values))
            except (ValueError, IndexError) as error:
                what = (
                    str(error)
                    if str(error).startswith("image ")
                    else "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
                )
                raise ValueError(f"line {number}: {what}") from None
            yield image
            next(lines, None)  # its points, of which there may be none
            count += 1
            if count > MAX_IMAGES:
                raise ValueError(f"more than {MAX_IMAGES} images")


def _lines(file: BinaryIO) -> Iterator[tuple[int, str]]:
    """Number and beginning of each line, however long it is."""
    number = 0
    while line := file.readline(MAX_LINE):
        number += 1
        rest = line
        while not rest.endswith(b"\n") and (rest := file.readline(2**16)):
            pass
        yield number, line.decode("utf-8", "replace")


# Binary


def _lenses_of_binary(path: Path) -> dict[int, Lens]:
    lenses = {}
    with regular_file(path, MAX_TABLE) as file:
        for _ in range(_count(file)):
            key, model, width, height = _unpacked(file, "<IiQQ")
            if not 0 <= model < len(_NUMBERED):
                raise ValueError(f"camera {key}: COLMAP's model number {model} is not known")
            name, n = _NUMBERED[model]
            lenses[key] = Lens(name, (width, height), np.array(_unpacked(file, f"<{n}d")))
    return lenses


def _images_of_binary(path: Path) -> Iterator[Image]:
    with regular_file(path, MAX_TABLE) as file:
        for _ in range(_count(file)):
            _, *values, camera = _unpacked(file, "<I7dI")
            name = bytearray()
            while (byte := file.read(1)) != b"\0":
                name += byte
                if not byte or len(name) > MAX_LINE:
                    raise ValueError("it breaks off in an image's name")
            yield _image(name.decode("utf-8", "replace"), camera, np.array(values))
            (points,) = _unpacked(file, "<Q")
            # Each has x and y and the number of a point in space.
            if points > MAX_TABLE:
                raise ValueError(f"an image of {points} points")
            file.seek(24 * points, 1)


def _count(file: BinaryIO) -> int:
    (count,) = _unpacked(file, "<Q")
    if count > MAX_IMAGES:
        raise ValueError(f"more than {MAX_IMAGES} entries")
    return int(count)


def _unpacked(file: BinaryIO, layout: str) -> tuple[Any, ...]:
    data = file.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise ValueError("it breaks off: it is not a whole binary file of a COLMAP model")
    return struct.unpack(layout, data)


def _image(name: str, camera: int, values: FloatArray) -> Image:
    """Of quaternion, w first, and translation."""
    if not np.abs(values).max() <= MAX_LENGTH or not abs(np.linalg.norm(values[:4]) - 1.0) < 1e-3:
        raise ValueError(f"image {one_line(name, 100)}: its pose is not a unit quaternion, w first, and a translation")
    return Image(name, camera, np.roll(values[:4], -1), values[4:])
