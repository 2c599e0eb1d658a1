"""`sylpose export` and `sylpose compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.cli.common import PlotFormat, Stop, app, examples, one_of, spoken
from sylpose.exports.formats import FORMATS

__all__ = ["compare", "export"]

# As `comparison` has them, known without loading NumPy.
ALIGNMENTS = ("first", "none", "se3", "sim3", "both")

Result = Annotated[
    Path, typer.Argument(metavar="RESULT", help="Folder that sylpose track wrote, or its trajectory.csv.")
]


@app.command(
    short_help="A trajectory in another program's format.",
    epilog=examples(
        "sylpose export recording/sylpose --out object.c3d",
        "sylpose export recording/sylpose --to rosbag --out bag",
        "sylpose export recording/sylpose --out object.bvh --start 10 --stop 200",
    ),
)
@spoken
def export(
    result: Result,
    out: Annotated[Path, typer.Option(metavar="FILE", help="The file; of a bag the folder.")],
    to: Annotated[
        str | None, typer.Option(metavar="|".join(FORMATS), help="The format; by default what FILE's name tells.")
    ] = None,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="What the object is called in it; its own name by default.")
    ] = None,
    start: Annotated[int | None, typer.Option(metavar="N", help="The first frame; that of RESULT by default.")] = None,
    stop: Stop = None,
) -> None:
    """Write a finished trajectory in another program's format.

    For biomechanics c3d and trc, for animation bvh, gltf and usd, for ROS 2 rosbag, as tables csv and parquet. Poses are
    world_from_object. Frames without a measured pose are gaps: points that are missing, an object that is not to be seen,
    messages that are not there. c3d, rosbag, parquet and usd need extras: pip install 'sylpose[export,usd]'.
    """
    from sylpose.app.export import export_aloud

    export_aloud(result, out, to, name, start, stop)


@app.command(
    short_help="How far two trajectories are apart.",
    epilog=examples(
        "sylpose compare recording/sylpose truth.tum",
        "sylpose compare first/sylpose second/sylpose --align none --out compared",
    ),
)
@spoken
def compare(
    a: Annotated[
        Path, typer.Argument(metavar="A", help="Folder that sylpose track wrote, a trajectory.csv or a .tum.")
    ],
    b: Annotated[Path, typer.Argument(metavar="B", help="The same, which A is compared with.")],
    align: Annotated[
        str,
        typer.Option(
            metavar="|".join(ALIGNMENTS),
            help="What may differ: first: the object's frame (motion since the first common pose); none: nothing; se3, "
            "sim3: the world, which is turned and moved, and scaled, so that positions fit best; both: the world and the "
            "object's frame.",
            callback=one_of(ALIGNMENTS),
        ),
    ] = "first",
    step: Annotated[int, typer.Option(metavar="N", help="Relative errors are between poses so many apart.")] = 1,
    within: Annotated[
        float | None,
        typer.Option(
            metavar="SEC", help="How far apart in time poses are that belong together; half of B's least step."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where compare.json and compare.png go.")] = Path(),
    plot_format: PlotFormat = "png",
) -> None:
    """Absolute and relative errors of A, told in B's frames: as a table, as compare.png and as numbers in compare.json."""
    from sylpose.app.compare import compare_aloud

    compare_aloud(a, b, align, step, within, out, plot_format)
