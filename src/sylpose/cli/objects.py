"""`sylpose object`: show, frame, scale, apply."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import GroupedCommand, app, format_examples, report_errors
from sylpose.commands.options import PlotFormat
from sylpose.units import METERS

__all__ = ["apply", "frame", "scale", "show"]

object_app = typer.Typer(
    help="Show or edit the object model of a run (object.npz).",
    no_args_is_help=True,
    rich_markup_mode=None,
)
app.add_typer(object_app, name="object")

ObjectFile = Annotated[Path, typer.Argument(metavar="IN", help="An object.npz from a run, or a file derived from one.")]
ResultFolder = Annotated[
    Path | None,
    typer.Option(
        "--result", metavar="DIR", help="Look up pixel points in this run of the object; default: the folder of IN."
    ),
]
POINTS = (
    '\b\nA POINT is "X,Y,Z" (in the present frame), "near X,Y,Z" (the nearest landmark), or pixels in a frame of a '
    'run,\n"@42 cam_0=812,400 cam_2=310,95"; one camera suffices where landmarks cover the surface.\n'
)


@object_app.command(
    short_help="Show the contents of an object file.", epilog=format_examples("sylpose object show object.npz")
)
@report_errors
def show(file: ObjectFile) -> None:
    """Show the contents of an object file: landmarks, keyframes, cameras, unit, size, frame and its uncertainty."""
    from sylpose.commands.objects import run_object_show_command

    run_object_show_command(file)


@object_app.command(
    short_help="Set the object frame in which poses are expressed.",
    epilog=POINTS
    + "\n"
    + format_examples(
        'sylpose object frame object.npz tool.npz --origin "@42 cam_0=812,400 cam_2=310,95" --x "@42 cam_0=850,390" '
        '--xy "@42 cam_0=812,300"',
        "sylpose object frame object.npz tool.npz --plane largest",
        "sylpose object frame object.npz tool.npz --extent",
        "sylpose object frame object.npz tool.npz --board apriltag:36h11,id=3,size=80mm --recording recording",
        "sylpose object frame object.npz tool.npz --origin 0,0,0.05 --turn 0,0,90",
        "sylpose track other --object tool.npz",
    ),
)
@report_errors
def frame(
    source: ObjectFile,
    target: Annotated[Path, typer.Argument(metavar="OUT", help="Write the object in its new frame to this .npz.")],
    origin: Annotated[str | None, typer.Option(metavar="POINT", help="Set the origin.")] = None,
    x: Annotated[str | None, typer.Option("--x", metavar="POINT", help="Set a point on the +X axis.")] = None,
    xy: Annotated[
        str | None, typer.Option("--xy", metavar="POINT", help="Set a point in the XY plane with positive y.")
    ] = None,
    plane: Annotated[
        list[str] | None,
        typer.Option(
            metavar="largest|POINT",
            help="Set Z to the outward normal of the object's largest plane, or of the plane at POINT (repeatable). The "
            "origin is its center or --origin; X keeps its direction or points to --x.",
        ),
    ] = None,
    extent: Annotated[
        bool,
        typer.Option(
            "--extent", help="Set the origin to the center, X along the longest extent, Z along the shortest."
        ),
    ] = False,
    turn: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Rotate the axes, in degrees about the present x, then y, then z."),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="WHAT", help="Use the frame of a board or marker on the object: apriltag:36h11,id=3,size=80mm."
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="With --board, detect it in this recording; default: that of --result."),
    ] = None,
    result: ResultFolder = None,
) -> None:
    """Set the origin and axes of an object, for `sylpose track OTHER --object OUT`.

    Reports the frame's uncertainty if it results from measurements, and writes a point cloud (.ply) next to OUT.
    """
    from sylpose.commands.objects import run_object_frame_command

    run_object_frame_command(
        source,
        target,
        origin=origin,
        x=x,
        xy=xy,
        plane=plane or (),
        extent=extent,
        turn=turn,
        board=board,
        recording=recording,
        result=result,
    )


@object_app.command(
    short_help="Set or check the object's size by a known distance.",
    epilog=POINTS
    + "\n"
    + format_examples(
        'sylpose object scale object.npz --between "near 0.1,0,0" "near -0.1,0,0" --distance 0.203',
        'sylpose object scale object.npz tool.npz --between "@42 cam_0=812,400" "@42 cam_0=610,380" --distance 35 --unit mm',
    ),
)
@report_errors
def scale(
    source: ObjectFile,
    target: Annotated[
        Path | None,
        typer.Argument(
            metavar="OUT", help="Write the scaled object here (only for objects of one camera); without it, compare."
        ),
    ] = None,
    between: Annotated[
        tuple[str, str], typer.Option(metavar="POINT POINT", help="Set the two points.", show_default=False)
    ] = ("", ""),
    distance: Annotated[
        float, typer.Option(metavar="LENGTH", help="Set the distance between them.", show_default=False)
    ] = 0.0,
    unit: Annotated[
        str | None,
        typer.Option(metavar="|".join(METERS), help="Set the unit of LENGTH and of the calibration used with OUT."),
    ] = None,
    result: ResultFolder = None,
) -> None:
    """Compare a distance on the object with a known length, and scale an object of a single camera to it.

    A single camera cannot observe scale: its poses are in units of the first distance. With a known length they are in
    the unit of LENGTH and the object's distance is observable. Lengths from several calibrated cameras are only
    compared.
    """
    from sylpose.commands.objects import run_object_scale_command

    if unit is not None and unit not in METERS:
        raise ValueError(f"--unit must be one of {', '.join(METERS)}, got {unit!r}")
    if not all(between) or not distance:
        raise ValueError("two points and their distance are required: --between POINT POINT --distance LENGTH")
    run_object_scale_command(source, target, between, distance, unit, result)


@object_app.command(
    cls=GroupedCommand,
    short_help="Re-express a result in an object's frame.",
    epilog=format_examples("sylpose object apply tool.npz recording/sylpose results_of_tool"),
)
@report_errors
def apply(
    file: ObjectFile,
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Folder of a run of this object.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New folder for the trajectory and its report.")],
    plot_format: PlotFormat = "png",
) -> None:
    """Re-express the trajectory of a finished run in the frame of an object file, without tracking again.

    The standard deviations of positions are upper bounds: trajectory files contain no correlations.
    """
    from sylpose.commands.objects import run_object_apply_command

    run_object_apply_command(file, result, out, plot_format)
