"""offsets.toml: by how many seconds each camera's images are later than their times say."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path

from sylpose.capture import Session
from sylpose.capture.live import LiveSession
from sylpose.capture.names import belongs_to

__all__ = ["OFFSETS_FILE", "find_offsets", "load_offsets"]

OFFSETS_FILE = "offsets.toml"


def load_offsets(path: Path, cameras: Sequence[str]) -> dict[str, float]:
    """Seconds by camera; those that the file does not name have none.

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the file: not TOML, an unknown camera, a value that is no number of seconds.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: lines such as cam_0 = 0.0042 are expected ({error})") from None
    names = belongs_to(data, cameras, path)
    for name, value in data.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"{path}: the offset of {name} must be a number of seconds, got {value!r}")
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
    offsets = load_offsets(file, session.rig.names)
    if any(offsets.values()) and isinstance(session, Session) and session.rate is None:
        raise ValueError(f"{file}: offsets are in seconds, but of this recording only the order of the frames is known")
    return offsets
