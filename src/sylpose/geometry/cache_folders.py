"""The folders that compiled kernels may be kept in, and which of them can be written.

What is loaded from there is run. So a folder that this program chooses by itself belongs to who runs it, and nobody else can
write into it; the one beside the sources is as much trusted as these are, and one that `NUMBA_CACHE_DIR` names is trusted.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

__all__ = ["CHOSEN", "folders_of", "is_writable", "place_of"]

# The environment variable by which Numba, too, is told where to keep what it compiles.
CHOSEN = "NUMBA_CACHE_DIR"


def folders_of(source: Path) -> tuple[tuple[Path, ...], Path | None]:
    """Where what is compiled of a source file may be.

    Returns:
        the folders to look in, the first choice first, and the one of them that new files go into: the first that can be
        written, and the last to look in; None where none can be.
    """
    return _folders(source.parent, os.environ.get(CHOSEN))


@cache
def _folders(package: Path, chosen: str | None) -> tuple[tuple[Path, ...], Path | None]:
    looked_in: list[Path] = []
    for folder in _candidates(package, chosen):
        looked_in.append(folder)
        if is_writable(folder):
            return tuple(looked_in), folder
    return tuple(looked_in), None


def _candidates(package: Path, chosen: str | None) -> Iterator[Path]:
    """Beside the sources of a package, in the user's cache, in the temporary folder; before all what the user chose."""
    # Several installations, and files of the same name, are kept apart by where they are.
    own = f"{package.name}_{hashlib.sha256(str(package.resolve()).encode()).hexdigest()[:16]}"
    if chosen:
        yield Path(chosen).absolute() / own
    yield package / "__pycache__"
    for base in _of_the_user():
        if _is_ours(base):
            yield base / own


def _of_the_user() -> Iterator[Path]:
    """Folders of whoever runs this that survive it, or might."""
    if (caches := _caches()) is not None:
        yield caches / "sylpose"
    with suppress(OSError):  # there may be none
        user = str(os.getuid()) if hasattr(os, "getuid") else "user"  # Windows: the folder is the user's own
        folder = Path(tempfile.gettempdir())
        if folder != Path.cwd():  # what Python takes where there is none: the user's data
            yield folder / f"sylpose-{user}"


def _caches() -> Path | None:
    """The user's folder for what can be made anew; None for who has no home."""
    home = os.path.expanduser("~")  # as it is where nobody knows
    if sys.platform == "win32":
        said, usual = os.environ.get("LOCALAPPDATA"), Path(home, "AppData", "Local")
    elif sys.platform == "darwin":
        said, usual = None, Path(home, "Library", "Caches")
    else:
        said, usual = os.environ.get("XDG_CACHE_HOME"), Path(home, ".cache")
    folder = Path(said) if said else usual
    return folder if folder.is_absolute() else None


@cache
def _is_ours(base: Path) -> bool:
    """Whether a folder, made where it is missing, is nobody else's: on Windows what is below the user's profile is not."""
    try:
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = base.lstat()
    except OSError:
        return False
    if not hasattr(os, "getuid"):
        return True
    others = stat.S_IWGRP | stat.S_IWOTH
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & others


def place_of(folder: Path) -> Path:
    """What to call one of the folders, each of which is for one package's files: what they are all in."""
    return Path(__file__).parents[1] if folder.name == "__pycache__" else folder.parent


@cache
def is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made where it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # What permissions say is not all: root may write what it likes, but not on a disk that is mounted read-only.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True
