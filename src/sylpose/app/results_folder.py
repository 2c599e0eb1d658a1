"""The folder of a run's results: one run at a time, and what an earlier one left there is kept until the new one has ended.

A new run first moves the earlier one's files into a folder in it, which takes its name only when they are all there. It is
removed when the new run has come to its end; where that fails before its first frame they are moved back, and else they
stay there. Whatever is interrupted, and wherever, the next run can tell how far that had come.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from sylpose.app.calibration_refinement import REFINED, REFINED_END
from sylpose.app.checkpoint import CHECKPOINT
from sylpose.app.object_files import CLOUD, OBJECT
from sylpose.app.outputs import RESULT, SUFFIXES, TRACKED, TRACKS
from sylpose.app.run_metadata import SETTINGS, USED, WORLD
from sylpose.atomic_io import beside, output_folder, writing

__all__ = ["EARLIER", "ResultsFolder", "alone_in"]

LOCK = ".lock"
# The earlier results; and while they are moved there or back; and while they are removed.
EARLIER, MOVING, REMOVED = "earlier_results", ".earlier_results.moving", ".earlier_results.removed"
# What a run writes, and `sylpose view` of it; its checkpoint first, since without one nothing goes on from what is half
# there.
_MANY = re.compile(r"overlay(_\d+)?\.mp4|report\.(html|png|svg|pdf)|view_.+\.(tum|csv|png|svg|pdf)")
_NAMES = (CHECKPOINT, *(f"{stem}{end}" for stem in (RESULT, TRACKED) for end in SUFFIXES))
_OWN = (*_NAMES, REFINED, REFINED_END, TRACKS, SETTINGS, USED, WORLD, OBJECT, CLOUD)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Within it no other run writes into the folder; when the process ends, however it does, the next one may.

    Raises:
        ValueError: another run does.
        OSError: naming the folder that cannot be written.
    """
    lock = FileLock(output_folder(folder) / LOCK, timeout=0)
    with suppress(NotImplementedError), writing(folder / LOCK):  # on file systems that know no locks
        try:
            lock.acquire()
        except Timeout:
            raise ValueError(
                f"{folder}: another run writes its results there; wait for its end, or give another folder with --out"
            ) from None
    try:
        yield
    finally:
        try:
            with suppress(OSError):  # on Windows, where nobody can remove what is open
                (folder / LOCK).unlink(missing_ok=True)
        finally:
            lock.release()


class ResultsFolder:
    """Where a run's files go.

    Args:
        path: of the folder.
        objects: names of several objects, which have folders in it; none for one.
    """

    def __init__(self, path: Path, objects: Sequence[str] = ()) -> None:
        self.path = path
        self.folders = [path / name for name in objects] or [path]

    @property
    def has_ended(self) -> bool:
        """Whether a run wrote its files here and came to its end."""
        if (self.path / CHECKPOINT).exists() or (self.path / MOVING).exists() or self._own(self.path / EARLIER):
            return False
        return (self.folders[0] / f"{RESULT}.csv").exists()

    def set_aside(self) -> None:
        """Moves an earlier run's results to where they are kept. Where there are some already, those here are of a run that
        did not come to its end, and are removed.

        Raises:
            OSError: naming a file that cannot be moved, or a folder that is called like one.
        """
        for taken in (folder / name for folder in self.folders for name in _OWN):
            if taken.is_dir():
                raise OSError(f"cannot write {taken}: it is a folder")
        self.recover()
        own = self._own(self.path)
        if self._own(self.path / EARLIER):
            _remove(own)
        elif own:
            self._move(self.path, self.path / MOVING)
            with writing(self.path / EARLIER):
                os.replace(self.path / MOVING, self.path / EARLIER)

    def recover(self) -> None:
        """Ends what was interrupted: results that were being moved come back, those being removed are."""
        self._drop(self.path / REMOVED)
        if (self.path / MOVING).exists():
            self._move(self.path / MOVING, self.path)

    def put_back(self) -> None:
        """Instead of what the new run has written."""
        _remove(self._own(self.path))
        if (self.path / EARLIER).exists():
            with writing(self.path / EARLIER):
                os.replace(self.path / EARLIER, self.path / MOVING)
            self.recover()

    def end(self) -> None:
        """The new results are whole: those before are removed, and what only going on needed."""
        if (self.path / EARLIER).exists():
            with writing(self.path / EARLIER):
                os.replace(self.path / EARLIER, self.path / REMOVED)
            self._drop(self.path / REMOVED)
        _remove([self.path / CHECKPOINT])
        _remove([beside(self.path / CHECKPOINT), *(folder / TRACKS for folder in self.folders)])

    def _own(self, base: Path) -> list[Path]:
        """The files of a run in a folder, or that were moved there."""
        own = {*_OWN, *(beside(Path(name)).name for name in _OWN)}
        found = []
        for folder in dict.fromkeys([self.path, *self.folders]):
            there = base / folder.relative_to(self.path)
            names = sorted(os.listdir(there), key=lambda name: name != CHECKPOINT) if there.is_dir() else []
            found += [there / name for name in names if name in own or _MANY.fullmatch(name)]
        return [file for file in found if file.is_file()]

    def _move(self, old: Path, new: Path) -> None:
        for file in self._own(old):
            to = new / file.relative_to(old)
            output_folder(to.parent)
            with writing(to):
                os.replace(file, to)
        if old != self.path:
            self._empty(old)

    def _drop(self, base: Path) -> None:
        _remove(self._own(base))
        self._empty(base)

    def _empty(self, base: Path) -> None:
        """Removes a folder of moved results, unless somebody has put something else there."""
        for folder in (*self.folders, self.path):
            with suppress(OSError):
                (base / folder.relative_to(self.path)).rmdir()


def _remove(files: Sequence[Path]) -> None:
    for file in files:
        with writing(file):
            file.unlink(missing_ok=True)
