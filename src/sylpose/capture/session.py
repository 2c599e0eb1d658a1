"""A session: a recording opened for reading, and its frames."""

from __future__ import annotations

import warnings as python_warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Self

import numpy as np

from sylpose import calibration as calibrations
from sylpose.calibration.world import World, told_in
from sylpose.capture.boxes import Masks, check_first_masks, find_masks, load_boxes, object_names
from sylpose.capture.frame_readers import CameraReader, Reading, check_readable
from sylpose.capture.sources import Source, find_sources, sizes_in
from sylpose.capture.timeline import Timeline, build_timeline, load_timestamps
from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import BoolArray
from sylpose.geometry.validation import listed
from sylpose.input_limits import told
from sylpose.rig import Rig

__all__ = ["Session", "SessionBase", "any_of", "open_session", "warn"]


@dataclass(frozen=True, eq=False)
class SessionBase:
    """What recordings and live sessions have in common: a rig, and one object or several in front of it.

    Attributes:
        path: the session's folder.
        rig: the calibrated cameras.
        calibration: the file that the rig was read from.
        objects: the objects' names; "object" for one that has none. All of them have boxes or none, and masks or none.
        masks: the folder of masks, or None.
        warnings: sentences about what looks wrong but can be worked with.
        world: of one's own, in which the rig is told; None in the calibration's.
        without: cameras of the calibration that are left out; the rig has only the others.
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
        """The object's box in the first frame that is given, by camera; not every camera has one.

        Raises:
            ValueError: the session has several objects: see `of`.
        """
        if len(self.objects) > 1:
            raise ValueError(
                f"{self.path}: several objects ({', '.join(self.objects)}): take the boxes of one at a time"
            )
        return self._boxes.get(self.objects[0], {})

    def of(self, name: str) -> Self:
        """The same cameras with the boxes and masks of one object only.

        Raises:
            ValueError: no such object.
        """
        if name not in self.objects:
            raise ValueError(f"{self.path}: no object {name!r} in the session ({', '.join(self.objects)})")
        boxes = {name: self._boxes[name]} if name in self._boxes else {}
        masks = {name: self._masks[name]} if name in self._masks else {}
        return replace(self, objects=(name,), _boxes=boxes, _masks=masks)

    def with_rig(self, rig: Rig) -> Self:
        """The same images with other numbers for the same cameras: in another unit or world, or refined.

        Raises:
            ValueError: other cameras, another order, or other sizes.
        """
        if [(c.name, c.size) for c in rig] != [(c.name, c.size) for c in self.rig]:
            raise ValueError(
                f"rig: the cameras {', '.join(self.rig.names)} of {self.path} and their sizes are expected"
            )
        return replace(self, rig=rig)

    def told_in(self, world: World) -> Self:
        """The same in a world of one's own, which is found in the calibration's.

        Raises:
            ValueError: it is told in another one already, or as `calibration.world.told_in`.
        """
        if self.world is not None:
            raise ValueError(f"world: {self.path} is told in {self.world.said or 'another one'} already")
        return replace(self.with_rig(told_in(self.rig, world)), world=world)


@dataclass(frozen=True, eq=False)
class Session(SessionBase):
    """A recording: one video or image folder per camera.

    Attributes:
        sources: one per camera, in the rig's order.
        timeline: which frame each camera shows at each instant, and when.
    """

    sources: tuple[Source, ...]
    timeline: Timeline

    @property
    def n_frames(self) -> int:
        """Number of instants: from instant 0 to the last at which any camera has a frame."""
        return len(self.timeline.times)

    @property
    def rate(self) -> float | None:
        """Instants per second, or None for images without time stamps."""
        return self.timeline.rate

    def frames(
        self,
        start: int = 0,
        stop: int | None = None,
        every: int = 1,
        on_problem: Callable[[str], None] | None = None,
    ) -> Generator[FrameSet, None, None]:
        """The frame sets of instants start, start + every, ... below stop, one at a time.

        One frame set is read ahead, the cameras in parallel threads; nothing else is kept. A camera that has no frame
        at an instant gives None. When files break off, what can be read is given; after the last frame of the last
        camera the iteration ends.

        Args:
            stop: None, or more than `n_frames`, for all.
            on_problem: called with a sentence for each file that breaks off and each frame that cannot be read, before
                the frame set concerned is given, in the caller's thread; None for `warnings.warn`.

        Raises:
            ValueError: a start outside of the session, stop <= start, every < 1; at the call, not at the first frame.
            OSError, ValueError: while iterating, a video that cannot be opened any more.
        """
        if not 0 <= start < self.n_frames:
            raise ValueError(f"start must be in 0 ... {self.n_frames - 1} (the session's frames), got {start}")
        if stop is not None and stop <= start:
            raise ValueError(f"stop must be greater than start ({start}), got {stop}")
        if every < 1:
            raise ValueError(f"every must be at least 1, got {every}")
        instants = range(start, self.n_frames if stop is None else min(stop, self.n_frames), every)
        return self._read(instants, on_problem or warn)

    def _read(self, instants: range, on_problem: Callable[[str], None]) -> Generator[FrameSet, None, None]:
        with ExitStack() as stack:
            readers = [
                stack.enter_context(closing(CameraReader(source, {name: m[c] for name, m in self._masks.items()})))
                for c, source in enumerate(self.sources)
            ]
            pool = stack.enter_context(ThreadPoolExecutor(len(readers), thread_name_prefix="sylpose-capture"))

            def submit(i: int) -> list[Future[Reading]]:
                row = self.timeline.frames[i].tolist()
                return [pool.submit(reader.read, k) for reader, k in zip(readers, row, strict=True)]

            last = [
                int(np.flatnonzero(column >= 0)[-1]) if (column >= 0).any() else -1 for column in self.timeline.frames.T
            ]
            pending = submit(instants[0])
            for i, following in zip_longest(instants, instants[1:]):
                readings = [future.result() for future in pending]
                pending = [] if following is None else submit(following)
                for reading in readings:
                    for problem in reading.problems:
                        on_problem(problem)
                if all(reading.ended or end < i for reading, end in zip(readings, last, strict=True)):
                    return
                yield self._frame_set(i, readings)

    def _frame_set(self, i: int, readings: list[Reading]) -> FrameSet:
        masks = {name: tuple(reading.masks[name] for reading in readings) for name in self._masks}
        return FrameSet(
            i,
            float(self.timeline.times[i]),
            tuple(None if np.isnan(stamp) else float(stamp) for stamp in self.timeline.stamps[i]),
            tuple(reading.image for reading in readings),
            tuple(any_of([m[c] for m in masks.values()]) for c in range(len(readings))),
            masks if len(masks) > 1 else {},
        )


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
) -> Session:
    """Open a recording: a folder with one video (`cam_0.mp4`) or one folder of images (`cam_0/`) per camera.

    Names are matched to the calibration's cameras, tolerantly where that is unambiguous (`0.avi` is `cam_0`). Frames are
    used as coded, without the rotation that a file's metadata may ask for; their size must be the calibration's. The
    folder may also hold the calibration, boxes.toml, masks/ and timestamps.csv, each found without being named.

    Args:
        path: the session's folder.
        calibration: the calibration's file, where it is not the only one in the folder.
        boxes: the file of boxes, instead of boxes.toml in the folder.
        masks: the folder of masks, instead of masks/ in the folder.
        offsets: by camera; its frame k is shown at instant k + offset, so a camera that starts late has offset > 0.
        cameras: by camera, its video or folder of images (relative ones in `path`), where the names do not tell.
        rate: frames per second of folders of images without time stamps.
        without: cameras of the calibration that are left out, whether they have images or not.

    Raises:
        FileNotFoundError: no such folder or file.
        ValueError: naming the file or camera that is wrong, and what was expected.
    """
    path = Path(path)
    with told(path):
        return _opened(path, calibration, boxes, masks, offsets, cameras, rate, without)


def reopen_session(
    path: Path,
    calibration: Path,
    offsets: Mapping[str, int],
    cameras: Mapping[str, Path | str],
    rate: float | None,
    without: Sequence[str],
) -> Session:
    """The same for its images alone, by the calibration of a run that had left cameras out: it has them no more.

    Raises:
        FileNotFoundError, ValueError: as `open_session`.
    """
    with told(path):
        return _opened(path, calibration, None, None, offsets, cameras, rate, without, again=bool(without))


def _opened(
    path: Path,
    calibration: Path | None,
    boxes: Path | None,
    masks: Path | None,
    offsets: Mapping[str, int] | None,
    cameras: Mapping[str, Path | str] | None,
    rate: float | None,
    without: Sequence[str],
    again: bool = False,
) -> Session:
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder")
    if not path.is_dir():
        raise ValueError(f"{path}: a folder with one video or image folder per camera is expected, not a file")
    calibration = calibrations.find(path) if calibration is None else Path(calibration)
    boxes = None if boxes is None else Path(boxes)
    masks = None if masks is None else Path(masks)
    if boxes is None and not again and (path / "boxes.toml").is_file():
        boxes = path / "boxes.toml"
    if masks is None and not again and (path / "masks").is_dir():
        masks = path / "masks"

    others = [] if masks is None else [masks]
    rig = calibrations.load(calibration, lambda names: sizes_in(path, names, calibration, others, cameras, without))
    whole, rig = rig, rig if again else _left(rig, without, calibration)
    sources, warnings = find_sources(path, rig, calibration, not_cameras=others, named=cameras, without=without)
    for source in sources:
        check_readable(source)
    stamps_file = path / "timestamps.csv"
    stamps = load_timestamps(stamps_file, rig.names, without) if stamps_file.is_file() else None
    timeline, timeline_warnings = build_timeline(sources, stamps, offsets, rate)
    by_object, mask_warnings = ({}, []) if masks is None else find_masks(masks, whole, sources)
    for camera_masks in by_object.values():
        check_first_masks(camera_masks, sources, timeline.frames)
    object_boxes = {} if boxes is None else load_boxes(boxes, whole)
    object_boxes = {name: {c: box for c, box in its.items() if c in rig.names} for name, its in object_boxes.items()}
    return Session(
        path=path,
        rig=rig,
        calibration=calibration,
        sources=sources,
        objects=object_names(object_boxes, by_object, boxes, masks),
        masks=masks,
        timeline=timeline,
        warnings=(*warnings, *timeline_warnings, *mask_warnings),
        without=tuple(without),
        _boxes=object_boxes,
        _masks=by_object,
    )


def _left(rig: Rig, without: Sequence[str], calibration: Path) -> Rig:
    """The cameras that are not left out.

    Raises:
        ValueError: one that the calibration does not have; all of them.
    """
    without = listed(without, str, "without")
    if unknown := [name for name in without if name not in rig.names]:
        raise ValueError(f"without: {unknown[0]!r} is no camera of {calibration.name} ({', '.join(rig.names)})")
    kept = [name for name in rig.names if name not in without]
    if not kept:
        raise ValueError(f"without: no camera of {calibration.name} is left")
    return rig.subset(kept) if without else rig


def any_of(masks: Sequence[BoolArray | None]) -> BoolArray | None:
    """Where any of the objects is, from a mask each; None unless all are known, one of one object as it is."""
    known = [mask for mask in masks if mask is not None]
    if not known or len(known) < len(masks):
        return None
    return known[0] if len(known) == 1 else np.logical_or.reduce(known)


def warn(problem: str) -> None:
    """What becomes of a problem that the caller of `frames` does not take."""
    python_warnings.warn(problem, stacklevel=3)
