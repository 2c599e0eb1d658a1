"""A recording's cameras and how far apart in time they are: session -> offsets.toml."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sylpose.app import console_output
from sylpose.app.precompile import compile_aloud
from sylpose.atomic_io import output_folder, replacing, toml_key
from sylpose.capture import Session
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.smoothing.trajectory import Track, smooth
from sylpose.sync.offsets import OFFSETS_FILE, load_offsets, retimed
from sylpose.sync.speed_correlation import Delays, Pulse, coarse_offsets, image_speed, small_grey, split_offsets
from sylpose.tracking.tracker import track

__all__ = ["Known", "Synced", "sync_aloud", "sync_session", "write_offsets"]

# Wraps the frames of a loop to show how far it is: what is done, how many they are, the frames.
Watch = Callable[[str, int, Iterable[FrameSet]], Iterable[FrameSet]]

# Of the search by speeds, seconds (choice: cameras started by hand).
MAX_LAG = 3.0
# The object is tracked for so many frames at most, so many times, until no offset changes by so much (seconds), or by
# more than its standard deviation (choice: 20 s at 30 per second; what moves by 1000 px/s moves by 0.1 px in it).
TRACKED, ROUNDS, SETTLED = 600, 4, 1e-4
# It is tracked again only where other frames belong together than was thought, an offset having changed by so many frames
# since: tracked with offsets that are off by half a frame, it tells the same of them (measured: benchmarks/sync.py).
AGAIN = 0.75
# Followed features are three times as exact as those found anew in every frame, for a third of the time; but their errors go
# along with the motion, by about so many pixels, as if the camera were late (measured: benchmarks/sync.py).
FEATURES, ALONG_PX = "klt", 0.01
# What is believed of the offsets before each round, frames; and what a camera's must be known to, to count as found
# (choice: whole frames are known by then; docs/sync.md promises a twentieth).
BELIEF, FOUND = 0.5, 0.05
# The offsets are also estimated from parts of the recording alone, so many at most and of so many frames at least (choice).
PARTS, PART = 6, 16


class Known(Enum):
    """How well a camera's offset is known. `known.text` is a sentence for people."""

    FINE = "found"
    COARSE = "to about a frame"
    NOT = "not shown"

    @property
    def text(self) -> str:
        """One sentence that says what it means."""
        return _TEXTS[self]


_TEXTS = {
    Known.FINE: "Found from the object's poses.",
    Known.COARSE: "Found from how the speed changes, in whole frames; the poses do not show the rest.",
    Known.NOT: "The motion does not show it: the object's speed has to change, in view of this camera.",
}


@dataclass(frozen=True, eq=False)
class Synced:
    """How far apart C cameras are in time, and how well that is known.

    Attributes:
        cameras: their names.
        rate: frames per second.
        offsets: (C,) seconds by which each camera's images are later than their times say, their mean 0; a camera of which
            nothing is known is taken to be as late as its time stamps or frame numbers say.
        sd: (C,) standard deviations, infinite when not known.
        known: how well, by camera.
        coarse: what the speeds alone tell.
        before, after: (C,) rms residual of the tracked object, pixels, with whole frames only and with the offsets; NaN
            where it was not seen.
        tracked: number of frames.
        problems: sentences about what could not be read, and what went wrong.
    """

    cameras: tuple[str, ...]
    rate: float
    offsets: FloatArray
    sd: FloatArray
    known: tuple[Known, ...]
    coarse: Delays
    before: FloatArray
    after: FloatArray
    tracked: int
    problems: tuple[str, ...]


def _unwatched(_what: str, _total: int, frames: Iterable[FrameSet]) -> Iterable[FrameSet]:
    return frames


def sync_session(
    session: Session,
    *,
    max_lag: float = MAX_LAG,
    start: int = 0,
    stop: int | None = None,
    seed: int = 0,
    watch: Watch = _unwatched,
) -> Synced:
    """Estimate how far apart in time a session's cameras are.

    First to about a frame, from how the speed of each camera's pictures changes; then from the object, tracked with
    these offsets, its poses, places of its features and the offsets refined together, until these settle.

    Args:
        session: of `open_session`; of several objects, the first is tracked.
        max_lag: seconds that two cameras may be apart, beside what their time stamps say.
        start, stop: frames start ... stop - 1; the object is tracked in 600 of them at most.
        seed: as in `track`.
        watch: wraps the loops over frames, to show how far they are.

    Raises:
        ValueError: one camera only; a recording whose rate is not known; frames that the session does not have.
    """
    if len(session.rig) < 2:
        raise ValueError(f"{session.path}: one camera alone has nothing to be synchronised with")
    if session.rate is None:
        raise ValueError(
            f"{session.path}: how far apart in time its cameras are can only be told when its frames have times: videos or "
            "timestamps.csv are expected"
        )
    rate, n = session.rate, len(session.rig)
    problems: list[str] = []
    looked = _pulses(session, start, stop, problems.append, watch)
    coarse = coarse_offsets(looked, rate, max_lag)
    whole = split_offsets(coarse.offsets, rate)[0] / rate
    whole -= whole.mean()
    one = session.of(session.objects[0])
    offsets, sd, settled, frames = whole, np.full(n, np.inf), False, 0
    before = after = np.full(n, np.nan)
    followed, then = list[Track](), offsets  # with these offsets; frames without a pose have no delays
    for k in range(ROUNDS):
        if k == 0 or (np.abs(offsets - then) * rate > AGAIN).any():
            moved, then = retimed(one, offsets), offsets
            end = min(moved.n_frames if stop is None else stop, start + TRACKED, moved.n_frames)
            # What is wrong with the files has been said.
            sets = watch(f"Tracking, round {k + 1}", end - start, moved.frames(start, end, 1, _unsaid))
            seen = track(sets, moved.rig, moved.boxes or None, features=FEATURES, seed=seed)
            followed = [Track.of(tracked) for tracked in seen]
        tracks = [replace(one_of, late=one_of.late + (offsets - then)[: len(one_of.late)]) for one_of in followed]
        found = smooth(tracks, moved.rig, offsets_sd=BELIEF / rate)
        frames = sum(t.pose.measured for t in tracks)
        if found.status is Status.TOO_FEW_MATCHES:
            problems.append("The object could not be tracked: its poses tell nothing.")
            sd = np.full(n, np.inf)
            break
        if k == 0:
            before = smooth(tracks, moved.rig).sigma_px
        after = found.sigma_px
        offsets, sd = offsets + found.offsets, found.offsets_sd
        settled = bool((np.abs(found.offsets) < np.maximum(SETTLED, sd)).all())
        if settled:
            break
    sd = np.hypot(sd * _disagreement(tracks, one.rig, BELIEF / rate), ALONG_PX / _speeds(tracks, one.rig))
    fine = sd < FOUND / rate
    if fine.sum() < 2:  # an offset is one from another camera
        fine[:] = False
    if fine.any() and not settled:
        problems.append(f"The offsets still change after {ROUNDS} rounds.")
    offsets = np.where(fine, offsets, whole)
    # In whole frames nothing is known better than to a part of one.
    rough = np.where(coarse.told, np.hypot(coarse.sd, 0.3 / rate), np.inf)
    known = [Known.FINE if f else Known.COARSE if c else Known.NOT for f, c in zip(fine, coarse.told, strict=True)]
    return Synced(
        session.rig.names,
        rate,
        offsets - offsets.mean(),
        np.where(fine, sd, rough),
        tuple(known),
        coarse,
        before,
        after,
        frames,
        tuple(problems),
    )


def _disagreement(tracks: Sequence[Track], rig: Rig, belief: float) -> float:
    """How many times their standard deviations the offsets from parts of the recording differ; at least 1.

    What the motion does not show comes out of errors that look like motion, and differently in every part.
    """
    n = min(len(tracks) // PART, PARTS)
    if n < 2:
        return 1.0
    edges = np.linspace(0, len(tracks), n + 1).astype(int)
    parts = [smooth(tracks[i:j], rig, offsets_sd=belief) for i, j in pairwise(edges)]
    parts = [part for part in parts if part.status is not Status.TOO_FEW_MATCHES]
    if len(parts) < 2:
        return 1.0
    values, sds = np.array([p.offsets for p in parts]), np.array([p.offsets_sd for p in parts])
    mean = (values / sds**2).sum(axis=0) / (1.0 / sds**2).sum(axis=0)
    # The offsets' mean is 0: one camera's follows from the others'.
    freedom = (len(parts) - 1) * (len(rig) - 1)
    return float(np.sqrt(max((((values - mean) / sds) ** 2).sum() / freedom, 1.0)))


def _speeds(tracks: Sequence[Track], rig: Rig) -> FloatArray:
    """(C,) how fast the object moves in each camera's images, pixels per second (root of the mean square); where it was not
    seen to move, next to nothing."""
    squares, counts = np.full(len(rig), 1e-12), np.ones(len(rig))
    for before, now in pairwise(tracks):
        for c, (there, here) in enumerate(zip(before.sightings, now.sightings, strict=True)):
            _, i, j = np.intersect1d(there.landmark, here.landmark, return_indices=True)
            moved = rig.cameras[c].focal * (here.normalized[j] - there.normalized[i])
            squares[c] += np.sum((moved / (now.pose.time - before.pose.time)) ** 2)
            counts[c] += len(i)
    return np.asarray(np.sqrt(squares / counts))


def _pulses(
    session: Session, start: int, stop: int | None, on_problem: Callable[[str], None], watch: Watch
) -> list[Pulse]:
    """How fast each camera's pictures move."""
    rate = session.rate or 1.0
    last: list[tuple[float, Image] | None] = [None] * len(session.rig)
    samples: list[list[tuple[float, float]]] = [[] for _ in session.rig]
    frames = session.frames(start, stop, on_problem=on_problem)
    end = session.n_frames if stop is None else min(stop, session.n_frames)
    for frame_set in watch("Looking", end - start, frames):
        for c, (image, stamp) in enumerate(zip(frame_set.images, frame_set.times, strict=True)):
            if image is None:
                continue
            now = (frame_set.time if stamp is None else stamp, small_grey(image))
            before = last[c]
            if before is not None and now[0] - before[0] < 2.5 / rate:
                speed = image_speed(before[1], now[1]) / ((now[0] - before[0]) * rate)
                samples[c].append(((now[0] + before[0]) / 2, speed))
            last[c] = now
    return [Pulse(*np.array(s).reshape(-1, 2).T) for s in samples]


def write_offsets(synced: Synced, path: Path) -> None:
    """The offsets as TOML, `cam_0 = 0.0042`, with what is known of each as a comment.

    Raises:
        OSError: naming the file.
    """
    lines = ["# Seconds by which each camera's images are later than their times say, as found by `sylpose sync`."]
    for name, offset, sd, known in zip(synced.cameras, synced.offsets, synced.sd, synced.known, strict=True):
        key = toml_key(name)
        about = f"give or take {sd:.6f}" if np.isfinite(sd) else "not shown by the motion"
        lines.append(
            f"{key} = {offset:.6f}  # {known.value}: {about}" if np.isfinite(sd) else f"{key} = 0.0  # {about}"
        )
    with replacing(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def sync_aloud(
    session: Session,
    out: Path | None = None,
    *,
    max_lag: float = MAX_LAG,
    start: int = 0,
    stop: int | None = None,
    seed: int = 0,
) -> Synced:
    """`sync_session` with everything that is said about it; writes the offsets unless none is known.

    Args:
        out: the file; None: `offsets.toml` in the session's folder.

    Raises:
        KeyboardInterrupt: with a sentence.
        ValueError, OSError: as `sync_session` and `write_offsets`.
    """
    path = session.path / OFFSETS_FILE if out is None else out
    _check_asked(session, out, seed)
    console = console_output.make_console()
    console.print(console_output.headline(session))
    console_output.print_warnings(console, session.warnings)
    compile_aloud(console)
    progress = _Watching()
    try:
        synced = sync_session(session, max_lag=max_lag, start=start, stop=stop, seed=seed, watch=progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {path} is as it was") from None
    finally:
        progress.stop()
    console.print()
    console_output.print_table(
        console, ("Camera", "late", "give or take", "frames", "residual", "offset"), _rows(synced)
    )
    console.print()
    found = [*synced.problems]
    for known in (Known.COARSE, Known.NOT):
        names = [name for name, k in zip(synced.cameras, synced.known, strict=True) if k is known]
        if names:
            found.append(f"{', '.join(names)}: {known.text[0].lower()}{known.text[1:]}")
    console_output.print_warnings(console, found)
    if any(known is not Known.NOT for known in synced.known):
        write_offsets(synced, path)
        console_output.print_files(console, "Offsets", [path])
    return synced


def _check_asked(session: Session, out: Path | None, seed: int) -> None:
    """Raises ValueError, before any frame is looked at, for what would only fail at the end, or replace another file."""
    if seed < 0:
        raise ValueError(f"--seed must not be negative, got {seed}")
    if out is not None:
        output_folder(out.parent)
    if out is not None and out.exists():
        try:
            load_offsets(out, session.rig.names)
        except (OSError, ValueError):
            raise ValueError(f"--out {out}: is there, and no file of offsets that could be replaced") from None


def _rows(synced: Synced) -> list[list[str]]:
    rows = []
    for c, (name, known) in enumerate(zip(synced.cameras, synced.known, strict=True)):
        late, sd = 1e3 * synced.offsets[c], 1e3 * synced.sd[c]
        digits = 2 if known is Known.FINE else 0
        shown = known is not Known.NOT
        residual = f"{synced.before[c]:.2f} to {synced.after[c]:.2f} px" if np.isfinite(synced.before[c]) else "-"
        rows.append(
            [
                name,
                f"{late:.{digits}f} ms" if shown else "-",
                f"{sd:.{digits}f} ms" if shown else "-",
                f"{synced.offsets[c] * synced.rate:.{digits}f}" if shown else "-",
                residual,
                known.value,
            ]
        )
    return rows


class _Watching:
    """A progress bar on stderr for one loop after the other; nothing when that is no terminal."""

    def __init__(self) -> None:
        console = console_output.make_console(stderr=True)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(compact=True),
        )
        self._progress = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._progress.start()

    def __call__(self, what: str, total: int, frames: Iterable[FrameSet]) -> Iterator[FrameSet]:
        task = self._progress.add_task(what, total=total)
        for frame_set in frames:
            yield frame_set
            self._progress.advance(task)
        self._progress.remove_task(task)

    def stop(self) -> None:
        self._progress.stop()


def _unsaid(problem: str) -> None:
    pass
