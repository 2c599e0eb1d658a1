"""Folders and object stores behind one small interface: files by their names below a place."""

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

__all__ = ["File", "Place", "is_url", "place", "resolved"]


@dataclass(frozen=True)
class File:
    """A file of a place.

    Attributes:
        name: path below the place, with "/".
        size: in bytes.
        tag: changes when the content does: an object store's etag, a folder's time of last change.
    """

    name: str
    size: int
    tag: str


@dataclass(frozen=True)
class Place:
    """A folder, or a prefix of an object store; can be sent to other processes.

    Everything raises OSError with a sentence that names what could not be read or written.

    Attributes:
        url: `s3://bucket/prefix` and the like; the absolute path of a folder.
    """

    url: str

    @property
    def folder(self) -> Path | None:
        """None in object stores."""
        return None if is_url(self.url) else Path(self.url)

    def below(self, name: str) -> Place:
        return Place(f"{self.url.rstrip('/')}/{name}")

    def read(self, name: str) -> bytes | None:
        """None where there is no such file."""
        with self._spoken("read", name):
            try:
                return bytes(obstore.get(*self._at(name)).bytes())
            except FileNotFoundError:
                return None

    def write(self, name: str, content: bytes | Path) -> None:
        """The file appears whole, in place of an older one."""
        with self._spoken("write", name):
            obstore.put(*self._at(name), content)

    def create(self, name: str, content: bytes) -> bool:
        """False where there is such a file already: of several that try at once, one succeeds."""
        with self._spoken("write", name):
            try:
                obstore.put(*self._at(name), content, mode="create")
            except (AlreadyExistsError, PreconditionError):
                return False
            return True

    def remove(self, name: str) -> None:
        """Nothing happens where there is no such file."""
        with self._spoken("remove", name):
            try:
                obstore.delete(*self._at(name))
            except FileNotFoundError:
                return

    def fetch(self, name: str, target: Path) -> None:
        """Copies a file into a folder's."""
        target.parent.mkdir(parents=True, exist_ok=True)
        with self._spoken("read", name), target.open("wb") as file:
            for part in obstore.get(*self._at(name)).stream():
                file.write(bytes(part))

    def names(self) -> list[str]:
        """Of the files directly here, sorted; none where there is nothing."""
        with self._spoken("list"):
            store, prefix = self._at("")
            found = obstore.list_with_delimiter(store, prefix or None)["objects"]
            return sorted(entry["path"].rpartition("/")[2] for entry in found)

    def files(self) -> list[File]:
        """All below, sorted by name; a folder's links are followed, hidden files are left out."""
        with self._spoken("list"):
            found = list(_walk(Path(self.url)) if self.folder is not None else self._listed())
        return sorted(found, key=lambda file: file.name)

    def _listed(self) -> Iterator[File]:
        store, prefix = self._at("")
        for entries in obstore.list(store, prefix or None):
            for entry in entries:
                name = entry["path"][len(prefix) :].lstrip("/")
                if name and not _hidden(name):
                    yield File(name, entry["size"], str(entry["e_tag"] or entry["last_modified"].isoformat()))

    def _at(self, name: str) -> tuple[Any, str]:
        """The store, and a file's path in it."""
        if not is_url(self.url):
            return _folder_store(), _absolute(f"{self.url.rstrip('/')}/{name}")
        root, path = _split(self.url)
        return _store(root), "/".join(part for part in (path, name) if part)

    @contextmanager
    def _spoken(self, what: str, name: str = "") -> Iterator[None]:
        where = f"{self.url}/{name}".rstrip("/")
        try:
            yield
        except FileNotFoundError:
            raise FileNotFoundError(f"cannot {what} {where}: no such file") from None
        except NotImplementedError:
            raise OSError(f"cannot {what} {where}: this kind of store cannot do that") from None
        except (PermissionDeniedError, UnauthenticatedError) as error:
            raise PermissionError(f"cannot {what} {where}: {_first_line(error)}") from None
        except BaseError as error:
            kind = PermissionError if "os error 13" in str(error) else OSError
            raise kind(f"cannot {what} {where}: {_first_line(error)}") from None


def place(where: str | Path) -> Place:
    """A place of a URL, or of a folder's path.

    Raises:
        ValueError: a URL of no known kind.
    """
    text = str(where)
    if not is_url(text):
        return Place(Path(text).expanduser().absolute().as_posix())
    text = text.rstrip("/")
    if text.startswith("file://"):
        return Place(text.removeprefix("file://") or "/")
    try:
        _store(_split(text)[0])
    except BaseError as error:
        raise ValueError(f"{text}: {_first_line(error)}") from None
    return Place(text)


def is_url(where: str) -> bool:
    """`s3://bucket/prefix`, but not `C:\\recordings`."""
    return re.match(r"[A-Za-z][\w+.-]+://", where) is not None


def resolved(where: str, base: Place) -> Place:
    """What a manifest in `base` calls `where`: a URL, an absolute path, or a path from there."""
    if is_url(where) or Path(where).expanduser().is_absolute():
        return place(where)
    return base.below(where) if base.folder is None else place(os.path.normpath(base.folder / where))


def _split(url: str) -> tuple[str, str]:
    """`s3://bucket` and the path in it."""
    scheme, _, rest = url.partition("://")
    host, _, path = rest.partition("/")
    return f"{scheme}://{host}", path


@cache
def _store(root: str) -> Any:
    # In this process only: for tests and trials.
    return MemoryStore() if root.startswith("memory://") else from_url(root)


@cache
def _folder_store() -> Any:
    return LocalStore()


def _absolute(path: str) -> str:
    return Path(path).as_posix().lstrip("/")


def _walk(folder: Path) -> Iterator[File]:
    seen: set[str] = set()
    for where, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(where)
        if real in seen:  # links in a circle
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in names:
            path = Path(where, name)
            if not name.startswith(".") and path.is_file():
                stat = path.stat()
                yield File(path.relative_to(folder).as_posix(), stat.st_size, str(stat.st_mtime_ns))


def _hidden(name: str) -> bool:
    return any(part.startswith(".") for part in name.split("/"))


def _first_line(error: Exception) -> str:
    """Without the addresses and structures that follow it."""
    return str(error).strip().split("\n", 1)[0].rstrip(" {:")
