"""Which body of a recording is tracked where it has no boxes."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import chain

from sylpose.frames import FrameSet
from sylpose.io.capture import Session
from sylpose.runs.options import RunOptions
from sylpose.tracking.bodies import (
    WINDOW_FRAMES,
    compare_cameras,
    find_candidates,
    reduce_frame_set,
    select_windows,
)
from sylpose.tracking.context import Candidate

# Yields the frame sets of increasing numbers, as `Session.frames_at` does.
ReadFrames = Callable[[Sequence[int]], Generator[FrameSet, None, None]]


def find_session_candidates(session: Session, options: RunOptions | None = None) -> list[Candidate]:
    """Find the bodies that move in a recording, by decreasing number of matches.

    Args:
        session: the recording.
        options: frames to search, seed, limits and workers; None: all frames.
    """
    options = options or RunOptions()
    windows = read_windows(*list_frames(session, options))
    return find_candidates(session.rig, windows, seed=options.seed, workers=options.workers, options=options.tracking)


def select_candidate(session: Session, options: RunOptions) -> Candidate | None:
    """Select the body to be tracked: the requested one, or the one with the most matches; None if nothing moves.

    Raises:
        ValueError: fewer bodies move than the requested number.
    """
    candidates = find_session_candidates(session, options)
    if options.candidate is None:
        return candidates[0] if candidates else None
    if options.candidate > len(candidates):
        n = len(candidates)
        moving = "no body moves" if not n else "one body moves" if n == 1 else f"{n} bodies move"
        raise ValueError(f"object {options.candidate}: {moving} in {session.path}; `sylpose check` draws what moves")
    return replace(candidates[options.candidate - 1], is_chosen=True)


def compare_session_cameras(session: Session, name: str, options: RunOptions) -> float:
    """Return the F ratio of an object that boxes or masks select, in the first frames. See `compare_cameras`."""
    every = options.every
    stop = min(session.n_frames if options.stop is None else options.stop, options.start + WINDOW_FRAMES * every)
    frames = [reduce_frame_set(own.for_object(name)) for own in session.frames(options.start, stop, every, _ignore)]
    boxes = session.select_object(name).boxes
    return compare_cameras(session.rig, frames, boxes, workers=options.workers, options=options.tracking)


def list_frames(
    session: Session, options: RunOptions, on_problem: Callable[[str], None] | None = None
) -> tuple[range, ReadFrames]:
    """Return the numbers of the frames that are tracked, and a function that reads some of them."""
    end = session.n_frames if options.stop is None else min(options.stop, session.n_frames)
    read = partial(session.frames_at, every=options.every, on_problem=on_problem or _ignore)
    return range(options.start, end, options.every), read


def read_windows(numbers: range, read: ReadFrames) -> Iterator[Sequence[FrameSet]]:
    """Read windows of frames spread over a recording.

    In its first half, a window begins where most cameras have an image: some start late, or with black pictures.
    """
    windows = [[*numbers[window.start : window.stop]] for window in select_windows(len(numbers))]
    known = dict[int, FrameSet]()
    with closing(read(sorted({*chain(*windows)}))) as reader:
        for window in windows:
            known = {k: frames for k, frames in known.items() if k in window}
            while window[-1] not in known and (frames := next(reader, None)) is not None:
                known[frames.index] = reduce_frame_set(frames)
            own = [known[k] for k in window if k in known]
            n_images = [sum(image is not None for image in frames.images) for frames in own[: len(own) // 2 + 1]]
            yield own[n_images.index(max(n_images)) :] if own else []


def _ignore(_problem: str) -> None:
    """Broken frames are reported when they are tracked."""
