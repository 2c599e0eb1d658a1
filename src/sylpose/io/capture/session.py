"""Recorded sessions: opening a recording and reading its frame sets."""

from __future__ import annotations

import sys
import warnings as python_warnings
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import BoolArray, Image
from sylpose.geometry.validation import check_integer, check_list
from sylpose.input_limits import input_errors
from sylpose.io import calibration as calibrations
from sylpose.io.calibration.lenses import Fov, LensFile, guess_lenses, load_lenses
from sylpose.io.calibration.world import World, transform_rig
from sylpose.io.capture.boxes import Masks, check_first_masks, find_masks, load_boxes, merge_object_names
from sylpose.io.capture.frame_readers import CameraReader, FrameReading, check_readable
from sylpose.io.capture.layouts import Layout, find_layouts
from sylpose.io.capture.repetitions import RepetitionFilter
from sylpose.io.capture.sources import RecordingFolder, Source
from sylpose.io.capture.time_tables import find_time_table
from sylpose.io.capture.timeline import Timeline, build_timeline
from sylpose.rig import Rig

# Decoded images that a reversed recording holds at once, bytes (choice: seconds of video on usual machines).
MAX_CHUNK_BYTES = 400_000_000
# Field of view of cameras that are not calibrated, degrees (choice: the focal length is the image's width).
WIDE_FOV = 53.13


@dataclass(frozen=True, eq=False)
class SessionBase:
    """Common base of recordings and live sessions: a rig and one or more objects.

    Attributes:
        path: the session folder.
        rig: the calibrated cameras.
        calibration: the file that the rig was read from.
        objects: the object names; "object" for an unnamed one. Boxes exist for all objects or for none; so do masks.
        masks: the folder of masks, or None.
        warnings: messages about suspicious but usable input.
        world: user-defined world frame in which the rig is expressed; None for the calibration's.
        without: excluded cameras of the calibration; the rig contains only the others.
    """

    path: Path
    rig: Rig
    calibration: Path
    objects: tuple[str, ...]
    masks: Path | None
    warnings: tuple[str, ...]
    _boxes: dict[str, dict[str, Box]] = field(repr=False)
    _masks: dict[str, tuple[Masks, ...]] = field(repr=False)
    world: World | None = field(default=None, kw_only=True)
    without: tuple[str, ...] = field(default=(), kw_only=True)

    @property
    def boxes(self) -> dict[str, Box]:
        """The object's box in the first frame set, by camera; cameras without a box are missing.

        Raises:
            ValueError: the session has several objects; see `select_object`.
        """
        if len(self.objects) > 1:
            raise ValueError(f"{self.path}: several objects ({', '.join(self.objects)}): select one object first")
        return self._boxes.get(self.objects[0], {})

    def select_object(self, name: str) -> Self:
        """Return the session restricted to the boxes and masks of one object.

        Raises:
            ValueError: no such object.
        """
        if name not in self.objects:
            raise ValueError(f"{self.path}: no object {name!r} in the session ({', '.join(self.objects)})")
        boxes = {name: self._boxes[name]} if name in self._boxes else {}
        masks = {name: self._masks[name]} if name in self._masks else {}
        return replace(self, objects=(name,), _boxes=boxes, _masks=masks)

    def with_boxes(self, boxes: Mapping[str, Mapping[str, Box]]) -> Self:
        """Return the session with boxes of its objects in the frame at which it starts."""
        return replace(self, _boxes={name: dict(by_camera) for name, by_camera in boxes.items()})

    def with_rig(self, rig: Rig) -> Self:
        """Return the session with a modified rig: another unit or world frame, or refined parameters.

        Raises:
            ValueError: the cameras, their order or their sizes differ.
        """
        if [(c.name, c.size) for c in rig] != [(c.name, c.size) for c in self.rig]:
            raise ValueError(
                f"rig: the cameras {', '.join(self.rig.names)} of {self.path} and their sizes are expected"
            )
        return replace(self, rig=rig)

    def with_world(self, world: World) -> Self:
        """Return the session with its rig expressed in a user-defined world frame.

        Args:
            world: the world frame, located in the calibration's.

        Raises:
            ValueError: a world frame is already set, or as `calibration.world.transform_rig`.
        """
        if self.world is not None:
            raise ValueError(f"world: {self.path} is already expressed in {self.world.description or 'another one'}")
        return replace(self.with_rig(transform_rig(self.rig, world)), world=world)


@dataclass(frozen=True, eq=False)
class Session(SessionBase):
    """A recording: one video or image folder per camera.

    Attributes:
        sources: one per camera, in the rig's order.
        timeline: frame of each camera and time of each frame set.
        as_coded: whether frames are not turned as their files specify where the calibration fits both.
        take: the take that was selected of several in one folder; "" else.
    """

    sources: tuple[Source, ...]
    timeline: Timeline
    as_coded: bool = field(default=False, kw_only=True)
    take: str = field(default="", kw_only=True)

    @property
    def has_ambiguous_orientation(self) -> bool:
        """Whether the calibration fits frames as coded and as turned."""
        return any(source.is_orientation_ambiguous for source in self.sources)

    def without_static_masks(self) -> tuple[Self, tuple[str, ...]]:
        """Return the session without masks for all frames, and the names of the cameras that had one."""
        has_static = [any(m[c].static is not None for m in self._masks.values()) for c in range(len(self.rig))]
        masks = {
            name: tuple(Masks() if has else m for m, has in zip(its, has_static, strict=True))
            for name, its in self._masks.items()
        }
        names = tuple(name for name, has in zip(self.rig.names, has_static, strict=True) if has)
        return replace(self, _masks=masks), names

    def select_cameras(self, names: Sequence[str]) -> Self:
        """Return the session restricted to some of its cameras; numbers and times of the frame sets remain.

        Raises:
            ValueError: no names, or one that is no camera of the session.
        """
        names = check_list(names, str, "names")
        if not names or not {*names} <= {*self.rig.names}:
            raise ValueError(f"names: some of the cameras {', '.join(self.rig.names)} are expected, got {names}")
        kept = [c for c, name in enumerate(self.rig.names) if name in names]
        boxes = {
            name: {camera: box for camera, box in by_camera.items() if camera in names}
            for name, by_camera in self._boxes.items()
        }
        timeline = replace(self.timeline, frames=self.timeline.frames[:, kept], stamps=self.timeline.stamps[:, kept])
        return replace(
            self,
            rig=self.rig.subset([self.rig.names[c] for c in kept]),
            sources=tuple(self.sources[c] for c in kept),
            timeline=timeline,
            without=(*self.without, *(name for name in self.rig.names if name not in names)),
            _boxes=boxes,
            _masks={name: tuple(masks[c] for c in kept) for name, masks in self._masks.items()},
        )

    @property
    def n_frames(self) -> int:
        """Number of frame sets, from 0 to the last in which any camera has a frame."""
        return len(self.timeline.times)

    @property
    def rate(self) -> float | None:
        """Frame sets per second, or None for images without timestamps."""
        return self.timeline.rate

    def frames(
        self,
        start: int = 0,
        stop: int | None = None,
        every: int = 1,
        on_problem: Callable[[str], None] | None = None,
    ) -> Generator[FrameSet, None, None]:
        """Yield the frame sets start, start + every, ... below stop.

        One frame set is read ahead, with one thread per camera; nothing else is kept in memory. The image of a camera
        without a frame is None. Truncated files are read as far as possible; iteration ends after the last frame of the
        last camera.

        Args:
            start: number of the first frame set.
            stop: number after the last; None, or more than `n_frames`, for all.
            every: step between frame sets.
            on_problem: called with one message per truncated file and per unreadable frame, before the frame set is
                yielded, in the caller's thread; None for `warnings.warn`.

        Raises:
            ValueError: a start outside the session, stop <= start, every < 1; at the call, not at the first frame.
            OSError, ValueError: while iterating, a video can no longer be opened.
        """
        if not 0 <= start < self.n_frames:
            raise ValueError(f"start must be in 0 ... {self.n_frames - 1} (the session's frames), got {start}")
        indices = check_frame_range(start, stop, every)
        return self._read(range(start, min(indices.stop, self.n_frames), every), every, on_problem or issue_warning)

    def frames_at(
        self, indices: Sequence[int], every: int = 1, on_problem: Callable[[str], None] | None = None
    ) -> Generator[FrameSet, None, None]:
        """Yield the frame sets of some numbers, as `frames` does with this step; the others are skipped.

        Args:
            indices: numbers of the frame sets, increasing.
            every: step of a frame set from the one before it, which shows which pictures are repeated.
            on_problem: as for `frames`.

        Raises:
            ValueError: numbers that are no integers, do not increase or are outside the session, every < 1.
            OSError, ValueError: while iterating, a video can no longer be opened.
        """
        check_frame_range(0, None, every)
        numbers = [check_integer(i, "indices", maximum=self.n_frames - 1) for i in indices]
        if any(a >= b for a, b in pairwise(numbers)):
            raise ValueError(f"indices must increase, got {numbers}")
        return self._read(numbers, every, on_problem or issue_warning)

    def _read(
        self, indices: Sequence[int], every: int, on_problem: Callable[[str], None]
    ) -> Generator[FrameSet, None, None]:
        if not indices:
            return
        with ExitStack() as stack:
            readers = [
                stack.enter_context(closing(CameraReader(source, {name: m[c] for name, m in self._masks.items()})))
                for c, source in enumerate(self.sources)
            ]
            pool = stack.enter_context(ThreadPoolExecutor(len(readers), thread_name_prefix="sylpose-capture"))

            def submit(i: int) -> list[Future[FrameReading]]:
                row = self.timeline.frames[i].tolist()
                return [pool.submit(reader.read, k) for reader, k in zip(readers, row, strict=True)]

            last = [max(np.flatnonzero(column >= 0).tolist(), default=-1) for column in self.timeline.frames.T]
            # The frame set before one shows which of its pictures are repeated.
            yielded, repetitions = {*indices}, RepetitionFilter(self.rig.names)
            read = sorted({*indices, *(i - every for i in indices if i >= every)})
            pending = submit(read[0])
            for i, next_index in zip_longest(read, read[1:]):
                readings = [future.result() for future in pending]
                pending = [] if next_index is None else submit(next_index)
                for reading in readings:
                    for problem in reading.problems:
                        on_problem(problem)
                if all(reading.ended or end < i for reading, end in zip(readings, last, strict=True)):
                    return
                images, repeated = repetitions.remove(i, [reading.image for reading in readings])
                if i not in yielded:
                    continue
                for problem in repeated:
                    on_problem(problem)
                yield self._frame_set(i, readings, images)

    def _frame_set(self, i: int, readings: list[FrameReading], images: list[Image | None]) -> FrameSet:
        times = (None if np.isnan(stamp) else float(stamp) for stamp in self.timeline.stamps[i])
        masks = {
            name: tuple(None if image is None else its.masks[name] for its, image in zip(readings, images, strict=True))
            for name in self._masks
        }
        no_masks = (None,) * len(readings)
        return add_masks(FrameSet(i, float(self.timeline.times[i]), tuple(times), tuple(images), no_masks), masks)


def open_session(
    path: Path | str,
    *,
    calibration: Path | None = None,
    boxes: Path | None = None,
    masks: Path | None = None,
    offsets: Mapping[str, int] | None = None,
    cameras: Mapping[str, Path | str] | None = None,
    rate: float | None = None,
    without: Sequence[str] = (),
    as_coded: bool = False,
    take: str = "",
    lenses: Sequence[LensFile] = (),
    fov: Fov | None = None,
) -> Session:
    """Open a recording: a folder with one video (`cam_0.mp4`) or one image folder (`cam_0/`) per camera.

    Folders of other programs are opened as they are: projects and recordings of Pose2Sim, Anipose, FreeMoCap, Caliscope,
    DANNCE, DeepLabCut, Multical, EasyMocap and OpenCap (`layouts.find_layouts`).

    File names are matched to the calibration's cameras, tolerantly if that is unambiguous (`0.avi` is `cam_0`). Frames
    are turned as their files specify (display matrix, EXIF), as OpenCV does, if the calibration has the size of the turned
    image; else their size must equal the calibration's. The folder may also contain the calibration, boxes.toml, masks/
    and timestamps.csv, which are found automatically.

    Args:
        path: the session folder.
        calibration: the calibration file, if it is not the only one in the folder.
        boxes: the file of boxes, instead of boxes.toml in the folder.
        masks: the folder of masks, instead of masks/ in the folder.
        offsets: frame offset by camera; frame k is in frame set k + offset, so a camera that starts late has offset >
            0.
        cameras: video or image folder by camera (relative to `path`), if the names do not identify them.
        rate: frame rate of image folders without timestamps, frames per second.
        without: cameras of the calibration to exclude, whether they have images or not.
        as_coded: whether frames are not turned where the calibration fits them as coded too.
        take: the take to open, of a folder with several.
        lenses: files of the lenses, each with the name of its camera or None, in place of a calibration; all poses are
            then the identity (`load_lenses`).
        fov: horizontal field of view of all cameras, degrees, in place of a calibration, or "exif" for that of the images;
            as for `lenses`.

    Returns:
        The session; its `warnings` list suspicious input.

    Raises:
        FileNotFoundError: no such folder or file.
        ValueError: the message names the file or camera and the expected content.
    """
    if lenses or fov is not None:
        calibration = lenses[0][1] if lenses else Path(path)
    files = _InputFiles(
        calibration, boxes, masks, offsets or {}, cameras or {}, rate, without, as_coded, take, lenses, fov
    )
    return _open_session(Path(path), files)


def reopen_session(
    path: Path,
    calibration: Path,
    offsets: Mapping[str, int],
    cameras: Mapping[str, Path | str],
    rate: float | None,
    without: Sequence[str],
    as_coded: bool,
) -> Session:
    """Open the images of a recording by the calibration of an earlier run, which lacks the excluded cameras.

    Raises:
        FileNotFoundError, ValueError: as `open_session`.
    """
    files = _InputFiles(calibration, None, None, offsets, cameras, rate, without, as_coded, "")
    return _open_session(path, files, search=not without)


def open_uncalibrated(
    path: Path | str,
    *,
    cameras: Mapping[str, Path | str] | None = None,
    offsets: Mapping[str, int] | None = None,
    rate: float | None = None,
    without: Sequence[str] = (),
    take: str = "",
) -> Session:
    """Open a recording whose cameras are not calibrated; a calibration in the folder is ignored.

    Args:
        path: folder with one video or image folder per camera, named like the camera.
        cameras: video or image folder by camera (relative to `path`), instead of all in the folder.
        offsets, rate, without, take: as of `open_session`.

    Returns:
        The session. Its rig has names and image sizes only: focal lengths are image widths, and all poses are equal.

    Raises:
        FileNotFoundError, ValueError: as `open_session`.
    """
    given = _InputFiles(Path(path), None, None, offsets or {}, cameras or {}, rate, without, False, take, (), WIDE_FOV)
    return _open_session(Path(path), given, search=False)


class _InputFiles(NamedTuple):
    """Arguments of `open_session`."""

    calibration: Path | None
    boxes: Path | None
    masks: Path | None
    offsets: Mapping[str, int]
    cameras: Mapping[str, Path | str]
    rate: float | None
    without: Sequence[str]
    as_coded: bool
    take: str
    lenses: Sequence[LensFile] = ()
    fov: Fov | None = None

    @property
    def has_lenses(self) -> bool:
        """Whether there are lenses in place of a calibration."""
        return bool(self.lenses) or self.fov is not None


def _open_session(path: Path, given: _InputFiles, search: bool = True) -> Session:
    """Open a session; without `search`, as of earlier: excluded cameras are not in the calibration, and no boxes used."""
    with input_errors(path):
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such folder")
        if not path.is_dir():
            raise ValueError(f"{path}: a folder with one video or image folder per camera is expected, not a file")
        layout = _find_layout(path, given)
        path, calibration = layout.path, layout.calibration
        boxes, masks = find_boxes_and_masks(path, given.boxes, given.masks, search)
        others = [masks] if masks else []
        take = "" if layout.take else given.take
        recording = RecordingFolder(
            layout.sources, calibration, others, given.cameras, given.without, given.as_coded, take
        )
        if given.has_lenses:
            rig = _load_lenses(recording, given)
        else:
            rig = calibrations.load(calibration, recording.read_image_sizes)
            rig = rig.subset(_keep_cameras(rig.names, given.without, calibration.name)) if search else rig
        sources, warnings = recording.find_sources(rig)
        for source in sources:
            check_readable(source)
        places = dict.fromkeys((path, layout.sources))
        tables = (find_time_table(place, rig.names, given.without) for place in places)
        table = next((table for table in tables if table is not None), None)
        timeline, timeline_warnings = build_timeline(sources, table, given.offsets, given.rate)
        by_object, mask_warnings = (
            ({}, []) if masks is None else find_masks(masks, [*rig.names, *given.without], sources)
        )
        for camera_masks in by_object.values():
            check_first_masks(camera_masks, sources, timeline.frames)
        object_boxes = {} if boxes is None else load_boxes(boxes, rig, given.without)
        return Session(
            path=path,
            rig=rig,
            calibration=calibration,
            sources=sources,
            objects=merge_object_names(object_boxes, by_object, boxes, masks),
            masks=masks,
            timeline=timeline,
            warnings=(*warnings, *timeline_warnings, *mask_warnings),
            without=tuple(given.without),
            as_coded=given.as_coded,
            take=take,
            _boxes=object_boxes,
            _masks=by_object,
        )


def use_frames_as_coded(session: Session) -> Session:
    """Return a session without the turns that files specify where the calibration fits both."""
    sources = (replace(its, orientation=1) if its.is_orientation_ambiguous else its for its in session.sources)
    return replace(session, sources=tuple(sources), as_coded=True)


def _find_layout(path: Path, given: _InputFiles) -> Layout:
    """Find the recording in a folder, of several takes the selected one."""
    calibration = None if given.calibration is None else Path(given.calibration)
    if given.cameras:  # relative to the folder
        return Layout(path, path, calibration or calibrations.find(path))
    layouts = find_layouts(path, calibration, given.has_lenses)
    if len(layouts) == 1 and given.take in ("", layouts[0].take):
        return layouts[0]
    names = [layout.take for layout in layouts]
    if len(layouts) > 1 and given.take not in names:
        problem = f"no take {given.take!r}" if given.take else "several takes"
        raise ValueError(f"{path}: {problem} ({', '.join(names)}); select one with --take NAME")
    return layouts[names.index(given.take)] if given.take in names else layouts[0]


def find_boxes_and_masks(
    path: Path, boxes: Path | None, masks: Path | None, search: bool = True
) -> tuple[Path | None, Path | None]:
    """Return the given file of boxes and folder of masks, or boxes.toml and masks/ in the folder, if they exist."""
    if boxes is None and search and (path / "boxes.toml").is_file():
        boxes = path / "boxes.toml"
    if masks is None and search and (path / "masks").is_dir():
        masks = path / "masks"
    return boxes and Path(boxes), masks and Path(masks)


def _load_lenses(recording: RecordingFolder, given: _InputFiles) -> Rig:
    """Load the lenses of the cameras that are not excluded; these have the names of their sources, or of the lenses.

    Raises:
        ValueError: as `load_lenses`, `guess_lenses` and `_keep_cameras`.
    """
    found, sizes = recording.list_cameras(), recording.read_image_sizes
    names = _keep_cameras(found, [name for name in given.without if name in found], recording.path)
    if given.fov is None:
        rig = load_lenses(given.lenses, names, sizes)
    else:
        rig = guess_lenses(given.fov, names, sizes, recording.read_focal_lengths)
    kept = _keep_cameras(dict.fromkeys([*found, *rig.names]), given.without, recording.path)
    return rig.subset([name for name in rig.names if name in kept])


def _keep_cameras(names: Collection[str], without: Sequence[str], where: Path | str) -> list[str]:
    """Return the names that are not excluded.

    Raises:
        ValueError: an unknown camera, or no camera remains.
    """
    without = check_list(without, str, "without")
    if unknown := [name for name in without if name not in names]:
        raise ValueError(f"without: {unknown[0]!r} is not a camera of {where} ({', '.join(names)})")
    kept = [name for name in names if name not in without]
    if not kept:
        raise ValueError(f"without: no camera of {where} remains")
    return kept


@dataclass(frozen=True, eq=False)
class ReversedSession(Session):
    """A recording whose frame sets come in reverse order; its times increase all the same.

    Videos are decoded forwards in chunks, from the last one to the first.

    Attributes:
        forward: the recording.
    """

    forward: Session = field(kw_only=True)

    @classmethod
    def from_session(cls, session: Session) -> Self:
        """Return a recording in reverse order; boxes are dropped, since they are those of its first frame."""
        old = session.timeline
        stamps, times = old.times[0] + old.times[-1] - old.stamps[::-1], old.times[0] + old.times[-1] - old.times[::-1]
        timeline = replace(old, frames=old.frames[::-1], times=times, stamps=stamps)
        values = {item.name: getattr(session, item.name) for item in fields(session)}
        return cls(**(values | {"timeline": timeline, "_boxes": {}, "forward": session}))

    def _read(
        self, indices: Sequence[int], every: int, on_problem: Callable[[str], None]
    ) -> Generator[FrameSet, None, None]:
        last = self.n_frames - 1
        size = sum(3 * camera.size[0] * camera.size[1] for camera in self.rig)
        length = max(1, MAX_CHUNK_BYTES // size)
        for begin in range(0, len(indices), length):
            chunk = indices[begin : begin + length]
            forward = self.forward._read([last - i for i in reversed(chunk)], every, on_problem)
            with closing(forward):
                sets = {last - frames.index: frames for frames in forward}
            for i in chunk:
                if i in sets:
                    stamps = (None if np.isnan(stamp) else float(stamp) for stamp in self.timeline.stamps[i])
                    yield replace(sets.pop(i), index=i, time=float(self.timeline.times[i]), times=tuple(stamps))


def add_masks(frames: FrameSet, by_object: Mapping[str, Sequence[BoolArray | None]]) -> FrameSet:
    """Return a frame set with the masks (h, w) of each object by camera, and the union of the objects' masks.

    The union is None unless all are known.
    """
    union: list[BoolArray | None] = []
    for c in range(len(frames.images)):
        known = [mask for masks in by_object.values() if (mask := masks[c]) is not None]
        is_complete = 0 < len(known) == len(by_object)
        union.append((known[0] if len(known) == 1 else np.logical_or.reduce(known)) if is_complete else None)
    object_masks = {name: tuple(masks) for name, masks in by_object.items()} if len(by_object) > 1 else {}
    return replace(frames, masks=tuple(union), object_masks=object_masks)


def check_frame_range(start: int, stop: int | None, every: int) -> range:
    """Return the numbers start, start + every, ... below stop, which may be None for no end.

    Raises:
        ValueError: stop <= start, or every < 1.
    """
    if stop is not None and stop <= start:
        raise ValueError(f"stop must be greater than start ({start}), got {stop}")
    if every < 1:
        raise ValueError(f"every must be at least 1, got {every}")
    return range(start, sys.maxsize if stop is None else stop, every)


def issue_warning(problem: str) -> None:
    """Issue a problem as a Python warning; the default `on_problem` of `frames`."""
    python_warnings.warn(problem, stacklevel=3)
