"""Matching of file names to cameras, and frame numbers in image names."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

# Length of names of cameras that are recognized within words (choice: serial numbers; shorter ones are in other numbers).
MIN_CONTAINED_LENGTH = 4
# Images have numbers in common if these are this share of the smaller set's (choice): two series in one folder are, and
# folders whose equal numbers are one moment.
MIN_COMMON_NUMBERS = 0.5
# Name that ends with a time of the years 2001 to 2033: seconds, and their fraction or nanoseconds.
_EPOCH = re.compile(r"(.*?)(1[0-9]{9})([._-])([0-9]{1,9})")
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".jp2"})


def match_names(found: Iterable[str], cameras: Sequence[str], where: Path | str = "") -> dict[str, str]:
    """Match file names to camera names: exactly, then tolerantly (`cam_0`, `0`, `Cam0`, `cam-00`, `port_0`).

    If that finds none, words common to all file names are ignored, and words common to all cameras: Pose2Sim's
    `int_cam01_img` and `cam01`, Anipose's `A` and `vid1-camA`; at last, names within words (`Video110374` and the serial
    number `10374`). This applies only if it assigns one file to every camera.

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
    return matched or _match_distinct_words(names, cameras) or _match_contained(names, cameras)


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


def _match_contained(names: Sequence[str], cameras: Sequence[str]) -> dict[str, str]:
    """Match names that contain a camera's name, such as its serial number; empty unless each does, and all match."""
    if len(names) != len(cameras) or any(len(_normalize_name(camera)) < MIN_CONTAINED_LENGTH for camera in cameras):
        return {}
    keys = {camera: _normalize_name(camera) for camera in cameras}
    found = {name: [c for c, key in keys.items() if key in _normalize_name(name)] for name in names}
    if sorted(c for its in found.values() for c in its) != sorted(cameras) or not all(found.values()):
        return {}
    return {name: its[0] for name, its in found.items()}


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


def has_images(folder: Path) -> bool:
    """Return whether a folder has any image, without listing all of them."""
    return any(_is_image(file) for file in folder.iterdir())


def image_files(folder: Path) -> list[Path]:
    """List the images of a folder in natural order (2 before 10) or by the times in their names, without hidden files.

    Raises:
        ValueError: two images whose names differ only in the suffix, or two series such as color and depth.
    """
    files = [file for file in folder.iterdir() if _is_image(file)]
    files.sort(key=lambda f: ([int(part) if i % 2 else part for i, part in enumerate(_split_digits(f.stem))], f.name))
    for first, second in pairwise(files):
        if first.stem == second.stem:
            raise ValueError(f"{folder}: {first.name} and {second.name} are two images with the same name")
    _check_one_series(files, folder)
    if (times := _epoch_times(files)) is not None:
        files = [file for _, file in sorted(zip(times, files, strict=True))]
    return files


def _is_image(file: Path) -> bool:
    return file.suffix.lower() in IMAGE_SUFFIXES and file.name[0] != "." and file.is_file()


def _check_one_series(files: Sequence[Path], folder: Path) -> None:
    """Check that names do not repeat the same numbers with other words: color_001 and depth_001."""
    series = dict[tuple[str, ...], dict[tuple[str, ...], Path]]()
    for file in files:
        parts = _split_digits(file.stem)
        series.setdefault(tuple(parts[::2]), {})[tuple(parts[1::2])] = file
    (first, *others) = sorted(series.values(), key=len, reverse=True) or [{}]
    for other in others:
        if len(other) > 1 and len(first.keys() & other.keys()) >= MIN_COMMON_NUMBERS * len(other):
            names = f"{next(iter(first.values())).name} and {next(iter(other.values())).name}"
            raise ValueError(f"{folder}: {names} are of two series of images; one for each folder is expected")


def _epoch_times(files: Sequence[Path]) -> list[int] | None:
    """Return the times in names such as `image_1738133056.145716000`, nanoseconds since 1970; None for other names.

    Nanoseconds may lack their leading zeros (`1738133056.9658000`), as some exporters of ROS write them.
    """
    matches = [match for file in files if (match := _EPOCH.fullmatch(file.stem))]
    if len(matches) < len(files) or len({match[1] for match in matches}) != 1:
        return None
    n_digits = max(len(match[4]) for match in matches)
    if matches[0][3] != "." and n_digits < 9 and len({match[2] for match in matches}) == 1:
        return None  # a serial number and a counter
    is_decimal = matches[0][3] == "." and n_digits < 9
    fractions = [match[4].ljust(9, "0") if is_decimal else match[4] + "0" * (9 - n_digits) for match in matches]
    return [int(match[2]) * 10**9 + int(fraction) for match, fraction in zip(matches, fractions, strict=True)]


def image_numbers(files: Sequence[Path]) -> tuple[int, ...] | None:
    """Return the frame numbers of sorted files: times since 1970, or the last number in the names that increases."""
    if (times := _epoch_times(files)) is not None and all(a < b for a, b in pairwise(times)):
        return tuple(times)
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
