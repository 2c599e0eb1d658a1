"""`sylpose calibration convert`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from sylpose.cli.common import World, WorldFrame, WorldFrom, app, examples, say, spoken
from sylpose.units import METRES

__all__ = ["convert"]

# As `calibration.written` has them, known without loading that.
WRITTEN = ("sylpose", "opencv", "opencv-stereo", "anipose", "kalibr", "colmap")


calibration_app = typer.Typer(help="Calibration files: convert.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(calibration_app, name="calibration")


@calibration_app.command(
    epilog=examples(
        "sylpose calibration convert camera_array.toml calibration.yml",
        "sylpose calibration convert rig.toml floor.toml --world chessboard:9x6,square=25mm --world-from floor_images",
        "sylpose calibration convert camchain.yaml calibration.toml --to anipose",
        "sylpose calibration convert rig.toml stereo.yml --to opencv-stereo --only cam_0 --only cam_2",
        "sylpose calibration convert colmap/sparse/0 calibration.toml",
    )
)
@spoken
def convert(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="Calibration in any format that sylpose reads: a file, or a folder.")
    ],
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="A .toml (sylpose's), .yml, .json or .xml (OpenCV's), camchain.yaml (Kalibr's), a folder (COLMAP's).",
        ),
    ],
    to: Annotated[
        str | None,
        typer.Option(metavar="|".join(WRITTEN), help="The format of OUT; by default what its name tells."),
    ] = None,
    unit: Annotated[
        str | None, typer.Option(metavar="|".join(METRES), help="Of all lengths in OUT; that of IN by default.")
    ] = None,
    is_in: Annotated[
        str | None, typer.Option(metavar="|".join(METRES), help="The unit of IN, which does not say it itself.")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CAM", help="The cameras in OUT, in this order; may be given several times. All by default."
        ),
    ] = None,
    world: World = None,
    world_frame: WorldFrame = None,
    world_from: WorldFrom = None,
    size: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[CAM=]WIDTHxHEIGHT",
            help="How large images are, where IN does not say it: of all cameras, or of one; may be given several times.",
        ),
    ] = None,
) -> None:
    """Write a calibration in another format, another unit or another world.

    Read are sylpose, Anipose, Caliscope, OpenCV (FileStorage, stereo), Kalibr, COLMAP, ROS, JARVIS, Qualisys, Vicon,
    OptiTrack, EasyMocap, MultiCamSelfCal, Matlab, Metashape, NeRF and DeepLabCut.
    """
    from sylpose import calibration
    from sylpose.app.world import asked_world, world_asked
    from sylpose.calibration.world import told_in
    from sylpose.rig import Rig

    rig = calibration.load(source, _sizes(size or []))
    if is_in is not None:
        if rig.unit not in ("", is_in):
            raise ValueError(f"--is-in {is_in}: {source} says itself that it is in {rig.unit}")
        if is_in not in METRES:
            raise ValueError(f"--is-in must be one of {', '.join(METRES)}, got {is_in!r}")
        rig = Rig(rig.cameras, is_in)
    notes: list[str] = []
    if (asked := asked_world(world, world_frame, world_from)) is not None:
        found, notes = world_asked(rig, asked)
        rig = told_in(rig, found)
    rig = rig if unit is None else rig.in_unit(unit)
    if only:
        if unknown := [name for name in only if name not in rig.names]:
            raise ValueError(f"--only: {unknown[0]!r} is no camera of {source} ({', '.join(rig.names)})")
        if len(set(only)) < len(only):
            raise ValueError(f"--only: a camera is given twice ({', '.join(only)})")
        rig = rig.subset(only)
    lost = calibration.save(rig, target, to)
    said = "; ".join([f"{len(rig)} cameras ({', '.join(rig.names)})", *lost])
    print(f"{target}, {calibration.format_of(target)}: {said}")
    for note in notes:
        say(note)


def _sizes(given: Sequence[str]) -> Callable[[Sequence[str]], dict[str, tuple[int, int]]]:
    """What tells the sizes of the cameras' images, from the words of `--size`."""
    of_all: tuple[int, int] | None = None
    own: dict[str, tuple[int, int]] = {}
    for text in given:
        name, _, words = text.rpartition("=")
        match = re.fullmatch(r"([0-9]{1,6})x([0-9]{1,6})", words)
        if match is None:
            raise ValueError(f"--size: WIDTHxHEIGHT or CAM=WIDTHxHEIGHT is expected, such as 1280x720, got {text!r}")
        if name:
            own[name] = int(match[1]), int(match[2])
        else:
            of_all = int(match[1]), int(match[2])
    return lambda names: {name: size for name in names if (size := own.get(name, of_all)) is not None}
