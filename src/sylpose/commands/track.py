"""`sylpose track`: its options; `track_display` shows the run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from sylpose.commands.app import ADVANCED, INPUT, LIVE, OBJECT, OUTPUT, command, exit_with_failures, option, pick
from sylpose.commands.options import (
    BoxesFile,
    DisplayOptions,
    EulerAxes,
    FrameOffset,
    MethodOptions,
    OutFolder,
    Overlay,
    PlotFormat,
    RecordingOptions,
    RefineCalibration,
    Seed,
    Smooth,
    StepOptions,
)
from sylpose.commands.self_calibration import SelfCalibrationOptions, calibrate_recording
from sylpose.input_limits import print_message
from sylpose.methods import MODES, format_methods_table
from sylpose.units import METERS

if TYPE_CHECKING:
    from sylpose.geometry.arrays import FloatArray
    from sylpose.io.capture import Session
    from sylpose.io.capture.live import LiveSession
    from sylpose.mesh import Mesh
    from sylpose.runs.options import RunOptions
    from sylpose.tracking.options import TrackingOptions


# Options that do not apply to live cameras and growing folders.
_NOT_LIVE = {
    "exclude_camera": "of live cameras and growing folders, all cameras of the calibration are used",
    "video": "live.toml assigns live cameras, and growing folders are assigned by name",
    "frame_offset": "frames of live cameras are matched by their timestamps; set delays with --offsets FILE",
    "self_calibrate": "only recordings can be tracked twice",
    "resume": "a live session cannot be resumed",
}
# Options that do not apply to a mesh.
_NOT_WITH_MESH = (
    "boxes",
    "known",
    "method",
    "features",
    "self_calibrate",
    "smooth",
    "refine_calibration",
    "distributed",
    "resume",
    "follow",
)


@dataclass(frozen=True, kw_only=True)
class TrackOptions(StepOptions, SelfCalibrationOptions, DisplayOptions, MethodOptions, RecordingOptions):
    """Options of `sylpose track`.

    Attributes:
        method: Select the estimation method; see below.
        self_calibrate: First calibrate the cameras from the object that moves, as sylpose calibrate does, with the lenses
            of --intrinsics, or of --calibration; its poses are ignored.
        known: Without boxes, track body N of those that `sylpose check` draws with the same --start, --stop and --every;
            or express poses in the frame of an object.npz from another recording; for several objects, repeat with
            NAME=FILE.
        mesh: Track a body of this shape by its outlines, without features: STL, OBJ, PLY or GLB; poses are those of its
            axes.
        mesh_unit: Set the length unit of the mesh's file; default: meters.
        follow: Track image folders that a recorder is still writing.
        no_drop: With --follow, track all frames, regardless of the delay.
        distributed: Run one node per camera over a simulated network: exact as in one process, or compact in fewer
            rounds.
        velocity: Write velocity.csv: also velocities and accelerations, with standard deviations.
        resume: Continue an interrupted run; requires the same options.
        checkpoint_seconds: Set the time between checkpoints for --resume.
        limit: Set a limit or size of the tracker, a field of TrackingOptions. Repeatable.
    """

    self_calibrate: Annotated[bool, option("--self-calibrate", INPUT)] = False
    boxes: BoxesFile = None
    known: Annotated[tuple[str, ...], option("--object N|[NAME=]FILE", OBJECT)] = ()
    mesh: Annotated[Path | None, option("--mesh FILE", OBJECT)] = None
    mesh_unit: Annotated[str | None, option(f"--mesh-unit {'|'.join(METERS)}", OBJECT)] = None
    frame_offset: FrameOffset = ()
    out: OutFolder = None
    overlay: Overlay = True
    angles: EulerAxes = None
    velocity: Annotated[bool, option("--velocity", OUTPUT)] = False
    plot_format: PlotFormat = "png"
    follow: Annotated[bool, option("--follow", LIVE)] = False
    no_drop: Annotated[bool, option("--no-drop", LIVE)] = False
    smooth: Smooth = None
    refine_calibration: RefineCalibration = False
    distributed: Annotated[str | None, option(f"--simulate-nodes {'|'.join(MODES)}", ADVANCED)] = None
    resume: Annotated[bool, option("--resume", ADVANCED)] = False
    checkpoint_seconds: Annotated[float, option("--checkpoint SEC", ADVANCED, min=0)] = 20.0
    limit: Annotated[tuple[str, ...], option("--set NAME=VALUE", ADVANCED)] = ()
    seed: Seed = 0

    def __post_init__(self) -> None:
        """Check that options of the calibration come with it, and others without."""
        super().__post_init__()
        if self.mesh is not None:
            self._refuse_with_mesh()
        if self.mesh_unit is not None and (self.mesh is None or self.mesh_unit not in METERS):
            raise ValueError(
                f"--mesh-unit: one of {', '.join(METERS)}, with --mesh, is expected, got {self.mesh_unit!r}"
            )
        if not self.self_calibrate:
            self.refuse_motion_options("only with --self-calibrate")
        elif self.resume or self.refine_calibration:
            name = "--resume" if self.resume else "--refine-calibration"
            raise ValueError(f"{name}: not with --self-calibrate, which calibrates from all frames")

    def _refuse_with_mesh(self) -> None:
        """Refuse options that select another object, need features or need live cameras."""
        for name in _NOT_WITH_MESH:
            default = next(f.default for f in fields(self) if f.name == name)
            if getattr(self, name) != default:
                option_name = {"known": "object", "distributed": "simulate-nodes"}.get(name, name.replace("_", "-"))
                raise ValueError(
                    f"--{option_name}: not with --mesh, which is tracked by its outlines; omit one of the two"
                )

    def open_session(self) -> Session | LiveSession:
        """Open the recording, or with `follow` or a live.toml the live session, in the requested world and unit.

        A recording whose cameras are still to be calibrated keeps the world and unit of its file.

        Raises:
            ValueError, OSError: as `open_session` and `open_live`; options that do not apply to the kind of session.
        """
        from sylpose.io.calibration.lenses import parse_fov, parse_lens_files
        from sylpose.io.capture.live import is_live, open_live

        if not (self.follow or is_live(self.session)):
            if self.no_drop:
                raise ValueError("--no-drop requires --follow (growing folders)")
            if self.self_calibrate:
                return self.open(self.boxes, self.frame_offset, parse_lens_files(self.intrinsics), parse_fov(self.fov))
            return self.apply_to(self.open(self.boxes, self.frame_offset))
        for name, reason in _NOT_LIVE.items():
            if getattr(self, name):
                raise ValueError(f"--{name.replace('_', '-')}: {reason}")
        live = open_live(
            self.session,
            calibration=self.calibration,
            boxes=self.boxes,
            masks=self.masks,
            follow=self.follow,
            lossless=self.no_drop,
            rate=self.rate,
        )
        return self.apply_to(live)

    def calibrate(self, session: Session) -> tuple[Session, FloatArray]:
        """Calibrate a recording's cameras from the object that moves, and write the calibration into the results.

        Returns:
            the recording in the requested world and unit, and the covariance of the calibration.

        Raises:
            typer.Exit: the motion does not determine the cameras.
            ValueError, OSError: as `calibrate_recording`; other options that are wrong, before it.
        """
        from sylpose.commands.track_display import STDOUT, open_pose_stream
        from sylpose.runs import console_output
        from sylpose.runs.calibration_page import write_motion_calibration
        from sylpose.runs.run import check_candidate, check_output, replace_results
        from sylpose.runs.run_metadata import ESTIMATED

        is_selected = session.masks is not None or any(session.select_object(name).boxes for name in session.objects)
        check_candidate(self.run_options(session).candidate, is_selected=is_selected)
        if self.stream is not None:
            with open_pose_stream(self.stream):
                pass
        check_output(session, self.out)
        console = console_output.make_console(stderr=self.stream == STDOUT, quiet=self.quiet)
        session, found = calibrate_recording(session, self, console)
        with replace_results(session, self.out) as folder:
            files, _ = write_motion_calibration(found, folder / ESTIMATED[0], session.path.resolve().name)
        console_output.print_files(console, "Calibration", files)
        console.print()
        return replace(session, calibration=files[0]), found.covariance

    def run_options(
        self, session: Session | LiveSession, calibration_covariance: FloatArray | None = None
    ) -> RunOptions:
        """Return the options of the run, with the files of objects and time offsets read.

        Raises:
            ValueError, OSError: as `load_known_objects`, `find_offsets` and `RunOptions`.
        """
        from sylpose.io.object_files import load_known_objects
        from sylpose.runs.options import RunOptions
        from sylpose.sync.offsets import find_offsets

        numbers = [text for text in self.known if text.isascii() and text.isdigit()]
        if numbers and (len(self.known) > 1 or not int(numbers[0])):
            raise ValueError(f"--object: expected one number from 1 on, or files, got {' '.join(self.known)}")
        known = load_known_objects(() if numbers else self.known, session.objects, session.rig)
        candidate = int(numbers[0]) if numbers else None
        mesh = None if self.mesh is None else self._read_mesh(session.rig.unit)
        tracking = parse_tracking_options(self.limit)
        offsets = find_offsets(session, self.offsets)
        changes = {"offsets": offsets, "known": known, "candidate": candidate, "mesh": mesh, "tracking": tracking}
        return pick(self, RunOptions, calibration_covariance=calibration_covariance, **changes)

    def _read_mesh(self, unit: str) -> Mesh:
        from sylpose.io.mesh_files import read_mesh

        assert self.mesh is not None
        if self.mesh_unit is not None and unit not in METERS:
            raise ValueError("--mesh-unit: the calibration has no unit; omit it, and scale the mesh to the calibration")
        return read_mesh(self.mesh, unit if unit in METERS else "", self.mesh_unit or "m")


def parse_tracking_options(texts: Sequence[str]) -> TrackingOptions:
    """Parse values of `--set`, NAME=VALUE.

    Raises:
        ValueError: an unknown name, or a value that is no number or out of its range.
    """
    from sylpose.tracking.options import TrackingOptions

    kinds = {field.name: int if isinstance(field.default, int) else float for field in fields(TrackingOptions)}
    values = dict[str, Any]()
    for text in texts:
        name, _, number = text.partition("=")
        if name not in kinds:
            raise ValueError(f"--set: {name!r} is not one of {', '.join(kinds)}")
        try:
            values[name] = kinds[name](number)
        except ValueError:
            raise ValueError(f"--set {name}: {number!r} is not a number") from None
    return TrackingOptions(**values)


@command("Track an object in a recording or live cameras.", notes=f"\b\n{format_methods_table()}\n")
def track(options: TrackOptions) -> None:
    """Track the pose of an object in a recording or in live cameras (a folder with live.toml).

    Writes trajectory.tum (time tx ty tz qx qy qz qw), trajectory.csv (with angles, uncertainty, status, inliers and
    residuals), report.html, report.png and overlay.mp4 into OUT; several objects get one folder each. Without boxes and
    masks, the body that moves with the most features is tracked.

    Examples:
        sylpose track recording
        sylpose track recording --boxes first_frame.toml --out results
        sylpose track recording --self-calibrate --intrinsics lenses.toml --distance cam_0:cam_1=1.52m
        sylpose track recording --start 100 --stop 400 --every 2 --frame-offset cam_2=5
    """
    from sylpose.commands.track_display import track_in_terminal
    from sylpose.io.capture import Session
    from sylpose.runs.check import check_session, describe_axis_miss, explain_failures
    from sylpose.runs.run import has_finished, output_path

    session, covariance = options.open_session(), None
    if options.self_calibrate:
        assert isinstance(session, Session)
        session, covariance = options.calibrate(session)
    if options.resume and has_finished(session, options.out):
        print(f"{output_path(session, options.out)}: the run there has ended; there is nothing to resume")
        return
    run = track_in_terminal(session, options.out, options.run_options(session, covariance), options)
    missing = explain_failures(session, run)
    # Warnings from the start of the run may be the cause and have scrolled away: repeat them.
    hints = (*check_session(session, options.start), describe_axis_miss(session.rig)) if missing else ()
    sentences = [sentence for sentence in (*missing, *hints) if sentence]
    if len(missing) == len(run.trajectories):
        exit_with_failures(sentences)
    for sentence in sentences:
        print_message(sentence)
