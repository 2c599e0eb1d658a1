"""The recording that a result is of, opened as its run had opened it: to look at the images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from sylpose.app.checkpoint import fingerprint
from sylpose.app.run_metadata import SETTINGS, USED, root_of
from sylpose.capture import Session
from sylpose.capture.session import reopen_session
from sylpose.input_limits import Unreadable, parsed_toml, text_of, told
from sylpose.sync.offsets import retimed

__all__ = ["recording_of"]


class _Settings(msgspec.Struct, frozen=True):
    """What of settings.toml says where the images are and which belong together."""

    recording: str = ""
    cameras: dict[str, str] = {}
    rate: float | None = None
    without: list[str] = []
    frame_offsets: dict[str, int] = {}
    offsets: dict[str, float] = {}
    checksums: dict[str, str] = {}


def recording_of(result: Path, moved: Path | None = None) -> Session:
    """The recording of a run, exactly as it was.

    Args:
        result: folder of the run, or of one of its objects.
        moved: where the recording is now; None: where it was.

    Raises:
        FileNotFoundError: it is not there, or the result does not say where it was.
        ValueError: it was of live cameras; it is no more what it was.
    """
    run = root_of(result)
    if not (run / SETTINGS).is_file():
        raise FileNotFoundError(f"{result}: no {SETTINGS}, which says where the recording is")
    settings = _settings(run / SETTINGS)
    if not settings.cameras:
        raise ValueError(f"{run}: of live cameras, a folder that grew, or tables of pixels: there is no recording")
    path, cameras = Path(settings.recording), dict(settings.cameras)
    if moved is not None:
        path = moved
        cameras = {name: Path(file).name for name, file in cameras.items()}
    elif any(name.startswith(("\\\\", "//")) for name in (settings.recording, *cameras.values())):
        # To ask for it would tell a computer that the result's author has chosen who asks.
        raise ValueError(f"{run / SETTINGS}: the recording is on another computer; say --recording DIR if it is yours")
    session = reopen_session(path, run / USED, settings.frame_offsets, cameras, None, settings.without)
    if session.rate is None and settings.rate is not None:  # that was said, of folders of images
        rate = settings.rate
        session = reopen_session(path, run / USED, settings.frame_offsets, cameras, rate, settings.without)
    session = retimed(session, [settings.offsets.get(name, 0.0) for name in session.rig.names])
    now = fingerprint(session)
    for name in ("images", "time stamps or offsets"):
        if settings.checksums.get(name) != now[name]:
            raise ValueError(f"{path}: the recording's {name} are not those of the run")
    # Only the images are wanted.
    return replace(session, masks=None, _masks={}, _boxes={})


def _settings(file: Path) -> _Settings:
    text = text_of(file)
    with told(file):
        try:
            raw: dict[str, Any] = parsed_toml(text)
            return msgspec.convert(raw, _Settings)
        except msgspec.MsgspecError as error:
            raise Unreadable(f"{file}: the settings of a run are expected ({error})") from None
