"""Growing folders: images of a recording that is still being written, yielded as soon as they are complete."""

from __future__ import annotations

import math
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

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import Image
from sylpose.input_limits import resolve_path
from sylpose.io.capture.frame_assembly import MAX_MISSED_SETS, DropCounter
from sylpose.io.capture.images import read_image
from sylpose.io.capture.names import IMAGE_SUFFIXES, image_files, image_numbers, invert_unique, match_names
from sylpose.io.capture.sources import NON_CAMERA_NAMES
from sylpose.rig import Camera, Rig

# A file of this name in a growing folder marks the end of the recording.
DONE_FILE = "DONE"
# Polling interval for the next image numbers, seconds.
POLL_INTERVAL = 0.005
# Shortest interval between full listings of a folder, seconds, and the largest share of time spent on them: an hour is
# 100,000 files.
MIN_LIST_INTERVAL, MAX_LIST_TIME_RATIO = 0.1, 0.05
# Image numbers that are probed by name, without listing the folder.
N_PROBES = 64


@dataclass(frozen=True, eq=False)
class GrowingFolder:
    """Folder of a recording that is still being written, with one image folder per camera.

    Attributes:
        path: the growing folder.
        rig: the calibrated cameras.
        masks: a folder that is not a camera's, or None.
        max_delay: longest wait of an image for other cameras or for the caller, seconds.
        idle: seconds without a new file after which the recording counts as ended.
        lossless: yield every frame set in order, however far the recorder is ahead.
        rate: frames per second, if known; it converts times to seconds.
    """

    path: Path
    rig: Rig
    masks: Path | None
    max_delay: float
    idle: float
    lossless: bool
    rate: float | None

    def check(self) -> tuple[str, ...]:
        """Return warnings about the folder.

        Raises:
            ValueError: two folders for one camera.
        """
        found = self.find_camera_folders()
        missing = [name for name in self.rig.names if name not in found]
        warnings = [f"No folder yet for camera {', '.join(missing)}; waiting for it."] if missing else []
        if (self.path / DONE_FILE).exists():
            warnings.append(f"The folder contains a file {DONE_FILE}: only existing images are read.")
        if (self.path / "timestamps.csv").is_file():
            warnings.append("timestamps.csv is not used while the recording grows.")
        return tuple(warnings)

    def follow(
        self, counter: DropCounter, indices: range, on_problem: Callable[[str], None], stopped: threading.Event
    ) -> Generator[FrameSet, None, None]:
        """Yield the frame sets, without masks, each as soon as it is complete, or else after `max_delay`.

        Frame sets whose number is not in `indices` are skipped. Iteration ends at a file DONE, or after `idle` seconds
        without a new image.

        Args:
            counter: counts dropped and missed frames.
            indices: numbers of the frame sets to yield.
            on_problem: called with messages.
            stopped: ends the iteration when set.

        Raises:
            ValueError: images without numbers in their names, or two folders for one camera.
            OSError: no image arrived in any camera's folder.
        """
        return _FolderFollower(self, counter).frames(indices, on_problem, stopped)

    def find_camera_folders(self) -> dict[str, Path]:
        """Return the existing image folders by camera."""
        found = {
            entry.name: entry
            for entry in sorted(self.path.iterdir())
            if entry.is_dir()
            and entry.name[0] != "."
            and (entry.name in self.rig.names or entry.name.lower() not in NON_CAMERA_NAMES)
            and (self.masks is None or resolve_path(entry) != resolve_path(self.masks))
        }
        matched = match_names(found, self.rig.names, self.path)
        return invert_unique({found[name]: camera for name, camera in matched.items()}, self.path)


class _CameraFolder:
    """Pending images of one camera: those with numbers above the last one consumed."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.path: Path | None = None
        self.files: dict[int, Path] = {}
        self.write_times: dict[int, float] = {}  # modification time, on the file system's clock
        self.newest_time = -np.inf
        self.step = 0  # smallest difference of numbers
        self.missed_sets = 0  # consecutive frame sets without this camera
        self._column = -1
        self._latest: tuple[int, str] | None = None
        self._next_list_time = -np.inf

    def find_new(self, last_number: int, final: bool = False) -> bool:
        """Look for new images; return whether there are any.

        `final` forces a full listing and accepts a single image.
        """
        known, latest = len(self.files), self._latest
        if self.path is not None:
            self._probe_names(last_number)
            begin = time.monotonic()
            if final or begin >= self._next_list_time:
                self._list_folder(last_number, final)
                end = time.monotonic()
                self._next_list_time = end + max(MIN_LIST_INTERVAL, (end - begin) / MAX_LIST_TIME_RATIO)
        if len(self.files) == known:
            return False
        # A listing is unordered, and the previous latest image may be consumed already.
        numbers = sorted({*self.files} if latest is None else {*self.files, latest[0]})
        steps = [b - a for a, b in pairwise(numbers)]
        self.step = min([self.step, *steps] if self.step else steps, default=0)
        return True

    def discard(self, number: int) -> None:
        """Discard the image of a number."""
        self.files.pop(number, None)
        self.write_times.pop(number, None)

    def _probe_names(self, last_number: int) -> None:
        """Probe by name for the next image numbers and for missing earlier ones."""
        if self._latest is None or self.path is None or not self.step:
            return
        number, name = self._latest
        found = list(re.finditer(r"[0-9]+", Path(name).stem))[self._column]
        # By steps rather than by ones: numbers may be nanoseconds.
        for n in range(number - N_PROBES * self.step, number + 3 * self.step + 1, self.step):
            if n > last_number and n not in self.files:
                digits = str(n).zfill(len(found[0]))
                self._add_file(n, self.path / f"{name[: found.start()]}{digits}{name[found.end() :]}")

    def _list_folder(self, last_number: int, final: bool) -> None:
        if self.path is None:
            return
        if self._column < 0 and not self._find_column(self.path, final):
            return
        for entry in os.scandir(self.path):
            if os.path.splitext(entry.name)[1].lower() in IMAGE_SUFFIXES and entry.name[0] != ".":
                numbers = re.findall(r"[0-9]+", Path(entry.name).stem)
                if (
                    len(numbers) > self._column
                    and (n := int(numbers[self._column])) > last_number
                    and n not in self.files
                ):
                    self._add_file(n, self.path / entry.name)

    def _find_column(self, folder: Path, final: bool) -> bool:
        """Find which number in the names is the frame number: the last that increases; needs two images."""
        files = image_files(folder)
        if len(files) < (1 if final else 2):
            return False
        numbers = image_numbers(files)
        if numbers is None:
            raise ValueError(f"{folder}: images with frame numbers in their names are expected")
        columns = list(zip(*(map(int, re.findall(r"[0-9]+", file.stem)) for file in files), strict=True))
        self._column = len(columns) - 1 - columns[::-1].index(numbers)
        return True

    def _add_file(self, n: int, file: Path) -> None:
        try:
            written = file.stat().st_mtime
        except OSError:  # missing, or deleted meanwhile
            return
        self.files[n], self.write_times[n] = file, written
        self.newest_time = max(self.newest_time, written)
        if self._latest is None or n > self._latest[0]:
            self._latest = (n, file.name)


class _PendingSet:
    """Images of one frame number, as far as they are readable."""

    def __init__(self, number: int) -> None:
        self.number, self.waiting_since = number, time.monotonic()
        self.images: dict[str, Image] = {}
        self.problems: dict[str, str] = {}
        self._failed: dict[str, tuple[int, int]] = {}

    def read(self, folders: Iterable[_CameraFolder], pool: ThreadPoolExecutor) -> None:
        """Read new images in parallel; retry unreadable files after they have changed."""
        first = not self.images
        todo = [f for f in folders if self.number in f.files and f.camera.name not in self.images]
        list(pool.map(self._read, todo))
        if first and self.images:
            self.waiting_since = time.monotonic()

    def _read(self, folder: _CameraFolder) -> None:
        name, file = folder.camera.name, folder.files[self.number]
        try:
            state = _file_state(file)
            if state == self._failed.get(name):
                return
            self._failed[name] = state
            image = read_image(file, folder.camera.size)
            if _file_state(file) != state:  # still being written
                del self._failed[name]
                return
        except (ValueError, OSError) as error:
            self.problems[name] = f"{error}"
            return
        self.images[name] = image


class _FolderFollower:
    """Yields the frame sets of a growing folder in order, each when complete or after its maximum delay."""

    def __init__(self, recording: GrowingFolder, counter: DropCounter) -> None:
        self._recording, self._counter = recording, counter
        self._folders = [_CameraFolder(camera) for camera in recording.rig]
        self._numbers: deque[int] = deque()
        self._last_number, self._index = -1, -1
        self._last_activity = time.monotonic()  # time of the latest new image
        self._next_search = -np.inf

    def frames(
        self, indices: range, on_problem: Callable[[str], None], stopped: threading.Event
    ) -> Generator[FrameSet, None, None]:
        """Yield frame sets without masks."""
        pending: _PendingSet | None = None
        n_skipped, reported = 0, set[str]()
        has_started = done = False
        with ThreadPoolExecutor(len(self._folders), thread_name_prefix="sylpose-follow") as pool:
            while not stopped.is_set() and self._index + 1 < indices.stop:
                was_done, done = done, (self._recording.path / DONE_FILE).exists()  # first: finds all images before it
                self._find_new(done > was_done or (not self._numbers and (done or self._is_idle())))
                if not self._numbers:
                    if done or self._is_idle():
                        break
                    stopped.wait(POLL_INTERVAL)
                elif self._index + 1 not in indices:
                    self._advance()
                elif self._is_backlogged():
                    n_skipped += not has_started
                    self._drop_set(has_started)
                else:
                    if pending is None or pending.number != self._numbers[0]:
                        pending = _PendingSet(self._numbers[0])
                    pending.read(self._folders, pool)
                    if not self._is_final(pending, done or self._is_idle()):
                        stopped.wait(POLL_INTERVAL)
                        continue
                    if n_skipped and not has_started:
                        on_problem(f"Skipped {n_skipped} frame sets that existed already.")
                    for camera, problem in pending.problems.items():
                        if (
                            camera not in reported and camera not in pending.images
                        ):  # once: a broken disk causes thousands
                            reported.add(camera)
                            on_problem(f"{camera}: {problem}; this and similar later images are skipped.")
                    self._advance(pending)
                    has_started = has_started or bool(pending.images)
                    if pending.images:
                        yield self._frame_set(pending, indices.step)
        if self._index < 0 and not stopped.is_set():
            raise OSError(f"{self._recording.path}: no camera's folder got any image within {self._recording.idle:g} s")

    def _is_idle(self) -> bool:
        return time.monotonic() - self._last_activity > self._recording.idle

    def _find_new(self, final: bool) -> None:
        if any(f.path is None for f in self._folders) and (final or time.monotonic() >= self._next_search):
            found = self._recording.find_camera_folders()
            for folder in self._folders:
                folder.path = folder.path or found.get(folder.camera.name)
            self._next_search = time.monotonic() + MIN_LIST_INTERVAL
        new = [folder for folder in self._folders if folder.find_new(self._last_number, final)]
        if new:
            self._last_activity = time.monotonic()
            self._numbers = deque(sorted({n for folder in self._folders for n in folder.files}))
        for folder in new:
            folder.missed_sets = 0

    def _is_final(self, pending: _PendingSet, is_ended: bool) -> bool:
        """Return whether a frame set is final; `is_ended` if no more images will arrive."""
        step = min((f.step for f in self._folders if f.step), default=1)
        gap = (
            self._last_number >= 0 and 2 * (pending.number - self._last_number) > 3 * step
        )  # intervals in nanoseconds are never exactly equal
        awaited = [f.camera.name for f in self._folders if f.missed_sets < MAX_MISSED_SETS]
        if not gap and pending.images.keys() >= set(awaited):
            return True
        ahead = self._newest_time() - max(
            f.write_times[pending.number] for f in self._folders if pending.number in f.write_times
        )
        return is_ended or max(time.monotonic() - pending.waiting_since, ahead) > self._recording.max_delay

    def _is_backlogged(self) -> bool:
        """Return whether the next frame set but one has waited for too long, by the file times."""
        if self._recording.lossless or len(self._numbers) < 2:
            return False
        n = self._numbers[1]
        return (
            self._newest_time() - max(f.write_times[n] for f in self._folders if n in f.write_times)
            > self._recording.max_delay
        )

    def _newest_time(self) -> float:
        return max(folder.newest_time for folder in self._folders)

    def _drop_set(self, is_counted: bool) -> None:
        for folder in self._folders:
            if is_counted and self._numbers[0] in folder.files:
                self._counter.dropped[folder.camera.name] += 1
        self._advance()

    def _advance(self, delivered: _PendingSet | None = None) -> None:
        self._index += 1
        self._last_number = self._numbers.popleft()
        for folder in self._folders:
            folder.discard(self._last_number)
            if delivered is not None and folder.camera.name not in delivered.images:
                folder.missed_sets += 1
                self._counter.missed[folder.camera.name] += 1

    def _frame_set(self, pending: _PendingSet, every: int) -> FrameSet:
        n = len(self._folders)
        images = tuple(pending.images.get(folder.camera.name) for folder in self._folders)
        rate, unknown = self._recording.rate, (None,) * n
        interval = every / rate if rate else math.nan
        return FrameSet(self._index, self._index / (rate or 1.0), unknown, images, unknown, interval=interval)


def _file_state(file: Path) -> tuple[int, int]:
    status = file.stat()
    return status.st_size, status.st_mtime_ns
