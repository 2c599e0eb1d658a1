"""Results folder of a run: locked for one run at a time, keeping earlier results until the new run has finished.

A new run first moves the earlier files into a subfolder, which gets its final name only when all files are in it. The
subfolder is removed when the new run finishes. If the run fails before its first frame, the files are moved back;
otherwise they stay in the subfolder. After an interruption at any point, the next run can determine the state.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from sylpose.atomic_io import make_output_folder, output_errors, partial_path
from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.io.object_files import CLOUD_FILE, OBJECT_FILE
from sylpose.runs.calibration_refinement import REFINED, REFINED_END
from sylpose.runs.checkpoint import CHECKPOINT
from sylpose.runs.outputs import RESULT, SUFFIXES, TRACKED, TRACKS
from sylpose.runs.run_metadata import ESTIMATED, SETTINGS, USED_CALIBRATION, WORLD

LOCK_FILE = ".lock"
# Subfolders with the earlier results: kept, while being moved there or back, and while being removed.
EARLIER, EARLIER_MOVING, EARLIER_REMOVED = "earlier_results", ".earlier_results.moving", ".earlier_results.removed"
# Files of a run, of `sylpose scan` and of `sylpose view`; the checkpoint is removed first, so that no run resumes from
# incomplete files.
_RUN_FILE_PATTERN = re.compile(
    r"overlay(_\d+)?\.mp4|shape\.(glb|png)|report\.(html|png|svg|pdf)|view_.+\.(tum|csv|png|svg|pdf)"
)
_MAIN_FILES = (CHECKPOINT, *(f"{stem}{end}" for stem in (RESULT, TRACKED) for end in SUFFIXES))
_OTHER_FILES = (REFINED, REFINED_END, *ESTIMATED, TRACKS, SETTINGS, USED_CALIBRATION, WORLD, OBJECT_FILE, CLOUD_FILE)
_RUN_FILES = (*_MAIN_FILES, *_OTHER_FILES)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock the folder against other runs; the lock ends with the process at the latest.

    Raises:
        ValueError: another run holds the lock.
        OSError: the folder cannot be written; the message names it.
    """
    lock = FileLock(make_output_folder(folder) / LOCK_FILE, timeout=0)
    with suppress(NotImplementedError), output_errors(folder / LOCK_FILE):  # file systems without locks
        try:
            lock.acquire()
        except Timeout:
            raise ValueError(
                f"{folder}: another run is writing its results there; wait for its end, or choose another folder with "
                "--out"
            ) from None
    try:
        yield
    finally:
        try:
            with suppress(OSError):  # Windows does not remove open files
                (folder / LOCK_FILE).unlink(missing_ok=True)
        finally:
            lock.release()


def check_output_folder(session: Session | LiveSession, out: Path) -> None:
    """Check that results may be written into a folder.

    Raises:
        ValueError: they would be taken for part of the recording.
    """
    target = Path(os.path.realpath(out))
    if target == Path(os.path.realpath(session.path)):
        raise ValueError(f"--out {out}: this is the recording's folder, where results would be taken for cameras")
    cameras = {name: session.path / name for name in session.rig.names}
    if isinstance(session, Session):
        cameras = {source.camera: source.path for source in session.sources}
    for name, path in cameras.items():
        if Path(os.path.realpath(path)) in (target, *target.parents):
            raise ValueError(f"--out {out}: camera {name} has its images there ({path})")
    if session.masks is not None and Path(os.path.realpath(session.masks)) in (target, *target.parents):
        raise ValueError(f"--out {out}: the masks are there ({session.masks})")


class ResultsFolder:
    """Folder for the files of a run.

    Args:
        path: the folder.
        objects: names of several objects, which get subfolders; empty for one object.
        own: names of files here that the new run uses: they stay.
    """

    def __init__(self, path: Path, objects: Sequence[str] = (), own: Sequence[str] = ()) -> None:
        self.path, self.own = path, own
        self.folders = [path / name for name in objects] or [path]

    @property
    def has_finished(self) -> bool:
        """Return whether a run has written its files here and finished."""
        if (
            (self.path / CHECKPOINT).exists()
            or (self.path / EARLIER_MOVING).exists()
            or self._find_run_files(self.path / EARLIER)
        ):
            return False
        return (self.folders[0] / f"{RESULT}.csv").exists()

    def move_earlier_results(self) -> None:
        """Move an earlier run's results into the subfolder for them.

        If that exists already, the results here are of an unfinished run and are removed.

        Raises:
            OSError: naming a file that cannot be moved, or a folder with the name of a file.
        """
        for path in (folder / name for folder in self.folders for name in _RUN_FILES):
            if path.is_dir():
                raise OSError(f"cannot write {path}: it is a folder")
        self.recover()
        files = self._find_run_files(self.path)
        if self._find_run_files(self.path / EARLIER):
            _remove_files(files)
        elif files:
            self._move(self.path, self.path / EARLIER_MOVING)
            with output_errors(self.path / EARLIER):
                os.replace(self.path / EARLIER_MOVING, self.path / EARLIER)

    def recover(self) -> None:
        """Complete an interrupted operation: move results back that were being moved, finish a removal."""
        self._remove_folder(self.path / EARLIER_REMOVED)
        if (self.path / EARLIER_MOVING).exists():
            self._move(self.path / EARLIER_MOVING, self.path)

    def restore_earlier_results(self) -> None:
        """Remove the new run's files and move the earlier results back, unless they would replace files that stay.

        A calibration that the new run has written stays with them.
        """
        if any((self.path / EARLIER / name).exists() for name in self.own):
            return
        _remove_files(self._find_run_files(self.path))
        if (self.path / EARLIER).exists():
            with output_errors(self.path / EARLIER):
                os.replace(self.path / EARLIER, self.path / EARLIER_MOVING)
            self.recover()

    def end(self) -> None:
        """Finish the run: remove the earlier results and the files that only resuming needs."""
        if (self.path / EARLIER).exists():
            with output_errors(self.path / EARLIER):
                os.replace(self.path / EARLIER, self.path / EARLIER_REMOVED)
            self._remove_folder(self.path / EARLIER_REMOVED)
        _remove_files([self.path / CHECKPOINT])
        _remove_files([partial_path(self.path / CHECKPOINT), *(folder / TRACKS for folder in self.folders)])

    def _find_run_files(self, base: Path) -> list[Path]:
        """Return the files of a run in a folder, or those moved there."""
        names_of_run = {*_RUN_FILES, *(partial_path(Path(name)).name for name in _RUN_FILES)}
        names_of_run -= {*self.own} if base == self.path else set()
        found = []
        for folder in dict.fromkeys([self.path, *self.folders]):
            subfolder = base / folder.relative_to(self.path)
            names = sorted(os.listdir(subfolder), key=lambda name: name != CHECKPOINT) if subfolder.is_dir() else []
            found += [subfolder / name for name in names if name in names_of_run or _RUN_FILE_PATTERN.fullmatch(name)]
        return [file for file in found if file.is_file()]

    def _move(self, old: Path, new: Path) -> None:
        for file in self._find_run_files(old):
            target = new / file.relative_to(old)
            make_output_folder(target.parent)
            with output_errors(target):
                os.replace(file, target)
        if old != self.path:
            self._remove_empty_folders(old)

    def _remove_folder(self, base: Path) -> None:
        _remove_files(self._find_run_files(base))
        self._remove_empty_folders(base)

    def _remove_empty_folders(self, base: Path) -> None:
        """Remove a folder of moved results, unless it contains other files."""
        for folder in (*self.folders, self.path):
            with suppress(OSError):
                (base / folder.relative_to(self.path)).rmdir()


def _remove_files(files: Sequence[Path]) -> None:
    for file in files:
        with output_errors(file):
            file.unlink(missing_ok=True)
