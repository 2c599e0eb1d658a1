"""What `--world` asks for: a board that is seen, a direction, or a file -> `World`."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sylpose.boards.board_pose import Sighting, find_board
from sylpose.boards.specification import EXAMPLES, Board, is_board, parse_board
from sylpose.calibration.world import World, load_world, up_in_words
from sylpose.capture import Session
from sylpose.capture.frame_readers import CameraReader
from sylpose.capture.images import read_image
from sylpose.capture.names import IMAGE_SUFFIXES, match_names
from sylpose.capture.session import SessionBase
from sylpose.capture.sources import NO_CAMERAS, VIDEO_SUFFIXES, source_of
from sylpose.geometry.arrays import Image
from sylpose.input_limits import one_line
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.units import METRES

__all__ = ["WorldAsked", "asked_world", "in_words", "world_asked", "world_of_session"]

# A board that is seen as so much larger or smaller than was said is another one (choice: a printer's scaling is less).
SIZE_OFF = 0.05

_WHY = {
    Status.TOO_FEW_MATCHES: "fewer than four of its points",
    Status.TURN_NOT_OBSERVABLE: "how it is tilted cannot be told; more cameras, or a larger board, would tell it",
    Status.SCALE_NOT_OBSERVABLE: "how far away it is cannot be told; more cameras, or a larger board, would tell it",
    Status.NOT_CONSISTENT: "what they see of it does not fit together: it is another board, or a camera was moved",
}

Images = Callable[[], Sequence[Image | None]]


@dataclass(frozen=True)
class WorldAsked:
    """The options about a world, as they were given.

    Attributes:
        world: a board, a direction or a file.
        frame: of the images in which the board is looked for; None: the first.
        images: a folder with them, instead of the recording.
    """

    world: str
    frame: int | None = None
    images: Path | None = None


def in_words(world: str) -> bool:
    """Whether a world is told in words, a board or a direction, and not by a file."""
    return is_board(world) or re.match(r"\s*up\s*=", world) is not None


def asked_world(world: str | None, frame: int | None, images: Path | None) -> WorldAsked | None:
    """The three options of a command.

    Raises:
        ValueError: the others without the first.
    """
    if world is None and (frame is not None or images is not None):
        raise ValueError("--world-frame and --world-from say where a board is seen: --world is missing")
    return None if world is None else WorldAsked(world, frame, images)


def world_of_session(session: SessionBase, asked: WorldAsked) -> tuple[World, list[str]]:
    """The world that is asked for, of a session in its calibration's own one; and sentences on what to know of it.

    Raises:
        ValueError: as `world_asked`; a board in images of live cameras, or a frame that the session does not have.
    """

    def seen() -> Sequence[Image | None]:
        frame = asked.frame or 0
        if not isinstance(session, Session):
            raise ValueError(
                "--world: a board is looked for in a recording: give images of it by --world-from, or a world.toml"
            )
        if not 0 <= frame < session.n_frames:
            raise ValueError(f"--world-frame {frame}: the recording has frames 0 to {session.n_frames - 1}")
        with closing(session.frames(frame, frame + 1, on_problem=lambda _: None)) as frames:
            return next(frames).images

    return world_asked(session.rig, asked, seen)


def world_asked(rig: Rig, asked: WorldAsked, seen: Images | None = None) -> tuple[World, list[str]]:
    """The world that is asked for, and sentences on what to know of it.

    Args:
        rig: as calibrated, in its own world.
        seen: gives what its cameras see, where boards are looked for if not in images elsewhere.

    Raises:
        ValueError: what is asked for is none of the three; a board that is not seen, or not where it is said to be.
        OSError: a file that cannot be read.
    """
    text = asked.world
    is_file = Path(text).is_file()
    if is_board(text) and not is_file:
        board = parse_board(text, rig.unit)
        if asked.images is not None:
            seen = partial(_images_of, asked.images, rig, asked.frame or 0)
        elif seen is None:
            raise ValueError(
                f"--world {_shown(text)}: --world-from FOLDER is missing: images in which the board is seen"
            )
        frame = f"frame {asked.frame or 0}" + (f" of {asked.images}" if asked.images is not None else "")
        return _of_board(rig, board, find_board(rig, seen(), board), frame)
    if asked.frame is not None or asked.images is not None:
        raise ValueError(f"--world-frame and --world-from are for boards, and --world {_shown(text)} is none")
    if is_file:
        return load_world(text, rig), []
    if (world := up_in_words(text, rig.unit)) is not None:
        return world, []
    raise ValueError(
        f"--world {_shown(text)}: neither a file that is there, nor a board such as {EXAMPLES[0]}, nor a direction such as "
        "up=0,-1,0"
    )


def _of_board(rig: Rig, board: Board, found: Sighting, frame: str) -> tuple[World, list[str]]:
    """Raises ValueError: a board that is not seen, not surely, or of another size."""
    what = f"--world {_shown(board.text)}"
    problems = "".join(f"; {problem}" for problem in found.problems)
    if not found.cameras:
        raise ValueError(f"{what}: no camera sees it in {frame}{problems}")
    if found.size is not None and abs(np.log(found.size)) > SIZE_OFF:
        raise ValueError(
            f"{what}: the cameras see it {found.size:.3g} times as large as that: a length in it is wrong, or the "
            f"calibration is not in {rig.unit or 'the same unit'}"
        )
    by = ", ".join(rig.names[c] for c in found.cameras)
    if found.motion.motion is None or found.motion.status is not Status.OK:
        why = _WHY.get(found.motion.status, "where it is cannot be told")
        raise ValueError(f"{what}: {by} see{'s' if len(found.cameras) == 1 else ''} it in {frame}, but {why}{problems}")
    notes = [f"The board of the world: {problem}." for problem in found.problems]
    if found.alike > 1:
        first = rig.names[found.cameras[0]]
        notes.append(
            f"The board looks the same after {'half' if found.alike == 2 else 'a quarter of'} a turn: x of the world is "
            f"what is most to the right for {first}."
        )
    said = f"{board.text}, seen in {frame} by {by}, {_how_well(found, rig.unit)}"
    return World(found.motion.motion.inv(), said, rig.unit, 1.0, rig.unit), notes


def _how_well(found: Sighting, unit: str) -> str:
    """The standard deviations of where the board is."""
    sd = np.sqrt(np.diag(found.motion.covariance))
    turn, place = float(np.degrees(sd[:3].max())), float(sd[3:].max())
    length = f"{1e3 * METRES[unit] * place:.2g} mm" if unit in METRES else f"{place:.2g}"
    return f"known to {turn:.2g} deg and {length}"


def _images_of(folder: Path, rig: Rig, frame: int) -> list[Image | None]:
    """What cameras see in a folder with an image, a video or a folder of images for each; None where it has none.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: nothing in it that is a camera's; images of another size; a frame that there is not.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; --world-from is a folder with images of the board")
    entries = {
        entry.name if entry.is_dir() else entry.stem: entry
        for entry in sorted(folder.iterdir())
        if not entry.name.startswith(".")
        and entry.name.lower() not in NO_CAMERAS
        and (entry.is_dir() or entry.suffix.lower() in IMAGE_SUFFIXES | VIDEO_SUFFIXES)
    }
    matched = match_names(entries, rig.names)
    if not matched:
        raise ValueError(
            f"{folder}: no image, video or folder of images of {one_line(', '.join(rig.names), 200)} in it"
        )
    of: Mapping[str, Path] = {camera: entries[name] for name, camera in matched.items()}
    images = [_image_of(of[camera.name], rig, camera.name, frame) if camera.name in of else None for camera in rig]
    if all(image is None for image in images):
        raise ValueError(f"--world-frame {frame}: no camera has an image of this number in {folder}")
    return images


def _image_of(entry: Path, rig: Rig, name: str, frame: int) -> Image | None:
    if entry.is_file() and entry.suffix.lower() in IMAGE_SUFFIXES:
        return read_image(entry, rig[name].size)
    source = source_of(entry, rig[name])
    if frame >= source.n_frames:
        return None
    with closing(CameraReader(source, {})) as reader:
        return reader.read(frame).image


def _shown(text: str) -> str:
    return one_line(text, 100)
