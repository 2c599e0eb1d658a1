"""`sylpose export`: export of a finished trajectory to other programs' formats."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from sylpose.io.exports.formats import EXPORT_FORMATS
from sylpose.io.exports.poses import Poses
from sylpose.results import Trajectory
from sylpose.runs import console_output
from sylpose.runs.run_metadata import find_run_folder, read_world_definition
from sylpose.runs.view import read_result

__all__ = ["export_trajectory", "run_export_command"]

# Writer of each format below sylpose.io.exports: formats with all columns take the trajectory, the others its poses.
_TABLE_WRITERS = {"csv": "text.write_csv", "parquet": "parquet.write_parquet"}
_POSE_WRITERS = {
    "tum": "text.write_tum",
    "trc": "text.write_trc",
    "bvh": "text.write_bvh",
    "gltf": "gltf.write_gltf",
    "c3d": "c3d.write_c3d",
    "rosbag": "rosbag.write_rosbag",
    "usd": "usd.write_usd",
}


def run_export_command(
    result: Path, out: Path, to: str | None, name: str | None, start: int | None, stop: int | None
) -> None:
    """Export a run's trajectory to another format and print a summary.

    Args:
        result: the run's folder or its trajectory.csv.
        out: file to write, or folder of a ROS bag.
        to: format; None: derived from the name of `out`.
        name: name of the object in the file; None: the result folder's name, or "object".
        start, stop: first frame, and first frame that is omitted; None for no limit.

    Raises:
        ValueError, OSError: as `export_trajectory` and `read_result`; no frames between `start` and `stop`.
    """
    trajectory = read_result(result)
    folder = result if result.is_dir() else result.parent
    default_name = folder.name if find_run_folder(folder) != folder else "object"
    selected = _select_frames(trajectory, start, stop)
    notes = export_trajectory(
        selected, out, to, name=name or default_name, z_up=read_world_definition(result) is not None
    )
    console = console_output.make_console()
    found = sum(frame.is_measured for frame in selected)
    console.print(f"{found} of {len(selected)} frames have a measured pose.")
    for note in notes:
        console.print(f"{note[0].upper()}{note[1:]}.", highlight=False)
    console_output.print_files(console, "File" if out.is_file() else "Folder", [out])


def export_trajectory(
    trajectory: Trajectory,
    out: Path,
    to: str | None = None,
    *,
    name: str = "object",
    start: int | None = None,
    stop: int | None = None,
    z_up: bool = False,
) -> list[str]:
    """Write a trajectory in another format.

    Args:
        trajectory: the trajectory to write.
        out: the file, or the folder of a ROS bag.
        to: one of `EXPORT_FORMATS`; None: derived from the file's name.
        name: name of the object, for formats that contain one.
        start, stop: first frame, and first frame that is omitted; None for no limit.
        z_up: the world's z axis is known to point up, as in a user-defined world.

    Returns:
        notes on differences between the file and the trajectory.

    Raises:
        ValueError: an unknown format, or a file name that does not match it; a required package is not installed; no
            frames between `start` and `stop`, or no poses in them; content that the format does not support.
        OSError: the file cannot be written; the message names it.
    """
    suffix = out.suffix.lower()
    if to is None:
        to = next(
            (format_name for format_name, file_format in EXPORT_FORMATS.items() if suffix in file_format.suffixes), None
        )
        if to is None:
            raise ValueError(f"{out}: unknown file name extension; give --to {'|'.join(EXPORT_FORMATS)}")
    if to not in EXPORT_FORMATS:
        raise ValueError(f"--to must be one of {', '.join(EXPORT_FORMATS)}, got {to!r}")
    file_format = EXPORT_FORMATS[to]
    if file_format.suffixes and suffix not in file_format.suffixes:
        raise ValueError(f"{out}: the file name of {to} must end in one of {', '.join(file_format.suffixes)}")
    if file_format.package and find_spec(file_format.package) is None:
        raise ValueError(
            f"--to {to} needs {file_format.package}, which is not installed: pip install 'sylpose[{file_format.extra}]'"
        )
    module, _, function = {**_TABLE_WRITERS, **_POSE_WRITERS}[to].partition(".")
    write = getattr(import_module(f"sylpose.io.exports.{module}"), function)
    selected = _select_frames(trajectory, start, stop)
    return list(write(selected if to in _TABLE_WRITERS else Poses.from_trajectory(selected, name, z_up), out))


def _select_frames(trajectory: Trajectory, start: int | None, stop: int | None) -> Trajectory:
    """Return the part of a trajectory from frame `start` to before frame `stop`.

    Raises:
        ValueError: it contains no frame.
    """
    kept = [f for f in trajectory if (start is None or f.index >= start) and (stop is None or f.index < stop)]
    if not kept:
        options = "".join(f" --{end} {n}" for end, n in (("start", start), ("stop", stop)) if n is not None)
        available = f"frames {trajectory[0].index} to {trajectory[-1].index}" if len(trajectory) else "none"
        raise ValueError(f"no frame to export: the trajectory has {available}, requested: {options.strip() or 'all'}")
    return Trajectory(kept, trajectory.camera_names, trajectory.unit)
