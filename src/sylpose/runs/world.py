"""World frames from `--world`: a detected board, a direction, or a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from sylpose.boards.board_pose import BoardObservation, find_board
from sylpose.boards.specification import EXAMPLES, Board, is_board, parse_board
from sylpose.geometry.arrays import Image
from sylpose.input_limits import to_one_line
from sylpose.io.calibration.world import World, load_world, parse_up_world
from sylpose.io.capture import Session
from sylpose.io.capture.frame_readers import CameraReader
from sylpose.io.capture.images import read_image
from sylpose.io.capture.names import IMAGE_SUFFIXES, match_names
from sylpose.io.capture.session import SessionBase
from sylpose.io.capture.sources import NON_CAMERA_NAMES, VIDEO_SUFFIXES, open_source
from sylpose.rig import Rig
from sylpose.status import Status
from sylpose.units import METERS

# Largest log ratio of a board's measured to its given size (choice: a printer's scaling is less).
MAX_LOG_SIZE_RATIO = 0.05

_FAILURE_REASONS = {
    Status.TOO_FEW_MATCHES: "fewer than four of its points",
    Status.ROTATION_NOT_OBSERVABLE: "its tilt is not observable; use more cameras or a larger board",
    Status.SCALE_NOT_OBSERVABLE: "its distance is not observable; use more cameras or a larger board",
    Status.NOT_CONSISTENT: "their detections are inconsistent: it is another board, or a camera was moved",
}

SessionT = TypeVar("SessionT", bound=SessionBase)

ImageReader = Callable[[], Sequence[Image | None]]


@dataclass(frozen=True)
class WorldSpec:
    """World options of a command.

    Attributes:
        world: a board, a direction or a file.
        frame: number of the frame in which the board is detected; None for the first.
        images: folder with images of the board, instead of the recording.
    """

    world: str
    frame: int | None = None
    images: Path | None = None


def apply_world_and_unit(opened: SessionT, world: WorldSpec | None, unit: str | None) -> SessionT:
    """Express a session in another world frame, then in another unit; lengths in `world` have the calibration's unit.

    Raises:
        ValueError, OSError: as `resolve_session_world` and `Rig.in_unit`.
    """
    if world is not None:
        found, notes = resolve_session_world(opened, world)
        opened = replace(opened.with_world(found), warnings=(*opened.warnings, *notes))
    if unit in METERS and not opened.rig.unit:
        raise ValueError(
            f"--unit {unit}: {opened.calibration} does not state its unit; set it with sylpose calibration convert IN "
            "OUT --is-in m"
        )
    return opened if unit is None else opened.with_rig(opened.rig.in_unit(unit))


def is_world_text(world: str) -> bool:
    """Return whether a world is given as text (a board or a direction) instead of a file."""
    return is_board(world) or re.match(r"\s*up\s*=", world) is not None


def resolve_session_world(session: SessionBase, spec: WorldSpec) -> tuple[World, list[str]]:
    """Determine the requested world of a session that is in its calibration's world; also return notes about it.

    Raises:
        ValueError: as `resolve_world`; a board in images of live cameras, or a frame that the session does not have.
    """

    def read_images() -> Sequence[Image | None]:
        frame = spec.frame or 0
        if not isinstance(session, Session):
            raise ValueError(
                "--world: live cameras cannot detect a board; give images of it with --world-from, or a world.toml"
            )
        if not 0 <= frame < session.n_frames:
            raise ValueError(f"--world-frame {frame}: the recording has frames 0 to {session.n_frames - 1}")
        with closing(session.frames(frame, frame + 1, on_problem=lambda _: None)) as frames:
            return next(frames).images

    return resolve_world(session.rig, spec, read_images)


def resolve_world(rig: Rig, spec: WorldSpec, read_images: ImageReader | None = None) -> tuple[World, list[str]]:
    """Determine the requested world frame.

    Args:
        rig: the cameras in the calibration's world.
        spec: the world options.
        read_images: returns the cameras' images, in which boards are detected unless the options give other images.

    Returns:
        The world, and notes about it as sentences.

    Raises:
        ValueError: neither a board, a direction nor a file; a board that is not detected, or of another size.
        OSError: a file that cannot be read.
    """
    text = spec.world
    checked = check_world(spec, rig.unit)
    if isinstance(checked, World):
        return checked, []
    if isinstance(checked, Board):
        if spec.images is not None:
            read_images = partial(_read_board_images, spec.images, rig, spec.frame or 0)
        elif read_images is None:
            raise ValueError(f"--world {_shorten(text)}: --world-from DIR, with images of the board, is missing")
        frame = f"frame {spec.frame or 0}" + (f" of {spec.images}" if spec.images is not None else "")
        return _make_board_world(rig, checked, find_board(rig, read_images(), checked), frame)
    return load_world(text, rig), []


def check_world(spec: WorldSpec, unit: str) -> Board | World | Path:
    """Check the world options without the cameras, as far as possible.

    Args:
        spec: the world options.
        unit: unit of the calibration.

    Returns:
        the board, the world of a direction, or the file, which is not read.

    Raises:
        ValueError: as `resolve_world`.
    """
    text = spec.world
    is_file = Path(text).is_file()
    if is_board(text) and not is_file:
        return parse_board(text, unit)
    if spec.frame is not None or spec.images is not None:
        raise ValueError(f"--world-frame and --world-from require a board, but --world {_shorten(text)} is none")
    if is_file:
        return Path(text)
    if (world := parse_up_world(text, unit)) is not None:
        return world
    raise ValueError(
        f"--world {_shorten(text)}: neither an existing file, nor a board such as {EXAMPLES[0]}, nor a direction such "
        "as up=0,-1,0"
    )


def _make_board_world(rig: Rig, board: Board, detection: BoardObservation, frame: str) -> tuple[World, list[str]]:
    """Create the world of a detected board; raise ValueError if it is not detected, ambiguous, or of another size."""
    option_text = f"--world {_shorten(board.text)}"
    problems = "".join(f"; {problem}" for problem in detection.problems)
    if not detection.cameras:
        raise ValueError(f"{option_text}: no camera sees it in {frame}{problems}")
    if detection.size_ratio is not None and abs(np.log(detection.size_ratio)) > MAX_LOG_SIZE_RATIO:
        raise ValueError(
            f"{option_text}: the board appears {detection.size_ratio:.3g} times as large: its given length is wrong, "
            f"or the calibration is not in {rig.unit or 'the same unit'}"
        )
    camera_names = ", ".join(rig.names[c] for c in detection.cameras)
    if detection.motion.motion is None or detection.motion.status is not Status.OK:
        reason = _FAILURE_REASONS.get(detection.motion.status, "its pose is unknown")
        raise ValueError(
            f"{option_text}: {camera_names} see{'s' if len(detection.cameras) == 1 else ''} it in {frame}, but "
            f"{reason}{problems}"
        )
    notes = [f"The board of the world: {problem}." for problem in detection.problems]
    if detection.n_symmetries > 1:
        first = rig.names[detection.cameras[0]]
        notes.append(
            f"The board is symmetric under rotations by {360 // detection.n_symmetries}°: the world's x axis is the "
            f"one that points most to the right for {first}."
        )
    description = f"{board.text}, seen in {frame} by {camera_names}, {_format_pose_sd(detection, rig.unit)}"
    return World(detection.motion.motion.inv(), description, rig.unit, 1.0, rig.unit), notes


def _format_pose_sd(detection: BoardObservation, unit: str) -> str:
    """Format the standard deviations of the board's pose."""
    sd = np.sqrt(np.diag(detection.motion.covariance))
    rotation, position = float(np.degrees(sd[:3].max())), float(sd[3:].max())
    length = f"{1e3 * METERS[unit] * position:.2g} mm" if unit in METERS else f"{position:.2g}"
    return f"sd {rotation:.2g} deg and {length}"


def _read_board_images(folder: Path, rig: Rig, frame: int) -> list[Image | None]:
    """Read one image per camera from a folder with images, videos or image folders; None for cameras without.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: no files of the cameras; images of another size; a missing frame.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; --world-from must be a folder with images of the board")
    entries = {
        entry.name if entry.is_dir() else entry.stem: entry
        for entry in sorted(folder.iterdir())
        if not entry.name.startswith(".")
        and entry.name.lower() not in NON_CAMERA_NAMES
        and (entry.is_dir() or entry.suffix.lower() in IMAGE_SUFFIXES | VIDEO_SUFFIXES)
    }
    matched = match_names(entries, rig.names)
    if not matched:
        raise ValueError(
            f"{folder}: contains no image, video or image folder of {to_one_line(', '.join(rig.names), 200)}"
        )
    path_by_camera: Mapping[str, Path] = {camera: entries[name] for name, camera in matched.items()}
    paths = [(path_by_camera.get(name), name) for name in rig.names]
    images = [None if path is None else _read_board_image(path, rig, name, frame) for path, name in paths]
    if all(image is None for image in images):
        raise ValueError(f"--world-frame {frame}: no camera has an image of this number in {folder}")
    return images


def _read_board_image(entry: Path, rig: Rig, name: str, frame: int) -> Image | None:
    if entry.is_file() and entry.suffix.lower() in IMAGE_SUFFIXES:
        return read_image(entry, rig[name].size)
    source = open_source(entry, rig[name])
    if frame >= source.n_frames:
        return None
    with closing(CameraReader(source, {})) as reader:
        return reader.read(frame).image


def _shorten(text: str) -> str:
    return to_one_line(text, 100)
