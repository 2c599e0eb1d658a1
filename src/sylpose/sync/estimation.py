"""Time offsets between a recording's cameras from the motion that they record (`sylpose sync`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import f as fisher

from sylpose.atomic_io import format_toml_key, replace_atomically
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.io.capture import Session
from sylpose.rig import Rig
from sylpose.smoothing import Track, smooth_tracks
from sylpose.status import Status
from sylpose.sync.offsets import apply_offsets
from sylpose.sync.speed_correlation import (
    MAX_CHANCE_PROBABILITY,
    OffsetEstimate,
    SpeedSignal,
    compute_image_speed,
    estimate_coarse_offsets,
    split_offsets,
    to_small_gray,
)
from sylpose.tracking.tracker import track

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
    """Precision of a camera's offset.

    FINE: estimated from the object's poses; COARSE: to whole frames, from changes of speed; UNOBSERVABLE: the object's
    speed does not change while the camera sees it.
    """

    FINE = "found"
    COARSE = "to about a frame"
    UNOBSERVABLE = "not observable"


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
        drifts: (C,) change of each offset from the first tracked frame to the last, seconds, if the clocks drift apart by
            more than chance; else zeros.
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
    drifts: FloatArray
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
        message = "time offsets can only be estimated if the frames have times; provide videos or timestamps.csv"
        raise ValueError(f"{session.path}: {message}")
    rate, problems = session.rate, list[str]()
    speeds = _measure_speeds(session, start, stop, problems.append, show_progress)
    coarse = estimate_coarse_offsets(speeds, rate, max_lag)
    whole_frames = split_offsets(coarse.offsets, rate)[0] / rate
    whole_frames -= whole_frames.mean()
    refined = _refine_offsets(session, whole_frames, (start, stop), seed, show_progress)
    fine = refined.sd < MAX_SD_FRAMES / rate
    if fine.sum() < 2:  # an offset is relative to another camera
        fine[:] = False
    if not refined.is_tracked:
        problems.append("The object could not be tracked, so its poses give no offsets.")
    if refined.drifts.any():
        changes = ", ".join(
            f"{name} by {1e3 * s:+.1f} ms" for name, s in zip(session.rig.names, refined.drifts, strict=True)
        )
        problems.append(
            f"The clocks drift apart, or frames were lost: while the object is tracked, the delays change ({changes}). "
            "Provide the time of each frame (timestamps.csv), or synchronize and track shorter parts (--start, --stop)."
        )
    if fine.any() and not refined.converged:
        problems.append(f"The offsets still change after {MAX_ROUNDS} rounds.")
    offsets = np.where(fine, refined.offsets, whole_frames)
    # Offsets in whole frames are never more precise than a part of a frame.
    coarse_sd = np.where(coarse.is_determined, np.hypot(coarse.sd, 0.3 / rate), np.inf)
    levels = np.array([OffsetPrecision.UNOBSERVABLE, OffsetPrecision.COARSE, OffsetPrecision.FINE])
    precision = tuple(levels[np.where(fine, 2, coarse.is_determined.astype(int))])
    estimate = session.rig.names, rate, offsets - offsets.mean(), np.where(fine, refined.sd, coarse_sd), precision
    return TimeOffsets(
        *estimate, coarse, refined.before, refined.after, refined.n_tracked, refined.drifts, tuple(problems)
    )


class _Refined(NamedTuple):
    """Offsets (C,) refined with the object's poses, their standard deviations and drifts, residuals before and after."""

    offsets: FloatArray
    sd: FloatArray
    drifts: FloatArray
    before: FloatArray
    after: FloatArray
    n_tracked: int
    is_tracked: bool
    converged: bool


def _refine_offsets(
    session: Session, initial: FloatArray, frames: tuple[int, int | None], seed: int, show_progress: ProgressWrapper
) -> _Refined:
    """Track the first object and refine its poses, landmarks and the offsets jointly, until the offsets converge."""
    single_object, rate, (start, stop) = session.select_object(session.objects[0]), session.rate or 1.0, frames
    offsets, converged, before = initial, False, np.full(len(session.rig), np.nan)
    after = before
    # Tracked frames, and the offsets with which they were tracked; frames without a pose have no delays.
    tracked_frames, tracking_offsets = list[Track](), offsets
    for k in range(MAX_ROUNDS):
        if k == 0 or (np.abs(offsets - tracking_offsets) * rate > RETRACK_FRAMES).any():
            tracking_offsets = offsets
            shifted = apply_offsets(single_object, dict(zip(session.rig.names, offsets, strict=True)))
            end = min(shifted.n_frames if stop is None else stop, start + MAX_TRACKED_FRAMES, shifted.n_frames)
            # Problems of the files have been reported before.
            read = shifted.frames(start, end, 1, lambda _: None)
            sets = show_progress(f"Tracking, round {k + 1}", end - start, read)
            tracking = track(sets, shifted.rig, shifted.boxes or None, features=FEATURES, seed=seed)
            tracked_frames = [Track.from_tracked(tracked) for tracked in tracking]
        change = offsets - tracking_offsets
        tracks = [replace(t, time_offsets=t.time_offsets + change[: len(t.time_offsets)]) for t in tracked_frames]
        refined = smooth_tracks(tracks, shifted.rig, offsets_sd=PRIOR_SD_FRAMES / rate)
        is_tracked = refined.status is not Status.TOO_FEW_MATCHES
        if refined.status is not Status.OK:
            sd = np.full(len(session.rig), np.inf)
            break
        if k == 0:
            before = smooth_tracks(tracks, shifted.rig).sigma_px
        after = refined.sigma_px
        offsets, sd = offsets + refined.offsets, refined.offsets_sd
        converged = bool((np.abs(refined.offsets) < np.maximum(CONVERGENCE_SECONDS, sd)).all())
        if converged:
            break
    scatter, drifts = _compare_parts(tracks, single_object.rig, rate)
    sd = np.hypot(sd * scatter, ERROR_ALONG_MOTION_PX / _image_speeds(tracks, single_object.rig))
    n_tracked = sum(t.pose.is_observed for t in tracks)
    return _Refined(offsets, sd, drifts, before, after, n_tracked, is_tracked, converged)


def _compare_parts(tracks: Sequence[Track], rig: Rig, rate: float) -> tuple[float, FloatArray]:
    """Compare the offsets from separate parts of the recording.

    Unobservable offsets are determined by errors that resemble motion and differ between the parts. Those of clocks that
    drift apart change steadily: along a line, the slope of which is significant (F test, once in a thousand times).

    Returns:
        the ratio, at least 1, of their scatter to their standard deviations; (C,) the drifts, see `TimeOffsets`.
    """
    n, no_drifts = min(len(tracks) // MIN_PART_FRAMES, MAX_PARTS), np.zeros(len(rig))
    edges = np.linspace(0, len(tracks), n + 1).astype(int)
    chosen = [tracks[i:j] for i, j in pairwise(edges)] if n > 1 else []
    parts = [(part, smooth_tracks(part, rig, offsets_sd=PRIOR_SD_FRAMES / rate)) for part in chosen]
    parts = [(part, found) for part, found in parts if found.status is Status.OK]
    if len(parts) < 2:
        return 1.0, no_drifts
    values, sds = np.array([p.offsets for _, p in parts]), np.array([p.offsets_sd for _, p in parts])
    known = [np.array([track.pose.time for track in part if track.pose.is_observed]) for part, _ in parts]
    times = np.array([[part.mean()] for part in known])
    weights = 1.0 / sds**2
    residuals, since = (x - (weights * x).sum(axis=0) / weights.sum(axis=0) for x in (values, times))
    # The offsets have mean 0, which removes one degree of freedom.
    n_free, n_parts = len(rig) - 1, len(parts)
    square = (weights * residuals**2).sum()
    slopes = (weights * since * residuals).sum(axis=0) / (weights * since**2).sum(axis=0)
    explained = (weights * since**2).sum(axis=0) @ slopes**2
    drifts = (slopes - slopes.mean()) * (known[-1][-1] - known[0][0])
    noise = max((square - explained) / max((n_parts - 2) * n_free, 1), 1.0)
    limit = fisher.isf(MAX_CHANCE_PROBABILITY, n_free, (n_parts - 2) * n_free) if n_parts > 2 else np.inf
    is_drift = explained / n_free > noise * limit and np.abs(drifts).max() * rate > MAX_SD_FRAMES
    scatter = float(np.sqrt(max(square / ((n_parts - 1) * n_free), 1.0)))
    return scatter, drifts if is_drift else no_drifts


def _image_speeds(tracks: Sequence[Track], rig: Rig) -> FloatArray:
    """Return the rms speed (C,) of the object in each camera's images, pixels per second; tiny without observations."""
    squares, counts = np.full(len(rig), 1e-12), np.ones(len(rig))
    for before, now in pairwise(tracks):
        for c, (earlier, later) in enumerate(zip(before.observations, now.observations, strict=True)):
            _, i, j = np.intersect1d(earlier.landmark_ids, later.landmark_ids, return_indices=True)
            displacement = rig.cameras[c].focal * (later.normalized[j] - earlier.normalized[i])
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
    columns = (offsets.cameras, offsets.offsets, offsets.sd, offsets.precision)
    for name, offset, sd, precision in zip(*columns, strict=True):
        known = f"{offset:.6f}  # {precision.value}: +- {sd:.6f} (1 sd)"
        unknown = "0.0  # not observable from the motion"
        lines.append(f"{format_toml_key(name)} = {known if np.isfinite(sd) else unknown}")
    with replace_atomically(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
