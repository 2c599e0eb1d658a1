"""Where compiled kernels are kept between processes.

Numba keeps what it has compiled with a digest of the file that a kernel stands in. But a kernel is compiled together with
what it calls and with the numbers that it refers to, wherever these are defined: after an update of one of those files the
kernel would go on as before it. Here all of that is part of the key; files that have nothing to do with a kernel are not.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import numpy as np
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

from sylpose.geometry.cache_folders import CHOSEN, folders_of, place_of

__all__ = ["announced", "folder_of", "is_kept", "keep"]

# What users of the library see without asking for it: a minute or two without a word looks like a program that hangs.
_log = logging.getLogger("sylpose")


def keep(dispatcher: Any) -> Any:
    """The kernel: what is compiled of it will be kept for other processes, where `folders_of` says. Where nothing can be
    written every process compiles what is not there, and says so."""
    # NUMBA_DISABLE_JIT leaves it a function.
    if type(dispatcher) is not FunctionType:
        with suppress(RuntimeError):  # its source is no file: Numba keeps nothing
            dispatcher._cache = _Cache(dispatcher.py_func)
    return dispatcher


def is_kept(dispatcher: Any) -> bool:
    """Whether a kernel as it is now, with all that it is compiled with, is kept for this processor."""
    its = getattr(dispatcher, "_cache", None)
    return isinstance(its, _Cache) and its.has_any(dispatcher.targetctx.codegen())


def folder_of(dispatcher: Any) -> Path | None:
    """Where what is compiled of a kernel will be kept; None if nowhere."""
    its = getattr(dispatcher, "_cache", None)
    return its.kept_in if isinstance(its, _Cache) else None


class _Locator:
    """What Numba asks of a locator, of the folder that can be written or else of the first choice."""

    def __init__(self, function: FunctionType, source: Path) -> None:
        self.folders, self.kept_in = folders_of(source)
        self._source, self._line = source, function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: FunctionType, file: str) -> _Locator | None:
        return cls(function, Path(file)) if Path(file).is_file() else None

    def get_cache_path(self) -> str:
        return str(self.kept_in or self.folders[0])

    def ensure_cache_path(self) -> None:
        Path(self.get_cache_path()).mkdir(parents=True, exist_ok=True)

    def get_source_stamp(self) -> str:
        return _content(self._source)

    def get_disambiguator(self) -> str:
        return str(self._line)


@cache
def _content(source: Path) -> str:
    return hashlib.sha256(source.read_bytes()).hexdigest()


class _Impl(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 as Numba has it


class _Cache(FunctionCache):
    """Numba's, for a kernel and all that it is compiled with, read from several folders. A file in them that is damaged, or
    cannot be read or written, costs no more than a kernel that is compiled once more."""

    _impl_class = _Impl

    def __init__(self, function: FunctionType) -> None:
        numbas: Any = super()  # without types
        numbas.__init__(function)
        self.function = function
        locator, name = self._impl.locator, self._impl.filename_base
        own = Path(locator.get_cache_path())  # of another kind, where NUMBA_CACHE_LOCATOR_CLASSES asks for it
        self.kept_in: Path | None = getattr(locator, "kept_in", own)
        index: Any = IndexDataCacheFile
        stamp = locator.get_source_stamp()
        self.files = [index(str(folder), name, stamp) for folder in getattr(locator, "folders", (own,))]

    def has_any(self, codegen: Any) -> bool:
        of, machine = digest(self.function), codegen.magic_tuple()
        return any(key[1] == machine and key[-1] == of for file in self.files for key in _keys(file))

    def _index_key(self, sig: object, codegen: object) -> tuple[object, ...]:
        numbas: Any = super()
        # When it is first called, all that it calls is defined.
        return (*numbas._index_key(sig, codegen), digest(self.function))

    def _load_overload(self, sig: object, target_context: Any) -> Any:
        key = self._index_key(sig, target_context.codegen())
        for file in self.files:
            if (data := _read(file, key)) is not None:
                return self._impl.rebuild(target_context, data)
        _announce(self.kept_in)
        return None

    def _save_overload(self, sig: object, data: Any) -> None:
        if self.kept_in is None:
            return
        numbas: Any = super()
        try:
            numbas._save_overload(sig, data)
        except OSError as error:  # the disk is full, the folder is gone
            _say_not_kept(self.kept_in, error.strerror or str(error))


def _read(file: Any, key: object) -> Any:
    """What is kept under a key; None for what is not there or cannot be read."""
    try:
        return file.load(key)
    except OSError:  # of another user, who kept it to himself
        return None
    except Exception:
        # Whatever a file raises that ends in the middle: what it is an index of is written anew.
        _forget(file)
        return None


def _keys(file: Any) -> list[Any]:
    """Of what is kept; none where the index cannot be read."""
    try:
        return list(file._load_index())
    except Exception:  # as above
        return []


def _forget(file: Any) -> None:
    with suppress(OSError):  # what cannot be written does not have to be mended either
        file.flush()


def digest(function: Callable[..., object]) -> str:
    """Of a kernel's code, that of all kernels which it calls, and the values that they refer to."""
    found: dict[str, bytes] = {}
    _add(function, found)
    return hashlib.sha256(b"".join(name.encode() + found[name] for name in sorted(found))).hexdigest()


def _add(function: Any, found: dict[str, bytes]) -> None:
    name = f"{function.__module__}.{function.__qualname__}"
    if name in found:
        return
    codes = _codes(function.__code__)
    found[name] = b"".join(code.co_code + repr(_plain(code)).encode() for code in codes)
    for each in sorted({each for code in codes for each in code.co_names}):
        value = function.__globals__.get(each)
        if isinstance(value, Dispatcher):
            _add(value.py_func, found)
        elif isinstance(value, FunctionType) and value.__module__ == function.__module__:
            _add(value, found)
        elif isinstance(value, bool | int | float | complex | str | tuple):
            found[name] += f"{each}={value!r}".encode()
        elif isinstance(value, np.ndarray):
            found[name] += f"{each}={value.dtype}{value.shape}".encode() + value.tobytes()
        elif isinstance(value, type) and hasattr(value, "_fields"):
            found[name] += f"{each}={value._fields}".encode()


def _codes(code: CodeType) -> list[CodeType]:
    """A function's code, and that of functions inside it."""
    return [code, *(each for c in code.co_consts if isinstance(c, CodeType) for each in _codes(c))]


def _plain(code: CodeType) -> list[object]:
    return [code.co_names, code.co_varnames, *(c for c in code.co_consts if not isinstance(c, CodeType))]


_said: set[str] = set()  # by this process


def announced() -> bool:
    """To be called by who says himself that it compiles, and shows how far it is: it is not said again. Tells whether it
    has been said before."""
    before = "compiling" in _said
    _said.add("compiling")
    return before


def _announce(kept_in: Path | None) -> None:
    if announced():
        return
    often, where = "after an installation or an update", f"kept in {kept_in and place_of(kept_in)}"
    if kept_in is None:
        often, where = "at every start", f"no folder can be written to keep it in, {CHOSEN}=FOLDER names one"
    _log.warning("sylpose compiles for this computer, for up to two minutes %s; %s", often, where)


def _say_not_kept(folder: Path, why: str) -> None:
    if "not kept" not in _said:
        _said.add("not kept")
        _log.warning(
            "what sylpose compiles cannot be kept in %s: %s; %s=FOLDER names another", folder, why.lower(), CHOSEN
        )
