"""Calibration formats for writing, and notes on what each of them does not preserve."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from sylpose.io.calibration import anipose, colmap, filestorage, kalibr, native, stereo
from sylpose.rig import Rig

__all__ = ["OUTPUT_FORMATS", "OutputFormat", "choose_output_format"]

_STORAGE = (".yml", ".yaml", ".json", ".xml")


class OutputFormat(NamedTuple):
    """Output format of rigs.

    Attributes:
        suffixes: suffixes of its file; empty for a folder.
        to_texts: returns the texts of its files, by their paths.
        list_differences: returns sentences on differences between the files and the rig.
    """

    suffixes: tuple[str, ...]
    to_texts: Callable[[Rig, Path], dict[Path, str]]
    list_differences: Callable[[Rig], list[str]] = lambda _: []


def _make_single_file(to_text: Callable[[Rig], str]) -> Callable[[Rig, Path], dict[Path, str]]:
    return lambda rig, path: {path: to_text(rig)}


def _format_colmap(rig: Rig, folder: Path) -> dict[Path, str]:
    return {folder / name: text for name, text in colmap.to_texts(rig).items()}


def _note_unit(rig: Rig) -> list[str]:
    return [f"it does not contain the length unit, {rig.unit}"] if rig.unit else []


def _note_world(rig: Rig) -> list[str]:
    return [f"its world is the frame of camera {rig.cameras[0].name}"]


def _note_kalibr(rig: Rig) -> list[str]:
    renamed = ", ".join(f"cam{i} is {name}" for i, name in enumerate(rig.names) if name != f"cam{i}")
    unit_note = ["lengths are in m"] if rig.unit not in ("", "m") else []
    return [*_note_world(rig), *([renamed] if renamed else []), *unit_note]


OUTPUT_FORMATS: dict[str, OutputFormat] = {
    "sylpose": OutputFormat((".toml",), _make_single_file(native.to_text)),
    "opencv": OutputFormat(_STORAGE, lambda rig, path: {path: filestorage.to_text(rig, path.suffix.lower())}),
    "opencv-stereo": OutputFormat(
        _STORAGE,
        lambda rig, path: {path: stereo.to_text(rig, path.suffix.lower())},
        lambda rig: [
            *_note_world(rig),
            f"its cameras are called 1 and 2, which are {' and '.join(rig.names)}",
            *_note_unit(rig),
        ],
    ),
    "anipose": OutputFormat((".toml",), _make_single_file(anipose.to_text), _note_unit),
    "kalibr": OutputFormat((".yaml", ".yml"), _make_single_file(kalibr.to_text), _note_kalibr),
    "colmap": OutputFormat((), _format_colmap, _note_unit),
}


def choose_output_format(path: Path, to: str | None) -> OutputFormat:
    """Choose the output format of a calibration: the given one, or the one implied by the file name.

    Raises:
        ValueError: no such format, or a name that does not fit it.
    """
    suffix = path.suffix.lower()
    if to is None:
        if suffix and suffix not in (".toml", *_STORAGE) and not path.is_dir():
            raise ValueError(
                f"{path}: a calibration is written as one of .toml, {', '.join(_STORAGE)}, or as COLMAP's folder; "
                f"or specify the format: {', '.join(OUTPUT_FORMATS)}"
            )
        to = "sylpose" if suffix == ".toml" else "opencv" if suffix in _STORAGE else "colmap"
        if "camchain" in path.stem.lower() and suffix in OUTPUT_FORMATS["kalibr"].suffixes:
            to = "kalibr"
    if to not in OUTPUT_FORMATS:
        raise ValueError(f"to must be one of {', '.join(OUTPUT_FORMATS)}, got {to!r}")
    if OUTPUT_FORMATS[to].suffixes and suffix not in OUTPUT_FORMATS[to].suffixes:
        raise ValueError(f"{path}: {to} is written as one of {', '.join(OUTPUT_FORMATS[to].suffixes)}")
    return OUTPUT_FORMATS[to]
