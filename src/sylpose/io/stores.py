"""Folders and object stores: files by their names below a location."""

from __future__ import annotations

import os
import posixpath
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from sylpose.atomic_io import replace_atomically


class StoredFile(NamedTuple):
    """A file below a location.

    Attributes:
        name: path below the location, with "/".
        size: in bytes.
        tag: changes with the content: an object store's etag, a file's modification time.
        modified: when it was written, seconds since 1970.
    """

    name: str
    size: int
    tag: str
    modified: float


@dataclass(frozen=True)
class Store:
    """A folder or file; `ObjectStore` has the same methods. All raise OSError that names the file.

    A file's name is relative to the location; "" is the location itself.

    Attributes:
        url: the absolute path of a folder; `s3://bucket/prefix` and the like.
    """

    url: str

    def join(self, name: str) -> Store:
        return Store(os.path.normpath(Path(self.url, name)))

    def read(self, name: str) -> bytes | None:
        """Read a file; None if it does not exist."""
        with suppress(FileNotFoundError, NotADirectoryError):
            return Path(self.url, name).read_bytes()
        return None

    def write(self, name: str, content: bytes | Path) -> None:
        """Write a file atomically, replacing an existing one."""
        with replace_atomically(Path(self.url, name)) as path:
            if isinstance(content, bytes):
                path.write_bytes(content)
            else:
                shutil.copyfile(content, path)

    def create(self, name: str, content: bytes) -> bool:
        """Create a file; False if it exists. Of several concurrent attempts only one succeeds."""
        path = Path(self.url, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError), path.open("xb") as file:
            file.write(content)
            return True
        return False

    def remove(self, name: str) -> None:
        """Remove a file, if it exists."""
        Path(self.url, name).unlink(missing_ok=True)

    def files(self) -> list[StoredFile]:
        """Return all files below this location, sorted by name; links are followed, hidden files skipped."""
        found, visited = [], set[str]()
        for where, folders, names in os.walk(self.url, followlinks=True):
            if os.path.realpath(where) in visited:  # circular links
                folders.clear()
                continue
            visited.add(os.path.realpath(where))
            folders[:] = [name for name in folders if not name.startswith(".")]
            for path in (Path(where, name) for name in names if not name.startswith(".")):
                with suppress(FileNotFoundError):  # removed meanwhile, such as a claim
                    if path.is_file():
                        name, stat = path.relative_to(self.url).as_posix(), path.stat()
                        found.append(StoredFile(name, stat.st_size, str(stat.st_mtime_ns), stat.st_mtime))
        return sorted(found)


class ObjectStore(Store):
    """A prefix of an object store, by obstore."""

    def join(self, name: str) -> Store:
        root, path = self._split()
        return ObjectStore(f"{root}{posixpath.normpath(posixpath.join('/', path, name))}".rstrip("/"))

    def read(self, name: str) -> bytes | None:
        with self._errors("read", name) as (client, path), suppress(FileNotFoundError):
            return bytes(client.get(path).bytes())
        return None

    def write(self, name: str, content: bytes | Path) -> None:
        with self._errors("write", name) as (client, path):
            client.put(path, content)

    def create(self, name: str, content: bytes) -> bool:
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        with self._errors("write", name) as (client, path), suppress(AlreadyExistsError, PreconditionError):
            client.put(path, content, mode="create")
            return True
        return False

    def remove(self, name: str) -> None:
        with self._errors("remove", name) as (client, path), suppress(FileNotFoundError):
            client.delete(path)

    def fetch(self, name: str, target: Path) -> None:
        """Copy a file to a local path."""
        target.parent.mkdir(parents=True, exist_ok=True)
        with self._errors("read", name) as (client, path), target.open("wb") as file:
            for part in client.get(path).stream():
                file.write(bytes(part))

    def files(self) -> list[StoredFile]:
        with self._errors("list") as (client, prefix):
            entries = client.list(prefix or None).collect()
        found = []
        for entry in entries:
            name, modified = entry["path"][len(prefix) :].lstrip("/"), entry["last_modified"]
            if name and not any(part.startswith(".") for part in name.split("/")):
                tag = str(entry["e_tag"] or modified.isoformat())
                found.append(StoredFile(name, entry["size"], tag, modified.timestamp()))
        return sorted(found)

    def _split(self, name: str = "") -> tuple[str, str]:
        """Return the bucket's URL, and a file's path in it."""
        scheme, _, location = self.url.partition("://")
        bucket, _, path = f"{location}/{name}".partition("/")
        return f"{scheme}://{bucket}", path.strip("/")

    @contextmanager
    def _errors(self, action: str, name: str = "") -> Iterator[tuple[Any, str]]:
        """Yield the client of the bucket and a file's path in it; describe errors."""
        from obstore.exceptions import BaseError

        root, path = self._split(name)
        try:
            yield _connect(root), path
        except FileNotFoundError:
            raise FileNotFoundError(f"cannot {action} {root}/{path}: no such file") from None
        except (BaseError, NotImplementedError) as error:
            raise OSError(f"cannot {action} {root}/{path}: {_first_line(error)}") from None


def open_store(location: str | Path) -> Store:
    """Return the store of a URL or of a folder's path.

    Raises:
        ValueError: an unsupported URL, or obstore is not installed.
    """
    text = str(location).removeprefix("file://") or "/"
    if not is_url(text):
        return Store(Path(text).expanduser().absolute().as_posix())
    text = text.rstrip("/")
    try:
        _connect("/".join(text.split("/")[:3]))
    except ImportError:
        raise ValueError(f"{text}: object stores need obstore: python3 -m pip install 'sylpose[archive]'") from None
    except Exception as error:  # obstore's errors have no common class with those of a wrong address
        raise ValueError(f"{text}: {_first_line(error)}") from None
    return ObjectStore(text)


def is_url(location: str) -> bool:
    """Return whether a location is a URL, such as `s3://bucket/prefix`, but not `C:\\recordings`."""
    return re.match(r"[A-Za-z][\w+.-]+://", location) is not None


def is_inside(name: str) -> bool:
    """Return whether a file's name below a folder cannot lead out of it."""
    return not PurePath(name).is_absolute() and ".." not in PurePath(name).parts


def resolve_location(location: str, base: Store) -> Store:
    """Resolve a location in a manifest in `base`: a URL, an absolute path, or a path relative to `base`."""
    is_absolute = is_url(location) or Path(location).expanduser().is_absolute()
    return open_store(location) if is_absolute else base.join(location)


@cache
def _connect(root: str) -> Any:
    from obstore.store import MemoryStore, from_url

    # In-memory stores exist in this process only: for tests.
    return MemoryStore() if root.startswith("memory://") else from_url(root)


def _first_line(error: Exception) -> str:
    """Return the error's first line, without the addresses and structures that follow."""
    return str(error).strip().split("\n", 1)[0].rstrip(" {:")
