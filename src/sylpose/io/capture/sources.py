"""Image sources of a session folder: one video, image folder or page stack per camera."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any, Literal

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.stream import VideoStream

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import UnreadableFileError, resolve_path
from sylpose.io.calibration.files import is_calibration_name
from sylpose.io.capture.image_sizes import describe_size_mismatch
from sylpose.io.capture.images import read_exif_focal, read_image, read_image_size, read_orientation
from sylpose.io.capture.names import (
    IMAGE_SUFFIXES,
    has_images,
    image_files,
    image_numbers,
    invert_unique,
    match_names,
    split_takes,
)
from sylpose.io.capture.page_stacks import STACK_SUFFIXES, PageStack, is_page_stack
from sylpose.io.capture.presentation import read_presentation
from sylpose.io.capture.unusable_files import describe_unusable_files, describe_unusable_video
from sylpose.rig import Camera, Rig

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".wmv", ".flv", ".ogv"}
)
# FFmpeg detects the format by content: any file may be a playlist of other files and URLs, whatever its name. Only
# video containers are allowed, and only local files.
DEMUXER_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,mpeg,mpegvideo,mpegts,asf,flv,live_flv,ogg",
}
# A title that is not UTF-8 must not make a video unreadable. PyAV >= 19 accepts any title; earlier versions need this
# option.
METADATA_OPTIONS: dict[str, Any] = {} if int(av.__version__.partition(".")[0]) >= 19 else {"metadata_errors": "replace"}
# EXIF orientation of a video whose pictures are to be turned counterclockwise by so many quarter turns.
EXIF_ORIENTATIONS = (1, 8, 3, 6)
# Folder names that sylpose itself writes or reads, and which are never cameras.
NON_CAMERA_NAMES = frozenset({"sylpose", "masks", "overlay"})
# Folder names of network drives, archives and viewers, whose images are thumbnails or copies.
THUMBNAIL_NAMES = frozenset({"@eadir", "__macosx", "thumbnails", "thumbs", "#recycle", "$recycle.bin"})
# Beginnings of the names of folders and videos for calibration: Pose2Sim, Anipose, DANNCE, DeepLabCut.
CALIBRATION_PREFIXES = ("calib", "camera_matrix")


@dataclass(frozen=True)
class Source:
    """Image source of one camera.

    Attributes:
        camera: the camera's name in the calibration.
        path: the video, the folder or the page stack.
        kind: "video", "images" or "pages".
        size: (width, height) in pixels, of the camera.
        n_frames: number of frames that the video declares; counted if it declares none.
        rate: average frame rate in frames per second; None for images and for videos without one.
        files: the images in order; empty for videos.
        numbers: the numbers in the image names; None for videos and if the names have no usable numbers.
        pts: presentation time stamp of each frame of a video, increasing, units of `time_base`; None for images and if
            the file has none.
        time_base: seconds.
        orientation: EXIF orientation that is applied to each frame: the display matrix of videos and EXIF of images, if the
            calibration fits the turned image; 1 for frames as coded.
        is_orientation_ambiguous: whether the calibration fits the image as coded as well.
    """

    camera: str
    path: Path
    kind: Literal["video", "images", "pages"]
    size: tuple[int, int]
    n_frames: int
    rate: float | None = None
    files: tuple[Path, ...] = field(default=(), repr=False)
    numbers: tuple[int, ...] | None = field(default=None, repr=False)
    pts: tuple[int, ...] | None = field(default=None, repr=False)
    time_base: float = 1.0
    orientation: int = 1
    is_orientation_ambiguous: bool = False

    @property
    def coded_size(self) -> tuple[int, int]:
        """(width, height) of the frames in the file."""
        return self.size[::-1] if self.orientation >= 5 else self.size

    @property
    def stamps(self) -> FloatArray | None:
        """(n_frames,) presentation times of a video's frames on the file's clock, seconds; None if unknown."""
        return None if self.pts is None else np.array(self.pts) * self.time_base

    def frame_number(self, k: int) -> int:
        """Return the number in the name of image `k`, or `k` if the names have no numbers."""
        return k if self.numbers is None else self.numbers[k]


@dataclass(frozen=True)
class RecordingFolder:
    """Folder of a recording.

    Attributes:
        path: the folder.
        calibration: the calibration file, named in messages.
        other_folders: folders with other content, such as masks.
        source_by_camera: video or image folder by camera, if the names do not identify it; the others are found by
            name.
        without: excluded cameras that are not in the rig; their sources are optional.
        as_coded: whether frames are not turned as their files specify where the calibration fits both.
        take: the take of which the sources are, if the folder has several.
    """

    path: Path
    calibration: Path
    other_folders: Sequence[Path] = ()
    source_by_camera: Mapping[str, Path | str] = field(default_factory=dict)
    without: Sequence[str] = ()
    as_coded: bool = False
    take: str = ""

    def find_sources(self, rig: Rig) -> tuple[tuple[Source, ...], list[str]]:
        """Find the image source of each camera.

        Returns:
            The sources in the rig's order, and warnings.

        Raises:
            FileNotFoundError: a file given in `source_by_camera` does not exist.
            ValueError: cameras without source and sources without camera (all listed), an unreadable video, or an image
                size that differs from the calibration's.
        """
        by_camera = self._match_entries(rig.names)
        warnings: list[str] = []
        return tuple(_probe(by_camera[camera.name], camera, warnings, self.as_coded) for camera in rig), warnings

    def list_cameras(self) -> list[str]:
        """List the cameras, excluded ones too, where no calibration names them: sources given, or all by their names.

        Raises:
            ValueError: no sources, or several takes of each camera.
        """
        return [*self.source_by_camera] or [*dict.fromkeys((self._find_entries() or self._select_folders()).values())]

    def read_focal_lengths(self, cameras: Sequence[str]) -> dict[str, float]:
        """Read the focal lengths of cameras from the EXIF of their first images.

        Returns:
            pixels, by camera.

        Raises:
            FileNotFoundError: as `find_sources`.
            ValueError: as `find_sources`, or naming a camera without.
        """
        focal = {
            name: read_exif_focal(image_files(entry)[0]) if entry.is_dir() else None
            for name, entry in self._match_entries(cameras).items()
        }
        if missing := [name for name, its in focal.items() if its is None]:
            raise ValueError(
                f"fov: no focal length in the EXIF of {', '.join(missing)} (only photographs have one, videos do not): give "
                "the horizontal field of view in degrees"
            )
        return {name: its for name, its in focal.items() if its is not None}

    def read_image_sizes(self, cameras: Sequence[str]) -> dict[str, tuple[int, int]]:
        """Read the image sizes of cameras whose calibration does not contain them.

        Returns:
            (width, height) by camera.

        Raises:
            FileNotFoundError, ValueError: as `find_sources`.
        """
        sizes = {}
        for name, entry in self._match_entries([name for name in cameras if name not in self.without]).items():
            size, orientation = _read_format(entry)
            sizes[name] = size[::-1] if orientation >= 5 else size
        return sizes

    def _match_entries(self, cameras: Sequence[str]) -> dict[str, Path]:
        """Return the video or image folder of each camera, without those of excluded cameras."""
        path, by_camera = self.path, self._resolve_given(cameras)
        unassigned = [name for name in cameras if name not in by_camera]
        names = self._find_entries((*cameras, *self.without), by_camera.values())
        if not names and unassigned:
            names = self._select_folders()
        names = self._select_take(names, unassigned)
        found = [*names]
        try:
            matched = match_names(dict.fromkeys(names.values()), [*unassigned, *self.without])
        except ValueError as error:
            raise ValueError(f"{path}: {error}; select it with --video NAME=FILE") from None
        given = {entry: camera for camera, entry in by_camera.items()}
        by_camera = invert_unique(given | {e: matched[names[e]] for e in found if names[e] in matched}, path)
        for name in self.without:
            by_camera.pop(name, None)
        missing = [name for name in cameras if name not in by_camera]
        # If sources were named explicitly, the folder may contain others.
        extra = [entry.name for entry in found if names[entry] not in matched and not self.source_by_camera]
        if missing or extra:
            calibration = self.calibration.name
            problems = [f"no video or image folder for camera {', '.join(missing)} of {calibration}"] if missing else []
            if extra:
                problems.append(f"no camera in {calibration} ({', '.join(cameras)}) for {', '.join(extra)}")
            found_text = "" if len(extra) == len(found) else f"; found {', '.join(entry.name for entry in found)}"
            hint = (
                f", or exclude a camera with --exclude-camera {missing[0]}" if 0 < len(missing) < len(cameras) else ""
            )
            unusable = describe_unusable_files(path)
            reason = f". {unusable}" if missing and unusable else ""
            raise ValueError(
                f"{path}: {'; '.join(problems)}{found_text}; assign them with --video NAME=FILE{hint}{reason}"
            )
        return by_camera

    def _find_entries(self, cameras: Sequence[str] = (), given: Collection[Path] = ()) -> dict[Path, str]:
        """Return the videos and image folders with their names, without folders of other content and given ones."""
        others = {resolve_path(folder) for folder in (*self.other_folders, *given)}
        found = [entry for entry in find_entries(self.path, cameras) if resolve_path(entry) not in others]
        return {entry: entry.name if entry.is_dir() else entry.stem for entry in found}

    def _select_folders(self) -> dict[Path, str]:
        """Return the video in each camera's folder, of the selected take, and the folder's name."""
        folders = find_camera_folders(self.path)
        if not folders:
            raise ValueError(describe_missing_sources(self.path))
        takes = list_folder_takes(folders)
        if not takes and all(len(files) == 1 for files in folders.values()):
            return {files[0]: name for name, files in folders.items()}
        if not takes:
            name, files = max(folders.items(), key=lambda item: len(item[1]))
            listed = ", ".join(file.name for file in files[:4])
            raise ValueError(
                f"{self.path}: {len(files)} videos in {name} ({listed}), with names that the other cameras' videos do not "
                "have: parts of one recording? Join those of each camera (ffmpeg -f concat), or keep one in each folder"
            )
        take = takes[0] if len(takes) == 1 and not self.take else self._check_take(takes)
        return {file: name for name, files in folders.items() for file in files if file.stem == take}

    def _select_take(self, names: dict[Path, str], cameras: Sequence[str]) -> dict[Path, str]:
        """Return the files of the selected take with the camera's part of their names, if there are several takes."""
        by_name = {name: entry for entry, name in names.items()}
        takes = split_takes(list(by_name), cameras)
        if len(takes) < 2 or any(name in cameras for name in by_name):
            return names
        return {by_name[name]: camera for camera, name in takes[self._check_take(list(takes))].items()}

    def _check_take(self, takes: Sequence[str]) -> str:
        if self.take not in takes:
            problem = f"no take {self.take!r}" if self.take else "several takes"
            raise ValueError(f"{self.path}: {problem} ({', '.join(takes)}); select one with --take NAME")
        return self.take

    def _resolve_given(self, cameras: Sequence[str]) -> dict[str, Path]:
        """Return the sources that are given by camera."""
        entries: dict[str, Path] = {}
        for name, file in self.source_by_camera.items():
            if name not in cameras:
                raise ValueError(f"cameras: {name!r} is not a camera of {self.calibration.name} ({', '.join(cameras)})")
            entry = self.path / file
            if not entry.exists():
                raise FileNotFoundError(f"{entry}: no such video or image folder, for camera {name}")
            if entry.is_dir() and not has_images(entry):
                raise ValueError(f"{entry}: no images in this folder, for camera {name}")
            for other, other_entry in entries.items():
                if resolve_path(other_entry) == resolve_path(entry):
                    raise ValueError(f"{entry}: assigned to both camera {other} and camera {name}")
            entries[name] = entry
        return entries


def find_recording_folders(files: Collection[PurePath], calibrated: bool) -> tuple[list[PurePath], list[PurePath]]:
    """Find the folders of recordings among files: those with videos or image folders, and a calibration.

    Args:
        files: paths below a folder.
        calibrated: whether a calibration is not required.

    Returns:
        The folders of recordings, outer ones only, and those that only lack a calibration; both sorted.
    """
    videos, images, stacks, calibrations = set(), set(), set(), set()
    for path in files:
        if (NON_CAMERA_NAMES | THUMBNAIL_NAMES) & {part.lower() for part in path.parts[:-1]}:
            continue
        # Videos of boards with the calibration that was made from them are no recording.
        is_for_calibration = any(part.lower().startswith(CALIBRATION_PREFIXES) for part in path.parts[:-1])
        if is_for_calibration and path.suffix.lower() in VIDEO_SUFFIXES | IMAGE_SUFFIXES:
            continue
        if path.suffix.lower() in VIDEO_SUFFIXES and path.stem not in NON_CAMERA_NAMES:
            videos.add(path.parent)
        elif path.suffix.lower() in IMAGE_SUFFIXES and len(path.parts) > 1:
            images.add(path.parent.parent)
            stacks |= {path.parent} if path.suffix.lower() in STACK_SUFFIXES else set()
        elif is_calibration_name(Path(path.name)):
            calibrations.add(path.parent)
    videos |= stacks & calibrations
    # An image folder next to recordings does not make their common parent a recording.
    outer = {parent for folder in videos | images for parent in folder.parents}
    candidates = {folder for folder in videos | images if folder in videos | calibrations or folder not in outer}
    taken = candidates if calibrated else candidates & calibrations
    found = [folder for folder in sorted(taken) if not taken & set(folder.parents)]
    recordings = set(found)
    return found, [folder for folder in sorted(candidates) if not {folder, *folder.parents} & recordings]


def open_video(path: Path) -> tuple[InputContainer, VideoStream]:
    """Open a video; the caller closes the container.

    Returns:
        The container and its video stream, of several that with the largest images.

    Raises:
        ValueError: the file is not a video, or its header is missing.
    """
    if not path.is_file():
        raise UnreadableFileError(f"{path}: a video is expected, not a folder, a pipe or a device")
    try:
        container = av.open(str(path.absolute()), options=DEMUXER_OPTIONS, **METADATA_OPTIONS)
    except av.error.FFmpegError as error:
        reason = describe_unusable_video(path) or error.strerror
        raise ValueError(f"{path}: cannot be opened as a video ({reason})") from None
    if not container.streams.video:
        container.close()
        raise ValueError(f"{path}: cannot be opened as a video (it contains no video stream: nothing was recorded)")
    # Files can have a preview besides; OpenCV takes the first stream.
    stream = max(list_video_streams(container), key=lambda its: its.width * its.height)
    # Cameras are decoded in parallel; additional threads per camera would each buffer frames.
    stream.codec_context.thread_count = 1
    return container, stream


def list_video_streams(container: InputContainer) -> list[VideoStream]:
    """Return the video streams of a file, without cover pictures unless there is nothing else."""
    streams = [its for its in container.streams.video if not its.disposition & Disposition.attached_pic]
    return streams or list(container.streams.video)


def find_entries(folder: Path, cameras: Sequence[str] = ()) -> list[Path]:
    """Return the videos, image folders and page stacks in a folder; names of cameras may be any."""
    return [entry for entry in sorted(folder.iterdir()) if _is_source(entry, cameras)]


def find_camera_folders(folder: Path) -> dict[str, list[Path]]:
    """Return the videos in each folder of a folder, of one camera each (DANNCE, OpenCap), by the folder's name."""
    found = dict[str, list[Path]]()
    for path in sorted(folder.iterdir()):
        if (
            path.is_dir()
            and not path.name.startswith(".")
            and path.name.lower() not in NON_CAMERA_NAMES | THUMBNAIL_NAMES
        ):
            files = [file for pattern in ("*", "InputMedia/*/*") for file in path.glob(pattern)]
            videos = sorted(file for file in files if file.suffix.lower() in VIDEO_SUFFIXES and file.is_file())
            if videos:
                found[path.name] = videos
    return found


def _is_source(entry: Path, cameras: Sequence[str]) -> bool:
    name = entry.name if entry.is_dir() else entry.stem
    is_other = name.lower() in NON_CAMERA_NAMES | THUMBNAIL_NAMES or name.lower().startswith(CALIBRATION_PREFIXES)
    if entry.name.startswith(".") or (is_other and name not in cameras):
        return False
    if entry.is_dir():
        # A folder with a trajectory or a picture of the rig is the output of an earlier run.
        output = any(entry.glob("trajectory.*")) or (entry / "rig.png").exists()
        return not output and has_images(entry)
    return entry.suffix.lower() in VIDEO_SUFFIXES or is_page_stack(entry)


def list_folder_takes(folders: Mapping[str, Sequence[Path]]) -> list[str]:
    """Return the takes of which each camera's folder has a video: the names common to all folders."""
    names = [dict.fromkeys(file.stem for file in files) for files in folders.values()]
    return [name for name in names[0] if all(name in others for others in names)]


def describe_missing_sources(folder: Path) -> str:
    """Return the message on a folder without videos and images."""
    unusable = describe_unusable_files(folder)
    message = f"{folder}: no videos and no folders of images, one per camera, in this folder"
    return f"{message}. {unusable}" if unusable else message


def _probe(path: Path, camera: Camera, warnings: list[str], as_coded: bool = False) -> Source:
    """Return the source in a video or image folder, after checking its size."""
    size, orientation = _read_format(path)
    applied = _fit_orientation(path, camera, size, orientation, warnings)
    is_ambiguous = applied > 1 and size == camera.size
    applied = 1 if is_ambiguous and as_coded else applied
    if path.is_dir():
        files = image_files(path)
        read_image(files[0], camera.size, applied)
        source = Source(camera.name, path, "images", camera.size, len(files), None, tuple(files), image_numbers(files))
    elif path.suffix.lower() in STACK_SUFFIXES:
        with PageStack(path) as stack:
            stack.read(0)
            source = Source(camera.name, path, "pages", camera.size, stack.n_pages)
    else:
        container, stream = open_video(path)
        with container:
            n_streams = len(list_video_streams(container))
            if n_streams > 1:
                used = f"that of {stream.width}x{stream.height}"
                warnings.append(f"{camera.name}: {path.name} has {n_streams} video streams; {used} is used.")
            shown = read_presentation(path, container, stream, warnings)
        times = shown.pts, shown.time_base
        source = Source(camera.name, path, "video", camera.size, shown.n_frames, shown.rate, (), None, *times)
    return replace(source, orientation=applied, is_orientation_ambiguous=is_ambiguous)


def _read_format(path: Path) -> tuple[tuple[int, int], int]:
    """Return (width, height), as coded, and the EXIF orientation of a video, a stack or the first image of a folder."""
    if path.is_dir():
        first = image_files(path)[0]
        return read_image_size(first), read_orientation(first)
    if path.suffix.lower() in STACK_SUFFIXES:
        with PageStack(path) as stack:
            return stack.size, 1
    container, stream = open_video(path)
    with container:
        size, rotation = (stream.width, stream.height), 0
        with suppress(av.error.FFmpegError):  # reported when it is read
            rotation = next((frame.rotation for frame in container.decode(stream)), 0)
    quarter_turns = round(rotation / 90)
    return size, EXIF_ORIENTATIONS[quarter_turns % 4] if rotation == 90 * quarter_turns else 1


def _fit_orientation(path: Path, camera: Camera, size: tuple[int, int], orientation: int, warnings: list[str]) -> int:
    """Return the orientation to be applied so that images of a size, as coded, fit the calibration.

    OpenCV and FFmpeg apply the rotation of a file, and so does every program for calibration that is based on them.

    Raises:
        ValueError: the calibration has another size.
    """
    turned = size[::-1] if orientation >= 5 else size
    if turned == camera.size:
        return orientation
    if size == camera.size:
        text = f"{path.name} has a rotation that is not applied: the calibration has the size of the frames as coded"
        warnings.append(f"{camera.name}: {text}.")
        return 1
    if display := _describe_display_size(path, camera.size):
        raise ValueError(f"{path}: images of {size[0]}x{size[1]}, but camera {camera.name} {display}")
    as_turned = "" if turned == size else f" ({turned[0]}x{turned[1]} with the file's rotation)"
    raise ValueError(
        f"{path}: images of {size[0]}x{size[1]}{as_turned}, but camera {camera.name} "
        f"is calibrated at {camera.size[0]}x{camera.size[1]}: {describe_size_mismatch(turned, camera.size)}"
    )


def _describe_display_size(path: Path, calibrated: tuple[int, int]) -> str:
    """Describe a calibration at the size in which players show a video whose pixels are not square; "" for others."""
    if path.is_dir() or path.suffix.lower() in STACK_SUFFIXES:
        return ""
    container, stream = open_video(path)
    with container:
        aspect = stream.sample_aspect_ratio
        ratio = float(aspect or 1)
        width, height = stream.width, stream.height
    shown = [(width * ratio, height), (width, height / ratio)]
    if ratio == 1 or not any(max(abs(w - calibrated[0]), abs(h - calibrated[1])) <= 2 for w, h in shown):
        return ""
    return (
        f"is calibrated at {calibrated[0]}x{calibrated[1]}, the size in which players show them: their pixels are not "
        f"square ({aspect}); calibrate with the frames as stored, as OpenCV reads them"
    )


def open_source(path: Path, camera: Camera) -> Source:
    """Open one camera's recording: a video, an image folder or a page stack.

    Raises:
        FileNotFoundError: the path does not exist.
        ValueError: it is neither, or its image size differs from the camera's.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.is_dir() and not has_images(path):
        raise ValueError(f"{path}: no images in this folder")
    return _probe(path, camera, [])
