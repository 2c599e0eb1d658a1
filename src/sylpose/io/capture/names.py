"""Matching of file names to cameras, and frame numbers in image names."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".jp2"})


def match_names(found: Iterable[str], cameras: Sequence[str], where: Path | str = "") -> dict[str, str]:
    """Match file names to camera names: exactly, then tolerantly (`cam_0`, `0`, `Cam0`, `cam-00`, `port_0`).

    If that finds none, words common to all file names are ignored, and words common to all cameras: Pose2Sim's
    `int_cam01_img` and `cam01`, Anipose's `A` and `vid1-camA`. This applies only if it assigns one file to every
    camera.

    Args:
        found: the file names.
        cameras: the camera names.
        where: where the names are, for the message.

    Returns:
        Camera name by file name, for the names that match.

    Raises:
        ValueError: names that differ only in tolerated ways, so that the match is not unique.
    """
    names, known = list(found), set(cameras)
    matched = {name: name for name in names if name in known}
    by_key: dict[str, list[str]] = {}
    for camera in cameras:
        if camera not in matched:
            by_key.setdefault(_normalize_name(camera), []).append(camera)
    names_by_key: dict[str, list[str]] = {}
    for name in names:
        if name not in known:
            names_by_key.setdefault(_normalize_name(name), []).append(name)
    for name in names:
        candidates = by_key.get(_normalize_name(name), []) if name not in matched else []
        same_key_names = names_by_key.get(_normalize_name(name), [])
        if candidates and len(candidates) + len(same_key_names) > 2:
            problem = f"{', '.join(same_key_names)} match the cameras {', '.join(candidates)} ambiguously"
            raise ValueError(f"{where}: {problem}" if where else problem)
        if candidates:
            matched[name] = candidates[0]
    return matched or _match_distinct_words(names, cameras)


def match_all_names(found: Iterable[str], cameras: Sequence[str], where: Path | str) -> dict[str, str]:
    """Match names as `match_names`, requiring that every name belongs to a different camera.

    Raises:
        ValueError: names that match no camera; the message contains `where` and these names.
    """
    names = list(found)
    matched = match_names(names, cameras, where)
    unknown = [name for name in names if name not in matched]
    if unknown:
        raise ValueError(f"{where}: {', '.join(unknown)} is not a camera of the calibration ({', '.join(cameras)})")
    return matched


def invert_unique(camera_by_entry: Mapping[Path, str], where: Path | str) -> dict[str, Path]:
    """Return the file or folder of each camera.

    Raises:
        ValueError: two of one camera; the message contains `where` and their names.
    """
    by_camera: dict[str, Path] = {}
    for entry, camera in camera_by_entry.items():
        if (other := by_camera.setdefault(camera, entry)) != entry:
            raise ValueError(f"{where}: {other.name} and {entry.name} are both for camera {camera}")
    return by_camera


def _match_distinct_words(names: Sequence[str], cameras: Sequence[str]) -> dict[str, str]:
    """Match names and cameras by their distinguishing words; empty unless all match."""
    if len(names) != len(cameras):
        return {}
    file_words, camera_words = _distinct_words(names), _distinct_words(cameras)
    if not all(file_words) or len(set(file_words)) < len(file_words) or set(file_words) != set(camera_words):
        return {}
    by_word = dict(zip(camera_words, cameras, strict=True))
    return {name: by_word[word] for name, word in zip(names, file_words, strict=True)}


def split_takes(names: Sequence[str], cameras: Sequence[str]) -> dict[str, dict[str, str]]:
    """Split names such as `vid1-camA` into takes, those that have a file for each camera.

    Returns:
        by take, by camera: the file's name; empty unless each name contains one camera's.
    """
    words = dict(zip(_distinct_words(cameras), cameras, strict=True)) | {
        _normalize_name(name): name for name in cameras
    }
    takes = dict[str, dict[str, str]]()
    for name in names:
        parts = re.split(r"([\s_.-]+)", name)
        # A camera's name may have several words.
        spans = [(i, j) for i in range(0, len(parts), 2) for j in range(i + 1, len(parts) + 1, 2)]
        found = [span for span in spans if _normalize_name("".join(parts[slice(*span)])) in words]
        if not found:
            return {}
        i, j = max(found, key=lambda span: (span[1] - span[0], span[0]))
        camera = words[_normalize_name("".join(parts[i:j]))]
        rest = "".join(parts[: max(i - 1, 0)]) + "".join(parts[j if i else j + 1 :])
        takes.setdefault(rest, {})[camera] = name
    return {take: by_camera for take, by_camera in takes.items() if len(by_camera) == len(cameras)}


def _distinct_words(names: Sequence[str]) -> list[str]:
    """Return each name without the words common to all names."""
    split = [[_normalize_name(word) for word in re.split(r"[\s_.-]+", name) if word] for name in names]
    common = set.intersection(*map(set, split)) if len(split) > 1 else set()
    return ["_".join(word for word in words if word not in common) for words in split]


def image_files(folder: Path) -> list[Path]:
    """List the images of a folder in natural order (2 before 10), without hidden files.

    Raises:
        ValueError: two images whose names differ only in the suffix.
    """
    files = [f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and f.name[0] != "." and f.is_file()]
    files.sort(key=lambda f: ([int(part) if i % 2 else part for i, part in enumerate(_split_digits(f.stem))], f.name))
    for first, second in pairwise(files):
        if first.stem == second.stem:
            raise ValueError(f"{folder}: {first.name} and {second.name} are two images with the same name")
    return files


def image_numbers(files: Sequence[Path]) -> tuple[int, ...] | None:
    """Return the frame numbers of naturally sorted files: the last number in the names that increases."""
    rows = [[int(part) for part in _split_digits(file.stem)[1::2]] for file in files]
    if len({len(row) for row in rows}) != 1:
        return None
    columns: list[tuple[int, ...]] = list(zip(*rows, strict=True))
    return next((c for c in reversed(columns) if all(a < b for a, b in pairwise(c))), None)


def _split_digits(stem: str) -> list[str]:
    """Split a name into alternating text and digits, text first."""
    return re.split(r"([0-9]+)", stem)


def _normalize_name(name: str) -> str:
    lower = unicodedata.normalize("NFC", name).lower().strip()  # macOS decomposes letters in file names
    bare = re.sub(r"^(camera|cam|port|video|view)[\s_.-]*", "", lower) or lower
    return str(int(bare)) if re.fullmatch(r"[0-9]+", bare) else re.sub(r"[\s_.-]+", "_", bare)
