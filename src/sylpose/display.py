"""Text representations of results and cameras: `repr`, `print` and notebook tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import MAX_SENTENCE_LENGTH, to_one_line

# Significant digits of a value and of a standard deviation (choice).
VALUE_DIGITS, SD_DIGITS = 3, 2
# Rows printed at most; the rest is counted (choice).
MAX_ROWS = 12
# A rotation by less than this is zero, radians (choice: rounding).
ZERO_ANGLE = 1e-9


class Summary(NamedTuple):
    """Summary of an object, from which its text representations are made.

    Attributes:
        brief: a few words, for `repr`.
        rows: labels and their texts.
        sentence: first line of `print` and notebook tables; "" for `brief`.
    """

    brief: str
    rows: Sequence[tuple[str, str]] = ()
    sentence: str = ""


class Printable:
    """Base class of objects with text representations made from `_summary`.

    Dataclasses need `repr=False`.
    """

    def _summary(self) -> Summary:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {to_one_line(self._summary().brief, MAX_SENTENCE_LENGTH)}>"

    def __str__(self) -> str:
        brief, rows, sentence = self._summary()
        width = max((len(label) for label, _ in rows), default=0)
        lines = [f"  {to_one_line(label):{width}}  {to_one_line(text, MAX_SENTENCE_LENGTH)}" for label, text in rows]
        return "\n".join([f"{type(self).__name__}: {to_one_line(sentence or brief, MAX_SENTENCE_LENGTH)}", *lines])

    def _repr_html_(self) -> str:
        brief, rows, sentence = self._summary()
        left = "style='text-align: left'"
        body = "".join(
            f"<tr><th {left}>{_escape_html(label)}</th><td {left}>{_escape_html(text)}</td></tr>"
            for label, text in rows
        )
        return (
            f"<div><b>{_escape_html(type(self).__name__)}</b>: {_escape_html(sentence or brief)}"
            f"<table>{body}</table></div>"
        )


def _escape_html(text: str) -> str:
    """Escape text for HTML: names come from files and must not be interpreted as markup."""
    return escape(to_one_line(text, MAX_SENTENCE_LENGTH))


def truncate_rows(rows: Sequence[tuple[str, str]], noun: str = "camera") -> list[tuple[str, str]]:
    """Return the first rows, and one that counts the rest."""
    n_more = len(rows) - MAX_ROWS
    return [*rows[:MAX_ROWS], *([("", f"and {n_more} {noun}{'s' if n_more > 1 else ''} more")] if n_more > 0 else [])]


def format_length(value: float, unit: str) -> str:
    """Format a length to three digits, in millimeters below one meter."""
    scale, unit = _display_unit(value, unit)
    return f"{scale * value:.{_count_decimals(scale * value, VALUE_DIGITS)}f} {unit}"


def format_lengths(values: FloatArray, sigma: FloatArray, unit: str) -> str:
    """Format three lengths with their standard deviations."""
    scale, unit = _display_unit(_max_abs(values), unit)
    return f"{format_with_sd(scale * values, scale * sigma)} {unit}"


def _display_unit(size: float, unit: str) -> tuple[float, str]:
    return (1000.0, "mm") if unit == "m" and abs(size) < 1 else (1.0, unit or "units")


def format_with_sd(values: FloatArray, sigma: FloatArray) -> str:
    """Format numbers with their standard deviations, to the digits that these justify."""
    finite_sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    digits = (
        _count_decimals(finite_sigma.min(), SD_DIGITS)
        if len(finite_sigma)
        else _count_decimals(_max_abs(values), VALUE_DIGITS)
    )
    return f"{format_vector(values, digits)} ± {format_vector(sigma, digits)}"


def format_vector(values: FloatArray, digits: int = 2) -> str:
    """Format numbers in parentheses with a fixed number of decimals."""
    # Adding 0 turns -0 into 0.
    texts = (f"{round(v, digits) + 0.0:.{digits}f}" if math.isfinite(v) else "unknown" for v in values.tolist())
    return f"({', '.join(texts)})"


def format_position(position: FloatArray) -> str:
    """Format a position in the calibration's unit, to a thousandth of its largest coordinate."""
    return format_vector(position, _count_decimals(_max_abs(position), VALUE_DIGITS + 1))


def format_rotation(rotation: Rotation, covariance: FloatArray | None = None) -> str:
    """Format a rotation as angle and axis, with standard deviations if a covariance is given.

    Args:
        rotation: the rotation.
        covariance: (3, 3) about the x, y and z axes, rad²; None to omit standard deviations.
    """
    w = rotation.as_rotvec()
    angle = float(np.linalg.norm(w))
    sigma = np.empty(0) if covariance is None else np.degrees(np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    finite_sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    digits = (
        _count_decimals(finite_sigma.min(), SD_DIGITS)
        if len(finite_sigma)
        else _count_decimals(np.degrees(angle), VALUE_DIGITS)
    )
    text = f"{np.degrees(angle):.{digits}f}°"
    text += f" about {format_vector(w / angle)}" if angle > ZERO_ANGLE else ""
    return text if covariance is None else f"{text}, ± {format_vector(sigma, digits)}° about x, y, z"


def format_inliers(inliers: int, matches: int, residual: float) -> str:
    """Format one camera's number of inliers and its residual in pixels."""
    return f"{inliers} of {matches} matches" + (f", residual {residual:.2f} px" if math.isfinite(residual) else "")


def format_optimality(certified: bool, candidates: int = 1) -> tuple[str, str]:
    """Return the row (label, text) on global optimality and the number of other minima."""
    others = f", one of {candidates} minima" if candidates > 1 else ""
    return "optimum", ("proved to be the global one" if certified else f"not proved to be the global one{others}")


def _max_abs(values: FloatArray) -> float:
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def _count_decimals(size: float, digits: int) -> int:
    """Return the decimals that give a number of this size so many significant digits."""
    return min(max(digits - 1 - math.floor(math.log10(abs(size))), 0), 9) if size and math.isfinite(size) else 0
