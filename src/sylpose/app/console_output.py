"""What the commands print: facts, tables, warnings and the progress bar."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sylpose.app.console import make_console, say
from sylpose.display import length
from sylpose.input_limits import SENTENCE, one_line
from sylpose.report.camera_consistency import remarks
from sylpose.results import FramePose, FrameStatus, Observable, Trajectory
from sylpose.units import FIRST_DISTANCES

if TYPE_CHECKING:  # loading these takes a second
    from sylpose.app.run_result import Run
    from sylpose.capture import Session
    from sylpose.capture.live import LiveSession
    from sylpose.report.rigview import CameraView

__all__ = [
    "RIG_HEADER",
    "frame_line",
    "headline",
    "length",
    "make_console",
    "per_camera",
    "print_facts",
    "print_files",
    "print_summary",
    "print_table",
    "print_warnings",
    "rig_rows",
    "say",
    "solved",
]

SHOWN_WARNINGS = 12
MOST_STRETCHES = 4  # of frames that were not found, of which it is said why
LABEL = 14


def print_facts(console: Console, facts: Iterable[tuple[str, str]]) -> None:
    """Lines of a label and what there is to say."""
    for label, value in facts:
        _print_entry(console, f"{label:{LABEL}}", "dim", value)


def print_files(console: Console, label: str, files: Sequence[Path]) -> None:
    """Paths whole on their lines, to be copied."""
    for i, file in enumerate(files):
        console.print(Text.assemble((f"{label if i == 0 else '':{LABEL}}", "dim"), str(file)), soft_wrap=True)


def print_warnings(console: Console, sentences: Sequence[str]) -> None:
    """A line each, the first dozen of them."""
    for sentence in sentences[:SHOWN_WARNINGS]:
        _print_entry(console, "! ", "bold yellow", sentence)
    if len(sentences) > SHOWN_WARNINGS:
        _print_entry(console, "! ", "bold yellow", f"and {len(sentences) - SHOWN_WARNINGS} more")


def _print_entry(console: Console, label: str, style: str, words: str) -> None:
    """Words with a hanging indent; not Rich's own wrapping, which breaks paths and fills lines with spaces."""
    width = max(console.width - len(label), 20)
    lines = textwrap.wrap(one_line(words, SENTENCE), width, break_long_words=False, break_on_hyphens=False) or [""]
    text = Text.assemble((label, style), f"\n{'':{len(label)}}".join(lines))
    console.print(text, soft_wrap=True)


def print_table(console: Console, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A table whose first column is names and whose others are numbers."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim", pad_edge=False)
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def headline(session: Session | LiveSession) -> Text:
    """The session's name, cameras, frames, rate and objects in one line."""
    rate = f" at {session.rate:.4g} per second" if session.rate else ""
    cameras = f"{len(session.rig)} camera{'s' if len(session.rig) > 1 else ''}"
    frames = "live"
    if session.n_frames is not None:
        frames = f"{session.n_frames} frame{'s' if session.n_frames > 1 else ''}"
    objects = f", {len(session.objects)} objects: {', '.join(session.objects)}" if len(session.objects) > 1 else ""
    return Text.assemble((session.path.resolve().name, "bold"), f": {cameras}, {frames}{rate}{objects}")


def frame_line(name: str, pose: FramePose, cameras: Sequence[str], unit: str) -> str:
    """A frame in one line: what happened, how well the pose is known, and by camera the inliers of the matches."""
    said = f"{name}: " if name else ""
    said += f"frame {pose.index}, {pose.time:.3f}: {pose.reason or pose.status.value}"
    if pose.world_from_object is not None and np.isfinite(pose.sigma).all():
        turn, move = np.degrees(np.linalg.norm(pose.sigma[:3])), float(np.linalg.norm(pose.sigma[3:]))
        said += f", within {turn:.2g}° and {length(move, unit)}"
    of = pose.matches if len(pose.matches) else pose.inliers
    return f"{said}; " + ", ".join(f"{c} {n} of {m}" for c, n, m in zip(cameras, pose.inliers, of, strict=True))


def print_summary(console: Console, run: Run, tracked: int) -> None:
    """What was found, how well, how long it took and where it is; `tracked` frames took that time."""
    for name, trajectory in run.trajectories.items():
        if len(run.trajectories) > 1:
            console.print(Text(name, "bold"))
        print_facts(console, _findings(trajectory))
        console.print()
        print_table(console, ("Camera", "frames used", "inliers", "residual"), per_camera(trajectory))
        console.print()
        if name in run.network:
            print_facts(console, [("Network", run.network[name])])
            console.print()
        if changes := run.changes.get(name):
            print_facts(console, [("Calibration" if not k else "", said) for k, said in enumerate(changes)])
            console.print()
    # What a live session says now and then is in what it says at its end.
    problems = [problem for problem in run.problems if not problem.startswith("Left out up to now")]
    if problems:
        print_warnings(console, problems)
        console.print()
    total = sum(run.seconds.values())
    parts = ", ".join(f"{name} {seconds:.1f}" for name, seconds in run.seconds.items())
    print_facts(console, [("Time", f"{total:.1f} s, {tracked / total:.1f} frames/s ({parts})")])
    print_files(console, "Files", run.files)


def solved(trajectory: Trajectory) -> list[FramePose]:
    """The frames whose pose was found and is not a definition."""
    return [f for f in trajectory if f.measured and f.status is not FrameStatus.FIRST]


def _findings(trajectory: Trajectory) -> list[tuple[str, str]]:
    found = int(trajectory.solved.sum())
    again = sum(f.status is FrameStatus.RELOCALISED for f in trajectory)
    said = f"{found} of {len(trajectory)} frames" + (f" ({again} relocalised)" if again else "")
    rest = Counter(f.status for f in trajectory if not f.measured)
    label = "Found" if any(f.status is FrameStatus.FOUND for f in trajectory) else "Tracked"
    facts = [(label, ", ".join([said, *(f"{status.value} {n}" for status, n in rest.most_common())]))]
    facts += [("" if k else "Not found", said) for k, said in enumerate(_why_not(trajectory))]
    if found < 2:
        return facts
    turn = np.degrees(trajectory.turn[trajectory.solved])
    most = f", {turn.max():.1f}° at most" if turn.max() - turn[-1] > 0.05 else ""
    facts.append(("Turned", f"{turn[-1]:.1f}° from the first to the last solved frame{most}"))
    positions = trajectory.positions[trajectory.solved]
    moved = length(float(np.linalg.norm(positions[-1] - positions[0])), trajectory.unit)
    path = length(float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()), trajectory.unit)
    facts.append(("Moved", f"{moved} from the first to the last solved frame, along a path of {path}"))
    open_scale = sum(f.observable is Observable.NO_SCALE for f in trajectory)
    if open_scale and trajectory.unit == FIRST_DISTANCES:
        facts.append(("Scale", "not observable with one camera: lengths are in units of the object's first distance"))
    elif open_scale:
        facts.append(("Scale", f"not observable in {open_scale} frames: how far the object moved in them is not known"))
    if believed := sum(f.observable is Observable.NO_LENGTH for f in trajectory):
        facts.append(
            ("Length", f"not observable in {believed} frames: without a turn it is what is believed of place and shape")
        )
    facts += [("" if k else "Cameras", remark) for k, remark in enumerate(remarks(trajectory))]
    return facts


def _why_not(trajectory: Trajectory) -> list[str]:
    """For the longest stretches of frames that were not found, why their first was not."""
    stretches = [list(group) for missed, group in groupby(trajectory, lambda f: bool(f.reason)) if missed]
    longest = sorted(sorted(stretches, key=len, reverse=True)[:MOST_STRETCHES], key=lambda group: group[0].index)
    said = []
    for group in longest:
        first, last = group[0].index, group[-1].index
        said.append(
            f"frame {first}: {group[0].reason}" if first == last else f"frames {first} to {last}: {group[0].reason}"
        )
    if (rest := len(stretches) - len(longest)) > 0:
        said.append(f"and {rest} shorter stretch{'es' if rest > 1 else ''}: see the column reason of trajectory.csv")
    return said


def per_camera(trajectory: Trajectory) -> list[list[str]]:
    """Rows: a camera, in how many frames it was used, its inliers and its residual in the middle of these."""
    frames = solved(trajectory)
    rows = []
    for c, name in enumerate(trajectory.camera_names):
        used = [f for f in frames if f.inliers[c] > 0]
        inliers = f"{np.median([f.inliers[c] for f in used]):.0f}" if used else "-"
        residuals = np.array([f.residuals[c] for f in used])
        residuals = residuals[np.isfinite(residuals)]
        residual = f"{np.median(residuals):.2f} px" if len(residuals) else "-"
        rows.append([name, str(len(used)), inliers, residual])
    return rows


RIG_HEADER = ("Camera", "size", "frames", "field of view", "distance", "off axis", "other axes")


def rig_rows(session: Session, views: Sequence[CameraView]) -> list[list[str]]:
    """`sylpose check`'s table, a row per camera, within 80 columns for names of usual length."""
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
                length(view.distance, session.rig.unit) if known else "-",
                f"{view.off_axis:.0f}°" if known else "-",
                f"{min(others):.0f}° to {max(others):.0f}°" if others else "-",
            ]
        )
    return rows
