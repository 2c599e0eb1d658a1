"""A recording tracked from end to end: session -> trackers -> trajectory files, plots and overlay video."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import ExitStack, closing
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from sylpose import __version__
from sylpose.app.checkpoint_schedule import Saver
from sylpose.app.checkpoint_schema import OutputState, RunState
from sylpose.app.object_files import checksum_of
from sylpose.app.outputs import MAX_SMOOTHED, ObjectOutput, Overlay
from sylpose.app.progress import Watcher, watched
from sylpose.app.results_folder import ResultsFolder, alone_in
from sylpose.app.run_metadata import SETTINGS, USED, WORLD, write_record
from sylpose.app.run_result import Run
from sylpose.app.session_options import check_out
from sylpose.app.thumbnails import Album, step_after
from sylpose.app.timing import Clock
from sylpose.capture import Session
from sylpose.capture.live import LiveSession
from sylpose.frames import FrameSet
from sylpose.geometry.euler_angles import angles_of
from sylpose.methods import FEATURES, METHODS, MODES, features_of
from sylpose.network.node_tracker import NodesTracker
from sylpose.report.formats import FORMATS
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.sync.offsets import find_offsets, retimed
from sylpose.tracking.known_object import KnownObject
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import Memory, Tracker
from sylpose.units import FIRST_DISTANCES

__all__ = ["CHECKPOINT_SECONDS", "Run", "has_ended", "output_path", "track_session", "unit_of"]

# Of the overlay where a recording does not say its rate, frames per second.
IMAGE_RATE = 2.0
# Seconds between two checkpoints (choice: what one may lose).
CHECKPOINT_SECONDS = 20.0


def output_path(session: Session | LiveSession, out: Path | str | None = None) -> Path:
    """Where a run's files go: `sylpose` in the session's folder when nothing else is said."""
    return session.path / "sylpose" if out is None else Path(out)


def unit_of(rig: Rig, known: KnownObject | None = None) -> str:
    """What a run tells lengths in; with one camera only an object of known size tells them in the calibration's unit."""
    return rig.unit if len(rig) > 1 or (known is not None and known.unit != FIRST_DISTANCES) else FIRST_DISTANCES


def has_ended(session: Session | LiveSession, out: Path | str | None = None) -> bool:
    """Whether a run wrote its files there and came to its end: there is nothing to resume."""
    return _folder_of(session, out).has_ended


def _folder_of(session: Session | LiveSession, out: Path | str | None) -> ResultsFolder:
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
    progress: bool | Watcher | None = None,
    on_resume: Callable[[int], None] | None = None,
    on_frame: Callable[[TrackedFrame], None] | None = None,
    on_pose: Callable[[str, FramePose], None] | None = None,
    on_smoothing: Callable[[int], None] | None = None,
    on_problem: Callable[[str], None] | None = None,
    interrupted: Callable[[], bool] | None = None,
) -> Run:
    """Track a session and write `trajectory.tum`, `trajectory.csv`, `report.png`, `report.html` and `overlay.mp4`.

    Of several objects, each has a folder of its name with the first four. Whatever ends it early (Ctrl-C, a full disk, a
    bug), the frames solved until then are in the trajectory files, and `report.png` and `overlay.mp4` are finished with
    them before the exception goes on; of a run that is killed they are in `tracked.tum` and `tracked.csv`, if it was to be
    smoothed. `resume` goes on from the last checkpoint, and comes to the same trajectories as if there had been no
    interruption.

    Args:
        session: of `open_session` or `open_live`.
        out: folder for the files; None: `sylpose` in the session's folder. Files of these names in it are replaced.
        method, features, seed: as in `track`.
        offsets: as in `track`; None for those of `offsets.toml` in the session's folder, if there are any.
        start, stop, every: frames start, start + every, ... below stop.
        overlay: False leaves `overlay.mp4` out.
        smooth: refine all poses together at the end (`sylpose.smoothing`); as tracked they are in `tracked.tum` and .csv.
            None: recordings of up to 10,000 frames, with the method "landmarks".
        refine_calibration: smooth, and refine the calibration with the poses; it goes to `calibration.refined.toml`.
        plot_format: of the report: "png", "svg" or "pdf".
        angles: three more in trajectory.csv, and those of the report: "XYZ" (about axes that turn along), "xyz" (that
            stand), or three vectors, "0,0,1 1,0,0 0,1,0" (that turn along).
        known: the object, or objects by name, as another take has learnt them (`app.object_files`): their poses are told in
            the frame that they had there. Their boxes are not used.
        workers: as in `track`; the result does not depend on it.
        distributed: None for one process; "exact" or "compact": by nodes, one for each camera, over a simulated network
            (`network.node_tracker`), of a recording.
        resume: go on with the run in `out` that was interrupted. It must have had the same options.
        checkpoint_seconds: between two checkpoints; 0 for one after every frame. Live sessions have none.
        progress: True for a bar in a terminal or a notebook; or called with the numbers of frames that are tracked and that
            there are (None for live sessions). None: nothing is shown.
        on_resume: called with the number of frames that the interrupted run has solved.
        on_frame: called with each frame once it is in the trajectory files; of several objects, with each of them.
        on_pose: called with the object's name and its pose in each frame, as it is tracked.
        on_smoothing: called with the number of each round in which the poses are refined together.
        on_problem: called with a sentence for each file that breaks off and each frame that cannot be read.
        interrupted: asked after each frame; when it says True, a checkpoint is written and KeyboardInterrupt raised.

    Raises:
        ValueError: frames that the session does not have, an unknown method, features that it cannot use, boxes that do
            not meet in space; `resume` with other options or another session than the interrupted run's, or of a live
            session.
        FileNotFoundError: `resume` without an interrupted run.
        OSError: naming the file or folder that cannot be written or read.
    """
    features_of(method, features)
    if not checkpoint_seconds >= 0:
        raise ValueError(f"--checkpoint must be a number of seconds, 0 or more, got {checkpoint_seconds}")
    if plot_format not in FORMATS:
        raise ValueError(f"plot_format must be one of {', '.join(FORMATS)}, got {plot_format!r}")
    about = None if angles is None else angles_of(angles)
    if workers is not None and workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    if distributed is not None:
        _refuse(distributed, session, resume=resume, known=bool(known))
    smooth = True if refine_calibration else smooth
    offsets = find_offsets(session) if offsets is None else dict(offsets)
    if isinstance(session, Session):  # then they are in its time stamps
        session, late = retimed(session, [offsets.get(name, 0.0) for name in session.rig.names]), None
    else:
        late = offsets
    problems: list[str] = []

    def said(problem: str) -> None:
        problems.append(problem)
        if on_problem is not None:
            on_problem(problem)

    number = len(range(start, _end(session, stop), max(every, 1)))
    smooth = _is_smoothed(smooth, session, method, number)
    asked = {"method": method, "features": features, "seed": seed, "start": start, "stop": stop, "every": every}
    if isinstance(known, KnownObject):
        if len(session.objects) > 1:
            raise ValueError(f"known: several objects ({', '.join(session.objects)}): give them by name")
        known = {session.objects[0]: known}
    known = dict(known or {})
    if unknown := known.keys() - {*session.objects}:
        raise ValueError(f"known: no object {', '.join(map(repr, sorted(unknown)))} in {session.path}")
    asked["known"] = ", ".join(f"{name} {checksum_of(its)}" for name, its in known.items()) or None
    asked |= {
        "angles": angles,
        "smooth": smooth,
        "refine_calibration": refine_calibration or None,
        "offsets": offsets or None,
    }
    results, clock = _folder_of(session, out), Clock()
    check_out(session, results.path)
    frames = session.frames(start, stop, every, said)
    saver = None
    if isinstance(session, Session) and distributed is None:
        saver = Saver(results.path, asked, session, checkpoint_seconds, said, clock)
    options: dict[str, Any] = {"method": method, "features": features, "offsets": late, "seed": seed}
    of: Any = partial(Tracker, workers=workers)
    if distributed is not None:
        of = partial(NodesTracker, mode=distributed)
    rigs = {name: Rig(session.rig.cameras, unit_of(session.rig, known.get(name))) for name in session.objects}
    if resume and saver is None:
        raise ValueError("a live session cannot be resumed: what was not tracked then is gone")
    with ExitStack() as whole:
        trackers: dict[str, Tracker | NodesTracker] = {}
        for name in session.objects:
            boxes = None if name in known else session.of(name).boxes or None
            more = {"known": known[name]} if name in known else {}
            tracker = trackers[name] = whole.enter_context(of(session.rig, boxes, **options, **more))
            if refine_calibration and isinstance(tracker, Tracker) and tracker.known and tracker.known.another_rig:
                raise ValueError(
                    f"refine_calibration: another rig has learnt {name}, and what that saw tells nothing of this one"
                )
        if resume and not results.path.is_dir():
            raise FileNotFoundError(f"{results.path}: no interrupted run to resume (there is no such folder)")
        # Up to here nothing was written.
        whole.enter_context(alone_in(results.path))
        shown = whole.enter_context(watched(progress, len(session.rig), number or None, len(trackers)))
        position, states = 0, {name: OutputState() for name in session.objects}
        album, noticed = Album(len(session.rig)), _noticed(session, start)
        outputs: dict[str, ObjectOutput] = {}

        def begun() -> bool:
            return position > 0 or any(output.n_frames for output in outputs.values())

        if resume and saver is not None and isinstance(session, Session):
            results.recover()
            saved = saver.load()
            position, states = saved.position, saved.outputs
            for name, tracker in trackers.items():
                if isinstance(tracker, Tracker):
                    tracker.go_back(saved.trackers[name])
            frames = _rest(session, start, stop, every, position, said)
            if position:
                first = start + position * every
                album.go_on(position, session.frames(start, first, every * step_after(position), lambda _: None))
            shown.skip(position)
            if on_resume is not None:
                on_resume(position)
        else:
            results.set_aside()
            whole.push(lambda error, *_: results.put_back() if error is not None and not begun() else None)
            write_record(results.path, session, asked, noticed)
            if saver is not None:
                saver.begin(RunState(0, _memories(trackers), states))

        stack = whole.enter_context(ExitStack())
        for name, own in zip(session.objects, results.folders, strict=True):
            state, tracker = None if saver is None else states[name], trackers[name]
            outputs[name] = ObjectOutput(
                own,
                rigs[name],
                clock,
                smooth=smooth,
                recalibrate=refine_calibration,
                plot_format=plot_format,
                angles=about,
                note=_note(session, name, method, smooth),
                noticed=noticed,
                known=tracker.known if isinstance(tracker, Tracker) else None,
                album=album,
                resume=state,
            )
            stack.callback(outputs[name].close)
        drawing = None
        overlay_path = results.path / (f"overlay_{start + position * every}.mp4" if position else "overlay.mp4")
        if overlay:
            rate = max(session.rate / every, 1.0) if session.rate else IMAGE_RATE
            drawing = stack.enter_context(
                closing(Overlay(overlay_path, rigs[session.objects[0]], rate, session.objects, clock, smooth=smooth))
            )

        def take(name: str, decided: list[TrackedFrame]) -> None:
            for tracked in decided:
                outputs[name].write(tracked)
                if tracked.note:
                    said(tracked.note if len(outputs) == 1 else f"{name}: {tracked.note}")
                if drawing is not None:
                    drawing.put(name, tracked)
                shown.update(tracked)
                if on_frame is not None:
                    on_frame(tracked)
                if on_pose is not None:
                    on_pose(name, tracked.pose)

        def refined(number: int) -> None:
            shown.smoothing(number)
            if on_smoothing is not None:
                on_smoothing(number)

        def state_now() -> RunState:
            return RunState(position, _memories(trackers), {name: output.state() for name, output in outputs.items()})

        stack.enter_context(closing(frames))
        for frame_set in clock.around("reading", frames):
            with clock.part("plots"):
                album.put(frame_set)
            for name, tracker in trackers.items():
                with clock.part("tracking"):
                    decided = tracker.step(frame_set.of(name))
                take(name, decided)
            position += 1
            stopping = interrupted is not None and interrupted()
            if saver is not None and (stopping or saver.is_due):
                saver.save(state_now)
            if stopping:
                raise KeyboardInterrupt
        for name, tracker in trackers.items():
            with clock.part("tracking"):
                decided = tracker.flush()
            take(name, decided)
        for name, output in outputs.items():
            if sentence := output.finish(refined):
                said(sentence if len(outputs) == 1 else f"{name}: {sentence}")
        for name, tracker in trackers.items():
            if isinstance(tracker, Tracker) and method == METHODS[0]:
                outputs[name].write_object(tracker.learnt())
        stack.close()
        results.end()
    files = [file for output in outputs.values() for file in output.files] + ([overlay_path] if overlay else [])
    files += [results.path / SETTINGS, results.path / USED]
    files += [results.path / WORLD] if session.world is not None else []
    trajectories = {name: output.trajectory for name, output in outputs.items()}
    changes = {name: tuple(output.changes) for name, output in outputs.items()}
    network = {name: tracker.cost() for name, tracker in trackers.items() if isinstance(tracker, NodesTracker)}
    return Run(trajectories, tuple(files), tuple(problems), clock.seconds, changes, network)


def _note(session: Session | LiveSession, name: str, method: str, smooth: bool) -> str:
    """What a report is of."""
    of = session.path.resolve().name + (f", {name}" if len(session.objects) > 1 else "")
    how = f"method {method}" + (", refined together" if smooth else "")
    return f"{of}, {how}, sylpose {__version__}, {datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"


def _noticed(session: Session | LiveSession, start: int) -> list[str]:
    """What looks wrong before the run."""
    from sylpose.app.check import concerns

    return concerns(session, start)


def _refuse(distributed: str, session: Session | LiveSession, *, resume: bool, known: bool) -> None:
    """What nodes cannot do."""
    if distributed not in MODES:
        raise ValueError(f"distributed: {distributed!r} is neither of {', '.join(MODES)}")
    if resume:
        raise ValueError("distributed: nodes leave no checkpoint, so there is nothing to resume")
    if known:
        raise ValueError("distributed: nodes begin with no known object")
    if not isinstance(session, Session):
        raise ValueError("distributed: nodes are simulated for recordings, not for live cameras")


def _memories(trackers: Mapping[str, Tracker | NodesTracker]) -> dict[str, Memory]:
    return {name: tracker.memory for name, tracker in trackers.items() if isinstance(tracker, Tracker)}


def _end(session: Session | LiveSession, stop: int | None) -> int:
    """The frame before which tracking ends; 0 of a live session, where that is not known."""
    if session.n_frames is None:
        return 0
    return session.n_frames if stop is None else min(stop, session.n_frames)


def _is_smoothed(asked: bool | None, session: Session | LiveSession, method: str, frames: int) -> bool:
    if asked and frames > MAX_SMOOTHED:
        raise ValueError(f"smooth: {frames} frames are more than the {MAX_SMOOTHED} that can be refined together")
    if asked is not None:
        return asked
    return isinstance(session, Session) and method == METHODS[0] and frames <= MAX_SMOOTHED


def _rest(
    session: Session, start: int, stop: int | None, every: int, position: int, on_problem: Callable[[str], None]
) -> Generator[FrameSet, None, None]:
    """The frames that are left after the first `position` ones."""
    first = start + position * every
    if first < _end(session, stop):
        return session.frames(first, stop, every, on_problem)
    return _nothing()


def _nothing() -> Generator[FrameSet, None, None]:
    nothing: Iterator[FrameSet] = iter(())
    yield from nothing
