"""Which recordings there are: folders found below a source, or listed in a manifest."""

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
from sylpose.app.world import in_words
from sylpose.archive.stores import File, Place, is_url, place, resolved
from sylpose.calibration.files import is_calibration_name
from sylpose.capture.names import IMAGE_SUFFIXES
from sylpose.capture.sources import NO_CAMERAS, VIDEO_SUFFIXES
from sylpose.input_limits import MAX_TABLE, one_line, parsed_toml, told
from sylpose.methods import FEATURES, METHODS, features_of

__all__ = ["Found", "Options", "Recording", "find_recordings"]


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a recording is tracked: those of `track_session`, the unit that it is told in, and the world: in words, or the URL
    or path of its file."""

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
        name: of its folder in the destination; may have "/" in it.
        url: of its folder.
        calibration, boxes, masks, offsets: URLs or paths of files (masks: a folder) that are not found in it.
        options: how it is tracked.
        inputs: digest of what it is tracked from: names, sizes and etags (times of last change) of its files.
    """

    name: str
    url: str
    options: Options
    inputs: str
    calibration: str | None = None
    boxes: str | None = None
    masks: str | None = None
    offsets: str | None = None

    @property
    def digest(self) -> str:
        """Of all that its result depends on: inputs, options, version."""
        return _digest([__version__, self.inputs, msgspec.to_builtins(self.options)])


class Found(msgspec.Struct, frozen=True):
    """Attributes:
    recordings: sorted by name, no two of one name.
    remarks: sentences about what looks like a recording and was not taken.
    """

    recordings: tuple[Recording, ...]
    remarks: tuple[str, ...]


class _Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A line of a manifest: a path, and what is not as for the others."""

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
    sources: Sequence[str], options: Options, calibration: str | None = None, out: Place | None = None
) -> Found:
    """The recordings of folders, object-store URLs and manifests.

    A recording is a folder with videos, or with folders of images, that has a calibration. It has the name of its path below
    the source, or its own if it is the source.

    Args:
        options: of all for which a manifest does not say something else.
        calibration: of all that have none in their folder or the manifest.
        out: where results go: is not looked through, and must not be where the recordings are.

    Raises:
        ValueError: a source without recordings, two recordings of one name, a manifest that is wrong, options that a method
            does not have.
        OSError: a source that is not there.
    """
    found: list[Recording] = []
    remarks: list[str] = []
    options = _at_its_place(options, None)
    for source in sources:
        if PurePosixPath(source).suffix.lower() in (".toml", ".csv"):
            found += _listed(source, options, calibration)
            continue
        here, without = _below(place(source), options, calibration, out)
        if not here:
            why = f", but {_few(without)} without a calibration: give one by --calibration" if without else ""
            raise ValueError(f"{source}: no recording in it (a folder with videos or images and a calibration){why}")
        found += here
        if without:
            remarks.append(f"{source}: not taken, for want of a calibration: {_few(without)}.")
    by_name: dict[str, Recording] = {}
    for recording in found:
        features_of(recording.options.method, recording.options.features)
        other = by_name.setdefault(recording.name, recording)
        if other is not recording:
            raise ValueError(
                f"{other.url} and {recording.url} would both be called {one_line(recording.name)}: give the folder "
                "that both lie in, or names in a manifest"
            )
    for name in sorted(by_name):
        if out is not None and out.below(name).url == by_name[name].url:
            raise ValueError(f"--out {out.url}: the results of {name} would lie among its videos; give another folder")
        for outer in PurePosixPath(name).parents:
            if outer.as_posix() in by_name:
                raise ValueError(f"recording {name} would lie in the results of {outer}: give names in a manifest")
    return Found(tuple(by_name[name] for name in sorted(by_name)), tuple(remarks))


def _below(
    source: Place, options: Options, calibration: str | None, out: Place | None
) -> tuple[list[Recording], list[str]]:
    """Recordings below a source, and folders that would be some with a calibration."""
    if source.folder is not None and not source.folder.is_dir():
        raise FileNotFoundError(f"{source.url}: no such folder")
    files, results = source.files(), f"{out.url}/" if out is not None else ""
    if results.startswith(f"{source.url}/") and results != f"{source.url}/":
        files = [file for file in files if not f"{source.url}/{file.name}".startswith(results)]
    taken, without = _folders(files, calibration is not None)
    side = _sides(calibration=calibration)
    found = []
    for folder, inside in taken.items():
        name = folder or source.url.rpartition("/")[2]
        where = source.below(folder) if folder else source
        own = any(is_calibration_name(Path(file.name)) for file in inside)
        used = {} if own else side
        inputs = _inputs(inside, used | _world_file(options))
        found.append(Recording(name=name, url=where.url, options=options, inputs=inputs, **used))
    return found, without


def _folders(files: Iterable[File], calibrated: bool) -> tuple[dict[str, list[File]], list[str]]:
    """By folder ("" the source itself) the files of the recordings, named from there; and folders without calibration."""
    videos, images, calibrations = set(), set(), set()
    usable = [file for file in files if not NO_CAMERAS & set(file.name.split("/")[:-1])]
    for file in usable:
        path = PurePosixPath(file.name)
        suffix, folder = path.suffix.lower(), _text(path.parent)
        if suffix in VIDEO_SUFFIXES and path.stem not in NO_CAMERAS:
            videos.add(folder)
        elif suffix in IMAGE_SUFFIXES and len(path.parts) > 1:
            images.add(_text(path.parent.parent))
        elif is_calibration_name(Path(path.name)):
            calibrations.add(folder)
    # A folder of pictures that lies beside recordings does not make one of all of them.
    around = {outer for folder in videos | images for outer in _around(folder)}
    like = {folder for folder in videos | images if folder in videos | calibrations or folder not in around}
    taken = like if calibrated else like & calibrations
    by_folder: dict[str, list[File]] = {folder: [] for folder in taken if not taken & _around(folder)}
    for file in files:
        parents = [_text(p) for p in PurePosixPath(file.name).parents]
        for folder in parents:
            inner = file.name[len(folder) + 1 if folder else 0 :]
            if folder in by_folder and not inner.startswith("sylpose/"):
                by_folder[folder].append(File(inner, file.size, file.tag))
    lone = [
        folder or "the folder itself" for folder in sorted(like) if not by_folder.keys() & {folder, *_around(folder)}
    ]
    return {folder: by_folder[folder] for folder in sorted(by_folder)}, lone


def _text(path: PurePosixPath) -> str:
    text = path.as_posix()
    return "" if text == "." else text


def _around(folder: str) -> set[str]:
    """The folders that a folder lies in, "" for the source."""
    return {_text(parent) for parent in PurePosixPath(folder).parents} - {folder}


def _listed(manifest: str, options: Options, calibration: str | None) -> list[Recording]:
    """The recordings of a manifest; its paths are relative to its folder."""
    folder, _, name = place(manifest).url.rpartition("/")
    base = place(folder or "/")
    content = base.read(name)
    if content is None:
        raise FileNotFoundError(f"{manifest}: no such manifest")
    found = []
    for row in _rows(content, manifest):
        own = resolved(row.path, base)
        given = {what: getattr(row, what) for what in ("calibration", "boxes", "masks", "offsets")}
        side = {what: resolved(value, base).url for what, value in given.items() if value is not None}
        if own.folder is not None and not own.folder.is_dir():
            raise FileNotFoundError(f"{manifest}: {one_line(row.path)}: no such folder")
        files = [file for file in own.files() if not file.name.startswith("sylpose/")]
        if "calibration" not in side and not any(is_calibration_name(Path(f.name)) for f in files):
            side |= _sides(calibration=calibration)
        changed = {key: value for key in Options.__struct_fields__ if (value := getattr(row, key)) is not None}
        called = row.name or (own.url.rpartition("/")[2] if is_url(row.path) else _text(PurePosixPath(row.path)))
        if not called or any(part in ("", ".", "..") for part in re.split(r"[/\\]", called)):
            called = own.url.rpartition("/")[2]
        chosen = msgspec.structs.replace(options, **changed)
        chosen = _at_its_place(chosen, base) if row.world is not None else chosen
        inputs = _inputs(files, side | _world_file(chosen))
        found.append(Recording(name=called, url=own.url, options=chosen, inputs=inputs, **side))
    if not found:
        raise ValueError(f"{manifest}: no recording in it")
    return found


def _rows(content: bytes, manifest: str) -> list[_Row]:
    """TOML with a table [[recording]] for each, or CSV with a line for each; an empty cell says nothing."""
    with told(manifest):
        return _rows_in(content, manifest)


def _rows_in(content: bytes, manifest: str) -> list[_Row]:
    try:
        if manifest.lower().endswith(".toml"):
            return msgspec.convert(parsed_toml(content.decode("utf-8-sig"), MAX_TABLE), _Manifest).recording
        lines: list[dict[str, Any]] = []
        for line in csv.DictReader(io.StringIO(content.decode("utf-8-sig"))):
            lines.append({(key or "more cells than the header has"): value for key, value in line.items() if value})
        return msgspec.convert(lines, list[_Row], strict=False)
    except (msgspec.MsgspecError, tomllib.TOMLDecodeError, csv.Error) as error:
        raise ValueError(f"{_plain(error)}; columns are {', '.join(_Row.__struct_fields__)}") from None
    except UnicodeDecodeError:
        raise ValueError("is not text") from None


def _plain(error: Exception) -> str:
    """msgspec's sentence, its path in words: `$.recording[2].start` is recording 3."""
    said, _, path = str(error).partition(" - at `")
    number = path.partition("[")[2].partition("]")[0]
    key = path.rstrip("`").rpartition(".")[2] if "]." in path else ""
    where = f"recording {int(number) + 1}: " if number.isdigit() else ""
    return f"{where}{key + ': ' if key else ''}{said[:1].lower()}{said[1:]}"


def _at_its_place(options: Options, base: Place | None) -> Options:
    """The same with the file of a world, if it is one, as URL or absolute path; relative to `base`, or to where we are."""
    if options.world is None or in_words(options.world):
        return options
    url = (place(options.world) if base is None else resolved(options.world, base)).url
    return msgspec.structs.replace(options, world=url)


def _world_file(options: Options) -> dict[str, str]:
    return {} if options.world is None or in_words(options.world) else {"world": options.world}


def _sides(**given: str | None) -> dict[str, str]:
    """Files that are named and not found, as URLs or absolute paths."""
    return {what: place(value).url for what, value in given.items() if value is not None}


def _inputs(files: Iterable[File], side: dict[str, str]) -> str:
    """Of a recording's files names, sizes and tags; of those beside it, which are small, the content."""
    parts: list[Any] = [(file.name, file.size, file.tag) for file in files]
    for what, url in sorted(side.items()):
        if what == "masks":
            parts += [what, [(file.name, file.size, file.tag) for file in Place(url).files()]]
            continue
        folder, _, name = url.rpartition("/")
        content = place(folder or "/").read(name)
        if content is None:
            raise FileNotFoundError(f"{url}: no such file ({what})")
        parts += [what, hashlib.blake2b(content).hexdigest()]
    return _digest(parts)


def _digest(parts: list[Any]) -> str:
    return hashlib.blake2b(msgspec.json.encode(parts), digest_size=16).hexdigest()


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
