"""A value that is computed meanwhile, beside what waits for nothing."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any, Generic, TypeVar

__all__ = ["Later"]

T = TypeVar("T")


class Later(Generic[T]):
    """What a function returns for some arguments, which nobody may change any more; computed in the order of asking, by half
    of the processor's cores at most.

    Attributes:
        asked: the function and its arguments: what begins with these anew comes to the same.
    """

    def __init__(self, function: Callable[..., T], *arguments: Any) -> None:
        self.asked = function, arguments
        self._future: Future[T] = _threads(os.getpid()).submit(function, *arguments)

    def value(self) -> T:
        """Waits for it. Raises what the function raised."""
        return self._future.result()


@cache
def _threads(process: int) -> ThreadPoolExecutor:  # noqa: ARG001
    """Of this process: one that was forked has none of another's."""
    return ThreadPoolExecutor(max(1, (os.cpu_count() or 1) // 2))
