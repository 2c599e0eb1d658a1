"""Threads of BLAS and LAPACK."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

from threadpoolctl import OpenBLASController, ThreadpoolController

_LOCK = Lock()
# The limit of this process, and how many want it now.
_limits = list[Any]()
_count = 0


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Compute with one thread of BLAS: more cost more than they give for small matrices, most of all on a busy machine.

    The number is one for the whole process. It is as before once no thread limits it any more.
    """
    global _count
    with _LOCK:
        if not _count:
            _limits.append(_find_libraries().limit(limits=1, user_api="blas"))
        _count += 1
    try:
        yield
    finally:
        with _LOCK:
            _count -= 1
            if not _count:
                # Otherwise only the thread that began can end it, and no other one can limit it afterwards.
                OpenBLASController.clear_controlling_thread(force=True)
                _limits.pop().restore_original_limits()
                OpenBLASController.clear_controlling_thread(force=True)


@cache
def _find_libraries() -> ThreadpoolController:
    """Find the libraries of NumPy and SciPy, which takes some milliseconds."""
    return ThreadpoolController()
