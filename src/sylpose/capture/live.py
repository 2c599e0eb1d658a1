"""Live sessions: cameras, network streams and folders that a recorder is still filling."""

from __future__ import annotations

import sys
import threading
import tomllib
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from sylpose import calibration as calibrations
from sylpose.capture.boxes import Masks, find_masks, load_boxes, object_names
from sylpose.capture.frame_assembly import Assembler, Tally
from sylpose.capture.growing import Pace, check_folders, read_folders
from sylpose.capture.names import belongs_to, match_names
from sylpose.capture.session import SessionBase, any_of, warn
from sylpose.capture.sources import Source
from sylpose.capture.streams import PAUSES, Device, open_device, read_streams
from sylpose.frames import FrameSet
from sylpose.input_limits import parsed_toml, text_of, told
from sylpose.rig import Rig

__all__ = ["LIVE_FILE", "LiveSession", "is_live", "open_live"]

LIVE_FILE = "live.toml"
# How long a frame set waits for late cameras, seconds, where nobody says it (choice: six frames at 30 per second).
MAX_DELAY = 0.2

Reader = Callable[[range, Callable[[str], None], threading.Event], Generator[FrameSet, None, None]]
OpenDevice = Callable[[int | str, tuple[int, int], float | None], Device]


class _LiveFile(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """live.toml."""

    sources: dict[str, int | str]
    calibration: str | None = None
    boxes: str | None = None
    max_delay: float = MAX_DELAY
    tolerance: float | None = None
    rate: float | None = None


@dataclass(frozen=True, eq=False)
class LiveSession(SessionBase):
    """A rig whose frames come while they are read; as far as it goes the same as a `Session`. Each mask is one camera's,
    for all of its frames.

    Attributes:
        rate: frames per second, if somebody said it.
        dropped: by camera, frames of the latest `frames` that came and are in no frame set.
        missed: by camera, frame sets of the latest `frames` that were given without it while it was late or dead.
    """

    rate: float | None
    dropped: dict[str, int]
    missed: dict[str, int]
    _reader: Reader = field(repr=False)
    _tally: Tally = field(repr=False)
    _stopped: threading.Event = field(repr=False, default_factory=threading.Event)

    @property
    def n_frames(self) -> None:
        """Nobody knows."""

    def stop(self) -> None:
        """End the frames that are being read after the present one; from any thread or a signal handler."""
        self._stopped.set()

    def frames(
        self,
        start: int = 0,
        stop: int | None = None,
        every: int = 1,
        on_problem: Callable[[str], None] | None = None,
    ) -> Generator[FrameSet, None, None]:
        """The frame sets number start, start + every, ... below stop, as they come.

        Cameras are opened at the first frame set, and closed when the generator ends or is closed. Sets that nobody
        asked for in time are not given; what was left out is counted, and said to `on_problem` now and then and at
        the end.

        Args:
            on_problem: called with sentences, in the caller's thread; None for `warnings.warn`.

        Raises:
            ValueError: start < 0, stop <= start, every < 1, at the call; while iterating, frames of another size than
                the calibration's, images without numbers in their names.
            OSError: while iterating, no camera gives any frame.
        """
        if start < 0:
            raise ValueError(f"start must be at least 0, got {start}")
        if stop is not None and stop <= start:
            raise ValueError(f"stop must be greater than start ({start}), got {stop}")
        if every < 1:
            raise ValueError(f"every must be at least 1, got {every}")
        self._stopped.clear()
        instants = range(start, sys.maxsize if stop is None else stop, every)
        return self._read(instants, on_problem or warn)

    def _read(self, instants: range, on_problem: Callable[[str], None]) -> Generator[FrameSet, None, None]:
        self._tally.reset()
        try:
            with closing(self._reader(instants, on_problem, self._stopped)) as sets:
                for frames in sets:
                    if news := self._tally.news():
                        on_problem(news)
                    by_object = {
                        name: tuple(
                            None if image is None else m.static for image, m in zip(frames.images, masks, strict=True)
                        )
                        for name, masks in self._masks.items()
                    }
                    yield replace(
                        frames,
                        masks=tuple(any_of([m[c] for m in by_object.values()]) for c in range(len(self.rig))),
                        object_masks=by_object if len(by_object) > 1 else {},
                    )
        finally:
            if total := self._tally.total():
                on_problem(total)


def is_live(path: Path | str) -> bool:
    """Whether a path is that of cameras and streams: a TOML file, or a folder with live.toml in it."""
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
    """Open cameras and streams (docs/live.md), or with `follow` a folder of images per camera that is still growing.

    Nothing is opened before the first frame set is asked for.

    Args:
        path: a live.toml, or the folder with it; with `follow` the session's folder.
        calibration, boxes, masks: as in `open_session`; they go before what live.toml says.
        lossless: with `follow`: every instant is given in order, however far the recorder is ahead.
        idle: with `follow`: seconds without a new file after which the recorder is taken to have ended.
        max_delay: how long frames may wait, for other cameras or for the caller, seconds; 0.2 when nobody says it.
        rate: frames per second, where known: of growing folders it makes the times seconds.
        opener: opens a device number, device path or URL.

    Raises:
        FileNotFoundError: no such file or folder.
        ValueError: naming the file, key or camera that is wrong, and what was expected.
    """
    path = Path(path)
    with told(path):
        return _opened(path, calibration, boxes, masks, follow, lossless, idle, max_delay, rate, opener)


def _opened(
    path: Path,
    calibration: Path | None,
    boxes: Path | None,
    masks: Path | None,
    follow: bool,
    lossless: bool,
    idle: float,
    max_delay: float | None,
    rate: float | None,
    opener: OpenDevice,
) -> LiveSession:
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if follow and not path.is_dir():
        raise ValueError(f"{path}: a folder with one folder of images per camera is expected, not a file")
    if lossless and not follow:
        raise ValueError("lossless: cameras and streams cannot wait; only a growing folder (follow) can be lossless")
    file = path / LIVE_FILE if path.is_dir() else path
    folder = path if path.is_dir() else path.parent
    settings = _LiveFile({}) if follow else _load(file)
    if calibration is None and settings.calibration is not None:
        calibration = folder / settings.calibration
    calibration = calibrations.find(folder) if calibration is None else Path(calibration)
    rig = calibrations.load(calibration)
    if boxes is None and settings.boxes is not None:
        boxes = folder / settings.boxes
    if boxes is None and (folder / "boxes.toml").is_file():
        boxes = folder / "boxes.toml"
    if masks is None and (folder / "masks").is_dir():
        masks = folder / "masks"
    max_delay = settings.max_delay if max_delay is None else max_delay
    rate = settings.rate if rate is None else rate
    numbers = {"max_delay": max_delay, "idle": idle, "tolerance": settings.tolerance, "rate": rate}
    for name, value in numbers.items():
        if value is not None and not 0 < value < np.inf:
            raise ValueError(f"{folder if follow else file}: {name} must be a positive number, got {value}")

    object_boxes = {} if boxes is None else load_boxes(Path(boxes), rig)
    object_masks = {} if masks is None else _static_masks(Path(masks), rig)
    tally = Tally(dict.fromkeys(rig.names, 0), dict.fromkeys(rig.names, 0))
    warnings: tuple[str, ...] = ()
    reader: Reader
    if follow:
        warnings = check_folders(folder, rig, masks)
        reader = partial(read_folders, folder, rig, masks, Pace(max_delay, idle, lossless, rate), tally)
    else:
        sources = _sources(settings, rig, file)
        reader = partial(_stream, rig, sources, opener, (max_delay, settings.tolerance, rate), tally)
    return LiveSession(
        path=folder,
        rig=rig,
        calibration=calibration,
        objects=object_names(object_boxes, object_masks, boxes, masks),
        masks=masks,
        rate=rate,
        warnings=warnings,
        dropped=tally.dropped,
        missed=tally.missed,
        _boxes=object_boxes,
        _masks=object_masks,
        _reader=reader,
        _tally=tally,
    )


def _load(file: Path) -> _LiveFile:
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; it says which cameras or streams to read")
    text = text_of(file)
    with told(file):
        try:
            return msgspec.convert(parsed_toml(text), _LiveFile)
        except (msgspec.MsgspecError, tomllib.TOMLDecodeError) as error:
            raise ValueError(
                f"a table [sources] of camera = device number, path or URL is expected ({error})"
            ) from None


def _sources(settings: _LiveFile, rig: Rig, file: Path) -> dict[str, int | str]:
    """Source by camera, for all cameras of the rig."""
    matched = belongs_to(settings.sources, rig.names, f"{file}: [sources]")
    sources = {camera: settings.sources[name] for name, camera in matched.items()}
    missing = [name for name in rig.names if name not in sources]
    if missing:
        raise ValueError(f"{file}: [sources] has none for camera {', '.join(missing)}")
    for camera, source in sources.items():
        known = source >= 0 if isinstance(source, int) else "://" in source or source.startswith("/dev/")
        if not known:
            raise ValueError(
                f"{file}: the source of {camera} must be a device number, a device path such as /dev/video0, or a URL "
                f"such as rtsp://host/path, got {source!r}"
            )
    return sources


def _static_masks(folder: Path, rig: Rig) -> dict[str, tuple[Masks, ...]]:
    if any(f.is_dir() and match_names([f.name], rig.names) for f in (*folder.glob("*"), *folder.glob("*/*"))):
        raise ValueError(f"{folder}: a live session takes one mask per camera (CAMERA.png), for all of its frames")
    return find_masks(folder, rig, tuple(Source(c.name, folder, "video", c.size, 0) for c in rig))[0]


def _stream(
    rig: Rig,
    sources: Mapping[str, int | str],
    opener: OpenDevice,
    limits: tuple[float, float | None, float | None],
    tally: Tally,
    instants: range,
    on_problem: Callable[[str], None],
    stopped: threading.Event,
) -> Generator[FrameSet, None, None]:
    openers = [partial(opener, sources[camera.name], camera.size, limits[2]) for camera in rig]
    return read_streams(rig, openers, Assembler(tally, *limits), instants, on_problem, stopped, PAUSES)
