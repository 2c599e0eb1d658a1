"""Calibration of a recording's cameras from the boards in its videos: detection in all frames, files."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np

from sylpose.atomic_io import replace_atomically
from sylpose.boards.charuco_search import complete_charuco, is_incomplete
from sylpose.boards.detection import Detection, detect
from sylpose.boards.specification import Board, parse_board
from sylpose.frames import FrameSet
from sylpose.input_limits import to_one_line
from sylpose.io import calibration as calibrations
from sylpose.io.calibration import native
from sylpose.io.capture import Session
from sylpose.rig import Rig
from sylpose.rig_calibration.from_boards import BoardCalibration, calibrate_from_boards
from sylpose.rig_calibration.result import RigCalibration
from sylpose.units import METERS

# Frame sets whose images are held in memory while the board is detected in them (choice: keeps all threads busy).
MAX_PENDING = 4
# Frames in which the dictionary of a board is searched (choice: some show the board whole).
SAMPLED_FRAMES = 12


def choose_unit(text: str, unit: str | None) -> str:
    """Return the unit of a calibration from a board: the requested one, meters if its lengths have units, or "".

    Raises:
        ValueError: an unknown unit.
    """
    if unit is not None and unit not in METERS:
        raise ValueError(f"unit must be one of {', '.join(METERS)}, got {unit!r}")
    if unit is not None:
        return unit
    try:
        parse_board(text)
    except ValueError:  # its lengths have units; anything else is reported when it is parsed with one
        return "m"
    return ""


def complete_board(session: Session, text: str, start: int = 0, stop: int | None = None) -> str:
    """Return a board's description, of a ChArUco board with the dictionary and marker size that the recording shows.

    Args:
        session: the recording.
        text: the description.
        start, stop: frames, as of `Session.frames`.

    Raises:
        ValueError: no such board in the recording, or frames outside it.
    """
    if not is_incomplete(text):
        return text
    last = session.n_frames if stop is None else min(stop, session.n_frames)
    step = max((last - start) // SAMPLED_FRAMES, 1)
    with closing(session.frames(start, stop, step, lambda _: None)) as frames:
        pairs = [(image, camera) for frame in frames for image, camera in zip(frame.images, session.rig, strict=True)]
    return complete_charuco(text, [(image, camera) for image, camera in pairs if image is not None])


def detect_boards(
    rig: Rig, frames: Iterable[FrameSet], board: Board, on_frame: Callable[[], None] = lambda: None
) -> Iterator[tuple[int, list[Detection]]]:
    """Detect a board in all frame sets, with one thread per core.

    Args:
        rig: C cameras.
        frames: frame sets.
        board: the target.
        on_frame: called after each frame set.

    Yields:
        The number of each frame set, and the detection of each camera, empty without one.
    """
    pending = deque[tuple[int, list[Future[Detection] | None]]]()

    def collect() -> tuple[int, list[Detection]]:
        index, futures = pending.popleft()
        on_frame()
        return index, [Detection() if future is None else future.result() for future in futures]

    with ThreadPoolExecutor(os.cpu_count() or 1, "board") as pool:
        for frame in frames:
            jobs = zip(rig, frame.images, strict=True)
            futures = [None if image is None else pool.submit(detect, image, camera, board) for camera, image in jobs]
            pending.append((frame.index, futures))
            if len(pending) > MAX_PENDING:
                yield collect()
        while pending:
            yield collect()


def calibrate_session(
    session: Session,
    board: Board,
    *,
    unit: str = "",
    start: int = 0,
    stop: int | None = None,
    every: int = 1,
    on_problem: Callable[[str], None] = lambda _: None,
    on_frame: Callable[[], None] = lambda: None,
) -> BoardCalibration:
    """Calibrate a recording's cameras from a board that is carried about in it.

    Args:
        session: the recording; of its cameras, names and image sizes are used.
        board: from `parse_board`.
        unit: unit of the board's points.
        start, stop, every: frames start, start + every, ... below stop.
        on_problem: called with a message per truncated file and unreadable frame.
        on_frame: called after each frame set.

    Raises:
        CalibrationRefusedError: the views do not determine a calibration.
        ValueError: frames outside the recording.
    """
    rig = Rig(session.rig.cameras, unit)
    with closing(session.frames(start, stop, every, on_problem)) as frames:
        found = [detections for _, detections in detect_boards(rig, frames, board, on_frame)]
    return calibrate_from_boards(rig, board, found)


def write_calibration(calibration: RigCalibration, file: Path, comments: Sequence[str] = ()) -> str:
    """Write a calibration in the format of the file's name; sylpose's own has the standard deviations as comments.

    Args:
        calibration: the calibration.
        file: output file.
        comments: further lines of comments in sylpose's own format.

    Returns:
        a sentence on what the format cannot hold, or "".

    Raises:
        OSError: the file cannot be written.
        ValueError: no format has such a name, or it cannot hold the rig.
    """
    if file.suffix != ".toml":
        return "; ".join(calibrations.save(calibration.rig, file))
    text = native.to_text(calibration.rig) + format_deviations(calibration)
    text += "".join(f"# {to_one_line(comment)}\n" for comment in comments)
    with replace_atomically(file) as part:
        part.write_text(text, encoding="utf-8")
    return ""


def format_deviations(calibration: RigCalibration) -> str:
    """Format the standard deviations as comments of a TOML file."""
    rig = calibration.rig
    lines = [f"# Standard deviations, those of poses relative to {rig.names[0]}:"]
    for c, camera in enumerate(rig):
        lens, pose = (
            np.sqrt(np.diag(its))
            for its in (calibration.intrinsics_covariance[c], calibration.extrinsics_covariance[c])
        )
        groups = (
            ("fx fy cx cy", lens[:4]),
            ("distortion", lens[4:]),
            ("rotation in degrees", np.degrees(pose[:3])),
            ("translation", pose[3:]),
        )
        # A lens that was not estimated, and the pose of the first camera, have none.
        texts = [f"{label} {' '.join(f'{v:.3g}' for v in its) if its.any() else 'held'}" for label, its in groups]
        lines.append(f"# {to_one_line(camera.name)}: {'; '.join(texts)}")
    return "\n" + "\n".join(lines) + "\n"
