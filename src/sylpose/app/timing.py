"""Where the time goes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import TypeVar

__all__ = ["Clock"]

T = TypeVar("T")


@dataclass(eq=False)
class Clock:
    """Seconds that the caller's thread has spent on each part."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """The block's time counted."""
        begin = perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - begin

    def around(self, name: str, items: Iterable[T]) -> Iterator[T]:
        """The items, with the time until each of them counted."""
        iterator = iter(items)
        while True:
            with self.part(name):
                try:
                    item = next(iterator)
                except StopIteration:
                    return
            yield item
