"""`sylpose calibrate` without a board: calibrate a rig from any moving object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sylpose.commands.app import INPUT, OUTPUT, exit_with_failures, option
from sylpose.commands.options import (
    BoxesFile,
    FrameOffset,
    RangeOptions,
    WorldOptions,
    parse_frame_offsets,
    parse_video_option,
)
from sylpose.input_limits import print_message

if TYPE_CHECKING:
    from rich.console import Console

    from sylpose.io.capture import Session
    from sylpose.rig_calibration.from_motion import MotionCalibration


FILE = "calibration.toml"


@dataclass(frozen=True, kw_only=True)
class MotionOptions(WorldOptions, RangeOptions):
    """Options of `sylpose calibrate` without a board, and those that both ways share.

    Attributes:
        session: Folder with one video (cam_0.mp4) or one folder of images per camera.
        intrinsics: Without a board: read the lenses from this calibration, whose poses are ignored, and calibrate from
            the object that moves.
        boxes: Without a board: read the object's boxes in the first frame from this file; default: boxes.toml in SESSION,
            else what moves.
        free: Without a board: also estimate these of the lenses, some of focal,principal,distortion.
        distance: Without a board: set the scale by the distance of two cameras, such as cam_0:cam_1=1.52m.
        object_length: Without a board: set the scale by the object's longest extent, such as 0.25m.
        video: Assign a video or image folder to a camera, instead of all in SESSION. Repeatable.
        exclude_camera: Leave out a camera. Repeatable.
        unit: Set the length unit of the calibration; default: that of the board or of the known length.
        out: Write the calibration here; default: SESSION/calibration.toml if that does not exist.
    """

    session: Annotated[Path, typer.Argument(metavar="SESSION")]
    intrinsics: Annotated[Path | None, option("--intrinsics FILE", INPUT)] = None
    boxes: BoxesFile = None
    free: Annotated[str, option("--free LIST", INPUT)] = ""
    distance: Annotated[str | None, option("--distance CAM:CAM=LENGTH", OUTPUT)] = None
    object_length: Annotated[str | None, option("--object-length LENGTH", OUTPUT)] = None
    frame_offset: FrameOffset = ()
    video: Annotated[tuple[str, ...], option("--video NAME=FILE", INPUT)] = ()
    exclude_camera: Annotated[tuple[str, ...], option("--exclude-camera CAM", INPUT)] = ()
    out: Annotated[Path | None, option("--out FILE", OUTPUT)] = None

    @property
    def file(self) -> Path:
        """Return the file to write; an existing one is replaced only if it was named."""
        if self.out is not None:
            return self.out
        if (file := self.session / FILE).exists():
            raise ValueError(f"{file} exists; name the file to write with --out FILE")
        return file


def calibrate_without_board(options: MotionOptions) -> None:
    """Calibrate all cameras from an object that moves in the recording, print and write the result."""
    from rich.progress import Progress

    from sylpose.atomic_io import make_output_folder
    from sylpose.rig_calibration.from_motion import calibrate_from_motion
    from sylpose.rig_calibration.relative_motions import MotionRefusedError
    from sylpose.runs import console_output
    from sylpose.runs import self_calibration as runs
    from sylpose.runs.calibrate import write_calibration
    from sylpose.runs.precompile import compile_with_progress

    file, free = options.file, runs.parse_free(options.free)
    if options.distance is not None and options.object_length is not None:
        raise ValueError("--distance and --object-length exclude each other")
    session = _open(options)
    distance = None if options.distance is None else runs.parse_distance(options.distance, session.rig.names)
    make_output_folder(file.parent)
    console = console_output.make_console()
    console.print(console_output.format_headline(session))
    console_output.print_warnings(console, session.warnings)
    compile_with_progress(console)
    frames = len(range(options.start, min(options.stop or session.n_frames, session.n_frames)))
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("Tracking by each camera", total=frames * len(session.rig))
        tracks = runs.track_cameras(session, options.start, options.stop, lambda: bar.advance(task))
    try:
        found = calibrate_from_motion(session.rig.cameras, tracks, free)
    except MotionRefusedError as error:
        _print_tests(console, error.tests)
        exit_with_failures([f"{error}; nothing was written"])
    found = runs.set_scale(found, distance, options.object_length, options.unit)
    rig = found.calibration.rig
    located = options.apply_to(session.select_cameras(rig.names).with_rig(rig))
    found = replace(found, calibration=replace(found.calibration, rig=located.rig))
    _print_result(console, found)
    lost = write_calibration(found.calibration, file, runs.describe_tests(found))
    console_output.print_files(console, "Calibration", [file])
    if lost:
        print_message(f"{file}: {lost}")


def _open(options: MotionOptions) -> Session:
    """Open the recording with the intrinsics."""
    from sylpose.io.capture import open_session

    session = open_session(
        options.session,
        calibration=options.intrinsics,
        boxes=options.boxes,
        cameras=parse_video_option(options.video),
        offsets=parse_frame_offsets(options.frame_offset),
        without=options.exclude_camera,
    )
    if len(session.objects) > 1:
        raise ValueError(
            f"{options.session}: several objects ({', '.join(session.objects)}): give boxes of one by --boxes"
        )
    if len(session.rig) < 2:
        raise ValueError(f"{options.session}: calibrating needs two cameras or more, found {session.rig.names[0]} only")
    return session


def _print_tests(console: Console, tests: object) -> None:
    from sylpose.runs import console_output

    rows = [(t.name, t.value, t.limit, "passed" if t.passed else "failed") for t in tests]  # type: ignore[attr-defined]
    console_output.print_table(console, ("Test", "result", "needs", ""), rows)


def _print_result(console: Console, found: MotionCalibration) -> None:
    """Print the cameras, the tests, the scale and warnings."""
    import numpy as np

    from sylpose.display import format_length
    from sylpose.runs import console_output

    calibration = found.calibration
    unit, rows = calibration.rig.unit, []
    for c, camera in enumerate(calibration.rig):
        pose_sd = np.sqrt(np.diag(calibration.extrinsics_covariance[c]))
        angles = np.degrees(camera.camera_from_world.rotation.as_rotvec())
        focal_sd = float(np.sqrt(calibration.intrinsics_covariance[c][0, 0]))
        focal = f"{camera.matrix[0, 0]:.1f} px" + (f" ± {focal_sd:.1g}" if "focal" in found.freed else "")
        rows.append(
            (
                camera.name,
                " ".join(f"{angle:.2f}" for angle in angles),
                f"± {np.degrees(np.linalg.norm(pose_sd[:3])):.1g}°" if c else "",
                " ".join(f"{value:.4f}" for value in camera.center),
                f"± {format_length(float(np.linalg.norm(pose_sd[3:])), unit)}" if c else "",
                focal,
                str(calibration.n_views[c]),
                f"{calibration.rms_px[c]:.2f} px",
            )
        )
    header = (
        "Camera",
        "rotation vector, °",
        "sd",
        f"place, {unit or 'relative'}",
        "sd",
        "focal length",
        "frames",
        "residual",
    )
    console.print()
    console_output.print_table(console, header, rows)
    console.print()
    _print_tests(console, found.tests)
    console.print()
    warnings = [*calibration.warnings, *(f"{name} was left out: {reason}" for name, reason in found.left_out.items())]
    if not unit:
        warnings.append(
            "the scale is unknown: give the distance of two cameras (--distance CAM:CAM=1.52m) or the object's longest "
            "extent (--object-length 0.25m)"
        )
    console_output.print_warnings(console, warnings)
    console_output.print_facts(
        console,
        [("Object", f"{format_length(found.object_length, unit)} long, {format_length(found.distance, unit)} away")],
    )
