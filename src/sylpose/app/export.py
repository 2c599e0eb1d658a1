"""`sylpose export`: a finished trajectory in another program's format."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from sylpose.app import text
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
        ValueError, OSError: as `export` and `read_result`.
    """
    trajectory = read_result(result)
    folder = result if result.is_dir() else result.parent
    # Of several objects each has a folder, in which there is no settings.toml.
    own = folder.name if (folder.parent / "settings.toml").is_file() else "object"
    notes = export(trajectory, out, to, name=name or own, start=start, stop=stop)
    console = text.make_console()
    found = sum(frame.measured for frame in trajectory)
    console.print(f"{found} of {len(trajectory)} frames have a measured pose.")
    for note in notes:
        console.print(f"{note[0].upper()}{note[1:]}.", highlight=False)
    text.print_files(console, "File" if out.is_file() else "Folder", [out])


def export(
    trajectory: Trajectory,
    out: Path,
    to: str | None = None,
    *,
    name: str = "object",
    start: int | None = None,
    stop: int | None = None,
) -> list[str]:
    """Write a trajectory in another format.

    Args:
        out: the file, or the folder of a bag.
        to: one of `FORMATS`; None for what the file's name tells.
        name: of the object, in formats that have one.
        start, stop: numbers of frames, of which the latter is the first that is left out.

    Returns:
        sentences on what is otherwise in the file.

    Raises:
        ValueError: another format, or a name that does not fit it; a package that is not installed; no poses; what the
            format cannot hold.
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
    if to in _TABLES:
        kept = [f for f in trajectory if (start is None or f.index >= start) and (stop is None or f.index < stop)]
        return list(write(Trajectory(kept, trajectory.camera_names, trajectory.unit), out))
    return list(write(Poses.of(trajectory, name, start, stop), out))
