"""A recording tracked from end to end: session -> tracker -> trajectory files, plots and overlay video."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TypeVar

import numpy as np

from sylpose.capture import Session
from sylpose.report.files import TrajectoryWriter, output_folder, writing
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Rig
from sylpose.tracking import METHODS, TrackedFrame, track

__all__ = ["Run", "notes", "track_session"]

T = TypeVar("T")

# Of the overlay where a recording does not say its rate, frames per second.
IMAGE_RATE = 2.0
# Frames that may wait for the overlay's thread before the tracker has to.
OVERLAY_QUEUE = 4
# With one camera lengths are relative to the object's distance in the first frame (docs/conventions.md).
ONE_CAMERA_UNIT = "first distances"


@dataclass(frozen=True, eq=False)
class Run:
    """What `track_session` did.

    Attributes:
        trajectory: of all frames; with one camera its unit is "first distances".
        files: that were written.
        problems: sentences about what could not be read.
        seconds: where the time went: "reading", "tracking" (detection, matching, solving), "overlay" and "plots".
    """

    trajectory: Trajectory
    files: tuple[Path, ...]
    problems: tuple[str, ...]
    seconds: dict[str, float]


def track_session(
    session: Session,
    out: Path | str | None = None,
    *,
    method: str = METHODS[0],
    start: int = 0,
    stop: int | None = None,
    every: int = 1,
    overlay: bool = True,
    seed: int = 0,
    on_frame: Callable[[TrackedFrame], None] | None = None,
    on_problem: Callable[[str], None] | None = None,
) -> Run:
    """Track a session and write `trajectory.tum`, `trajectory.csv`, `report.png` and `overlay.mp4`.

    Whatever ends it early (Ctrl-C, a full disk, a bug), the frames solved until then are in the trajectory files, and
    `report.png` and `overlay.mp4` are finished with them before the exception goes on.

    Args:
        session: of `open_session`.
        out: folder for the files; None: `sylpose` in the session's folder. Files of these names in it are replaced.
        method, seed: as in `track`.
        start, stop, every: frames start, start + every, ... below stop.
        overlay: False leaves `overlay.mp4` out.
        on_frame: called with each frame once it is in the trajectory files.
        on_problem: called with a sentence for each file that breaks off and each frame that cannot be read.

    Raises:
        ValueError: frames that the session does not have, an unknown method, boxes that do not meet in space.
        OSError: naming the file or folder that cannot be written or read.
    """
    if method not in METHODS:
        raise ValueError(f"method: {method!r} is not one of {', '.join(METHODS)}")
    problems: list[str] = []
    clock = _Clock()

    def said(problem: str) -> None:
        problems.append(problem)
        if on_problem is not None:
            on_problem(problem)

    frames = session.frames(start, stop, every, said)
    folder = output_folder(session.path / "sylpose" if out is None else out)
    rig = session.rig if len(session.rig) > 1 else Rig(session.rig.cameras, ONE_CAMERA_UNIT)
    report_path, overlay_path = folder / "report.png", folder / "overlay.mp4"
    for old in (report_path, overlay_path):  # an earlier run's would be taken for this one's
        with writing(old):
            old.unlink(missing_ok=True)
    poses: list[FramePose] = []
    with ExitStack() as stack:
        writer = stack.enter_context(TrajectoryWriter(folder, rig.names, rig.unit))
        files = [writer.tum_path, writer.csv_path, report_path]
        stack.callback(_write_report, poses, rig, report_path, clock)
        drawing = None
        if overlay:
            rate = max(session.rate / every, 1.0) if session.rate else IMAGE_RATE
            drawing = stack.enter_context(closing(_Overlay(overlay_path, rig, rate, clock)))
            files.append(overlay_path)
        stack.enter_context(closing(frames))
        read = clock.around("reading", frames)
        solved = track(read, session.rig, session.boxes or None, method=method, seed=seed)
        for tracked in clock.around("tracking", solved):
            writer.write(tracked.pose)
            poses.append(tracked.pose)
            if drawing is not None:
                drawing.put(tracked)
            if on_frame is not None:
                on_frame(tracked)
    seconds = clock.seconds
    seconds["tracking"] -= seconds["reading"]  # `track` reads
    return Run(Trajectory(poses, rig.names, rig.unit), tuple(files), tuple(problems), seconds)


def notes(session: Session, start: int = 0) -> list[str]:
    """What to know about a session before it is tracked from frame `start` on, in sentences."""
    found = [*session.warnings]
    n, parts = session.n_frames, []
    for name, column in zip(session.rig.names, session.timeline.frames.T, strict=True):
        shown = np.flatnonzero(column >= 0)
        if not len(shown):
            parts.append(f"{name} has none of them")
        elif len(shown) < n:
            missing = int(shown[-1] - shown[0] + 1 - len(shown))
            within = f" without {missing} in between" if missing else ""
            parts.append(f"{name} has {shown[0]} to {shown[-1]}{within}")
    if parts:
        found.append(f"Not every camera has all frames 0 to {n - 1}: {', '.join(parts)}.")
    if session.boxes and start > 0:
        found.append(f"The boxes are taken to be of frame {start}, where tracking starts.")
    return found


def _write_report(poses: list[FramePose], rig: Rig, path: Path, clock: _Clock) -> None:
    if poses:
        with clock.part("plots"):
            from sylpose.report.plots import plot_trajectory  # loading matplotlib takes a second

            plot_trajectory(Trajectory(poses, rig.names, rig.unit), path)


class _Overlay:
    """Draws and encodes in one thread beside the tracker, in order; its exceptions come out of `put` and `close`."""

    def __init__(self, path: Path, rig: Rig, rate: float, clock: _Clock) -> None:
        from sylpose.report.overlay import OverlayWriter

        self._clock = clock
        self._writer = OverlayWriter(path, rig, rate)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="sylpose-overlay")
        self._pending: deque[Future[None]] = deque()

    def put(self, tracked: TrackedFrame) -> None:
        job = (tracked.frames.images, tracked.pose, tracked.matches, tracked.radius, tracked.regions)
        self._pending.append(self._pool.submit(self._writer.write, *job))
        with self._clock.part("overlay"):
            while self._pending and (len(self._pending) > OVERLAY_QUEUE or self._pending[0].done()):
                self._pending.popleft().result()

    def close(self) -> None:
        with self._clock.part("overlay"):
            try:
                while self._pending:
                    self._pending.popleft().result()
            finally:
                self._pool.shutdown()
                self._writer.close()


@dataclass(eq=False)
class _Clock:
    """Seconds that the caller's thread has spent on each part."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
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
