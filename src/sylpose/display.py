"""What results and cameras say of themselves: a line for `repr`, some lines for `print`, a table in a notebook."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import SENTENCE, one_line

__all__ = [
    "Telling",
    "Told",
    "inliers_told",
    "length",
    "lengths",
    "named",
    "place_told",
    "proof_told",
    "spread",
    "turned",
    "vector",
]

# So many digits of a number are for people, and so many of a standard deviation (choice).
DIGITS, SD_DIGITS = 3, 2
# So many of a kind are named; of the others it is said how many they are (choice).
NAMED = 12
# A turn by less than this is none, radians (choice: rounding).
NO_TURN = 1e-9


class Telling(NamedTuple):
    """What something says of itself.

    Attributes:
        brief: a few words.
        rows: labels, and what there is to say.
        sentence: what its first line says instead of the few words; "" for those.
    """

    brief: str
    rows: Sequence[tuple[str, str]] = ()
    sentence: str = ""


class Told:
    """Something that says what it is: its class has `_told`, and `repr=False` where it is a dataclass."""

    def _told(self) -> Telling:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {one_line(self._told().brief, SENTENCE)}>"

    def __str__(self) -> str:
        brief, rows, sentence = self._told()
        width = max((len(label) for label, _ in rows), default=0)
        lines = [f"  {one_line(label):{width}}  {one_line(said, SENTENCE)}" for label, said in rows]
        return "\n".join([f"{type(self).__name__}: {one_line(sentence or brief, SENTENCE)}", *lines])

    def _repr_html_(self) -> str:
        brief, rows, sentence = self._told()
        left = "style='text-align: left'"
        body = "".join(f"<tr><th {left}>{_html(label)}</th><td {left}>{_html(said)}</td></tr>" for label, said in rows)
        return f"<div><b>{_html(type(self).__name__)}</b>: {_html(sentence or brief)}<table>{body}</table></div>"


def _html(text: str) -> str:
    """Names come from files: nothing in them is markup."""
    return escape(one_line(text, SENTENCE))


def named(rows: Sequence[tuple[str, str]], what: str = "camera") -> list[tuple[str, str]]:
    """The first of them, and how many more there are."""
    rest = len(rows) - NAMED
    return [*rows[:NAMED], *([("", f"and {rest} {what}{'s' if rest > 1 else ''} more")] if rest > 0 else [])]


def length(value: float, unit: str) -> str:
    """A length for people, to three digits: millimetres below one metre."""
    scale, unit = _readable(value, unit)
    return f"{scale * value:.{_decimals(scale * value, DIGITS)}f} {unit}"


def lengths(values: FloatArray, sigma: FloatArray, unit: str) -> str:
    """Three lengths and their standard deviations."""
    scale, unit = _readable(_largest(values), unit)
    return f"{spread(scale * values, scale * sigma)} {unit}"


def _readable(size: float, unit: str) -> tuple[float, str]:
    return (1000.0, "mm") if unit == "m" and abs(size) < 1 else (1.0, unit or "units")


def spread(values: FloatArray, sigma: FloatArray) -> str:
    """Numbers and their standard deviations, to as many digits as these leave them."""
    sure = sigma[np.isfinite(sigma) & (sigma > 0)]
    digits = _decimals(sure.min(), SD_DIGITS) if len(sure) else _decimals(_largest(values), DIGITS)
    return f"{vector(values, digits)} ± {vector(sigma, digits)}"


def vector(values: FloatArray, digits: int = 2) -> str:
    """Numbers in parentheses, so many digits behind the point."""
    # Added to 0, a number that rounds to -0 is 0.
    said = (f"{round(v, digits) + 0.0:.{digits}f}" if math.isfinite(v) else "unknown" for v in values.tolist())
    return f"({', '.join(said)})"


def place_told(place: FloatArray) -> str:
    """A place in the calibration's unit, to a thousandth of how far away it is."""
    return vector(place, _decimals(_largest(place), DIGITS + 1))


def turned(rotation: Rotation, covariance: FloatArray | None = None) -> str:
    """By how much and about what; with the standard deviations about x, y and z, by the covariance (3, 3), radians."""
    w = rotation.as_rotvec()
    angle = float(np.linalg.norm(w))
    sigma = np.empty(0) if covariance is None else np.degrees(np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    sure = sigma[np.isfinite(sigma) & (sigma > 0)]
    digits = _decimals(sure.min(), SD_DIGITS) if len(sure) else _decimals(np.degrees(angle), DIGITS)
    said = f"{np.degrees(angle):.{digits}f}°"
    said += f" about {vector(w / angle)}" if angle > NO_TURN else ""
    return said if covariance is None else f"{said}, ± {vector(sigma, digits)}° about x, y, z"


def inliers_told(inliers: int, matches: int, residual: float) -> str:
    """Of one camera, with the residual in pixels."""
    return f"{inliers} of {matches} matches" + (f", residual {residual:.2f} px" if math.isfinite(residual) else "")


def proof_told(certified: bool, candidates: int = 1) -> tuple[str, str]:
    """A row that says whether a rotation is proved to be the best one, and how many others were found."""
    others = f", one of {candidates} minima" if candidates > 1 else ""
    return "optimum", ("proved to be the global one" if certified else f"not proved to be the global one{others}")


def _largest(values: FloatArray) -> float:
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def _decimals(size: float, digits: int) -> int:
    """Behind the point, that a number of this size has so many digits."""
    return min(max(digits - 1 - math.floor(math.log10(abs(size))), 0), 9) if size and math.isfinite(size) else 0
