"""Calibration of a recording's cameras from the object that moves in it: tracking by each camera, scale, file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from sylpose.display import format_length
from sylpose.frames import FrameSet
from sylpose.geometry.validation import check_choice, check_type
from sylpose.io.capture import Session
from sylpose.rig_calibration.camera_tracks import RefinedTrack, make_single_rig, refine_track, track_alone
from sylpose.rig_calibration.free_flight import find_free_flight
from sylpose.rig_calibration.from_motion import MotionCalibration, calibrate_from_motion, rescale
from sylpose.rig_calibration.motion_bundle import LENS_SD
from sylpose.sync.offsets import apply_offsets, find_offsets
from sylpose.units import METERS, parse_length_with_unit

# Relative standard deviation of the object's measured length (measured: docs/calibrating.md; its ends must be seen).
OBJECT_LENGTH_SD = 0.1


def self_calibrate(
    session: Session,
    free: Sequence[str] = (),
    *,
    start: int = 0,
    stop: int | None = None,
    scale: KnownLength | None = None,
    throw: bool = False,
    unit: str | None = None,
    offsets: Mapping[str, float] | None = None,
    on_frame: Callable[[], None] = lambda: None,
) -> MotionCalibration:
    """Calibrate a recording's cameras from any rigid object that moves in it, without a board.

    Args:
        session: a recording of one object by two cameras or more; its lenses are used, its poses are not.
        free: what is estimated of the lenses, some of "focal", "principal", "distortion"; "fov" if focal lengths come from
            a field of view (`open_session`).
        start, stop: frames, as of `Session.frames`.
        scale: a known length; None: lengths are relative to the first camera's distance from the object.
        throw: set the scale by gravity instead: the object is thrown up twice or more.
        unit: unit of the result; None: that of the known length.
        offsets: delay of cameras' images relative to their times, seconds; None: those of offsets.toml in the recording.
        on_frame: called after each frame of each camera, from several threads.

    Raises:
        MotionRefusedError: the motion does not determine the cameras; the message has the reason and the remedy.
        CalibrationRefusedError: the same of throws.
        ValueError: one camera, several objects, frames outside the recording, or offsets of unknown cameras; throws in a
            recording without time stamps, or with a known length.
    """
    check_type(session, Session, "session")
    if len(session.objects) > 1:
        raise ValueError(
            f"{session.path}: several objects ({', '.join(session.objects)}): give boxes of one by --boxes"
        )
    if len(session.rig) < 2:
        raise ValueError(f"{session.path}: calibrating needs two cameras or more, found {session.rig.names[0]} only")
    final_unit = choose_unit(scale, throw, unit)
    if throw and session.rate is None:
        raise ValueError(f"throw: {session.path} has no time stamps, which enter by their square: give timestamps.csv")
    session = apply_offsets(session, find_offsets(session) if offsets is None else offsets)
    tracks = track_cameras(session, start, stop, on_frame)
    found = calibrate_from_motion(session.rig.cameras, tracks, free, is_timed=session.rate is not None)
    if not throw:
        return found if scale is None else _set_scale(found, scale, final_unit)
    flight = find_free_flight(found.times, found.reference_from_object)
    factor = flight.scale / METERS[final_unit]
    return replace(rescale(found, factor, final_unit, sd=flight.scale_sd), flight=flight)


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


@dataclass(frozen=True)
class KnownLength:
    """Length that sets the scale of a calibration.

    Attributes:
        length: in `unit`, which may be "".
        unit: of the length.
        cameras: names of the two cameras that are so far apart; None: the object is so long.
    """

    length: float
    unit: str
    cameras: tuple[str, str] | None = None


def parse_scale(distance: str | None, object_length: str | None, names: Sequence[str]) -> KnownLength | None:
    """Parse a distance of two cameras such as `cam_0:cam_1=1.52m`, or the object's length, such as `0.25m`.

    Raises:
        ValueError: another form, or cameras that do not exist.
    """
    if distance is None:
        return None if object_length is None else KnownLength(*parse_length_with_unit(object_length, "--object-length"))
    pair, equals, length = distance.partition("=")
    first, colon, second = pair.partition(":")
    if not (equals and colon) or first == second or not {first, second} <= {*names}:
        raise ValueError(
            f"--distance must be CAM:CAM=LENGTH with two of the cameras {', '.join(names)}, such as "
            f"{names[0]}:{names[-1]}=1.52m; got {distance!r}"
        )
    return KnownLength(*parse_length_with_unit(length, "--distance"), (first, second))


def choose_unit(scale: KnownLength | None, throw: bool, unit: str | None) -> str:
    """Return the unit of a calibration: the requested one, that of the known length, meters from a throw, or "".

    Raises:
        ValueError: an unknown unit, or one without a scale; two scales.
    """
    if throw and scale is not None:
        raise ValueError("throw: the scale is given by a length, too; omit one")
    if unit is None:
        return "m" if throw else "" if scale is None else scale.unit
    if not throw and scale is None:
        raise ValueError("--unit: give a length, --distance CAM:CAM=1.52m or --object-length 0.25m, or --throw")
    return check_choice(unit, [*METERS], "unit")


def _set_scale(found: MotionCalibration, scale: KnownLength, unit: str) -> MotionCalibration:
    """Scale a calibration in relative lengths by a known length, and convert it to a unit.

    Raises:
        ValueError: a camera that is not in the rig.
    """
    rig, measured, sd = found.calibration.rig, found.object_length, OBJECT_LENGTH_SD
    if scale.cameras is not None:
        for name in scale.cameras:
            if name not in rig:
                reason = found.left_out.get(name, "not a camera")
                raise ValueError(
                    f"--distance: {name} was left out: {reason}; give the distance of two of {', '.join(rig.names)}"
                )
        first, second = (rig[name].center for name in scale.cameras)
        measured, sd = float(np.linalg.norm(first - second)), 0.0
    factor = scale.length / measured
    if scale.unit:
        factor *= METERS[scale.unit] / METERS[unit]
    return rescale(found, factor, unit, exact=scale.cameras, sd=sd)


def build_camera_rows(found: MotionCalibration) -> list[list[str]]:
    """Return the cells of a table of the cameras: pose, focal length, frames and residual, with standard deviations."""
    calibration, rows = found.calibration, []
    unit = calibration.rig.unit
    for c, camera in enumerate(calibration.rig):
        pose_sd = np.sqrt(np.diag(calibration.extrinsics_covariance[c]))
        angles = np.degrees(camera.camera_from_world.rotation.as_rotvec())
        focal_sd = float(np.sqrt(calibration.intrinsics_covariance[c][0, 0]))
        focal = f"{camera.matrix[0, 0]:.1f} px" + (f" ± {focal_sd:.1g}" if {"focal", "fov"} & {*found.freed} else "")
        row = [camera.name, " ".join(f"{angle:.2f}" for angle in angles.round(2) + 0.0)]
        row.append(f"± {np.degrees(np.linalg.norm(pose_sd[:3])):.1g}°" if c else "")
        row.append(" ".join(f"{value:.4f}" for value in camera.center.round(4) + 0.0))
        row.append(f"± {format_length(float(np.linalg.norm(pose_sd[3:])), unit)}" if c else "")
        rows.append([*row, focal, str(calibration.n_views[c]), f"{calibration.rms_px[c]:.2f} px"])
    return rows


def list_warnings(found: MotionCalibration) -> list[str]:
    """Return what may be wrong with a calibration, and what it lacks, one sentence each."""
    warnings = [*found.calibration.unobservable, *found.calibration.warnings]
    warnings += [f"{name} was left out: {reason}" for name, reason in found.left_out.items()]
    if not found.calibration.rig.unit:
        warnings.append(
            "the scale is unknown: give the distance of two cameras (--distance CAM:CAM=1.52m) or the object's longest "
            "extent (--object-length 0.25m), or throw it (--throw)"
        )
    return warnings


def describe_tests(found: MotionCalibration) -> list[str]:
    """Describe the tests and the cameras left out, one line each."""
    lines = [f"{test.name}: {test.value} ({test.limit})" for test in found.tests]
    if found.flight is not None:
        lines.append(describe_flight(found))
    return lines + [f"left out: {name}: {reason}" for name, reason in found.left_out.items()]


def describe_flight(found: MotionCalibration) -> str:
    """Describe the throws that set the scale, and the vertical that they give, in the axes of the calibration."""
    flight, camera = found.flight, found.calibration.rig[0]
    assert flight is not None
    up = ",".join(f"{value:.4f}" for value in camera.rotation.T @ flight.up + 0.0)
    return (
        f"{len(flight.flights)} throws: scale ± {100 * flight.scale_sd:.2g} %, if the time stamps are right (1 % changes it "
        f"by 2 %); upwards is {up} in the axes of the calibration, ± {np.degrees(flight.up_sd):.2g} degrees "
        f"(--world up={up})"
    )
