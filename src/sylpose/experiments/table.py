"""Tables of the studies in long format: one row per scene, method and level, with quartiles over the trials."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray

Cell = str | int | float | None

# Columns computed by `compute_error_cells` from the errors of all trials.
ERROR_COLUMNS = ("trials", "failed", "certified", "q25_deg", "median_deg", "q75_deg")


class Table(NamedTuple):
    """Result table of a study.

    Attributes:
        columns: names, ending with the unit if there is one.
        rows: one cell per column; None if there is no value.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def filter_rows(self, **equal: Cell) -> Table:
        """Return the rows with these cell values, by column name."""
        index = {self.columns.index(name): value for name, value in equal.items()}
        return Table(self.columns, tuple(r for r in self.rows if all(r[i] == v for i, v in index.items())))

    def distinct(self, column: str) -> list[Cell]:
        """Return the distinct values of a column, in the order of the rows."""
        return list(dict.fromkeys(row[self.columns.index(column)] for row in self.rows))

    def column_values(self, column: str) -> FloatArray:
        """Return a column of numbers (n,); NaN for missing values."""
        i = self.columns.index(column)
        return np.array([np.nan if row[i] is None else row[i] for row in self.rows], dtype=float)

    def value(self, column: str, **equal: Cell) -> float:
        """Return the number in the one row with these cell values.

        Raises:
            ValueError: there is no such row, or several.
        """
        (value,) = self.filter_rows(**equal).column_values(column)
        return float(value)

    def to_csv(self) -> str:
        """Format as CSV text with a header; floats have six digits, missing values are empty."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([_format_cell(cell) for cell in row] for row in self.rows)
        return out.getvalue()


def _format_cell(cell: Cell) -> str:
    if cell is None or cell != cell:  # NaN
        return ""
    return f"{cell:.6g}" if isinstance(cell, float) else str(cell)


def compute_quartiles(values: ArrayLike) -> tuple[float, float, float]:
    """Return first quartile, median and third quartile of the finite values; NaN without any."""
    numbers = np.asarray(values, dtype=float)
    numbers = numbers[np.isfinite(numbers)]
    if not numbers.size:
        return np.nan, np.nan, np.nan
    q25, median, q75 = np.quantile(numbers, [0.25, 0.5, 0.75])
    return float(q25), float(median), float(q75)


def compute_error_cells(errors: Sequence[float], certified: Iterable[bool | None]) -> tuple[Cell, ...]:
    """Return the `ERROR_COLUMNS` of some trials.

    Number of trials; number without a result (NaN); share certified as the global optimum (None if the method has no
    certificate); quartiles of the finite errors.
    """
    certificates = [c for c in certified if c is not None]
    share = float(np.mean(certificates)) if certificates else None
    failed = int((~np.isfinite(errors)).sum())
    return len(errors), failed, share, *compute_quartiles(errors)
