"""Calibration from the object that moves, for `sylpose calibrate` and `sylpose track`: options, tables, steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from sylpose.commands.app import INPUT, OUTPUT, exit_with_failures, option
from sylpose.commands.options import RangeOptions, WorldOptions

if TYPE_CHECKING:
    from rich.console import Console

    from sylpose.io.capture import Session
    from sylpose.rig_calibration.from_motion import MotionCalibration
    from sylpose.rig_calibration.relative_motions import MotionTest


# Options that only a calibration from the object that moves has.
MOTION_OPTIONS = ("intrinsics", "fov", "free", "distance", "object_length", "throw")


@dataclass(frozen=True, kw_only=True)
class SelfCalibrationOptions(WorldOptions, RangeOptions):
    """Options of a calibration from the object that moves.

    Attributes:
        intrinsics: To calibrate from the object that moves, read the lenses from this calibration, with poses, which are
            ignored, or without. One of a single camera is that of CAM, or of all. Repeatable.
        fov: In place of --intrinsics, the horizontal field of view of all cameras in degrees, to 20 %, or exif: that of the
            photographs; focal lengths are then estimated.
        free: Also estimate these of the lenses, some of focal,principal,distortion.
        distance: Set the scale by the distance of two cameras, such as cam_0:cam_1=1.52m.
        object_length: Set the scale by the object's longest extent, such as 0.25m.
        throw: Set the scale by gravity: the object is thrown up twice or more; prints the vertical, too.
        offsets: Read the cameras' time offsets in seconds (TOML); default: SESSION/offsets.toml if present.
    """

    intrinsics: Annotated[tuple[str, ...], option("--intrinsics [CAM=]FILE", INPUT)] = ()
    fov: Annotated[str | None, option("--fov DEG|exif", INPUT)] = None
    free: Annotated[str, option("--free LIST", INPUT)] = ""
    distance: Annotated[str | None, option("--distance CAM:CAM=LENGTH", OUTPUT)] = None
    object_length: Annotated[str | None, option("--object-length LENGTH", OUTPUT)] = None
    throw: Annotated[bool, option("--throw", OUTPUT)] = False
    offsets: Annotated[Path | None, option("--offsets FILE", INPUT)] = None

    def __post_init__(self) -> None:
        """Check that the scale is given once."""
        super().__post_init__()
        scales = {"--distance": self.distance, "--object-length": self.object_length, "--throw": self.throw or None}
        given = [name for name, value in scales.items() if value is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other")
        if self.fov is not None and self.intrinsics:
            raise ValueError("--fov and --intrinsics exclude each other")

    def refuse_motion_options(self, reason: str) -> None:
        """Refuse the options of a calibration from motion.

        Raises:
            ValueError: one is given.
        """
        for name in MOTION_OPTIONS:
            if getattr(self, name):
                raise ValueError(f"--{name.replace('_', '-')}: {reason}")


def calibrate_recording(
    session: Session, options: SelfCalibrationOptions, console: Console
) -> tuple[Session, MotionCalibration]:
    """Calibrate a recording's cameras from the object that moves in it, and print the recording, progress and result.

    All options are checked before the calibration, which takes minutes.

    Args:
        session: the recording, with the lenses.
        options: what is estimated, the scale, the world, the frames.
        console: for the output.

    Returns:
        the recording with these cameras, and the calibration, both in the requested world and unit.

    Raises:
        typer.Exit: the motion does not determine the cameras; the failed test is printed.
        ValueError: other options, or a recording of one camera or several objects.
    """
    from rich.progress import Progress

    from sylpose.rig_calibration.from_motion import locate
    from sylpose.rig_calibration.relative_motions import MotionRefusedError
    from sylpose.rig_calibration.result import CalibrationRefusedError
    from sylpose.runs import console_output
    from sylpose.runs import self_calibration as runs
    from sylpose.runs.precompile import compile_with_progress
    from sylpose.runs.world import check_world
    from sylpose.sync.offsets import find_offsets

    scale = runs.parse_scale(options.distance, options.object_length, session.rig.names)
    unit = runs.choose_unit(scale, options.throw, options.unit)
    if options.world_spec is not None:
        check_world(options.world_spec, unit)
    free = runs.parse_free(options.free)
    free = free if options.fov is None else (*free, "fov")
    offsets = find_offsets(session, options.offsets)
    console.print(console_output.format_headline(session))
    console_output.print_warnings(console, session.warnings)
    console_output.print_offsets(console, offsets)
    compile_with_progress(console)
    n_frames = len(range(options.start, min(options.stop or session.n_frames, session.n_frames)))
    try:
        with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
            task = bar.add_task("Tracking by each camera", total=n_frames * len(session.rig))
            found = runs.self_calibrate(
                session,
                free,
                start=options.start,
                stop=options.stop,
                scale=scale,
                throw=options.throw,
                unit=options.unit,
                offsets=offsets,
                on_frame=lambda: bar.advance(task),
            )
    except CalibrationRefusedError as error:
        if isinstance(error, MotionRefusedError):
            print_tests(console, error.tests)
        exit_with_failures([f"{error}; nothing was written"])
    rig = found.calibration.rig
    located = options.apply_to(session.select_cameras(rig.names).with_rig(rig))
    found = locate(found, located.rig)
    print_calibration(console, found)
    return located, found


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
    print_facts(console, [*facts, *([("Gravity", describe_flight(found))] if found.flight else [])])
