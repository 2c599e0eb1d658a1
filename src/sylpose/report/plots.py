"""Plots: a trajectory over time, a comparison, and the nodes of a network."""

from __future__ import annotations

import io
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy.spatial.transform import RigidTransform

from sylpose.atomic_io import replace_atomically
from sylpose.comparison import Comparison
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.euler_angles import PAN_TILT_ROLL, EulerAngles
from sylpose.geometry.validation import check_type
from sylpose.report.camera_consistency import describe_camera_problems, find_disagreements
from sylpose.report.failure_reasons import explain_missing_poses
from sylpose.results import FramePose, Trajectory
from sylpose.status import DOUBTFUL, PREDICTED, FrameStatus, Observability

# Letters that the font lacks, of names of folders, are drawn as boxes.
warnings.filterwarnings("ignore", message=r"Glyph \d+ .* missing from", category=UserWarning)

# Okabe & Ito's colors, distinguishable for the color-blind. An axis has the same color in both upper panels: tilt
# rotates about x, pan about y, roll about z.
X_COLOR, Y_COLOR, Z_COLOR = "#D55E00", "#009E73", "#0072B2"
# Paul Tol's "muted" colors, for cameras; another dash pattern from the tenth camera on.
CAMERA_COLORS = ("#332288", "#CC6677", "#117733", "#DDCC77", "#88CCEE", "#882255", "#44AA99", "#999933", "#AA4499")
DASHES = ("-", "--", ":", "-.")
NO_POSE_COLOR, UNKNOWN_SCALE_COLOR, COASTING_COLOR, UNKNOWN_LENGTH_COLOR = "#BBBBBB", "#F0E442", "#F6D9C2", "#D9C7E8"
UNCERTAIN_COLOR, AMBIGUOUS_COLOR, CONTRADICTED_COLOR = "#F4B6B6", "#E8A0D0", "#E06666"
INK = "#333333"

# With more frames than this, markers would overlap.
MAX_MARKED_FRAMES = 80
# Angles that change by more than this between frames have wrapped around, degrees (choice: beyond any rotation, below
# 180).
JUMP_DEG = 150.0


def camera_colors(n: int) -> list[str]:
    """Return n colors for cameras, the same in every picture; they repeat after nine."""
    return [CAMERA_COLORS[i % len(CAMERA_COLORS)] for i in range(n)]


def summarize_trajectory(trajectory: Trajectory) -> str:
    """Summarize a trajectory in one line.

    It contains the number of frames with a pose, rotation and translation between first and last, and median residual.

    Raises:
        ValueError: a trajectory without frames.
    """
    if not len(trajectory):
        raise ValueError("the trajectory has no frames")
    solved = [f for f in trajectory if f.is_measured]
    parts = [f"{len(solved)} of {len(trajectory)} frames with a pose"]
    for status in (*PREDICTED, *DOUBTFUL):
        if frames := sum(f.status is status for f in trajectory):
            parts.append(f"{status.value} in {frames}")
    if solved:
        turn = trajectory.rotation_angles[trajectory.measured_mask][-1]
        parts.append(f"rotated {np.degrees(turn):.1f}° from first to last frame")
        moved = float(np.linalg.norm(solved[-1].position - solved[0].position))
        scale, unit = choose_length_unit(moved, trajectory.unit)
        if solved[-1].observability is Observability.NO_SCALE:
            parts.append("translation scale not observable")
        else:
            parts.append(f"moved {moved * scale:.3g} {unit}")
    residuals = np.array([f.residuals for f in trajectory]).ravel()
    residuals = residuals[np.isfinite(residuals) & (residuals > 0)]
    if residuals.size:
        parts.append(f"residual {np.median(residuals):.2f} px (median)")
    return ", ".join(parts)


def plot_trajectory(trajectory: Trajectory, *, note: str = "") -> Figure:
    """Plot angles, position, inliers and residuals over time, as in `report.png`; notebooks display the figure.

    Args:
        trajectory: trajectory of at least one frame.
        note: a line of text below the plots.

    Raises:
        ValueError: a trajectory without frames.
    """
    return draw_trajectory_figure(check_type(trajectory, Trajectory, "trajectory"), note=check_type(note, str, "note"))


def save_trajectory_plot(
    trajectory: Trajectory,
    path: Path | str,
    *,
    note: str = "",
    angles: EulerAngles = PAN_TILT_ROLL,
    input_warnings: Sequence[str] = (),
) -> None:
    """Write `draw_trajectory_figure` to a file (.png, .svg, .pdf), replacing an existing one.

    Raises:
        ValueError: a trajectory without frames.
        OSError: the file cannot be written; the message names it.
    """
    save_figure(draw_trajectory_figure(trajectory, note=note, angles=angles, input_warnings=input_warnings), path)


def draw_trajectory_figure(
    trajectory: Trajectory, *, note: str = "", angles: EulerAngles = PAN_TILT_ROLL, input_warnings: Sequence[str] = ()
) -> Figure:
    """Plot angles, position, inliers and residuals of a trajectory over time.

    The top panel has three angles, as in the CSV, and the total rotation; lines break where angles wrap around.
    Positions are relative to the start; inliers and residuals are per camera.

    Bands are two standard deviations to each side, to first order in the covariance. Predicted (coasting,
    interpolated), poorly constrained (uncertain) and contradicted poses are dotted and pale; these frames and those
    without a pose are shaded. While a camera disagrees with the others, the lower panels are shaded in its color, and
    the title reports it. If no frame has a pose, the figure lists the reasons instead.

    Args:
        trajectory: trajectory of at least one frame.
        note: a caption below the figure.
        angles: the three angles to plot.
        input_warnings: sentences about problems found before the run, listed if no frame has a pose.

    Raises:
        ValueError: a trajectory without frames.
    """
    title = summarize_trajectory(trajectory)
    solved = trajectory.measured_mask
    if not any(f.world_from_object is not None for f in trajectory):
        return _draw_failure_figure(trajectory, title, note, input_warnings)
    is_unmeasured = np.array([f.world_from_object is not None and not f.is_measured for f in trajectory])
    times = trajectory.times
    figure = create_figure(11.5, 11.5)
    panels: list[Axes] = list(figure.subplots(4, 1, sharex=True, gridspec_kw={"height_ratios": [3, 3, 2, 2]}))
    turns, position, inliers, residuals = panels
    if problems := describe_camera_problems(trajectory):
        more = f" And {len(problems) - 1} more: see trajectory.csv." if len(problems) > 1 else ""
        title += f"\n{problems[0]}{more}"
    figure.suptitle(title, x=0.01, horizontalalignment="left", fontsize=12, fontweight="bold", color=INK)
    _plot_angles(turns, trajectory, angles, is_unmeasured)
    start = trajectory.positions[solved][0] if solved.any() else np.full(3, np.nan)
    moved = trajectory.positions - start
    scale, unit = choose_length_unit(float(np.abs(moved[solved]).max(initial=0)), trajectory.unit)
    sigmas = np.array([f.sigma[3:] for f in trajectory])
    labels = (("x", X_COLOR), ("y", Y_COLOR), ("z", Z_COLOR))
    _plot_lines(position, times, scale * moved, scale * sigmas, is_unmeasured, labels)
    position.set_ylabel(f"position since the start ({unit})")
    _plot_cameras(inliers, residuals, trajectory)
    shading = _shade_frames(panels, trajectory)
    for panel in panels:
        style_panel(panel)
    inliers.set_ylim(bottom=0)
    residuals.set_ylim(bottom=0)
    pad = 0.01 * (times[-1] - times[0]) or 0.5
    residuals.set_xlim(times[0] - pad, times[-1] + pad)
    band = [Patch(color=Z_COLOR, alpha=0.25, linewidth=0, label="± 2 standard deviations")]
    handles: list[Line2D | Patch] = [*turns.get_lines(), *band, *shading]
    _add_legend(turns, [h for h in handles if not str(h.get_label()).startswith("_")])
    _add_legend(position, [line for line in position.get_lines() if not str(line.get_label()).startswith("_")])
    _add_legend(inliers, list(inliers.get_lines()))
    figure.align_ylabels(panels)
    _add_note(figure, note)
    return figure


def _plot_angles(panel: Axes, trajectory: Trajectory, angles: EulerAngles, is_unmeasured: BoolArray) -> None:
    """Plot three angles and the total rotation."""
    times = trajectory.times
    values = np.degrees(compute_frame_angles(trajectory, angles))
    sigmas = np.degrees(_compute_angle_sigmas(trajectory, angles))
    # Lines break where angles wrap around: (180, 0, 180) and (0, 180, 0) are one rotation, and the CSV has either.
    jumps = 1 + np.flatnonzero((np.abs(np.diff(values, axis=0)) > JUMP_DEG).any(axis=1))
    values, sigmas = np.insert(values, jumps, np.nan, axis=0), np.insert(sigmas, jumps, np.nan, axis=0)
    broken_times, is_unmeasured = np.insert(times, jumps, times[jumps]), np.insert(is_unmeasured, jumps, False)
    _plot_lines(panel, broken_times, values, sigmas, is_unmeasured, angle_labels(angles), len(trajectory))
    turn = np.where(trajectory.measured_mask, np.degrees(trajectory.rotation_angles), np.nan)
    panel.plot(times, turn, color=INK, linewidth=1.2, linestyle="--", label="total rotation (0 to 180°)")
    panel.set_ylabel("angle (degrees)")


def _plot_cameras(inliers: Axes, residuals: Axes, trajectory: Trajectory) -> None:
    """Plot the inliers and residuals of each camera, shaded in its color while it disagrees with the others."""
    times, colors = trajectory.times, camera_colors(len(trajectory.camera_names))
    counts, errors = count_inliers(trajectory)
    marker = "." if len(trajectory) <= MAX_MARKED_FRAMES else ""
    for k, name in enumerate(trajectory.camera_names):
        dash = DASHES[k // len(CAMERA_COLORS) % len(DASHES)]
        for panel, values in ((inliers, counts), (residuals, errors)):
            panel.plot(times, values[:, k], dash, marker=marker, label=name, color=colors[k], linewidth=1.3)
    inliers.set_ylabel("inliers")
    residuals.set_ylabel("residual, rms (px)")
    residuals.set_xlabel("time (s)")
    indices = [f.index for f in trajectory]
    if np.array_equal(times, indices):
        residuals.set_xlabel("frame")
        residuals.xaxis.set_major_locator(MaxNLocator(integer=True))
    for disagreement in find_disagreements(trajectory):
        first_row = indices.index(disagreement.first)
        last_row = len(times) - 1 if disagreement.is_ongoing else indices.index(disagreement.last)
        color = colors[trajectory.camera_names.index(disagreement.camera)]
        for panel in (inliers, residuals):
            panel.axvspan(times[first_row], times[last_row], color=color, alpha=0.15, linewidth=0, zorder=0)


def _add_note(figure: Figure, note: str) -> None:
    if note:
        figure.text(0.01, -0.005, note, fontsize=8.5, color="#666666", verticalalignment="top", parse_math=False)


def _draw_failure_figure(trajectory: Trajectory, title: str, note: str, input_warnings: Sequence[str]) -> Figure:
    """Draw the reasons for missing poses, after the problems found before the run as the likeliest cause."""
    parts = {"Problems found before the run": input_warnings, "Why there is no pose": explain_missing_poses(trajectory)}
    lines: list[tuple[str, bool]] = []
    for heading, sentences in parts.items():
        if sentences:
            lines += [("", False)] * bool(lines) + [(heading, True)]
        for sentence in sentences:
            lines += [(line, False) for line in textwrap.wrap(sentence, 130, subsequent_indent="    ")]
    height = 1.2 + 0.25 * len(lines)
    figure = create_figure(11.5, height)
    figure.suptitle(title, x=0.01, horizontalalignment="left", fontsize=12, fontweight="bold", color=INK)
    for k, (line, bold) in enumerate(lines):
        weight, y = "bold" if bold else "normal", 1.0 - (0.55 + 0.25 * k) / height
        figure.text(0.02, y, line, fontsize=10, fontweight=weight, color=INK, verticalalignment="top", parse_math=False)
    _add_note(figure, note)
    return figure


class NotebookFigure(Figure):
    """Figure that notebooks display, whatever Matplotlib's notebook setup."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png", bbox_inches="tight", pad_inches=0.15)
        return file.getvalue()


def create_figure(width: float, height: float) -> Figure:
    """Create an empty figure, sizes in inches, drawn by Agg: no window, no global state."""
    figure = NotebookFigure(figsize=(width, height), dpi=110, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path | str) -> None:
    """Write the figure in the format of the file name's suffix.

    Raises:
        ValueError: a format that matplotlib does not support.
        OSError: the file cannot be written; the message names it.
    """
    with replace_atomically(path) as part:
        # Without dates, equal figures give equal files.
        dated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
        end = part.suffix.removeprefix(".")
        # Keep text searchable and editable.
        with rc_context({"svg.hashsalt": "sylpose", "svg.fonttype": "none", "pdf.fonttype": 42}):
            figure.savefig(part, bbox_inches="tight", pad_inches=0.15, metadata=dated.get(end))


def choose_length_unit(length: float, unit: str) -> tuple[float, str]:
    """Choose the factor and unit to print lengths in: millimeters for short lengths in meters."""
    if unit == "m" and length < 0.1:
        return 1000.0, "mm"
    return 1.0, unit or "units"


def _plot_lines(
    panel: Axes,
    x: FloatArray,
    values: FloatArray,
    sigmas: FloatArray,
    is_unmeasured: BoolArray,
    labels: Sequence[tuple[str, str]],
    frames: int | None = None,
) -> None:
    """Plot columns of measured values as lines, and predicted or uncertain ones as separate pale dots."""
    marker = "." if (frames or len(x)) <= MAX_MARKED_FRAMES else ""
    for y, sigma, (label, color) in zip(values.T, sigmas.T, labels, strict=True):
        panel.plot(x, np.where(is_unmeasured, np.nan, y), color=color, label=label, linewidth=1.6, marker=marker)
        if is_unmeasured.any():
            panel.plot(x, np.where(is_unmeasured, y, np.nan), ".", color=color, alpha=0.4, markersize=3, label="_pale")
        sigma = np.where(np.isfinite(sigma), sigma, np.nan)
        panel.fill_between(x, y - 2 * sigma, y + 2 * sigma, color=color, alpha=0.18, linewidth=0)


def style_panel(panel: Axes) -> None:
    """Apply the common grid, frame and colors to a panel."""
    panel.grid(True, color="#DDDDDD", linewidth=0.7)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.spines[["left", "bottom"]].set_color("#999999")
    panel.tick_params(colors=INK)
    panel.yaxis.label.set_color(INK)
    panel.xaxis.label.set_color(INK)


def _add_legend(panel: Axes, handles: list[Line2D] | list[Line2D | Patch]) -> None:
    columns = 1 + (len(handles) - 1) // 8
    panel.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.005, 1.0), frameon=False, ncols=columns)


def _shade_frames(panels: list[Axes], trajectory: Trajectory) -> list[Patch]:
    """Shade frames with a missing, predicted, doubtful or partly observable pose, and return legend entries."""
    observability, status = np.array([(f.observability, f.status) for f in trajectory], object).T
    unknown_scale = observability == Observability.NO_SCALE
    unknown_length = observability == Observability.NO_TRANSLATION_SCALE
    coasting, interpolated = status == FrameStatus.COASTING, status == FrameStatus.INTERPOLATED
    uncertain, ambiguous = status == FrameStatus.UNCERTAIN, status == FrameStatus.AMBIGUOUS
    contradicted = status == FrameStatus.CONTRADICTED
    entries = []
    for frames, color, label in (
        (np.array([f.world_from_object is None for f in trajectory]), NO_POSE_COLOR, "no pose"),
        (coasting, COASTING_COLOR, "coasting: predicted, not observed"),
        (interpolated, COASTING_COLOR, "interpolated, not observed"),
        (uncertain, UNCERTAIN_COLOR, "uncertain: rotation poorly constrained"),
        (ambiguous, AMBIGUOUS_COLOR, "ambiguous: several bodies move"),
        (contradicted, CONTRADICTED_COLOR, "contradicted: the cameras disagree"),
        (unknown_scale, UNKNOWN_SCALE_COLOR, Observability.NO_SCALE.value),
        (unknown_length, UNKNOWN_LENGTH_COLOR, Observability.NO_TRANSLATION_SCALE.value),
    ):
        for start, stop in _compute_intervals(trajectory.times, frames):
            for panel in panels:
                panel.axvspan(start, stop, color=color, alpha=0.4, linewidth=0, zorder=0)
        if frames.any():
            entries.append(Patch(color=color, alpha=0.4, linewidth=0, label=label))
    return entries


def _compute_intervals(times: FloatArray, frames: BoolArray) -> Iterator[tuple[float, float]]:
    """Yield the extent of each run of `frames`, half a frame beyond its first and last."""
    if len(times) == 1:
        edges = np.array([times[0] - 0.5, times[0] + 0.5])
    else:
        middles = (times[1:] + times[:-1]) / 2
        edges = np.concatenate([[2 * times[0] - middles[0]], middles, [2 * times[-1] - middles[-1]]])
    change = np.flatnonzero(np.diff(np.concatenate([[False], frames, [False]]).astype(int)))
    for first, end in zip(change[::2], change[1::2], strict=True):
        yield float(edges[first]), float(edges[end])


def angle_labels(angles: EulerAngles) -> list[tuple[str, str]]:
    """Return labels and colors of the three angles.

    The colors are those of the axes if each angle rotates about its own axis.
    """
    colors = (X_COLOR, Y_COLOR, Z_COLOR)
    axis_indices = [int(k) for k in np.argmax(np.abs(angles.axes), axis=1)]
    exact = np.array_equal(angles.axes, np.eye(3)[axis_indices])
    color_indices = axis_indices if len(set(axis_indices)) == 3 else [0, 1, 2]
    labels = [
        f"{name.partition('_')[0]} (about {'xyz'[k]})" if exact else name
        for name, k in zip(angles.names, axis_indices, strict=True)
    ]
    return [(label, colors[k]) for label, k in zip(labels, color_indices, strict=True)]


def count_inliers(frames: Iterable[FramePose]) -> tuple[FloatArray, FloatArray]:
    """Return inliers and residuals, (N, C); NaN where a frame has no matches."""
    frames = list(frames)
    counts, errors = (np.array([getattr(f, name) for f in frames], float) for name in ("inliers", "residuals"))
    # The first frame has no match partner and predicted frames have no matches: their zeros are no measurement.
    unmatched = np.array([f.status in (FrameStatus.FIRST, *PREDICTED) for f in frames])
    counts[unmatched], errors[unmatched] = np.nan, np.nan
    return counts, errors


def compute_frame_angles(trajectory: Trajectory, angles: EulerAngles) -> FloatArray:
    """Compute the angles (N, 3) in radians, as in the CSV; NaN rows without a pose."""
    places = [f.world_from_object for f in trajectory]
    return np.array([np.full(3, np.nan) if place is None else angles.from_rotation(place.rotation) for place in places])


def _compute_angle_sigmas(trajectory: Trajectory, angles: EulerAngles) -> FloatArray:
    """Compute standard deviations (N, 3) of the angles in radians; NaN without a pose."""
    poses = [(f.world_from_object, f.covariance[:3, :3]) for f in trajectory]
    return np.array([np.full(3, np.nan) if p is None else angles.sigma(p.rotation, c) for p, c in poses])


ABSOLUTE_COLOR, RELATIVE_COLOR = "#332288", "#CC6677"


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
    scale, length = choose_length_unit(largest, unit)
    for k, (axis, color) in enumerate((("x", X_COLOR), ("y", Y_COLOR), ("z", Z_COLOR))):
        reference, estimate = (scale * (p.translation - start)[:, k] for p in (result.reference, result.estimate))
        wide: dict[str, Any] = {"color": "#CCCCCC", "linewidth": 5, "solid_capstyle": "round"}
        position_axes.plot(times, reference, **wide, label="reference" if k == 0 else None)
        position_axes.plot(times, estimate, color=color, linewidth=1.4, label=axis)
    position_axes.set_ylabel(f"position since the start ({length})")
    middle = 0.5 * (times[len(times) - len(result.relative_rotation) :] + times[: len(result.relative_rotation)])
    scale, length = choose_length_unit(float(result.position.max()), unit)
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


# Line widths: each node's line is narrower than the one below it, so that all of them stay visible (choice).
MAX_LINE_WIDTH, LINE_WIDTH_STEP = 7.0, 1.5


class NodeResult(NamedTuple):
    """Result of one node: its name, trajectory, and pose errors (n,) in degrees at times (n,) in seconds."""

    name: str
    trajectory: Trajectory
    times: FloatArray
    errors: FloatArray


def plot_nodes(
    nodes: Sequence[NodeResult],
    times: FloatArray,
    truth: RigidTransform,
    offline: tuple[float, float] | None,
    path: Path,
) -> None:
    """Plot the rotation since the first frame (top) and each node's error (bottom).

    Args:
        nodes: results of the nodes.
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
    wide: dict[str, Any] = {"color": "#DDDDDD", "linewidth": MAX_LINE_WIDTH + 4, "solid_capstyle": "round"}
    rotation_axes.plot(times, true, **wide, label="truth")
    first = next(p.world_from_object for p in nodes[0].trajectory if p.world_from_object is not None)
    colors = dict(zip(dict.fromkeys(a.name.partition(" ")[0] for a in nodes), camera_colors(9), strict=False))
    for k, result in enumerate(nodes):
        solved = [p for p in result.trajectory if p.world_from_object is not None]
        color = colors[result.name.partition(" ")[0]]
        poses = [p.world_from_object for p in solved if p.world_from_object is not None]
        angles = [np.degrees((pose.rotation * first.rotation.inv()).magnitude()) for pose in poses]
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
