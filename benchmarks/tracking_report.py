"""Results of the tracking benchmark: scores against the truth, the table, what must hold, what got worse."""

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

__all__ = ["HEADER", "Row", "errors", "line", "load", "must_hold", "save", "score", "worse_than"]


# An object is found again where its pose is right to within this.
RIGHT_DEG, RIGHT_MM = 2.0, 20.0
# "At the end" is the root mean square over this share of the frames: a chain's very last error is one throw of dice.
END_SHARE = 0.1
# What counts as worse than a baseline.
WORSE, WORSE_SPEED = 1.2, 0.7
TINY_DEG, TINY_MM = 0.02, 0.05


class Spread(NamedTuple):
    """Of the errors of the motion since the start."""

    median: float
    worst: float
    last: float
    end: float


@dataclass(frozen=True)
class Row:
    """One run on one recording; None for what does not apply.

    Attributes:
        data: the recording (and its object).
        by: who ran, with which options.
        total: frames that could be solved: those of the truth (every 5th of it, where only these were used).
        solved: frames with a pose that was found in their images.
        deg, mm: errors of the motion since the first solved frame.
        fps, tracking_fps: frame sets per second, of the whole run and of the tracking alone.
        memory_mb: peak.
        growth: memory at the end over that after a fifth of the frames.
        statuses: how many frames have each.
        nees: median of the squared normalised errors' mean over the six degrees of freedom (0.9 when the standard
            deviations are right), of the solved frames with finite ones; correlations are not in the file.
        false: frames solved while no camera shows the object.
        back: frames from its return into at least two whole views until it is found again; the remaining ones if never.
        after_deg: worst error from then on.
        failed: why there is nothing to score.
    """

    data: str
    by: str
    total: int = 0
    solved: int = 0
    deg: Spread | None = None
    mm: Spread | None = None
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


def errors(
    estimate: tuple[FloatArray, RigidTransform], truth: tuple[FloatArray, RigidTransform], center: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Errors of the motion since the first pose that both have, as shared/tools/score.py defines it.

    Args:
        estimate, truth: times (n,), seconds, and poses; paired by the nearest time, within half the truth's least step.
        center: (3,) the object's centre in the world at the first true pose.

    Returns:
        (m,) paired frames of the truth; (m, 6) errors of the turn (rotation vector, world, radians) and of the centre's
        displacement. Zero in the first row.
    """
    (times, poses), (true_times, true_poses) = estimate, truth
    if not len(times):
        return np.empty(0, np.int64), np.empty((0, 6))
    nearest = np.abs(times[None, :] - true_times[:, None]).argmin(axis=1)
    frames = np.flatnonzero(np.abs(times[nearest] - true_times) <= 0.5 * np.diff(true_times).min())
    if not len(frames):
        return frames, np.empty((0, 6))
    found, right = poses[nearest[frames]], true_poses[frames]
    motion, true_motion = found * found[0].inv(), right * right[0].inv()
    start = (right[0] * true_poses[0].inv()).apply(center)
    turn = (motion.rotation * true_motion.rotation.inv()).as_rotvec()
    return frames, np.concatenate([turn, motion.apply(start) - true_motion.apply(start)], axis=1)


def score(row: Row, tum: Path, truth: Path, center: FloatArray | None = None, every: int = 1) -> Row:
    """The row with its errors, from a trajectory.tum (and a trajectory.csv of the same name beside it, if any).

    Args:
        truth: groundtruth.tum, or groundtruth_NAME.tum of one object of several; visible.csv is looked for beside it.
        center: of the object in the first frame; None: its frame's origin there.
        every: only every so manieth frame was given to it.
    """
    estimate, right = read_tum(tum), read_tum(truth)
    center = right[1][0].translation if center is None else center
    frames, off = errors(estimate, right, np.asarray(center, dtype=float))
    total = len(range(0, len(right[0]), every))
    if len(frames) < 2:
        return replace(row, total=total, failed="fewer than two poses")
    deg, mm = np.degrees(np.linalg.norm(off[:, :3], axis=1)), 1e3 * np.linalg.norm(off[:, 3:], axis=1)
    row = replace(row, total=total, solved=len(frames), deg=_spread(deg), mm=_spread(mm))
    table = tum.with_suffix(".csv")
    if table.exists():
        trajectory = read_trajectory(table)
        statuses = Counter(pose.status.value for pose in trajectory)
        sigma = {pose.time: pose.sigma for pose in trajectory}
        row = replace(row, statuses=dict(statuses.most_common()), nees=_nees(frames, off, right[0], sigma))
    visible = truth.with_name(truth.name.replace("groundtruth", "visible")).with_suffix(".csv")
    if visible.exists():
        row = _lost_and_found(row, frames, (deg < RIGHT_DEG) & (mm < RIGHT_MM), deg, _read_shares(visible))
    return row


def _spread(values: FloatArray) -> Spread:
    """Of the frames after the first, which is right by definition."""
    values = values[1:]
    tail = values[-max(round(END_SHARE * len(values)), 1) :]
    return Spread(float(np.median(values)), float(values.max()), float(values[-1]), float(np.sqrt((tail**2).mean())))


def _nees(frames: IntArray, off: FloatArray, times: FloatArray, sigma: dict[float, FloatArray]) -> float | None:
    known = np.array(list(sigma))
    squares = []
    for frame, error in zip(frames[1:], off[1:], strict=True):
        sd = sigma[known[np.abs(known - times[frame]).argmin()]]
        if np.isfinite(sd).all() and (sd > 0).all():
            squares.append(float(((error / sd) ** 2).mean()))
    return float(np.median(squares)) if squares else None


def _read_shares(path: Path) -> FloatArray:
    with path.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return np.array([[float(cell) for cell in row[1:]] for row in rows])


def _lost_and_found(row: Row, frames: IntArray, right: BoolArray, deg: FloatArray, shares: FloatArray) -> Row:
    hidden = np.flatnonzero((shares == 0).all(axis=1))
    if not len(hidden):
        return row
    false = int(np.isin(frames, hidden).sum())
    whole = np.flatnonzero((shares > 0.99).sum(axis=1) >= 2)
    whole = whole[whole > hidden[-1]]
    if not len(whole):
        return replace(row, false=false)
    found = frames[right & (frames > hidden[-1])]
    if not len(found):
        return replace(row, false=false, back=int(len(shares) - whole[0]))
    after = float(deg[frames >= found[0]].max())
    return replace(row, false=false, back=max(int(found[0] - whole[0]), 0), after_deg=after)


HEADER = (
    "| data | by | solved | degrees since the start: median / worst / last / end | mm | frames/s: run, tracking | MB "
    "| NEES | status of the frames; what else |\n|---|---|---|---|---|---|---|---|---|"
)


def line(row: Row) -> str:
    """One line of the table."""

    def spread(of: Spread | None) -> str:
        return "-" if of is None else " / ".join(f"{value:.3g}" for value in of)

    def number(value: float | None, style: str) -> str:
        return "-" if value is None else format(value, style)

    notes = [f"{count} {status}" for status, count in row.statuses.items()]
    if row.back is not None:
        notes.append(f"found again {row.back} frames after its return")
    if row.after_deg is not None:
        notes.append(f"then worst {row.after_deg:.3g}°")
    if row.false:
        notes.append(f"{row.false} solved while unseen")
    if row.growth is not None:
        notes.append(f"memory x{row.growth:.2f}")
    if row.failed:
        notes.append(f"FAILED: {row.failed}")
    speed = f"{number(row.fps, '.1f')}, {number(row.tracking_fps, '.1f')}"
    return (
        f"| {row.data} | {row.by} | {row.solved} of {row.total} | {spread(row.deg)} | {spread(row.mm)} | {speed} "
        f"| {number(row.memory_mb, '.0f')} | {number(row.nees, '.2g')} | {'; '.join(notes)} |"
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
    """A figure of a recording, and the most that it may be (the least, if `least`); of runs with an option, if said."""

    data: str
    figure: str
    limit: float
    least: bool = False
    option: str = ""


TARGETS = (
    Target("board4", "solved", 48, least=True),
    Target("board4", "median deg", 1.5),
    Target("board4", "worst deg", 3.5),
    Target("board4", "median mm", 4),
    Target("board4, no boxes", "solved", 44, least=True),
    Target("board4, no boxes", "median deg", 3),
    Target("temple", "last deg", 0.2),
    Target("temple", "last mm", 0.2),
    Target("box", "worst deg", 0.3),
    Target("body", "worst deg", 0.3),
    Target("occluded-half", "worst deg", 0.5),
    Target("gone", "frames until found again", 3),
    Target("gone", "worst deg after that", 0.6),
    Target("box", "frames/s", 25, least=True, option="klt"),
    Target("box", "frames/s", 6, least=True, option="sift"),
    Target("long", "memory at the end / at a fifth", 1.1),
)
# At the end, the chain of adjacent frames is to be so many times as far off.
GAIN = 8.0


def must_hold(rows: Sequence[Row]) -> str:
    """The table of the targets that these runs tell about."""
    lines = ["| must hold | figure | target | holds |", "|---|---|---|---|"]

    def add(what: str, value: float | None, limit: float, least: bool) -> None:
        holds = value is not None and (value >= limit if least else value <= limit)
        shown = "none" if value is None else f"{value:.3g}"
        lines.append(
            f"| {what} | {shown} | {'at least' if least else 'at most'} {limit:g} | {'yes' if holds else 'NO'} |"
        )

    ours = [row for row in rows if row.by.startswith("sylpose")]
    for target in TARGETS:
        for row in ours:
            # Without an option, they are followed.
            features = "sift" if "sift" in row.by else "klt"
            if row.data == target.data and target.option in ("", features):
                add(f"{row.data}, {row.by}: {target.figure}", FIGURES[target.figure](row), target.limit, target.least)
    for row in ours:
        chain = [r for r in rows if r.by == "poselib" and r.data == row.data]
        if chain:
            gain = chain[0].deg.end / row.deg.end if chain[0].deg and row.deg else None
            add(f"{row.data}, {row.by}: the chain's error at the end, over ours", gain, GAIN, True)
    return "\n".join(lines)


def save(rows: Sequence[Row], path: Path) -> None:
    """Writes the rows as JSON."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(list(rows)), indent=1) + b"\n")


def load(path: Path) -> list[Row]:
    """Reads what `save` wrote.

    Raises:
        ValueError: naming the file, when it is no such file.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=list[Row])
    except (OSError, msgspec.MsgspecError) as error:
        raise ValueError(f"{path}: not a file of results ({error})") from None


def worse_than(rows: Sequence[Row], old: Sequence[Row]) -> Iterator[str]:
    """What got worse than in an earlier run of the same recordings."""
    before = {(row.data, row.by): row for row in old}
    for row in rows:
        was = before.get((row.data, row.by))
        where = f"{row.data}, {row.by}"
        if was is not None and row.failed and not was.failed:
            yield f"{where}: failed ({row.failed})"
        if was is None or was.total != row.total:
            continue
        if row.solved < was.solved:
            yield f"{where}: {row.solved} of {row.total} solved, {was.solved} before"
        for name in ("median deg", "worst deg", "last deg", "median mm"):
            now, then = FIGURES[name](row), FIGURES[name](was)
            slack = TINY_MM if name.endswith("mm") else TINY_DEG
            if now is not None and then is not None and now > WORSE * then + slack:
                yield f"{where}: {name} {now:.3g}, {then:.3g} before"
        if row.back is not None and was.back is not None and row.back > was.back:
            yield f"{where}: found again after {row.back} frames, {was.back} before"
        if row.fps is not None and was.fps is not None and row.fps < WORSE_SPEED * was.fps:
            yield f"{where}: {row.fps:.1f} frames/s, {was.fps:.1f} before"
