"""Plot of the difference between two trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sylpose.comparison import Comparison
from sylpose.report.plots import INK, X_COLOR, Y_COLOR, Z_COLOR, create_figure, save_figure, style_panel

__all__ = ["plot_comparison"]

COMPARED_COLOR, ABSOLUTE_COLOR, RELATIVE_COLOR = "#888888", "#332288", "#CC6677"


def plot_comparison(result: Comparison, path: Path, *, unit: str = "", title: str = "") -> None:
    """Plot two trajectories and their absolute and relative errors over time.

    The panels show both positions since the first common pose, rotation errors and position errors.

    Args:
        result: the comparison.
        path: path of the picture; its suffix sets the format.
        unit: unit of lengths, or "".
        title: above the panels.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    figure = create_figure(11.5, 9.0)
    position_axes, rotation_axes, error_axes = figure.subplots(
        3, 1, sharex=True, gridspec_kw={"height_ratios": [3, 2, 2]}
    )
    figure.suptitle(title, x=0.01, horizontalalignment="left", fontsize=12, fontweight="bold", color=INK)
    times, start = result.times, result.reference.translation[0]
    largest = float(max(np.abs(p.translation - start).max() for p in (result.estimate, result.reference)))
    for k, (axis, color) in enumerate((("x", X_COLOR), ("y", Y_COLOR), ("z", Z_COLOR))):
        scale, _ = _choose_length_unit(largest, unit)
        position_axes.plot(
            times,
            scale * (result.reference.translation - start)[:, k],
            color="#CCCCCC",
            linewidth=5,
            solid_capstyle="round",
            label="reference" if k == 0 else None,
        )
        position_axes.plot(
            times, scale * (result.estimate.translation - start)[:, k], color=color, linewidth=1.4, label=axis
        )
    position_axes.set_ylabel(f"position since the start ({_choose_length_unit(largest, unit)[1]})")
    middle = 0.5 * (times[len(times) - len(result.relative_rotation) :] + times[: len(result.relative_rotation)])
    scale, length = _choose_length_unit(float(result.position.max()), unit)
    for panel, absolute, relative, label in (
        (rotation_axes, np.degrees(result.rotation), np.degrees(result.relative_rotation), "rotation error (degrees)"),
        (error_axes, scale * result.position, scale * result.relative_position, f"position error ({length})"),
    ):
        panel.plot(times, absolute, color=ABSOLUTE_COLOR, linewidth=1.5, label="absolute")
        panel.plot(middle, relative, color=RELATIVE_COLOR, linewidth=1.0, label="relative")
        rms = float(np.sqrt(np.mean(absolute**2)))
        panel.axhline(rms, color=ABSOLUTE_COLOR, linewidth=0.9, linestyle="--", label=f"rms {rms:.3g}")
        panel.set_ylabel(label)
        panel.set_ylim(bottom=0)
    error_axes.set_xlabel("time (s)")
    for panel in (position_axes, rotation_axes, error_axes):
        style_panel(panel)
        panel.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), frameon=False)
    figure.align_ylabels([position_axes, rotation_axes, error_axes])
    save_figure(figure, path)


def _choose_length_unit(length: float, unit: str) -> tuple[float, str]:
    """Choose the scale factor and unit in which to print lengths."""
    return (1000.0, "mm") if unit == "m" and length < 0.1 else (1.0, unit or "units")
