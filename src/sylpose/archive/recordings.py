"""Discovery of recordings: folders below a source, or entries of a manifest."""

from __future__ import annotations

import csv
import hashlib
import io
import re
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from sylpose import __version__
from sylpose.archive.stores import Store, StoredFile, is_url, open_store, resolve_location
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors, parse_toml, to_one_line
from sylpose.io.calibration.files import is_calibration_name
from sylpose.io.capture.names import IMAGE_SUFFIXES
from sylpose.io.capture.sources import NON_CAMERA_NAMES, VIDEO_SUFFIXES
from sylpose.methods import FEATURES, METHODS, resolve_features
from sylpose.runs.world import is_world_text

__all__ = ["FoundRecordings", "Recording", "TrackingOptions", "find_recordings"]


class TrackingOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Tracking options of a recording: those of `track_session`, the output unit, and the world.

    The world is a specification, or the URL or path of its file.
    """

    method: str = METHODS[0]
    features: str = FEATURES[0]
    smooth: bool | None = None
    refine_calibration: bool = False
    start: int = 0
    stop: int | None = None
    every: int = 1
    overlay: bool = True
    seed: int = 0
    unit: str | None = None
    world: str | None = None


class Recording(msgspec.Struct, frozen=True, kw_only=True):
    """One recording of an archive.

    Attributes:
        name: name of its folder in the destination; may contain "/".
        url: URL or path of its folder.
        calibration, boxes, masks, offsets: URLs or paths of files (masks: a folder) outside its folder.
        options: tracking options.
        inputs: digest of its input files: names, sizes and etags (modification times).
    """

    name: str
    url: str
    options: TrackingOptions
    inputs: str
    calibration: str | None = None
    boxes: str | None = None
    masks: str | None = None
    offsets: str | None = None

    @property
    def digest(self) -> str:
        """Return a digest of everything that determines the result: inputs, options, version."""
        return _digest([__version__, self.inputs, msgspec.to_builtins(self.options)])


class FoundRecordings(msgspec.Struct, frozen=True):
    """Recordings found in the sources.

    Attributes:
        recordings: sorted by name, names unique.
        remarks: messages about folders that look like a recording but were not used.
    """

    recordings: tuple[Recording, ...]
    remarks: tuple[str, ...]


class _Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An entry of a manifest: a path, and settings that differ from the defaults."""

    path: str
    name: str | None = None
    calibration: str | None = None
    boxes: str | None = None
    masks: str | None = None
    offsets: str | None = None
    method: str | None = None
    features: str | None = None
    smooth: bool | None = None
    refine_calibration: bool | None = None
    start: int | None = None
    stop: int | None = None
    every: int | None = None
    overlay: bool | None = None
    seed: int | None = None
    unit: str | None = None
    world: str | None = None


class _Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    recording: list[_Row]


def find_recordings(
    sources: Sequence[str], options: TrackingOptions, calibration: str | None = None, out: Store | None = None
) -> FoundRecordings:
    """Find the recordings in folders, object-store URLs and manifests.

    A recording is a folder with videos or image folders, and a calibration. Its name is its path below the source, or
    its own name if it is the source.

    Args:
        sources: folders, URLs and manifest files.
        options: defaults, which a manifest can override.
        calibration: calibration for recordings without one in their folder or the manifest.
        out: the destination; it is not searched, and must differ from the recordings' folders.

    Raises:
        ValueError: a source without recordings, two recordings with the same name, an invalid manifest, or options that
            a method does not support.
        OSError: a source does not exist.
    """
    found: list[Recording] = []
    remarks: list[str] = []
    options = _resolve_world(options, None)
    for source in sources:
        if PurePosixPath(source).suffix.lower() in (".toml", ".csv"):
            found += _read_manifest(source, options, calibration)
            continue
        below_source, uncalibrated = _find_below(open_store(source), options, calibration, out)
        if not below_source:
            hint = (
                f", but {_shorten_list(uncalibrated)} without a calibration: set one with --calibration"
                if uncalibrated
                else ""
            )
            raise ValueError(f"{source}: no recording in it (a folder with videos or images and a calibration){hint}")
        found += below_source
        if uncalibrated:
            remarks.append(f"{source}: skipped without a calibration: {_shorten_list(uncalibrated)}.")
    by_name: dict[str, Recording] = {}
    for recording in found:
        resolve_features(recording.options.method, recording.options.features)
        other = by_name.setdefault(recording.name, recording)
        if other is not recording:
            raise ValueError(
                f"{other.url} and {recording.url} would both be named {to_one_line(recording.name)}: use their common "
                "parent folder, or set names in a manifest"
            )
    for name in sorted(by_name):
        if out is not None and out.join(name).url == by_name[name].url:
            raise ValueError(
                f"--out {out.url}: the results of {name} would be in the folder of its videos; use another folder"
            )
        for outer in PurePosixPath(name).parents:
            if outer.as_posix() in by_name:
                raise ValueError(f"recording {name} would be inside the results of {outer}: set names in a manifest")
    return FoundRecordings(tuple(by_name[name] for name in sorted(by_name)), tuple(remarks))


def _find_below(
    source: Store, options: TrackingOptions, calibration: str | None, out: Store | None
) -> tuple[list[Recording], list[str]]:
    """Find the recordings below a source, and folders that only lack a calibration."""
    if source.folder is not None and not source.folder.is_dir():
        raise FileNotFoundError(f"{source.url}: no such folder")
    files, results = source.files(), f"{out.url}/" if out is not None else ""
    if results.startswith(f"{source.url}/") and results != f"{source.url}/":
        files = [file for file in files if not f"{source.url}/{file.name}".startswith(results)]
    taken, uncalibrated = _group_by_folder(files, calibration is not None)
    separate_files = _resolve_files(calibration=calibration)
    found = []
    for folder, inside in taken.items():
        name = folder or source.url.rpartition("/")[2]
        where = source.join(folder) if folder else source
        has_calibration = any(is_calibration_name(Path(file.name)) for file in inside)
        used = {} if has_calibration else separate_files
        inputs = _digest_inputs(inside, used | _world_file(options))
        found.append(Recording(name=name, url=where.url, options=options, inputs=inputs, **used))
    return found, uncalibrated


def _group_by_folder(files: Iterable[StoredFile], calibrated: bool) -> tuple[dict[str, list[StoredFile]], list[str]]:
    """Group files by recording folder; also return folders without calibration.

    The source itself is "". File names are relative to the folders.
    """
    videos, images, calibrations = set(), set(), set()
    usable = [file for file in files if not NON_CAMERA_NAMES & set(file.name.split("/")[:-1])]
    for file in usable:
        path = PurePosixPath(file.name)
        suffix, folder = path.suffix.lower(), _path_text(path.parent)
        if suffix in VIDEO_SUFFIXES and path.stem not in NON_CAMERA_NAMES:
            videos.add(folder)
        elif suffix in IMAGE_SUFFIXES and len(path.parts) > 1:
            images.add(_path_text(path.parent.parent))
        elif is_calibration_name(Path(path.name)):
            calibrations.add(folder)
    # An image folder next to recordings does not make their common parent a recording.
    parent_folders = {outer for folder in videos | images for outer in _list_parents(folder)}
    candidates = {
        folder for folder in videos | images if folder in videos | calibrations or folder not in parent_folders
    }
    taken = candidates if calibrated else candidates & calibrations
    by_folder: dict[str, list[StoredFile]] = {folder: [] for folder in taken if not taken & _list_parents(folder)}
    for file in files:
        parents = [_path_text(p) for p in PurePosixPath(file.name).parents]
        for folder in parents:
            inner = file.name[len(folder) + 1 if folder else 0 :]
            if folder in by_folder and not inner.startswith("sylpose/"):
                by_folder[folder].append(StoredFile(inner, file.size, file.tag))
    uncalibrated = [
        folder or "the folder itself"
        for folder in sorted(candidates)
        if not by_folder.keys() & {folder, *_list_parents(folder)}
    ]
    return {folder: by_folder[folder] for folder in sorted(by_folder)}, uncalibrated


def _path_text(path: PurePosixPath) -> str:
    text = path.as_posix()
    return "" if text == "." else text


def _list_parents(folder: str) -> set[str]:
    """Return the parents of a folder, "" for the source."""
    return {_path_text(parent) for parent in PurePosixPath(folder).parents} - {folder}


def _read_manifest(manifest: str, options: TrackingOptions, calibration: str | None) -> list[Recording]:
    """Read the recordings of a manifest; its paths are relative to its folder."""
    folder, _, name = open_store(manifest).url.rpartition("/")
    base = open_store(folder or "/")
    content = base.read(name)
    if content is None:
        raise FileNotFoundError(f"{manifest}: no such manifest")
    found = []
    for row in _parse_rows(content, manifest):
        recording_store = resolve_location(row.path, base)
        row_files = {kind: getattr(row, kind) for kind in ("calibration", "boxes", "masks", "offsets")}
        separate_files = {
            kind: resolve_location(value, base).url for kind, value in row_files.items() if value is not None
        }
        if recording_store.folder is not None and not recording_store.folder.is_dir():
            raise FileNotFoundError(f"{manifest}: {to_one_line(row.path)}: no such folder")
        files = [file for file in recording_store.files() if not file.name.startswith("sylpose/")]
        if "calibration" not in separate_files and not any(is_calibration_name(Path(f.name)) for f in files):
            separate_files |= _resolve_files(calibration=calibration)
        row_options = {
            key: value for key in TrackingOptions.__struct_fields__ if (value := getattr(row, key)) is not None
        }
        recording_name = row.name or (
            recording_store.url.rpartition("/")[2] if is_url(row.path) else _path_text(PurePosixPath(row.path))
        )
        if not recording_name or any(part in ("", ".", "..") for part in re.split(r"[/\\]", recording_name)):
            recording_name = recording_store.url.rpartition("/")[2]
        chosen = msgspec.structs.replace(options, **row_options)
        chosen = _resolve_world(chosen, base) if row.world is not None else chosen
        inputs = _digest_inputs(files, separate_files | _world_file(chosen))
        found.append(
            Recording(name=recording_name, url=recording_store.url, options=chosen, inputs=inputs, **separate_files)
        )
    if not found:
        raise ValueError(f"{manifest}: no recording in it")
    return found


def _parse_rows(content: bytes, manifest: str) -> list[_Row]:
    """Parse a manifest: TOML with one table [[recording]] each, or CSV with one line each; empty cells are unset."""
    with input_errors(manifest):
        return _parse_rows_unchecked(content, manifest)


def _parse_rows_unchecked(content: bytes, manifest: str) -> list[_Row]:
    try:
        if manifest.lower().endswith(".toml"):
            return msgspec.convert(parse_toml(content.decode("utf-8-sig"), MAX_TABLE_BYTES), _Manifest).recording
        lines: list[dict[str, Any]] = []
        for line in csv.DictReader(io.StringIO(content.decode("utf-8-sig"))):
            lines.append({(key or "more cells than the header has"): value for key, value in line.items() if value})
        return msgspec.convert(lines, list[_Row], strict=False)
    except (msgspec.MsgspecError, tomllib.TOMLDecodeError, csv.Error) as error:
        raise ValueError(f"{_rephrase_error(error)}; columns are {', '.join(_Row.__struct_fields__)}") from None
    except UnicodeDecodeError:
        raise ValueError("is not text") from None


def _rephrase_error(error: Exception) -> str:
    """Rephrase an msgspec error: `$.recording[2].start` becomes recording 3."""
    message, _, path = str(error).partition(" - at `")
    number = path.partition("[")[2].partition("]")[0]
    key = path.rstrip("`").rpartition(".")[2] if "]." in path else ""
    where = f"recording {int(number) + 1}: " if number.isdigit() else ""
    return f"{where}{key + ': ' if key else ''}{message[:1].lower()}{message[1:]}"


def _resolve_world(options: TrackingOptions, base: Store | None) -> TrackingOptions:
    """Resolve the options' world file to a URL or absolute path, relative to `base` or the working directory."""
    if options.world is None or is_world_text(options.world):
        return options
    url = (open_store(options.world) if base is None else resolve_location(options.world, base)).url
    return msgspec.structs.replace(options, world=url)


def _world_file(options: TrackingOptions) -> dict[str, str]:
    return {} if options.world is None or is_world_text(options.world) else {"world": options.world}


def _resolve_files(**given: str | None) -> dict[str, str]:
    """Return the given files as URLs or absolute paths."""
    return {kind: open_store(value).url for kind, value in given.items() if value is not None}


def _digest_inputs(files: Iterable[StoredFile], separate_files: dict[str, str]) -> str:
    """Digest the inputs: names, sizes and tags of the recording's files, and contents of the small separate files."""
    parts: list[Any] = [(file.name, file.size, file.tag) for file in files]
    for kind, url in sorted(separate_files.items()):
        if kind == "masks":
            parts += [kind, [(file.name, file.size, file.tag) for file in Store(url).files()]]
            continue
        folder, _, name = url.rpartition("/")
        content = open_store(folder or "/").read(name)
        if content is None:
            raise FileNotFoundError(f"{url}: no such file ({kind})")
        parts += [kind, hashlib.blake2b(content).hexdigest()]
    return _digest(parts)


def _digest(parts: list[Any]) -> str:
    return hashlib.blake2b(msgspec.json.encode(parts), digest_size=16).hexdigest()


def _shorten_list(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
