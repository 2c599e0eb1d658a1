"""`sylpose object`: show an object file, set its frame or size, and re-express a result in its frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sylpose.commands.app import CommandOptions, app, command, option
from sylpose.commands.options import PlotFormat
from sylpose.units import INITIAL_DISTANCES, METERS

if TYPE_CHECKING:
    from sylpose.tracking.known_object import KnownObject


# Axes with a larger standard deviation, degrees, cause a warning (choice).
MAX_AXIS_SD_DEG = 5.0
POINTS = (
    '\b\nA POINT is "X,Y,Z" (in the present frame), "near X,Y,Z" (the nearest landmark), or pixels in a frame of a '
    'run,\n"@42 cam_0=812,400 cam_2=310,95"; one camera suffices where landmarks cover the surface.\n'
)

object_app = typer.Typer(
    help="Show or edit the object model of a run (object.npz).", no_args_is_help=True, rich_markup_mode=None
)
app.add_typer(object_app, name="object")

ObjectFile = Annotated[Path, typer.Argument(metavar="IN", help="An object.npz from a run, or a file derived from one.")]
ResultFolder = Annotated[Path | None, option("--result DIR")]


@dataclass(frozen=True, kw_only=True)
class ShowOptions(CommandOptions):
    """Options of `sylpose object show`."""

    file: ObjectFile


@command("Show the contents of an object file.", group=object_app)
def show(options: ShowOptions) -> None:
    """Show the contents of an object file: landmarks, keyframes, cameras, unit, size, frame and its uncertainty.

    Examples:
        sylpose object show object.npz
    """
    import numpy as np

    from sylpose.display import format_length
    from sylpose.io.object_files import load_object
    from sylpose.landmarks.landmark_filter import KNOWN_DEPTH_RATIO
    from sylpose.runs import console_output, object_frames

    known, console = load_object(options.file), console_output.make_console()
    console_output.print_facts(console, object_frames.describe_object(known))
    rows = []
    for name, memory in known._cameras.items():
        sd = memory.landmarks.depth_sd
        precise = sd[sd < KNOWN_DEPTH_RATIO * known.radius]
        views = sum(len(features) > 0 for features in memory.features)
        median_sd = format_length(float(np.median(precise)), known.unit) if len(precise) else "-"
        rows.append([name, str(len(sd)), str(len(precise)), median_sd, str(views)])
    console_output.print_table(console, ["camera", "landmarks", "precise", "their median sd", "in keyframes"], rows)


@dataclass(frozen=True, kw_only=True)
class FrameOptions(CommandOptions):
    """Options of `sylpose object frame`.

    Attributes:
        target: Write the object in its new frame to this .npz.
        origin: Set the origin.
        x: Set a point on the +X axis.
        xy: Set a point in the XY plane with positive y.
        plane: Set Z to the outward normal of the object's largest plane, or of the plane at POINT (repeatable). The
            origin is its center or --origin; X keeps its direction or points to --x.
        extent: Set the origin to the center, X along the longest extent, Z along the shortest.
        turn: Rotate the axes, in degrees about the present x, then y, then z.
        board: Use the frame of a board or marker on the object: apriltag:36h11,id=3,size=80mm.
        recording: With --board, detect it in this recording; default: that of --result.
        result: Look up pixel points in this run of the object; default: the folder of IN.
    """

    source: ObjectFile
    target: Annotated[Path, typer.Argument(metavar="OUT")]
    origin: Annotated[str | None, option("--origin POINT")] = None
    x: Annotated[str | None, option("--x POINT")] = None
    xy: Annotated[str | None, option("--xy POINT")] = None
    plane: Annotated[tuple[str, ...], option("--plane largest|POINT")] = ()
    extent: Annotated[bool, option("--extent")] = False
    turn: Annotated[str | None, option("--turn X,Y,Z")] = None
    board: Annotated[str | None, option("--board WHAT")] = None
    recording: Annotated[Path | None, option("--recording DIR")] = None
    result: ResultFolder = None

    def __post_init__(self) -> None:
        """Check that the options define one frame."""
        super().__post_init__()
        definitions = {name: getattr(self, name[2:]) for name in ("--xy", "--plane", "--extent", "--turn", "--board")}
        requested = [name for name, given in definitions.items() if given]
        points = {name for name, given in (("--origin", self.origin), ("--x", self.x)) if given}
        # Points that each definition accepts.
        both = {"--origin", "--x"}
        allowed = {"": {"--origin"}, "--turn": {"--origin"}, "--plane": both, "--xy": both}
        if not requested and "--origin" not in points:
            raise ValueError(
                "no frame is given: use --origin alone, --origin with --x and --xy, --plane, --extent, --board or "
                "--turn"
            )
        if conflicting := [*requested[1:], *sorted(points - allowed.get("".join(requested[:1]), set()))]:
            raise ValueError(f"{' and '.join([*requested[:1], *conflicting])}: these options cannot be combined")
        if (self.board is None) != (self.recording is None):
            raise ValueError(
                "--board and --recording require each other: a board on the object, and a recording that shows it"
            )
        if self.xy and len(points) < 2:
            raise ValueError("--xy requires three points: --origin, --x and --xy")


@command("Set the object frame in which poses are expressed.", group=object_app, notes=POINTS)
def frame(options: FrameOptions) -> None:
    """Set the origin and axes of an object, for `sylpose track OTHER --object OUT`.

    Reports the frame's uncertainty if it results from measurements, and writes a point cloud (.ply) next to OUT.

    Examples:
        sylpose object frame object.npz tool.npz --origin "@42 cam_0=812,400 cam_2=310,95" --x "@42 cam_0=850,390"
            --xy "@42 cam_0=812,300"
        sylpose object frame object.npz tool.npz --plane largest
        sylpose object frame object.npz tool.npz --extent
        sylpose object frame object.npz tool.npz --board apriltag:36h11,id=3,size=80mm --recording recording
        sylpose object frame object.npz tool.npz --origin 0,0,0.05 --turn 0,0,90
        sylpose track other --object tool.npz
    """
    import numpy as np

    from sylpose.input_limits import input_errors
    from sylpose.io.object_files import load_object
    from sylpose.runs import console_output, object_frames

    known, origin, x = load_object(options.source), options.origin, options.x
    points = object_frames.PointParser(known, options.source, options.result)
    if options.board is not None and options.recording is not None:
        new_frame = object_frames.estimate_board_frame(points.result, options.recording, options.board)
    elif options.plane:
        new_frame = object_frames.frame_from_plane(points, options.plane, origin, x)
    elif options.extent:
        new_frame = object_frames.frame_from_extent(known)
    elif options.xy and x and origin:
        new_frame = object_frames.frame_from_points(points, origin, x, options.xy)
    else:
        new_frame = object_frames.move_frame(points, origin, options.turn)
    with input_errors(options.target):
        framed = known.to_frame(*new_frame)
    files = _write_object(framed, options.target)
    console = console_output.make_console()
    facts = [fact for fact in object_frames.describe_object(framed) if fact[0] in ("Frame", "", "Extent")]
    console_output.print_facts(console, facts)
    if np.degrees(new_frame.sd[:3].max()) > MAX_AXIS_SD_DEG:
        warning = f"The axes are uncertain: {object_frames.format_frame_sd(new_frame.sd, known.unit)}"
        console_output.print_warnings(console, [warning])
    console_output.print_files(console, "Files", files)


def _write_object(known: KnownObject, target: Path) -> list[Path]:
    """Write an object file, and its point cloud next to it.

    Raises:
        ValueError: the suffix is not .npz.
        OSError: the file cannot be written; the message names it.
    """
    from sylpose.atomic_io import make_output_folder
    from sylpose.io.object_files import save_object, write_cloud

    if target.suffix != ".npz":
        raise ValueError(f"{target}: the suffix of an object file must be .npz")
    make_output_folder(target.parent)
    save_object(known, target)
    write_cloud(known, target.with_suffix(".ply"))
    return [target, target.with_suffix(".ply")]


@dataclass(frozen=True, kw_only=True)
class ScaleOptions(CommandOptions):
    """Options of `sylpose object scale`.

    Attributes:
        target: Write the scaled object here (only for objects of one camera); without it, compare.
        between: Set the two points.
        distance: Set the distance between them.
        unit: Set the unit of LENGTH and of the calibration used with OUT.
        result: Look up pixel points in this run of the object; default: the folder of IN.
    """

    source: ObjectFile
    target: Annotated[Path | None, typer.Argument(metavar="OUT")] = None
    between: Annotated[tuple[str, str], option("--between POINT POINT", show_default=False)] = ("", "")
    distance: Annotated[float, option("--distance LENGTH", show_default=False)] = 0.0
    unit: Annotated[str | None, option(f"--unit {'|'.join(METERS)}")] = None
    result: ResultFolder = None

    def __post_init__(self) -> None:
        """Check that both points and a length are given."""
        super().__post_init__()
        if self.unit is not None and self.unit not in METERS:
            raise ValueError(f"--unit must be one of {', '.join(METERS)}, got {self.unit!r}")
        if not all(self.between) or not self.distance:
            raise ValueError("two points and their distance are required: --between POINT POINT --distance LENGTH")
        if not 0 < self.distance < float("inf"):
            raise ValueError(f"--distance: expected a positive length, got {self.distance}")


@command("Set or check the object's size by a known distance.", group=object_app, notes=POINTS)
def scale(options: ScaleOptions) -> None:
    """Compare a distance on the object with a known length, and scale an object of a single camera to it.

    A single camera cannot observe scale: its poses are in units of the first distance. With a known length they are in
    the unit of LENGTH and the object's distance is observable. Lengths from several calibrated cameras are only
    compared.

    Examples:
        sylpose object scale object.npz --between "near 0.1,0,0" "near -0.1,0,0" --distance 0.203
        sylpose object scale object.npz tool.npz --between "@42 cam_0=812,400" "@42 cam_0=610,380" --distance 35
            --unit mm
    """
    from sylpose.display import format_length
    from sylpose.io.object_files import load_object
    from sylpose.runs import console_output
    from sylpose.runs.object_frames import PointParser, measure_distance

    known, distance, unit = load_object(options.source), options.distance, options.unit
    points = PointParser(known, options.source, options.result)
    measured, sd = measure_distance(*(points("--between", text) for text in options.between))
    has_free_scale = known.unit == INITIAL_DISTANCES
    if not has_free_scale and unit not in (None, known.unit):
        raise ValueError(f"--unit {unit}: the object's lengths are in {known.unit or 'an unknown unit'}")
    if has_free_scale:
        lengths = f"{format_length(measured, INITIAL_DISTANCES)}, given as {format_length(distance, unit or '')}"
        fact = ("Scale", f"{distance / measured:.6g}, to {100 * sd:.2g} % (one sd)")
    else:
        lengths = f"{format_length(measured, known.unit)} measured, {format_length(distance, known.unit)} given"
        fact = ("Error", f"{100 * (measured / distance - 1.0):+.2f} %, measured to {100 * sd:.2g} % (one sd)")
    console = console_output.make_console()
    console_output.print_facts(console, [("Distance", lengths), fact])
    if options.target is None:
        return
    if not has_free_scale:
        raise ValueError(
            f"{options.source}: its lengths were measured by calibrated cameras, and scaling would contradict them in "
            "every recording. Correct the calibration instead: calibrate again or scale its unit"
        )
    scaled = known.scaled(distance / measured, unit or "", min(sd, 1.0))
    console_output.print_files(console, "Files", _write_object(scaled, options.target))


@dataclass(frozen=True, kw_only=True)
class ApplyOptions(CommandOptions):
    """Options of `sylpose object apply`.

    Attributes:
        result: Folder of a run of this object.
        out: New folder for the trajectory and its report.
    """

    file: ObjectFile
    result: Annotated[Path, typer.Argument(metavar="RESULT")]
    out: Annotated[Path, typer.Argument(metavar="OUT")]
    plot_format: PlotFormat = "png"


@command("Re-express a result in an object's frame.", group=object_app)
def apply(options: ApplyOptions) -> None:
    """Re-express the trajectory of a finished run in the frame of an object file, without tracking again.

    The standard deviations of positions are upper bounds: trajectory files contain no correlations.

    Examples:
        sylpose object apply tool.npz recording results_of_tool
    """
    from dataclasses import replace

    from sylpose.atomic_io import make_output_folder
    from sylpose.io import calibration
    from sylpose.io.object_files import CLOUD_FILE, OBJECT_FILE, load_object, save_object
    from sylpose.report.files import write_trajectory
    from sylpose.report.plots import save_trajectory_plot
    from sylpose.results import Trajectory
    from sylpose.runs import console_output
    from sylpose.runs.object_frames import change_object_frame, read_object_run
    from sylpose.runs.run_metadata import SETTINGS, USED_CALIBRATION, find_result

    file, result, out = options.file, find_result(options.result), options.out
    known = load_object(file)
    run = read_object_run(result, known)
    if out.resolve() == file.resolve().parent or (out / SETTINGS).exists():
        raise ValueError(f"{out}: contains the results of a run, or the object; choose another folder")
    poses = [change_object_frame(pose, run.frame_from_run) for pose in run.trajectory]
    trajectory = Trajectory(poses, run.trajectory.camera_names, run.trajectory.unit)
    # Files left by another run would be taken for those of this one.
    for name in (OBJECT_FILE, CLOUD_FILE):
        (make_output_folder(out) / name).unlink(missing_ok=True)
    files = [*write_trajectory(out, trajectory), out / f"report.{options.plot_format}"]
    calibration.save(run.rig, out / USED_CALIBRATION)
    save_trajectory_plot(trajectory, files[-1], note=f"{result.resolve().name}, in the frame of {file.name}")
    save_object(replace(load_object(result / OBJECT_FILE), frame=known.frame), out / OBJECT_FILE)
    files += [out / USED_CALIBRATION, out / OBJECT_FILE]
    console_output.print_files(console_output.make_console(), "Files", files)
