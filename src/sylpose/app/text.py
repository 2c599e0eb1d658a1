"""What the commands print: facts, tables, warnings and the progress bar."""

from __future__ import annotations

import math
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from sylpose.reading import SENTENCE, one_line
from sylpose.report.disagreement import remarks
from sylpose.results import FramePose, FrameStatus, Observable, Trajectory

if TYPE_CHECKING:  # loading these takes a second
    from sylpose.app.outcome import Run
    from sylpose.capture import Session
    from sylpose.capture.live import LiveSession
    from sylpose.report.rigview import CameraView
    from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = [
    "RIG_HEADER",
    "TrackingProgress",
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
BETWEEN_LINES = 20.0  # seconds, of progress where there is no terminal


def make_console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """A console that never breaks lines where nobody looks at them: in files and pipes."""
    console = Console(stderr=stderr, quiet=quiet, highlight=False, emoji=False, markup=False)
    if not console.is_terminal:
        console.width = 10_000
    return console


def say(sentence: str) -> None:
    """What went wrong, on stderr."""
    print(f"sylpose: {one_line(sentence, SENTENCE)}", file=sys.stderr)


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


def length(value: float, unit: str) -> str:
    """A length for people, to three digits: millimetres below one metre."""
    if unit == "m" and value < 1:
        value, unit = 1000 * value, "mm"
    digits = 2 - math.floor(math.log10(value)) if value > 0 else 0
    return f"{value:.{min(max(digits, 0), 9)}f} {unit or 'units'}"


def headline(session: Session | LiveSession) -> Text:
    """The session's name, cameras, frames, rate and objects in one line."""
    rate = f" at {session.rate:.4g} per second" if session.rate else ""
    cameras = f"{len(session.rig)} camera{'s' if len(session.rig) > 1 else ''}"
    frames = "live"
    if session.n_frames is not None:
        frames = f"{session.n_frames} frame{'s' if session.n_frames > 1 else ''}"
    objects = f", {len(session.objects)} objects: {', '.join(session.objects)}" if len(session.objects) > 1 else ""
    return Text.assemble((session.path.resolve().name, "bold"), f": {cameras}, {frames}{rate}{objects}")


class TrackingProgress:
    """A progress bar on stderr, where that is no terminal a line every twenty seconds: frames, frames per second, inliers.

    A context manager; `update` is what `track_session` takes as `on_frame`.

    Args:
        cameras: how many.
        frames: how many, with those that are skipped; None when nobody knows.
        objects: `update` is called for each of them.
        quiet: nothing is shown.
    """

    def __init__(self, cameras: int, frames: int | None, objects: int = 1, *, quiet: bool = False) -> None:
        self._updates, self._skipped, self._objects = 0, 0, objects
        self._said = time.monotonic()
        console = make_console(stderr=True, quiet=quiet)
        self._quiet = quiet
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(f"{cameras} camera{'s' if cameras > 1 else ''}"),
            TextColumn("{task.fields[rate]}"),
            TextColumn("{task.fields[inliers]}"),
            TimeRemainingColumn(compact=True),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._progress.add_task("Tracking", total=frames, rate="", inliers="")

    def __enter__(self) -> TrackingProgress:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Takes the bar away; twice does no harm."""
        self._progress.stop()

    @property
    def tracked(self) -> int:
        """Frames that all objects are tracked in."""
        return self._updates // self._objects

    @property
    def done(self) -> int:
        """Frames, those included that an earlier run has tracked."""
        return self._skipped + self.tracked

    def skip(self, frames: int) -> None:
        """Frames that an earlier run has tracked."""
        self._skipped = frames
        self._progress.update(self._task, completed=frames)

    def smoothing(self, number: int) -> None:
        """One round more in which all poses are refined together."""
        self._progress.update(self._task, description="Refining", total=None, rate=f"round {number}", inliers="")

    def update(self, tracked: TrackedFrame) -> None:
        """One frame of one object more."""
        self._updates += 1
        pose = tracked.pose
        measured = pose.measured and pose.status is not FrameStatus.FIRST
        inliers = f"{int(pose.inliers.sum())} inliers" if measured else pose.reason or pose.status.value
        elapsed = self._progress.tasks[0].elapsed
        rate = f"{self.tracked / elapsed:.1f} frames/s" if elapsed else ""
        self._progress.update(self._task, completed=self.done, rate=rate, inliers=inliers)
        now = time.monotonic()
        if self._progress.disable and not self._quiet and now - self._said >= BETWEEN_LINES:
            self._said = now
            total = self._progress.tasks[0].total
            of = "" if total is None else f" of {total:.0f}"
            say(f"tracked {self.done}{of} frames, {rate or 'no rate yet'}, {inliers}")


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
    facts = [("Tracked", ", ".join([said, *(f"{status.value} {n}" for status, n in rest.most_common())]))]
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
    one_camera = len(trajectory.camera_names) == 1
    open_scale = sum(f.observable is Observable.NO_SCALE for f in trajectory)
    if one_camera:
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
