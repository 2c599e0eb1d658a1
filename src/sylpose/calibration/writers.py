"""The formats that rigs are written in, and what of a rig each does not keep."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from sylpose.calibration import anipose, colmap, filestorage, kalibr, native, stereo
from sylpose.rig import Rig

__all__ = ["FORMATS", "Written", "format_for"]

_STORAGE = (".yml", ".yaml", ".json", ".xml")


class Written(NamedTuple):
    """A format that rigs are written in.

    Attributes:
        suffixes: of its file; none for a folder.
        texts: the texts of its files, by their paths.
        notes: sentences on what is otherwise in it than in the rig.
    """

    suffixes: tuple[str, ...]
    texts: Callable[[Rig, Path], dict[Path, str]]
    notes: Callable[[Rig], list[str]] = lambda _: []


def _one(to_text: Callable[[Rig], str]) -> Callable[[Rig, Path], dict[Path, str]]:
    return lambda rig, path: {path: to_text(rig)}


def _colmap(rig: Rig, folder: Path) -> dict[Path, str]:
    return {folder / name: text for name, text in colmap.to_texts(rig).items()}


def _unit(rig: Rig) -> list[str]:
    return [f"it does not say that lengths are in {rig.unit}"] if rig.unit else []


def _at_first(rig: Rig) -> list[str]:
    return [f"its world is the frame of camera {rig.cameras[0].name}"]


def _of_kalibr(rig: Rig) -> list[str]:
    called = ", ".join(f"cam{i} is {name}" for i, name in enumerate(rig.names) if name != f"cam{i}")
    metres = ["lengths are in m"] if rig.unit not in ("", "m") else []
    return [*_at_first(rig), *([called] if called else []), *metres]


FORMATS: dict[str, Written] = {
    "sylpose": Written((".toml",), _one(native.to_text)),
    "opencv": Written(_STORAGE, lambda rig, path: {path: filestorage.to_text(rig, path.suffix.lower())}),
    "opencv-stereo": Written(
        _STORAGE,
        lambda rig, path: {path: stereo.to_text(rig, path.suffix.lower())},
        lambda rig: [
            *_at_first(rig),
            f"its cameras are called 1 and 2, which are {' and '.join(rig.names)}",
            *_unit(rig),
        ],
    ),
    "anipose": Written((".toml",), _one(anipose.to_text), _unit),
    "kalibr": Written((".yaml", ".yml"), _one(kalibr.to_text), _of_kalibr),
    "colmap": Written((), _colmap, _unit),
}


def format_for(path: Path, to: str | None) -> Written:
    """The format that a calibration with this path is written in: the one that is named, or the one that its name tells.

    Raises:
        ValueError: no such format, or a name that does not fit it.
    """
    suffix = path.suffix.lower()
    if to is None:
        if suffix and suffix not in (".toml", *_STORAGE) and not path.is_dir():
            raise ValueError(
                f"{path}: a calibration is written as one of .toml, {', '.join(_STORAGE)}, or as COLMAP's folder; "
                f"or say which format: {', '.join(FORMATS)}"
            )
        to = "sylpose" if suffix == ".toml" else "opencv" if suffix in _STORAGE else "colmap"
        if "camchain" in path.stem.lower() and suffix in FORMATS["kalibr"].suffixes:
            to = "kalibr"
    if to not in FORMATS:
        raise ValueError(f"to must be one of {', '.join(FORMATS)}, got {to!r}")
    if FORMATS[to].suffixes and suffix not in FORMATS[to].suffixes:
        raise ValueError(f"{path}: {to} is written as one of {', '.join(FORMATS[to].suffixes)}")
    return FORMATS[to]
