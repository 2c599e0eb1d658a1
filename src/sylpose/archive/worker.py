"""Work on one recording: fetch it if remote, track it as `sylpose track` does, and summarize the result."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np

from sylpose.archive.contract import Summary
from sylpose.archive.recordings import FILE_KINDS, Recording
from sylpose.input_limits import to_one_line
from sylpose.io.capture import open_session
from sylpose.io.stores import ObjectStore, is_inside, is_url, open_store
from sylpose.report.camera_consistency import describe_camera_problems
from sylpose.runs.check import explain_failures
from sylpose.runs.options import RunOptions
from sylpose.runs.precompile import compile_once_per_computer
from sylpose.runs.run import track_session
from sylpose.runs.run_result import Run
from sylpose.runs.world import WorldSpec, apply_world_and_unit, is_world_text
from sylpose.sync.offsets import find_offsets

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
    compile_once_per_computer()
    copies: dict[str, str] = {}

    def local(url: str | None, name: str) -> Path | None:
        if url is None or not is_url(url):
            return None if url is None else Path(url)
        copies[str(folder / name)] = url
        return _fetch(url, folder / name)

    options = recording.options
    unit, world = options.pop("unit"), options.pop("world")
    try:
        given = (local(getattr(recording, kind), f"given_{kind}") for kind in FILE_KINDS)
        calibration, boxes, masks, offsets = given
        path = local(recording.path, "recording") or folder
        session = open_session(path, calibration=calibration, boxes=boxes, masks=masks, take=recording.take)
        if world is not None:
            world = WorldSpec(world if is_world_text(world) else str(local(world, "given_world.toml")))
        session = apply_world_and_unit(session, world, unit)
        run_options = RunOptions(
            offsets=find_offsets(session, offsets),
            checkpoint_seconds=float("inf"),
            workers=threads,
            **options,
        )
        run = track_session(session, folder / "results", run_options)
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
    faults, coverages, residuals = [], [], []
    for name, trajectory in run.trajectories.items():
        prefix = f"{name}: " if len(run.trajectories) > 1 else ""
        faults += [prefix + message for message in describe_camera_problems(trajectory)]
        coverages.append(float(np.mean(trajectory.measured_mask)) if len(trajectory) else 0.0)
        values = np.concatenate([frame.residuals for frame in trajectory if frame.is_measured] or [np.empty(0)])
        values = values[np.isfinite(values) & (values > 0)]
        residuals += [float(np.median(values))] if len(values) else []
    return Summary(
        status="nothing found" if len(missing) == len(run.trajectories) else "done",
        frames=max(len(trajectory) for trajectory in run.trajectories.values()),
        coverage=round(min(coverages), 4),
        residual_px=round(max(residuals), 4) if residuals else None,
        faults=tuple(faults[:MAX_MESSAGES]),
        error=" ".join(missing),
        notes=(*notes, *run.problems)[:MAX_MESSAGES],
    )


def _fetch(url: str, target: Path) -> Path:
    """Copy a file, or all files below a folder, from an object store."""
    source = open_store(url)
    assert isinstance(source, ObjectStore)
    names = [file.name for file in source.files() if not file.name.startswith("sylpose/")]
    if not names:
        target = target.with_suffix(PurePosixPath(url).suffix)
        source.fetch("", target)
    for name in names:
        if not is_inside(name):
            raise ValueError(f"{url}: a file named {to_one_line(name)} cannot belong to a recording")
        source.fetch(name, target / name)
    return target
