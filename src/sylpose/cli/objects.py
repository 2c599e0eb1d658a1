"""`sylpose object`: show, frame, scale, apply."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.cli.common import PlotFormat, app, examples, spoken
from sylpose.units import METRES

__all__ = ["apply", "frame", "scale", "show"]

object_app = typer.Typer(
    help="What a run has learnt of the object (object.npz): show it, set its frame or its size, tell results in it.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
app.add_typer(object_app, name="object")

ObjectFile = Annotated[Path, typer.Argument(metavar="IN", help="An object.npz that a run has written, or made of one.")]
ResultFolder = Annotated[
    Path | None,
    typer.Option(
        "--result", metavar="DIR", help="Of a run that has seen the object, for points that are pixels; where IN is."
    ),
]
POINTS = (
    '\b\nA POINT is "X,Y,Z" (in the present frame), "near X,Y,Z" (the nearest landmark), or pixels in a frame of a run,\n'
    '"@42 cam_0=812,400 cam_2=310,95"; one camera is enough where it has seen the surface.\n'
)


@object_app.command(short_help="What is in an object's file.", epilog=examples("sylpose object show object.npz"))
@spoken
def show(file: ObjectFile) -> None:
    """What is in an object's file: landmarks, keyframes, cameras, unit, size, frame and how well it is known."""
    from sylpose.app.objects import show_aloud

    show_aloud(file)


@object_app.command(
    short_help="Set the frame that poses are told in.",
    epilog=POINTS
    + "\n"
    + examples(
        'sylpose object frame object.npz tool.npz --origin "@42 cam_0=812,400 cam_2=310,95" --x "@42 cam_0=850,390" '
        '--xy "@42 cam_0=812,300"',
        "sylpose object frame object.npz tool.npz --plane largest",
        "sylpose object frame object.npz tool.npz --extent",
        "sylpose object frame object.npz tool.npz --board apriltag:36h11,id=3,size=80mm --recording recording",
        "sylpose object frame object.npz tool.npz --origin 0,0,0.05 --turn 0,0,90",
        "sylpose track other --object tool.npz",
    ),
)
@spoken
def frame(
    source: ObjectFile,
    target: Annotated[Path, typer.Argument(metavar="OUT", help="The same object in its new frame, an .npz.")],
    origin: Annotated[str | None, typer.Option(metavar="POINT", help="Where the origin is.")] = None,
    x: Annotated[str | None, typer.Option("--x", metavar="POINT", help="On the +X axis.")] = None,
    xy: Annotated[
        str | None, typer.Option("--xy", metavar="POINT", help="In the XY plane, where y is positive.")
    ] = None,
    plane: Annotated[
        list[str] | None,
        typer.Option(
            metavar="largest|POINT",
            help="Z is the normal, outwards, of the largest plane of its surface or of that at POINT (several times); the "
            "origin is in it: its middle, or --origin; X as it was, or to --x.",
        ),
    ] = None,
    extent: Annotated[
        bool,
        typer.Option("--extent", help="Origin in the middle, X along its longest direction, Z along its shortest."),
    ] = False,
    turn: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Turn the axes, degrees about the present x, then y, then z.")
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(metavar="WHAT", help="A board or marker that is on it, such as apriltag:36h11,id=3,size=80mm."),
    ] = None,
    recording: Annotated[
        Path | None, typer.Option(metavar="DIR", help="With --board: where it is seen; what --result is of.")
    ] = None,
    result: ResultFolder = None,
) -> None:
    """Set the origin and the axes of an object: `sylpose track OTHER --object OUT` then tells poses of them.

    Says how certain they are where they are told by what was measured, and writes a cloud (.ply) beside OUT to look at.
    """
    from sylpose.app.objects import frame_aloud

    frame_aloud(
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
    short_help="Set or check its size by a known distance.",
    epilog=POINTS
    + "\n"
    + examples(
        'sylpose object scale object.npz --between "near 0.1,0,0" "near -0.1,0,0" --distance 0.203',
        'sylpose object scale object.npz tool.npz --between "@42 cam_0=812,400" "@42 cam_0=610,380" --distance 35 --unit mm',
    ),
)
@spoken
def scale(
    source: ObjectFile,
    target: Annotated[
        Path | None,
        typer.Argument(
            metavar="OUT", help="The object in that size, of one that one camera has learnt; else only compared."
        ),
    ] = None,
    between: Annotated[
        tuple[str, str], typer.Option(metavar="POINT POINT", help="Two points of it.", show_default=False)
    ] = ("", ""),
    distance: Annotated[
        float, typer.Option(metavar="LENGTH", help="How far apart they are.", show_default=False)
    ] = 0.0,
    unit: Annotated[
        str | None, typer.Option(metavar="|".join(METRES), help="Of LENGTH, and of the calibration it is used with.")
    ] = None,
    result: ResultFolder = None,
) -> None:
    """How far the distance of two points of the object is off; sets the size of one that a single camera has learnt.

    One camera sees no sizes: poses are then in units of the first distance. With a size they are in that of LENGTH, and the
    object's distance is seen. Lengths that several calibrated cameras have measured are compared, not changed.
    """
    from sylpose.app.objects import scale_aloud

    if unit is not None and unit not in METRES:
        raise ValueError(f"--unit must be one of {', '.join(METRES)}, got {unit!r}")
    if not all(between) or not distance:
        raise ValueError("two points and how far apart they are: --between POINT POINT --distance LENGTH")
    scale_aloud(source, target, between, distance, unit, result)


@object_app.command(
    short_help="Tell a finished result in an object's frame.",
    epilog=examples("sylpose object apply tool.npz recording/sylpose results_of_tool"),
)
@spoken
def apply(
    file: ObjectFile,
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Folder of a run that has seen it.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Another folder, for the trajectory and its report.")],
    plot_format: PlotFormat = "png",
) -> None:
    """Tell the trajectory of a finished run in the frame of an object's file, without tracking again.

    Standard deviations of positions are then at most what they would be: correlations are not in a trajectory's file.
    """
    from sylpose.app.objects import apply_aloud

    apply_aloud(file, result, out, plot_format)
