"""Where compiled kernels are kept between processes.

Numba keeps what it has compiled with a digest of the file that a kernel stands in. But a kernel is compiled together with
what it calls and with the numbers that it refers to, wherever these are defined: after an update of one of those files the
kernel would go on as before it. Here all of that is part of the key; files that have nothing to do with a kernel are not.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from functools import cache
from types import CodeType, FunctionType
from typing import Any

import numpy as np
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher

__all__ = ["keep"]

_log = logging.getLogger(__name__)


def keep(dispatcher: Any) -> Any:
    """The kernel: what is compiled of it will be kept for other processes, beside its source or where else it can be. Where
    nothing can be written, every process compiles, and says so."""
    # NUMBA_DISABLE_JIT leaves it a function.
    if type(dispatcher) is not FunctionType:
        try:
            dispatcher._cache = _Cache(dispatcher.py_func)
        except RuntimeError:
            _say_once()
    return dispatcher


class _Cache(FunctionCache):
    """Numba's, for a kernel and all that it is compiled with."""

    def __init__(self, function: FunctionType) -> None:
        numbas: Any = super()  # without types
        numbas.__init__(function)
        self.function = function

    def _index_key(self, sig: object, codegen: object) -> tuple[object, ...]:
        numbas: Any = super()
        # When it is first called, all that it calls is defined.
        return (*numbas._index_key(sig, codegen), digest(self.function))


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


@cache
def _say_once() -> None:
    _log.warning(
        "compiled code cannot be kept, as no folder for it can be written: every start compiles for one to two minutes; "
        "NUMBA_CACHE_DIR=FOLDER says where it may be kept"
    )
