"""Tracking of a whole session: trackers, trajectory files, plots and overlay video."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from sylpose import __version__
from sylpose.bundle_adjustment.calibration_refinement import N_CAMERA_PARAMETERS
from sylpose.frames import Box, FrameSet
from sylpose.geometry.validation import check_finite, format_value
from sylpose.io.capture import Session, open_session
from sylpose.io.capture.live import LiveSession, is_live, open_live
from sylpose.io.object_files import object_checksum
from sylpose.methods import METHODS
from sylpose.network.simulation import NodesTracker
from sylpose.rig import Rig
from sylpose.runs.calibration_refinement import REFINED, REFINED_END
from sylpose.runs.candidates import compare_session_cameras, select_candidate
from sylpose.runs.check import check_session
from sylpose.runs.checkpoint import CheckpointWriter
from sylpose.runs.checkpoint_schema import OutputState, RunState
from sylpose.runs.mesh_tracking import check_mesh_session, open_contour_tracker
from sylpose.runs.options import RunOptions
from sylpose.runs.outputs import MAX_SMOOTHED_FRAMES, ObjectOutput, Overlay
from sylpose.runs.page import ThumbnailAlbum, thumbnail_step
from sylpose.runs.progress import Progress, ProgressCallback, show_progress
from sylpose.runs.results_folder import ResultsFolder, check_output_folder, lock_folder
from sylpose.runs.run_metadata import DEFAULT_FOLDER, ESTIMATED, SETTINGS, USED_CALIBRATION, WORLD, write_run_metadata
from sylpose.runs.run_result import Run, StageTimer
from sylpose.runs.system_resources import return_large_arrays
from sylpose.silhouettes.contour_tracker import ContourTracker
from sylpose.sync.offsets import apply_offsets, find_offsets
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.known_object import KnownObject
from sylpose.tracking.search_clock import SearchClock
from sylpose.tracking.tracker import Tracker, TrackerArguments
from sylpose.units import INITIAL_DISTANCES

# Frame rate of the overlay if the recording has none, frames per second.
DEFAULT_OVERLAY_RATE = 2.0


def output_path(session: Session | LiveSession, out: Path | str | None = None) -> Path:
    """Return the folder of a run's files; the default is `sylpose` in the session's folder, with a folder for each take."""
    take = session.take if isinstance(session, Session) else ""
    return session.path / DEFAULT_FOLDER / take if out is None else Path(out)


def result_units(
    session: Session | LiveSession, known: Mapping[str, KnownObject], *, has_mesh: bool = False
) -> dict[str, str]:
    """Return the length unit of each object's results.

    With one camera it is the calibration's unit only if the object's size is known, otherwise `INITIAL_DISTANCES`.

    Args:
        session: the session.
        known: known objects by name.
        has_mesh: whether the shape of the objects is known.
    """
    has_size = {name for name, model in known.items() if model.unit != INITIAL_DISTANCES}
    return {
        name: session.rig.unit if len(session.rig) > 1 or has_mesh or name in has_size else INITIAL_DISTANCES
        for name in session.objects
    }


def has_finished(session: Session | LiveSession, out: Path | str | None = None) -> bool:
    """Return whether a run in this folder has finished, so that there is nothing to resume."""
    return _make_results_folder(session, out).has_finished


def check_candidate(candidate: int | None, *, is_selected: bool, is_live: bool = False) -> None:
    """Check that a moving body may be selected by its number, if it is.

    Args:
        candidate: the number.
        is_selected: whether boxes, masks or a known object select it.
        is_live: whether images come from cameras.

    Raises:
        ValueError: it may not.
    """
    if candidate is not None and (is_selected or is_live):
        reason = "boxes or masks select the object" if is_selected else "live cameras are not searched in advance"
        raise ValueError(f"object {candidate}: {reason}; omit the number")


def check_output(session: Session, out: Path | str | None = None) -> None:
    """Check that a run can write its files, before what takes long.

    Raises:
        ValueError, OSError: as `track_session`; the folder is made.
    """
    check_output_folder(session, output_path(session, out))
    with lock_folder(output_path(session, out)):
        pass


@contextmanager
def replace_results(session: Session, out: Path | str | None = None) -> Iterator[Path]:
    """Move earlier results away, to write files with which a run begins; yield the folder, which is locked.

    Raises:
        ValueError, OSError: as `track_session`.
    """
    results = _make_results_folder(session, out)
    with lock_folder(results.path):
        results.move_earlier_results()
        yield results.path


def _make_results_folder(session: Session | LiveSession, out: Path | str | None) -> ResultsFolder:
    path = output_path(session, out)
    # The calibration that the run uses stays there, if an earlier run has written it.
    used = session.calibration.resolve()
    written = ESTIMATED, (REFINED,), (REFINED_END,)
    own = next((files for files in written if used == (path / files[0]).resolve()), ())
    return ResultsFolder(path, session.objects if len(session.objects) > 1 else (), own)


def track_session(
    session: Session | LiveSession | Path | str,
    out: Path | str | None = None,
    options: RunOptions | None = None,
    *,
    progress: bool | ProgressCallback | None = None,
    on_resume: Callable[[int], None] | None = None,
    on_frame: Callable[[str, TrackedFrame], None] | None = None,
    on_smoothing: Callable[[int], None] | None = None,
    on_problem: Callable[[str], None] | None = None,
    interrupted: Callable[[], bool] | None = None,
) -> Run:
    """Track a session and write `trajectory.tum`, `trajectory.csv`, `report.png`, `report.html` and `overlay.mp4`.

    Several objects get one folder each, with the first four files. If an exception ends the run early (Ctrl-C, a full
    disk, a bug), the trajectory files contain the frames solved so far, and `report.png` and `overlay.mp4` are
    completed before the exception propagates. If a run with smoothing is killed, its frames are in `tracked.tum` and
    `tracked.csv`. Resuming continues from the last checkpoint and yields the same trajectories as an uninterrupted run.

    Args:
        session: session from `open_session` or `open_live`; or their path, to open it without options.
        out: folder for the files, which are replaced; None for `sylpose` in the session's folder.
        options: method, frames, outputs and so on; None for the defaults.
        progress: True for a progress bar in a terminal or a notebook; or a function that is called with the number of
            tracked frames and the total (None for live sessions). None shows nothing.
        on_resume: called with the number of frames that the interrupted run has solved.
        on_frame: called with the object's name and each frame, once it is in the trajectory files.
        on_smoothing: called with the number of each round of the joint refinement.
        on_problem: called with a message for each truncated file and each frame that cannot be read.
        interrupted: called after each frame; if it returns True, a checkpoint is written and KeyboardInterrupt raised.

    Returns:
        The trajectories, the files written and the problems found.

    Raises:
        TypeError: no session.
        ValueError: as `open_session` and `open_live`; frames outside the session, or boxes whose rays do not meet;
            resuming with other options or another session than the interrupted run, or a live session.
        FileNotFoundError: resuming without an interrupted run.
        OSError: a file or folder cannot be written or read; the message names it.
    """
    if isinstance(session, Path | str):
        session = open_live(session) if is_live(session) else open_session(session)
    elif not isinstance(session, Session | LiveSession):
        raise TypeError(f"session must be a Session, a LiveSession or a path, got {format_value(session)}")
    return_large_arrays()
    events = _Events(
        on_resume or _ignore, on_frame or _ignore, on_smoothing or _ignore, on_problem or _ignore, interrupted
    )
    run = _SessionRun(session, out, options or RunOptions(), events)
    with ExitStack() as stack:
        run.open_trackers(stack)
        if run.options.resume and not run.results.path.is_dir():
            raise FileNotFoundError(f"{run.results.path}: no interrupted run to resume (there is no such folder)")
        # Nothing has been written up to here.
        stack.enter_context(lock_folder(run.results.path))
        run.progress = stack.enter_context(
            show_progress(progress, len(session.rig), run.n_frames or None, len(run.trackers))
        )
        states = run.restore_checkpoint() if run.options.resume else run.begin(stack)
        with ExitStack() as outputs:
            run.open_outputs(outputs, states)
            run.track_frames()
            run.finish_outputs()
        run.results.end()
    return run.make_result()


def _ignore(*_: object) -> None:
    pass


@dataclass(frozen=True)
class _Events:
    """Callbacks of `track_session`."""

    on_resume: Callable[[int], None]
    on_frame: Callable[[str, TrackedFrame], None]
    on_smoothing: Callable[[int], None]
    on_problem: Callable[[str], None]
    interrupted: Callable[[], bool] | None


class _SessionRun:
    """Steps of `track_session`, in their order, and their common state.

    Args:
        session, out, options: as for `track_session`.
        events: its callbacks.
    """

    progress: Progress

    def __init__(
        self, session: Session | LiveSession, out: Path | str | None, options: RunOptions, events: _Events
    ) -> None:
        if options.distributed is not None and not isinstance(session, Session):
            raise ValueError("distributed: nodes are simulated for recordings, not for live cameras")
        if options.calibration_covariance is not None:
            size = N_CAMERA_PARAMETERS * len(session.rig)
            name = f"calibration_covariance, for {len(session.rig)} cameras,"
            check_finite(options.calibration_covariance, (size, size), name)
        self.events, self.problems = events, list[str]()
        offsets = find_offsets(session) if options.offsets is None else dict(options.offsets)
        self._time_offsets: dict[str, float] | None = offsets
        if isinstance(session, Session):  # apply the offsets to its timestamps
            session = apply_offsets(session, offsets)
            self._time_offsets = None
        if options.mesh is not None:
            session = check_mesh_session(session, options.mesh)
        self.session = session
        self.n_frames = len(range(options.start, _end_frame(session, options.stop), max(options.every, 1)))
        self.known = name_known_objects(session, options.known)
        self.options = replace(options, offsets=offsets or None, smooth=_is_smoothed(options, session, self.n_frames))
        self.results, self.clock = _make_results_folder(session, out), StageTimer()
        check_output_folder(session, self.results.path)
        self._frames = session.frames(options.start, options.stop, options.every, self.report_problem)
        self._settings = self._collect_settings()
        self._saver: CheckpointWriter | None = None
        if isinstance(session, Session) and options.distributed is None and options.mesh is None:
            self._saver = CheckpointWriter(
                self.results.path, self._settings, session, options.checkpoint_seconds, self.report_problem, self.clock
            )
        if options.resume and self._saver is None:
            raise ValueError("a live session cannot be resumed: its frames are gone")
        self.trackers: dict[str, Tracker | NodesTracker | ContourTracker] = {}
        self._outputs: dict[str, ObjectOutput] = {}
        self._position = 0
        self._warnings = check_session(session, options.start)
        self._album = ThumbnailAlbum(len(session.rig))
        self._overlay: Overlay | None = None

    def report_problem(self, problem: str) -> None:
        """Store and report a problem."""
        self.problems.append(problem)
        self.events.on_problem(problem)

    def _collect_settings(self) -> dict[str, Any]:
        """Return the options that must be the same to resume."""
        names = ("method", "features", "seed", "start", "stop", "every", "candidate")
        return {name: getattr(self.options, name) for name in names} | {
            "mesh": None if self.options.mesh is None else self.options.mesh.checksum,
            "known": ", ".join(f"{name} {object_checksum(its)}" for name, its in self.known.items()) or None,
            "angles": self.options.angles,
            "smooth": self.options.smooth,
            "refine_calibration": self.options.refine_calibration or None,
            "self_calibrate": self.options.calibration_covariance is not None or None,
            "velocity": self.options.velocity or None,
            "offsets": self.options.offsets,
            "tracking": dict(self.options.tracking.changes) or None,
        }

    def open_trackers(self, stack: ExitStack) -> None:
        """Create a tracker for each object."""
        options = self.options
        if options.mesh is not None:
            assert isinstance(self.session, Session)
            with self.clock.measure("background"):
                self.trackers[self.session.objects[0]] = open_contour_tracker(self.session, options)
            return
        arguments: TrackerArguments = {"method": options.method, "features": options.features, "seed": options.seed}
        arguments |= {"offsets": self._time_offsets, "options": options.tracking}
        for name in self.session.objects:
            boxes = None if name in self.known else self.session.select_object(name).boxes or None
            own: TrackerArguments = {**arguments, **self._look_ahead(name, boxes)}
            if options.distributed is not None:
                nodes = NodesTracker(self.session.rig, boxes, mode=options.distributed, **own)
                self.trackers[name] = stack.enter_context(nodes)
                continue
            own["known_object"] = self.known.get(name)
            if isinstance(self.session, LiveSession) and self.session.is_real_time:
                own["search_clock"] = SearchClock()
            tracker = Tracker(self.session.rig, boxes, workers=options.workers, **own)
            self.trackers[name] = stack.enter_context(tracker)
            learned = tracker.transferred_object
            if options.refine_calibration and learned is not None and learned.is_other_rig:
                raise ValueError(
                    f"refine_calibration: {name} was learned with another rig, which does not constrain this one"
                )

    def _look_ahead(self, name: str, boxes: Mapping[str, Box] | None) -> TrackerArguments:
        """Search a recording: do the cameras agree, and which moving body is tracked if nothing else selects it?"""
        is_selected = bool(boxes) or name in self.known or self.session.masks is not None
        check_candidate(self.options.candidate, is_selected=is_selected, is_live=not isinstance(self.session, Session))
        if name in self.known or not isinstance(self.session, Session):
            return {}
        with self.clock.measure("search for what moves"):
            if is_selected:
                return {"f_ratio": compare_session_cameras(self.session, name, self.options)}
            candidate = select_candidate(self.session, self.options)
            return {} if candidate is None else {"candidate": candidate, "f_ratio": candidate.f_ratio}

    def begin(self, stack: ExitStack) -> dict[str, OutputState]:
        """Move earlier results away, which return if no frame is tracked, and write the first files."""
        self.results.move_earlier_results()

        def restore(error: object, *_: object) -> None:
            has_frames = self._position > 0 or any(output.n_frames for output in self._outputs.values())
            if error is not None and not has_frames:
                self.results.restore_earlier_results()

        stack.push(restore)
        states = {name: OutputState() for name in self.session.objects}
        write_run_metadata(self.results.path, self.session, self._settings, self._warnings)
        if self._saver is not None:
            self._saver.begin(self._make_state(states))
        return states

    def restore_checkpoint(self) -> dict[str, OutputState]:
        """Continue from the last checkpoint; return the state of each object's files."""
        assert self._saver is not None
        assert isinstance(self.session, Session)
        options = self.options
        self.results.recover()
        checkpoint = self._saver.load()
        position = self._position = checkpoint.position
        for name, tracker in self.trackers.items():
            if isinstance(tracker, Tracker):
                tracker.restore(checkpoint.trackers[name])
        first = options.start + position * options.every
        self._frames = _iterate_no_frames()
        if first < _end_frame(self.session, options.stop):
            self._frames = self.session.frames(first, options.stop, options.every, self.report_problem)
        if position:
            step = options.every * thumbnail_step(position)
            self._album.restore(position, self.session.frames(options.start, first, step, _ignore))
        self.progress.skip(position)
        self.events.on_resume(position)
        return checkpoint.outputs

    def _make_state(self, outputs: dict[str, OutputState]) -> RunState:
        trackers = {name: tracker.snapshot for name, tracker in self.trackers.items() if isinstance(tracker, Tracker)}
        return RunState(self._position, trackers, outputs)

    def open_outputs(self, stack: ExitStack, states: dict[str, OutputState]) -> None:
        """Open each object's files and the overlay video, and start reading."""
        session, options = self.session, self.options
        units = result_units(session, self.known, has_mesh=options.mesh is not None)
        rigs = {name: Rig(session.rig.cameras, unit) for name, unit in units.items()}
        for name, folder in zip(session.objects, self.results.folders, strict=True):
            tracker = self.trackers[name]
            self._outputs[name] = ObjectOutput(
                folder,
                rigs[name],
                options,
                self.clock,
                note=self._format_note(name),
                warnings=self._warnings,
                known=tracker.transferred_object if isinstance(tracker, Tracker) else None,
                album=self._album,
                resume=None if self._saver is None else states[name],
            )
            stack.callback(self._outputs[name].close)
        number = options.start + self._position * options.every
        self._overlay_path = self.results.path / (f"overlay_{number}.mp4" if self._position else "overlay.mp4")
        if options.overlay:
            rate = max(session.rate / options.every, 1.0) if session.rate else DEFAULT_OVERLAY_RATE
            rig, smooth = rigs[session.objects[0]], bool(options.smooth)
            self._overlay = Overlay(self._overlay_path, rig, rate, session.objects, self.clock, smooth=smooth)
            stack.enter_context(closing(self._overlay))
        stack.enter_context(closing(self._frames))

    def _format_note(self, name: str) -> str:
        """Return the report's note: recording, object, method, version and time."""
        of = self.session.path.resolve().name + (f", {name}" if len(self.session.objects) > 1 else "")
        how = f"method {self.options.method}" + (", refined jointly" if self.options.smooth else "")
        how = how if self.options.mesh is None else "outlines of a mesh"
        return f"{of}, {how}, sylpose {__version__}, {datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"

    def track_frames(self) -> None:
        """Track all frames, with a checkpoint from time to time.

        Raises:
            KeyboardInterrupt: the run was interrupted, after a checkpoint.
        """
        for frame_set in self.clock.measure_iteration("reading", self._frames):
            with self.clock.measure("plots"):
                self._album.put(frame_set)
            for name, tracker in self.trackers.items():
                with self.clock.measure("tracking"):
                    final_frames = tracker.step(frame_set.for_object(name))
                self._write_frames(name, final_frames)
            self._position += 1
            stopping = self.events.interrupted is not None and self.events.interrupted()
            if self._saver is not None and (stopping or self._saver.is_due):
                self._saver.save(
                    lambda: self._make_state({name: output.state() for name, output in self._outputs.items()})
                )
            if stopping:
                raise KeyboardInterrupt
        for name, tracker in self.trackers.items():
            with self.clock.measure("tracking"):
                final_frames = tracker.flush()
            self._write_frames(name, final_frames)

    def _write_frames(self, name: str, frames: list[TrackedFrame]) -> None:
        for tracked in frames:
            self._outputs[name].write(tracked)
            if tracked.note:
                self._report_problem_of(name, tracked.note)
            if self._overlay is not None:
                self._overlay.put(name, tracked)
            self.progress.update(tracked)
            self.events.on_frame(name, tracked)

    def _report_problem_of(self, name: str, problem: str) -> None:
        self.report_problem(problem if len(self._outputs) == 1 else f"{name}: {problem}")

    def finish_outputs(self) -> None:
        """Smooth the trajectories if requested, and write the learned objects."""
        for name, output in self._outputs.items():
            if sentence := output.finish(self._report_smoothing_round):
                self._report_problem_of(name, sentence)
        for name, tracker in self.trackers.items():
            if isinstance(tracker, Tracker) and self.options.method == METHODS[0]:
                self._outputs[name].write_object(tracker.build_known_object())

    def _report_smoothing_round(self, number: int) -> None:
        self.progress.report_smoothing_round(number)
        self.events.on_smoothing(number)

    def make_result(self) -> Run:
        """Return the result after all files are closed."""
        files = [file for output in self._outputs.values() for file in output.files]
        files += [self._overlay_path] if self.options.overlay else []
        files += [self.results.path / SETTINGS, self.results.path / USED_CALIBRATION]
        files += [self.results.path / WORLD] if self.session.world is not None else []
        trajectories = {name: output.trajectory for name, output in self._outputs.items()}
        changes = {name: tuple(output.changes) for name, output in self._outputs.items()}
        nodes = {name: tracker for name, tracker in self.trackers.items() if isinstance(tracker, NodesTracker)}
        network = {name: tracker.describe_cost() for name, tracker in nodes.items()}
        return Run(trajectories, tuple(files), tuple(self.problems), self.clock.seconds, changes, network)


def name_known_objects(
    session: Session | LiveSession, known: KnownObject | Mapping[str, KnownObject] | None
) -> dict[str, KnownObject]:
    """Return the known objects by name; a single one is the session's only object.

    Raises:
        ValueError: a name that is no object of the session, or none for one of several objects.
    """
    if isinstance(known, KnownObject):
        if len(session.objects) > 1:
            raise ValueError(f"known: several objects ({', '.join(session.objects)}): give them by name")
        known = {session.objects[0]: known}
    known = dict(known or {})
    if unknown := known.keys() - {*session.objects}:
        raise ValueError(f"known: no object {', '.join(map(repr, sorted(unknown)))} in {session.path}")
    return known


def _end_frame(session: Session | LiveSession, stop: int | None) -> int:
    """Return the frame before which tracking ends; 0 for a live session, which has no known end."""
    if session.n_frames is None:
        return 0
    return session.n_frames if stop is None else min(stop, session.n_frames)


def _is_smoothed(options: RunOptions, session: Session | LiveSession, frames: int) -> bool:
    if options.mesh is not None:
        return False
    requested = options.refine_calibration or options.smooth
    if requested and frames > MAX_SMOOTHED_FRAMES:
        raise ValueError(f"smooth: {frames} frames are more than the {MAX_SMOOTHED_FRAMES} that can be refined jointly")
    if requested is not None:
        return requested
    return isinstance(session, Session) and options.method == METHODS[0] and frames <= MAX_SMOOTHED_FRAMES


def _iterate_no_frames() -> Generator[FrameSet, None, None]:
    yield from ()
