"""Files of points: known points of an object, and tables of image points by frame and camera (docs/formats.md).

Points of an object are made by hand or by CAD: named points, vertices, markers. A table of image points is of all
cameras, or DeepLabCut's of one.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sylpose.boards.specification import Board, parse_board
from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors, parse_toml, read_bytes, read_text, to_one_line
from sylpose.io.capture.names import match_names
from sylpose.rig import MAX_FOCAL_PX, MAX_LENGTH
from sylpose.units import METERS, parse_length

# Largest size of a file of points in bytes, and largest number of points, each of which is used in every frame
# (choice).
MAX_BYTES, MAX_POINTS = 1 << 26, 1_000_000
# Largest number of markers on an object, and largest difference of their ids (choice: the largest family has fewer).
MAX_MARKERS = 10_000
# Tolerance of a marker's squareness as a share of its side (choice: three decimals), and as a cosine between its axes.
SQUARE_TOLERANCE, MAX_AXIS_COSINE = 0.02, 1e-3
# A marker faces inwards if the center of all markers is this many of its sides in front of it (choice).
MIN_INWARD_RATIO = 0.25
# Largest size of a PLY header in bytes (choice).
MAX_PLY_HEADER = 1 << 14
_COLUMNS = ("name", "x", "y", "z")
# Points with a lower likelihood are ignored (choice: DeepLabCut's default pcutoff).
MIN_LIKELIHOOD = 0.6
# Accepted names of the columns.
_PIXEL_COLUMNS = {
    "camera": ("camera", "cam"),
    "frame": ("frame",),
    "name": ("name", "point", "bodypart"),
    "u": ("u", "x"),
    "v": ("v", "y"),
    "likelihood": ("likelihood", "score", "confidence"),
    "time": ("time",),
}
_REQUIRED_PIXEL_COLUMNS = ("camera", "frame", "name", "u", "v")
MAX_FRAME = 2**53


@dataclass(frozen=True, eq=False)
class MarkerLayout:
    """Markers on an object.

    Attributes:
        marker: specification of one of them, for the detector.
        corners: corners (4, 3) by id in the object's frame, clockwise from the upper left (the order of
            `Board.points`).
    """

    marker: Board
    corners: Mapping[int, FloatArray]

    @property
    def inward_markers(self) -> tuple[int, ...]:
        """Return the ids of markers that face the center of all markers: their corners may be in the wrong order."""
        corners = np.array([*self.corners.values()])
        centers = corners.mean(axis=1)
        right, up = corners[:, 1] - corners[:, 0], corners[:, 0] - corners[:, 3]
        outward = np.einsum("ni,ni->n", np.cross(right, up), centers - centers.mean(axis=0))
        sides = np.linalg.norm(right, axis=1)
        is_inward = outward / sides**3 < -MIN_INWARD_RATIO
        return tuple(name for name, inward in zip(self.corners, is_inward, strict=True) if inward)


@dataclass(frozen=True, eq=False)
class PointModel:
    """Known points and markers of an object.

    Attributes:
        unit: length unit, "" if the file has none.
        points: positions (3,) by name, in the object's frame.
        markers: its markers, or None.
    """

    unit: str
    points: Mapping[str, FloatArray] = field(default_factory=dict)
    markers: MarkerLayout | None = None

    def in_unit(self, unit: str, is_in: str | None = None) -> PointModel:
        """Return the model with lengths in the calibration's unit.

        Args:
            unit: the calibration's unit.
            is_in: the model's unit if the file has none.

        Raises:
            ValueError: units that cannot be converted, or that contradict the file.
        """
        if is_in is not None and (is_in not in METERS or self.unit not in ("", is_in)):
            raise ValueError(f"--is-in {is_in}: expected one of {', '.join(METERS)}, without contradicting the file")
        source_unit = self.unit or is_in or ""
        if source_unit in ("", unit):
            return replace(self, unit=unit)
        if source_unit not in METERS or unit not in METERS:
            raise ValueError(
                f"its lengths are in {source_unit}, those of the calibration "
                f"{f'in {unit}' if unit else 'in an unknown unit'}"
            )
        scale, markers = METERS[source_unit] / METERS[unit], self.markers
        if markers is not None:
            markers = replace(markers, corners={name: scale * corners for name, corners in markers.corners.items()})
        return PointModel(unit, {name: scale * place for name, place in self.points.items()}, markers)


def load_points(path: Path) -> PointModel:
    """Read object points; the file's suffix selects the format.

    Args:
        path: .csv (`name,x,y,z`), .toml (points or markers), .ply or .obj (vertices, named by their index from 0).

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the file, and the line if possible: another suffix, or invalid content.
    """
    readers = {".csv": _read_csv, ".toml": _read_toml, ".ply": _read_ply, ".obj": _read_obj}
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected points or markers of an object")
    with input_errors(path):
        if path.suffix.lower() not in readers:
            raise ValueError(f"points are read from {', '.join(readers)}")
        model = readers[path.suffix.lower()](path)
        if not model.points and model.markers is None:
            raise ValueError("contains no points")
        return model


def _parse_position(values: Any, name: str) -> FloatArray:
    good = isinstance(values, list | tuple) and len(values) == 3
    if not good or not all(
        isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= MAX_LENGTH for v in values
    ):
        raise ValueError(f"{to_one_line(name, 60)}: expected three numbers of at most {MAX_LENGTH:g}")
    return np.array(values, dtype=float)


_Rows = Iterator[tuple[int, list[str]]]


def _split_rows(text: str) -> _Rows:
    """Yield the rows of CSV, without blanks around cells, each with the number of its last line."""
    rows = csv.reader(io.StringIO(text, newline=""))
    return ((rows.line_num, [cell.strip() for cell in row]) for row in rows)


def _read_rows(rows: _Rows, n_cells: int, read_row: Callable[[list[str]], None]) -> None:
    """Read the rows that are not blank; errors name the line."""
    for line, row in rows:
        if not any(row):
            continue
        try:
            if len(row) != n_cells:
                raise ValueError(f"expected {n_cells} cells, got {len(row)}")
            read_row(row)
        except ValueError as error:
            raise ValueError(f"line {line}: {error}") from None


def _read_csv(path: Path) -> PointModel:
    rows = _split_rows(read_text(path, MAX_BYTES))
    header = [cell.lower() for cell in next(rows, (1, []))[1]]
    if sorted(header) != sorted(_COLUMNS):
        raise ValueError(f"line 1: expected the columns {','.join(_COLUMNS)}, got {to_one_line(','.join(header), 60)}")
    columns, points = [header.index(column) for column in _COLUMNS], dict[str, FloatArray]()

    def read_row(row: list[str]) -> None:
        name = row[columns[0]]
        if not name or name in points:
            raise ValueError(f"the point {name!r} occurs twice" if name else "a point without a name")
        points[name] = _parse_position([float(row[k]) for k in columns[1:]], name)
        _check_count(len(points))

    _read_rows(rows, len(header), read_row)
    return PointModel("", points)


def _check_count(n: int) -> None:
    if n > MAX_POINTS:
        raise ValueError(f"more than {MAX_POINTS} points")


def _read_toml(path: Path) -> PointModel:
    data = parse_toml(read_text(path))
    if unknown := data.keys() - {"unit", "points", "markers", "family", "size"}:
        raise ValueError(
            f"{to_one_line(', '.join(sorted(unknown)), 60)}: expected only unit, points, markers, family and size"
        )
    unit = data.get("unit", "")
    if unit not in ("", *METERS):
        raise ValueError(f"unit: expected one of {', '.join(METERS)}, got {to_one_line(repr(unit), 60)}")
    points, markers = data.get("points", {}), data.get("markers")
    if not isinstance(points, dict):
        raise ValueError("points: expected a table, NAME = [x, y, z]")
    named = {name: _parse_position(place, f"points: {name}") for name, place in points.items()}
    if markers is None:
        if unused := data.keys() & {"family", "size"}:
            raise ValueError(f"{', '.join(sorted(unused))}: only for markers, and there are none")
        return PointModel(unit, named)
    if not isinstance(markers, dict) or not 0 < len(markers) <= MAX_MARKERS:
        raise ValueError("markers: expected one table per marker, [markers.NUMBER]")
    return PointModel(unit, named, _parse_layout(markers, data.get("family"), data.get("size"), unit))


def _parse_layout(markers: Mapping[str, Any], family: Any, size: Any, unit: str) -> MarkerLayout:
    """Parse the tables of markers by id, each with `corners`, or `center`, `x` and `y`."""
    if not isinstance(family, str):
        raise ValueError("family: expected that of the markers, such as apriltag:36h11 or aruco:4X4_50")
    side = None if size is None else parse_length(str(size), "size", unit)
    corners = dict[int, FloatArray]()
    for number, table in markers.items():
        if not number.isascii() or not number.isdecimal() or len(number) > 5 or not isinstance(table, dict):
            raise ValueError(f"markers: expected tables by number, [markers.3], got {to_one_line(number, 60)}")
        if int(number) in corners:
            raise ValueError(f"markers.{number}: the number occurs twice")
        corners[int(number)] = _parse_corners(table, f"markers.{number}", side)
    if max(corners) - min(corners) >= MAX_MARKERS:
        raise ValueError(f"markers: numbers from {min(corners)} to {max(corners)} are not of one family")
    # The detector does not use the size.
    marker = parse_board(f"{family},id={min(corners)},size=1", "")
    if marker.kind != "marker":
        raise ValueError(
            f"family: {to_one_line(family, 60)} is not a family of single markers, such as apriltag:36h11 or "
            "aruco:4X4_50"
        )
    return MarkerLayout(marker, dict(sorted(corners.items())))


def _parse_corners(table: Mapping[str, Any], name: str, side: float | None) -> FloatArray:
    """Return a marker's corners (4, 3), clockwise from the upper left as printed."""
    if table.keys() == {"corners"}:
        values = table["corners"]
        if not isinstance(values, list) or len(values) != 4:
            raise ValueError(f"{name}.corners: expected four points, clockwise from the upper left as printed")
        places = np.array([_parse_position(place, f"{name}.corners") for place in values])
        sides = np.roll(places, -1, axis=0) - places
        length = float(np.linalg.norm(sides, axis=1).mean())
        skew = abs(float(sides[0] @ sides[1])) / max(length, 1e-300)
        deviations = np.linalg.norm(sides[0] + sides[2]), skew, np.ptp(np.linalg.norm(sides, axis=1))
        if not length > 0 or max(deviations) > SQUARE_TOLERANCE * length:
            raise ValueError(f"{name}.corners: they do not form a square")
        if side is not None and abs(side - length) > SQUARE_TOLERANCE * length:
            raise ValueError(f"{name}.corners: its sides are {length:.6g} long, but size is {side:.6g}")
        return places
    if table.keys() != {"center", "x", "y"}:
        raise ValueError(
            f"{name}: expected corners, or center, x and y, got {to_one_line(', '.join(table) or 'nothing', 60)}"
        )
    if side is None:
        raise ValueError(f"{name}: size, the length of a marker's side, is missing")
    center, x, y = (_parse_position(table[key], f"{name}.{key}") for key in ("center", "x", "y"))
    lengths = [float(np.linalg.norm(axis)) for axis in (x, y)]
    if not min(lengths) > 0 or abs(float(x @ y)) > MAX_AXIS_COSINE * lengths[0] * lengths[1]:
        raise ValueError(f"{name}: x and y, to its right and its upper side, must be perpendicular")
    x, y = side / 2 * x / lengths[0], side / 2 * y / lengths[1]
    return np.array([center - x + y, center + x + y, center + x - y, center - x - y])


# --- vertices --------------------------------------------------------------------------------------------------------


def _make_numbered_model(places: FloatArray) -> PointModel:
    _check_count(len(places))
    if not (np.abs(places) <= MAX_LENGTH).all():  # also rejects NaN
        raise ValueError(f"vertices are not finite, or beyond {MAX_LENGTH:g}")
    return PointModel("", {str(k): place for k, place in enumerate(places)})


def _read_obj(path: Path) -> PointModel:
    places = list[Sequence[float]]()
    for number, line in enumerate(read_text(path, MAX_BYTES).splitlines(), start=1):
        words = line.split()
        if words[:1] != ["v"]:
            continue
        try:
            places.append([float(word) for word in words[1:4]])
        except ValueError:
            places.append([])
        if len(places[-1]) != 3:
            raise ValueError(f"line {number}: expected three numbers after v")
        _check_count(len(places))
    return _make_numbered_model(np.array(places, dtype=float).reshape(-1, 3))


_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_PLY_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def _read_ply(path: Path) -> PointModel:
    data = read_bytes(path, MAX_BYTES)
    head, end, _ = data[:MAX_PLY_HEADER].partition(b"end_header")
    body = data[data.find(b"\n", len(head)) + 1 :]
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not end or lines[:1] != [["ply"]]:
        raise ValueError("not PLY: its header is missing")
    form = next((line[1] for line in lines if line[:1] == ["format"] and len(line) == 3), "")
    count, fields, first = -1, list[tuple[str, str]](), ""
    for line in lines:
        if line[:1] == ["element"]:
            first = first or " ".join(line[1:2])
            if first != "vertex":
                raise ValueError("its first element is not vertex")
            if count >= 0:
                break
            count = int(line[2]) if len(line) == 3 and line[2].isdecimal() and len(line[2]) < 10 else MAX_POINTS + 1
        elif line[:1] == ["property"] and count >= 0:
            if len(line) != 3 or line[1] not in _PLY_TYPES or line[2] in dict(fields):
                raise ValueError("its vertices have a property that is not a number, or one twice")
            fields.append((line[2], _PLY_TYPES[line[1]]))
    _check_count(count)
    names = [name for name, _ in fields]
    if count < 0 or not {"x", "y", "z"} <= {*names}:
        raise ValueError("it has no vertices with x, y and z")
    if form == "ascii":
        words = body.decode("ascii", "replace").split(maxsplit=count * len(fields))[: count * len(fields)]
        if len(words) < count * len(fields):
            raise ValueError("it ends before its last vertex")
        table = np.array([float(word) for word in words]).reshape(count, len(fields))
        return _make_numbered_model(table[:, [names.index(axis) for axis in "xyz"]])
    if form not in _PLY_BYTE_ORDERS:
        raise ValueError(
            f"its format is {to_one_line(form, 40) or 'missing'}; supported are "
            f"{', '.join(['ascii', *_PLY_BYTE_ORDERS])}"
        )
    row = np.dtype([(name, _PLY_BYTE_ORDERS[form] + kind) for name, kind in fields])
    if len(body) < count * row.itemsize:
        raise ValueError("it ends before its last vertex")
    records = np.frombuffer(body, row, count)
    return _make_numbered_model(np.column_stack([records[axis].astype(float) for axis in "xyz"]))


# Image points


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
            rows = _split_rows(text)
            _, header = next(rows, (1, []))
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


def _read_deeplabcut(rows: _Rows, camera: str, collected: _Accumulator) -> None:
    """Read the rest of a DeepLabCut table: `bodyparts`, `coords`, then one row per frame."""
    (_, parts), (_, coords) = (next(rows, (1, [])) for _ in range(2))
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

    _read_rows(rows, len(parts), read_row)


def _read_table(rows: _Rows, header: Sequence[str], cameras: Sequence[str], collected: _Accumulator) -> None:
    columns = dict[str, int]()
    for k, cell in enumerate(header):
        column = next((name for name, words in _PIXEL_COLUMNS.items() if cell.lower() in words), None)
        if column is None or column in columns:
            raise ValueError(f"line 1: the column {to_one_line(cell, 40)!r} is unknown or occurs twice")
        columns[column] = k
    if missing := [name for name in _REQUIRED_PIXEL_COLUMNS if name not in columns]:
        raise ValueError(
            f"line 1: expected the columns {','.join(_REQUIRED_PIXEL_COLUMNS)}; {', '.join(missing)} missing"
        )
    matched = dict[str, str]()

    def read_row(row: list[str]) -> None:
        camera_text, name = row[columns["camera"]], row[columns["name"]]
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

    _read_rows(rows, len(header), read_row)


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
        return float(cell) if cell else np.nan
    except ValueError:
        raise ValueError(f"{to_one_line(cell, 40)!r} is not a number") from None
