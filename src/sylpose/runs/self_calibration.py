"""Calibration of a recording's cameras from the object that moves in it: tracking by each camera, scale, file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np

from sylpose.frames import FrameSet
from sylpose.io.capture import Session
from sylpose.rig_calibration.camera_tracks import RefinedTrack, make_single_rig, refine_track, track_alone
from sylpose.rig_calibration.from_motion import MotionCalibration
from sylpose.rig_calibration.motion_bundle import LENS_SD
from sylpose.units import METERS, parse_length_with_unit


def track_cameras(
    session: Session,
    start: int = 0,
    stop: int | None = None,
    on_frame: Callable[[], None] = lambda: None,
) -> list[RefinedTrack | None]:
    """Track the object by each camera alone, in parallel, and refine the tracks.

    Args:
        session: a recording of one object; the rig's poses are not used.
        start, stop: frames, as of `Session.frames`.
        on_frame: called after each frame of each camera, from several threads.

    Returns:
        the cameras' tracks; None for a camera that could not track the object.
    """

    def track_camera(name: str) -> RefinedTrack | None:
        camera = session.rig[name]
        alone = session.select_cameras([name]).with_rig(make_single_rig(camera))
        # A box is that of the first frame of the recording.
        box = session.boxes.get(name) if start == 0 else None
        with closing(alone.frames(start, stop, on_problem=lambda _: None)) as frames:
            return refine_track(track_alone(_skip_missing(frames, on_frame), camera, box), camera)

    with ThreadPoolExecutor(min(len(session.rig), os.cpu_count() or 1), "calibrate") as pool:
        return list(pool.map(track_camera, session.rig.names))


def _skip_missing(frames: Iterator[FrameSet], on_frame: Callable[[], None]) -> Iterator[FrameSet]:
    """Yield the frames from the first one with an image: a camera may start late."""
    has_started = False
    for frame in frames:
        has_started = has_started or frame.images[0] is not None
        if has_started:
            yield frame
        on_frame()


def parse_free(text: str) -> tuple[str, ...]:
    """Parse what is estimated of the lenses, such as `focal,principal`.

    Raises:
        ValueError: an unknown word.
    """
    words = tuple(word.strip() for word in text.split(",") if word.strip())
    for word in words:
        if word not in LENS_SD:
            raise ValueError(f"--free must be some of {','.join(LENS_SD)}, got {word!r}")
    return words


def parse_distance(text: str, names: Sequence[str]) -> tuple[str, str, float, str]:
    """Parse a distance of two cameras such as `cam_0:cam_1=1.52m` into their names, the length and its unit.

    Raises:
        ValueError: another form, or cameras that do not exist.
    """
    pair, equals, length = text.partition("=")
    first, colon, second = pair.partition(":")
    if not (equals and colon) or first == second or not {first, second} <= {*names}:
        raise ValueError(
            f"--distance must be CAM:CAM=LENGTH with two of the cameras {', '.join(names)}, such as "
            f"{names[0]}:{names[-1]}=1.52m; got {text!r}"
        )
    return first, second, *parse_length_with_unit(length, "--distance")


def set_scale(
    found: MotionCalibration, distance: tuple[str, str, float, str] | None, object_length: str | None, unit: str | None
) -> MotionCalibration:
    """Scale a calibration by a known length, and convert it to a unit.

    Args:
        found: the calibration, in relative lengths.
        distance: as of `parse_distance`.
        object_length: longest extent of the object, such as `0.25m`.
        unit: of the result; None: that of the length.

    Raises:
        ValueError: a camera that is not in the rig; a unit without a length.
    """
    rig = found.calibration.rig
    if distance is not None:
        first, second, length, own_unit = distance
        for name in (first, second):
            if name not in rig:
                raise ValueError(f"--distance: {name} was left out: {found.left_out.get(name, 'not a camera')}")
        factor = length / float(np.linalg.norm(rig[first].center - rig[second].center))
    elif object_length is not None:
        length, own_unit = parse_length_with_unit(object_length, "--object-length")
        factor = length / found.object_length
    elif unit is not None:
        raise ValueError("--unit: give a length, --distance CAM:CAM=1.52m or --object-length 0.25m")
    else:
        return found
    if unit is None or own_unit in ("", unit):
        return found.rescale(factor, own_unit or unit or "")
    if unit not in METERS:
        raise ValueError(f"--unit must be one of {', '.join(METERS)}, got {unit!r}")
    return found.rescale(factor * METERS[own_unit] / METERS[unit], unit)


def describe_tests(found: MotionCalibration) -> list[str]:
    """Describe the tests and the cameras left out, one line each."""
    lines = [f"{test.name}: {test.value} ({test.limit})" for test in found.tests]
    return lines + [f"left out: {name}: {reason}" for name, reason in found.left_out.items()]
