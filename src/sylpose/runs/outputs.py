"""Output of a run: trajectory files and report of each object, and one overlay video of all objects."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from sylpose.atomic_io import make_output_folder
from sylpose.bundle_adjustment.calibration_refinement import CalibrationPrior, default_calibration_prior
from sylpose.geometry.euler_angles import PAN_TILT_ROLL, parse_euler_angles
from sylpose.input_limits import MAX_TABLE_BYTES
from sylpose.io.exports.text import write_csv
from sylpose.io.object_files import CLOUD_FILE, OBJECT_FILE, save_object, write_cloud
from sylpose.report.files import PAGE_FILE, TrajectoryWriter, build_columns, write_trajectory
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Rig
from sylpose.runs.calibration_refinement import describe_changes, find_moved_cameras, write_refined
from sylpose.runs.checkpoint import FrameFile
from sylpose.runs.checkpoint_schema import OutputState
from sylpose.runs.options import RunOptions
from sylpose.runs.page import ThumbnailAlbum
from sylpose.runs.run_result import StageTimer
from sylpose.smoothing import Track, make_keyframe_tracks, smooth_tracks
from sylpose.status import Status
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.known_object import KnownObject, TransferredObject

# Largest number of frames that are refined jointly: they take some 30 kB each, all at once in memory.
MAX_SMOOTHED_FRAMES = 10_000
# File with the data that smoothing needs of each frame.
TRACKS = "tracks.bin"
# Names of the trajectory files: the result, and the poses as tracked if the result is smoothed.
RESULT = "trajectory"
TRACKED = "tracked"
# The result with velocities.
VELOCITY = "velocity.csv"
SUFFIXES: tuple[str, ...] = (".tum", ".csv")
# Frames that may wait for the overlay's thread before the tracker is blocked.
OVERLAY_QUEUE = 4


class ObjectOutput:
    """Output files of one object: trajectory.tum and .csv frame by frame, and the reports when it is closed.

    Args:
        folder: created if missing.
        rig: cameras and length unit of the files.
        options: options of the run. With `smooth`, frames are written to tracked.tum and .csv, and the data are kept
            from which `finish` makes trajectory.tum and .csv.
        clock: measures the time of "plots" and "smoothing".
        note: title of the report, one line.
        warnings: warnings from before the run.
        known: the object model in this rig, if it is known from another recording.
        album: images of the run for the report page.
        resume: state of an interrupted run whose files are continued.

    Raises:
        OSError, ValueError: as `TrajectoryWriter` and `FrameFile`.
    """

    def __init__(
        self,
        folder: Path,
        rig: Rig,
        options: RunOptions,
        clock: StageTimer,
        *,
        note: str,
        warnings: Sequence[str],
        known: TransferredObject | None,
        album: ThumbnailAlbum,
        resume: OutputState | None,
    ) -> None:
        self.folder, self._rig, self._clock = make_output_folder(folder), rig, clock
        self.changes: list[str] = []
        self._has_velocity = options.velocity
        self._calibration_covariance = options.calibration_covariance
        self._recalibrate, self._note, self._known = options.refine_calibration, note, known
        self._angles = None if options.angles is None else parse_euler_angles(options.angles)
        self._album, self._warnings = album, warnings
        self.report_path = self.folder / f"report.{options.plot_format}"
        state = OutputState() if resume is None else resume
        stem = TRACKED if options.smooth else RESULT
        writer = None if resume is None else resume.writer
        self._writer = TrajectoryWriter(self.folder, rig.names, rig.unit, stem=stem, angles=self._angles, resume=writer)
        self._tracks = FrameFile(self.folder / TRACKS, Track, state.tracks_bytes) if options.smooth else None
        # Kept on disk: runs of days do not fit in memory, and the trajectory files contain rounded values.
        self._poses = FrameFile(self.folder, FramePose)
        self.n_frames = 0
        for pose in self._writer.read_back():
            self._append(pose)
        self._finished = False
        self._final_trajectory: Trajectory | None = None
        self.files = [
            *self._files_named(RESULT),
            self.report_path,
            self.folder / PAGE_FILE,
            *(self._files_named(TRACKED) if options.smooth else []),
        ]

    def _files_named(self, stem: str) -> list[Path]:
        return [self.folder / f"{stem}{suffix}" for suffix in SUFFIXES]

    @property
    def trajectory(self) -> Trajectory:
        """Return the trajectory of all frames so far."""
        final = self._final_trajectory
        return self._make_trajectory(list(self._poses.read())) if final is None else final

    def _make_trajectory(self, poses: Sequence[FramePose]) -> Trajectory:
        return Trajectory(poses, self._rig.names, self._rig.unit)

    def _append(self, pose: FramePose) -> None:
        self._poses.write(pose)
        self.n_frames += 1

    def write(self, tracked: TrackedFrame) -> None:
        """Append a frame to the files."""
        self._writer.write(tracked.pose)
        if self._tracks is not None and self._known is not None and not self.n_frames:
            for track in make_keyframe_tracks(self._known, self._rig, tracked.pose.time):
                self._tracks.write(track)
        self._append(tracked.pose)
        if self._tracks is not None:
            self._tracks.write(Track.from_tracked(tracked))

    def state(self) -> OutputState:
        """Return the state from which the output can be resumed, after flushing the files to disk."""
        return OutputState(self._writer.state(), 0 if self._tracks is None else self._tracks.length())

    def finish(self, on_round: Callable[[int], None] | None = None) -> str | None:
        """Finish after the last frame: smooth the trajectory if requested.

        Files that resuming from a checkpoint needs are not changed, so a run killed here can be resumed with the same
        result.

        Args:
            on_round: called with the number of each round of the refinement.

        Returns:
            A message if smoothing or velocities failed, else None.
        """
        self._writer.truncate()
        messages = [None if self._tracks is None else self._smooth(self._tracks, on_round)]
        if self._has_velocity:
            messages.append(self._write_velocity())
        self._finished = True
        return " ".join(filter(None, messages)) or None

    def _write_velocity(self) -> str | None:
        """Write velocity.csv; return a message if there are too few poses."""
        trajectory = self.trajectory
        try:
            with self._clock.measure("velocities"):
                kinematics = trajectory.differentiate()
        except ValueError as error:
            return f"No {VELOCITY}: {error}."
        write_csv(build_columns(trajectory, kinematics), self.folder / VELOCITY)
        self.files.append(self.folder / VELOCITY)
        return None

    def _smooth(self, track_file: FrameFile[Track], on_round: Callable[[int], None] | None) -> str | None:
        if self.n_frames > MAX_SMOOTHED_FRAMES:
            return f"Smoothing: {self.n_frames} frames are more than the {MAX_SMOOTHED_FRAMES} that can be refined jointly."
        with self._clock.measure("smoothing"):
            tracks = list(track_file.read())
            corrections = tracks[-1].nudges if tracks else ()
            moved = find_moved_cameras(self.trajectory, corrections) if self._recalibrate else []
            result = smooth_tracks(
                tracks,
                self._rig,
                calibration_prior=self._make_prior(),
                recalibrate=self._recalibrate,
                moved_cameras=moved,
                on_iteration=on_round,
            )
            poses = result.poses[len(tracks) - self.n_frames :]
            if self._known is not None:
                poses = tuple(map(self._known.converter.convert, poses))
            self._final_trajectory = self._make_trajectory(poses)
            if result.correction is not None:
                self.files += write_refined(self.folder, result.correction, self._rig.names, result.moved_cameras)
                self.changes += describe_changes(result.correction, self._rig, result.moved_cameras)
        return None if result.status is Status.OK else f"Smoothing: {result.status.text} The poses are as tracked."

    def _make_prior(self) -> CalibrationPrior:
        covariance = self._calibration_covariance
        if covariance is None:
            return default_calibration_prior(self._rig)
        return CalibrationPrior.from_covariance(covariance)

    def write_object(self, model: KnownObject | None) -> None:
        """Write the object model and its point cloud, for other recordings and for viewing; nothing for None."""
        if model is None:
            return
        save_object(model, self.folder / OBJECT_FILE)
        write_cloud(model, self.folder / CLOUD_FILE)
        self.files += [self.folder / OBJECT_FILE, self.folder / CLOUD_FILE]

    def close(self) -> None:
        """Complete the files with the frames so far.

        If the run did not finish, an existing result with at least as many frames is kept, with its report.
        """
        self._final_trajectory = self.trajectory
        self._poses.close()
        self._writer.close()
        if self._tracks is not None:
            self._tracks.close()
        if not self._finished and _count_frames(self._files_named(RESULT)[1]) >= self.n_frames + (self._tracks is None):
            return
        if self._tracks is not None:  # refined, or as tracked if the run was interrupted or has too many frames
            write_trajectory(self.folder, self._final_trajectory, stem=RESULT, angles=self._angles)
        if self.n_frames:
            with self._clock.measure("plots"):
                from sylpose.report.plots import save_trajectory_plot

                trajectory, plot, angles = self._final_trajectory, self.report_path, self._angles or PAN_TILT_ROLL
                save_trajectory_plot(trajectory, plot, note=self._note, angles=angles, input_warnings=self._warnings)
                if self._files_named(RESULT)[1].stat().st_size <= MAX_TABLE_BYTES:
                    from sylpose.runs.page import write_report_page

                    write_report_page(self.folder, self._album.stills())


def _count_frames(path: Path) -> int:
    """Count the frames in a trajectory.csv by its lines; return -1 if the file does not exist."""
    return path.read_bytes().count(b"\n") - 1 if path.exists() else -1


class Overlay:
    """Overlay video, drawn and encoded in order by a separate thread, whose exceptions `put` and `close` raise.

    Args:
        path: the video; replaced.
        rig: the cameras that are tiled.
        rate: frames per second.
        names: names of the objects; a single name is not drawn.
        clock: measures the time that the tracker waits for the video, as "overlay".
        smooth: all poses are refined later, so the video is labeled as showing poses as tracked.
    """

    def __init__(
        self, path: Path, rig: Rig, rate: float, names: Sequence[str], clock: StageTimer, *, smooth: bool = False
    ) -> None:
        from sylpose.report.overlay import OverlayWriter

        self._clock = clock
        self._names = list(names)
        self._writer = OverlayWriter(path, rig, rate, note="poses as tracked" if smooth else "")
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="sylpose-overlay")
        self._pending: deque[Future[None]] = deque()
        # Frames in which some objects are not final yet, and the last final frame by object.
        self._incomplete: dict[int, dict[str, TrackedFrame]] = {}
        self._last_final = dict.fromkeys(names, -1)

    def put(self, name: str, tracked: TrackedFrame) -> None:
        """Add one object in one frame. A frame is drawn when all objects are final in it."""
        self._incomplete.setdefault(tracked.pose.index, {})[name] = tracked
        self._last_final[name] = tracked.pose.index
        complete = min(self._last_final.values())
        for index in sorted(k for k in self._incomplete if k <= complete):
            self._pending.append(self._pool.submit(self._draw, self._incomplete.pop(index)))
        with self._clock.measure("overlay"):
            while self._pending and (len(self._pending) > OVERLAY_QUEUE or self._pending[0].done()):
                self._pending.popleft().result()

    def _draw(self, frame: dict[str, TrackedFrame]) -> None:
        from sylpose.report.overlay import OverlayObject, object_color

        drawings = list[OverlayObject]()
        for k, name in enumerate(self._names):
            if (t := frame.get(name)) is not None:
                label, color = ("", None) if len(self._names) == 1 else (name, object_color(k))
                candidates = [(region.features, region.rejected) for region in t.detections]
                drawings.append(OverlayObject(label, t.pose, t.matches, t.radius, t.regions, color, candidates))
        self._writer.write(next(iter(frame.values())).frames.images, drawings)

    def close(self) -> None:
        """Complete the video."""
        with self._clock.measure("overlay"):
            try:
                while self._pending:
                    self._pending.popleft().result()
            finally:
                self._pool.shutdown()
                self._writer.close()
