"""Cache folders for compiled kernels, and which of them are writable.

Code loaded from these folders is executed. So a folder that is chosen automatically must belong to the user and must
not be writable by others. The folder next to the sources is as trustworthy as the sources, and one set by
`NUMBA_CACHE_DIR` is accepted as is.
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

__all__ = ["CACHE_DIR_VARIABLE", "display_folder", "find_cache_folders", "is_writable"]

# Environment variable that also sets Numba's cache folder.
CACHE_DIR_VARIABLE = "NUMBA_CACHE_DIR"


def find_cache_folders(source: Path) -> tuple[tuple[Path, ...], Path | None]:
    """Return the cache folders for compiled code of a source file.

    Returns:
        the folders to search, in order of preference, and the first writable one of them, which is the last to search
        and receives new files; None if none is writable.
    """
    return _find_cache_folders(source.parent, os.environ.get(CACHE_DIR_VARIABLE))


@cache
def _find_cache_folders(package: Path, chosen: str | None) -> tuple[tuple[Path, ...], Path | None]:
    searched: list[Path] = []
    for folder in _candidates(package, chosen):
        searched.append(folder)
        if is_writable(folder):
            return tuple(searched), folder
    return tuple(searched), None


def _candidates(package: Path, chosen: str | None) -> Iterator[Path]:
    """Yield the candidate folders in order of preference.

    The one that the user set, then those next to the package's sources, in the user's cache, and in the temporary
    folder.
    """
    # The hash separates installations and files of the same name.
    package_folder = f"{package.name}_{hashlib.sha256(str(package.resolve()).encode()).hexdigest()[:16]}"
    if chosen:
        yield Path(chosen).absolute() / package_folder
    yield package / "__pycache__"
    for base in _user_folders():
        if _is_private(base):
            yield base / package_folder


def _user_folders() -> Iterator[Path]:
    """Yield folders of the current user that persist after the process, if possible."""
    if (caches := _user_cache_folder()) is not None:
        yield caches / "sylpose"
    with suppress(OSError):  # without a temporary folder
        user = str(os.getuid()) if hasattr(os, "getuid") else "user"  # Windows: the folder belongs to the user
        folder = Path(tempfile.gettempdir())
        if folder != Path.cwd():  # Python's fallback, which contains the user's data
            yield folder / f"sylpose-{user}"


def _user_cache_folder() -> Path | None:
    """Return the user's cache folder; None for a user without a home."""
    home = os.path.expanduser("~")  # unchanged if unknown
    if sys.platform == "win32":
        configured, default = os.environ.get("LOCALAPPDATA"), Path(home, "AppData", "Local")
    elif sys.platform == "darwin":
        configured, default = None, Path(home, "Library", "Caches")
    else:
        configured, default = os.environ.get("XDG_CACHE_HOME"), Path(home, ".cache")
    folder = Path(configured) if configured else default
    return folder if folder.is_absolute() else None


@cache
def _is_private(base: Path) -> bool:
    """Return whether a folder, created if missing, belongs to the user alone; assumed on Windows."""
    try:
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        info = base.lstat()
    except OSError:
        return False
    if not hasattr(os, "getuid"):
        return True
    others = stat.S_IWGRP | stat.S_IWOTH
    return stat.S_ISDIR(info.st_mode) and info.st_uid == os.getuid() and not info.st_mode & others


def display_folder(folder: Path) -> Path:
    """Return the folder to display for a package's cache folder: its parent."""
    return Path(__file__).parents[1] if folder.name == "__pycache__" else folder.parent


@cache
def is_writable(folder: Path) -> bool:
    """Return whether files can be created in a folder, which is created if missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Permissions are not sufficient: root ignores them, but not a read-only mount.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True
