"""Tracking of a whole session: trackers, trajectory files, plots and overlay video."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import ExitStack, closing
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from sylpose import __version__
from sylpose.frames import FrameSet
from sylpose.geometry.euler_angles import parse_euler_angles
from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.io.object_files import object_checksum
from sylpose.methods import FEATURES, METHODS, MODES, resolve_features
from sylpose.network.node_tracker import NodesTracker
from sylpose.report.formats import PICTURE_FORMATS
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.runs.checkpoint_schedule import CheckpointWriter
from sylpose.runs.checkpoint_schema import OutputState, RunState
from sylpose.runs.outputs import MAX_SMOOTHED_FRAMES, ObjectOutput, Overlay
from sylpose.runs.progress import ProgressCallback, show_progress
from sylpose.runs.results_folder import ResultsFolder, lock_folder
from sylpose.runs.run_metadata import SETTINGS, USED_CALIBRATION, WORLD, write_run_metadata
from sylpose.runs.run_result import Run
from sylpose.runs.session_options import check_output_folder
from sylpose.runs.thumbnails import ThumbnailAlbum, thumbnail_step
from sylpose.runs.timing import StageTimer
from sylpose.sync.offsets import apply_offsets, find_offsets
from sylpose.tracking.known_object import KnownObject
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import Tracker, TrackerSnapshot
from sylpose.units import INITIAL_DISTANCES

__all__ = ["CHECKPOINT_SECONDS", "Run", "has_finished", "output_path", "result_unit", "track_session"]

# Frame rate of the overlay if the recording has none, frames per second.
DEFAULT_OVERLAY_RATE = 2.0
# Seconds between two checkpoints (choice: acceptable loss of work).
CHECKPOINT_SECONDS = 20.0


def output_path(session: Session | LiveSession, out: Path | str | None = None) -> Path:
    """Return the folder of a run's files; the default is `sylpose` in the session's folder."""
    return session.path / "sylpose" if out is None else Path(out)


def result_unit(rig: Rig, known: KnownObject | None = None) -> str:
    """Return the length unit of a run's results.

    With one camera it is the calibration's unit only if the object's size is known, otherwise `INITIAL_DISTANCES`.
    """
    return rig.unit if len(rig) > 1 or (known is not None and known.unit != INITIAL_DISTANCES) else INITIAL_DISTANCES


def has_finished(session: Session | LiveSession, out: Path | str | None = None) -> bool:
    """Return whether a run in this folder has finished, so that there is nothing to resume."""
    return _make_results_folder(session, out).has_finished


def _make_results_folder(session: Session | LiveSession, out: Path | str | None) -> ResultsFolder:
    return ResultsFolder(output_path(session, out), session.objects if len(session.objects) > 1 else ())


def track_session(
    session: Session | LiveSession,
    out: Path | str | None = None,
    *,
    method: str = METHODS[0],
    features: str = FEATURES[0],
    offsets: Mapping[str, float] | None = None,
    start: int = 0,
    stop: int | None = None,
    every: int = 1,
    overlay: bool = True,
    smooth: bool | None = None,
    refine_calibration: bool = False,
    plot_format: str = "png",
    angles: str | None = None,
    known: KnownObject | Mapping[str, KnownObject] | None = None,
    seed: int = 0,
    workers: int | None = None,
    distributed: str | None = None,
    resume: bool = False,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    progress: bool | ProgressCallback | None = None,
    on_resume: Callable[[int], None] | None = None,
    on_frame: Callable[[TrackedFrame], None] | None = None,
    on_pose: Callable[[str, FramePose], None] | None = None,
    on_smoothing: Callable[[int], None] | None = None,
    on_problem: Callable[[str], None] | None = None,
    interrupted: Callable[[], bool] | None = None,
) -> Run:
    """Track a session and write `trajectory.tum`, `trajectory.csv`, `report.png`, `report.html` and `overlay.mp4`.

    Several objects get one folder each, with the first four files. If an exception ends the run early (Ctrl-C, a full
    disk, a bug), the trajectory files contain the frames solved so far, and `report.png` and `overlay.mp4` are
    completed before the exception propagates. If a run with smoothing is killed, its frames are in `tracked.tum` and
    `tracked.csv`. `resume` continues from the last checkpoint and yields the same trajectories as an uninterrupted run.

    Args:
        session: session from `open_session` or `open_live`.
        out: folder for the files, which are replaced; None for `sylpose` in the session's folder.
        method, features, seed: as in `track`.
        offsets: as in `track`; None for those of `offsets.toml` in the session's folder, if it exists.
        start, stop, every: frames start, start + every, ... below stop.
        overlay: write `overlay.mp4`.
        smooth: refine all poses jointly at the end (`sylpose.smoothing`); the poses as tracked go to `tracked.tum` and
            `tracked.csv`. None: for recordings of up to 10,000 frames, with the method "landmarks".
        refine_calibration: smooth, and refine the calibration with the poses; it goes to `calibration.refined.toml`.
        plot_format: file format of the report: "png", "svg" or "pdf".
        angles: Euler angles in the report and additionally in trajectory.csv: "XYZ" (intrinsic axes), "xyz" (extrinsic
            axes), or three vectors, "0,0,1 1,0,0 0,1,0" (intrinsic).
        known: object model, or models by name, from another recording (`io.object_files`); poses are expressed in its
            frame. Boxes of these objects are not used.
        workers: as in `track`; the result does not depend on it.
        distributed: None for one process; "exact" or "compact" for one node per camera over a simulated network
            (`network.node_tracker`), for recordings only.
        resume: continue the interrupted run in `out`, which must have had the same options.
        checkpoint_seconds: time between two checkpoints; 0 for one after every frame. Live sessions have none.
        progress: True for a progress bar in a terminal or a notebook; or a function that is called with the number of
            tracked frames and the total (None for live sessions). None shows nothing.
        on_resume: called with the number of frames that the interrupted run has solved.
        on_frame: called with each frame once it is in the trajectory files, once per object.
        on_pose: called with the object's name and its pose in each frame, as it is tracked.
        on_smoothing: called with the number of each round of the joint refinement.
        on_problem: called with a message for each truncated file and each frame that cannot be read.
        interrupted: called after each frame; if it returns True, a checkpoint is written and KeyboardInterrupt raised.

    Returns:
        The trajectories, the files written and the problems found.

    Raises:
        ValueError: frames outside the session, an unknown method, features that it cannot use, or boxes whose rays do
            not meet; `resume` with other options or another session than the interrupted run, or for a live session.
        FileNotFoundError: `resume` without an interrupted run.
        OSError: a file or folder cannot be written or read; the message names it.
    """
    resolve_features(method, features)
    if not checkpoint_seconds >= 0:
        raise ValueError(f"--checkpoint must be a number of seconds, 0 or more, got {checkpoint_seconds}")
    if plot_format not in PICTURE_FORMATS:
        raise ValueError(f"plot_format must be one of {', '.join(PICTURE_FORMATS)}, got {plot_format!r}")
    euler_angles = None if angles is None else parse_euler_angles(angles)
    if workers is not None and workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    if distributed is not None:
        _check_distributed(distributed, session, resume=resume, known=bool(known))
    smooth = True if refine_calibration else smooth
    offsets = find_offsets(session) if offsets is None else dict(offsets)
    if isinstance(session, Session):  # apply the offsets to its timestamps
        session, time_offsets = apply_offsets(session, [offsets.get(name, 0.0) for name in session.rig.names]), None
    else:
        time_offsets = offsets
    problems: list[str] = []

    def report_problem(problem: str) -> None:
        problems.append(problem)
        if on_problem is not None:
            on_problem(problem)

    n_frames = len(range(start, _end_frame(session, stop), max(every, 1)))
    smooth = _is_smoothed(smooth, session, method, n_frames)
    settings = {"method": method, "features": features, "seed": seed, "start": start, "stop": stop, "every": every}
    if isinstance(known, KnownObject):
        if len(session.objects) > 1:
            raise ValueError(f"known: several objects ({', '.join(session.objects)}): give them by name")
        known = {session.objects[0]: known}
    known = dict(known or {})
    if unknown := known.keys() - {*session.objects}:
        raise ValueError(f"known: no object {', '.join(map(repr, sorted(unknown)))} in {session.path}")
    settings["known"] = ", ".join(f"{name} {object_checksum(its)}" for name, its in known.items()) or None
    settings |= {
        "angles": angles,
        "smooth": smooth,
        "refine_calibration": refine_calibration or None,
        "offsets": offsets or None,
    }
    results, clock = _make_results_folder(session, out), StageTimer()
    check_output_folder(session, results.path)
    frames = session.frames(start, stop, every, report_problem)
    saver = None
    if isinstance(session, Session) and distributed is None:
        saver = CheckpointWriter(results.path, settings, session, checkpoint_seconds, report_problem, clock)
    options: dict[str, Any] = {"method": method, "features": features, "offsets": time_offsets, "seed": seed}
    make_tracker: Any = partial(Tracker, workers=workers)
    if distributed is not None:
        make_tracker = partial(NodesTracker, mode=distributed)
    rigs = {name: Rig(session.rig.cameras, result_unit(session.rig, known.get(name))) for name in session.objects}
    if resume and saver is None:
        raise ValueError("a live session cannot be resumed: its frames are gone")
    with ExitStack() as run_stack:
        trackers: dict[str, Tracker | NodesTracker] = {}
        for name in session.objects:
            boxes = None if name in known else session.select_object(name).boxes or None
            extra = {"known_object": known[name]} if name in known else {}
            tracker = trackers[name] = run_stack.enter_context(make_tracker(session.rig, boxes, **options, **extra))
            if (
                refine_calibration
                and isinstance(tracker, Tracker)
                and tracker.transferred_object
                and tracker.transferred_object.is_other_rig
            ):
                raise ValueError(
                    f"refine_calibration: {name} was learned with another rig, which does not constrain this one"
                )
        if resume and not results.path.is_dir():
            raise FileNotFoundError(f"{results.path}: no interrupted run to resume (there is no such folder)")
        # Nothing has been written up to here.
        run_stack.enter_context(lock_folder(results.path))
        progress_display = run_stack.enter_context(
            show_progress(progress, len(session.rig), n_frames or None, len(trackers))
        )
        position, states = 0, {name: OutputState() for name in session.objects}
        album, warnings = ThumbnailAlbum(len(session.rig)), _find_warnings(session, start)
        outputs: dict[str, ObjectOutput] = {}

        def has_frames() -> bool:
            return position > 0 or any(output.n_frames for output in outputs.values())

        if resume and saver is not None and isinstance(session, Session):
            results.recover()
            checkpoint = saver.load()
            position, states = checkpoint.position, checkpoint.outputs
            for name, tracker in trackers.items():
                if isinstance(tracker, Tracker):
                    tracker.restore(checkpoint.trackers[name])
            frames = _remaining_frames(session, start, stop, every, position, report_problem)
            if position:
                first = start + position * every
                album.restore(position, session.frames(start, first, every * thumbnail_step(position), lambda _: None))
            progress_display.skip(position)
            if on_resume is not None:
                on_resume(position)
        else:
            results.move_earlier_results()
            run_stack.push(
                lambda error, *_: results.restore_earlier_results() if error is not None and not has_frames() else None
            )
            write_run_metadata(results.path, session, settings, warnings)
            if saver is not None:
                saver.begin(RunState(0, _collect_snapshots(trackers), states))

        stack = run_stack.enter_context(ExitStack())
        for name, folder in zip(session.objects, results.folders, strict=True):
            state, tracker = None if saver is None else states[name], trackers[name]
            outputs[name] = ObjectOutput(
                folder,
                rigs[name],
                clock,
                smooth=smooth,
                recalibrate=refine_calibration,
                plot_format=plot_format,
                angles=euler_angles,
                note=_format_note(session, name, method, smooth),
                warnings=warnings,
                known=tracker.transferred_object if isinstance(tracker, Tracker) else None,
                album=album,
                resume=state,
            )
            stack.callback(outputs[name].close)
        overlay_video = None
        overlay_path = results.path / (f"overlay_{start + position * every}.mp4" if position else "overlay.mp4")
        if overlay:
            rate = max(session.rate / every, 1.0) if session.rate else DEFAULT_OVERLAY_RATE
            overlay_video = stack.enter_context(
                closing(Overlay(overlay_path, rigs[session.objects[0]], rate, session.objects, clock, smooth=smooth))
            )

        def write_frames(name: str, decided: list[TrackedFrame]) -> None:
            for tracked in decided:
                outputs[name].write(tracked)
                if tracked.note:
                    report_problem(tracked.note if len(outputs) == 1 else f"{name}: {tracked.note}")
                if overlay_video is not None:
                    overlay_video.put(name, tracked)
                progress_display.update(tracked)
                if on_frame is not None:
                    on_frame(tracked)
                if on_pose is not None:
                    on_pose(name, tracked.pose)

        def report_round(number: int) -> None:
            progress_display.report_smoothing_round(number)
            if on_smoothing is not None:
                on_smoothing(number)

        def current_state() -> RunState:
            return RunState(
                position, _collect_snapshots(trackers), {name: output.state() for name, output in outputs.items()}
            )

        stack.enter_context(closing(frames))
        for frame_set in clock.measure_iteration("reading", frames):
            with clock.measure("plots"):
                album.put(frame_set)
            for name, tracker in trackers.items():
                with clock.measure("tracking"):
                    final_frames = tracker.step(frame_set.for_object(name))
                write_frames(name, final_frames)
            position += 1
            stopping = interrupted is not None and interrupted()
            if saver is not None and (stopping or saver.is_due):
                saver.save(current_state)
            if stopping:
                raise KeyboardInterrupt
        for name, tracker in trackers.items():
            with clock.measure("tracking"):
                final_frames = tracker.flush()
            write_frames(name, final_frames)
        for name, output in outputs.items():
            if sentence := output.finish(report_round):
                report_problem(sentence if len(outputs) == 1 else f"{name}: {sentence}")
        for name, tracker in trackers.items():
            if isinstance(tracker, Tracker) and method == METHODS[0]:
                outputs[name].write_object(tracker.build_known_object())
        stack.close()
        results.end()
    files = [file for output in outputs.values() for file in output.files] + ([overlay_path] if overlay else [])
    files += [results.path / SETTINGS, results.path / USED_CALIBRATION]
    files += [results.path / WORLD] if session.world is not None else []
    trajectories = {name: output.trajectory for name, output in outputs.items()}
    changes = {name: tuple(output.changes) for name, output in outputs.items()}
    network = {name: tracker.describe_cost() for name, tracker in trackers.items() if isinstance(tracker, NodesTracker)}
    return Run(trajectories, tuple(files), tuple(problems), clock.seconds, changes, network)


def _format_note(session: Session | LiveSession, name: str, method: str, smooth: bool) -> str:
    """Return the report's note: recording, object, method, version and time."""
    of = session.path.resolve().name + (f", {name}" if len(session.objects) > 1 else "")
    how = f"method {method}" + (", refined jointly" if smooth else "")
    return f"{of}, {how}, sylpose {__version__}, {datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"


def _find_warnings(session: Session | LiveSession, start: int) -> list[str]:
    """Return the warnings about the session, as `sylpose check` finds them."""
    from sylpose.runs.check import check_session

    return check_session(session, start)


def _check_distributed(distributed: str, session: Session | LiveSession, *, resume: bool, known: bool) -> None:
    """Raise ValueError for options that simulated nodes do not support."""
    if distributed not in MODES:
        raise ValueError(f"distributed: {distributed!r} is neither of {', '.join(MODES)}")
    if resume:
        raise ValueError("distributed: nodes write no checkpoints, so there is nothing to resume")
    if known:
        raise ValueError("distributed: nodes do not support known objects")
    if not isinstance(session, Session):
        raise ValueError("distributed: nodes are simulated for recordings, not for live cameras")


def _collect_snapshots(trackers: Mapping[str, Tracker | NodesTracker]) -> dict[str, TrackerSnapshot]:
    return {name: tracker.snapshot for name, tracker in trackers.items() if isinstance(tracker, Tracker)}


def _end_frame(session: Session | LiveSession, stop: int | None) -> int:
    """Return the frame before which tracking ends; 0 for a live session, which has no known end."""
    if session.n_frames is None:
        return 0
    return session.n_frames if stop is None else min(stop, session.n_frames)


def _is_smoothed(requested: bool | None, session: Session | LiveSession, method: str, frames: int) -> bool:
    if requested and frames > MAX_SMOOTHED_FRAMES:
        raise ValueError(f"smooth: {frames} frames are more than the {MAX_SMOOTHED_FRAMES} that can be refined jointly")
    if requested is not None:
        return requested
    return isinstance(session, Session) and method == METHODS[0] and frames <= MAX_SMOOTHED_FRAMES


def _remaining_frames(
    session: Session, start: int, stop: int | None, every: int, position: int, on_problem: Callable[[str], None]
) -> Generator[FrameSet, None, None]:
    """Return the frames that remain after the first `position` ones."""
    first = start + position * every
    if first < _end_frame(session, stop):
        return session.frames(first, stop, every, on_problem)
    return _iterate_no_frames()


def _iterate_no_frames() -> Generator[FrameSet, None, None]:
    nothing: Iterator[FrameSet] = iter(())
    yield from nothing
