"""How far two trajectories are apart, as one picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sylpose.comparison import Comparison
from sylpose.report.plots import INK, X_COLOR, Y_COLOR, Z_COLOR, finish, new_figure, save_figure

__all__ = ["plot_comparison"]

COMPARED, ABSOLUTE, RELATIVE = "#888888", "#332288", "#CC6677"


def plot_comparison(result: Comparison, path: Path, *, unit: str = "", title: str = "") -> None:
    """Positions of both since the first common pose, then errors of turn and of position over time: absolute and relative.

    Raises:
        OSError: naming the file that cannot be written.
    """
    figure = new_figure(11.5, 9.0)
    place, turn, off = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": [3, 2, 2]})
    figure.suptitle(title, x=0.01, horizontalalignment="left", fontsize=12, fontweight="bold", color=INK)
    times, start = result.times, result.reference.translation[0]
    largest = float(max(np.abs(p.translation - start).max() for p in (result.found, result.reference)))
    for k, (axis, color) in enumerate((("x", X_COLOR), ("y", Y_COLOR), ("z", Z_COLOR))):
        scale, _ = _readable(largest, unit)
        place.plot(
            times,
            scale * (result.reference.translation - start)[:, k],
            color="#CCCCCC",
            linewidth=5,
            solid_capstyle="round",
            label="compared with" if k == 0 else None,
        )
        place.plot(times, scale * (result.found.translation - start)[:, k], color=color, linewidth=1.4, label=axis)
    place.set_ylabel(f"position since the start ({_readable(largest, unit)[1]})")
    middle = 0.5 * (times[len(times) - len(result.relative_rotation) :] + times[: len(result.relative_rotation)])
    scale, length = _readable(float(result.position.max()), unit)
    for panel, absolute, relative, what in (
        (turn, np.degrees(result.rotation), np.degrees(result.relative_rotation), "turn off (degrees)"),
        (off, scale * result.position, scale * result.relative_position, f"position off ({length})"),
    ):
        panel.plot(times, absolute, color=ABSOLUTE, linewidth=1.5, label="absolute")
        panel.plot(middle, relative, color=RELATIVE, linewidth=1.0, label="relative")
        rms = float(np.sqrt(np.mean(absolute**2)))
        panel.axhline(rms, color=ABSOLUTE, linewidth=0.9, linestyle="--", label=f"rms {rms:.3g}")
        panel.set_ylabel(what)
        panel.set_ylim(bottom=0)
    off.set_xlabel("time (s)")
    for panel in (place, turn, off):
        finish(panel)
        panel.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), frameon=False)
    figure.align_ylabels([place, turn, off])
    save_figure(figure, path)


def _readable(length: float, unit: str) -> tuple[float, str]:
    """Factor and unit to print lengths in."""
    return (1000.0, "mm") if unit == "m" and length < 0.1 else (1.0, unit or "units")
