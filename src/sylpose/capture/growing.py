"""Growing folders: the images of a recording that is still being written, each instant as soon as it is whole."""

from __future__ import annotations

import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from sylpose.capture.frame_assembly import PATIENCE, Tally
from sylpose.capture.images import read_image
from sylpose.capture.names import IMAGE_SUFFIXES, image_files, image_numbers, match_names
from sylpose.capture.sources import NO_CAMERAS
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import Image
from sylpose.input_limits import resolved
from sylpose.rig import Camera, Rig

__all__ = ["DONE", "Pace", "check_folders", "read_folders"]

# A file of this name in a growing folder says that nothing more will come.
DONE = "DONE"
# Seconds between two looks at a growing folder for the next numbers.
POLL = 0.005
# A folder is listed whole this often, and never for more than this share of the time: an hour is 100,000 files.
LIST_PAUSE, LIST_SHARE = 0.1, 0.05
# Numbers that are looked for by name, without listing.
PROBES = 64


@dataclass(frozen=True)
class Pace:
    """How long a growing folder is waited for.

    Attributes:
        max_delay: how long images may wait, for other cameras or for the caller, seconds.
        idle: seconds without a new file after which the recorder is taken to have ended.
        lossless: every instant is given in order, however far the recorder is ahead.
        rate: frames per second, where known: it makes the times seconds.
    """

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
        known, latest = len(self.files), self._latest
        if self.path is not None:
            self._probe(given)
            begin = time.monotonic()
            if final or begin >= self._next_list:
                self._list(given, final)
                end = time.monotonic()
                self._next_list = end + max(LIST_PAUSE, (end - begin) / LIST_SHARE)
        if len(self.files) == known:
            return False
        # A listing has them in any order, and the last one before may be given already.
        numbers = sorted({*self.files} if latest is None else {*self.files, latest[0]})
        steps = [b - a for a, b in pairwise(numbers)]
        self.step = min([self.step, *steps] if self.step else steps, default=0)
        return True

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
        # In steps, never one by one: numbers may be nanoseconds.
        for n in range(number - PROBES * self.step, number + 3 * self.step + 1, self.step):
            if n > given and n not in self.files:
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
            image = read_image(file, folder.camera.size)
            if _state(file) != state:  # it is being written
                del self._failed[name]
                return
        except (ValueError, OSError) as error:
            self.problems[name] = f"{error}"
            return
        self.images[name] = image


class _Follower:
    """Gives the instants of a growing folder in order, each as soon as it is whole or has waited for long enough."""

    def __init__(self, path: Path, rig: Rig, masks: Path | None, pace: Pace, tally: Tally) -> None:
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
        gap = (
            self._given >= 0 and 2 * (instant.number - self._given) > 3 * step
        )  # nanoseconds are never quite apart alike
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


def read_folders(
    path: Path,
    rig: Rig,
    masks: Path | None,
    pace: Pace,
    tally: Tally,
    instants: range,
    on_problem: Callable[[str], None],
    stopped: threading.Event,
) -> Generator[FrameSet, None, None]:
    """Frame sets, without masks, of a folder with one folder of images per camera, each as soon as it is whole.

    An instant that stays incomplete is given after `pace.max_delay`. Instants whose number is not in `instants` are
    passed over. The end is when there is a file DONE, or nothing new has come for `pace.idle` seconds.

    Args:
        masks: a folder that is no camera's, or None.

    Raises:
        ValueError: images without numbers in their names, two folders for one camera.
        OSError: no camera's folder got any image.
    """
    return _Follower(path, rig, masks, pace, tally).frames(instants, on_problem, stopped)


def _find_folders(path: Path, rig: Rig, masks: Path | None) -> dict[str, Path]:
    """The folders that there are up to now, by camera."""
    others = {resolved(folder) for folder in ([] if masks is None else [masks])}
    found = {
        entry.name: entry
        for entry in sorted(path.iterdir())
        if entry.is_dir()
        and entry.name[0] != "."
        and (entry.name in rig.names or entry.name.lower() not in NO_CAMERAS)
        and resolved(entry) not in others
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


def check_folders(path: Path, rig: Rig, masks: Path | None) -> tuple[str, ...]:
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
