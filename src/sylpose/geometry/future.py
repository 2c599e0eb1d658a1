"""Values that are computed in background threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class BackgroundResult(Generic[T]):
    """Result of a function call in a background thread; the arguments must not be modified afterwards.

    Calls are executed in order, on at most half of the processor's cores.

    Attributes:
        call: the function and its arguments, from which the call can be repeated.
    """

    def __init__(self, function: Callable[..., T], *arguments: Any) -> None:
        self.call = function, arguments
        self._future: Future[T] = _thread_pool(os.getpid()).submit(function, *arguments)

    def is_known(self) -> bool:
        """Return whether `value` need not wait."""
        return self._future.done()

    def value(self) -> T:
        """Wait for the result and return it, or raise the function's exception."""
        return self._future.result()


@cache
def _thread_pool(process: int) -> ThreadPoolExecutor:  # noqa: ARG001
    """Return the thread pool of this process; a forked process needs its own."""
    return ThreadPoolExecutor(max(1, (os.cpu_count() or 1) // 2))
