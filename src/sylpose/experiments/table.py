"""The tables of the studies: long ones, a row per scene, method and level, with quartiles over the trials."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray

__all__ = ["ERROR_COLUMNS", "Cell", "Table", "error_columns", "quartiles"]

Cell = str | int | float | None

# What `error_columns` makes of the errors of all trials.
ERROR_COLUMNS = ("trials", "failed", "certified", "q25_deg", "median_deg", "q75_deg")


class Table(NamedTuple):
    """What a study found.

    Attributes:
        columns: names, with the unit at their end where there is one.
        rows: as many cells each as there are columns; None where there is no value.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def where(self, **equal: Cell) -> Table:
        """The rows whose cells are those, by column name."""
        index = {self.columns.index(name): value for name, value in equal.items()}
        return Table(self.columns, tuple(r for r in self.rows if all(r[i] == v for i, v in index.items())))

    def distinct(self, column: str) -> list[Cell]:
        """The values of a column, each once, in the order of the rows."""
        return list(dict.fromkeys(row[self.columns.index(column)] for row in self.rows))

    def numbers(self, column: str) -> FloatArray:
        """(n,) a column of numbers; NaN where there is none."""
        i = self.columns.index(column)
        return np.array([np.nan if row[i] is None else row[i] for row in self.rows], dtype=float)

    def value(self, column: str, **equal: Cell) -> float:
        """The number in the one row whose cells are those.

        Raises:
            ValueError: no such row, or several.
        """
        (value,) = self.where(**equal).numbers(column)
        return float(value)

    def csv(self) -> str:
        """Text with a header; floats to six digits, and nothing where there is no value."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([_text(cell) for cell in row] for row in self.rows)
        return out.getvalue()


def _text(cell: Cell) -> str:
    if cell is None or cell != cell:  # NaN
        return ""
    return f"{cell:.6g}" if isinstance(cell, float) else str(cell)


def quartiles(values: ArrayLike) -> tuple[float, float, float]:
    """First quartile, median and third quartile of the numbers among the values; NaN without any."""
    numbers = np.asarray(values, dtype=float)
    numbers = numbers[np.isfinite(numbers)]
    if not numbers.size:
        return np.nan, np.nan, np.nan
    q25, median, q75 = np.quantile(numbers, [0.25, 0.5, 0.75])
    return float(q25), float(median), float(q75)


def error_columns(errors: Sequence[float], certified: Iterable[bool | None]) -> tuple[Cell, ...]:
    """The `ERROR_COLUMNS` of some trials: how many, how many without an answer (NaN), the share whose answer is proved
    the global optimum (None where the method proves nothing), and quartiles of the others' errors."""
    proofs = [c for c in certified if c is not None]
    share = float(np.mean(proofs)) if proofs else None
    failed = int((~np.isfinite(errors)).sum())
    return len(errors), failed, share, *quartiles(errors)
