"""offsets.toml: by how many seconds each camera's images are later than their times say."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from sylpose.capture import Session
from sylpose.capture.live import LiveSession
from sylpose.capture.names import belongs_to
from sylpose.input_limits import parsed_toml, text_of, told
from sylpose.sync.speed_correlation import split_offsets

__all__ = ["OFFSETS_FILE", "find_offsets", "load_offsets", "retimed"]

OFFSETS_FILE = "offsets.toml"
# Seconds: clocks that are set by hand are hours apart (choice).
MAX_OFFSET = 86_400.0


def load_offsets(path: Path, cameras: Sequence[str]) -> dict[str, float]:
    """Seconds by camera; those that the file does not name have none.

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the file: not TOML, an unknown camera, a value that is no number of seconds.
    """
    text = text_of(path)
    with told(path):
        try:
            data = parsed_toml(text)
        except tomllib.TOMLDecodeError as error:
            raise ValueError(f"lines such as cam_0 = 0.0042 are expected ({error})") from None
        names = belongs_to(data, cameras, path)
        for name, value in data.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_OFFSET:
                raise ValueError(f"the offset of {name} must be a number of seconds, got {value!r}; at most a day")
        return {camera: float(data[name]) for name, camera in names.items()}


def find_offsets(session: Session | LiveSession, file: Path | None = None) -> dict[str, float]:
    """The offsets in a file, else in offsets.toml in the session's folder, else none.

    Raises:
        FileNotFoundError, ValueError: as `load_offsets`; a recording whose times are no seconds.
    """
    if file is None:
        file = session.path / OFFSETS_FILE
        if not file.is_file():
            return {}
    offsets = load_offsets(file, (*session.rig.names, *session.without))
    offsets = {name: seconds for name, seconds in offsets.items() if name in session.rig.names}
    if any(offsets.values()) and isinstance(session, Session) and session.rate is None:
        raise ValueError(f"{file}: offsets are in seconds, but of this recording only the order of the frames is known")
    return offsets


def retimed(session: Session, offsets: ArrayLike) -> Session:
    """The session with the cameras' times set right: frames of one time in one frame set, each with its own time stamp.

    Cameras that are more than a frame apart are moved by whole frames, so that all have an image at instant 0.

    Args:
        offsets: (C,) seconds by which each camera's images are later than their times say.

    Raises:
        ValueError: as many offsets as cameras are expected, and a session with a rate; a camera without a
            frame while all run.
    """
    late = np.asarray(offsets, dtype=float)
    if late.shape != (len(session.rig),) or not np.isfinite(late).all():
        raise ValueError(f"offsets: {len(session.rig)} numbers are expected, one for each camera, got {late}")
    if not late.any():
        return session
    if session.rate is None:
        raise ValueError(f"{session.path}: offsets are in seconds, but this recording's rate is not known")
    old, n = session.timeline, len(session.rig)
    shift, rest = split_offsets(late, session.rate)
    frames, stamps = np.full(old.frames.shape, -1, np.int64), np.full(old.stamps.shape, np.nan)
    for c in range(n):
        kept = max(len(frames) + shift[c], 0)
        frames[:kept, c], stamps[:kept, c] = old.frames[len(frames) - kept :, c], old.stamps[len(frames) - kept :, c]
    stamped = bool(np.isfinite(old.stamps).any())
    if stamped:
        stamps = stamps + late
    used = (frames >= 0).any(axis=1) & (np.isfinite(stamps).any(axis=1) | (not stamped))
    for name, before, now in zip(session.rig.names, old.frames.T, frames.T, strict=True):
        if (before >= 0).any() and not (now >= 0).any():
            raise ValueError(f"{session.path}: with these offsets {name} ends before the last camera begins")
    rows = np.flatnonzero(used) if stamped else np.arange(1 + np.flatnonzero(used).max(initial=-1))
    frames, stamps = frames[rows], stamps[rows]
    if stamped:
        times = np.nanmean(stamps, axis=1)
    else:
        times = old.times[rows]
        stamps = np.where(frames >= 0, times[:, None] + rest, np.nan)
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise ValueError(f"{session.path}: with these offsets the times of the frames do not increase")
    lost = [f"{name} {-k}" for name, k in zip(session.rig.names, shift, strict=True) if k]
    said = f"The cameras start at different times; frames before the last one starts are not used: {', '.join(lost)}."
    warnings = (*session.warnings, said) if lost else session.warnings
    return replace(session, timeline=replace(old, frames=frames, times=times, stamps=stamps), warnings=warnings)
