"""What a run was asked for and the calibration that it used, beside its results: written, and read again."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from sylpose import __version__, calibration
from sylpose.app.checkpoint import fingerprint
from sylpose.calibration.world import save_world
from sylpose.capture import Session
from sylpose.capture.live import LiveSession
from sylpose.files import output_folder, replacing, toml_key, toml_string
from sylpose.reading import parsed_toml, text_of, told

__all__ = ["SETTINGS", "USED", "WORLD", "root_of", "settings_of", "table", "world_said", "write_record"]

SETTINGS, USED, WORLD = "settings.toml", "calibration.used.toml", "world.toml"
# Whose versions answers may depend on, to rounding; OpenCV in whatever flavour there is.
_OPENCV = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python")
_PACKAGES = ("numpy", "scipy", "numba", "av", *_OPENCV)
_HEAD = f"# What this run of sylpose was asked for. The calibration that it used is beside it, in {USED}.\n"


def write_record(
    folder: Path, session: Session | LiveSession, options: Mapping[str, object], noticed: Sequence[str] = ()
) -> list[Path]:
    """Writes `settings.toml` and `calibration.used.toml`, and `world.toml` of a session that is told in a world of one's
    own; returns these files.

    Args:
        options: numbers, words or tables of these by the names that `track_session` has for them; None is left out.
        noticed: sentences about what looked wrong before the run.

    Raises:
        OSError: naming the file that cannot be written.
    """
    output_folder(folder)
    begun = datetime.now(UTC).isoformat(timespec="seconds")
    asked = {name: value for name, value in options.items() if value is not None}
    of_session = {"rate": session.rate, "unit": session.rig.unit or None, "world": session.world and session.world.said}
    asked |= {name: value for name, value in of_session.items() if value is not None}
    text = f"{_HEAD}begun = {begun}\nrecording = {toml_string(str(session.path.resolve()))}\n"
    text += f"calibration = {toml_string(str(session.calibration.resolve()))}\n"
    if isinstance(session, Session) and session.rate is not None:
        text += f"rate = {session.rate!r}\n"
    if session.without:
        text += f"without = [{', '.join(map(toml_string, session.without))}]\n"
    if noticed:
        text += f"noticed = [{', '.join(map(toml_string, noticed))}]\n"
    text += _table("options", {name: value for name, value in asked.items() if not isinstance(value, Mapping)})
    for name, value in asked.items():
        if isinstance(value, Mapping):
            text += _table(name, value)
    if isinstance(session, Session):
        if session.timeline.offsets:
            text += _table("frame_offsets", session.timeline.offsets)
        text += _table("cameras", {source.camera: str(source.path.resolve()) for source in session.sources})
        text += "\n# Of what the result depends on; images count by their names and sizes."
        text += _table("checksums", fingerprint(session))
    text += _table("versions", _versions())
    settings, used = folder / SETTINGS, folder / USED
    with replacing(settings) as part:
        part.write_text(text, encoding="utf-8")
    calibration.save(session.rig, used)
    if session.world is None:
        return [settings, used]
    save_world(session.world, folder / WORLD)
    return [settings, used, folder / WORLD]


def root_of(folder: Path) -> Path:
    """The folder of the run: of several objects, each has a folder in it."""
    return folder.parent if not (folder / SETTINGS).is_file() and (folder.parent / SETTINGS).is_file() else folder


def settings_of(folder: Path) -> dict[str, Any]:
    """What settings.toml says; nothing where there is none, as of runs of 0.1.0."""
    file = root_of(folder) / SETTINGS
    if not file.is_file():
        return {}
    content = text_of(file)
    with told(file):
        return parsed_toml(content)


def table(settings: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    table = settings.get(name)
    return table if isinstance(table, dict) else {}


def world_said(result: Path) -> str | None:
    """By what the world of a result was told, whose z axis goes up; None of one that is told in its calibration's world.

    Args:
        result: folder of the run, or of one of its objects, or a file in it.
    """
    folder = result if result.is_dir() else result.parent
    # A world.toml alone does not tell: `sylpose check` leaves one, too.
    world = table(settings_of(folder), "options").get("world")
    return None if world is None else str(world)


def _versions() -> dict[str, str]:
    found = {"sylpose": __version__, "python": platform.python_version(), "system": platform.platform(terse=True)}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _table(name: str, values: Mapping[str, object]) -> str:
    return f"\n[{name}]\n" + "".join(f"{toml_key(key)} = {_value(value)}\n" for key, value in values.items())


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return toml_string(value) if isinstance(value, str) else repr(value)
