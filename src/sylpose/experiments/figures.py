"""Figures of the studies: medians over the trials, with bands from the first to the third quartile."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from sylpose.experiments.table import Cell, Table
from sylpose.geometry.arrays import FloatArray
from sylpose.report.plots import INK, create_figure, save_figure, style_panel

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
