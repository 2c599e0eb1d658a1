"""`sylpose export`: a finished trajectory in another program's format."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from sylpose.app import console_output
from sylpose.app.run_metadata import root_of, world_said
from sylpose.app.view import read_result
from sylpose.exports.formats import FORMATS
from sylpose.exports.poses import Poses
from sylpose.results import Trajectory

__all__ = ["export", "export_aloud"]

# Where each is written; of those that have all columns, the trajectory, of others the poses.
_TABLES = {"csv": "text.write_csv", "parquet": "parquet.write_parquet"}
_OF_POSES = {
    "tum": "text.write_tum",
    "trc": "text.write_trc",
    "bvh": "text.write_bvh",
    "gltf": "gltf.write_gltf",
    "c3d": "c3d.write_c3d",
    "rosbag": "rosbag.write_rosbag",
    "usd": "usd.write_usd",
}


def export_aloud(
    result: Path, out: Path, to: str | None, name: str | None, start: int | None, stop: int | None
) -> None:
    """Writes the trajectory of a run in another format, and says what is in the file.

    Raises:
        ValueError, OSError: as `export` and `read_result`; no frames between `start` and `stop`.
    """
    trajectory = read_result(result)
    folder = result if result.is_dir() else result.parent
    own = folder.name if root_of(folder) != folder else "object"
    asked = _between(trajectory, start, stop)
    notes = export(asked, out, to, name=name or own, z_up=world_said(result) is not None)
    console = console_output.make_console()
    found = sum(frame.measured for frame in asked)
    console.print(f"{found} of {len(asked)} frames have a measured pose.")
    for note in notes:
        console.print(f"{note[0].upper()}{note[1:]}.", highlight=False)
    console_output.print_files(console, "File" if out.is_file() else "Folder", [out])


def export(
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
        out: the file, or the folder of a bag.
        to: one of `FORMATS`; None for what the file's name tells.
        name: of the object, in formats that have one.
        start, stop: numbers of frames, of which the latter is the first that is left out.
        z_up: the world's z axis is known to go up, as in a world of one's own.

    Returns:
        sentences on what is otherwise in the file.

    Raises:
        ValueError: another format, or a name that does not fit it; a package that is not installed; no frames
            between `start` and `stop`, or no poses in them; what the format cannot hold.
        OSError: naming the file that cannot be written.
    """
    suffix = out.suffix.lower()
    if to is None:
        to = next((known for known, its in FORMATS.items() if suffix in its.suffixes), None)
        if to is None:
            raise ValueError(f"{out}: its name does not tell a format; say --to {'|'.join(FORMATS)}")
    if to not in FORMATS:
        raise ValueError(f"--to must be one of {', '.join(FORMATS)}, got {to!r}")
    its = FORMATS[to]
    if its.suffixes and suffix not in its.suffixes:
        raise ValueError(f"{out}: {to} is written as one of {', '.join(its.suffixes)}")
    if its.package and find_spec(its.package) is None:
        raise ValueError(f"--to {to} needs {its.package}, which is not installed: pip install 'sylpose[{its.extra}]'")
    module, _, function = {**_TABLES, **_OF_POSES}[to].partition(".")
    write = getattr(import_module(f"sylpose.exports.{module}"), function)
    asked = _between(trajectory, start, stop)
    return list(write(asked if to in _TABLES else Poses.of(asked, name, z_up), out))


def _between(trajectory: Trajectory, start: int | None, stop: int | None) -> Trajectory:
    """The frames that are asked for.

    Raises:
        ValueError: there are none.
    """
    kept = [f for f in trajectory if (start is None or f.index >= start) and (stop is None or f.index < stop)]
    if not kept:
        asked = "".join(f" --{end} {n}" for end, n in (("start", start), ("stop", stop)) if n is not None)
        has = f"frames {trajectory[0].index} to {trajectory[-1].index}" if len(trajectory) else "none"
        raise ValueError(
            f"no frame to export: the trajectory has {has}, {asked.strip() or 'and that is all'} asked for"
        )
    return Trajectory(kept, trajectory.camera_names, trajectory.unit)
