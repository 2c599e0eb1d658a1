"""`sylpose export`: export a finished trajectory to another program's format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sylpose.commands.app import INPUT, OUTPUT, CommandOptions, command, option
from sylpose.commands.options import EulerAxes, ResultPath, StopFrame
from sylpose.io.exports.formats import EXPORT_FORMATS


@dataclass(frozen=True, kw_only=True)
class ExportOptions(CommandOptions):
    """Options of `sylpose export`.

    Attributes:
        out: Write this file; for rosbag, this folder.
        to: Set the format; default: from FILE's name.
        name: Set the object's name in FILE; default: its own.
        start: Start at this frame; default: RESULT's first.
        angles: Set the axes of the angles (mot and sto); default: XYZ, the free joint's.
        velocity: Add velocities and accelerations with their standard deviations (csv and parquet).
    """

    result: ResultPath
    out: Annotated[Path, option("--out FILE", OUTPUT)]
    to: Annotated[str | None, option(f"--to {'|'.join(EXPORT_FORMATS)}", OUTPUT)] = None
    name: Annotated[str | None, option("--name NAME", OUTPUT)] = None
    start: Annotated[int | None, option("--start N", INPUT)] = None
    stop: StopFrame = None
    angles: EulerAxes = None
    velocity: Annotated[bool, option("--velocity", OUTPUT)] = False


@command("Export a trajectory to another program's format.")
def export(options: ExportOptions) -> None:
    """Export a finished trajectory to another program's format.

    Biomechanics: c3d, trc, mot and sto; animation: bvh, gltf and usd; ROS 2: rosbag; tables: csv and parquet. Poses are
    world_from_object. Frames without a measured pose are gaps: missing points, an invisible object, or no message. c3d,
    rosbag, parquet and usd require extras: pip install 'sylpose[export,usd]'.

    Examples:
        sylpose export recording --out object.c3d
        sylpose export recording --out velocity.csv --velocity
        sylpose export relative.csv --out knee.mot --euler ZXY
        sylpose export recording --to rosbag --out bag
        sylpose export recording --out object.bvh --start 10 --stop 200
    """
    from sylpose.io.exports.formats import export_trajectory, select_frames
    from sylpose.runs import console_output
    from sylpose.runs.page import read_surroundings
    from sylpose.runs.run_metadata import find_result, find_run_folder, read_world_definition
    from sylpose.runs.view import load_trajectory

    result, out = find_result(options.result), options.out
    folder = result if result.is_dir() else result.parent
    name = options.name or (folder.name if find_run_folder(folder) != folder else "object")
    trajectory, z_up = load_trajectory(result), read_world_definition(result) is not None
    selected = select_frames(trajectory, options.start, options.stop)
    suffixes = EXPORT_FORMATS["gltf"].suffixes + EXPORT_FORMATS["usd"].suffixes
    surroundings = read_surroundings(result) if out.suffix.lower() in suffixes else None
    notes = export_trajectory(
        trajectory,
        out,
        options.to,
        name=name,
        start=options.start,
        stop=options.stop,
        z_up=z_up,
        velocity=options.velocity,
        angles=options.angles,
        surroundings=surroundings,
    )
    console = console_output.make_console()
    console.print(f"{sum(frame.is_measured for frame in selected)} of {len(selected)} frames have a measured pose.")
    for note in notes:
        console.print(f"{note[0].upper()}{note[1:]}.", highlight=False)
    console_output.print_files(console, "File" if out.is_file() else "Folder", [out])
