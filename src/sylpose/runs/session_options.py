"""Sessions from command-line options, recorded or live, and checks of their output folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from sylpose.io.capture import Session, live, open_session
from sylpose.io.capture.session import SessionBase
from sylpose.runs.world import WorldSpec, apply_world_and_unit

__all__ = ["check_output_folder", "open_from_options", "open_recording", "parse_video_option"]

SessionT = TypeVar("SessionT", bound=SessionBase)


def open_recording(
    path: Path,
    calibration: Path | None,
    boxes: Path | None,
    masks: Path | None,
    offset: Sequence[str] | None,
    camera: Sequence[str] | None = None,
    rate: float | None = None,
    unit: str | None = None,
    world: WorldSpec | None = None,
    without: Sequence[str] | None = None,
) -> Session:
    """Open a recording; the arguments are the options of the same names, None if not given.

    Raises:
        ValueError, OSError: as `open_session`, `resolve_session_world` and `Rig.in_unit`; an offset that is not
            CAMERA=FRAMES, a camera that is not NAME=FILE.
    """
    cameras = parse_video_option(camera)
    opened = open_session(
        path,
        calibration=calibration,
        boxes=boxes,
        masks=masks,
        offsets=_parse_frame_offsets(offset),
        cameras=cameras,
        rate=rate,
        without=without or (),
    )
    return apply_world_and_unit(opened, world, unit)


def open_from_options(
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
    world: WorldSpec | None = None,
    without: Sequence[str] | None = None,
) -> Session | live.LiveSession:
    """Open a recording, or with `follow` or a live.toml a live session; otherwise as `open_recording`.

    Raises:
        ValueError: also for options that do not apply to this kind of session.
    """
    if not (follow or live.is_live(path)):
        if lossless:
            raise ValueError("--no-drop requires --follow (growing folders)")
        return open_recording(path, calibration, boxes, masks, offset, camera, rate, unit, world, without)
    if without:
        raise ValueError(
            "--exclude-camera: of live cameras and growing folders, all cameras of the calibration are used"
        )
    if camera:
        raise ValueError("--video: live.toml assigns live cameras, and growing folders are assigned by name")
    if offset:
        raise ValueError(
            "--frame-offset: frames of live cameras are matched by their timestamps; set delays with --offsets FILE"
        )
    if resume:
        raise ValueError("--resume: a live session cannot be resumed")
    opened = live.open_live(
        path, calibration=calibration, boxes=boxes, masks=masks, follow=follow, lossless=lossless, rate=rate
    )
    return apply_world_and_unit(opened, world, unit)


def check_output_folder(session: Session | live.LiveSession, out: Path) -> None:
    """Check that results may be written into a folder.

    Raises:
        ValueError: they would be taken for part of the recording.
    """
    target = Path(os.path.realpath(out))
    if target == Path(os.path.realpath(session.path)):
        raise ValueError(f"--out {out}: this is the recording's folder, where results would be taken for cameras")
    cameras = {name: session.path / name for name in session.rig.names}
    if isinstance(session, Session):
        cameras = {source.camera: source.path for source in session.sources}
    for name, path in cameras.items():
        if Path(os.path.realpath(path)) in (target, *target.parents):
            raise ValueError(f"--out {out}: camera {name} has its images there ({path})")
    if session.masks is not None and Path(os.path.realpath(session.masks)) in (target, *target.parents):
        raise ValueError(f"--out {out}: the masks are there ({session.masks})")


def parse_video_option(values: Sequence[str] | None) -> dict[str, str] | None:
    """Parse the values of `--video NAME=FILE` into files by name.

    Raises:
        ValueError: a value of another form, or a name given twice.
    """
    cameras: dict[str, str] = {}
    for text in values or ():
        name, _, file = text.partition("=")
        if not name or not file:
            raise ValueError(f"--video: expected NAME=FILE, such as cam_2=left.mp4, got {text!r}")
        if name in cameras:
            raise ValueError(f"--video: {name} is given twice")
        cameras[name] = file
    return cameras or None


def _parse_frame_offsets(values: Sequence[str] | None) -> dict[str, int] | None:
    offsets = {}
    for text in values or ():
        camera, _, frames = text.rpartition("=")
        try:
            offsets[camera] = int(frames)
        except ValueError:
            camera = ""
        if not camera:
            raise ValueError(f"--frame-offset: expected CAMERA=FRAMES, such as cam_2=5, got {text!r}")
    return offsets or None
