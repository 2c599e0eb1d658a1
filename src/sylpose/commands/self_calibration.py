"""Calibration from the object that moves, for `sylpose calibrate` and `sylpose track`: options, tables, steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from sylpose.commands.app import INPUT, OUTPUT, CommandOptions, exit_with_failures, option

if TYPE_CHECKING:
    from rich.console import Console

    from sylpose.io.capture import Session
    from sylpose.rig_calibration.from_motion import MotionCalibration
    from sylpose.rig_calibration.relative_motions import MotionTest


@dataclass(frozen=True, kw_only=True)
class SelfCalibrationOptions(CommandOptions):
    """Options of a calibration from the object that moves.

    Attributes:
        intrinsics: To calibrate from the object that moves, read the lenses from this calibration, with poses, which are
            ignored, or without. One of a single camera is that of CAM, or of all. Repeatable.
        fov: In place of --intrinsics, the horizontal field of view of all cameras in degrees, to 20 %; focal lengths are
            then estimated.
        free: Also estimate these of the lenses, some of focal,principal,distortion.
        distance: Set the scale by the distance of two cameras, such as cam_0:cam_1=1.52m.
        object_length: Set the scale by the object's longest extent, such as 0.25m.
        throw: Set the scale by gravity: the object is thrown up twice or more; prints the vertical, too.
    """

    intrinsics: Annotated[tuple[str, ...], option("--intrinsics [CAM=]FILE", INPUT)] = ()
    fov: Annotated[float | None, option("--fov DEG", INPUT)] = None
    free: Annotated[str, option("--free LIST", INPUT)] = ""
    distance: Annotated[str | None, option("--distance CAM:CAM=LENGTH", OUTPUT)] = None
    object_length: Annotated[str | None, option("--object-length LENGTH", OUTPUT)] = None
    throw: Annotated[bool, option("--throw", OUTPUT)] = False

    def __post_init__(self) -> None:
        """Check that the scale is given once."""
        super().__post_init__()
        scales = {"--distance": self.distance, "--object-length": self.object_length, "--throw": self.throw or None}
        given = [name for name, value in scales.items() if value is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other")
        if self.fov is not None and self.intrinsics:
            raise ValueError("--fov and --intrinsics exclude each other")


def calibrate_recording(
    session: Session,
    options: SelfCalibrationOptions,
    frames: tuple[int, int | None],
    unit: str | None,
    console: Console,
) -> MotionCalibration:
    """Calibrate a recording's cameras from the object that moves in it, and print the progress.

    Args:
        session: the recording, with the lenses.
        options: what is estimated, and the scale.
        frames: first one and the one after the last, as of `Session.frames`.
        unit: unit of the result; None: that of the given length.
        console: for the output.

    Raises:
        typer.Exit: the motion does not determine the cameras; the failed test is printed.
        ValueError: other options, or a recording of one camera or several objects.
    """
    from rich.progress import Progress

    from sylpose.rig_calibration.relative_motions import MotionRefusedError
    from sylpose.rig_calibration.result import CalibrationRefusedError
    from sylpose.runs import self_calibration as runs
    from sylpose.runs.precompile import compile_with_progress

    scale = runs.parse_scale(options.distance, options.object_length, session.rig.names)
    free, (start, stop) = runs.parse_free(options.free), frames
    free = free if options.fov is None else (*free, "fov")
    compile_with_progress(console)
    n_frames = len(range(start, min(stop or session.n_frames, session.n_frames)))
    try:
        with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
            task = bar.add_task("Tracking by each camera", total=n_frames * len(session.rig))
            found = runs.self_calibrate(
                session,
                free,
                start=start,
                stop=stop,
                scale=scale,
                throw=options.throw,
                unit=unit,
                on_frame=lambda: bar.advance(task),
            )
    except CalibrationRefusedError as error:
        if isinstance(error, MotionRefusedError):
            print_tests(console, error.tests)
        exit_with_failures([f"{error}; nothing was written"])
    return found


def print_tests(console: Console, tests: Sequence[MotionTest]) -> None:
    """Print the tests and their results."""
    from sylpose.runs.console_output import print_table

    rows = [(t.name, t.value, t.limit, "passed" if t.passed else "failed") for t in tests]
    print_table(console, ("Test", "result", "needs", ""), rows)


def print_calibration(console: Console, found: MotionCalibration) -> None:
    """Print the cameras, the tests, the scale and warnings."""
    from sylpose.display import format_length
    from sylpose.runs.calibration_page import MOTION_HEADER
    from sylpose.runs.console_output import print_facts, print_table, print_warnings
    from sylpose.runs.self_calibration import build_camera_rows, describe_flight, list_warnings

    unit = found.calibration.rig.unit
    console.print()
    print_table(console, [title.format(unit or "relative") for title in MOTION_HEADER], build_camera_rows(found))
    console.print()
    print_tests(console, found.tests)
    console.print()
    print_warnings(console, list_warnings(found))
    lengths = format_length(found.object_length, unit), format_length(found.distance, unit)
    facts = [("Object", f"{lengths[0]} long, {lengths[1]} away")]
    print_facts(console, [*facts, *([("Gravity", describe_flight(found.flight))] if found.flight else [])])
