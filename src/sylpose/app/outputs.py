"""What a run writes: the trajectory files and the report of each object, and one overlay video of all of them."""

from __future__ import annotations

import os
import pickle
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from sylpose.adjustment.calibration import usual_doubt
from sylpose.app.checkpoint import ExactPickler
from sylpose.app.clock import Clock
from sylpose.app.recalibrate import REFINED, REFINED_END, changes, moved_cameras, write_refined
from sylpose.report.files import TrajectoryWriter, WriterState, output_folder, read_trajectory, writing
from sylpose.results import FramePose, Status, Trajectory
from sylpose.rig import Rig
from sylpose.smoothing.trajectory import Track, smooth
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["MAX_SMOOTHED", "ObjectOutput", "OutputState", "Overlay"]

# So many frames are refined together at most: they take some 30 kB each, all at once in memory.
MAX_SMOOTHED = 10_000
# What smoothing needs of the frames.
TRACKS = "tracks.bin"
# Names of the trajectory's files: the result; as it was tracked, where that is smoothed; and while it is written.
RESULT, TRACKED, PARTIAL, SUFFIXES = "trajectory", "tracked", "smoothing", (".tum", ".csv")
# Frames that may wait for the overlay's thread before the tracker has to.
OVERLAY_QUEUE = 4


@dataclass(frozen=True, eq=False)
class OutputState:
    """How far an `ObjectOutput` has come; `n_tracks` is the length in bytes of what is kept for smoothing."""

    writer: WriterState
    n_tracks: int


class ObjectOutput:
    """The files of one object: trajectory.tum and .csv frame by frame, report.png when it is closed.

    Args:
        folder: made when it is not there.
        rig: whose cameras and unit the files name.
        smooth: write the frames to tracked.tum and .csv, and keep what `finish` needs to make trajectory.tum and .csv of
            them: in a file, since it is much.
        recalibrate: refine the calibration with it, and write it too.
        clock: counts the time of "plots" and "smoothing".
        resume: of an earlier run, to go on with its files.

    Raises:
        OSError, ValueError: as `TrajectoryWriter`.
    """

    def __init__(
        self,
        folder: Path,
        rig: Rig,
        clock: Clock,
        *,
        smooth: bool = False,
        recalibrate: bool = False,
        resume: OutputState | None = None,
    ) -> None:
        self.folder, self._rig, self._clock = output_folder(folder), rig, clock
        self.poses: list[FramePose] = []
        self.changes: list[str] = []
        self._recalibrate = recalibrate
        self.report_path = self.folder / "report.png"
        self._writer = TrajectoryWriter(
            self.folder,
            rig.names,
            rig.unit,
            stem=TRACKED if smooth else RESULT,
            resume=None if resume is None else resume.writer,
        )
        result = [self.folder / f"{RESULT}{suffix}" for suffix in SUFFIXES]
        tracked = [self.folder / f"{TRACKED}{suffix}" for suffix in SUFFIXES]
        earlier = [self.report_path]  # it would be taken for this run's
        if resume is None:
            earlier += [
                *(result if smooth else tracked),
                *(self.folder / name for name in (REFINED, REFINED_END, TRACKS)),
            ]
        for old in earlier:
            with writing(old):
                old.unlink(missing_ok=True)
        self.files = [*result, self.report_path, *(tracked if smooth else [])]
        self._tracks_path = self.folder / TRACKS
        self._tracks, self._published = None, False
        if resume is not None:
            self.poses += read_trajectory(self._writer.csv_path)
        if smooth:
            with writing(self._tracks_path):
                self._tracks = self._tracks_path.open("wb" if resume is None else "r+b")
                self._tracks.truncate(0 if resume is None else resume.n_tracks)
                self._tracks.seek(0, os.SEEK_END)

    @property
    def trajectory(self) -> Trajectory:
        """All frames up to now."""
        return Trajectory(self.poses, self._rig.names, self._rig.unit)

    def write(self, tracked: TrackedFrame) -> None:
        """Appends a frame to the files."""
        self._writer.write(tracked.pose)
        self.poses.append(tracked.pose)
        if self._tracks is not None:
            with writing(self._tracks_path):
                ExactPickler(self._tracks, protocol=5).dump(Track.of(tracked))

    def state(self) -> OutputState:
        """What it takes to go on from here; all that was written is then on the disk."""
        n_tracks = 0
        if self._tracks is not None:
            with writing(self._tracks_path):
                self._tracks.flush()
                os.fsync(self._tracks.fileno())
            n_tracks = self._tracks.tell()
        return OutputState(self._writer.state(), n_tracks)

    def finish(self, on_round: Callable[[int], None] | None = None) -> str | None:
        """After the last frame: smooth the trajectory if that is asked for; a sentence when that did not work out.

        Nothing that going on from a checkpoint needs is changed: killed here, a run can be resumed and ends the same.

        Args:
            on_round: called with the number of each round of the refinement.
        """
        if self._tracks is None:
            return None
        if len(self.poses) > MAX_SMOOTHED:
            return f"Smoothing: {len(self.poses)} frames are more than the {MAX_SMOOTHED} that can be refined together."
        with self._clock.part("smoothing"):
            self._tracks.flush()
            tracks = []
            with self._tracks_path.open("rb") as file:
                while file.peek(1):
                    tracks.append(pickle.load(file))
            nudges = tracks[-1].nudges if tracks else ()
            moved = moved_cameras(self.trajectory, nudges) if self._recalibrate else []
            doubt = usual_doubt(self._rig)
            result = smooth(
                tracks, self._rig, doubt=doubt, recalibrate=self._recalibrate, moved=moved, on_round=on_round
            )
            self.poses[:] = result.poses
            if result.correction is not None:
                self.files += write_refined(self.folder, result.correction, self._rig.names, result.moved)
                self.changes += changes(result.correction, self._rig, result.moved)
            self._publish()
        return None if result.status is Status.OK else f"Smoothing: {result.status.text}"

    def _publish(self) -> None:
        """Writes the poses as the result: each file whole or not at all."""
        with TrajectoryWriter(self.folder, self._rig.names, self._rig.unit, stem=PARTIAL) as writer:
            for pose in self.poses:
                writer.write(pose)
        for path in (writer.tum_path, writer.csv_path):
            with writing(path):
                os.replace(path, path.with_stem(RESULT))
        self._published = True

    def close(self) -> None:
        """Finishes the files with the frames there are."""
        self._writer.close()
        if self._tracks is not None:
            self._tracks.close()
            if not self._published:  # interrupted, or too much to be smoothed: the result is what was tracked
                self._publish()
        if self.poses:
            with self._clock.part("plots"):
                from sylpose.report.plots import plot_trajectory

                plot_trajectory(self.trajectory, self.report_path)

    def forget(self) -> None:
        """Once there is nothing to be resumed: what was kept for smoothing is removed."""
        with writing(self._tracks_path):
            self._tracks_path.unlink(missing_ok=True)


class Overlay:
    """Draws and encodes in one thread beside the tracker, in order; its exceptions come out of `put` and `close`.

    Args:
        path: of the video; replaced.
        rig: whose cameras are tiled.
        rate: frames per second.
        names: of the objects; with one it is not written into the picture.
        clock: counts the time that the tracker waits for it, as "overlay".
    """

    def __init__(self, path: Path, rig: Rig, rate: float, names: Sequence[str], clock: Clock) -> None:
        from sylpose.report.overlay import OverlayWriter

        self._clock = clock
        self._names = list(names)
        self._writer = OverlayWriter(path, rig, rate)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="sylpose-overlay")
        self._pending: deque[Future[None]] = deque()
        # Frames that some objects are not decided in yet, and by object the last one that it is.
        self._open: dict[int, dict[str, TrackedFrame]] = {}
        self._decided = dict.fromkeys(names, -1)

    def put(self, name: str, tracked: TrackedFrame) -> None:
        """One object in one frame. A frame is drawn when all objects are decided in it."""
        self._open.setdefault(tracked.pose.index, {})[name] = tracked
        self._decided[name] = tracked.pose.index
        whole = min(self._decided.values())
        for index in sorted(k for k in self._open if k <= whole):
            self._pending.append(self._pool.submit(self._draw, self._open.pop(index)))
        with self._clock.part("overlay"):
            while self._pending and (len(self._pending) > OVERLAY_QUEUE or self._pending[0].done()):
                self._pending.popleft().result()

    def _draw(self, frame: dict[str, TrackedFrame]) -> None:
        from sylpose.report.overlay import Shown, object_color

        images = next(iter(frame.values())).frames.images
        if len(self._names) == 1:
            t = frame[self._names[0]]
            return self._writer.write(images, t.pose, t.matches, t.radius, t.regions)
        shown = [
            Shown(name, t.pose, t.matches, t.radius, t.regions, object_color(self._names.index(name)))
            for name, t in sorted(frame.items(), key=lambda item: self._names.index(item[0]))
        ]
        return self._writer.write_objects(images, shown)

    def close(self) -> None:
        """Finishes the video."""
        with self._clock.part("overlay"):
            try:
                while self._pending:
                    self._pending.popleft().result()
            finally:
                self._pool.shutdown()
                self._writer.close()
