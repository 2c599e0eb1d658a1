"""Metadata of a run: its options and calibration, written next to the results and read again."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import msgspec

from sylpose import __version__
from sylpose.atomic_io import format_toml_key, format_toml_string, make_output_folder, replace_atomically
from sylpose.input_limits import UnreadableFileError, input_errors, parse_toml, read_text
from sylpose.io import calibration
from sylpose.io.calibration.world import save_world
from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.io.capture.session import reopen_session
from sylpose.rig import Rig
from sylpose.runs.checkpoint import compute_fingerprint, compute_rig_checksum
from sylpose.sync.offsets import apply_offsets

SETTINGS, USED_CALIBRATION, WORLD, TRAJECTORY = "settings.toml", "calibration.used.toml", "world.toml", "trajectory.csv"
# Calibration from the recording itself, and its page.
ESTIMATED = "calibration.estimated.toml", "calibration.estimated.html"
# Folder of the results in a recording's folder.
DEFAULT_FOLDER = "sylpose"
# Packages whose versions may change results by rounding; OpenCV in any of its variants.
_OPENCV = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python")
_PACKAGES = ("numpy", "scipy", "numba", "av", *_OPENCV)
_HEADER = (
    f"# Options of this run of sylpose. The calibration that it used is in {USED_CALIBRATION}, in the same folder.\n"
)
_COMMENTS = {"checksums": "# Checksums of the inputs; of images, their names and sizes.\n"}


# Values by their keys in settings.toml; None is omitted.
_Values = Mapping[str, object]


def write_run_metadata(
    folder: Path, session: Session | LiveSession, options: _Values, warnings: Sequence[str] = ()
) -> list[Path]:
    """Write `settings.toml` and `calibration.used.toml`, and `world.toml` if the session has its own world frame.

    Args:
        folder: folder of the run; created if missing.
        session: the session that is tracked.
        options: numbers, strings or tables of these, by their names in `track_session`; None is omitted.
        warnings: warnings from before the run.

    Returns:
        The files.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    inputs: dict[str, object] = {
        "recording": str(session.path.resolve()),
        "calibration": str(session.calibration.resolve()),
    }
    tables: dict[str, _Values] = {}
    if isinstance(session, Session):
        inputs |= {"rate": session.rate, "without": [*session.without] or None, "as_coded": session.as_coded or None}
        tables["frame_offsets"] = session.timeline.offsets
        tables["cameras"] = {source.camera: str(source.path.resolve()) for source in session.sources}
        tables["checksums"] = compute_fingerprint(session)
    world = session.world and session.world.description
    options = {**options, "rate": session.rate, "unit": session.rig.unit or None, "world": world}
    inputs["warnings"] = [*warnings] or None
    files = _write_metadata(folder, session.rig, inputs, options, tables)
    if session.world is None:
        return files
    save_world(session.world, folder / WORLD)
    return [*files, folder / WORLD]


def write_table_run_metadata(
    folder: Path, tables: Sequence[Path], calibration_file: Path, rig: Rig, options: _Values, warnings: Sequence[str]
) -> list[Path]:
    """Write the same files for a run on tables of image points instead of a recording.

    Args:
        folder: folder of the run; created if missing.
        tables: files with image points.
        calibration_file: the calibration's file.
        rig: the cameras.
        options: as in `write_run_metadata`.
        warnings: warnings from before the run.

    Raises:
        OSError: naming the file that cannot be written, or read.
    """
    files = [str(table.resolve()) for table in tables]
    inputs = {"tables": files, "calibration": str(calibration_file.resolve()), "warnings": [*warnings] or None}
    checksums = {file: file_checksum(Path(file)) for file in files} | {"calibration": compute_rig_checksum(rig)}
    return _write_metadata(folder, rig, inputs, {**options, "unit": rig.unit or None}, {"checksums": checksums})


def file_checksum(file: Path) -> str:
    """Return the BLAKE2b checksum of a file's content."""
    return hashlib.blake2b(file.read_bytes(), digest_size=16).hexdigest()


def _write_metadata(
    folder: Path, rig: Rig, inputs: _Values, options: _Values, tables: Mapping[str, _Values]
) -> list[Path]:
    """Write both files: the run's inputs, then its options and the tables."""
    make_output_folder(folder)
    nested = {name: value for name, value in options.items() if isinstance(value, Mapping)}
    options = {name: value for name, value in options.items() if name not in nested}
    tables = {"options": options, **nested, **tables, "versions": _collect_versions()}
    text = f"{_HEADER}started = {datetime.now(UTC).isoformat(timespec='seconds')}\n{_format_lines(inputs)}"
    for name, values in tables.items():
        if values:
            text += f"\n{_COMMENTS.get(name, '')}[{name}]\n{_format_lines(values)}"
    with replace_atomically(folder / SETTINGS) as part:
        part.write_text(text, encoding="utf-8")
    calibration.save(rig, folder / USED_CALIBRATION)
    return [folder / SETTINGS, folder / USED_CALIBRATION]


def find_result(path: Path) -> Path:
    """Return the folder of the results in a recording's folder; other paths are returned as they are."""
    if (path / SETTINGS).is_file() or (path / TRAJECTORY).is_file():
        return path
    inner = path / DEFAULT_FOLDER
    # A recording of several takes has only their folders in it.
    is_result = (inner / SETTINGS).is_file() or any(inner.glob(TRAJECTORY)) or any(inner.glob(f"*/{TRAJECTORY}"))
    return inner if is_result else path


def find_run_folder(result: Path) -> Path:
    """Return the folder of the run of a result: a folder, which may be that of one of several objects, or a file in it."""
    folder = result if result.is_dir() else result.parent
    return folder.parent if not (folder / SETTINGS).is_file() and (folder.parent / SETTINGS).is_file() else folder


def find_settings(result: Path) -> Path:
    """Return the path of a result's settings.toml, which may not exist."""
    return find_run_folder(result) / SETTINGS


def read_settings(result: Path) -> dict[str, Any]:
    """Read settings.toml of a result; return an empty dictionary if it does not exist, as for runs of 0.1.0."""
    file = find_settings(result)
    if not file.is_file():
        return {}
    content = read_text(file)
    with input_errors(file):
        return parse_toml(content)


def settings_table(settings: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    table = settings.get(name)
    return table if isinstance(table, dict) else {}


def read_world_definition(result: Path) -> str | None:
    """Return the definition of a result's own world frame (z up), or None for the calibration's world.

    Args:
        result: folder of the run, or of one of its objects, or a file in it.
    """
    # The existence of world.toml does not decide it: `sylpose check` writes one, too.
    world = settings_table(read_settings(result), "options").get("world")
    return None if world is None else str(world)


def _collect_versions() -> dict[str, str]:
    found = {"sylpose": __version__, "python": platform.python_version(), "system": platform.platform(terse=True)}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _format_lines(values: _Values) -> str:
    known = {key: value for key, value in values.items() if value is not None}
    return "".join(f"{format_toml_key(key)} = {_format_value(value)}\n" for key, value in known.items())


def _format_value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_format_value, value))}]"
    return format_toml_string(value) if isinstance(value, str) else repr(value)


class _Settings(msgspec.Struct, frozen=True):
    """Part of settings.toml that locates the images and matches their frames."""

    recording: str = ""
    cameras: dict[str, str] = {}
    rate: float | None = None
    without: list[str] = []
    as_coded: bool = False
    frame_offsets: dict[str, int] = {}
    offsets: dict[str, float] = {}
    checksums: dict[str, str] = {}


def open_source_recording(result: Path, recording: Path | None = None, *, with_masks: bool = False) -> Session:
    """Open the recording of a run and verify that it is unchanged.

    Args:
        result: folder of the run, or of one of its objects.
        recording: present folder of the recording; None if it was not moved.
        with_masks: with the masks in its folder.

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
    reopen = partial(
        reopen_session,
        path,
        run / USED_CALIBRATION,
        settings.frame_offsets,
        cameras,
        without=settings.without,
        as_coded=settings.as_coded,
    )
    session = reopen(rate=None)
    if session.rate is None and settings.rate is not None:  # given by --rate, for image folders
        session = reopen(rate=settings.rate)
    session = apply_offsets(session, settings.offsets)
    now = compute_fingerprint(session)
    for name in ("images", "timestamps or offsets"):
        if settings.checksums.get(name) != now[name]:
            raise ValueError(f"{path}: the recording's {name} are not those of the run")
    if with_masks:
        return session
    # Only the images are needed.
    return replace(session, masks=None, _masks={}, _boxes={})


def _read_settings(file: Path) -> _Settings:
    settings = read_settings(file.parent)
    with input_errors(file):
        try:
            return msgspec.convert(settings, _Settings)
        except msgspec.MsgspecError as error:
            raise UnreadableFileError(f"{file}: expected the settings of a run ({error})") from None
