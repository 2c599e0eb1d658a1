"""Tables of image points by frame and camera: one table for all cameras, or DeepLabCut's tables, one per camera."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors, read_text, to_one_line
from sylpose.io.capture.names import match_names
from sylpose.rig import MAX_FOCAL_PX

# Points with a lower likelihood are ignored (choice: DeepLabCut's default pcutoff).
MIN_LIKELIHOOD = 0.6
# Accepted names of the columns.
_COLUMN_NAMES = {
    "camera": ("camera", "cam"),
    "frame": ("frame",),
    "name": ("name", "point", "bodypart"),
    "u": ("u", "x"),
    "v": ("v", "y"),
    "likelihood": ("likelihood", "score", "confidence"),
    "time": ("time",),
}
_REQUIRED_COLUMNS = ("camera", "frame", "name", "u", "v")
MAX_FRAME = 2**53


@dataclass(frozen=True, eq=False)
class ImagePoints:
    """Image points of named object points.

    Attributes:
        frames: frame numbers, increasing.
        times: seconds by frame, if the tables contain times.
        pixels: pixels (2,) by the point's name, by frame and camera.
        names: names of all points, in order of first appearance.
    """

    frames: tuple[int, ...]
    times: Mapping[int, float]
    pixels: Mapping[tuple[int, str], Mapping[str, FloatArray]]
    names: tuple[str, ...]


class _Accumulator:
    """Accumulator for the rows of all tables."""

    def __init__(self, min_likelihood: float) -> None:
        self.min_likelihood = min_likelihood
        self.pixels = dict[tuple[int, str], dict[str, FloatArray]]()
        self.times = dict[int, float]()
        self.frames, self.names = set[int](), dict[str, None]()

    def add(self, frame: int, camera: str, name: str, u: float, v: float, likelihood: float) -> None:
        """Add an image point; raise ValueError for a duplicate or a pixel out of range."""
        self.frames.add(frame)
        self.names[name] = None
        if np.isnan([u, v]).any() or not likelihood >= self.min_likelihood:
            return
        if not max(abs(u), abs(v)) <= MAX_FOCAL_PX:
            raise ValueError(f"{u}, {v} is not a valid pixel")
        points = self.pixels.setdefault((frame, camera), {})
        if name in points:
            raise ValueError(f"{camera} has {name!r} twice in frame {frame}")
        points[name] = np.array([u, v])


def load_image_points(
    files: Sequence[Path],
    cameras: Sequence[str],
    file_by_camera: Mapping[str, str] | None = None,
    min_likelihood: float = MIN_LIKELIHOOD,
) -> ImagePoints:
    """Read tables of image points.

    A table has the columns `camera,frame,name,u,v`, optionally with `likelihood` and `time`, for all cameras, or is
    DeepLabCut's table of one camera, whose name begins the file's name.

    Args:
        files: the tables.
        cameras: names of the rig's cameras.
        file_by_camera: files by camera, for files whose names do not match.
        min_likelihood: smallest likelihood of a point that is used.

    Raises:
        FileNotFoundError: a file is missing; the message names it.
        ValueError: naming the file and the line: another format, an unknown camera, a duplicate point.
    """
    collected = _Accumulator(min_likelihood)
    camera_by_file = {Path(file): camera for camera, file in (file_by_camera or {}).items()}
    if unknown := [camera for camera in camera_by_file.values() if camera not in cameras]:
        raise ValueError(f"--video: no camera {', '.join(unknown)} in the calibration ({', '.join(cameras)})")
    file_of_camera = dict[str, Path]()
    for path in [*files, *camera_by_file]:
        text = read_text(path, MAX_TABLE_BYTES)
        with input_errors(path):
            rows = csv.reader(io.StringIO(text, newline=""))
            header = [cell.strip() for cell in next(rows, [])]
            if header[:1] == ["scorer"]:
                camera = camera_by_file.get(path) or _match_camera(path, cameras)
                if camera in file_of_camera:
                    raise ValueError(f"belongs to {camera}, like {file_of_camera[camera].name}")
                file_of_camera[camera] = path
                _read_deeplabcut(rows, camera, collected)
            elif path in camera_by_file:
                raise ValueError("expected a DeepLabCut table of one camera, whose first line begins with scorer")
            else:
                _read_table(rows, header, cameras, collected)
    return ImagePoints(tuple(sorted(collected.frames)), collected.times, collected.pixels, tuple(collected.names))


def _match_camera(path: Path, cameras: Sequence[str]) -> str:
    """Find a file's camera; DeepLabCut appends the name of its network to the video's name."""
    stem = re.split(r"DLC|DeepCut", path.stem, maxsplit=1)[0].rstrip("_-. ") or path.stem
    camera = match_names([stem], cameras).get(stem)
    if camera is None:
        raise ValueError(
            f"its name begins with no camera's name ({', '.join(cameras)}); assign it with --video NAME=FILE"
        )
    return camera


def _read_deeplabcut(rows: Iterator[list[str]], camera: str, collected: _Accumulator) -> None:
    """Read the rest of a DeepLabCut table: `bodyparts`, `coords`, then one row per frame."""
    parts, coords = ([cell.strip() for cell in next(rows, [])] for _ in range(2))
    if parts[:1] == ["individuals"]:
        raise ValueError("has several individuals; expected the points of one object")
    if parts[:1] != ["bodyparts"] or coords[:1] != ["coords"] or len(parts) != len(coords):
        raise ValueError("lines 2 and 3 of a DeepLabCut table must be bodyparts and coords")
    columns = dict[str, dict[str, int]]()
    for k, (part, coordinate) in enumerate(zip(parts[1:], coords[1:], strict=True), start=1):
        if coordinate in columns.setdefault(part, {}):
            raise ValueError(f"line 3: {to_one_line(coordinate, 40)} of {to_one_line(part, 40)} occurs twice")
        columns[part][coordinate] = k
    for part, its in columns.items():
        if not {"x", "y"} <= its.keys() <= {"x", "y", "likelihood"}:
            raise ValueError(f"line 3: expected x, y and likelihood of {to_one_line(part, 60)}")

    def read_row(row: list[str]) -> None:
        frame = _parse_frame(row[0])
        for part, its in columns.items():
            u, v = _parse_number(row[its["x"]]), _parse_number(row[its["y"]])
            collected.add(frame, camera, part, u, v, _parse_likelihood(row, its))

    _read_rows(rows, len(parts), 4, read_row)


def _read_table(
    rows: Iterator[list[str]], header: Sequence[str], cameras: Sequence[str], collected: _Accumulator
) -> None:
    columns = dict[str, int]()
    for k, cell in enumerate(header):
        column = next((name for name, words in _COLUMN_NAMES.items() if cell.lower() in words), None)
        if column is None or column in columns:
            raise ValueError(f"line 1: the column {to_one_line(cell, 40)!r} is unknown or occurs twice")
        columns[column] = k
    if missing := [name for name in _REQUIRED_COLUMNS if name not in columns]:
        raise ValueError(f"line 1: expected the columns {','.join(_REQUIRED_COLUMNS)}; {', '.join(missing)} missing")
    matched = dict[str, str]()

    def read_row(row: list[str]) -> None:
        camera_text, name = row[columns["camera"]].strip(), row[columns["name"]].strip()
        if camera_text not in matched:
            camera = match_names([camera_text], cameras).get(camera_text)
            if camera is None:
                raise ValueError(
                    f"no camera {to_one_line(camera_text, 60)!r} in the calibration ({', '.join(cameras)})"
                )
            matched[camera_text] = camera
        if not name:
            raise ValueError("a point without a name")
        frame = _parse_frame(row[columns["frame"]])
        likelihood = _parse_likelihood(row, columns)
        if "time" in columns:
            time = _parse_number(row[columns["time"]])
            if not np.isfinite(time) or collected.times.setdefault(frame, time) != time:
                raise ValueError(f"frame {frame} has no time, or two")
        u, v = _parse_number(row[columns["u"]]), _parse_number(row[columns["v"]])
        collected.add(frame, matched[camera_text], name, u, v, likelihood)

    _read_rows(rows, len(header), 2, read_row)


def _read_rows(rows: Iterator[list[str]], n_cells: int, first_line: int, read_row: Callable[[list[str]], None]) -> None:
    """Read the rows that are not blank; errors name the line."""
    for number, row in enumerate(rows, start=first_line):
        if not any(cell.strip() for cell in row):
            continue
        try:
            if len(row) != n_cells:
                raise ValueError(f"expected {n_cells} cells, got {len(row)}")
            read_row(row)
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None


def _parse_likelihood(row: Sequence[str], columns: Mapping[str, int]) -> float:
    """Return the likelihood in a row: NaN for an empty cell, infinite without the column."""
    return _parse_number(row[columns["likelihood"]]) if "likelihood" in columns else np.inf


def _parse_frame(cell: str) -> int:
    number = _parse_number(cell)
    if not 0 <= number <= MAX_FRAME or number != round(number):
        raise ValueError(f"{to_one_line(cell, 40)!r} is not a frame number")
    return int(number)


def _parse_number(cell: str) -> float:
    try:
        return float(cell) if cell.strip() else np.nan
    except ValueError:
        raise ValueError(f"{to_one_line(cell, 40)!r} is not a number") from None
