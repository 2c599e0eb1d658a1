"""Source recording of a result, opened with the settings of its run to read the images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from sylpose.input_limits import UnreadableFileError, input_errors, parse_toml, read_text
from sylpose.io.capture import Session
from sylpose.io.capture.session import reopen_session
from sylpose.runs.checkpoint import compute_fingerprint
from sylpose.runs.run_metadata import SETTINGS, USED_CALIBRATION, find_run_folder
from sylpose.sync.offsets import apply_offsets

__all__ = ["open_source_recording"]


class _Settings(msgspec.Struct, frozen=True):
    """Part of settings.toml that locates the images and matches their frames."""

    recording: str = ""
    cameras: dict[str, str] = {}
    rate: float | None = None
    without: list[str] = []
    frame_offsets: dict[str, int] = {}
    offsets: dict[str, float] = {}
    checksums: dict[str, str] = {}


def open_source_recording(result: Path, recording: Path | None = None) -> Session:
    """Open the recording of a run and verify that it is unchanged.

    Args:
        result: folder of the run, or of one of its objects.
        recording: present folder of the recording; None if it was not moved.

    Raises:
        FileNotFoundError: no recording there, or a result without its path.
        ValueError: a run of live cameras; a recording that was changed.
    """
    run = find_run_folder(result)
    if not (run / SETTINGS).is_file():
        raise FileNotFoundError(f"{result}: no {SETTINGS}, which contains the recording's path")
    settings = _read_settings(run / SETTINGS)
    if not settings.cameras:
        raise ValueError(
            f"{run}: the run had live cameras, a growing folder or tables of pixels: there is no recording"
        )
    path, cameras = Path(settings.recording), dict(settings.cameras)
    if recording is not None:
        path = recording
        cameras = {name: Path(file).name for name, file in cameras.items()}
    elif any(name.startswith(("\\\\", "//")) for name in (settings.recording, *cameras.values())):
        # Access would send the user's credentials to a computer that the result's author has chosen.
        raise ValueError(f"{run / SETTINGS}: the recording is on another computer; give --recording DIR if it is yours")
    session = reopen_session(path, run / USED_CALIBRATION, settings.frame_offsets, cameras, None, settings.without)
    if session.rate is None and settings.rate is not None:  # given by --rate, for image folders
        rate = settings.rate
        session = reopen_session(path, run / USED_CALIBRATION, settings.frame_offsets, cameras, rate, settings.without)
    session = apply_offsets(session, [settings.offsets.get(name, 0.0) for name in session.rig.names])
    now = compute_fingerprint(session)
    for name in ("images", "timestamps or offsets"):
        if settings.checksums.get(name) != now[name]:
            raise ValueError(f"{path}: the recording's {name} are not those of the run")
    # Only the images are needed.
    return replace(session, masks=None, _masks={}, _boxes={})


def _read_settings(file: Path) -> _Settings:
    text = read_text(file)
    with input_errors(file):
        try:
            raw: dict[str, Any] = parse_toml(text)
            return msgspec.convert(raw, _Settings)
        except msgspec.MsgspecError as error:
            raise UnreadableFileError(f"{file}: expected the settings of a run ({error})") from None
