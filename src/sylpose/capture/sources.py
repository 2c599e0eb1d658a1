"""What a session folder holds: one video or one folder of images per camera."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import av
import av.error
from av.container import InputContainer
from av.video.stream import VideoStream

from sylpose.capture.images import image_size, read_image
from sylpose.capture.names import image_files, image_numbers, match_names, several_of
from sylpose.input_limits import Unreadable, resolved
from sylpose.rig import Camera, Rig

__all__ = ["NO_CAMERAS", "VIDEO_SUFFIXES", "Source", "find_sources", "open_video", "sizes_in", "source_of"]

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".wmv", ".flv", ".ogv"}
)
# FFmpeg tells a format by its content: a file may be a list of others, and of URLs, whatever its name. Only containers
# with pictures in them are opened, and of them nothing but the file itself.
ONLY_VIDEOS = {
    "protocol_whitelist": "file",
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,mpeg,mpegvideo,mpegts,asf,flv,live_flv,ogg",
}
# A title that is no UTF-8 is no reason to refuse a video. PyAV takes any from version 19 on, and has to be told before.
ANY_TITLE: dict[str, Any] = {} if int(av.__version__.partition(".")[0]) >= 19 else {"metadata_errors": "replace"}
# What sylpose writes, or reads as something else than a camera.
NO_CAMERAS = frozenset({"sylpose", "masks", "overlay"})


@dataclass(frozen=True)
class Source:
    """The images of one camera.

    Attributes:
        camera: the camera's name in the calibration.
        path: the video or the folder.
        kind: "video" or "images".
        size: (width, height) in pixels, as coded: rotation metadata of videos and photographs is not applied.
        n_frames: number of frames, as the video declares it; counted where it declares none.
        rate: frames per second on average; None for images, and for videos that do not say.
        files: the images in order; empty for videos.
        numbers: the numbers in the images' names; None for videos and when the names have no usable numbers.
    """

    camera: str
    path: Path
    kind: Literal["video", "images"]
    size: tuple[int, int]
    n_frames: int
    rate: float | None = None
    files: tuple[Path, ...] = field(default=(), repr=False)
    numbers: tuple[int, ...] | None = field(default=None, repr=False)

    def frame_number(self, k: int) -> int:
        """The number that names the k-th frame: the one in its image's name, k itself without one."""
        return k if self.numbers is None else self.numbers[k]


def find_sources(
    path: Path,
    rig: Rig,
    calibration: Path,
    not_cameras: Iterable[Path] = (),
    named: Mapping[str, Path | str] | None = None,
    without: Sequence[str] = (),
) -> tuple[tuple[Source, ...], list[str]]:
    """The sources of a session's folder in the rig's order, and what looks wrong with them.

    Args:
        not_cameras: folders that are something else, such as masks.
        named: video or folder of images by camera, where the names do not tell; the others are looked for.
        without: cameras besides the rig's, which may have a video or not.

    Raises:
        FileNotFoundError: one that is named is not there.
        ValueError: cameras without source and sources without camera (all named), a video that cannot be read,
            an image size that differs from the calibration's.
    """
    by_camera = _entries(path, rig.names, calibration, not_cameras, named, without)
    warnings: list[str] = []
    sources = []
    for camera in rig:
        entry = by_camera[camera.name]
        sources.append(_probe_images(entry, camera) if entry.is_dir() else _probe_video(entry, camera, warnings))
    return tuple(sources), warnings


def sizes_in(
    path: Path,
    cameras: Sequence[str],
    calibration: Path,
    not_cameras: Iterable[Path] = (),
    named: Mapping[str, Path | str] | None = None,
    without: Sequence[str] = (),
) -> dict[str, tuple[int, int]]:
    """How large the images of cameras are, of which the calibration does not say it.

    Raises:
        FileNotFoundError, ValueError: as `find_sources`.
    """
    sizes = {}
    kept = [name for name in cameras if name not in without]
    for name, entry in _entries(path, kept, calibration, not_cameras, named, without).items():
        if entry.is_dir():
            sizes[name] = image_size(image_files(entry)[0])
            continue
        container, stream = open_video(entry)
        with container:
            sizes[name] = (stream.width, stream.height)
    return sizes


def _entries(
    path: Path,
    cameras: Sequence[str],
    calibration: Path,
    not_cameras: Iterable[Path],
    named: Mapping[str, Path | str] | None,
    without: Sequence[str],
) -> dict[str, Path]:
    """The video or folder of images of each camera; those of the ones left out are not taken for another's."""
    by_camera = _named(path, cameras, calibration, named or {})
    left = [name for name in cameras if name not in by_camera]
    others = {resolved(folder) for folder in (*not_cameras, *by_camera.values())}
    known = (*cameras, *without)
    found = [entry for entry in sorted(path.iterdir()) if _is_source(entry, known) and resolved(entry) not in others]
    if not found and left:
        raise ValueError(f"{path}: no videos and no folders of images, one per camera, in this folder")
    names = {entry: entry.name if entry.is_dir() else entry.stem for entry in found}
    try:
        matched = match_names(dict.fromkeys(names.values()), [*left, *without])
    except ValueError as error:
        raise ValueError(f"{path}: {error}; --video NAME=FILE says it") from None
    for entry in found:
        name = matched.get(names[entry])
        if name in by_camera:
            raise ValueError(f"{path}: {by_camera[name].name} and {entry.name} are both for camera {name}")
        if name is not None:
            by_camera[name] = entry
    for name in without:
        by_camera.pop(name, None)
    missing = [name for name in cameras if name not in by_camera]
    # Where some were named, others may lie beside them.
    extra = [entry.name for entry in found if names[entry] not in matched] if not named else []
    if missing and (first := several_of(list(names.values()), left)):
        several = ", ".join(entry.name for entry in found if names[entry] in first)
        raise ValueError(
            f"{path}: several recordings in one folder ({several} are all of camera {left[0]}); --video NAME=FILE, for "
            "each camera, takes one of them"
        )
    if missing or extra:
        wrong = []
        if missing:
            wrong.append(f"no video or image folder for camera {', '.join(missing)} of {calibration.name}")
        if extra:
            wrong.append(f"no camera in {calibration.name} ({', '.join(cameras)}) for {', '.join(extra)}")
        leave = f", --exclude-camera {missing[0]} leaves a camera out" if 0 < len(missing) < len(cameras) else ""
        listed = "" if len(extra) == len(found) else f"; found {', '.join(entry.name for entry in found)}"
        raise ValueError(f"{path}: {'; '.join(wrong)}{listed}; --video NAME=FILE says which is which{leave}")
    return by_camera


def _named(path: Path, cameras: Sequence[str], calibration: Path, named: Mapping[str, Path | str]) -> dict[str, Path]:
    entries: dict[str, Path] = {}
    for name, file in named.items():
        if name not in cameras:
            raise ValueError(f"cameras: {name!r} is no camera of {calibration.name} ({', '.join(cameras)})")
        entry = path / file
        if not entry.exists():
            raise FileNotFoundError(f"{entry}: no such video or folder of images, for camera {name}")
        if entry.is_dir() and not image_files(entry):
            raise ValueError(f"{entry}: no images in this folder, for camera {name}")
        same = [other for other, its in entries.items() if resolved(its) == resolved(entry)]
        if same:
            raise ValueError(f"{entry}: named for camera {same[0]} and for camera {name}")
        entries[name] = entry
    return entries


def open_video(path: Path) -> tuple[InputContainer, VideoStream]:
    """Open a video; the caller closes the container.

    Raises:
        ValueError: naming a file that is no video, or has lost the part that says what it is.
    """
    if not path.is_file():
        raise Unreadable(f"{path}: a video is expected, not a folder, a pipe or a device")
    try:
        container = av.open(str(path.absolute()), options=ONLY_VIDEOS, **ANY_TITLE)
    except av.error.FFmpegError as error:
        raise ValueError(f"{path}: cannot be opened as a video ({error.strerror})") from None
    if not container.streams.video:
        container.close()
        raise ValueError(f"{path}: cannot be opened as a video (there is no video stream in it)")
    stream = container.streams.video[0]
    # The cameras are decoded in parallel to each other; more threads per camera would each hold frames of their own.
    stream.codec_context.thread_count = 1
    return container, stream


def _is_source(entry: Path, cameras: Sequence[str]) -> bool:
    name = entry.name if entry.is_dir() else entry.stem
    if entry.name.startswith(".") or (name.lower() in NO_CAMERAS and name not in cameras):
        return False
    if entry.is_dir():
        # A folder with a trajectory, or the picture of the rig, is the output of an earlier run.
        output = any(entry.glob("trajectory.*")) or (entry / "rig.png").exists()
        return not output and bool(image_files(entry))
    return entry.suffix.lower() in VIDEO_SUFFIXES


def _check_size(path: Path, camera: Camera, size: tuple[int, int]) -> None:
    if size != camera.size:
        raise ValueError(
            f"{path}: images of {size[0]}x{size[1]}, but camera {camera.name} "
            f"is calibrated at {camera.size[0]}x{camera.size[1]}"
        )


def _probe_images(folder: Path, camera: Camera) -> Source:
    files = image_files(folder)
    _check_size(files[0], camera, image_size(files[0]))
    read_image(files[0], camera.size)
    return Source(camera.name, folder, "images", camera.size, len(files), None, tuple(files), image_numbers(files))


def _probe_video(path: Path, camera: Camera, warnings: list[str]) -> Source:
    container, stream = open_video(path)
    with container:
        size = (stream.width, stream.height)
        _check_size(path, camera, size)
        rate = stream.average_rate or stream.guessed_rate
        rate_s = float(rate) if rate else None
        n_frames = _declared_frames(path, stream)
    return Source(camera.name, path, "video", size, n_frames or _count_frames(path, rate_s, warnings), rate_s)


def _declared_frames(path: Path, stream: VideoStream) -> int:
    """Frames that the container declares, less those that its edit list hides (a cut made without encoding anew)."""
    entries = stream.index_entries
    hidden = sum(entry.is_discard for entry in entries) if len(entries) == stream.frames else 0
    # As many frames as bytes: a lie, of a header that is damaged or worse; they are counted.
    return stream.frames - hidden if stream.frames < path.stat().st_size else 0


def _count_frames(path: Path, rate: float | None, warnings: list[str]) -> int:
    """Frames in a container that does not declare their number (Matroska, WebM, MPEG-TS, fragmented MP4)."""
    n_frames, end = 0, 0.0
    container, stream = open_video(path)
    with container:
        declared = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
        if not declared and len(container.streams) == 1 and container.duration:
            declared = container.duration / av.time_base
        try:
            for packet in container.demux(stream):
                if packet.size and not packet.is_discard:
                    n_frames += 1
                    if packet.pts is not None:
                        end = max(end, float((packet.pts + (packet.duration or 0)) * packet.time_base))
        except av.error.FFmpegError as error:
            warnings.append(f"{path.name} breaks off after {n_frames} frames ({error.strerror}).")
            return n_frames
    if end < declared - max(0.1, 2.5 / (rate or 25.0)):
        warnings.append(
            f"{path.name} breaks off: {n_frames} frames, {end:.2f} s of the {declared:.2f} s that it declares."
        )
    return n_frames


def source_of(path: Path, camera: Camera) -> Source:
    """One camera's recording: a video, or a folder of images.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it is neither, or of another size than the camera's.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if not path.is_dir():
        return _probe_video(path, camera, [])
    if not image_files(path):
        raise ValueError(f"{path}: no images in this folder")
    return _probe_images(path, camera)
