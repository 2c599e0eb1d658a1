"""Common interface to folders and object stores: files by their paths below a location."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import obstore
from obstore.exceptions import (
    AlreadyExistsError,
    BaseError,
    PermissionDeniedError,
    PreconditionError,
    UnauthenticatedError,
)
from obstore.store import LocalStore, MemoryStore, from_url

__all__ = ["Store", "StoredFile", "is_url", "open_store", "resolve_location"]


@dataclass(frozen=True)
class StoredFile:
    """A file below a location.

    Attributes:
        name: path below the location, with "/".
        size: in bytes.
        tag: changes with the content: an object store's etag, a file's modification time.
    """

    name: str
    size: int
    tag: str


@dataclass(frozen=True)
class Store:
    """A folder, or a prefix of an object store; picklable.

    All methods raise OSError with a message that names the unreadable or unwritable file.

    Attributes:
        url: `s3://bucket/prefix` and the like; the absolute path of a folder.
    """

    url: str

    @property
    def folder(self) -> Path | None:
        """Path of the folder; None in object stores."""
        return None if is_url(self.url) else Path(self.url)

    def join(self, name: str) -> Store:
        return Store(f"{self.url.rstrip('/')}/{name}")

    def read(self, name: str) -> bytes | None:
        """Read a file; None if it does not exist."""
        with self._describe_errors("read", name):
            try:
                return bytes(obstore.get(*self._locate(name)).bytes())
            except FileNotFoundError:
                return None

    def write(self, name: str, content: bytes | Path) -> None:
        """Write a file atomically, replacing an existing one."""
        with self._describe_errors("write", name):
            obstore.put(*self._locate(name), content)

    def create(self, name: str, content: bytes) -> bool:
        """Create a file; False if it exists. Of several concurrent attempts only one succeeds."""
        with self._describe_errors("write", name):
            try:
                obstore.put(*self._locate(name), content, mode="create")
            except (AlreadyExistsError, PreconditionError):
                return False
            return True

    def remove(self, name: str) -> None:
        """Remove a file, if it exists."""
        with self._describe_errors("remove", name):
            try:
                obstore.delete(*self._locate(name))
            except FileNotFoundError:
                return

    def fetch(self, name: str, target: Path) -> None:
        """Copy a file to a local path."""
        target.parent.mkdir(parents=True, exist_ok=True)
        with self._describe_errors("read", name), target.open("wb") as file:
            for part in obstore.get(*self._locate(name)).stream():
                file.write(bytes(part))

    def names(self) -> list[str]:
        """Return the names of the files directly in this location, sorted; empty if it does not exist."""
        with self._describe_errors("list"):
            store, prefix = self._locate("")
            found = obstore.list_with_delimiter(store, prefix or None)["objects"]
            return sorted(entry["path"].rpartition("/")[2] for entry in found)

    def files(self) -> list[StoredFile]:
        """Return all files below this location, sorted by name; links are followed, hidden files skipped."""
        with self._describe_errors("list"):
            found = list(_walk(Path(self.url)) if self.folder is not None else self._list_objects())
        return sorted(found, key=lambda file: file.name)

    def _list_objects(self) -> Iterator[StoredFile]:
        store, prefix = self._locate("")
        for entries in obstore.list(store, prefix or None):
            for entry in entries:
                name = entry["path"][len(prefix) :].lstrip("/")
                if name and not _is_hidden(name):
                    yield StoredFile(name, entry["size"], str(entry["e_tag"] or entry["last_modified"].isoformat()))

    def _locate(self, name: str) -> tuple[Any, str]:
        """Return the store, and a file's path in it."""
        if not is_url(self.url):
            return _folder_store(), _relative_to_root(f"{self.url.rstrip('/')}/{name}")
        root, path = _split_url(self.url)
        return _store(root), "/".join(part for part in (path, name) if part)

    @contextmanager
    def _describe_errors(self, action: str, name: str = "") -> Iterator[None]:
        where = f"{self.url}/{name}".rstrip("/")
        try:
            yield
        except FileNotFoundError:
            raise FileNotFoundError(f"cannot {action} {where}: no such file") from None
        except NotImplementedError:
            raise OSError(f"cannot {action} {where}: this kind of store does not support it") from None
        except (PermissionDeniedError, UnauthenticatedError) as error:
            raise PermissionError(f"cannot {action} {where}: {_first_line(error)}") from None
        except BaseError as error:
            kind = PermissionError if "os error 13" in str(error) else OSError
            raise kind(f"cannot {action} {where}: {_first_line(error)}") from None


def open_store(location: str | Path) -> Store:
    """Return the store of a URL or of a folder's path.

    Raises:
        ValueError: an unsupported URL.
    """
    text = str(location)
    if not is_url(text):
        return Store(Path(text).expanduser().absolute().as_posix())
    text = text.rstrip("/")
    if text.startswith("file://"):
        return Store(text.removeprefix("file://") or "/")
    try:
        _store(_split_url(text)[0])
    except BaseError as error:
        raise ValueError(f"{text}: {_first_line(error)}") from None
    return Store(text)


def is_url(location: str) -> bool:
    """Return whether a location is a URL, such as `s3://bucket/prefix`, but not `C:\\recordings`."""
    return re.match(r"[A-Za-z][\w+.-]+://", location) is not None


def resolve_location(location: str, base: Store) -> Store:
    """Resolve a location in a manifest in `base`: a URL, an absolute path, or a path relative to `base`."""
    if is_url(location) or Path(location).expanduser().is_absolute():
        return open_store(location)
    return base.join(location) if base.folder is None else open_store(os.path.normpath(base.folder / location))


def _split_url(url: str) -> tuple[str, str]:
    """Split a URL into its root, such as `s3://bucket`, and the path in it."""
    scheme, _, rest = url.partition("://")
    host, _, path = rest.partition("/")
    return f"{scheme}://{host}", path


@cache
def _store(root: str) -> Any:
    # In-memory stores exist in this process only: for tests.
    return MemoryStore() if root.startswith("memory://") else from_url(root)


@cache
def _folder_store() -> Any:
    return LocalStore()


def _relative_to_root(path: str) -> str:
    return Path(path).as_posix().lstrip("/")


def _walk(folder: Path) -> Iterator[StoredFile]:
    visited: set[str] = set()
    for where, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(where)
        if real in visited:  # circular links
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in names:
            path = Path(where, name)
            if not name.startswith(".") and path.is_file():
                stat = path.stat()
                yield StoredFile(path.relative_to(folder).as_posix(), stat.st_size, str(stat.st_mtime_ns))


def _is_hidden(name: str) -> bool:
    return any(part.startswith(".") for part in name.split("/"))


def _first_line(error: Exception) -> str:
    """Return the error's first line, without the addresses and structures that follow."""
    return str(error).strip().split("\n", 1)[0].rstrip(" {:")
