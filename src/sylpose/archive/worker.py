"""Work on one recording: fetch it if remote, track it as `sylpose track` does, and summarize the result."""

from __future__ import annotations

import functools
import os
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

import sylpose
from sylpose.archive.contract import Summary
from sylpose.archive.recordings import Recording
from sylpose.archive.stores import is_url, open_store
from sylpose.input_limits import to_one_line
from sylpose.io.capture import open_session
from sylpose.report.camera_consistency import describe_camera_problems
from sylpose.results import Trajectory
from sylpose.runs.run import Run, track_session
from sylpose.runs.session_warnings import explain_failures
from sylpose.runs.world import WorldSpec, apply_world_and_unit, is_world_text
from sylpose.simulate import make_demo_scene, write_sequence
from sylpose.sync.offsets import find_offsets

__all__ = ["compile_kernels_once", "summarize_run", "track_recording"]

# Largest number of messages in a summary (choice: enough to identify the problem).
MAX_MESSAGES = 20


def track_recording(recording: Recording, folder: Path, threads: int) -> Summary:
    """Track a recording; the files of `sylpose track` go into `results` below a folder.

    Args:
        recording: the recording.
        folder: folder for copies and results.
        threads: number of threads.

    Raises:
        ValueError, OSError: as `open_session` and `track_session`; messages name the original instead of a copy.
    """
    compile_kernels_once()
    copies: dict[str, str] = {}

    def local(url: str | None, name: str) -> Path | None:
        if url is None or not is_url(url):
            return None if url is None else Path(url)
        copies[str(folder / name)] = url
        return _fetch(url, folder / name)

    try:
        path = local(recording.url, "recording")
        assert path is not None
        session = open_session(
            path,
            calibration=local(recording.calibration, "given_calibration"),
            boxes=local(recording.boxes, "given_boxes"),
            masks=local(recording.masks, "given_masks"),
        )
        options = msgspec.structs.asdict(recording.options)
        unit, world = options.pop("unit"), options.pop("world")
        if world is not None:
            world = WorldSpec(world if is_world_text(world) else str(local(world, "given_world.toml")))
        session = apply_world_and_unit(session, world, unit)
        run = track_session(
            session,
            folder / "results",
            offsets=find_offsets(session, local(recording.offsets, "given_offsets")),
            checkpoint_seconds=float("inf"),
            workers=threads,
            **options,
        )
        return summarize_run(run, explain_failures(session, run), session.warnings)
    except (ValueError, OSError) as error:
        message = str(error)
        for copy, url in copies.items():
            message = message.replace(copy, url)
        if message == str(error):
            raise
        raise type(error)(message) from error


def summarize_run(run: Run, missing: list[str], notes: tuple[str, ...] = ()) -> Summary:
    """Summarize a run.

    Args:
        run: the finished run.
        missing: a message for each object without any pose.
        notes: further messages.
    """
    has_several_objects = len(run.trajectories) > 1
    residuals = [
        value for trajectory in run.trajectories.values() if (value := _compute_residual(trajectory)) is not None
    ]
    faults = [
        f"{name}: {message}" if has_several_objects else message
        for name, trajectory in run.trajectories.items()
        for message in describe_camera_problems(trajectory)
    ]
    return Summary(
        status="nothing found" if len(missing) == len(run.trajectories) else "done",
        frames=max(len(trajectory) for trajectory in run.trajectories.values()),
        coverage=min(_compute_coverage(trajectory) for trajectory in run.trajectories.values()),
        residual_px=round(max(residuals), 4) if residuals else None,
        faults=tuple(faults[:MAX_MESSAGES]),
        error=" ".join(missing),
        notes=(*notes, *run.problems)[:MAX_MESSAGES],
    )


def _compute_coverage(trajectory: Trajectory) -> float:
    return round(float(np.mean([frame.is_measured for frame in trajectory])), 4) if len(trajectory) else 0.0


def _compute_residual(trajectory: Trajectory) -> float | None:
    values = np.concatenate([frame.residuals for frame in trajectory if frame.is_measured] or [np.empty(0)])
    values = values[np.isfinite(values) & (values > 0)]
    return float(np.median(values)) if len(values) else None


def _fetch(url: str, target: Path) -> Path:
    """Copy a file, or all files below a folder, from an object store."""
    source = open_store(url)
    files = source.files()
    if not files:
        folder, _, name = url.rpartition("/")
        open_store(folder).fetch(name, target.with_suffix(Path(name).suffix))
        return target.with_suffix(Path(name).suffix)
    for file in files:
        if ".." in file.name.split("/") or file.name.startswith("/"):
            raise ValueError(f"{url}: a file named {to_one_line(file.name)} cannot belong to a recording")
        if not file.name.startswith("sylpose/"):
            there = target / file.name
            if not there.exists() or there.stat().st_size != file.size:  # retry after an I/O error
                source.fetch(file.name, there)
    return target


@functools.cache
def compile_kernels_once() -> None:
    """Compile the tracking kernels once per computer; other processes wait for the first."""
    sources = Path(sylpose.__file__).parent.rglob("*.py")
    stamp = max(path.stat().st_mtime_ns for path in sources)
    user = os.getuid() if hasattr(os, "getuid") else 0
    mark = Path(tempfile.gettempdir()) / f"sylpose-compiled-{user}-{stamp}"
    with _hold_file_lock(mark.with_suffix(".lock")):
        if mark.exists():
            return
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = make_demo_scene(frames=40, angle_deg=60.0, size=(320, 240), n_cameras=3)
            write_sequence(Path(folder), replace(scene, frames=8))
            session = open_session(folder)
            track_session(session, overlay=False, checkpoint_seconds=float("inf"))
        with suppress(OSError):
            mark.touch()


@contextmanager
def _hold_file_lock(path: Path) -> Iterator[None]:
    """Exclude other processes of this computer within the context, if file locks are available."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
