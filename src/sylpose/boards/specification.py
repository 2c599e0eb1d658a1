"""Calibration targets in words, such as `charuco:5x7,square=0.04,marker=0.03,dict=4X4_50`, and the points on them.

The frame of a target (docs/conventions.md): x to the right along the page as it was printed, y up the page, z out of it,
towards whoever looks at it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.validation import finite, finite_rows, items, kind_of, number, one_of, shown, truth, whole
from sylpose.input_limits import one_line
from sylpose.units import NoUnit, length_of

__all__ = ["EXAMPLES", "Board", "is_board", "parse_board"]

# One of each kind, as it is typed.
EXAMPLES = (
    "charuco:5x7,square=40mm,marker=30mm,dict=4X4_50",
    "chessboard:9x6,square=25mm",
    "circles:7x5,spacing=30mm,diameter=18mm",
    "acircles:4x11,spacing=20mm,diameter=12mm",
    "apriltag:36h11,id=3,size=80mm",
    "aruco:4X4_50,id=0,size=50mm",
    "aprilgrid:6x6,size=88mm,gap=0.3",
)
# OpenCV's dictionaries without their prefix DICT_ (OpenCV 4.8), by what is told apart of a name: its capitals.
DICTIONARIES = {
    name.upper(): name
    for name in (
        *(f"{n}X{n}_{size}" for n in (4, 5, 6, 7) for size in (50, 100, 250, 1000)),
        "ARUCO_ORIGINAL",
        "ARUCO_MIP_36h12",
        *(f"APRILTAG_{family}" for family in ("16h5", "25h9", "36h10", "36h11")),
    )
}
# No target has more points a side (choice).
MOST_A_SIDE = 100
MOST_TAGS, MOST_BORDER = 10_000, 4


@dataclass(frozen=True, eq=False)
class Board:
    """A calibration target.

    Attributes:
        kind: "charuco", "chessboard", "circles", "acircles", "marker" or "aprilgrid".
        text: as it was typed.
        size: (columns, rows): squares of a ChArUco board, inner corners of a chessboard, circles, tags; (1, 1) of a marker.
        points: (N, 3) in its frame, z = 0; detections name them by their rows.
        alike: rows of `points` (N,) in the order in which it looks the same after a turn; the first is no turn at all.
        dictionary: of its markers, OpenCV's name without DICT_; "" without any.
        first_id: the least of its markers' numbers.
        marker_share: a ChArUco board's marker by its square.
        border: black bits around a marker's code.
        half_turned: the marker is printed upside down, as OpenCV has it.
        diameter: of its circles.

    Raises:
        TypeError, ValueError: naming what is none of these, or does not fit the others.
    """

    kind: str
    text: str
    size: tuple[int, int]
    points: FloatArray
    alike: tuple[IntArray, ...]
    dictionary: str = ""
    first_id: int = 0
    marker_share: float = 1.0
    border: int = 1
    half_turned: bool = False
    diameter: float = 0.0

    def __post_init__(self) -> None:
        columns, rows = (
            whole(side, "size", least=1, most=MOST_A_SIDE) for side in items(self.size, "size", 2, "sides")
        )
        counts = {"charuco": (columns - 1) * (rows - 1), "marker": 4, "aprilgrid": 4 * columns * rows}
        kind = one_of(self.kind, ("charuco", "chessboard", "circles", "acircles", "marker", "aprilgrid"), "kind")
        points = finite_rows(self.points, 3, "points")
        n = counts.get(kind, columns * rows)
        if len(points) != n:
            raise ValueError(f"points: {len(points)} for a target of {n}")
        alike = tuple(finite(way, (n,), "alike") for way in items(self.alike, "alike"))
        if not alike or any((np.sort(way) != np.arange(n)).any() for way in alike):
            raise ValueError(f"alike must have the numbers 0 to {n - 1} in some order each")
        object.__setattr__(self, "size", (columns, rows))
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "alike", tuple(way.astype(np.int64) for way in alike))
        kind_of(self.text, str, "text")
        if kind_of(self.dictionary, str, "dictionary") not in ("", *DICTIONARIES.values()):
            raise ValueError(f"dictionary: {shown(self.dictionary)} is none of OpenCV's")
        truth(self.half_turned, "half_turned")
        whole(self.first_id, "first_id", most=MOST_TAGS)
        whole(self.border, "border", least=1, most=MOST_BORDER)
        number(self.marker_share, "marker_share", above=0.0, most=1.0)
        number(self.diameter, "diameter", least=0.0)


def is_board(text: str) -> bool:
    """Whether a text is a description of a target, right or wrong."""
    kind, colon, _ = text.partition(":")
    return bool(colon) and kind.strip().lower() in _KINDS


def parse_board(text: str, unit: str = "") -> Board:
    """A target as users describe it; `EXAMPLES` has one of each kind.

    Args:
        text: KIND:WHAT,KEY=VALUE,...
        unit: of the points, the calibration's; lengths are in it, unless one has a unit of its own (`25mm`).

    Raises:
        TypeError, ValueError: in one sentence, what of the description is wrong, and what was expected.
    """
    text, unit = kind_of(text, str, "text"), kind_of(unit, str, "unit")
    kind, _, rest = text.partition(":")
    kind = kind.strip().lower()
    if not is_board(text):
        raise ValueError(
            f"{_shown(text)} is no board or marker: expected is one such as {EXAMPLES[0]} or {EXAMPLES[1]}; known are "
            f"{', '.join(_KINDS)}"
        )
    what, *settings = [part.strip() for part in rest.split(",")]
    values: dict[str, str] = {}
    for setting in settings:
        key, equals, value = (part.strip() for part in setting.partition("="))
        if not equals or not key or not value:
            raise ValueError(f"{_shown(text)}: KEY=VALUE is expected between the commas, got {_shown(setting)}")
        if key.lower() in values:
            raise ValueError(f"{_shown(text)}: {_shown(key)} is given twice")
        values[key.lower()] = value
    try:
        asked = _Asked(values, unit)
        board = _KINDS[kind](what, text, asked)
        asked.nothing_else()
    except NoUnit as error:
        raise ValueError(f"{_shown(text)}: {error}") from None
    except ValueError as error:
        example = next(e for e in EXAMPLES if e.startswith(f"{kind}:"))
        raise ValueError(f"{_shown(text)}: {error}; expected is one such as {example}") from None
    return board


class _Asked:
    """The settings of a description, each taken once."""

    def __init__(self, values: Mapping[str, str], unit: str) -> None:
        self._values, self._unit, self._known = values, unit, list[str]()

    def text(self, key: str) -> str | None:
        self._known.append(key)
        return self._values.get(key)

    def length(self, key: str) -> float:
        value = self.text(key)
        if value is None:
            raise ValueError(f"{key} is missing")
        return length_of(value, key, self._unit)

    def whole(self, key: str, otherwise: int | None, most: int) -> int:
        value = self.text(key)
        if value is None and otherwise is not None:
            return otherwise
        if value is None or not re.fullmatch(r"[0-9]{1,9}", value) or int(value) > most:
            got = "is missing" if value is None else f"must be a whole number from 0 to {most}, got {_shown(value)}"
            raise ValueError(f"{key} {got}")
        return int(value)

    def nothing_else(self) -> None:
        if unknown := [key for key in self._values if key not in self._known]:
            raise ValueError(f"it has no {_shown(unknown[0])} (known are {', '.join(self._known)})")


def _charuco(what: str, text: str, asked: _Asked) -> Board:
    columns, rows = _sides(what, "squares")
    square, marker = asked.length("square"), asked.length("marker")
    if not marker < square:
        raise ValueError("marker must be smaller than square")
    dictionary = _dictionary(asked.text("dict") or "")
    # OpenCV counts the inner corners from the top row of the page.
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(1, columns), np.arange(1, rows)))
    points = _plane(square * column, square * (rows - row))
    return Board("charuco", text, (columns, rows), points, _as_it_is(points), dictionary, 0, marker / square)


def _chessboard(what: str, text: str, asked: _Asked) -> Board:
    columns, rows = _sides(what, "inner corners", 3)
    points = _grid(columns, rows, asked.length("square"))
    numbers = np.arange(len(points)).reshape(rows, columns)
    # Colours tell a half turn where one number of corners is even and the other odd; where both are the same odd number,
    # they tell a quarter turn.
    turns = [0] if (columns + rows) % 2 else [0, 1, 2, 3] if columns == rows and columns % 2 == 0 else [0, 2]
    return Board("chessboard", text, (columns, rows), points, tuple(np.rot90(numbers, k).ravel() for k in turns))


def _circles(what: str, text: str, asked: _Asked) -> Board:
    columns, rows = _sides(what, "circles", 3)
    spacing = asked.length("spacing")
    points = _grid(columns, rows, spacing)
    numbers = np.arange(len(points)).reshape(rows, columns)
    turns = [0, 1, 2, 3] if columns == rows else [0, 2]
    alike = tuple(np.rot90(numbers, k).ravel() for k in turns)
    return Board("circles", text, (columns, rows), points, alike, diameter=_diameter(asked, spacing))


def _acircles(what: str, text: str, asked: _Asked) -> Board:
    columns, rows = _sides(what, "circles", 3)
    if rows % 2 == 0:
        raise ValueError("of an even number of rows it looks the same after half a turn: an odd one is expected")
    spacing = asked.length("spacing")
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(rows)))
    points = _plane(2 * column + row % 2, rows - 1 - row) * spacing
    diameter = _diameter(asked, np.sqrt(2.0) * spacing)
    return Board("acircles", text, (columns, rows), points, _as_it_is(points), diameter=diameter)


def _diameter(asked: _Asked, apart: float) -> float:
    diameter = asked.length("diameter")
    if not diameter < apart:
        raise ValueError("diameter must be less than what lies between the circles' centres")
    return diameter


def _apriltag(what: str, text: str, asked: _Asked) -> Board:
    # OpenCV draws and reads AprilTags upside down: docs/conventions.md takes the images of those who made them.
    return _marker(_dictionary(_family(what)), text, asked, half_turned=True)


def _aruco(what: str, text: str, asked: _Asked) -> Board:
    return _marker(_dictionary(what), text, asked, half_turned=False)


def _marker(dictionary: str, text: str, asked: _Asked, *, half_turned: bool) -> Board:
    half = asked.length("size") / 2
    points = _plane(np.array([-half, half, half, -half]), np.array([half, half, -half, -half]))
    number, border = asked.whole("id", None, MOST_TAGS), _border(asked, 1)
    return Board("marker", text, (1, 1), points, _as_it_is(points), dictionary, number, 1.0, border, half_turned)


def _aprilgrid(what: str, text: str, asked: _Asked) -> Board:
    columns, rows = _sides(what, "tags")
    size = asked.length("size")
    gap = asked.text("gap")
    try:
        share = float(gap or "")
    except ValueError:
        share = np.nan
    if not 0 < share < MOST_A_SIDE:
        raise ValueError("gap must be the space between two tags by a tag's size, such as 0.3 (Kalibr's tagSpacing)")
    step = (1 + share) * size
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(rows)))
    # Numbered along the lowest row first, each with its corners from the lower left one around against the clock.
    corners = np.array([[0, 0], [size, 0], [size, size], [0, size]])
    places = np.asarray(step * np.column_stack([column, row])[:, None] + corners, dtype=float).reshape(-1, 2)
    points = _plane(places[:, 0], places[:, 1])
    dictionary = _dictionary(_family(asked.text("family") or "36h11"))
    first, border = asked.whole("start", 0, MOST_TAGS), _border(asked, 2)
    return Board("aprilgrid", text, (columns, rows), points, _as_it_is(points), dictionary, first, 1.0, border)


_KINDS: Mapping[str, Callable[[str, str, _Asked], Board]] = {
    "charuco": _charuco,
    "chessboard": _chessboard,
    "circles": _circles,
    "acircles": _acircles,
    "apriltag": _apriltag,
    "aruco": _aruco,
    "aprilgrid": _aprilgrid,
}


def _sides(what: str, of: str, least: int = 2) -> tuple[int, int]:
    found = re.fullmatch(r"([0-9]{1,4})\s*[xX]\s*([0-9]{1,4})", what)
    sides = (int(found[1]), int(found[2])) if found else (0, 0)
    if not least <= min(sides) <= max(sides) <= MOST_A_SIDE:
        raise ValueError(
            f"columns and rows of {of} are expected, such as 9x6, {least} to {MOST_A_SIDE} each, got {_shown(what)}"
        )
    return sides


def _dictionary(name: str) -> str:
    bare = name.upper().removeprefix("DICT_")
    if bare not in DICTIONARIES:
        got = _shown(name) if name else "none"
        raise ValueError(
            "a dictionary of markers is expected, such as 4X4_50, 6X6_250, ARUCO_ORIGINAL or APRILTAG_36h11 (OpenCV's), "
            f"got {got}"
        )
    return DICTIONARIES[bare]


def _family(name: str) -> str:
    """The name of a family of AprilTags, 36h11 or tag36h11, as a dictionary's."""
    bare = name.upper().removeprefix("DICT_").removeprefix("APRILTAG_").removeprefix("TAG")
    return f"APRILTAG_{bare}" if f"APRILTAG_{bare}" in DICTIONARIES else name


def _border(asked: _Asked, otherwise: int) -> int:
    border = asked.whole("border", otherwise, MOST_BORDER)
    if border < 1:
        raise ValueError("border must be at least 1 bit")
    return border


def _grid(columns: int, rows: int, step: float) -> FloatArray:
    """(N, 3) row by row from the lower left."""
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(rows)))
    return _plane(step * column, step * row)


def _plane(x: ArrayLike, y: ArrayLike) -> FloatArray:
    """(N, 3) of coordinates (N,)."""
    flat = np.array([x, y], dtype=float).T
    return np.column_stack([flat, np.zeros(len(flat))])


def _as_it_is(points: FloatArray) -> tuple[IntArray]:
    return (np.arange(len(points)),)


def _shown(text: str) -> str:
    return ascii(one_line(text, 80))
