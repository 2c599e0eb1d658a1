"""The work on one recording: fetched where it is elsewhere, tracked as `sylpose track` does it, summed up."""

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
from sylpose.app.run import Run, track_session
from sylpose.app.session_options import told
from sylpose.app.track_command import why_nothing
from sylpose.app.world import WorldAsked, in_words
from sylpose.archive.contract import Summary
from sylpose.archive.recordings import Recording
from sylpose.archive.stores import is_url, place
from sylpose.capture import open_session
from sylpose.input_limits import one_line
from sylpose.report.camera_consistency import remarks
from sylpose.results import Trajectory
from sylpose.simulate import demo_scene, write_sequence
from sylpose.sync.offsets import find_offsets

__all__ = ["summed_up", "track_recording", "warm"]

# Sentences that a summary keeps (choice: enough to see what is wrong).
KEPT = 20


def track_recording(recording: Recording, folder: Path, threads: int) -> Summary:
    """Tracks a recording; the files of `sylpose track` go into `results` in a folder.

    Raises:
        ValueError, OSError: as `open_session` and `track_session`; what they say of a copy is said of the original.
    """
    warm()
    copies: dict[str, str] = {}

    def local(url: str | None, name: str) -> Path | None:
        if url is None or not is_url(url):
            return None if url is None else Path(url)
        copies[str(folder / name)] = url
        return _fetched(url, folder / name)

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
            world = WorldAsked(world if in_words(world) else str(local(world, "given_world.toml")))
        session = told(session, world, unit)
        run = track_session(
            session,
            folder / "results",
            offsets=find_offsets(session, local(recording.offsets, "given_offsets")),
            checkpoint_seconds=float("inf"),
            workers=threads,
            **options,
        )
        return summed_up(run, why_nothing(session, run), session.warnings)
    except (ValueError, OSError) as error:
        said = str(error)
        for copy, url in copies.items():
            said = said.replace(copy, url)
        if said == str(error):
            raise
        raise type(error)(said) from error


def summed_up(run: Run, missing: list[str], notes: tuple[str, ...] = ()) -> Summary:
    """What a run comes to; `missing` has a sentence for each object that was found in no frame."""
    several = len(run.trajectories) > 1
    residuals = [value for trajectory in run.trajectories.values() if (value := _residual(trajectory)) is not None]
    faults = [
        f"{name}: {said}" if several else said
        for name, trajectory in run.trajectories.items()
        for said in remarks(trajectory)
    ]
    return Summary(
        status="nothing found" if len(missing) == len(run.trajectories) else "done",
        frames=max(len(trajectory) for trajectory in run.trajectories.values()),
        coverage=min(_coverage(trajectory) for trajectory in run.trajectories.values()),
        residual_px=round(max(residuals), 4) if residuals else None,
        faults=tuple(faults[:KEPT]),
        error=" ".join(missing),
        notes=(*notes, *run.problems)[:KEPT],
    )


def _coverage(trajectory: Trajectory) -> float:
    return round(float(np.mean([frame.measured for frame in trajectory])), 4) if len(trajectory) else 0.0


def _residual(trajectory: Trajectory) -> float | None:
    values = np.concatenate([frame.residuals for frame in trajectory if frame.measured] or [np.empty(0)])
    values = values[np.isfinite(values) & (values > 0)]
    return float(np.median(values)) if len(values) else None


def _fetched(url: str, target: Path) -> Path:
    """A file or all below a folder of an object store, copied."""
    source = place(url)
    files = source.files()
    if not files:
        folder, _, name = url.rpartition("/")
        place(folder).fetch(name, target.with_suffix(Path(name).suffix))
        return target.with_suffix(Path(name).suffix)
    for file in files:
        if ".." in file.name.split("/") or file.name.startswith("/"):
            raise ValueError(f"{url}: a file called {one_line(file.name)} cannot be one of a recording")
        if not file.name.startswith("sylpose/"):
            there = target / file.name
            if not there.exists() or there.stat().st_size != file.size:  # tried again after an I/O error
                source.fetch(file.name, there)
    return target


@functools.cache
def warm() -> None:
    """Compiles what tracking needs, once on a computer: whoever comes first does it, the others wait for it."""
    sources = Path(sylpose.__file__).parent.rglob("*.py")
    stamp = max(path.stat().st_mtime_ns for path in sources)
    user = os.getuid() if hasattr(os, "getuid") else 0
    mark = Path(tempfile.gettempdir()) / f"sylpose-compiled-{user}-{stamp}"
    with _alone(mark.with_suffix(".lock")):
        if mark.exists():
            return
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = demo_scene(frames=40, turn_deg=60.0, size=(320, 240), n_cameras=3)
            write_sequence(Path(folder), replace(scene, frames=8))
            session = open_session(folder)
            track_session(session, overlay=False, checkpoint_seconds=float("inf"))
        with suppress(OSError):
            mark.touch()


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Within it no other process of this computer is; where files cannot be locked all are, and compile alike."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
