"""Compilation of kernels that others call, and disk cache of compiled kernels.

Numba optimizes a function together with all that it calls, and again in each of its callers. Half of the time of
compilation is saved by translating the callees only, and by optimizing each kernel that Python calls, with all below it,
once.

Numba keys its cache by a digest of the kernel's source file. But a kernel is compiled together with the functions that
it calls and the constants that it refers to, wherever they are defined: after an update of those files Numba would load
an outdated kernel. Here they are part of the key; unrelated files are not.

Code loaded from the cache's folder is executed. So a folder that is chosen automatically must belong to the user and
must not be writable by others. The folder next to the sources is as trustworthy as the sources, and one set by
`NUMBA_CACHE_DIR` is accepted as is.

Wheels for one platform contain kernels that were compiled for any of its processors. They are loaded where nothing was
compiled for this very processor, if Numba has the version that compiled them.
"""

from __future__ import annotations

import hashlib
import logging
import os
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import numpy as np
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.dispatcher import Dispatcher

# Visible by default: one or two minutes without output would look like a hang.
_log = logging.getLogger("sylpose")


# The package, and the folder of the compiled kernels of its subpackages in a wheel (derived).
PACKAGE = Path(__file__).parents[1]
SHIPPED_FOLDER = PACKAGE / "_kernels"
# LLVM's name of the processor that they are compiled for: any of the architecture.
PORTABLE_CPU = "generic"


def enable_cache(dispatcher: Any) -> Any:
    """Enable the disk cache of a kernel, in the folder of `find_cache_folders`, and return the kernel.

    If no folder is writable, every process compiles missing kernels and logs it.
    """
    # With NUMBA_DISABLE_JIT it is a plain function.
    if type(dispatcher) is not FunctionType:
        with suppress(RuntimeError):  # without a source file Numba caches nothing
            dispatcher._cache = _KernelCache(dispatcher.py_func)
    return dispatcher


def is_cached(dispatcher: Any) -> bool:
    """Return whether the current kernel, with its dependencies, is cached for this processor."""
    cache_object = getattr(dispatcher, "_cache", None)
    return isinstance(cache_object, _KernelCache) and cache_object.has_any(dispatcher.targetctx.codegen())


def cache_folder(dispatcher: Any) -> Path | None:
    """Return the folder of a kernel's cache; None without one."""
    cache_object = getattr(dispatcher, "_cache", None)
    return cache_object.kept_in if isinstance(cache_object, _KernelCache) else None


def is_optimizing() -> bool:
    """Return whether Numba optimizes compiled code; otherwise no kernel that calls another one can be cached.

    Its code then contains the callee's address in this process. The other kernels are not cached either: they would slow
    down later processes, which optimize.
    """
    return bool(vars(config)["OPT"])


class _Locator:
    """Numba cache locator for the writable folder, or else the first choice."""

    def __init__(self, function: FunctionType, source: Path) -> None:
        self.folders, self.kept_in = find_cache_folders(source)
        self._source, self._line = source, function.__code__.co_firstlineno
        self._py_file = str(source)  # named by Numba's warning about a function that it cannot cache

    @classmethod
    def from_function(cls, function: FunctionType, file: str) -> _Locator | None:
        return cls(function, Path(file)) if Path(file).is_file() else None

    def get_cache_path(self) -> str:
        return str(self.kept_in or self.folders[0])

    def ensure_cache_path(self) -> None:
        Path(self.get_cache_path()).mkdir(parents=True, exist_ok=True)

    def get_source_stamp(self) -> str:
        return _hash_file(self._source)

    def get_disambiguator(self) -> str:
        return str(self._line)


class _CalleeLibrary(JITCodeLibrary):
    """Code of a function that compiled functions link with theirs and optimize; Python cannot call it."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        base: Any = super()
        base._finalize_dynamic_globals()
        self._finalized = True


# These methods are private: a version of Numba without them optimizes callees as well.
_REPLACED = "_optimize_final_module", "_finalize_final_module", "_finalize_dynamic_globals"
_CAN_POSTPONE = all(hasattr(JITCodeLibrary, name) for name in _REPLACED)


def set_callee(dispatcher: Any, callee: Any) -> None:
    """Let kernels that call a kernel link with the code of another dispatcher of the same function.

    The callee is only translated: its callers optimize it, with what Numba compiles for it, such as `numpy.empty`. So
    Python must not call it, nor a function of `numba.njit` that it calls: kernels call only kernels and what Numba itself
    provides.

    Args:
        dispatcher: of the kernel, called by Python.
        callee: of the same function, called by kernels only.
    """
    # A kernel that calls itself is compiled by the callee.
    dispatcher.get_overload, dispatcher._compiling_counter = callee.get_overload, callee._compiling_counter
    if not _CAN_POSTPONE:
        return
    compile_dispatcher, compile_callee = dispatcher._compiler.compile, callee._compiler.compile
    codegen = dispatcher.targetctx.codegen()

    def compile_for_callers(args: object, return_type: object) -> Any:
        # Numba holds its compiler lock.
        before = codegen._library_class, codegen.set_env
        codegen._library_class = _CalleeLibrary
        codegen.set_env = lambda *_: None  # there is no machine code to be given an environment
        try:
            return compile_callee(args, return_type)
        finally:
            codegen._library_class, codegen.set_env = before

    def compile_with_callees(args: object, return_type: object) -> Any:
        compiled = compile_dispatcher(args, return_type)
        # Numba sets these only where it loads a kernel from the cache: errors with values need them.
        for environment in compiled._find_referenced_environments():
            codegen.set_env(environment.env_name, environment)
        return compiled

    dispatcher._compiler.compile, callee._compiler.compile = compile_with_callees, compile_for_callers


@cache
def _hash_file(source: Path) -> str:
    return hashlib.sha256(source.read_bytes()).hexdigest()


class _CacheImpl(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 as in Numba


class _KernelCache(FunctionCache):
    """Numba's cache, keyed by a kernel and its dependencies, and read from several folders.

    Files that are damaged, unreadable or not writable only cause the kernel to be compiled again.
    """

    _impl_class = _CacheImpl

    def __init__(self, function: FunctionType) -> None:
        base: Any = super()  # without types
        base.__init__(function)
        self.function = function
        locator, name = self._impl.locator, self._impl.filename_base
        own_folder = Path(locator.get_cache_path())  # of another class, if NUMBA_CACHE_LOCATOR_CLASSES is set
        self.kept_in: Path | None = getattr(locator, "kept_in", own_folder)
        if not is_optimizing():
            self.kept_in = None
        index: Any = IndexDataCacheFile
        stamp = locator.get_source_stamp()
        self.files = [index(str(folder), name, stamp) for folder in getattr(locator, "folders", (own_folder,))]
        source = Path(function.__code__.co_filename).parent
        self.shipped = []
        if source.is_relative_to(PACKAGE) and SHIPPED_FOLDER.is_dir():
            self.shipped = [index(str(SHIPPED_FOLDER / source.relative_to(PACKAGE)), name, stamp)]

    def has_any(self, codegen: Any) -> bool:
        kernel_digest, places = compute_digest(self.function), self._list_places(codegen.magic_tuple())
        return any(key[1] == cpu and key[-1] == kernel_digest for file, cpu in places for key in _list_keys(file))

    def _list_places(self, machine: tuple[str, str, str]) -> list[tuple[Any, tuple[str, str, str]]]:
        """Return the files to search in, each with the machine that its kernels are for: platform, processor, features."""
        portable = machine[0], PORTABLE_CPU, ""
        return [*((file, machine) for file in self.files), *((file, portable) for file in self.shipped)]

    def _index_key(self, sig: object, codegen: object) -> tuple[Any, ...]:
        base: Any = super()
        # On the first call, all its dependencies are defined.
        return (*base._index_key(sig, codegen), compute_digest(self.function))

    def _load_overload(self, sig: object, target_context: Any) -> Any:
        key = self._index_key(sig, target_context.codegen())
        for file, machine in self._list_places(key[1]):
            if (data := _load_entry(file, (key[0], machine, *key[2:]))) is not None:
                return self._impl.rebuild(target_context, data)
        _log_compilation(self.kept_in)
        return None

    def _save_overload(self, sig: object, data: Any) -> None:
        if self.kept_in is None:
            return
        base: Any = super()
        try:
            base._save_overload(sig, data)
        except OSError as error:  # the disk is full, the folder is gone
            if "not kept" not in _logged:
                _logged.add("not kept")
                reason = (error.strerror or str(error)).lower()
                text = "compiled code cannot be cached in %s: %s; %s=FOLDER sets another folder"
                _log.warning(text, self.kept_in, reason, CACHE_DIR_VARIABLE)


def _load_entry(file: Any, key: object) -> Any:
    """Load the entry of a key; None if it is missing or unreadable."""
    try:
        return file.load(key)
    except OSError:  # owned by another user
        return None
    except Exception:
        # A truncated file can raise anything: its index is reset, unless it is read-only.
        with suppress(OSError):
            file.flush()
        return None


def _list_keys(file: Any) -> list[Any]:
    """Return the keys of the entries; none if the index is unreadable."""
    try:
        return list(file._load_index())
    except Exception:  # as above
        return []


def compute_digest(function: Callable[..., object]) -> str:
    """Return the digest of a kernel's code, of all kernels that it calls, and of the values that they refer to."""
    digests: dict[str, bytes] = {}
    _add_digest(function, digests)
    return hashlib.sha256(b"".join(name.encode() + digests[name] for name in sorted(digests))).hexdigest()


def _add_digest(function: Any, digests: dict[str, bytes]) -> None:
    name = f"{function.__module__}.{function.__qualname__}"
    if name in digests:
        return
    codes = _nested_codes(function.__code__)
    digests[name] = b"".join(code.co_code + repr(_comparable_parts(code)).encode() for code in codes)
    for name_used in sorted({name_used for code in codes for name_used in code.co_names}):
        value = function.__globals__.get(name_used)
        if isinstance(value, Dispatcher):
            _add_digest(value.py_func, digests)
        elif isinstance(value, FunctionType) and value.__module__ == function.__module__:
            _add_digest(value, digests)
        elif isinstance(value, bool | int | float | complex | str | tuple):
            digests[name] += f"{name_used}={value!r}".encode()
        elif isinstance(value, np.ndarray):
            digests[name] += f"{name_used}={value.dtype}{value.shape}".encode() + value.tobytes()
        elif isinstance(value, type) and hasattr(value, "_fields"):
            digests[name] += f"{name_used}={value._fields}".encode()


def _nested_codes(code: CodeType) -> list[CodeType]:
    """Return a function's code, and that of its inner functions."""
    return [code, *(inner for c in code.co_consts if isinstance(c, CodeType) for inner in _nested_codes(c))]


def _comparable_parts(code: CodeType) -> list[object]:
    return [code.co_names, code.co_varnames, *(c for c in code.co_consts if not isinstance(c, CodeType))]


_logged: set[str] = set()  # messages logged by this process


def mark_announced() -> bool:
    """Mark compilation as announced, for callers that show its progress, and return whether it was before."""
    was_announced = "compiling" in _logged
    _logged.add("compiling")
    return was_announced


def _log_compilation(kept_in: Path | None) -> None:
    if not mark_announced():
        _log.warning("sylpose compiles its kernels for up to two minutes %s", describe_compilation(kept_in))


def describe_compilation(kept_in: Path | None) -> str:
    """Return when kernels are compiled, and where they are kept: in a cache folder, or why nowhere and the remedy."""
    if kept_in is not None:
        return f"after an installation or an update; cached in {display_folder(kept_in)}"
    if not is_optimizing():
        return "at every start, as NUMBA_OPT=0 is set: unset it"
    return f"at every start, as no folder is writable for their cache: set {CACHE_DIR_VARIABLE}=FOLDER"


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
