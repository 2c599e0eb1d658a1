"""A value that a thread of its own computes meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import Any, Generic, TypeVar

__all__ = ["Later"]

T = TypeVar("T")


class Later(Generic[T]):
    """What a function returns for some arguments, which nobody may change any more; it begins at once.

    Saved and loaded again, it begins anew, and comes to the same.
    """

    def __init__(self, function: Callable[..., T], *arguments: Any) -> None:
        self._function, self._arguments = function, arguments
        self._future: Future[T] = Future()
        Thread(target=self._run).start()

    def _run(self) -> None:
        try:
            self._future.set_result(self._function(*self._arguments))
        except BaseException as error:  # whoever asks for the value is told
            self._future.set_exception(error)

    def __reduce__(self) -> tuple[Any, ...]:
        return Later, (self._function, *self._arguments)

    def value(self) -> T:
        """Waits for it. Raises what the function raised."""
        return self._future.result()
