"""Discovery of recordings: folders below a source, or entries of a manifest."""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Sequence
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

import msgspec

from sylpose import __version__
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors, parse_toml, to_one_line
from sylpose.io.calibration.files import is_calibration_name
from sylpose.io.capture.layouts import list_takes
from sylpose.io.capture.sources import find_recording_folders
from sylpose.io.stores import ObjectStore, Store, StoredFile, open_store, resolve_location
from sylpose.methods import FEATURES, METHODS, resolve_features
from sylpose.runs.world import is_world_text

SOURCE = PurePosixPath(".")
FILE_KINDS = ("calibration", "boxes", "masks", "offsets")


class _Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    recording: list[dict[str, Any]]


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


class Recording(TrackingOptions, frozen=True, kw_only=True):
    """One recording of an archive, with its options.

    Attributes:
        name: name of its folder in the destination; may contain "/".
        path: URL or path of its folder.
        calibration, boxes, masks, offsets: URLs or paths of files (masks: a folder) outside its folder.
        inputs: digest of its input files: names, sizes and etags (modification times).
    """

    name: str = ""
    path: str
    take: str = ""
    calibration: str | None = None
    boxes: str | None = None
    masks: str | None = None
    offsets: str | None = None
    inputs: str = ""

    @property
    def options(self) -> dict[str, Any]:
        return {key: getattr(self, key) for key in TrackingOptions.__struct_fields__}

    @property
    def digest(self) -> str:
        """Return a digest of everything that determines the result: inputs, options, version."""
        return _digest([__version__, self.inputs, self.take, self.options])


COLUMNS = ("path", "name", "take", *FILE_KINDS, *TrackingOptions.__struct_fields__)


def find_recordings(
    sources: Sequence[str], options: TrackingOptions, calibration: str | None = None, out: Store | None = None
) -> tuple[list[Recording], list[str]]:
    """Find the recordings in folders, object-store URLs and manifests.

    A recording is a folder with videos or image folders, and a calibration. Its name is its path below the source, or
    its own name if it is the source.

    Args:
        sources: folders, URLs and manifest files.
        options: defaults, which a manifest can override.
        calibration: calibration for recordings without one in their folder or the manifest.
        out: the destination; it is not searched, and must differ from the recordings' folders.

    Returns:
        the recordings, sorted by name, and messages about folders that look like a recording but were not used.

    Raises:
        ValueError: a source without recordings, two recordings with the same name, an invalid manifest, or options that
            a method does not support.
        OSError: a source does not exist.
    """
    remarks: list[str] = []
    if options.world is not None:
        options = msgspec.structs.replace(options, world=_resolve("world", options.world, open_store(".")))
    calibration = None if calibration is None else open_store(calibration).url
    by_name: dict[str, Recording] = {}
    for source in sources:
        if PurePosixPath(source).suffix.lower() in (".toml", ".csv"):
            found = _read_manifest(source, options, calibration)
        else:
            found, uncalibrated = _find_below(open_store(source), options, calibration, out)
            if uncalibrated and found:
                remarks.append(f"{source}: skipped without a calibration: {uncalibrated}.")
            if not found:
                hint = f", but {uncalibrated} without a calibration: set one with --calibration" if uncalibrated else ""
                raise ValueError(
                    f"{source}: no recording in it (a folder with videos or images and a calibration){hint}"
                )
        for recording in found:
            resolve_features(recording.method, recording.features)
            other = by_name.setdefault(recording.name, recording)
            if other is not recording:
                raise ValueError(
                    f"{other.path} and {recording.path} would both be named {to_one_line(recording.name)}: use their "
                    "common parent folder, or set names in a manifest"
                )
    for name in sorted(by_name):
        if out is not None and out.join(name).url == by_name[name].path:
            raise ValueError(
                f"--out {out.url}: the results of {name} would be in the folder of its videos; use another folder"
            )
        for outer in PurePosixPath(name).parents:
            if outer.as_posix() in by_name:
                raise ValueError(f"recording {name} would be inside the results of {outer}: set names in a manifest")
    return [by_name[name] for name in sorted(by_name)], remarks


def _find_below(
    source: Store, options: TrackingOptions, calibration: str | None, out: Store | None
) -> tuple[list[Recording], str]:
    """Find the recordings below a source, and list folders that only lack a calibration."""
    files, results = _list_files(source, source.url), "" if out is None else f"{out.url}/"
    if results.startswith(f"{source.url}/") and results != f"{source.url}/":
        files = [file for file in files if not f"{source.url}/{file.name}".startswith(results)]
    paths: dict[PurePath, StoredFile] = {PurePosixPath(file.name): file for file in files}
    folders, uncalibrated = find_recording_folders(paths, calibration is not None)
    inside: dict[PurePath, list[StoredFile]] = {folder: [] for folder in folders}
    for path, file in paths.items():
        for folder in inside.keys() & set(path.parents):
            inside[folder].append(file._replace(name=path.relative_to(folder).as_posix()))
    found = []
    for folder in folders:
        name = source.url.rpartition("/")[2] if folder == SOURCE else folder.as_posix()
        url = source.join(folder.as_posix()).url
        recording = Recording(name=name, path=url, **msgspec.structs.asdict(options))
        found.append(_complete(recording, inside[folder], calibration))
    if not found and not isinstance(source, ObjectStore):
        found = _find_takes(source, options, files, calibration)
    names = ["the folder itself" if name == SOURCE else str(name) for name in uncalibrated]
    return found, ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _find_takes(
    source: Store, options: TrackingOptions, files: Sequence[StoredFile], calibration: str | None
) -> list[Recording]:
    """Find the takes in the folder of another program."""
    try:
        takes = list_takes(Path(source.url), None if calibration is None else Path(calibration))
    except ValueError:
        return []
    name = source.url.rpartition("/")[2]
    defaults = msgspec.structs.asdict(options)
    return [
        _complete(Recording(name=take or name, path=source.url, take=take, **defaults), files, None) for take in takes
    ]


def _list_files(store: Store, label: str) -> list[StoredFile]:
    if not isinstance(store, ObjectStore) and not Path(store.url).is_dir():
        raise FileNotFoundError(f"{label}: no such folder")
    return store.files()


def _read_manifest(manifest: str, options: TrackingOptions, calibration: str | None) -> list[Recording]:
    """Read the recordings of a manifest; its paths are relative to its folder."""
    location = open_store(manifest)
    base = location.join("..")
    if (content := location.read("")) is None:
        raise FileNotFoundError(f"{manifest}: no such manifest")
    with input_errors(manifest):
        entries = _parse_manifest(content, manifest.lower().endswith(".toml"), options)
    found = []
    for recording, given in entries:
        store = resolve_location(recording.path, base)
        files = _list_files(store, f"{manifest}: {to_one_line(recording.path)}")
        paths: dict[str, Any] = {
            kind: _resolve(kind, given[kind], base) for kind in (*FILE_KINDS, "world") if kind in given
        }
        name = recording.name or PurePosixPath(recording.path).as_posix()
        if "://" in name or any(part in ("", ".", "..") for part in re.split(r"[/\\]", name)):
            name = store.url.rpartition("/")[2]
        recording = msgspec.structs.replace(recording, name=name, path=store.url, **paths)
        found.append(_complete(recording, files, calibration))
    if not found:
        raise ValueError(f"{manifest}: no recording in it")
    return found


def _parse_manifest(content: bytes, is_toml: bool, options: TrackingOptions) -> list[tuple[Recording, dict[str, Any]]]:
    """Parse a manifest: TOML with one table [[recording]] each, or CSV with one line each; empty cells are unset.

    Returns:
        the recordings, with the given options where the manifest sets none; and what it sets of each.
    """
    where, found = "", []
    try:
        text = content.decode("utf-8-sig")
        if is_toml:
            tables = msgspec.convert(parse_toml(text, MAX_TABLE_BYTES), _Manifest).recording
        else:
            lines = csv.DictReader(io.StringIO(text), restkey="more cells than the header has")
            tables = [{key: value for key, value in line.items() if value} for line in lines]
        for number, table in enumerate(tables, 1):
            where = f"recording {number}: "
            for key in table.keys() - set(COLUMNS):
                raise ValueError(f"unknown field `{to_one_line(key)}`")
            found.append((msgspec.convert(msgspec.structs.asdict(options) | table, Recording, strict=is_toml), table))
    except UnicodeDecodeError:
        raise ValueError("is not text") from None
    except (ValueError, msgspec.MsgspecError, csv.Error) as error:
        message, _, path = str(error).partition(" - at `$.")
        message = (f"{path.rstrip('`')}: " if path else "") + message[:1].lower() + message[1:]
        raise ValueError(f"{where}{message}; columns are {', '.join(COLUMNS)}") from None
    return found


def _resolve(kind: str, location: str, base: Store) -> str:
    """Resolve the location of a file to a URL or absolute path, relative to `base`; a world may be no file."""
    return location if kind == "world" and is_world_text(location) else resolve_location(location, base).url


def _complete(recording: Recording, files: Sequence[StoredFile], calibration: str | None) -> Recording:
    """Add the digest of the inputs to a recording, and a calibration if it has none.

    Names, sizes and tags of the recording's files, and contents of the small separate files, are digested.
    """
    files = [file for file in files if not file.name.startswith("sylpose/")]
    if recording.calibration is None and not any(is_calibration_name(Path(file.name)) for file in files):
        recording = msgspec.structs.replace(recording, calibration=calibration)
    inputs: list[Any] = [file[:3] for file in files]
    for kind in (*FILE_KINDS, "world"):
        url = getattr(recording, kind)
        if url is None or (kind == "world" and is_world_text(url)):
            continue
        if kind == "masks":
            inputs += [kind, [file[:3] for file in open_store(url).files()]]
        else:
            if (content := open_store(url).read("")) is None:
                raise FileNotFoundError(f"{url}: no such file ({kind})")
            inputs += [kind, hashlib.blake2b(content).hexdigest()]
    return msgspec.structs.replace(recording, inputs=_digest(inputs))


def _digest(parts: list[Any]) -> str:
    return hashlib.blake2b(msgspec.json.encode(parts), digest_size=16).hexdigest()
