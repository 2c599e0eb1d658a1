"""`sylpose export`: export a finished trajectory to another program's format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sylpose.commands.app import INPUT, OUTPUT, CommandOptions, command, option
from sylpose.commands.options import ResultPath, StopFrame
from sylpose.io.exports.formats import EXPORT_FORMATS


@dataclass(frozen=True, kw_only=True)
class ExportOptions(CommandOptions):
    """Options of `sylpose export`.

    Attributes:
        out: Write this file; for rosbag, this folder.
        to: Set the format; default: from FILE's name.
        name: Set the object's name in FILE; default: its own.
        start: Start at this frame; default: RESULT's first.
        velocity: Add velocities and accelerations with their standard deviations (csv and parquet).
    """

    result: ResultPath
    out: Annotated[Path, option("--out FILE", OUTPUT)]
    to: Annotated[str | None, option(f"--to {'|'.join(EXPORT_FORMATS)}", OUTPUT)] = None
    name: Annotated[str | None, option("--name NAME", OUTPUT)] = None
    start: Annotated[int | None, option("--start N", INPUT)] = None
    stop: StopFrame = None
    velocity: Annotated[bool, option("--velocity", OUTPUT)] = False


@command("Export a trajectory to another program's format.")
def export(options: ExportOptions) -> None:
    """Export a finished trajectory to another program's format.

    Biomechanics: c3d and trc; animation: bvh, gltf and usd; ROS 2: rosbag; tables: csv and parquet. Poses are
    world_from_object. Frames without a measured pose are gaps: missing points, an invisible object, or no message. c3d,
    rosbag, parquet and usd require extras: pip install 'sylpose[export,usd]'.

    Examples:
        sylpose export recording/sylpose --out object.c3d
        sylpose export recording/sylpose --out velocity.csv --velocity
        sylpose export recording/sylpose --to rosbag --out bag
        sylpose export recording/sylpose --out object.bvh --start 10 --stop 200
    """
    from sylpose.io.exports.formats import export_trajectory, select_frames
    from sylpose.runs import console_output
    from sylpose.runs.run_metadata import find_run_folder, read_world_definition
    from sylpose.runs.view import read_result

    result, out = options.result, options.out
    folder = result if result.is_dir() else result.parent
    name = options.name or (folder.name if find_run_folder(folder) != folder else "object")
    trajectory, z_up = read_result(result), read_world_definition(result) is not None
    selected = select_frames(trajectory, options.start, options.stop)
    start, stop, velocity = options.start, options.stop, options.velocity
    notes = export_trajectory(
        trajectory, out, options.to, name=name, start=start, stop=stop, z_up=z_up, velocity=velocity
    )
    console = console_output.make_console()
    console.print(f"{sum(frame.is_measured for frame in selected)} of {len(selected)} frames have a measured pose.")
    for note in notes:
        console.print(f"{note[0].upper()}{note[1:]}.", highlight=False)
    console_output.print_files(console, "File" if out.is_file() else "Folder", [out])
