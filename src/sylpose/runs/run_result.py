"""Result of a run, and the time of its stages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TypeVar

from sylpose.results import Trajectory

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Run:
    """Result of `track_session`.

    Attributes:
        trajectories: trajectory by object; with one camera their unit is "first distances", unless the object's size is
            known from another recording.
        files: the files written.
        problems: messages about frames and files that could not be read.
        seconds: time by stage: "reading", "tracking" (detection, matching, solving), "saving" (checkpoints), "overlay",
            "smoothing" and "plots".
        changes: by object, corrections of the calibration, one sentence per camera; empty without `refine_calibration`.
        network: by object, the communication cost of its nodes in one sentence; empty for a single process.
    """

    trajectories: dict[str, Trajectory]
    files: tuple[Path, ...]
    problems: tuple[str, ...]
    seconds: dict[str, float]
    changes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    network: dict[str, str] = field(default_factory=dict)

    @property
    def trajectory(self) -> Trajectory:
        """Return the trajectory of the only object.

        Raises:
            ValueError: there are several objects.
        """
        if len(self.trajectories) > 1:
            raise ValueError(f"several objects ({', '.join(self.trajectories)}): take one of `trajectories`")
        return next(iter(self.trajectories.values()))


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
