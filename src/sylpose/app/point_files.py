"""Points known on an object, as files made by hand or by CAD: named points, vertices, markers (docs/formats.md)."""

from __future__ import annotations

import csv
import io
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sylpose.boards.specification import Board, parse_board
from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import bytes_of, one_line, parsed_toml, text_of, told
from sylpose.rig import MAX_LENGTH
from sylpose.units import METRES, length_of

__all__ = ["Layout", "PointModel", "load_points"]

# Bytes of a file of points or vertices (choice), and so many of them: each is looked for in every frame (choice).
LARGEST, MOST_POINTS = 1 << 26, 1_000_000
# Markers of one object, and the difference of their numbers (choice: the largest family has fewer).
MOST_MARKERS = 10_000
# Corners of a marker are square to this share of its side (choice: three decimals), and its axes to this cosine.
SQUARE, ACROSS = 0.02, 1e-3
# A marker looks inwards that is so many of its sides behind the middle of all (choice).
INWARDS = 0.25
# Bytes that PLY's header has at most (choice).
PLY_HEADER = 1 << 14
_COLUMNS = ("name", "x", "y", "z")


@dataclass(frozen=True, eq=False)
class Layout:
    """Markers on an object.

    Attributes:
        marker: what detectors look for, one of them.
        corners: (4, 3) by number, object's frame, in the order of `Board.points`: from the upper left one on, clockwise.
    """

    marker: Board
    corners: Mapping[int, FloatArray]

    @property
    def inwards(self) -> tuple[int, ...]:
        """Numbers of markers that look towards the middle of all: their corners may be told the wrong way round."""
        corners = np.array([*self.corners.values()])
        centers = corners.mean(axis=1)
        right, up = corners[:, 1] - corners[:, 0], corners[:, 0] - corners[:, 3]
        out = np.einsum("ni,ni->n", np.cross(right, up), centers - centers.mean(axis=0))
        sides = np.linalg.norm(right, axis=1)
        return tuple(name for name, far in zip(self.corners, out / sides**3, strict=True) if far < -INWARDS)


@dataclass(frozen=True, eq=False)
class PointModel:
    """What is known of an object.

    Attributes:
        unit: of lengths, "" where the file does not say it.
        points: (3,) by name, object's frame.
        markers: on it, None without any.
    """

    unit: str
    points: Mapping[str, FloatArray] = field(default_factory=dict)
    markers: Layout | None = None

    def in_unit(self, unit: str, is_in: str | None = None) -> PointModel:
        """The same, its lengths in a calibration's unit.

        Args:
            is_in: its unit, where the file does not say it.

        Raises:
            ValueError: units that cannot be told in each other, or contradict what the file says.
        """
        if is_in is not None and (is_in not in METRES or self.unit not in ("", is_in)):
            raise ValueError(f"--is-in {is_in}: one of {', '.join(METRES)} is expected, and what the file says itself")
        its = self.unit or is_in or ""
        if its in ("", unit):
            return replace(self, unit=unit)
        if its not in METRES or unit not in METRES:
            raise ValueError(
                f"its lengths are in {its}, those of the calibration {f'in {unit}' if unit else 'in no unit that is said'}"
            )
        scale, markers = METRES[its] / METRES[unit], self.markers
        if markers is not None:
            markers = replace(markers, corners={name: scale * its for name, its in markers.corners.items()})
        return PointModel(unit, {name: scale * place for name, place in self.points.items()}, markers)


def load_points(path: Path) -> PointModel:
    """Reads points by the file's ending: .csv (`name,x,y,z`), .toml (points, or markers), .ply, .obj (vertices, named by
    their numbers, the first of which is 0).

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the file, and the line where there is one: another ending, or not what is expected.
    """
    readers = {".csv": _from_csv, ".toml": _from_toml, ".ply": _from_ply, ".obj": _from_obj}
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; points or markers of an object are expected")
    with told(path):
        if path.suffix.lower() not in readers:
            raise ValueError(f"points are read from {', '.join(readers)}")
        model = readers[path.suffix.lower()](path)
        if not model.points and model.markers is None:
            raise ValueError("no points in it")
        return model


def _place(values: Any, name: str) -> FloatArray:
    good = isinstance(values, list | tuple) and len(values) == 3
    if not good or not all(
        isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= MAX_LENGTH for v in values
    ):
        raise ValueError(f"{one_line(name, 60)}: three numbers of at most {MAX_LENGTH:g} are expected")
    return np.array(values, dtype=float)


def _from_csv(path: Path) -> PointModel:
    rows = csv.reader(io.StringIO(text_of(path, LARGEST), newline=""))
    header = [cell.strip().lower() for cell in next(rows, [])]
    if sorted(header) != sorted(_COLUMNS):
        raise ValueError(f"line 1: the columns {','.join(_COLUMNS)} are expected, got {one_line(','.join(header), 60)}")
    at, points = [header.index(column) for column in _COLUMNS], dict[str, FloatArray]()
    for row in rows:
        if not any(cell.strip() for cell in row):
            continue
        try:
            if len(row) != len(header):
                raise ValueError(f"{len(header)} cells are expected, got {len(row)}")
            name = row[at[0]].strip()
            if not name or name in points:
                raise ValueError(f"the point {name!r} is there twice" if name else "a point without a name")
            points[name] = _place([float(row[k]) for k in at[1:]], name)
        except ValueError as error:
            raise ValueError(f"line {rows.line_num}: {error}") from None
        _not_too_many(len(points))
    return PointModel("", points)


def _not_too_many(n: int) -> None:
    if n > MOST_POINTS:
        raise ValueError(f"more than {MOST_POINTS} points")


def _from_toml(path: Path) -> PointModel:
    try:
        data = parsed_toml(text_of(path))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not TOML ({error})") from None
    if unknown := data.keys() - {"unit", "points", "markers", "family", "size"}:
        raise ValueError(
            f"{one_line(', '.join(sorted(unknown)), 60)}: unit, points, markers, family and size are known"
        )
    unit = data.get("unit", "")
    if unit not in ("", *METRES):
        raise ValueError(f"unit: one of {', '.join(METRES)} is expected, got {one_line(repr(unit), 60)}")
    points, markers = data.get("points", {}), data.get("markers")
    if not isinstance(points, dict):
        raise ValueError("points: a table is expected, NAME = [x, y, z]")
    named = {name: _place(place, f"points: {name}") for name, place in points.items()}
    if markers is None:
        if more := data.keys() & {"family", "size"}:
            raise ValueError(f"{', '.join(sorted(more))}: of markers, and there are none")
        return PointModel(unit, named)
    if not isinstance(markers, dict) or not 0 < len(markers) <= MOST_MARKERS:
        raise ValueError("markers: a table for each is expected, [markers.NUMBER]")
    return PointModel(unit, named, _layout(markers, data.get("family"), data.get("size"), unit))


def _layout(markers: Mapping[str, Any], family: Any, size: Any, unit: str) -> Layout:
    """Of tables by number, each with `corners`, or `center`, `x` and `y`."""
    if not isinstance(family, str):
        raise ValueError("family: that of the markers is expected, such as apriltag:36h11 or aruco:4X4_50")
    side = None
    if size is not None:
        side = length_of(
            str(size) if isinstance(size, int | float) and not isinstance(size, bool) else f"{size}", "size", unit
        )
    corners = dict[int, FloatArray]()
    for word, table in markers.items():
        if not word.isascii() or not word.isdecimal() or len(word) > 5 or not isinstance(table, dict):
            raise ValueError(f"markers: tables by number are expected, [markers.3], got {one_line(word, 60)}")
        if int(word) in corners:
            raise ValueError(f"markers.{word}: the number is there twice")
        corners[int(word)] = _corners(table, f"markers.{word}", side)
    if max(corners) - min(corners) >= MOST_MARKERS:
        raise ValueError(f"markers: numbers from {min(corners)} to {max(corners)} are of no one family")
    # A size that detectors do not use.
    marker = parse_board(f"{family},id={min(corners)},size=1", "")
    if marker.kind != "marker":
        raise ValueError(
            f"family: {one_line(family, 60)} is none of single markers, such as apriltag:36h11 or aruco:4X4_50"
        )
    return Layout(marker, dict(sorted(corners.items())))


def _corners(table: Mapping[str, Any], name: str, side: float | None) -> FloatArray:
    """(4, 3) of a marker, from the upper left one on, clockwise, as it is printed."""
    if table.keys() == {"corners"}:
        given = table["corners"]
        if not isinstance(given, list) or len(given) != 4:
            raise ValueError(
                f"{name}.corners: four points are expected, from the upper left one on, clockwise as printed"
            )
        places = np.array([_place(place, f"{name}.corners") for place in given])
        sides = np.roll(places, -1, axis=0) - places
        length = float(np.linalg.norm(sides, axis=1).mean())
        off = max(float(np.linalg.norm(sides[0] + sides[2])), abs(float(sides[0] @ sides[1])) / max(length, 1e-300))
        if not length > 0 or off > SQUARE * length or np.ptp(np.linalg.norm(sides, axis=1)) > SQUARE * length:
            raise ValueError(f"{name}.corners: they are those of no square")
        if side is not None and abs(side - length) > SQUARE * length:
            raise ValueError(f"{name}.corners: its sides are {length:.6g} long, and size says {side:.6g}")
        return places
    if table.keys() != {"center", "x", "y"}:
        raise ValueError(
            f"{name}: corners, or center, x and y are expected, got {one_line(', '.join(table) or 'nothing', 60)}"
        )
    if side is None:
        raise ValueError(f"{name}: size is missing, how long the side of a marker is")
    center, x, y = (_place(table[key], f"{name}.{key}") for key in ("center", "x", "y"))
    lengths = [float(np.linalg.norm(axis)) for axis in (x, y)]
    if not min(lengths) > 0 or abs(float(x @ y)) > ACROSS * lengths[0] * lengths[1]:
        raise ValueError(f"{name}: x and y, to its right and to its upper side, are to be square to each other")
    x, y = side / 2 * x / lengths[0], side / 2 * y / lengths[1]
    return np.array([center - x + y, center + x + y, center + x - y, center - x - y])


# --- vertices --------------------------------------------------------------------------------------------------------


def _numbered(places: FloatArray) -> PointModel:
    _not_too_many(len(places))
    if not (np.abs(places) <= MAX_LENGTH).all():  # nor not a number
        raise ValueError(f"vertices that are not finite, or beyond {MAX_LENGTH:g}")
    return PointModel("", {str(k): place for k, place in enumerate(places)})


def _from_obj(path: Path) -> PointModel:
    places = list[Sequence[float]]()
    for number, line in enumerate(text_of(path, LARGEST).splitlines(), start=1):
        words = line.split()
        if words[:1] != ["v"]:
            continue
        try:
            places.append([float(word) for word in words[1:4]])
        except ValueError:
            places.append([])
        if len(places[-1]) != 3:
            raise ValueError(f"line {number}: a vertex is three numbers after v")
        _not_too_many(len(places))
    return _numbered(np.array(places, dtype=float).reshape(-1, 3))


_PLY = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def _from_ply(path: Path) -> PointModel:
    data = bytes_of(path, LARGEST)
    head, found, _ = data[:PLY_HEADER].partition(b"end_header")
    body = data[data.find(b"\n", len(head)) + 1 :]
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not found or lines[:1] != [["ply"]]:
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
            count = int(line[2]) if len(line) == 3 and line[2].isdecimal() and len(line[2]) < 10 else MOST_POINTS + 1
        elif line[:1] == ["property"] and count >= 0:
            if len(line) != 3 or line[1] not in _PLY or line[2] in dict(fields):
                raise ValueError("its vertices have a property that is no number, or one twice")
            fields.append((line[2], _PLY[line[1]]))
    _not_too_many(count)
    names = [name for name, _ in fields]
    if count < 0 or not {"x", "y", "z"} <= {*names}:
        raise ValueError("it has no vertices with x, y and z")
    if form == "ascii":
        words = body.decode("ascii", "replace").split(maxsplit=count * len(fields))[: count * len(fields)]
        if len(words) < count * len(fields):
            raise ValueError("it ends before its vertices do")
        table = np.array([float(word) for word in words]).reshape(count, len(fields))
        return _numbered(table[:, [names.index(axis) for axis in "xyz"]])
    if form not in _ORDERS:
        raise ValueError(f"its format is {one_line(form, 40) or 'missing'}; {', '.join(['ascii', *_ORDERS])} are read")
    row = np.dtype([(name, _ORDERS[form] + kind) for name, kind in fields])
    if len(body) < count * row.itemsize:
        raise ValueError("it ends before its vertices do")
    records = np.frombuffer(body, row, count)
    return _numbered(np.column_stack([records[axis].astype(float) for axis in "xyz"]))
