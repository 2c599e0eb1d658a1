"""Plot of the motion estimated by several nodes against ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.report.plots import INK, camera_colors, create_figure, save_figure, style_panel
from sylpose.results import Trajectory

__all__ = ["NodeResult", "plot_nodes"]

# Line widths: each node's line is narrower than the one below it, so that all of them stay visible (choice).
MAX_LINE_WIDTH, LINE_WIDTH_STEP = 7.0, 1.5


class NodeResult(NamedTuple):
    """Result of one node: its name, trajectory, and pose errors (n,) in degrees at times (n,) in seconds."""

    name: str
    trajectory: Trajectory
    times: FloatArray
    errors: FloatArray


def plot_nodes(
    results: Sequence[NodeResult],
    times: FloatArray,
    truth: RigidTransform,
    offline: tuple[float, float] | None,
    path: Path,
) -> None:
    """Plot the rotation since the first frame (top) and each node's error (bottom).

    Args:
        results: results of the nodes.
        times: (n,) seconds.
        truth: the n true poses.
        offline: start and end of the time a node was offline, seconds; None for no outage.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    figure = create_figure(9.0, 6.0)
    rotation_axes, error_axes = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    true = np.degrees((truth.rotation * truth[0].rotation.inv()).magnitude())
    rotation_axes.plot(
        times, true, color="#DDDDDD", linewidth=MAX_LINE_WIDTH + 4, label="truth", solid_capstyle="round"
    )
    first = next(p.world_from_object for p in results[0].trajectory if p.world_from_object is not None)
    colors = dict(zip(dict.fromkeys(a.name.partition(" ")[0] for a in results), camera_colors(9), strict=False))
    for k, result in enumerate(results):
        solved = [p for p in result.trajectory if p.world_from_object is not None]
        color = colors[result.name.partition(" ")[0]]
        angles = [
            np.degrees((p.world_from_object.rotation * first.rotation.inv()).magnitude())
            for p in solved
            if p.world_from_object is not None
        ]
        width = max(MAX_LINE_WIDTH - LINE_WIDTH_STEP * k, 1.2)
        rotation_axes.plot([p.time for p in solved], angles, color=color, linewidth=width, label=result.name)
        error_axes.plot(result.times, result.errors, color=color, linewidth=max(0.6 * width, 1.0))
    for axes in (rotation_axes, error_axes):
        if offline is not None:
            axes.axvspan(*offline, color="#F6D9C2", zorder=0, linewidth=0)
        style_panel(axes)
    if offline is not None:
        rotation_axes.annotate(
            "node offline", (offline[0], 0.02), xycoords=("data", "axes fraction"), color=INK, fontsize=9
        )
    rotation_axes.set_ylabel("rotation (degrees)")
    error_axes.set_ylabel("error (degrees)")
    error_axes.set_xlabel("time (s)")
    error_axes.set_ylim(bottom=0)
    rotation_axes.legend(loc="upper left", frameon=False)
    rotation_axes.set_title("Estimates of the same motion by each node")
    save_figure(figure, path)
