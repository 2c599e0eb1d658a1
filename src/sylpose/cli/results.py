"""`sylpose export` and `sylpose compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import INPUT, OUTPUT, GroupedCommand, app, format_examples, make_choice_check, report_errors
from sylpose.commands.options import PlotFormat, StopFrame
from sylpose.io.exports.formats import EXPORT_FORMATS

__all__ = ["compare", "export"]

# Same as in `comparison`, repeated here to avoid importing NumPy.
ALIGNMENTS = ("first", "none", "se3", "sim3", "both")

Result = Annotated[
    Path, typer.Argument(metavar="RESULT", help="Folder that sylpose track wrote, or its trajectory.csv.")
]


@app.command(
    cls=GroupedCommand,
    short_help="Export a trajectory to another program's format.",
    epilog=format_examples(
        "sylpose export recording/sylpose --out object.c3d",
        "sylpose export recording/sylpose --to rosbag --out bag",
        "sylpose export recording/sylpose --out object.bvh --start 10 --stop 200",
    ),
)
@report_errors
def export(
    result: Result,
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="Write this file; for rosbag, this folder.", rich_help_panel=OUTPUT),
    ],
    to: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(EXPORT_FORMATS), help="Set the format; default: from FILE's name.", rich_help_panel=OUTPUT
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Set the object's name in FILE; default: its own.", rich_help_panel=OUTPUT),
    ] = None,
    start: Annotated[
        int | None,
        typer.Option(metavar="N", help="Start at this frame; default: RESULT's first.", rich_help_panel=INPUT),
    ] = None,
    stop: StopFrame = None,
) -> None:
    """Export a finished trajectory to another program's format.

    Biomechanics: c3d and trc; animation: bvh, gltf and usd; ROS 2: rosbag; tables: csv and parquet. Poses are
    world_from_object. Frames without a measured pose are gaps: missing points, an invisible object, or no message. c3d,
    rosbag, parquet and usd require extras: pip install 'sylpose[export,usd]'.
    """
    from sylpose.commands.export import run_export_command

    run_export_command(result, out, to, name, start, stop)


@app.command(
    cls=GroupedCommand,
    short_help="Compute the errors between two trajectories.",
    epilog=format_examples(
        "sylpose compare recording/sylpose truth.tum",
        "sylpose compare first/sylpose second/sylpose --align none --out compared",
    ),
)
@report_errors
def compare(
    a: Annotated[
        Path, typer.Argument(metavar="A", help="Trajectory: a folder of sylpose track, a trajectory.csv or a .tum.")
    ],
    b: Annotated[Path, typer.Argument(metavar="B", help="Reference trajectory, in the same formats.")],
    align: Annotated[
        str,
        typer.Option(
            metavar="|".join(ALIGNMENTS),
            help="Align A to B before comparing. first: the object's frame (motion since the first common pose); none; se3, "
            "sim3: the world frame, rigidly or with scale, fitted to positions; both: the world and the object's "
            "frame.",
            callback=make_choice_check(ALIGNMENTS),
        ),
    ] = "first",
    step: Annotated[int, typer.Option(metavar="N", help="Compute relative errors over N poses.")] = 1,
    within: Annotated[
        float | None,
        typer.Option(
            metavar="SEC", help="Match poses within this time difference; default: half of B's smallest step."
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Write compare.json and compare.png here.", rich_help_panel=OUTPUT)
    ] = Path(),
    plot_format: PlotFormat = "png",
) -> None:
    """Compute absolute and relative pose errors of A with respect to B.

    Prints a table and writes compare.png and compare.json. Errors are expressed in B's frames.
    """
    from sylpose.commands.compare import run_compare_command

    run_compare_command(a, b, align, step, within, out, plot_format)
