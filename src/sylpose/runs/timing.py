"""Timing of the stages of a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import TypeVar

__all__ = ["StageTimer"]

T = TypeVar("T")


@dataclass(eq=False)
class StageTimer:
    """Stopwatch of the caller's thread, in seconds by stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the time of the `with` block to a stage."""
        begin = perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - begin

    def measure_iteration(self, name: str, items: Iterable[T]) -> Iterator[T]:
        """Yield the items and add the time spent waiting for each to a stage."""
        iterator = iter(items)
        while True:
            with self.measure(name):
                try:
                    item = next(iterator)
                except StopIteration:
                    return
            yield item
