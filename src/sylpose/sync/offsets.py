"""offsets.toml: delay of each camera's images relative to their timestamps, seconds."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from sylpose.geometry.validation import MAX_TIME_OFFSET, check_number, check_type, format_value
from sylpose.input_limits import input_errors, parse_toml, read_text
from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.io.capture.names import match_all_names
from sylpose.sync.speed_correlation import split_offsets

OFFSETS_FILE = "offsets.toml"


def load_offsets(path: Path, cameras: Sequence[str]) -> dict[str, float]:
    """Read offsets.toml.

    Args:
        path: the file.
        cameras: names of the cameras.

    Returns:
        Seconds by camera, for the cameras in the file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not TOML, an unknown camera, or a value that is not a number of seconds; the message names the file.
    """
    text = read_text(path)
    with input_errors(path):
        try:
            data = parse_toml(text)
        except tomllib.TOMLDecodeError as error:
            raise ValueError(f"lines such as cam_0 = 0.0042 are expected ({error})") from None
        names = match_all_names(data, cameras, path)
        for name, value in data.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_TIME_OFFSET:
                raise ValueError(f"the offset of {name} must be a number of seconds (at most a day), got {value!r}")
        return {camera: float(data[name]) for name, camera in names.items()}


def find_offsets(session: Session | LiveSession, file: Path | None = None) -> dict[str, float]:
    """Read the offsets of a session from a file, by default from offsets.toml in its folder.

    Returns:
        Seconds by camera; empty without a file.

    Raises:
        FileNotFoundError, ValueError: as `load_offsets`; a recording whose times are not in seconds.
    """
    if file is None:
        file = session.path / OFFSETS_FILE
        if not file.is_file():
            return {}
    offsets = load_offsets(file, (*session.rig.names, *session.without))
    offsets = {name: seconds for name, seconds in offsets.items() if name in session.rig.names}
    if any(offsets.values()) and isinstance(session, Session) and session.rate is None:
        raise ValueError(f"{file}: offsets are in seconds, but this recording has neither timestamps nor a frame rate")
    return offsets


def apply_offsets(session: Session, offsets: Mapping[str, float]) -> Session:
    """Apply time offsets to a session: simultaneous frames share a frame set, each with its own timestamp.

    Cameras more than a frame apart are shifted by whole frames, so that all have an image in frame set 0.

    Args:
        session: the recording.
        offsets: delay of a camera's images relative to their timestamps, seconds, by camera; 0 for others.

    Raises:
        TypeError: offsets that are no mapping.
        ValueError: a camera that is not in the recording, an offset that is no number or exceeds a day, a session without
            rate, or a camera without a frame in the common time.
    """
    for name, value in check_type(offsets, Mapping, "offsets").items():
        if name not in session.rig.names and name not in session.without:
            raise ValueError(f"offsets: no camera {format_value(name)} in the rig ({', '.join(session.rig.names)})")
        check_number(value, f"offsets: {name}", minimum=-MAX_TIME_OFFSET, maximum=MAX_TIME_OFFSET)
    delays = np.array([float(offsets.get(name, 0.0)) for name in session.rig.names])
    if not delays.any():
        return session
    if session.rate is None:
        raise ValueError(f"{session.path}: offsets are in seconds, but this recording's frame rate is unknown")
    old, n = session.timeline, len(session.rig)
    whole_frames, remainder = split_offsets(delays, session.rate)
    frames, stamps = np.full(old.frames.shape, -1, np.int64), np.full(old.stamps.shape, np.nan)
    for c in range(n):
        kept = max(len(frames) + whole_frames[c], 0)
        frames[:kept, c], stamps[:kept, c] = old.frames[len(frames) - kept :, c], old.stamps[len(frames) - kept :, c]
    has_timestamps = bool(np.isfinite(old.stamps).any())
    if has_timestamps:
        stamps = stamps + delays
    used = (frames >= 0).any(axis=1) & (np.isfinite(stamps).any(axis=1) | (not has_timestamps))
    for name, before, now in zip(session.rig.names, old.frames.T, frames.T, strict=True):
        if (before >= 0).any() and not (now >= 0).any():
            raise ValueError(f"{session.path}: with these offsets {name} ends before the last camera begins")
    rows = np.flatnonzero(used) if has_timestamps else np.arange(1 + np.flatnonzero(used).max(initial=-1))
    frames, stamps = frames[rows], stamps[rows]
    if has_timestamps:
        times = np.nanmean(stamps, axis=1)
    else:
        times = old.times[rows]
        stamps = np.where(frames >= 0, times[:, None] + remainder, np.nan)
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise ValueError(f"{session.path}: with these offsets the times of the frames do not increase")
    lost = [f"{name} {-k}" for name, k in zip(session.rig.names, whole_frames, strict=True) if k]
    message = (
        f"The cameras start at different times; frames before the last one starts are not used: {', '.join(lost)}."
    )
    warnings = (*session.warnings, message) if lost else session.warnings
    return replace(session, timeline=replace(old, frames=frames, times=times, stamps=stamps), warnings=warnings)
