"""Text descriptions of calibration targets, and the target points that they define.

An example is `charuco:5x7,square=0.04,marker=0.03,dict=4X4_50`. The frame of a target (docs/conventions.md): x to the
right along the printed page, y up the page, z out of it, towards the viewer.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.validation import (
    check_bool,
    check_choice,
    check_finite,
    check_finite_rows,
    check_integer,
    check_number,
    check_sequence,
    check_type,
    format_value,
)
from sylpose.input_limits import to_one_line
from sylpose.units import MissingUnitError, parse_length

# One example of each kind.
EXAMPLES = (
    "charuco:5x7,square=40mm,marker=30mm,dict=4X4_50",
    "chessboard:9x6,square=25mm",
    "circles:7x5,spacing=30mm,diameter=18mm",
    "acircles:4x11,spacing=20mm,diameter=12mm",
    "apriltag:36h11,id=3,size=80mm",
    "aruco:4X4_50,id=0,size=50mm",
    "aprilgrid:6x6,size=88mm,gap=0.3",
)
# OpenCV's dictionaries without their prefix DICT_ (OpenCV 4.8), by upper-case name.
DICTIONARIES = {
    name.upper(): name
    for name in (
        *(f"{n}X{n}_{size}" for n in (4, 5, 6, 7) for size in (50, 100, 250, 1000)),
        "ARUCO_ORIGINAL",
        "ARUCO_MIP_36h12",
        *(f"APRILTAG_{family}" for family in ("16h5", "25h9", "36h10", "36h11")),
    )
}
# Maximum number of points per side, of tags, and of border bits (choice).
MAX_SIDE = 100
MAX_TAGS, MAX_BORDER = 10_000, 4


@dataclass(frozen=True, eq=False)
class Board:
    """Calibration target.

    Attributes:
        kind: "charuco", "chessboard", "circles", "acircles", "marker" or "aprilgrid".
        text: its description.
        size: (columns, rows): squares of a ChArUco board, inner corners of a chessboard, circles, tags; (1, 1) of a
            marker.
        points: (N, 3) in its frame, z = 0; detections refer to them by row.
        symmetries: symmetries, as permutations (N,) of the rows of `points`; the first is the identity.
        dictionary: dictionary of its markers, OpenCV's name without DICT_; "" without markers.
        first_id: lowest ID of its markers.
        marker_ratio: ratio of marker to square size of a ChArUco board.
        border: width of the black border around a marker's code, in bits.
        is_upside_down: whether the marker is printed upside down relative to OpenCV's.
        diameter: diameter of its circles.
        is_inverted: whether black and white of a ChArUco board are exchanged.

    Raises:
        TypeError, ValueError: naming an argument that is invalid or does not fit the others.
    """

    kind: str
    text: str
    size: tuple[int, int]
    points: FloatArray
    symmetries: tuple[IntArray, ...]
    dictionary: str = ""
    first_id: int = 0
    marker_ratio: float = 1.0
    border: int = 1
    is_upside_down: bool = False
    diameter: float = 0.0
    is_inverted: bool = False

    def __post_init__(self) -> None:
        sides = check_sequence(self.size, "size", 2, "sides")
        columns, rows = (check_integer(side, "size", minimum=1, maximum=MAX_SIDE) for side in sides)
        counts = {"charuco": (columns - 1) * (rows - 1), "marker": 4, "aprilgrid": 4 * columns * rows}
        kind = check_choice(self.kind, ("charuco", "chessboard", "circles", "acircles", "marker", "aprilgrid"), "kind")
        points = check_finite_rows(self.points, 3, "points")
        n = counts.get(kind, columns * rows)
        if len(points) != n:
            raise ValueError(f"points: {len(points)} for a target of {n}")
        symmetries = tuple(
            check_finite(way, (n,), "symmetries") for way in check_sequence(self.symmetries, "symmetries")
        )
        if not symmetries or any((np.sort(way) != np.arange(n)).any() for way in symmetries):
            raise ValueError(f"symmetries must be permutations of 0 to {n - 1}")
        object.__setattr__(self, "size", (columns, rows))
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "symmetries", tuple(way.astype(np.int64) for way in symmetries))
        check_type(self.text, str, "text")
        if check_type(self.dictionary, str, "dictionary") not in ("", *DICTIONARIES.values()):
            raise ValueError(f"dictionary: {format_value(self.dictionary)} is not one of OpenCV's")
        check_bool(self.is_upside_down, "is_upside_down")
        check_bool(self.is_inverted, "is_inverted")
        check_integer(self.first_id, "first_id", maximum=MAX_TAGS)
        check_integer(self.border, "border", minimum=1, maximum=MAX_BORDER)
        check_number(self.marker_ratio, "marker_ratio", above=0.0, maximum=1.0)
        check_number(self.diameter, "diameter", minimum=0.0)


def is_board(text: str) -> bool:
    """Return whether a text is a target's description, valid or not."""
    kind, colon, _ = text.partition(":")
    return bool(colon) and kind.strip().lower() in _KINDS


def parse_board(text: str, unit: str = "") -> Board:
    """Parse a target's description; `EXAMPLES` has one of each kind.

    Args:
        text: KIND:LAYOUT,KEY=VALUE,...
        unit: unit of the points, the calibration's; lengths are in it unless given with their own unit (`25mm`).

    Returns:
        the target, its points in `unit`.

    Raises:
        TypeError, ValueError: one sentence on what is wrong in the description, and what is expected.
    """
    text, unit = check_type(text, str, "text"), check_type(unit, str, "unit")
    kind, _, rest = text.partition(":")
    kind = kind.strip().lower()
    if not is_board(text):
        raise ValueError(
            f"{_quote(text)} is not a board or marker; expected one such as {EXAMPLES[0]} or {EXAMPLES[1]}; known are "
            f"{', '.join(_KINDS)}"
        )
    layout, *assignments = [part.strip() for part in rest.split(",")]
    values: dict[str, str] = {}
    for assignment in assignments:
        key, equals, value = (part.strip() for part in assignment.partition("="))
        if not equals or not key or not value:
            raise ValueError(f"{_quote(text)}: KEY=VALUE is expected between the commas, got {_quote(assignment)}")
        if key.lower() in values:
            raise ValueError(f"{_quote(text)}: {_quote(key)} is given twice")
        values[key.lower()] = value
    try:
        parsed = _Settings(values, unit)
        board = _KINDS[kind](layout, text, parsed)
        parsed.reject_unknown()
    except MissingUnitError as error:
        raise ValueError(f"{_quote(text)}: {error}") from None
    except ValueError as error:
        example = next(e for e in EXAMPLES if e.startswith(f"{kind}:"))
        raise ValueError(f"{_quote(text)}: {error}; expected one such as {example}") from None
    return board


class _Settings:
    """Settings of a description, with tracking of those used."""

    def __init__(self, values: Mapping[str, str], unit: str) -> None:
        self._values, self._unit, self._used = values, unit, list[str]()

    def text(self, key: str) -> str | None:
        self._used.append(key)
        return self._values.get(key)

    def length(self, key: str) -> float:
        value = self.text(key)
        if value is None:
            raise ValueError(f"{key} is missing")
        return parse_length(value, key, self._unit)

    def integer(self, key: str, default: int | None, maximum: int, minimum: int = 0) -> int:
        value = self.text(key)
        if value is None and default is not None:
            return default
        if value is None:
            raise ValueError(f"{key} is missing")
        if not re.fullmatch(r"[0-9]{1,9}", value) or not minimum <= int(value) <= maximum:
            raise ValueError(f"{key} must be a whole number from {minimum} to {maximum}, got {_quote(value)}")
        return int(value)

    def reject_unknown(self) -> None:
        if unknown := [key for key in self._values if key not in self._used]:
            raise ValueError(f"it has no {_quote(unknown[0])} (known are {', '.join(self._used)})")


def _build_charuco(layout: str, text: str, settings: _Settings) -> Board:
    columns, rows = _parse_sides(layout, "squares")
    square, marker = settings.length("square"), settings.length("marker")
    if not marker < square:
        raise ValueError("marker must be smaller than square")
    dictionary = _parse_dictionary(settings.text("dict") or "")
    # OpenCV counts the inner corners from the top row of the page.
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(1, columns), np.arange(1, rows)))
    points = _make_planar_points(square * column, square * (rows - row))
    is_inverted = bool(settings.integer("inverted", 0, 1))
    sides, ways = (columns, rows), _identity_symmetry(points)
    return Board("charuco", text, sides, points, ways, dictionary, 0, marker / square, is_inverted=is_inverted)


def _build_chessboard(layout: str, text: str, settings: _Settings) -> Board:
    columns, rows = _parse_sides(layout, "inner corners", 3)
    points = _make_grid(columns, rows, settings.length("square"))
    numbers = np.arange(len(points)).reshape(rows, columns)
    # Colors resolve the half rotation if one number of corners is even and the other odd, and the quarter rotation if
    # both are the same odd number.
    rotations = [0] if (columns + rows) % 2 else [0, 1, 2, 3] if columns == rows and columns % 2 == 0 else [0, 2]
    return Board("chessboard", text, (columns, rows), points, tuple(np.rot90(numbers, k).ravel() for k in rotations))


def _build_circles(layout: str, text: str, settings: _Settings) -> Board:
    columns, rows = _parse_sides(layout, "circles", 3)
    spacing = settings.length("spacing")
    points = _make_grid(columns, rows, spacing)
    numbers = np.arange(len(points)).reshape(rows, columns)
    rotations = [0, 1, 2, 3] if columns == rows else [0, 2]
    symmetries = tuple(np.rot90(numbers, k).ravel() for k in rotations)
    return Board("circles", text, (columns, rows), points, symmetries, diameter=_parse_diameter(settings, spacing))


def _build_acircles(layout: str, text: str, settings: _Settings) -> Board:
    columns, rows = _parse_sides(layout, "circles", 3)
    if rows % 2 == 0:
        raise ValueError("an odd number of rows is required: with an even one it is symmetric under half a rotation")
    spacing = settings.length("spacing")
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(rows)))
    points = _make_planar_points(2 * column + row % 2, rows - 1 - row) * spacing
    diameter = _parse_diameter(settings, np.sqrt(2.0) * spacing)
    return Board("acircles", text, (columns, rows), points, _identity_symmetry(points), diameter=diameter)


def _parse_diameter(settings: _Settings, center_distance: float) -> float:
    diameter = settings.length("diameter")
    if not diameter < center_distance:
        raise ValueError("diameter must be less than the distance between the circles' centers")
    return diameter


def _build_marker(name: str, text: str, settings: _Settings, is_upside_down: bool) -> Board:
    dictionary = _parse_dictionary(name)
    half = settings.length("size") / 2
    points = _make_planar_points(np.array([-half, half, half, -half]), np.array([half, half, -half, -half]))
    number, border = settings.integer("id", None, MAX_TAGS), settings.integer("border", 1, MAX_BORDER, minimum=1)
    return Board(
        "marker", text, (1, 1), points, _identity_symmetry(points), dictionary, number, 1.0, border, is_upside_down
    )


def _build_aprilgrid(layout: str, text: str, settings: _Settings) -> Board:
    columns, rows = _parse_sides(layout, "tags")
    size = settings.length("size")
    gap = settings.text("gap")
    try:
        share = float(gap or "")
    except ValueError:
        share = np.nan
    if not 0 < share < MAX_SIDE:
        raise ValueError("gap must be the space between two tags by a tag's size, such as 0.3 (Kalibr's tagSpacing)")
    step = (1 + share) * size
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(rows)))
    # Numbered along the lowest row first, each with its corners counterclockwise from the lower left one.
    corners = np.array([[0, 0], [size, 0], [size, size], [0, size]])
    places = np.asarray(step * np.column_stack([column, row])[:, None] + corners, dtype=float).reshape(-1, 2)
    points = _make_planar_points(places[:, 0], places[:, 1])
    dictionary = _parse_dictionary(_parse_family(settings.text("family") or "36h11"))
    first, border = settings.integer("start", 0, MAX_TAGS), settings.integer("border", 2, MAX_BORDER, minimum=1)
    return Board("aprilgrid", text, (columns, rows), points, _identity_symmetry(points), dictionary, first, 1.0, border)


_KINDS: Mapping[str, Callable[[str, str, _Settings], Board]] = {
    "charuco": _build_charuco,
    "chessboard": _build_chessboard,
    "circles": _build_circles,
    "acircles": _build_acircles,
    # OpenCV draws and reads AprilTags upside down: docs/conventions.md follows the original AprilTag images.
    "apriltag": lambda family, text, settings: _build_marker(_parse_family(family), text, settings, True),
    "aruco": lambda dictionary, text, settings: _build_marker(dictionary, text, settings, False),
    "aprilgrid": _build_aprilgrid,
}


def _parse_sides(layout: str, item: str, minimum: int = 2) -> tuple[int, int]:
    found = re.fullmatch(r"([0-9]{1,4})\s*[xX]\s*([0-9]{1,4})", layout)
    sides = (int(found[1]), int(found[2])) if found else (0, 0)
    if not minimum <= min(sides) <= max(sides) <= MAX_SIDE:
        raise ValueError(
            f"columns and rows of {item} are expected, such as 9x6, {minimum} to {MAX_SIDE} each, got {_quote(layout)}"
        )
    return sides


def _parse_dictionary(name: str) -> str:
    bare = name.upper().removeprefix("DICT_")
    if bare not in DICTIONARIES:
        got = _quote(name) if name else "none"
        raise ValueError(
            "a dictionary of markers is expected, such as 4X4_50, 6X6_250, ARUCO_ORIGINAL or APRILTAG_36h11 "
            f"(OpenCV's), got {got}"
        )
    return DICTIONARIES[bare]


def _parse_family(name: str) -> str:
    """Return the dictionary name of an AprilTag family, 36h11 or tag36h11."""
    bare = name.upper().removeprefix("DICT_").removeprefix("APRILTAG_").removeprefix("TAG")
    return f"APRILTAG_{bare}" if f"APRILTAG_{bare}" in DICTIONARIES else name


def _make_grid(columns: int, rows: int, step: float) -> FloatArray:
    """Return grid points (N, 3), row by row from the lower left."""
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(rows)))
    return _make_planar_points(step * column, step * row)


def _make_planar_points(x: ArrayLike, y: ArrayLike) -> FloatArray:
    """Return points (N, 3) with z = 0 of coordinates (N,)."""
    flat = np.array([x, y], dtype=float).T
    return np.column_stack([flat, np.zeros(len(flat))])


def _identity_symmetry(points: FloatArray) -> tuple[IntArray]:
    return (np.arange(len(points)),)


def _quote(text: str) -> str:
    return ascii(to_one_line(text, 80))
