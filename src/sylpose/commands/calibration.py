"""`sylpose calibration convert`: convert a calibration to another format, length unit or world frame."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import INPUT, OUTPUT, app, command, option
from sylpose.commands.options import WorldOptions
from sylpose.input_limits import print_message
from sylpose.units import METERS

# Same as in `calibration.formats`, repeated here to avoid importing it.
OUTPUT_FORMATS = ("sylpose", "opencv", "opencv-stereo", "anipose", "kalibr", "colmap")

calibration_app = typer.Typer(help="Convert calibration files.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(calibration_app, name="calibration")


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(WorldOptions):
    """Options of `sylpose calibration convert`.

    Attributes:
        source: Calibration file or folder in any format that sylpose reads.
        target: Output: .toml (sylpose), .yml, .json or .xml (OpenCV), camchain.yaml (Kalibr), or a folder (COLMAP).
        to: Set the format of OUT; default: from its name.
        unit: Set the length unit of OUT; default: that of IN.
        world_frame: Detect the world board in this frame of --world-from; default: the first frame.
        world_from: Detect the world board in these images or videos.
        is_in: Set the length unit of IN if the file has none.
        only: Write only this camera; repeat for more, in this order. Default: all.
        size: Set the image size of all cameras or of one if IN does not contain it. Repeatable.
    """

    source: Annotated[Path, typer.Argument(metavar="IN")]
    target: Annotated[Path, typer.Argument(metavar="OUT")]
    to: Annotated[str | None, option(f"--to {'|'.join(OUTPUT_FORMATS)}", OUTPUT)] = None
    unit: Annotated[str | None, option(f"--unit {'|'.join(METERS)}", OUTPUT)] = None
    is_in: Annotated[str | None, option(f"--is-in {'|'.join(METERS)}", INPUT)] = None
    only: Annotated[tuple[str, ...], option("--only CAM", OUTPUT)] = ()
    size: Annotated[tuple[str, ...], option("--size [CAM=]WIDTHxHEIGHT", INPUT)] = ()


@command("Convert a calibration to another format or unit.", group=calibration_app)
def convert(options: ConvertOptions) -> None:
    """Convert a calibration to another format, length unit or world frame.

    Reads the formats of sylpose, Anipose, Caliscope, OpenCV (FileStorage, stereo), Kalibr, COLMAP, ROS, JARVIS,
    Qualisys, Vicon, OptiTrack, EasyMocap, MultiCamSelfCal, Matlab, Metashape, NeRF, DeepLabCut, DANNCE, Label3D, OpenCap,
    MC-Calib, CMU Panoptic, mrcal, BOP, 3D Gaussian splatting, XMALab, DLTdv, Argus, OpenPTV, KWIVER and VIAME.

    Examples:
        sylpose calibration convert camera_array.toml calibration.yml
        sylpose calibration convert rig.toml floor.toml --world chessboard:9x6,square=25mm --world-from floor_images
        sylpose calibration convert camchain.yaml calibration.toml --to anipose
        sylpose calibration convert rig.toml stereo.yml --to opencv-stereo --only cam_0 --only cam_2
        sylpose calibration convert colmap/sparse/0 calibration.toml
    """
    from sylpose.io import calibration
    from sylpose.io.calibration.unit_consistency import describe_unit_outlier
    from sylpose.io.calibration.world import transform_rig
    from sylpose.rig import Rig
    from sylpose.runs.world import resolve_world

    source, target, is_in, only = options.source, options.target, options.is_in, options.only
    rig = calibration.load(source, _parse_image_sizes(options.size))
    if is_in is not None:
        if rig.unit not in ("", is_in):
            raise ValueError(f"--is-in {is_in}: {source} states that its unit is {rig.unit}")
        if is_in not in METERS:
            raise ValueError(f"--is-in must be one of {', '.join(METERS)}, got {is_in!r}")
        rig = Rig(rig.cameras, is_in)
    notes = [note] if (note := describe_unit_outlier(rig)) else []
    if (world_spec := options.world_spec) is not None:
        found, world_notes = resolve_world(rig, world_spec)
        notes += world_notes
        rig = transform_rig(rig, found)
    rig = rig if options.unit is None else rig.in_unit(options.unit)
    if only:
        if unknown := [name for name in only if name not in rig.names]:
            raise ValueError(f"--only: {unknown[0]!r} is no camera of {source} ({', '.join(rig.names)})")
        if len(set(only)) < len(only):
            raise ValueError(f"--only: a camera is given twice ({', '.join(only)})")
        rig = rig.subset(only)
    lost = calibration.save(rig, target, options.to)
    read_as = f"read from {source}, {calibration.format_name(source)}"
    errors_px = [camera.error_px for camera in rig if camera.error_px is not None]
    error = [f"reprojection error up to {max(errors_px):.2g} px"] if errors_px else []
    summary = "; ".join([f"{len(rig)} cameras ({', '.join(rig.names)})", *error, *lost, read_as])
    print(f"{target}, {calibration.format_name(target)}: {summary}")
    for note in notes:
        print_message(note)


def _parse_image_sizes(values: Sequence[str]) -> Callable[[Sequence[str]], dict[str, tuple[int, int]]]:
    """Parse the values of `--size`; return a function from camera names to image sizes."""
    default_size: tuple[int, int] | None = None
    size_by_camera: dict[str, tuple[int, int]] = {}
    for text in values:
        name, _, size_text = text.rpartition("=")
        match = re.fullmatch(r"([0-9]{1,6})x([0-9]{1,6})", size_text)
        if match is None:
            raise ValueError(f"--size: expected WIDTHxHEIGHT or CAM=WIDTHxHEIGHT, such as 1280x720, got {text!r}")
        if name:
            size_by_camera[name] = int(match[1]), int(match[2])
        else:
            default_size = int(match[1]), int(match[2])
    return lambda names: {name: size for name in names if (size := size_by_camera.get(name, default_size)) is not None}
