"""A trajectory as one picture: angles, position, inliers and residuals over time."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from sylpose.atomic_io import replacing
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.euler_angles import PAN_TILT_ROLL, Angles
from sylpose.report.camera_consistency import disagreements, remarks
from sylpose.report.failure_reasons import why_nothing
from sylpose.results import FrameStatus, Observable, Trajectory

__all__ = [
    "X_COLOR",
    "Y_COLOR",
    "Z_COLOR",
    "angle_labels",
    "angles_of_frames",
    "camera_colors",
    "finish",
    "new_figure",
    "plot_trajectory",
    "readable",
    "save_figure",
    "summary",
    "trajectory_figure",
]


# Okabe & Ito's colours, which the colour-blind can tell apart. The same axis has the same colour in both upper panels:
# tilt turns about x, pan about y, roll about z.
X_COLOR, Y_COLOR, Z_COLOR = "#D55E00", "#009E73", "#0072B2"
# Paul Tol's "muted" colours, for cameras; another dash from the tenth camera on.
CAMERA_COLORS = ("#332288", "#CC6677", "#117733", "#DDCC77", "#88CCEE", "#882255", "#44AA99", "#999933", "#AA4499")
DASHES = ("-", "--", ":", "-.")
NO_POSE_COLOR, PARTIAL_COLOR, COASTING_COLOR, STRAIGHT_COLOR = "#BBBBBB", "#F0E442", "#F6D9C2", "#D9C7E8"
UNCERTAIN_COLOR = "#F4B6B6"
INK = "#333333"

# With more frames than this, markers would run into each other.
MARKED_FRAMES = 80
# Angles that change by more from a frame to the next have gone round, degrees (choice: beyond any turn, below 180).
JUMP_DEG = 150.0


def camera_colors(n: int) -> list[str]:
    """n colours for cameras, the same in every picture; they repeat after nine."""
    return [CAMERA_COLORS[i % len(CAMERA_COLORS)] for i in range(n)]


def summary(trajectory: Trajectory) -> str:
    """One line: frames in which a pose was found, turn and displacement from the first to the last, median residual.

    Raises:
        ValueError: a trajectory without frames.
    """
    if not len(trajectory):
        raise ValueError("the trajectory has no frames")
    solved = [f for f in trajectory if f.measured]
    parts = [f"{len(solved)} of {len(trajectory)} frames with a pose"]
    for status in (FrameStatus.COASTING, FrameStatus.UNCERTAIN):
        if frames := sum(f.status is status for f in trajectory):
            parts.append(f"{status.value} in {frames}")
    if solved:
        turn = trajectory.turn[trajectory.solved][-1]
        parts.append(f"turned {np.degrees(turn):.1f}° from the first to the last")
        moved = float(np.linalg.norm(solved[-1].position - solved[0].position))
        scale, unit = readable(moved, trajectory.unit)
        if solved[-1].observable is Observable.NO_SCALE:
            parts.append("how far it moved is not observable")
        else:
            parts.append(f"moved {moved * scale:.3g} {unit}")
    residuals = np.array([f.residuals for f in trajectory]).ravel()
    residuals = residuals[np.isfinite(residuals) & (residuals > 0)]
    if residuals.size:
        parts.append(f"residual {np.median(residuals):.2f} px (median)")
    return ", ".join(parts)


def plot_trajectory(
    trajectory: Trajectory,
    path: Path | str,
    *,
    note: str = "",
    angles: Angles = PAN_TILT_ROLL,
    noticed: Sequence[str] = (),
) -> None:
    """`trajectory_figure` as a file (.png, .svg, .pdf), replaced when it is there.

    Raises:
        ValueError: a trajectory without frames.
        OSError: naming the file, when it cannot be written.
    """
    save_figure(trajectory_figure(trajectory, note=note, angles=angles, noticed=noticed), path)


def trajectory_figure(
    trajectory: Trajectory, *, note: str = "", angles: Angles = PAN_TILT_ROLL, noticed: Sequence[str] = ()
) -> Figure:
    """Draws three angles and the total turn, the position since the start, inliers and residuals per camera over time.

    Angles are those of the CSV, their lines broken where they go round.

    Bands are two standard deviations either way, to first order in the covariance. Poses that are carried on only
    (coasting) or hardly known (uncertain) are dotted and pale; these frames and those without a pose are shaded. While
    a camera disagrees with the others, the cameras' panels are shaded in its colour, and the title says so. Where no frame
    has a pose, the picture says why instead.

    Args:
        trajectory: of at least one frame.
        note: a line below, of what this is a picture of.
        angles: which three.
        noticed: sentences about what looked wrong before the run, which are said where no frame has a pose.

    Raises:
        ValueError: a trajectory without frames.
    """
    title = summary(trajectory)
    solved = trajectory.solved
    if not any(f.world_from_object is not None for f in trajectory):
        return _picture_of_nothing(trajectory, title, note, noticed)
    pale = np.array([f.status in (FrameStatus.COASTING, FrameStatus.UNCERTAIN) for f in trajectory])
    times = trajectory.times
    marker = "." if len(trajectory) <= MARKED_FRAMES else ""
    figure = new_figure(11.5, 11.5)
    panels: list[Axes] = list(figure.subplots(4, 1, sharex=True, gridspec_kw={"height_ratios": [3, 3, 2, 2]}))
    said = remarks(trajectory)
    if said:
        title += "\n" + said[0] + (f" And {len(said) - 1} more: see trajectory.csv." if len(said) > 1 else "")
    figure.suptitle(title, x=0.01, horizontalalignment="left", fontsize=12, fontweight="bold", color=INK)

    turns, position, inliers, residuals = panels
    values, sigmas = np.degrees(angles_of_frames(trajectory, angles)), np.degrees(_angle_sigmas(trajectory, angles))
    # Broken where they go round: of (180, 0, 180) and (0, 180, 0) the CSV has one, too.
    jumps = 1 + np.flatnonzero((np.abs(np.diff(values, axis=0)) > JUMP_DEG).any(axis=1))
    at = np.insert(times, jumps, times[jumps])
    values, sigmas = np.insert(values, jumps, np.nan, axis=0), np.insert(sigmas, jumps, np.nan, axis=0)
    pale_too = np.insert(pale, jumps, False)
    for k, (label, color) in enumerate(angle_labels(angles)):
        _line(turns, at, values[:, k], sigmas[:, k], pale_too, color, label, marker)
    turn = np.where(solved, np.degrees(trajectory.turn), np.nan)
    turns.plot(times, turn, color=INK, linewidth=1.2, linestyle="--", label="total turn (0 to 180°)")
    turns.set_ylabel("angle (degrees)")

    start = trajectory.positions[solved][0] if solved.any() else np.full(3, np.nan)
    moved = trajectory.positions - start
    scale, unit = readable(float(np.abs(moved[solved]).max(initial=0)), trajectory.unit)
    sigmas = np.array([f.sigma[3:] for f in trajectory])
    for k, label, color in ((0, "x", X_COLOR), (1, "y", Y_COLOR), (2, "z", Z_COLOR)):
        _line(position, times, scale * moved[:, k], scale * sigmas[:, k], pale, color, label, marker)
    position.set_ylabel(f"position since the start ({unit})")

    colors = camera_colors(len(trajectory.camera_names))
    counts = np.array([f.inliers for f in trajectory], dtype=float)
    errors = np.array([f.residuals for f in trajectory], dtype=float)
    # The first frame is matched with nothing, and coasting ones found nothing: their zeros are no measurement.
    unmatched = np.array([f.status in (FrameStatus.FIRST, FrameStatus.COASTING) for f in trajectory])
    counts[unmatched], errors[unmatched] = np.nan, np.nan
    for k, name in enumerate(trajectory.camera_names):
        dash = DASHES[k // len(CAMERA_COLORS) % len(DASHES)]
        for panel, values in ((inliers, counts), (residuals, errors)):
            panel.plot(times, values[:, k], dash, marker=marker, label=name, color=colors[k], linewidth=1.3)
    inliers.set_ylabel("inliers")
    residuals.set_ylabel("residual, rms (px)")
    residuals.set_xlabel("time (s)")
    if np.array_equal(times, [f.index for f in trajectory]):
        residuals.set_xlabel("frame")
        residuals.xaxis.set_major_locator(MaxNLocator(integer=True))

    for other in disagreements(trajectory):
        since = [f.index for f in trajectory].index(other.first)
        until = len(times) - 1 if other.lasts else [f.index for f in trajectory].index(other.last)
        color = colors[trajectory.camera_names.index(other.camera)]
        for panel in (inliers, residuals):
            panel.axvspan(times[since], times[until], color=color, alpha=0.15, linewidth=0, zorder=0)
    shading = _shade(panels, trajectory)
    for panel in panels:
        finish(panel)
    inliers.set_ylim(bottom=0)
    residuals.set_ylim(bottom=0)
    pad = 0.01 * (times[-1] - times[0]) or 0.5
    residuals.set_xlim(times[0] - pad, times[-1] + pad)
    band = [Patch(color=Z_COLOR, alpha=0.25, linewidth=0, label="± 2 standard deviations")]
    handles: list[Line2D | Patch] = [*turns.get_lines(), *band, *shading]
    _legend(turns, [h for h in handles if not str(h.get_label()).startswith("_")])
    _legend(position, [line for line in position.get_lines() if not str(line.get_label()).startswith("_")])
    _legend(inliers, list(inliers.get_lines()))
    figure.align_ylabels(panels)
    _put_note(figure, note)
    return figure


def _put_note(figure: Figure, note: str) -> None:
    if note:
        figure.text(0.01, -0.005, note, fontsize=8.5, color="#666666", verticalalignment="top", parse_math=False)


def _picture_of_nothing(trajectory: Trajectory, title: str, note: str, noticed: Sequence[str]) -> Figure:
    """Why there is no pose, as a picture: first what looked wrong before, which is the likeliest cause."""
    parts = (("What looked wrong before the run", noticed), ("Why there is no pose", why_nothing(trajectory)))
    lines: list[tuple[str, bool]] = []
    for heading, said in parts:
        if said:
            lines += [("", False)] * bool(lines) + [(heading, True)]
            lines += [(line, False) for one in said for line in textwrap.wrap(one, 130, subsequent_indent="    ")]
    height = 1.2 + 0.25 * len(lines)
    figure = new_figure(11.5, height)
    figure.suptitle(title, x=0.01, horizontalalignment="left", fontsize=12, fontweight="bold", color=INK)
    for k, (line, bold) in enumerate(lines):
        weight, y = "bold" if bold else "normal", 1.0 - (0.55 + 0.25 * k) / height
        figure.text(0.02, y, line, fontsize=10, fontweight=weight, color=INK, verticalalignment="top", parse_math=False)
    _put_note(figure, note)
    return figure


class Picture(Figure):
    """A figure that notebooks show, whether Matplotlib has been told of them or not."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png", bbox_inches="tight", pad_inches=0.15)
        return file.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of that many inches, drawn by Agg: no window, no global state."""
    figure = Picture(figsize=(width, height), dpi=110, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path | str) -> None:
    """Writes the figure in the format that the file's name ends with.

    Raises:
        ValueError: a format that matplotlib does not know.
        OSError: naming the file, when it cannot be written.
    """
    with replacing(path) as part:
        # Without their dates, equal figures are equal files.
        dated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
        end = part.suffix.removeprefix(".")
        # Text stays text, which can be searched and edited.
        with rc_context({"svg.hashsalt": "sylpose", "svg.fonttype": "none", "pdf.fonttype": 42}):
            figure.savefig(part, bbox_inches="tight", pad_inches=0.15, metadata=dated.get(end))


def readable(length: float, unit: str) -> tuple[float, str]:
    """Factor and unit to print lengths in: millimetres for short ones when the calibration's unit is the metre."""
    if unit == "m" and length < 0.1:
        return 1000.0, "mm"
    return 1.0, unit or "units"


def _line(
    panel: Axes,
    x: FloatArray,
    y: FloatArray,
    sigma: FloatArray,
    pale: BoolArray,
    color: str,
    label: str,
    marker: str,
) -> None:
    """What was measured as a line, and what was carried on only, or is hardly known, as pale dots not joined to it."""
    panel.plot(x, np.where(pale, np.nan, y), color=color, label=label, linewidth=1.6, marker=marker)
    if pale.any():
        panel.plot(x, np.where(pale, y, np.nan), ".", color=color, alpha=0.4, markersize=3, label="_pale")
    sigma = np.where(np.isfinite(sigma), sigma, np.nan)
    panel.fill_between(x, y - 2 * sigma, y + 2 * sigma, color=color, alpha=0.18, linewidth=0)


def finish(panel: Axes) -> None:
    """Grid, frame and colours, the same in all figures."""
    panel.grid(True, color="#DDDDDD", linewidth=0.7)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.spines[["left", "bottom"]].set_color("#999999")
    panel.tick_params(colors=INK)
    panel.yaxis.label.set_color(INK)
    panel.xaxis.label.set_color(INK)


def _legend(panel: Axes, handles: list[Line2D] | list[Line2D | Patch]) -> None:
    columns = 1 + (len(handles) - 1) // 8
    panel.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.005, 1.0), frameon=False, ncols=columns)


def _shade(panels: list[Axes], trajectory: Trajectory) -> list[Patch]:
    """Strips behind frames that have no pose, or hardly one, coast, or do not tell how far it moved; returns legend
    entries."""
    partial, straight = (
        np.array([f.observable is kind for f in trajectory]) for kind in (Observable.NO_SCALE, Observable.NO_LENGTH)
    )
    entries = []
    coasting, uncertain = (
        np.array([f.status is status for f in trajectory]) for status in (FrameStatus.COASTING, FrameStatus.UNCERTAIN)
    )
    for frames, color, label in (
        (~trajectory.solved & ~coasting & ~uncertain, NO_POSE_COLOR, "no pose"),
        (coasting, COASTING_COLOR, "coasting: not seen, carried on"),
        (uncertain, UNCERTAIN_COLOR, "uncertain: its turn is hardly known"),
        (partial, PARTIAL_COLOR, Observable.NO_SCALE.value),
        (straight, STRAIGHT_COLOR, Observable.NO_LENGTH.value),
    ):
        for start, stop in _strips(trajectory.times, frames):
            for panel in panels:
                panel.axvspan(start, stop, color=color, alpha=0.4, linewidth=0, zorder=0)
        if frames.any():
            entries.append(Patch(color=color, alpha=0.4, linewidth=0, label=label))
    return entries


def _strips(times: FloatArray, frames: BoolArray) -> Iterator[tuple[float, float]]:
    """Runs of `frames`, from half a frame before the first to half a frame after the last."""
    if len(times) == 1:
        edges = np.array([times[0] - 0.5, times[0] + 0.5])
    else:
        middles = (times[1:] + times[:-1]) / 2
        edges = np.concatenate([[2 * times[0] - middles[0]], middles, [2 * times[-1] - middles[-1]]])
    change = np.flatnonzero(np.diff(np.concatenate([[False], frames, [False]]).astype(int)))
    for first, end in zip(change[::2], change[1::2], strict=True):
        yield float(edges[first]), float(edges[end])


def angle_labels(angles: Angles) -> list[tuple[str, str]]:
    """What the three are called, and their colours: those of the axes, where they turn about axes each of its own."""
    colors = (X_COLOR, Y_COLOR, Z_COLOR)
    about = [int(k) for k in np.argmax(np.abs(angles.axes), axis=1)]
    exact = np.array_equal(angles.axes, np.eye(3)[about])
    own = about if len(set(about)) == 3 else [0, 1, 2]
    labels = [
        f"{name.partition('_')[0]} (about {'xyz'[k]})" if exact else name
        for name, k in zip(angles.names, about, strict=True)
    ]
    return [(label, colors[k]) for label, k in zip(labels, own, strict=True)]


def angles_of_frames(trajectory: Trajectory, angles: Angles) -> FloatArray:
    """(N, 3) radians, as in the CSV; NaN rows where there is no pose."""
    places = [f.world_from_object for f in trajectory]
    return np.array([np.full(3, np.nan) if place is None else angles.of(place.rotation) for place in places])


def _angle_sigmas(trajectory: Trajectory, angles: Angles) -> FloatArray:
    """(N, 3) standard deviations of the angles in radians; NaN where there is none."""
    poses = [(f.world_from_object, f.covariance[:3, :3]) for f in trajectory]
    return np.array([np.full(3, np.nan) if p is None else angles.sigma(p.rotation, c) for p, c in poses])
