"""Where cameras see named points in frames, as tables: one of all cameras, or one of each as DeepLabCut writes them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sylpose.capture.names import match_names
from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import MAX_TABLE, one_line, text_of, told
from sylpose.rig import MAX_PX

__all__ = ["LIKELIHOOD", "Sightings", "load_pixels"]

# Points that a network is less sure of count as not seen (choice: DeepLabCut's own pcutoff).
LIKELIHOOD = 0.6
# Words for a column.
_NAMES = {
    "camera": ("camera", "cam"),
    "frame": ("frame",),
    "name": ("name", "point", "bodypart"),
    "u": ("u", "x"),
    "v": ("v", "y"),
    "likelihood": ("likelihood", "score", "confidence"),
    "time": ("time",),
}
_NEEDED = ("camera", "frame", "name", "u", "v")
MOST_FRAME = 2**53


@dataclass(frozen=True, eq=False)
class Sightings:
    """What cameras see.

    Attributes:
        frames: their numbers, in order.
        times: seconds by frame, where the tables say them.
        seen: by frame and camera, (2,) pixels by the name of a point.
        names: of all points, in the order in which they are first named.
    """

    frames: tuple[int, ...]
    times: Mapping[int, float]
    seen: Mapping[tuple[int, str], Mapping[str, FloatArray]]
    names: tuple[str, ...]


class _Collected:
    """Rows as they are read."""

    def __init__(self, least: float) -> None:
        self.least = least
        self.seen = dict[tuple[int, str], dict[str, FloatArray]]()
        self.times = dict[int, float]()
        self.frames, self.names = set[int](), dict[str, None]()

    def take(self, frame: int, camera: str, name: str, u: float, v: float, likelihood: float) -> None:
        """Raises ValueError: a point that is there twice, or pixels that are none."""
        self.frames.add(frame)
        self.names[name] = None
        if np.isnan([u, v]).any() or not likelihood >= self.least:
            return
        if not max(abs(u), abs(v)) <= MAX_PX:
            raise ValueError(f"{u}, {v} is no pixel")
        points = self.seen.setdefault((frame, camera), {})
        if name in points:
            raise ValueError(f"{camera} sees {name!r} twice in frame {frame}")
        points[name] = np.array([u, v])


def load_pixels(
    files: Sequence[Path], cameras: Sequence[str], named: Mapping[str, str] | None = None, least: float = LIKELIHOOD
) -> Sightings:
    """Reads tables `camera,frame,name,u,v` (`likelihood` and `time` may follow), of all cameras, or DeepLabCut's, of one
    camera each: the one that the file's name begins with.

    Args:
        cameras: of the rig.
        named: by camera, files whose names do not tell it.
        least: likelihood of a point that counts as seen.

    Raises:
        FileNotFoundError: naming a file that is not there.
        ValueError: naming the file and the line: another table, an unknown camera, a point that is there twice.
    """
    found, own = _Collected(least), {Path(file): camera for camera, file in (named or {}).items()}
    if unknown := [camera for camera in (named or {}) if camera not in cameras]:
        raise ValueError(f"--video: no camera {', '.join(unknown)} in the calibration ({', '.join(cameras)})")
    by = dict[str, Path]()
    for path in [*files, *own]:
        text = text_of(path, MAX_TABLE)
        with told(path):
            rows = csv.reader(io.StringIO(text, newline=""))
            header = [cell.strip() for cell in next(rows, [])]
            if header[:1] == ["scorer"]:
                camera = own.get(path) or _camera_of(path, cameras)
                if camera in by:
                    raise ValueError(f"of {camera}, as {by[camera].name} is")
                by[camera] = path
                _from_network(rows, camera, found)
            elif path in own:
                raise ValueError(
                    "one camera's table, as DeepLabCut writes it, is expected: its first line begins with scorer"
                )
            else:
                _from_table(rows, header, cameras, found)
    return Sightings(tuple(sorted(found.frames)), found.times, found.seen, tuple(found.names))


def _camera_of(path: Path, cameras: Sequence[str]) -> str:
    """DeepLabCut puts the name of its network behind that of the video."""
    stem = re.split(r"DLC|DeepCut", path.stem, maxsplit=1)[0].rstrip("_-. ") or path.stem
    camera = match_names([stem], cameras).get(stem)
    if camera is None:
        raise ValueError(
            f"its name begins with that of no camera ({', '.join(cameras)}); --video NAME=FILE says whose it is"
        )
    return camera


def _from_network(rows: Iterator[Sequence[str]], camera: str, found: _Collected) -> None:
    """The rest of DeepLabCut's table: `bodyparts`, `coords`, then a row for each frame."""
    parts, coords = ([cell.strip() for cell in next(rows, [])] for _ in range(2))
    if parts[:1] == ["individuals"]:
        raise ValueError("of several animals: one object's points are expected")
    if parts[:1] != ["bodyparts"] or coords[:1] != ["coords"] or len(parts) != len(coords):
        raise ValueError("lines 2 and 3 of DeepLabCut's table are bodyparts and coords")
    columns = dict[str, dict[str, int]]()
    for k, (part, what) in enumerate(zip(parts[1:], coords[1:], strict=True), start=1):
        if what in columns.setdefault(part, {}):
            raise ValueError(f"line 3: {one_line(what, 40)} of {one_line(part, 40)} is there twice")
        columns[part][what] = k
    for part, its in columns.items():
        if not {"x", "y"} <= its.keys() <= {"x", "y", "likelihood"}:
            raise ValueError(f"line 3: x, y and likelihood of {one_line(part, 60)} are expected")
    for number, row in enumerate(rows, start=4):
        if not any(cell.strip() for cell in row):
            continue
        try:
            if len(row) != len(parts):
                raise ValueError(f"{len(parts)} cells are expected, got {len(row)}")
            frame = _frame(row[0])
            for part, its in columns.items():
                likelihood = _number(row[its["likelihood"]], np.nan) if "likelihood" in its else np.inf
                found.take(frame, camera, part, _number(row[its["x"]]), _number(row[its["y"]]), likelihood)
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None


def _from_table(
    rows: Iterator[Sequence[str]], header: Sequence[str], cameras: Sequence[str], found: _Collected
) -> None:
    at = dict[str, int]()
    for k, cell in enumerate(header):
        what = next((name for name, words in _NAMES.items() if cell.lower() in words), None)
        if what is None or what in at:
            raise ValueError(f"line 1: the column {one_line(cell, 40)!r} is not known, or there twice")
        at[what] = k
    if missing := [name for name in _NEEDED if name not in at]:
        raise ValueError(f"line 1: the columns {','.join(_NEEDED)} are expected; {', '.join(missing)} missing")
    matched = dict[str, str]()
    for number, row in enumerate(rows, start=2):
        if not any(cell.strip() for cell in row):
            continue
        try:
            if len(row) != len(header):
                raise ValueError(f"{len(header)} cells are expected, got {len(row)}")
            word, name = row[at["camera"]].strip(), row[at["name"]].strip()
            if word not in matched:
                camera = match_names([word], cameras).get(word)
                if camera is None:
                    raise ValueError(f"no camera {one_line(word, 60)!r} in the calibration ({', '.join(cameras)})")
                matched[word] = camera
            if not name:
                raise ValueError("a point without a name")
            frame = _frame(row[at["frame"]])
            likelihood = _number(row[at["likelihood"]], np.nan) if "likelihood" in at else np.inf
            if "time" in at:
                time = _number(row[at["time"]])
                if not np.isfinite(time) or found.times.setdefault(frame, time) != time:
                    raise ValueError(f"frame {frame} has no time, or two")
            found.take(frame, matched[word], name, _number(row[at["u"]]), _number(row[at["v"]]), likelihood)
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None


def _frame(cell: str) -> int:
    number = _number(cell)
    if not 0 <= number <= MOST_FRAME or number != round(number):
        raise ValueError(f"{one_line(cell, 40)!r} is no frame's number")
    return int(number)


def _number(cell: str, empty: float = np.nan) -> float:
    try:
        return float(cell) if cell.strip() else empty
    except ValueError:
        raise ValueError(f"{one_line(cell, 40)!r} is no number") from None
