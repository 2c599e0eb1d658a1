"""What a run was asked for and the calibration that it used, beside its results: written, and read again."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from sylpose import __version__, calibration
from sylpose.app.checkpoint import checksum_of_rig, fingerprint
from sylpose.atomic_io import output_folder, replacing, toml_key, toml_string
from sylpose.calibration.world import save_world
from sylpose.capture import Session
from sylpose.capture.live import LiveSession
from sylpose.input_limits import parsed_toml, text_of, told
from sylpose.rig import Rig

__all__ = [
    "SETTINGS",
    "USED",
    "WORLD",
    "checksum",
    "root_of",
    "settings_of",
    "table",
    "world_said",
    "write_record",
    "write_record_of_tables",
]

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
    of_session = {"rate": session.rate, "unit": session.rig.unit or None, "world": session.world and session.world.said}
    of: dict[str, object] = {
        "recording": str(session.path.resolve()),
        "calibration": str(session.calibration.resolve()),
    }
    rest = ""
    if isinstance(session, Session):
        of |= _known({"rate": session.rate, "without": [*session.without] or None})
        if session.timeline.offsets:
            rest += _table("frame_offsets", session.timeline.offsets)
        rest += _table("cameras", {source.camera: str(source.path.resolve()) for source in session.sources})
        rest += "\n# Of what the result depends on; images count by their names and sizes."
        rest += _table("checksums", fingerprint(session))
    files = _write(folder, session.rig, of, {**options, **_known(of_session)}, noticed, rest)
    if session.world is None:
        return files
    save_world(session.world, folder / WORLD)
    return [*files, folder / WORLD]


def write_record_of_tables(
    folder: Path,
    tables: Sequence[Path],
    given: Path,
    rig: Rig,
    options: Mapping[str, object],
    noticed: Sequence[str] = (),
) -> list[Path]:
    """The same of what is not of a recording but of tables of pixels, and of a calibration's file.

    Raises:
        OSError: naming the file that cannot be written, or read.
    """
    of = {"tables": [str(table.resolve()) for table in tables], "calibration": str(given.resolve())}
    sums = {str(table.resolve()): checksum(table) for table in tables} | {"calibration": checksum_of_rig(rig)}
    asked = {**options, **_known({"unit": rig.unit or None})}
    return _write(folder, rig, of, asked, noticed, _table("checksums", sums))


def checksum(file: Path) -> str:
    """Of all that is in a file."""
    return hashlib.blake2b(file.read_bytes(), digest_size=16).hexdigest()


def _write(
    folder: Path, rig: Rig, of: Mapping[str, object], asked: Mapping[str, object], noticed: Sequence[str], rest: str
) -> list[Path]:
    """Both files: what the run is of, its options, and the tables after them."""
    output_folder(folder)
    asked = _known(asked)
    text = f"{_HEAD}begun = {datetime.now(UTC).isoformat(timespec='seconds')}\n{_lines(of)}"
    if noticed:
        text += _lines({"noticed": [*noticed]})
    text += _table("options", {name: value for name, value in asked.items() if not isinstance(value, Mapping)})
    for name, value in asked.items():
        if isinstance(value, Mapping):
            text += _table(name, value)
    text += rest + _table("versions", _versions())
    with replacing(folder / SETTINGS) as part:
        part.write_text(text, encoding="utf-8")
    calibration.save(rig, folder / USED)
    return [folder / SETTINGS, folder / USED]


def _known(values: Mapping[str, object]) -> dict[str, object]:
    return {name: value for name, value in values.items() if value is not None}


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
    return f"\n[{name}]\n{_lines(values)}"


def _lines(values: Mapping[str, object]) -> str:
    return "".join(f"{toml_key(key)} = {_value(value)}\n" for key, value in values.items())


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return toml_string(value) if isinstance(value, str) else repr(value)
