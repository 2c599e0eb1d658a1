"""Studies: Monte Carlo comparisons over levels, their tables in long format, and their figures.

A table has one row per scene, method and level. Figures show medians over the trials, with bands from the first to the
third quartile.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import ArrayLike

from sylpose.experiments.problems import Estimator, Problem, Scene, error_deg
from sylpose.geometry.arrays import FloatArray
from sylpose.report.plots import INK, create_figure, save_figure, style_panel

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


# Okabe & Ito's colors for up to four methods, with distinct dashes and markers for printing in gray.
STYLES = (("#0072B2", "-", "o"), ("#D55E00", "--", "s"), ("#009E73", "-.", "^"), ("#CC79A7", ":", "D"))
# Maximum number of levels of which each one gets a marker and a tick (choice).
MAX_MARKERS = 15
ERROR_LABEL = "rotation error (degrees)"


class ReferenceCurve(NamedTuple):
    """Reference curve, drawn thin and gray in every panel."""

    label: str
    evaluate: Callable[[FloatArray], FloatArray]


# The error of the identity as the estimate, if the level is the rotation angle.
IDENTITY_ERROR = ReferenceCurve("identity: error equals the angle", lambda turn: turn)


class Lines(NamedTuple):
    """Figure with one panel per scene and one line per method over a column, with a logarithmic y axis.

    Attributes:
        title, x_label, y_label: texts of the figure.
        x, y: column of the x axis, and suffix of the quartile columns.
        log_x: use a logarithmic x axis too; levels of zero are omitted.
        reference: curve for comparison.
    """

    title: str
    x: str
    x_label: str
    y: str = "deg"
    y_label: str = ERROR_LABEL
    log_x: bool = True
    reference: ReferenceCurve | None = None

    def draw(self, table: Table, path: Path) -> None:
        """Write the figure of a table with columns scene, method, `x`, q25_`y`, median_`y` and q75_`y`."""
        figure, panels = _create_panels(table, self.title, self.x_label, self.y_label)
        levels = np.unique(table.column_values(self.x))
        for scene, panel in panels.items():
            for k, method in enumerate(table.distinct("method")):
                self._plot_method(panel, table.filter_rows(scene=scene, method=method), method, k)
            if self.reference is not None:
                x, (label, evaluate) = levels[levels > 0] if self.log_x else levels, self.reference
                panel.plot(x, evaluate(x), color="#888888", linewidth=1.2, linestyle=":", label=label)
            panel.set_yscale("log")
            _set_log_ticks(panel.yaxis)
            if self.log_x:
                panel.set_xscale("log")
                _set_log_ticks(panel.xaxis)
            elif len(levels) <= MAX_MARKERS:
                panel.set_xticks(levels)
            style_panel(panel)
        handles, labels = next(iter(panels.values())).get_legend_handles_labels()
        if len(handles) > 1:
            # One row if it fits, by the typical width of letters in inches; else two.
            wide = sum(0.7 + 0.075 * len(label) for label in labels) > figure.get_figwidth()
            columns = -(-len(handles) // 2) if wide else len(handles)
            figure.legend(handles, labels, loc="outside lower left", ncols=columns, frameon=False, labelcolor=INK)
        save_figure(figure, path)

    def _plot_method(self, panel: Axes, rows: Table, method: Cell, k: int) -> None:
        """Plot the rows of the k-th method."""
        x = rows.column_values(self.x)
        is_shown = x > 0 if self.log_x else np.full(len(x), True)
        low, median, high = (rows.column_values(f"{q}_{self.y}")[is_shown] for q in ("q25", "median", "q75"))
        (color, dash, marker), x = STYLES[k], x[is_shown]
        every = 1 + len(x) // MAX_MARKERS
        panel.plot(x, median, color=color, linestyle=dash, marker=marker, markevery=(k % every, every), label=method)
        panel.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)


def draw_bars(table: Table, path: Path, *, title: str) -> None:
    """Draw one panel per scene and one row per method: median (labeled) and quartiles of the rotation error.

    Args:
        table: with columns scene, method, q25_deg, median_deg and q75_deg, one row per scene and method.
        path: output file.
        title: title of the figure.
    """
    methods = table.distinct("method")
    figure, panels = _create_panels(table, title, ERROR_LABEL, "", rows=len(methods))
    for scene, panel in panels.items():
        for k, method in enumerate(methods):
            low, median, high = (table.value(f"{q}_deg", scene=scene, method=method) for q in ("q25", "median", "q75"))
            panel.plot([low, high], [k, k], color=STYLES[0][0], linewidth=7, alpha=0.25, solid_capstyle="butt")
            panel.plot(median, k, "o", color=STYLES[0][0])
            panel.annotate(f"{median:.2g}°", (high, k), (6, 0), textcoords="offset points", va="center", color=INK)
        panel.set_yticks(range(len(methods)), [str(m) for m in methods])
        panel.set_ylim(len(methods) - 0.5, -0.5)
        panel.set_xscale("log")
        _set_log_ticks(panel.xaxis)
        style_panel(panel)
    left, right = panel.get_xlim()  # shared by all panels
    panel.set_xlim(left, right * (right / left) ** 0.15)  # space for the numbers at the right
    save_figure(figure, path)


def _create_panels(
    table: Table, title: str, x_label: str, y_label: str, rows: int | None = None
) -> tuple[Figure, dict[str, Axes]]:
    """Create one panel per scene, side by side (four: two by two), high enough for `rows` rows of text."""
    scenes = [str(scene) for scene in table.distinct("scene")]
    columns = 2 if len(scenes) == 4 else min(len(scenes), 3)
    lines = -(-len(scenes) // columns)
    width, height = (3.4, 2.7) if rows is None else (3.3, 0.7 + 0.32 * rows)
    # Space for the title, the axis labels and the legend.
    figure = create_figure(max(width * columns, 5.5) + (0.5 if rows is None else 2.5), height * lines + 1.2)
    axes = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    figure.suptitle(title, x=0.01, horizontalalignment="left", fontsize=12, fontweight="bold", color=INK)
    for panel in axes[-1]:
        panel.set_xlabel(x_label, color=INK)
    for panel in axes[:, 0]:
        panel.set_ylabel(y_label, color=INK)
    panels = dict(zip(scenes, axes.ravel(), strict=True))
    if len(scenes) > 1:
        for scene, panel in panels.items():
            panel.set_title(scene, fontsize=10, color=INK, loc="left")
    return figure, panels


def _set_log_ticks(axis: Axis) -> None:
    """Set the ticks of a logarithmic axis to 1, 2, 5, 10, ... or, over more than three decades, powers of ten."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1000 * low else (1.0,)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))


class Study(NamedTuple):
    """One of the paper's experiments.

    Attributes:
        name: its name on the command line.
        question: the research question, a sentence.
        run: computes the table from a seed and the number of trials; reproducible except for run times.
        draw: writes the figure of a table to a path.
        summarize: summarizes a table in sentences.
        trials, quick_trials: number of trials by default, and in quick mode.
    """

    name: str
    question: str
    run: Callable[[int, int], Table]
    draw: Callable[[Table, Path], None]
    summarize: Callable[[Table], list[str]]
    trials: int = 40
    quick_trials: int = 4


class Levels(NamedTuple):
    """Quantity that a comparison varies.

    Attributes:
        name: its column in the table.
        label: its label in the figure.
        values: its levels.
        simulate: builds a problem from a scene, a level and a random generator.
        is_log: draw it on a logarithmic axis.
    """

    name: str
    label: str
    values: Sequence[float]
    simulate: Callable[[Scene, float, np.random.Generator], Problem]
    is_log: bool = True


def compare(
    name: str,
    question: str,
    title: str,
    levels: Levels,
    scenes: Sequence[Scene],
    estimators: Mapping[str, Estimator],
    summarize: Callable[[Table], list[str]],
    reference: ReferenceCurve | None = None,
    **trials: int,
) -> Study:
    """Return a study of all estimators on the same problems, with the same motions at every level.

    The table has the columns scene, method, `levels.name` and `ERROR_COLUMNS`.

    Args:
        name, question, summarize, trials: as in `Study`.
        title: title of the figure.
        levels: the varied quantity.
        scenes: a panel each.
        estimators: a line each, by their names.
        reference: as in `Lines`.
    """

    def run(seed: int, trials: int) -> Table:
        rows = []
        for scene in scenes:
            for level in levels.values:
                problems = simulate_trials(partial(levels.simulate, scene, level), seed, trials)
                rows += [(scene.name, name, level, *score_estimator(of, problems)) for name, of in estimators.items()]
        return Table(("scene", "method", levels.name, *ERROR_COLUMNS), tuple(rows))

    figure = Lines(title, levels.name, levels.label, log_x=levels.is_log, reference=reference)
    return Study(name, question, run, figure.draw, summarize, **trials)


def simulate_trials(simulate: Callable[[np.random.Generator], Problem], seed: int, trials: int) -> list[Problem]:
    """Return the problems of all trials."""
    return [simulate(np.random.default_rng([seed, trial])) for trial in range(trials)]


def score_estimator(estimate: Estimator, problems: Iterable[Problem]) -> tuple[Cell, ...]:
    """Return the cells of `ERROR_COLUMNS` of an estimator's results."""
    answers = [(estimate(problem), problem.truth) for problem in problems]
    return compute_error_cells([error_deg(a, truth) for a, truth in answers], [a.certified for a, _ in answers])
