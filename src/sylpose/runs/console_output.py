"""Terminal output of the commands: facts, tables, warnings and summaries."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sylpose.display import format_length
from sylpose.input_limits import MAX_SENTENCE_LENGTH, to_one_line
from sylpose.report.camera_consistency import describe_camera_problems
from sylpose.results import FramePose, Trajectory
from sylpose.status import FrameStatus, Observability
from sylpose.units import INITIAL_DISTANCES

if TYPE_CHECKING:  # loading these takes a second
    from sylpose.io.capture import Session
    from sylpose.io.capture.live import LiveSession
    from sylpose.report.rigview import CameraView
    from sylpose.runs.run_result import Run


MAX_WARNINGS = 12
MAX_FAILED_RANGES = 4  # ranges of failed frames whose reason is printed
LABEL_WIDTH = 14


def make_console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """Create a console that does not wrap lines when its output goes to a file or a pipe."""
    console = Console(stderr=stderr, quiet=quiet, highlight=False, emoji=False, markup=False)
    if not console.is_terminal:
        console.width = 10_000
    return console


def print_facts(console: Console, facts: Iterable[tuple[str, str]]) -> None:
    """Print a line of label and text for each fact."""
    for label, value in facts:
        _print_entry(console, f"{label:{LABEL_WIDTH}}", "dim", value)


def print_files(console: Console, label: str, files: Sequence[Path]) -> None:
    """Print file paths unwrapped, one per line, so that they can be copied."""
    for i, file in enumerate(files):
        console.print(Text.assemble((f"{label if i == 0 else '':{LABEL_WIDTH}}", "dim"), str(file)), soft_wrap=True)


def print_offsets(console: Console, offsets: Mapping[str, float]) -> None:
    """Print time offsets, seconds by camera, in milliseconds; nothing if there are none."""
    if text := ", ".join(f"{name} {1000 * seconds:.4g} ms" for name, seconds in offsets.items() if seconds):
        console.print(f"Time offsets: {text} (from --offsets, or offsets.toml in the recording).")


def print_warnings(console: Console, sentences: Sequence[str]) -> None:
    """Print one entry per warning, at most a dozen."""
    for sentence in sentences[:MAX_WARNINGS]:
        _print_entry(console, "! ", "bold yellow", sentence)
    if len(sentences) > MAX_WARNINGS:
        _print_entry(console, "! ", "bold yellow", f"and {len(sentences) - MAX_WARNINGS} more")


def _print_entry(console: Console, label: str, style: str, message: str) -> None:
    """Print text with a hanging indent; Rich's own wrapping would break paths and pad lines with spaces."""
    message, width = to_one_line(message, MAX_SENTENCE_LENGTH), max(console.width - len(label), 20)
    lines = textwrap.wrap(message, width, break_long_words=False, break_on_hyphens=False)
    console.print(Text.assemble((label, style), f"\n{'':{len(label)}}".join(lines)), soft_wrap=True)


def print_table(console: Console, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table whose first column contains names and whose others contain numbers."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim", pad_edge=False)
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def format_headline(session: Session | LiveSession) -> Text:
    """Format a session's name, cameras, frames, rate and objects in one line."""
    rate = f" at {session.rate:.4g} per second" if session.rate else ""
    cameras = f"{len(session.rig)} camera{'s' if len(session.rig) > 1 else ''}"
    frames = "live"
    if session.n_frames is not None:
        frames = f"{session.n_frames} frame{'s' if session.n_frames > 1 else ''}"
    objects = f", {len(session.objects)} objects: {', '.join(session.objects)}" if len(session.objects) > 1 else ""
    return Text.assemble((session.path.resolve().name, "bold"), f": {cameras}, {frames}{rate}{objects}")


def format_frame_line(name: str, pose: FramePose, cameras: Sequence[str], unit: str) -> str:
    """Format a frame in one line: its status, the pose's standard deviations, and inliers of matches by camera."""
    text = f"{name}: " if name else ""
    text += f"frame {pose.index}, {pose.time:.3f}: {pose.reason or pose.status.value}"
    if pose.world_from_object is not None and np.isfinite(pose.sigma).all():
        rotation_sd, position_sd = np.degrees(np.linalg.norm(pose.sigma[:3])), float(np.linalg.norm(pose.sigma[3:]))
        text += f", ± {rotation_sd:.2g}° and ± {format_length(position_sd, unit)}"
    totals = pose.matches if len(pose.matches) else pose.inliers
    return f"{text}; " + ", ".join(f"{c} {n} of {m}" for c, n, m in zip(cameras, pose.inliers, totals, strict=True))


def print_summary(console: Console, run: Run, n_tracked: int) -> None:
    """Print a run's results, accuracy, running time and files.

    Args:
        console: where to print.
        run: the finished run.
        n_tracked: number of frames that the running time refers to.
    """
    for name, trajectory in run.trajectories.items():
        if len(run.trajectories) > 1:
            console.print(Text(name, "bold"))
        print_facts(console, _summarize(trajectory))
        console.print()
        print_table(console, ("Camera", "frames used", "inliers", "residual"), build_camera_rows(trajectory))
        console.print()
        if name in run.network:
            print_facts(console, [("Network", run.network[name])])
            console.print()
        if changes := run.changes.get(name):
            print_facts(console, [("Calibration" if not k else "", change) for k, change in enumerate(changes)])
            console.print()
    # The intermediate reports of a live session are contained in its final one.
    problems = [problem for problem in run.problems if not problem.startswith("Left out so far")]
    if problems:
        print_warnings(console, problems)
        console.print()
    total = sum(run.seconds.values())
    parts = ", ".join(f"{name} {seconds:.1f}" for name, seconds in run.seconds.items())
    print_facts(console, [("Time", f"{total:.1f} s, {n_tracked / total:.1f} frames/s ({parts})")])
    print_files(console, "Files", run.files)


def print_page_hint(console: Console, files: Sequence[Path]) -> None:
    """Print which of the written files to open first: the page, or those of several objects."""
    pages = [str(file) for file in files if file.suffix == ".html" and file.is_file()]
    if pages:
        console.print()
        console.print(Text.assemble("Open ", (" or ".join(pages), "bold"), " in a browser."), soft_wrap=True)


def select_solved_frames(trajectory: Trajectory) -> list[FramePose]:
    """Return the frames with a measured pose, without the first, whose pose is a definition."""
    return [f for f in trajectory if f.is_measured and f.status is not FrameStatus.FIRST]


def _summarize(trajectory: Trajectory) -> list[tuple[str, str]]:
    found = int(trajectory.measured_mask.sum())
    n_relocalized = sum(f.status is FrameStatus.RELOCALIZED for f in trajectory)
    text = f"{found} of {len(trajectory)} frames" + (f" ({n_relocalized} relocalized)" if n_relocalized else "")
    rest = Counter(f.status for f in trajectory if not f.is_measured)
    label = "Found" if any(f.status is FrameStatus.LOCALIZED for f in trajectory) else "Tracked"
    facts = [(label, ", ".join([text, *(f"{status.value} {n}" for status, n in rest.most_common())]))]
    facts += [("" if k else "Not found", text) for k, text in enumerate(_describe_failures(trajectory))]
    if found < 2:
        return facts
    angles = np.degrees(trajectory.rotation_angles[trajectory.measured_mask])
    maximum = f", {angles.max():.1f}° at most" if angles.max() - angles[-1] > 0.05 else ""
    facts.append(("Rotation", f"{angles[-1]:.1f}° from the first to the last solved frame{maximum}"))
    positions = trajectory.positions[trajectory.measured_mask]
    distance = format_length(float(np.linalg.norm(positions[-1] - positions[0])), trajectory.unit)
    path = format_length(float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()), trajectory.unit)
    facts.append(("Translation", f"{distance} from the first to the last solved frame, along a path of {path}"))
    n_without_scale = sum(f.observability is Observability.NO_SCALE for f in trajectory)
    if n_without_scale and trajectory.unit == INITIAL_DISTANCES:
        facts.append(("Scale", "not observable with one camera: lengths are in units of the object's first distance"))
    elif n_without_scale:
        facts.append(("Scale", f"not observable in {n_without_scale} frames: the translation in them is unknown"))
    if n_uncertain := sum(f.observability is Observability.NO_TRANSLATION_SCALE for f in trajectory):
        text = f"uncertain in {n_uncertain} frames: without rotation it rests on the assumed shape (see tx_sd)"
        facts.append(("Distance", text))
    facts += [("" if k else "Cameras", remark) for k, remark in enumerate(describe_camera_problems(trajectory))]
    return facts


def _describe_failures(trajectory: Trajectory) -> list[str]:
    """Return the reason of the first frame of each of the longest ranges of failed frames."""
    ranges = [list(group) for has_failed, group in groupby(trajectory, lambda f: bool(f.reason)) if has_failed]
    longest = sorted(sorted(ranges, key=len, reverse=True)[:MAX_FAILED_RANGES], key=lambda group: group[0].index)
    reasons = []
    for group in longest:
        first, last = group[0].index, group[-1].index
        frames = f"frame {first}" if first == last else f"frames {first} to {last}"
        reasons.append(f"{frames}: {group[0].reason}")
    if (rest := len(ranges) - len(longest)) > 0:
        reasons.append(f"and {rest} shorter range{'s' if rest > 1 else ''}: see the column reason of trajectory.csv")
    return reasons


def build_camera_rows(trajectory: Trajectory) -> list[list[str]]:
    """Return a row per camera: name, number of frames used, median inliers and median residual."""
    frames = select_solved_frames(trajectory)
    rows = []
    for c, name in enumerate(trajectory.camera_names):
        used = [f for f in frames if f.inliers[c] > 0]
        inliers = f"{np.median([f.inliers[c] for f in used]):.0f}" if used else "-"
        residuals = np.array([f.residuals[c] for f in used])
        residuals = residuals[np.isfinite(residuals)]
        residual = f"{np.median(residuals):.2f} px" if len(residuals) else "-"
        rows.append([name, str(len(used)), inliers, residual])
    return rows


RIG_HEADER = ("Camera", "size", "frames", "field of view", "distance", "off axis", "axis angles")


def build_rig_rows(session: Session, views: Sequence[CameraView]) -> list[list[str]]:
    """Return the rows of `sylpose check`'s camera table, within 80 columns for names of usual length."""
    rows = []
    for i, (source, view) in enumerate(zip(session.sources, views, strict=True)):
        file = source.path.name if source.kind == "images" else source.path.stem
        others = [angle for j, angle in enumerate(view.angles) if j != i]
        known = np.isfinite(view.distance)
        rows.append(
            [
                view.name if file == view.name else f"{view.name} ({source.path.name})",
                f"{view.size[0]}x{view.size[1]}",
                str(source.n_frames),
                f"{view.field_of_view[0]:.0f}° x {view.field_of_view[1]:.0f}°",
                format_length(view.distance, session.rig.unit) if known else "-",
                f"{view.off_axis:.0f}°" if known else "-",
                f"{min(others):.0f}° to {max(others):.0f}°" if others else "-",
            ]
        )
    return rows
