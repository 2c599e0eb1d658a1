"""Names: which file belongs to which camera, and which number an image file has."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

__all__ = ["IMAGE_SUFFIXES", "belongs_to", "image_files", "image_numbers", "match_names", "several_of"]

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".jp2"})


def match_names(found: Iterable[str], cameras: Sequence[str]) -> dict[str, str]:
    """Match names of files to names of cameras: exactly, then tolerantly (`cam_0`, `0`, `Cam0`, `cam-00`, `port_0`).

    Where that finds none, words that all files' names have in common say nothing, nor those that all cameras' have:
    Pose2Sim's `int_cam01_img` and `cam01`, Anipose's `A` and `vid1-camA`. Only if every camera has its one file by it.

    Returns:
        camera's name for each name of `found` that has one.

    Raises:
        ValueError: names that are equal but for what is tolerated, so that the match would not be unique.
    """
    names, known = list(found), set(cameras)
    matched = {name: name for name in names if name in known}
    by_key: dict[str, list[str]] = {}
    for camera in cameras:
        if camera not in matched:
            by_key.setdefault(_key(camera), []).append(camera)
    alike: dict[str, list[str]] = {}
    for name in names:
        if name not in known:
            alike.setdefault(_key(name), []).append(name)
    for name in names:
        candidates = by_key.get(_key(name), []) if name not in matched else []
        rivals = alike.get(_key(name), [])
        if candidates and len(candidates) + len(rivals) > 2:
            raise ValueError(f"it is not clear which of {', '.join(rivals)} is which camera of {', '.join(candidates)}")
        if candidates:
            matched[name] = candidates[0]
    return matched or _by_what_differs(names, cameras)


def belongs_to(found: Iterable[str], cameras: Sequence[str], where: Path | str) -> dict[str, str]:
    """As `match_names`, for names that must all be cameras', each of another.

    Raises:
        ValueError: naming `where` and the names that are no camera's.
    """
    names = list(found)
    try:
        matched = match_names(names, cameras)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    unknown = [name for name in names if name not in matched]
    if unknown:
        raise ValueError(f"{where}: {', '.join(unknown)} is no camera of the calibration ({', '.join(cameras)})")
    return matched


def _by_what_differs(names: Sequence[str], cameras: Sequence[str]) -> dict[str, str]:
    """Camera by name, by the word in which they differ from the others of their kind; nothing unless all are matched."""
    if len(names) != len(cameras):
        return {}
    own, its = _own_words(names), _own_words(cameras)
    if not all(own) or len(set(own)) < len(own) or set(own) != set(its):
        return {}
    by_word = dict(zip(its, cameras, strict=True))
    return {name: by_word[word] for name, word in zip(names, own, strict=True)}


def several_of(names: Sequence[str], cameras: Sequence[str]) -> list[str]:
    """The names of the first camera where several are each camera's by its own word: several recordings in one folder.
    Nothing otherwise."""
    each, rest = divmod(len(names), max(len(cameras), 1))
    if each < 2 or rest:
        return []
    having: dict[str, list[str]] = {}
    for name in names:
        for word in {_key(word) for word in re.split(r"[\s_.-]+", name)}:
            having.setdefault(word, []).append(name)
    its = [having.get(word, []) for word in _own_words(cameras)]
    return its[0] if {len(those) for those in its} == {each} and len(set().union(*its)) == len(names) else []


def _own_words(names: Sequence[str]) -> list[str]:
    """Of each name what is left without the words that all have."""
    split = [[_key(word) for word in re.split(r"[\s_.-]+", name) if word] for name in names]
    common = set.intersection(*map(set, split)) if len(split) > 1 else set()
    return ["_".join(word for word in words if word not in common) for words in split]


def image_files(folder: Path) -> list[Path]:
    """The images of a folder in natural order (2 before 10), hidden files aside.

    Raises:
        ValueError: two images that differ in their suffix only.
    """
    files = [f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and f.name[0] != "." and f.is_file()]
    files.sort(key=lambda f: ([int(part) if i % 2 else part for i, part in enumerate(_parts(f.stem))], f.name))
    for first, second in pairwise(files):
        if first.stem == second.stem:
            raise ValueError(f"{folder}: {first.name} and {second.name} are two images of one name")
    return files


def image_numbers(files: Sequence[Path]) -> tuple[int, ...] | None:
    """The frame numbers in the names of naturally sorted files: the last number that counts up from file to file."""
    rows = [[int(part) for part in _parts(file.stem)[1::2]] for file in files]
    if len({len(row) for row in rows}) != 1:
        return None
    columns: list[tuple[int, ...]] = list(zip(*rows, strict=True))
    return next((c for c in reversed(columns) if all(a < b for a, b in pairwise(c))), None)


def _parts(stem: str) -> list[str]:
    """Text and digits in turn, text first."""
    return re.split(r"([0-9]+)", stem)


def _key(name: str) -> str:
    lower = name.lower().strip()
    bare = re.sub(r"^(camera|cam|port|video|view)[\s_.-]*", "", lower) or lower
    return str(int(bare)) if re.fullmatch(r"[0-9]+", bare) else re.sub(r"[\s_.-]+", "_", bare)
