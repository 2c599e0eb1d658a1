"""Correspondences between known object points and pixels, frame by frame: markers of a recording, or tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sylpose.boards.detection import detect_markers
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.input_limits import input_errors, print_message
from sylpose.io.capture import Session
from sylpose.io.point_files import MarkerLayout, PointModel, load_image_points
from sylpose.rig import Camera, Rig
from sylpose.runs.page import ThumbnailAlbum

# Number of unmatched names that a message lists (choice).
MAX_LISTED_NAMES = 5


class FrameCorrespondences(NamedTuple):
    """Correspondences of one frame: by camera, object points (n, 3) and their pixels (n, 2)."""

    number: int
    time: float
    points: list[FloatArray]
    pixels: list[FloatArray]


def find_points(model: PointModel, file: Path, rig: Rig, is_in: str | None) -> PointModel:
    """Return the model in the rig's unit.

    Raises:
        ValueError: naming the file: no named points, or an unknown unit.
    """
    with input_errors(file):
        model = model.in_unit(rig.unit, is_in)
    if not model.points:
        raise ValueError(f"{file}: it has markers, which require a recording, and no named points")
    return model


def find_markers(model: PointModel, file: Path, rig: Rig, is_in: str | None) -> MarkerLayout:
    """Return the markers of a model in the rig's unit.

    Raises:
        ValueError: naming the file: no markers, or an unknown unit.
    """
    with input_errors(file):
        layout = model.in_unit(rig.unit, is_in).markers
    if layout is None:
        raise ValueError(f"{file}: it has no markers to detect in a recording; its points require tables of pixels")
    return layout


def detect_in_recording(
    session: Session, layout: MarkerLayout, frames: tuple[int, int | None, int], album: ThumbnailAlbum
) -> Iterator[FrameCorrespondences]:
    """Detect the markers in each frame.

    Args:
        session: the recording.
        layout: the markers.
        frames: start, stop and step.
        album: receives the images.
    """
    with closing(session.frames(*frames, print_message)) as frame_sets:
        for frame_set in frame_sets:
            album.put(frame_set)
            pairs = zip(frame_set.images, session.rig, strict=True)
            points, pixels = zip(*(_detect_markers(image, camera, layout) for image, camera in pairs), strict=True)
            yield FrameCorrespondences(frame_set.index, frame_set.time, [*points], [*pixels])


def _detect_markers(image: Image | None, camera: Camera, layout: MarkerLayout) -> tuple[FloatArray, FloatArray]:
    """Detect the object's markers in an image; return their corners (n, 3) and pixels (n, 2)."""
    if image is None:
        return np.empty((0, 3)), np.empty((0, 2))
    numbers, pixels, _ = detect_markers(image, camera, layout.marker, layout.corners)
    points = np.array([layout.corners[number] for number in numbers.tolist()])
    return points.reshape(-1, 3), pixels.reshape(-1, 2)


def read_tables(
    model: PointModel,
    files: Sequence[Path],
    rig: Rig,
    file_by_camera: Mapping[str, str] | None,
    rate: float | None,
    likelihood: float,
) -> tuple[list[FrameCorrespondences], list[str]]:
    """Read the correspondences of tables of image points.

    Args:
        model: named points.
        files: the tables.
        rig: the cameras.
        file_by_camera: files whose names do not match a camera.
        rate: frames per second, for tables without times.
        likelihood: points with a lower likelihood are ignored.

    Returns:
        The frames, and warnings.

    Raises:
        FileNotFoundError, ValueError: as `load_image_points`; no matching name; times that do not increase.
    """
    tables, warnings = load_image_points(files, rig.names, file_by_camera, likelihood), list[str]()
    if rate is not None and not (np.isfinite(rate) and rate > 0):
        raise ValueError(f"--rate must be a number of frames per second, got {rate}")
    if rate is not None and tables.times:
        raise ValueError("--rate: the tables have times")
    known = model.points
    if not any(name in known for name in tables.names):
        raise ValueError(
            f"none of the tables' points ({_list_names(tables.names)}) is a point of the object ({_list_names([*known])})"
        )
    if unknown := [name for name in tables.names if name not in known]:
        count_text = f"{len(unknown)} points of the tables are" if len(unknown) > 1 else "1 point of the tables is"
        warnings.append(f"{count_text} not in the object model: {_list_names(unknown)}")
    out = []
    for frame in tables.frames:
        points, pixels = [], []
        for name in rig.names:
            pixel_by_name = {n: at for n, at in tables.pixels.get((frame, name), {}).items() if n in known}
            points.append(np.array([known[n] for n in pixel_by_name]).reshape(-1, 3))
            pixels.append(np.array([*pixel_by_name.values()]).reshape(-1, 2))
        time = tables.times.get(frame, frame / rate if rate else float(frame))
        out.append(FrameCorrespondences(frame, time, points, pixels))
    if any(b.time <= a.time for a, b in pairwise(out)):
        named = files[0] if files else [f"{name}={file}" for name, file in (file_by_camera or {}).items()]
        raise ValueError(f"{named}: times do not increase from frame to frame")
    return out, warnings


def _list_names(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:MAX_LISTED_NAMES]) + (", ..." if len(names) > MAX_LISTED_NAMES else "")
