"""What a run writes: the trajectory files and the report of each object, and one overlay video of all of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from sylpose.app.calibration_refinement import changes, moved_cameras, write_refined
from sylpose.app.checkpoint_schema import OutputState
from sylpose.app.frame_store import FrameFile
from sylpose.app.object_files import CLOUD, OBJECT, save_object, write_cloud
from sylpose.app.thumbnails import Album
from sylpose.app.timing import Clock
from sylpose.atomic_io import output_folder
from sylpose.bundle_adjustment.calibration_refinement import usual_doubt
from sylpose.geometry.euler_angles import PAN_TILT_ROLL, Angles
from sylpose.input_limits import MAX_TABLE
from sylpose.report.files import TrajectoryWriter, write_trajectory
from sylpose.report.formats import PAGE
from sylpose.results import FramePose, Status, Trajectory
from sylpose.rig import Rig
from sylpose.smoothing.known import tracks_of
from sylpose.smoothing.trajectory import Track, smooth
from sylpose.tracking.known_object import KnownObject
from sylpose.tracking.object_transfer import KnownHere
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["MAX_SMOOTHED", "RESULT", "SUFFIXES", "TRACKED", "TRACKS", "ObjectOutput", "Overlay"]

# So many frames are refined together at most: they take some 30 kB each, all at once in memory.
MAX_SMOOTHED = 10_000
# What smoothing needs of the frames.
TRACKS = "tracks.bin"
# Names of the trajectory's files: the result; as it was tracked, where that is smoothed.
RESULT, TRACKED, SUFFIXES = "trajectory", "tracked", (".tum", ".csv")
# Frames that may wait for the overlay's thread before the tracker has to.
OVERLAY_QUEUE = 4


class ObjectOutput:
    """The files of one object: trajectory.tum and .csv frame by frame, the reports when it is closed.

    Args:
        folder: made when it is not there.
        rig: whose cameras and unit the files name.
        smooth: write the frames to tracked.tum and .csv, and keep what `finish` needs to make trajectory.tum and .csv of
            them.
        recalibrate: refine the calibration with it, and write it too.
        clock: counts the time of "plots" and "smoothing".
        plot_format: what the report's name ends with.
        note: what it is a report of, a line.
        noticed: what looked wrong before the run, sentences.
        angles: three more in the files, and those of the report.
        known: the object before these cameras, if that is known from another take.
        album: pictures of the run, for its page; None for no page.
        resume: of an earlier run, to go on with its files. Nothing of them is cut or removed before there is as much again.

    Raises:
        OSError, ValueError: as `TrajectoryWriter` and `FrameFile`.
    """

    def __init__(
        self,
        folder: Path,
        rig: Rig,
        clock: Clock,
        *,
        smooth: bool = False,
        recalibrate: bool = False,
        plot_format: str = "png",
        note: str = "",
        noticed: Sequence[str] = (),
        angles: Angles | None = None,
        known: KnownHere | None = None,
        album: Album | None = None,
        resume: OutputState | None = None,
    ) -> None:
        self.folder, self._rig, self._clock = output_folder(folder), rig, clock
        self.changes: list[str] = []
        self._recalibrate, self._note, self._known, self._angles = recalibrate, note, known, angles
        self._album, self._noticed = album, noticed
        self.report_path = self.folder / f"report.{plot_format}"
        state = OutputState() if resume is None else resume
        stem = TRACKED if smooth else RESULT
        writer = None if resume is None else resume.writer
        self._writer = TrajectoryWriter(self.folder, rig.names, rig.unit, stem=stem, angles=angles, resume=writer)
        self._tracks = FrameFile(self.folder / TRACKS, Track, state.n_tracks) if smooth else None
        # Of a run of days they are too many for the memory, and the files have them rounded.
        self._poses = FrameFile(self.folder, FramePose)
        self.n_frames = 0
        for pose in self._writer.written():
            self._keep(pose)
        self._ended = False
        self._whole: Trajectory | None = None
        self.files = [
            *self._named(RESULT),
            self.report_path,
            *([] if album is None else [self.folder / PAGE]),
            *(self._named(TRACKED) if smooth else []),
        ]

    def _named(self, stem: str) -> list[Path]:
        return [self.folder / f"{stem}{suffix}" for suffix in SUFFIXES]

    @property
    def trajectory(self) -> Trajectory:
        """All frames up to now."""
        return self._of(list(self._poses.read())) if self._whole is None else self._whole

    def _of(self, poses: Sequence[FramePose]) -> Trajectory:
        return Trajectory(poses, self._rig.names, self._rig.unit)

    def _keep(self, pose: FramePose) -> None:
        self._poses.write(pose)
        self.n_frames += 1

    def write(self, tracked: TrackedFrame) -> None:
        """Appends a frame to the files."""
        self._writer.write(tracked.pose)
        if self._tracks is not None and self._known is not None and not self.n_frames:
            for track in tracks_of(self._known, self._rig, tracked.pose.time):
                self._tracks.write(track)
        self._keep(tracked.pose)
        if self._tracks is not None:
            self._tracks.write(Track.of(tracked))

    def state(self) -> OutputState:
        """What it takes to go on from here; all that was written is then on the disk."""
        return OutputState(self._writer.state(), 0 if self._tracks is None else self._tracks.length())

    def finish(self, on_round: Callable[[int], None] | None = None) -> str | None:
        """After the last frame: smooth the trajectory if that is asked for; a sentence when that did not work out.

        Nothing that going on from a checkpoint needs is changed: killed here, a run can be resumed and ends the same.

        Args:
            on_round: called with the number of each round of the refinement.
        """
        self._writer.cut_rest()
        sentence = None if self._tracks is None else self._smoothed(self._tracks, on_round)
        self._ended = True
        return sentence

    def _smoothed(self, kept: FrameFile[Track], on_round: Callable[[int], None] | None) -> str | None:
        if self.n_frames > MAX_SMOOTHED:
            return f"Smoothing: {self.n_frames} frames are more than the {MAX_SMOOTHED} that can be refined together."
        with self._clock.part("smoothing"):
            tracks = list(kept.read())
            nudges = tracks[-1].nudges if tracks else ()
            moved = moved_cameras(self.trajectory, nudges) if self._recalibrate else []
            doubt = usual_doubt(self._rig)
            result = smooth(
                tracks, self._rig, doubt=doubt, recalibrate=self._recalibrate, moved=moved, on_round=on_round
            )
            poses = result.poses[len(tracks) - self.n_frames :]
            if self._known is not None:
                poses = tuple(map(self._known.telling.of, poses))
            self._whole = self._of(poses)
            if result.correction is not None:
                self.files += write_refined(self.folder, result.correction, self._rig.names, result.moved)
                self.changes += changes(result.correction, self._rig, result.moved)
        return None if result.status is Status.OK else f"Smoothing: {result.status.text}"

    def write_object(self, learnt: KnownObject | None) -> None:
        """What is known of the object in the end, for another take and to look at; nothing where that is next to nothing."""
        if learnt is None:
            return
        save_object(learnt, self.folder / OBJECT)
        write_cloud(learnt, self.folder / CLOUD)
        self.files += [self.folder / OBJECT, self.folder / CLOUD]

    def close(self) -> None:
        """Finishes the files with the frames there are. Where the run did not come to its end, a result that is there and
        has as many frames stays, and its report."""
        self._whole = self.trajectory
        self._poses.close()
        self._writer.close()
        if self._tracks is not None:
            self._tracks.close()
        if not self._ended and _frames_in(self._named(RESULT)[1]) >= self.n_frames + (self._tracks is None):
            return
        if self._tracks is not None:  # as refined, or as tracked where it was interrupted or is too much
            write_trajectory(self.folder, self._whole, stem=RESULT, angles=self._angles)
        if self.n_frames:
            with self._clock.part("plots"):
                from sylpose.report.plots import plot_trajectory

                angles = self._angles or PAN_TILT_ROLL
                plot_trajectory(self._whole, self.report_path, note=self._note, angles=angles, noticed=self._noticed)
                if self._album is not None and self._named(RESULT)[1].stat().st_size <= MAX_TABLE:
                    from sylpose.app.page import make_page

                    make_page(self.folder, self._album.stills())


def _frames_in(path: Path) -> int:
    """In a trajectory.csv, by its lines; -1 without one."""
    return path.read_bytes().count(b"\n") - 1 if path.exists() else -1


class Overlay:
    """Draws and encodes in one thread beside the tracker, in order; its exceptions come out of `put` and `close`.

    Args:
        path: of the video; replaced.
        rig: whose cameras are tiled.
        rate: frames per second.
        names: of the objects; with one it is not written into the picture.
        clock: counts the time that the tracker waits for it, as "overlay".
        smooth: all poses are refined together in the end, so that those in the video are not yet what the result has.
    """

    def __init__(
        self, path: Path, rig: Rig, rate: float, names: Sequence[str], clock: Clock, *, smooth: bool = False
    ) -> None:
        from sylpose.report.overlay import OverlayWriter

        self._clock = clock
        self._names = list(names)
        self._writer = OverlayWriter(path, rig, rate, note="poses as tracked" if smooth else "")
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
        one = len(self._names) == 1
        shown = [
            Shown(
                "" if one else name,
                t.pose,
                t.matches,
                t.radius,
                t.regions,
                None if one else object_color(self._names.index(name)),
                [(sought.features, sought.rejected) for sought in t.sought],
            )
            for name, t in sorted(frame.items(), key=lambda item: self._names.index(item[0]))
        ]
        self._writer.write_objects(images, shown)

    def close(self) -> None:
        """Finishes the video."""
        with self._clock.part("overlay"):
            try:
                while self._pending:
                    self._pending.popleft().result()
            finally:
                self._pool.shutdown()
                self._writer.close()
