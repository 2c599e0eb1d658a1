"""Where the videos and the calibration of a recording are: in one folder, or as other programs arrange them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from sylpose.io import calibration as calibrations
from sylpose.io.capture.names import match_names, split_takes
from sylpose.io.capture.sources import (
    CALIBRATION_PREFIXES,
    NON_CAMERA_NAMES,
    THUMBNAIL_NAMES,
    describe_missing_sources,
    find_camera_folders,
    find_entries,
    list_folder_takes,
)

# Folders with the videos or image folders of a recording, by preference: FreeMoCap, Pose2Sim, DANNCE, EasyMocap, Anipose,
# OpenCap.
SOURCE_FOLDERS = ("synchronized_videos", "videos", "videos-raw", "videos_raw", "Videos", "images")
# Folder of recordings of a project of Caliscope.
RECORDINGS_FOLDER = "recordings"
# A calibration is searched in so many folders above the recording (choice: participant, session, project).
MAX_PARENTS = 3


@dataclass(frozen=True)
class Layout:
    """Folders and files of a recording.

    Attributes:
        path: the recording's own folder, with boxes and results.
        sources: folder of the videos or image folders.
        calibration: its calibration.
        take: the take's name if the folder that was given has several folders of takes; "" else.
    """

    path: Path
    sources: Path
    calibration: Path
    take: str = ""


def find_layouts(folder: Path, calibration: Path | None = None, is_lens: bool = False) -> list[Layout]:
    """Find the recordings in a folder: itself, its folder of videos, or each of its folders of takes.

    Args:
        folder: recording or project of sylpose, Pose2Sim, Anipose, FreeMoCap, Caliscope, DANNCE, DeepLabCut, Multical,
            EasyMocap or OpenCap.
        calibration: the calibration file; None to search it in the recording, in folders such as calibration in it, and in
            the folders above.
        is_lens: whether that may be the file of one lens, without the cameras' names, or no file.

    Returns:
        by name of the take; one recording without takes if there are no videos.

    Raises:
        ValueError: no calibration, or several of the same rank.
    """
    sources = _find_source_folder(folder)
    if sources is not None:
        return [Layout(folder, sources, calibration or _find_calibration(folder, sources))]
    inner = [
        path for place in (folder, folder / RECORDINGS_FOLDER) if place.is_dir() for path in sorted(place.iterdir())
    ]
    takes = [(path, found) for path in inner if _may_be_take(path) and (found := _find_source_folder(path)) is not None]
    if takes:
        layouts = [
            Layout(path, found, calibration or _find_calibration(path, found), path.name) for path, found in takes
        ]
        cameras = _read_camera_names(layouts[0].calibration)
        if is_lens and len(cameras) < 2:  # two folders with a single video each are cameras
            are_takes = sum(len(find_entries(found)) == 1 for _, found in takes) < 2
        else:
            # Folders with the cameras' names are no takes, unless there are files of all cameras in each.
            of_cameras = match_names([path.name for path, _ in takes], cameras)
            are_takes = set(of_cameras.values()) < set(cameras) or _has_all_cameras(layouts[0].sources, cameras)
        if are_takes:
            return layouts
    return [Layout(folder, folder, calibration or _find_calibration(folder, folder))]


def list_takes(folder: Path, calibration: Path | None = None) -> list[str]:
    """Return the names of the takes in a folder; "" for a recording without takes.

    Raises:
        ValueError: no videos, or as `find_layouts`.
    """
    layouts = find_layouts(folder, calibration)
    if len(layouts) > 1:
        return [layout.take for layout in layouts]
    sources = layouts[0].sources
    by_camera = find_camera_folders(sources)
    names = [entry.name if entry.is_dir() else entry.stem for entry in find_entries(sources)]
    if not names and not by_camera:
        raise ValueError(describe_missing_sources(folder))
    takes = list(split_takes(names, _read_camera_names(layouts[0].calibration)))
    if not names:
        takes = list_folder_takes(by_camera)
    return takes if len(takes) > 1 else [layouts[0].take]


def _may_be_take(path: Path) -> bool:
    name, others = path.name.lower(), NON_CAMERA_NAMES | THUMBNAIL_NAMES
    return path.is_dir() and not name.startswith((".", *CALIBRATION_PREFIXES)) and name not in others


def _has_all_cameras(sources: Path, cameras: Sequence[str]) -> bool:
    names = [entry.stem for entry in find_entries(sources)]
    return set(match_names(names, cameras).values()) == set(cameras) or bool(split_takes(names, cameras))


def _find_source_folder(folder: Path) -> Path | None:
    """Return the folder itself or the one in it that has videos, image folders, or a folder of videos for each camera."""
    places = [folder, *(folder / name for name in SOURCE_FOLDERS if (folder / name).is_dir())]
    for place in places:
        if find_entries(place):
            return place
    return next((place for place in places[1:] if len(find_camera_folders(place)) > 1), None)


def _find_calibration(folder: Path, sources: Path) -> Path:
    """Find the calibration in a recording, in folders of it, or above it; the nearest one.

    Raises:
        ValueError: none, or several in the nearest place.
    """
    places = [folder, sources]
    for place in (folder, *islice(folder.resolve().parents, MAX_PARENTS)):
        inner = [path for path in _list_folders(place) if path.name.lower().startswith(CALIBRATION_PREFIXES)]
        places += [place, *inner]
    for place in places:
        if calibrations.search(place):
            return calibrations.find(place)
    return calibrations.find(folder)


def _list_folders(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.is_dir())
    except OSError:  # a folder above that may not be read
        return []


def _read_camera_names(calibration: Path) -> Sequence[str]:
    """Return the names of a calibration's cameras, whatever their sizes."""
    names = list[str]()

    def look_up(unknown: Sequence[str]) -> dict[str, tuple[int, int]]:
        names.extend(unknown)
        return {}

    try:
        return calibrations.load(calibration, look_up).names
    except ValueError:
        return names
