"""A session as the options of `sylpose track` and `check` ask for it, recorded or live, and where its results may go."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from sylpose.app.world import WorldAsked, world_of_session
from sylpose.capture import Session, live, open_session
from sylpose.capture.session import SessionBase
from sylpose.units import METRES

__all__ = ["camera_files", "check_out", "open_asked", "open_recorded", "told"]

Opened = TypeVar("Opened", bound=SessionBase)


def open_recorded(
    path: Path,
    calibration: Path | None,
    boxes: Path | None,
    masks: Path | None,
    offset: Sequence[str] | None,
    camera: Sequence[str] | None = None,
    rate: float | None = None,
    unit: str | None = None,
    world: WorldAsked | None = None,
    without: Sequence[str] | None = None,
) -> Session:
    """A recording; the arguments are the options of the same names, None where they were not given.

    Raises:
        ValueError, OSError: as `open_session`, `world_of_session` and `Rig.in_unit`; an offset that is not CAMERA=FRAMES, a
            camera that is not NAME=FILE.
    """
    cameras = camera_files(camera)
    opened = open_session(
        path,
        calibration=calibration,
        boxes=boxes,
        masks=masks,
        offsets=_offsets(offset),
        cameras=cameras,
        rate=rate,
        without=without or (),
    )
    return told(opened, world, unit)


def open_asked(
    path: Path,
    calibration: Path | None,
    boxes: Path | None,
    masks: Path | None,
    offset: Sequence[str] | None,
    *,
    resume: bool,
    follow: bool,
    lossless: bool,
    rate: float | None,
    camera: Sequence[str] | None = None,
    unit: str | None = None,
    world: WorldAsked | None = None,
    without: Sequence[str] | None = None,
) -> Session | live.LiveSession:
    """A recording, or with `follow` or a live.toml a live session; otherwise as `open_recorded`.

    Raises:
        ValueError: also for options that have no meaning for this kind of session.
    """
    if not (follow or live.is_live(path)):
        if lossless:
            raise ValueError("--no-drop is only for growing folders, with --follow")
        return open_recorded(path, calibration, boxes, masks, offset, camera, rate, unit, world, without)
    if without:
        raise ValueError("--exclude-camera: of live cameras and growing folders all take part that the calibration has")
    if camera:
        raise ValueError("--video: of live cameras live.toml says which is which, and growing folders have their names")
    if offset:
        raise ValueError(
            "--frame-offset: frames of live cameras belong together by their times; --offsets FILE is for delays"
        )
    if resume:
        raise ValueError("--resume: a live session cannot be gone back to")
    opened = live.open_live(
        path, calibration=calibration, boxes=boxes, masks=masks, follow=follow, lossless=lossless, rate=rate
    )
    return told(opened, world, unit)


def told(opened: Opened, world: WorldAsked | None, unit: str | None) -> Opened:
    """The session in another world, then in another unit: lengths that `world` has are the calibration's.

    Raises:
        ValueError, OSError: as `world_of_session` and `Rig.in_unit`.
    """
    if world is not None:
        found, notes = world_of_session(opened, world)
        opened = replace(opened.told_in(found), warnings=(*opened.warnings, *notes))
    if unit in METRES and not opened.rig.unit:
        raise ValueError(
            f"--unit {unit}: {opened.calibration} does not say its own unit; sylpose calibration convert IN OUT --is-in m "
            "writes one that does"
        )
    return opened if unit is None else opened.with_rig(opened.rig.in_unit(unit))


def check_out(session: Session | live.LiveSession, out: Path) -> None:
    """Whether results may be written into a folder.

    Raises:
        ValueError: they would be taken for part of the recording.
    """
    there = Path(os.path.realpath(out))
    if there == Path(os.path.realpath(session.path)):
        raise ValueError(
            f"--out {out}: this is the recording's own folder, in which results would be taken for cameras"
        )
    cameras = {name: session.path / name for name in session.rig.names}
    if isinstance(session, Session):
        cameras = {source.camera: source.path for source in session.sources}
    for name, path in cameras.items():
        if Path(os.path.realpath(path)) in (there, *there.parents):
            raise ValueError(f"--out {out}: camera {name} has its images there ({path})")
    if session.masks is not None and Path(os.path.realpath(session.masks)) in (there, *there.parents):
        raise ValueError(f"--out {out}: the masks are there ({session.masks})")


def camera_files(given: Sequence[str] | None) -> dict[str, str] | None:
    """What `--video NAME=FILE` says, by name.

    Raises:
        ValueError: something else, or a name twice.
    """
    cameras: dict[str, str] = {}
    for text in given or ():
        name, _, file = text.partition("=")
        if not name or not file:
            raise ValueError(f"--video: NAME=FILE is expected, such as cam_2=left.mp4, got {text!r}")
        if name in cameras:
            raise ValueError(f"--video: {name} is given twice")
        cameras[name] = file
    return cameras or None


def _offsets(given: Sequence[str] | None) -> dict[str, int] | None:
    offsets = {}
    for text in given or ():
        camera, _, frames = text.rpartition("=")
        try:
            offsets[camera] = int(frames)
        except ValueError:
            camera = ""
        if not camera:
            raise ValueError(f"--frame-offset: CAMERA=FRAMES is expected, such as cam_2=5, got {text!r}")
    return offsets or None
