"""Live sessions: cameras, network streams and folders that a recorder is still filling."""

from __future__ import annotations

import os
import re
import sys
import threading
import time
import warnings as python_warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from sylpose import calibration as calibrations
from sylpose.capture.images import read_image
from sylpose.capture.names import IMAGE_SUFFIXES, belongs_to, image_files, image_numbers, match_names
from sylpose.capture.regions import Box, Masks, find_masks, load_boxes, object_names
from sylpose.capture.session import FrameSet, _any_of
from sylpose.capture.sources import NO_CAMERAS, Source
from sylpose.capture.streams import PATIENCE, PAUSES, Assembler, Device, Tally, open_device, read_streams
from sylpose.rig import Camera, Rig

__all__ = ["DONE", "LIVE_FILE", "LiveSession", "is_live", "open_live"]

LIVE_FILE = "live.toml"
# A file of this name in a growing folder says that nothing more will come.
DONE = "DONE"
MAX_DELAY = 0.2
# Seconds between two looks at a growing folder for the next numbers.
POLL = 0.005
# A folder is listed whole this often, and never for more than this share of the time: an hour is 100,000 files.
LIST_PAUSE, LIST_SHARE = 0.1, 0.05
# Numbers that are looked for by name, without listing.
PROBES = 64

Image = NDArray[np.uint8]
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
class LiveSession:
    """A rig whose frames come while they are read; as far as it goes the same as a `Session`.

    Attributes:
        path: the session's folder.
        rig, calibration, objects: as in `Session`.
        masks: the folder of masks, one per camera for all frames, or None.
        rate: frames per second, if somebody said it.
        warnings: sentences about what looks wrong but can be worked with.
        dropped: by camera, frames of the latest `frames` that came and are in no frame set.
        missed: by camera, frame sets of the latest `frames` that were given without it while it was late or dead.
    """

    path: Path
    rig: Rig
    calibration: Path
    objects: tuple[str, ...]
    masks: Path | None
    rate: float | None
    warnings: tuple[str, ...]
    dropped: dict[str, int]
    missed: dict[str, int]
    _boxes: dict[str, dict[str, Box]] = field(repr=False)
    _masks: dict[str, tuple[Masks, ...]] = field(repr=False)
    _reader: Reader = field(repr=False)
    _tally: Tally = field(repr=False)
    _stopped: threading.Event = field(repr=False, default_factory=threading.Event)

    @property
    def boxes(self) -> dict[str, Box]:
        """The object's box in the first frame set that is given, by camera; not every camera has one.

        Raises:
            ValueError: the session has several objects: see `of`.
        """
        if len(self.objects) > 1:
            raise ValueError(
                f"{self.path}: several objects ({', '.join(self.objects)}): take the boxes of one at a time"
            )
        return self._boxes.get(self.objects[0], {})

    def of(self, name: str) -> LiveSession:
        """The same cameras with the boxes and masks of one object only.

        Raises:
            ValueError: no such object.
        """
        if name not in self.objects:
            raise ValueError(f"{self.path}: no object {name!r} in the session ({', '.join(self.objects)})")
        boxes = {name: self._boxes[name]} if name in self._boxes else {}
        masks = {name: self._masks[name]} if name in self._masks else {}
        return replace(self, objects=(name,), _boxes=boxes, _masks=masks)

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
        return self._read(instants, on_problem or _warn)

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
                        masks=tuple(_any_of([m[c] for m in by_object.values()]) for c in range(len(self.rig))),
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
        warnings = _check_folders(folder, rig, masks)
        reader = partial(_follow, folder, rig, masks, _Pace(max_delay, idle, lossless, rate), tally)
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
    try:
        return msgspec.toml.decode(file.read_bytes(), type=_LiveFile)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{file}: a table [sources] of camera = device number, path or URL is expected ({error})"
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


def _warn(problem: str) -> None:
    python_warnings.warn(problem, stacklevel=3)


# --- growing folders -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Pace:
    max_delay: float
    idle: float
    lossless: bool
    rate: float | None


class _Folder:
    """The images of one camera whose numbers are above the last one that was given."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.path: Path | None = None
        self.files: dict[int, Path] = {}
        self.written: dict[int, float] = {}  # when, on the file system's clock
        self.newest = -np.inf
        self.step = 0  # smallest difference of numbers
        self.away = 0  # instants in a row without this camera
        self._column = -1
        self._latest: tuple[int, str] | None = None
        self._next_list = -np.inf

    def look(self, given: int, final: bool = False) -> bool:
        """Whether there are new files. `final` lists the folder in any case, and is content with a single image."""
        known = len(self.files)
        if self.path is not None:
            self._probe(given)
            begin = time.monotonic()
            if final or begin >= self._next_list:
                self._list(given, final)
                end = time.monotonic()
                self._next_list = end + max(LIST_PAUSE, (end - begin) / LIST_SHARE)
        return len(self.files) > known

    def forget(self, number: int) -> None:
        """A number is done with."""
        self.files.pop(number, None)
        self.written.pop(number, None)

    def _probe(self, given: int) -> None:
        """Look for the next numbers, and those that are missing before them, by name."""
        if self._latest is None or self.path is None or not self.step:
            return
        number, name = self._latest
        found = list(re.finditer(r"[0-9]+", Path(name).stem))[self._column]
        for n in range(max(given + 1, number - PROBES * self.step), number + 3 * self.step + 1):
            if (n - number) % self.step == 0 and n not in self.files:
                digits = str(n).zfill(len(found[0]))
                self._add(n, self.path / f"{name[: found.start()]}{digits}{name[found.end() :]}")

    def _list(self, given: int, final: bool) -> None:
        if self.path is None:
            return
        if self._column < 0 and not self._find_column(self.path, final):
            return
        for entry in os.scandir(self.path):
            if os.path.splitext(entry.name)[1].lower() in IMAGE_SUFFIXES and entry.name[0] != ".":
                numbers = re.findall(r"[0-9]+", Path(entry.name).stem)
                if len(numbers) > self._column and (n := int(numbers[self._column])) > given and n not in self.files:
                    self._add(n, self.path / entry.name)

    def _find_column(self, folder: Path, final: bool) -> bool:
        """Which number in the names is the frame's: the last that counts up, which two images can tell."""
        files = image_files(folder)
        if len(files) < (1 if final else 2):
            return False
        numbers = image_numbers(files)
        if numbers is None:
            raise ValueError(f"{folder}: images with the frame's number in their names are expected")
        columns = list(zip(*(map(int, re.findall(r"[0-9]+", file.stem)) for file in files), strict=True))
        self._column = len(columns) - 1 - columns[::-1].index(numbers)
        return True

    def _add(self, n: int, file: Path) -> None:
        try:
            written = file.stat().st_mtime
        except OSError:  # not there, or gone again
            return
        self.files[n], self.written[n] = file, written
        self.newest = max(self.newest, written)
        if self._latest is not None and n != self._latest[0]:
            difference = abs(n - self._latest[0])
            self.step = min(self.step or difference, difference)
        if self._latest is None or n > self._latest[0]:
            self._latest = (n, file.name)


class _Instant:
    """The images of one number, as far as they can be read."""

    def __init__(self, number: int) -> None:
        self.number, self.since = number, time.monotonic()
        self.images: dict[str, Image] = {}
        self.problems: dict[str, str] = {}
        self._failed: dict[str, tuple[int, int]] = {}

    def read(self, folders: Iterable[_Folder], pool: ThreadPoolExecutor) -> None:
        """Read what is new, in parallel; files that cannot be read are tried again once they have changed."""
        first = not self.images
        todo = [f for f in folders if self.number in f.files and f.camera.name not in self.images]
        list(pool.map(self._read, todo))
        if first and self.images:
            self.since = time.monotonic()

    def _read(self, folder: _Folder) -> None:
        name, file = folder.camera.name, folder.files[self.number]
        try:
            state = _state(file)
            if state == self._failed.get(name):
                return
            self._failed[name] = state
            image = read_image(file)
            if _state(file) != state:  # it is being written
                del self._failed[name]
                return
        except (ValueError, OSError) as error:
            self.problems[name] = f"{error}"
            return
        size = image.shape[1::-1]
        if size == folder.camera.size:
            self.images[name] = image
        else:
            wanted = folder.camera.size
            self.problems[name] = f"{file} is {size[0]}x{size[1]}, not {wanted[0]}x{wanted[1]}"


class _Follower:
    """Gives the instants of a growing folder in order, each as soon as it is whole or has waited for long enough."""

    def __init__(self, path: Path, rig: Rig, masks: Path | None, pace: _Pace, tally: Tally) -> None:
        self._path, self._rig, self._masks, self._pace, self._tally = path, rig, masks, pace, tally
        self._folders = [_Folder(camera) for camera in rig]
        self._numbers: deque[int] = deque()
        self._given, self._index = -1, -1
        self._quiet = time.monotonic()  # since when nothing new has come
        self._next_search = -np.inf

    def frames(
        self, instants: range, on_problem: Callable[[str], None], stopped: threading.Event
    ) -> Generator[FrameSet, None, None]:
        """Frame sets without masks."""
        instant: _Instant | None = None
        passed, said = 0, set[str]()
        begun = done = False
        with ThreadPoolExecutor(len(self._folders), thread_name_prefix="sylpose-follow") as pool:
            while not stopped.is_set() and self._index + 1 < instants.stop:
                was_done, done = done, (self._path / DONE).exists()  # before looking: what came before it is then found
                self._look(done > was_done or (not self._numbers and (done or self._is_idle())))
                if not self._numbers:
                    if done or self._is_idle():
                        break
                    stopped.wait(POLL)
                elif self._index + 1 not in instants:
                    self._advance()
                elif self._overdue():
                    passed += not begun
                    self._drop(begun)
                else:
                    if instant is None or instant.number != self._numbers[0]:
                        instant = _Instant(self._numbers[0])
                    instant.read(self._folders, pool)
                    if not self._due(instant, done or self._is_idle()):
                        stopped.wait(POLL)
                        continue
                    if passed and not begun:
                        on_problem(f"{passed} instants that were there already are passed over.")
                    for camera, problem in instant.problems.items():
                        if camera not in said and camera not in instant.images:  # once: a broken disk has thousands
                            said.add(camera)
                            on_problem(f"{camera}: {problem}; it is left out, and so are later ones that are like it.")
                    self._advance(instant)
                    begun = begun or bool(instant.images)
                    if instant.images:
                        yield self._frame_set(instant)
        if self._index < 0 and not stopped.is_set():
            raise OSError(f"{self._path}: no camera's folder got any image within {self._pace.idle:g} s")

    def _is_idle(self) -> bool:
        return time.monotonic() - self._quiet > self._pace.idle

    def _look(self, final: bool) -> None:
        if any(f.path is None for f in self._folders) and (final or time.monotonic() >= self._next_search):
            found = _find_folders(self._path, self._rig, self._masks)
            for folder in self._folders:
                folder.path = folder.path or found.get(folder.camera.name)
            self._next_search = time.monotonic() + LIST_PAUSE
        new = [folder for folder in self._folders if folder.look(self._given, final)]
        if new:
            self._quiet = time.monotonic()
            self._numbers = deque(sorted({n for folder in self._folders for n in folder.files}))
        for folder in new:
            folder.away = 0

    def _due(self, instant: _Instant, over: bool) -> bool:
        """Whether there is nothing more to wait for; `over` when nothing more will come."""
        step = min((f.step for f in self._folders if f.step), default=1)
        gap = 0 <= self._given < instant.number - step
        awaited = [f.camera.name for f in self._folders if f.away < PATIENCE]
        if not gap and instant.images.keys() >= set(awaited):
            return True
        ahead = self._newest() - max(f.written[instant.number] for f in self._folders if instant.number in f.written)
        return over or max(time.monotonic() - instant.since, ahead) > self._pace.max_delay

    def _overdue(self) -> bool:
        """Whether the next instant but one has waited for too long already, as told by the times of the files."""
        if self._pace.lossless or len(self._numbers) < 2:
            return False
        n = self._numbers[1]
        return self._newest() - max(f.written[n] for f in self._folders if n in f.written) > self._pace.max_delay

    def _newest(self) -> float:
        return max(folder.newest for folder in self._folders)

    def _drop(self, counted: bool) -> None:
        for folder in self._folders:
            if counted and self._numbers[0] in folder.files:
                self._tally.dropped[folder.camera.name] += 1
        self._advance()

    def _advance(self, given: _Instant | None = None) -> None:
        self._index += 1
        self._given = self._numbers.popleft()
        for folder in self._folders:
            folder.forget(self._given)
            if given is not None and folder.camera.name not in given.images:
                folder.away += 1
                self._tally.missed[folder.camera.name] += 1

    def _frame_set(self, instant: _Instant) -> FrameSet:
        n = len(self._folders)
        images = tuple(instant.images.get(folder.camera.name) for folder in self._folders)
        return FrameSet(self._index, self._index / (self._pace.rate or 1.0), (None,) * n, images, (None,) * n)


def _follow(
    path: Path,
    rig: Rig,
    masks: Path | None,
    pace: _Pace,
    tally: Tally,
    instants: range,
    on_problem: Callable[[str], None],
    stopped: threading.Event,
) -> Generator[FrameSet, None, None]:
    return _Follower(path, rig, masks, pace, tally).frames(instants, on_problem, stopped)


def _find_folders(path: Path, rig: Rig, masks: Path | None) -> dict[str, Path]:
    """The folders that there are up to now, by camera."""
    others = {folder.resolve() for folder in ([] if masks is None else [masks])}
    found = {
        entry.name: entry
        for entry in sorted(path.iterdir())
        if entry.is_dir()
        and entry.name[0] != "."
        and (entry.name in rig.names or entry.name.lower() not in NO_CAMERAS)
        and entry.resolve() not in others
    }
    try:
        matched = match_names(found, rig.names)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    by_camera: dict[str, Path] = {}
    for name, camera in matched.items():
        if camera in by_camera:
            raise ValueError(f"{path}: {by_camera[camera].name} and {name} are both for camera {camera}")
        by_camera[camera] = found[name]
    return by_camera


def _check_folders(path: Path, rig: Rig, masks: Path | None) -> tuple[str, ...]:
    """What looks wrong with a folder that is to be followed."""
    found = _find_folders(path, rig, masks)
    missing = [name for name in rig.names if name not in found]
    warnings = [f"No folder yet for camera {', '.join(missing)}; it is waited for."] if missing else []
    if (path / DONE).exists():
        warnings.append(f"There is a file {DONE} in the folder: only what is there already is read.")
    if (path / "timestamps.csv").is_file():
        warnings.append("timestamps.csv is not used while the recording grows.")
    return tuple(warnings)


def _state(file: Path) -> tuple[int, int]:
    status = file.stat()
    return status.st_size, status.st_mtime_ns
