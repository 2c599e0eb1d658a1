"""`sylpose sync`: estimate the time offsets between a recording's cameras and write offsets.toml."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sylpose.atomic_io import format_toml_key, make_output_folder, replace_atomically
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.io.capture import Session
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.runs import console_output
from sylpose.runs.precompile import compile_with_progress
from sylpose.smoothing.trajectory import Track, smooth
from sylpose.sync.offsets import OFFSETS_FILE, apply_offsets, load_offsets
from sylpose.sync.speed_correlation import (
    OffsetEstimate,
    SpeedSignal,
    compute_image_speed,
    estimate_coarse_offsets,
    split_offsets,
    to_small_gray,
)
from sylpose.tracking.tracker import track

__all__ = ["OffsetPrecision", "TimeOffsets", "run_sync_command", "sync_session", "write_offsets"]

# Wraps the frames of a loop to show its progress: description, number of frames, frames.
ProgressWrapper = Callable[[str, int, Iterable[FrameSet]], Iterable[FrameSet]]

# Search range of the speed correlation, seconds (choice: cameras started by hand).
MAX_LAG = 3.0
# Largest number of tracked frames, largest number of rounds, and the change of an offset in seconds at which they have
# converged, if it is not below its sd (choice: 20 s at 30 per second; a motion of 1000 px/s covers 0.1 px in it).
MAX_TRACKED_FRAMES, MAX_ROUNDS, CONVERGENCE_SECONDS = 600, 4, 1e-4
# The object is tracked again only after an offset has changed by so many frames, which changes the matching of frames:
# with offsets that are off by half a frame, tracking yields the same estimates (measured: benchmarks/sync.py).
RETRACK_FRAMES = 0.75
# Features tracked by KLT are three times as precise as those detected in every frame, in a third of the time; but their
# errors along the motion, in pixels, act like a time offset (measured: benchmarks/sync.py).
FEATURES, ERROR_ALONG_MOTION_PX = "klt", 0.01
# Prior sd of the offsets in each round, and largest sd of an offset that counts as found, both in frames (choice: whole
# frames are known from the correlation; docs/sync.md specifies a twentieth).
PRIOR_SD_FRAMES, MAX_SD_FRAMES = 0.5, 0.05
# The offsets are also estimated from separate parts of the recording: largest number of parts, fewest frames (choice).
MAX_PARTS, MIN_PART_FRAMES = 6, 16


class OffsetPrecision(Enum):
    """Precision of a camera's offset; `text` is an explanation."""

    FINE = "found"
    COARSE = "to about a frame"
    UNOBSERVABLE = "not observable"

    @property
    def text(self) -> str:
        """Return one sentence that explains the value."""
        return _TEXTS[self]


_TEXTS = {
    OffsetPrecision.FINE: "Estimated from the object's poses.",
    OffsetPrecision.COARSE: "Estimated from changes of speed, to whole frames; the poses do not constrain the fraction.",
    OffsetPrecision.UNOBSERVABLE: "Not observable from the motion: the object's speed must change "
    "while this camera sees it.",
}


@dataclass(frozen=True, eq=False)
class TimeOffsets:
    """Time offsets of C cameras.

    Attributes:
        cameras: names of the cameras.
        rate: frames per second.
        offsets: (C,) delays in seconds of each camera's images relative to their timestamps, with mean 0; a camera
            without an estimate is assumed to have correct timestamps or frame numbers.
        sd: (C,) standard deviations, infinite if unknown.
        precision: precision by camera.
        coarse: estimate from the speeds alone.
        before, after: (C,) rms residual of the tracked object in pixels, with whole-frame offsets and with the final
            ones; NaN if it was not seen.
        tracked: number of tracked frames.
        problems: messages about unreadable frames and failures.
    """

    cameras: tuple[str, ...]
    rate: float
    offsets: FloatArray
    sd: FloatArray
    precision: tuple[OffsetPrecision, ...]
    coarse: OffsetEstimate
    before: FloatArray
    after: FloatArray
    tracked: int
    problems: tuple[str, ...]


def _show_no_progress(_description: str, _total: int, frames: Iterable[FrameSet]) -> Iterable[FrameSet]:
    return frames


def sync_session(
    session: Session,
    *,
    max_lag: float = MAX_LAG,
    start: int = 0,
    stop: int | None = None,
    seed: int = 0,
    show_progress: ProgressWrapper = _show_no_progress,
) -> TimeOffsets:
    """Estimate the time offsets between a session's cameras.

    First the offsets are estimated to about a frame by correlating the speeds of motion in the cameras' images. Then
    the object is tracked with these offsets, and poses, landmarks and offsets are refined jointly, until the offsets
    converge.

    Args:
        session: session from `open_session`; of several objects, the first is tracked.
        max_lag: largest offset in seconds between two cameras, relative to their timestamps.
        start, stop: frames start ... stop - 1; the object is tracked in 600 of them at most.
        seed: as in `track`.
        show_progress: wraps the loops over frames, to show their progress.

    Returns:
        The offsets with their standard deviations.

    Raises:
        ValueError: a single camera; a recording with unknown frame rate; frames outside the session.
    """
    if len(session.rig) < 2:
        raise ValueError(f"{session.path}: synchronization requires at least two cameras")
    if session.rate is None:
        raise ValueError(
            f"{session.path}: time offsets can only be estimated if the frames have times; provide videos or "
            "timestamps.csv"
        )
    rate, n = session.rate, len(session.rig)
    problems: list[str] = []
    speeds = _measure_speeds(session, start, stop, problems.append, show_progress)
    coarse = estimate_coarse_offsets(speeds, rate, max_lag)
    whole_frames = split_offsets(coarse.offsets, rate)[0] / rate
    whole_frames -= whole_frames.mean()
    single_object = session.select_object(session.objects[0])
    offsets, sd, converged, frames = whole_frames, np.full(n, np.inf), False, 0
    before = after = np.full(n, np.nan)
    # Tracked frames, and the offsets with which they were tracked; frames without a pose have no delays.
    tracked_frames, tracking_offsets = list[Track](), offsets
    for k in range(MAX_ROUNDS):
        if k == 0 or (np.abs(offsets - tracking_offsets) * rate > RETRACK_FRAMES).any():
            shifted, tracking_offsets = apply_offsets(single_object, offsets), offsets
            end = min(shifted.n_frames if stop is None else stop, start + MAX_TRACKED_FRAMES, shifted.n_frames)
            # Problems of the files have been reported before.
            sets = show_progress(
                f"Tracking, round {k + 1}", end - start, shifted.frames(start, end, 1, _ignore_problem)
            )
            tracking = track(sets, shifted.rig, shifted.boxes or None, features=FEATURES, seed=seed)
            tracked_frames = [Track.from_tracked(tracked) for tracked in tracking]
        tracks = [
            replace(
                tracked_frame,
                time_offsets=tracked_frame.time_offsets
                + (offsets - tracking_offsets)[: len(tracked_frame.time_offsets)],
            )
            for tracked_frame in tracked_frames
        ]
        refined = smooth(tracks, shifted.rig, offsets_sd=PRIOR_SD_FRAMES / rate)
        frames = sum(t.pose.is_measured for t in tracks)
        if refined.status is Status.TOO_FEW_MATCHES:
            problems.append("The object could not be tracked, so its poses give no offsets.")
            sd = np.full(n, np.inf)
            break
        if k == 0:
            before = smooth(tracks, shifted.rig).sigma_px
        after = refined.sigma_px
        offsets, sd = offsets + refined.offsets, refined.offsets_sd
        converged = bool((np.abs(refined.offsets) < np.maximum(CONVERGENCE_SECONDS, sd)).all())
        if converged:
            break
    sd = np.hypot(
        sd * _scatter_ratio(tracks, single_object.rig, PRIOR_SD_FRAMES / rate),
        ERROR_ALONG_MOTION_PX / _image_speeds(tracks, single_object.rig),
    )
    fine = sd < MAX_SD_FRAMES / rate
    if fine.sum() < 2:  # an offset is relative to another camera
        fine[:] = False
    if fine.any() and not converged:
        problems.append(f"The offsets still change after {MAX_ROUNDS} rounds.")
    offsets = np.where(fine, offsets, whole_frames)
    # Offsets in whole frames are never more precise than a part of a frame.
    coarse_sd = np.where(coarse.is_determined, np.hypot(coarse.sd, 0.3 / rate), np.inf)
    precision = [
        OffsetPrecision.FINE if f else OffsetPrecision.COARSE if c else OffsetPrecision.UNOBSERVABLE
        for f, c in zip(fine, coarse.is_determined, strict=True)
    ]
    return TimeOffsets(
        session.rig.names,
        rate,
        offsets - offsets.mean(),
        np.where(fine, sd, coarse_sd),
        tuple(precision),
        coarse,
        before,
        after,
        frames,
        tuple(problems),
    )


def _scatter_ratio(tracks: Sequence[Track], rig: Rig, prior_sd: float) -> float:
    """Return the ratio, at least 1, of the scatter of offsets from parts of the recording to their standard deviations.

    Unobservable offsets are determined by errors that resemble motion and differ between the parts.
    """
    n = min(len(tracks) // MIN_PART_FRAMES, MAX_PARTS)
    if n < 2:
        return 1.0
    edges = np.linspace(0, len(tracks), n + 1).astype(int)
    parts = [smooth(tracks[i:j], rig, offsets_sd=prior_sd) for i, j in pairwise(edges)]
    parts = [part for part in parts if part.status is not Status.TOO_FEW_MATCHES]
    if len(parts) < 2:
        return 1.0
    values, sds = np.array([p.offsets for p in parts]), np.array([p.offsets_sd for p in parts])
    mean = (values / sds**2).sum(axis=0) / (1.0 / sds**2).sum(axis=0)
    # The offsets have mean 0, which removes one degree of freedom.
    degrees_of_freedom = (len(parts) - 1) * (len(rig) - 1)
    return float(np.sqrt(max((((values - mean) / sds) ** 2).sum() / degrees_of_freedom, 1.0)))


def _image_speeds(tracks: Sequence[Track], rig: Rig) -> FloatArray:
    """Return the rms speed (C,) of the object in each camera's images, pixels per second; tiny without observations."""
    squares, counts = np.full(len(rig), 1e-12), np.ones(len(rig))
    for before, now in pairwise(tracks):
        for c, (previous_observations, observations) in enumerate(
            zip(before.observations, now.observations, strict=True)
        ):
            _, i, j = np.intersect1d(previous_observations.landmark_ids, observations.landmark_ids, return_indices=True)
            displacement = rig.cameras[c].focal * (observations.normalized[j] - previous_observations.normalized[i])
            squares[c] += np.sum((displacement / (now.pose.time - before.pose.time)) ** 2)
            counts[c] += len(i)
    return np.asarray(np.sqrt(squares / counts))


def _measure_speeds(
    session: Session, start: int, stop: int | None, on_problem: Callable[[str], None], show_progress: ProgressWrapper
) -> list[SpeedSignal]:
    """Measure the speed of motion in each camera's images."""
    rate = session.rate or 1.0
    last: list[tuple[float, Image] | None] = [None] * len(session.rig)
    samples: list[list[tuple[float, float]]] = [[] for _ in session.rig]
    frames = session.frames(start, stop, on_problem=on_problem)
    end = session.n_frames if stop is None else min(stop, session.n_frames)
    for frame_set in show_progress("Reading", end - start, frames):
        for c, (image, stamp) in enumerate(zip(frame_set.images, frame_set.times, strict=True)):
            if image is None:
                continue
            now = (frame_set.time if stamp is None else stamp, to_small_gray(image))
            before = last[c]
            if before is not None and now[0] - before[0] < 2.5 / rate:
                speed = compute_image_speed(before[1], now[1]) / ((now[0] - before[0]) * rate)
                samples[c].append(((now[0] + before[0]) / 2, speed))
            last[c] = now
    return [SpeedSignal(*np.array(s).reshape(-1, 2).T) for s in samples]


def write_offsets(offsets: TimeOffsets, path: Path) -> None:
    """Write the offsets as TOML, `cam_0 = 0.0042`, each with its precision as a comment.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    lines = ["# Delay of each camera's images relative to their timestamps, seconds, estimated by `sylpose sync`."]
    for name, offset, sd, precision in zip(
        offsets.cameras, offsets.offsets, offsets.sd, offsets.precision, strict=True
    ):
        key = format_toml_key(name)
        precision_text = f"+- {sd:.6f} (1 sd)" if np.isfinite(sd) else "not observable from the motion"
        lines.append(
            f"{key} = {offset:.6f}  # {precision.value}: {precision_text}"
            if np.isfinite(sd)
            else f"{key} = 0.0  # {precision_text}"
        )
    with replace_atomically(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def run_sync_command(
    session: Session,
    out: Path | None = None,
    *,
    max_lag: float = MAX_LAG,
    start: int = 0,
    stop: int | None = None,
    seed: int = 0,
) -> TimeOffsets:
    """Run `sync_session` with terminal output, and write the offsets unless all are unknown.

    Args:
        session: as in `sync_session`.
        out: the file; None for `offsets.toml` in the session's folder.
        max_lag, start, stop, seed: as in `sync_session`.

    Raises:
        KeyboardInterrupt: with a message.
        ValueError, OSError: as `sync_session` and `write_offsets`.
    """
    path = session.path / OFFSETS_FILE if out is None else out
    _check_arguments(session, out, seed)
    console = console_output.make_console()
    console.print(console_output.format_headline(session))
    console_output.print_warnings(console, session.warnings)
    compile_with_progress(console)
    progress = _ProgressBars()
    try:
        synced = sync_session(session, max_lag=max_lag, start=start, stop=stop, seed=seed, show_progress=progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {path} is unchanged") from None
    finally:
        progress.stop()
    console.print()
    console_output.print_table(
        console, ("Camera", "delay", "+- 1 sd", "frames", "residual", "offset"), _table_rows(synced)
    )
    console.print()
    warnings = [*synced.problems]
    for precision in (OffsetPrecision.COARSE, OffsetPrecision.UNOBSERVABLE):
        names = [name for name, k in zip(synced.cameras, synced.precision, strict=True) if k is precision]
        if names:
            warnings.append(f"{', '.join(names)}: {precision.text[0].lower()}{precision.text[1:]}")
    console_output.print_warnings(console, warnings)
    if any(precision is not OffsetPrecision.UNOBSERVABLE for precision in synced.precision):
        write_offsets(synced, path)
        console_output.print_files(console, "Offsets", [path])
    return synced


def _check_arguments(session: Session, out: Path | None, seed: int) -> None:
    """Check the arguments before reading frames.

    Raises:
        ValueError: arguments that would fail later or replace another file.
    """
    if seed < 0:
        raise ValueError(f"--seed must not be negative, got {seed}")
    if out is not None:
        make_output_folder(out.parent)
    if out is not None and out.exists():
        try:
            load_offsets(out, session.rig.names)
        except (OSError, ValueError):
            raise ValueError(f"--out {out}: exists and is not a file of offsets, so it is not replaced") from None


def _table_rows(synced: TimeOffsets) -> list[list[str]]:
    rows = []
    for c, (name, precision) in enumerate(zip(synced.cameras, synced.precision, strict=True)):
        delay, sd = 1e3 * synced.offsets[c], 1e3 * synced.sd[c]
        digits = 2 if precision is OffsetPrecision.FINE else 0
        is_known = precision is not OffsetPrecision.UNOBSERVABLE
        residual = f"{synced.before[c]:.2f} to {synced.after[c]:.2f} px" if np.isfinite(synced.before[c]) else "-"
        rows.append(
            [
                name,
                f"{delay:.{digits}f} ms" if is_known else "-",
                f"{sd:.{digits}f} ms" if is_known else "-",
                f"{synced.offsets[c] * synced.rate:.{digits}f}" if is_known else "-",
                residual,
                precision.value,
            ]
        )
    return rows


class _ProgressBars:
    """Progress bar on stderr for successive loops; nothing without a terminal."""

    def __init__(self) -> None:
        console = console_output.make_console(stderr=True)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(compact=True),
        )
        self._progress = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._progress.start()

    def __call__(self, description: str, total: int, frames: Iterable[FrameSet]) -> Iterator[FrameSet]:
        task = self._progress.add_task(description, total=total)
        for frame_set in frames:
            yield frame_set
            self._progress.advance(task)
        self._progress.remove_task(task)

    def stop(self) -> None:
        self._progress.stop()


def _ignore_problem(problem: str) -> None:
    pass
