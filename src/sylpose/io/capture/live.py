"""Live sessions: cameras, network streams and image folders that are still being written."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from sylpose.frames import FrameSet
from sylpose.input_limits import input_errors, parse_toml, read_text
from sylpose.io import calibration as calibrations
from sylpose.io.capture.boxes import Masks, find_masks, load_boxes, merge_object_names
from sylpose.io.capture.frame_assembly import DropCounter, FrameAssembler
from sylpose.io.capture.growing import GrowingFolder
from sylpose.io.capture.names import match_all_names, match_names
from sylpose.io.capture.session import (
    SessionBase,
    add_masks,
    check_frame_range,
    find_boxes_and_masks,
    issue_warning,
)
from sylpose.io.capture.sources import Source
from sylpose.io.capture.streams import Device, open_device, read_streams
from sylpose.rig import Rig

LIVE_FILE = "live.toml"
# Seconds for which a frame set waits for delayed cameras by default (choice: six frames at 30 per second).
DEFAULT_MAX_DELAY = 0.2

ReadFrames = Callable[[range, Callable[[str], None], threading.Event], Generator[FrameSet, None, None]]
OpenDevice = Callable[[int | str, tuple[int, int], float | None], Device]


class _LiveFile(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Content of live.toml."""

    sources: dict[str, int | str]
    calibration: str | None = None
    boxes: str | None = None
    max_delay: float = DEFAULT_MAX_DELAY
    tolerance: float | None = None
    rate: float | None = None


@dataclass(frozen=True, eq=False)
class LiveSession(SessionBase):
    """A session whose frames are read while they arrive, with the interface of `Session`.

    Each mask applies to all frames of its camera.

    Attributes:
        rate: frames per second, if given.
        is_real_time: whether late frame sets are dropped and times are seconds of the clock.
        dropped: by camera, frames of the latest `frames` call that are in no frame set.
        missed: by camera, frame sets of the latest `frames` call without this camera because it was delayed or dead.
    """

    rate: float | None
    is_real_time: bool
    dropped: dict[str, int]
    missed: dict[str, int]
    _reader: ReadFrames = field(repr=False)
    _counter: DropCounter = field(repr=False)
    _stopped: threading.Event = field(repr=False, default_factory=threading.Event)

    @property
    def n_frames(self) -> None:
        """Return None: the number of frames is unknown."""

    def stop(self) -> None:
        """Stop reading after the current frame set; callable from any thread or signal handler."""
        self._stopped.set()

    def frames(
        self,
        start: int = 0,
        stop: int | None = None,
        every: int = 1,
        on_problem: Callable[[str], None] | None = None,
    ) -> Generator[FrameSet, None, None]:
        """Yield the frame sets start, start + every, ... below stop as they arrive.

        Cameras are opened at the first frame set, and closed when the generator ends or is closed. Frame sets that are
        not requested in time are dropped. Dropped frames are counted, and reported to `on_problem` at intervals and at
        the end.

        Args:
            start: number of the first frame set.
            stop: number after the last; None for no end.
            every: step between frame sets.
            on_problem: called with messages, in the caller's thread; None for `warnings.warn`.

        Raises:
            ValueError: start < 0, stop <= start, every < 1, at the call; while iterating, frames whose size differs
                from the calibration's, or images without numbers in their names.
            OSError: while iterating, no camera delivers any frame.
        """
        if start < 0:
            raise ValueError(f"start must be at least 0, got {start}")
        indices = check_frame_range(start, stop, every)
        self._stopped.clear()
        return self._read(indices, on_problem or issue_warning)

    def _read(self, indices: range, on_problem: Callable[[str], None]) -> Generator[FrameSet, None, None]:
        self._counter.reset()
        try:
            with closing(self._reader(indices, on_problem, self._stopped)) as sets:
                for frames in sets:
                    if report := self._counter.report_if_due():
                        on_problem(report)
                    has_image = [image is not None for image in frames.images]
                    masks = {
                        name: [m.static if has else None for has, m in zip(has_image, its, strict=True)]
                        for name, its in self._masks.items()
                    }
                    yield add_masks(frames, masks)
        finally:
            if final_report := self._counter.final_report():
                on_problem(final_report)


def is_live(path: Path | str) -> bool:
    """Return whether a path is a live session: a TOML file, or a folder with live.toml."""
    path = Path(path)
    return (path / LIVE_FILE).is_file() or (path.is_file() and path.suffix.lower() == ".toml")


def open_live(
    path: Path | str,
    *,
    calibration: Path | None = None,
    boxes: Path | None = None,
    masks: Path | None = None,
    follow: bool = False,
    lossless: bool = False,
    idle: float = 10.0,
    max_delay: float | None = None,
    rate: float | None = None,
    opener: OpenDevice = open_device,
) -> LiveSession:
    """Open cameras and streams (docs/live.md) or, with `follow`, a growing folder of images per camera.

    Devices are opened when the first frame set is requested.

    Args:
        path: a live.toml or its folder; with `follow`, the session folder.
        calibration, boxes, masks: as in `open_session`; they take precedence over live.toml.
        follow: read image folders that a recorder is still writing.
        lossless: with `follow`: yield every frame set in order, however far the recorder is ahead.
        idle: with `follow`: seconds without a new file after which the recording counts as ended.
        max_delay: longest wait of a frame for other cameras or for the caller, seconds; 0.2 by default.
        rate: frames per second, if known; for growing folders it converts times to seconds.
        opener: opens a device number, device path or URL.

    Raises:
        FileNotFoundError: no such file or folder.
        ValueError: the message names the file, key or camera and the expected content.
    """
    path = Path(path)
    with input_errors(path):
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file or folder")
        if follow and not path.is_dir():
            raise ValueError(f"{path}: a folder with one folder of images per camera is expected, not a file")
        if lossless and not follow:
            raise ValueError(
                "lossless: cameras and streams cannot wait; only a growing folder (follow) can be lossless"
            )
        folder, file = (path, path / LIVE_FILE) if path.is_dir() else (path.parent, path)
        settings = _LiveFile({}) if follow else _load_live_file(file)
        max_delay = settings.max_delay if max_delay is None else max_delay
        rate = settings.rate if rate is None else rate
        numbers = {"max_delay": max_delay, "idle": idle, "tolerance": settings.tolerance, "rate": rate}
        for name, value in numbers.items():
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"{folder if follow else file}: {name} must be a positive number, got {value}")
        if calibration is None and settings.calibration is not None:
            calibration = folder / settings.calibration
        if boxes is None and settings.boxes is not None:
            boxes = folder / settings.boxes
        calibration = calibrations.find(folder) if calibration is None else Path(calibration)
        rig = calibrations.load(calibration)
        boxes, masks = find_boxes_and_masks(folder, boxes, masks)
        object_boxes = {} if boxes is None else load_boxes(boxes, rig)
        object_masks = {} if masks is None else _load_static_masks(masks, rig)
        counter = DropCounter(dict.fromkeys(rig.names, 0), dict.fromkeys(rig.names, 0))
        warnings: tuple[str, ...] = ()
        reader: ReadFrames
        if follow:
            growing = GrowingFolder(folder, rig, masks, max_delay, idle, lossless, rate)
            warnings, reader = growing.check(), partial(growing.follow, counter)
        else:
            sources = _match_sources(settings, rig, file)
            openers = [partial(opener, sources[camera.name], camera.size, rate) for camera in rig]
            assemble = partial(FrameAssembler, counter, max_delay, settings.tolerance, rate)
            reader = partial(read_streams, rig, openers, assemble)
        return LiveSession(
            path=folder,
            rig=rig,
            calibration=calibration,
            objects=merge_object_names(object_boxes, object_masks, boxes, masks),
            masks=masks,
            rate=rate,
            is_real_time=not follow or (not lossless and rate is not None),
            warnings=warnings,
            dropped=counter.dropped,
            missed=counter.missed,
            _boxes=object_boxes,
            _masks=object_masks,
            _reader=reader,
            _counter=counter,
        )


def _load_live_file(file: Path) -> _LiveFile:
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; it lists the cameras or streams to read")
    text = read_text(file)
    with input_errors(file):
        try:
            return msgspec.convert(parse_toml(text), _LiveFile)
        except (msgspec.MsgspecError, tomllib.TOMLDecodeError) as error:
            raise ValueError(
                f"a table [sources] of camera = device number, path or URL is expected ({error})"
            ) from None


def _match_sources(settings: _LiveFile, rig: Rig, file: Path) -> dict[str, int | str]:
    """Return the device or URL of each camera of the rig."""
    matched = match_all_names(settings.sources, rig.names, f"{file}: [sources]")
    sources = {camera: settings.sources[name] for name, camera in matched.items()}
    missing = [name for name in rig.names if name not in sources]
    if missing:
        raise ValueError(f"{file}: [sources] has no entry for camera {', '.join(missing)}")
    for camera, source in sources.items():
        is_valid = source >= 0 if isinstance(source, int) else "://" in source or source.startswith("/dev/")
        if not is_valid:
            raise ValueError(
                f"{file}: the source of {camera} must be a device number, a device path such as /dev/video0, or a URL "
                f"such as rtsp://host/path, got {source!r}"
            )
    return sources


def _load_static_masks(folder: Path, rig: Rig) -> dict[str, tuple[Masks, ...]]:
    if any(f.is_dir() and match_names([f.name], rig.names) for f in (*folder.glob("*"), *folder.glob("*/*"))):
        raise ValueError(f"{folder}: a live session needs one mask per camera (CAMERA.png) for all frames")
    return find_masks(folder, rig.names, tuple(Source(c.name, folder, "video", c.size, 0) for c in rig))[0]
