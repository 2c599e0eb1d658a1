"""Results of the tracking benchmark: scores against the truth, table, requirements and regressions."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.report.files import read_trajectory, read_tum

__all__ = [
    "HEADER",
    "Row",
    "compute_errors",
    "find_regressions",
    "format_requirements",
    "format_row",
    "load",
    "save",
    "score_trajectory",
]


# An object is relocalized if its pose error is below these limits.
MAX_CORRECT_DEG, MAX_CORRECT_MM = 2.0, 20.0
# The error at the end is the root mean square over this share of the frames; the last error alone is too noisy.
END_SHARE = 0.1
# Limits of a regression: factor of the errors, factor of the speed, and absolute slack of the errors.
WORSE_ERROR, WORSE_SPEED = 1.2, 0.7
SLACK_DEG, SLACK_MM = 0.02, 0.05


class ErrorStatistics(NamedTuple):
    """Statistics of the errors of the motion since the start: median, maximum, last, and RMS at the end."""

    median: float
    worst: float
    last: float
    end: float


@dataclass(frozen=True)
class Row:
    """One run on one recording; None where a figure does not apply.

    Attributes:
        data: recording, and object if there are several.
        by: program and its options.
        total: number of frames with truth (every 5th of them if only these were used).
        solved: number of frames whose pose was measured in their images.
        deg, mm: errors of the motion since the first solved frame.
        fps, tracking_fps: frame sets per second of the whole run and of the tracking stage.
        memory_mb: peak memory.
        growth: ratio of the memory at the end to that after a fifth of the frames.
        statuses: number of frames per status.
        nees: median over the solved frames of the mean squared normalized error of the six degrees of freedom (0.9 for
            correct standard deviations). Frames without finite deviations do not count; the file has no correlations.
        false: number of frames solved while no camera sees the object.
        back: frames from its return, fully visible to two cameras, to its relocalization; the remaining ones if never.
        after_deg: largest error from then on.
        failed: reason if there is nothing to score.
    """

    data: str
    by: str
    total: int = 0
    solved: int = 0
    deg: ErrorStatistics | None = None
    mm: ErrorStatistics | None = None
    fps: float | None = None
    tracking_fps: float | None = None
    memory_mb: float | None = None
    growth: float | None = None
    statuses: dict[str, int] = field(default_factory=dict)
    nees: float | None = None
    false: int | None = None
    back: int | None = None
    after_deg: float | None = None
    failed: str = ""


def compute_errors(
    estimate: tuple[FloatArray, RigidTransform], truth: tuple[FloatArray, RigidTransform], center: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Compute errors of the motion since the first common pose, as defined by shared/tools/score.py.

    Args:
        estimate, truth: times (n,), seconds, and poses; paired by nearest time, within half the truth's least step.
        center: (3,) the object's center in the world at the first true pose.

    Returns:
        (m,) paired frames of the truth; (m, 6) errors of the rotation (rotation vector, world, radians) and of the
        center's translation. The first row is zero.
    """
    (times, poses), (true_times, true_poses) = estimate, truth
    if not len(times):
        return np.empty(0, np.int64), np.empty((0, 6))
    nearest = np.abs(times[None, :] - true_times[:, None]).argmin(axis=1)
    frames = np.flatnonzero(np.abs(times[nearest] - true_times) <= 0.5 * np.diff(true_times).min())
    if not len(frames):
        return frames, np.empty((0, 6))
    matched_poses, true_matched = poses[nearest[frames]], true_poses[frames]
    motion, true_motion = matched_poses * matched_poses[0].inv(), true_matched * true_matched[0].inv()
    start = (true_matched[0] * true_poses[0].inv()).apply(center)
    rotation_error = (motion.rotation * true_motion.rotation.inv()).as_rotvec()
    return frames, np.concatenate([rotation_error, motion.apply(start) - true_motion.apply(start)], axis=1)


def score_trajectory(row: Row, tum: Path, truth: Path, center: FloatArray | None = None, every: int = 1) -> Row:
    """Return the row with the errors of a trajectory.tum, and the statuses of a trajectory.csv next to it.

    Args:
        truth: groundtruth.tum, or groundtruth_NAME.tum of one of several objects; a visible.csv next to it is read too.
        center: (3,) center of the object in the first frame; None: the origin of its frame.
        every: step between the frames that were processed.
    """
    estimate, true_trajectory = read_tum(tum), read_tum(truth)
    center = true_trajectory[1][0].translation if center is None else center
    frames, error_vectors = compute_errors(estimate, true_trajectory, np.asarray(center, dtype=float))
    total = len(range(0, len(true_trajectory[0]), every))
    if len(frames) < 2:
        return replace(row, total=total, failed="fewer than two poses")
    deg, mm = (
        np.degrees(np.linalg.norm(error_vectors[:, :3], axis=1)),
        1e3 * np.linalg.norm(error_vectors[:, 3:], axis=1),
    )
    row = replace(row, total=total, solved=len(frames), deg=_summarize_errors(deg), mm=_summarize_errors(mm))
    table = tum.with_suffix(".csv")
    if table.exists():
        trajectory = read_trajectory(table)
        statuses = Counter(pose.status.value for pose in trajectory)
        sigma = {pose.time: pose.sigma for pose in trajectory}
        row = replace(
            row,
            statuses=dict(statuses.most_common()),
            nees=_median_nees(frames, error_vectors, true_trajectory[0], sigma),
        )
    visible = truth.with_name(truth.name.replace("groundtruth", "visible")).with_suffix(".csv")
    if visible.exists():
        row = _add_relocalization(
            row, frames, (deg < MAX_CORRECT_DEG) & (mm < MAX_CORRECT_MM), deg, _read_shares(visible)
        )
    return row


def _summarize_errors(values: FloatArray) -> ErrorStatistics:
    """Summarize the errors of the frames after the first, whose error is zero by definition."""
    values = values[1:]
    tail = values[-max(round(END_SHARE * len(values)), 1) :]
    return ErrorStatistics(
        float(np.median(values)), float(values.max()), float(values[-1]), float(np.sqrt((tail**2).mean()))
    )


def _median_nees(
    frames: IntArray, error_vectors: FloatArray, times: FloatArray, sigma: dict[float, FloatArray]
) -> float | None:
    known_times = np.array(list(sigma))
    squares = []
    for frame, error in zip(frames[1:], error_vectors[1:], strict=True):
        sd = sigma[known_times[np.abs(known_times - times[frame]).argmin()]]
        if np.isfinite(sd).all() and (sd > 0).all():
            squares.append(float(((error / sd) ** 2).mean()))
    return float(np.median(squares)) if squares else None


def _read_shares(path: Path) -> FloatArray:
    with path.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return np.array([[float(cell) for cell in row[1:]] for row in rows])


def _add_relocalization(row: Row, frames: IntArray, is_correct: BoolArray, deg: FloatArray, shares: FloatArray) -> Row:
    hidden = np.flatnonzero((shares == 0).all(axis=1))
    if not len(hidden):
        return row
    false = int(np.isin(frames, hidden).sum())
    fully_visible = np.flatnonzero((shares > 0.99).sum(axis=1) >= 2)
    fully_visible = fully_visible[fully_visible > hidden[-1]]
    if not len(fully_visible):
        return replace(row, false=false)
    found = frames[is_correct & (frames > hidden[-1])]
    if not len(found):
        return replace(row, false=false, back=int(len(shares) - fully_visible[0]))
    max_deg = float(deg[frames >= found[0]].max())
    return replace(row, false=false, back=max(int(found[0] - fully_visible[0]), 0), after_deg=max_deg)


HEADER = (
    "| recording | run | frames solved | rotation error, deg: median / worst / last / RMS at the end "
    "| position error, mm | frames/s: run, tracking | peak memory, MB | NEES | frame status; notes |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def format_row(row: Row) -> str:
    """Format one row of the table."""

    def format_errors(statistics: ErrorStatistics | None) -> str:
        return "-" if statistics is None else " / ".join(f"{value:.3g}" for value in statistics)

    def format_number(value: float | None, style: str) -> str:
        return "-" if value is None else format(value, style)

    notes = [f"{count} {status}" for status, count in row.statuses.items()]
    if row.back is not None:
        notes.append(f"relocalized {row.back} frames after its return")
    if row.after_deg is not None:
        notes.append(f"then at most {row.after_deg:.3g}°")
    if row.false:
        notes.append(f"{row.false} solved while invisible")
    if row.growth is not None:
        notes.append(f"memory x{row.growth:.2f}")
    if row.failed:
        notes.append(f"FAILED: {row.failed}")
    speed = f"{format_number(row.fps, '.1f')}, {format_number(row.tracking_fps, '.1f')}"
    return (
        f"| {row.data} | {row.by} | {row.solved} of {row.total} | {format_errors(row.deg)} | "
        f"{format_errors(row.mm)} | {speed} "
        f"| {format_number(row.memory_mb, '.0f')} | {format_number(row.nees, '.2g')} | {'; '.join(notes)} |"
    )


Figure = Callable[[Row], float | None]
FIGURES: dict[str, Figure] = {
    "solved": lambda r: r.solved,
    "median deg": lambda r: r.deg and r.deg.median,
    "worst deg": lambda r: r.deg and r.deg.worst,
    "last deg": lambda r: r.deg and r.deg.last,
    "median mm": lambda r: r.mm and r.mm.median,
    "last mm": lambda r: r.mm and r.mm.last,
    "frames until found again": lambda r: r.back,
    "worst deg after that": lambda r: r.after_deg,
    "frames/s": lambda r: r.fps,
    "memory at the end / at a fifth": lambda r: r.growth,
}


class Target(NamedTuple):
    """Limit of a figure of a recording, upper unless `is_lower_limit`, for runs with one option or for all."""

    data: str
    figure: str
    limit: float
    is_lower_limit: bool = False
    option: str = ""


TARGETS = (
    Target("board4", "solved", 48, is_lower_limit=True),
    Target("board4", "median deg", 1.5),
    Target("board4", "worst deg", 3.5),
    Target("board4", "median mm", 4),
    Target("board4, no boxes", "solved", 44, is_lower_limit=True),
    Target("board4, no boxes", "median deg", 3),
    Target("temple", "last deg", 0.2),
    Target("temple", "last mm", 0.2),
    Target("box", "worst deg", 0.3),
    Target("body", "worst deg", 0.3),
    Target("occluded-half", "worst deg", 0.5),
    Target("gone", "frames until found again", 3),
    Target("gone", "worst deg after that", 0.6),
    Target("box", "frames/s", 25, is_lower_limit=True, option="klt"),
    Target("box", "frames/s", 6, is_lower_limit=True, option="sift"),
    Target("long", "memory at the end / at a fifth", 1.1),
)
# Required ratio of the error at the end of chained adjacent frames to that of sylpose.
MIN_CHAIN_RATIO = 8.0


def format_requirements(rows: Sequence[Row]) -> str:
    """Format the table of the targets that apply to these runs."""
    lines = ["| requirement | figure | target | holds |", "|---|---|---|---|"]

    def add(requirement: str, value: float | None, limit: float, is_lower_limit: bool) -> None:
        holds = value is not None and (value >= limit if is_lower_limit else value <= limit)
        value_text = "none" if value is None else f"{value:.3g}"
        lines.append(
            f"| {requirement} | {value_text} | "
            f"{'at least' if is_lower_limit else 'at most'} {limit:g} | {'yes' if holds else 'NO'} |"
        )

    own_rows = [row for row in rows if row.by.startswith("sylpose")]
    for target in TARGETS:
        for row in own_rows:
            # The default is tracking by KLT.
            features = "sift" if "sift" in row.by else "klt"
            if row.data == target.data and target.option in ("", features):
                add(
                    f"{row.data}, {row.by}: {target.figure}",
                    FIGURES[target.figure](row),
                    target.limit,
                    target.is_lower_limit,
                )
    for row in own_rows:
        chain = [r for r in rows if r.by == "poselib" and r.data == row.data]
        if chain:
            gain = chain[0].deg.end / row.deg.end if chain[0].deg and row.deg else None
            add(
                f"{row.data}, {row.by}: ratio of the chain's error at the end to that of sylpose",
                gain,
                MIN_CHAIN_RATIO,
                True,
            )
    return "\n".join(lines)


def save(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as JSON."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(list(rows)), indent=1) + b"\n")


def load(path: Path) -> list[Row]:
    """Read a file that `save` wrote.

    Raises:
        ValueError: the file cannot be read; the message contains its name.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=list[Row])
    except (OSError, msgspec.MsgspecError) as error:
        raise ValueError(f"{path}: not a file of results ({error})") from None


def find_regressions(rows: Sequence[Row], baseline_rows: Sequence[Row]) -> Iterator[str]:
    """Yield a line for each regression against an earlier run of the same recordings."""
    baseline = {(row.data, row.by): row for row in baseline_rows}
    for row in rows:
        baseline_row = baseline.get((row.data, row.by))
        label = f"{row.data}, {row.by}"
        if baseline_row is not None and row.failed and not baseline_row.failed:
            yield f"{label}: failed ({row.failed})"
        if baseline_row is None or baseline_row.total != row.total:
            continue
        if row.solved < baseline_row.solved:
            yield f"{label}: {row.solved} of {row.total} solved, {baseline_row.solved} before"
        for name in ("median deg", "worst deg", "last deg", "median mm"):
            value, baseline_value = FIGURES[name](row), FIGURES[name](baseline_row)
            slack = SLACK_MM if name.endswith("mm") else SLACK_DEG
            if value is not None and baseline_value is not None and value > WORSE_ERROR * baseline_value + slack:
                yield f"{label}: {name} {value:.3g}, {baseline_value:.3g} before"
        if row.back is not None and baseline_row.back is not None and row.back > baseline_row.back:
            yield f"{label}: relocalized after {row.back} frames, {baseline_row.back} before"
        if row.fps is not None and baseline_row.fps is not None and row.fps < WORSE_SPEED * baseline_row.fps:
            yield f"{label}: {row.fps:.1f} frames/s, {baseline_row.fps:.1f} before"
