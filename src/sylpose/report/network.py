"""What several nodes found of one motion, over the truth, as one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.report.plots import INK, camera_colors, finish, new_figure, save_figure
from sylpose.results import Trajectory

__all__ = ["NodeAnswer", "plot_nodes"]

# Widths of lines, so that nodes that agree are all seen: each is drawn narrower than the one below it (choice).
WIDEST, NARROWER = 7.0, 1.5


class NodeAnswer(NamedTuple):
    """A node's name, and what it found; errors: (n,) degrees, of its poses with a time, (n,) seconds."""

    name: str
    found: Trajectory
    times: FloatArray
    errors: FloatArray


def plot_nodes(
    answers: Sequence[NodeAnswer],
    times: FloatArray,
    truth: RigidTransform,
    away: tuple[float, float] | None,
    path: Path,
) -> None:
    """Above the turn since the first frame, of the truth and of each node; below how far off each is.

    Args:
        times: (n,) and truth: the n true poses.
        away: when a node died and when it was back, seconds.

    Raises:
        OSError: naming the file that cannot be written.
    """
    figure = new_figure(9.0, 6.0)
    turn, error = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    true = np.degrees((truth.rotation * truth[0].rotation.inv()).magnitude())
    turn.plot(times, true, color="#DDDDDD", linewidth=WIDEST + 4, label="truth", solid_capstyle="round")
    first = next(p.world_from_object for p in answers[0].found if p.world_from_object is not None)
    colors = dict(zip(dict.fromkeys(a.name.partition(" ")[0] for a in answers), camera_colors(9), strict=False))
    for k, answer in enumerate(answers):
        solved = [p for p in answer.found if p.world_from_object is not None]
        color = colors[answer.name.partition(" ")[0]]
        angles = [
            np.degrees((p.world_from_object.rotation * first.rotation.inv()).magnitude())
            for p in solved
            if p.world_from_object is not None
        ]
        width = max(WIDEST - NARROWER * k, 1.2)
        turn.plot([p.time for p in solved], angles, color=color, linewidth=width, label=answer.name)
        error.plot(answer.times, answer.errors, color=color, linewidth=max(0.6 * width, 1.0))
    for axes in (turn, error):
        if away is not None:
            axes.axvspan(*away, color="#F6D9C2", zorder=0, linewidth=0)
        finish(axes)
    if away is not None:
        turn.annotate("killed, and back", (away[0], 0.02), xycoords=("data", "axes fraction"), color=INK, fontsize=9)
    turn.set_ylabel("turn, degrees")
    error.set_ylabel("off the truth, degrees")
    error.set_xlabel("time, seconds")
    error.set_ylim(bottom=0)
    turn.legend(loc="upper left", frameon=False)
    turn.set_title("What each node found of the same motion")
    save_figure(figure, path)
