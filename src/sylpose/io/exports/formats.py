"""Export of trajectories to other programs' formats; importable without the writers' dependencies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from sylpose.io.exports.poses import Surroundings
    from sylpose.results import Trajectory


class ExportFormat(NamedTuple):
    """Export format of trajectories.

    Attributes:
        suffixes: suffixes of its file; empty for a folder.
        package: import name of the required package; "" for none.
        extra: extra of sylpose that installs it.
    """

    suffixes: tuple[str, ...]
    package: str = ""
    extra: str = ""


EXPORT_FORMATS: dict[str, ExportFormat] = {
    "csv": ExportFormat((".csv",)),
    "tum": ExportFormat((".tum", ".txt")),
    "trc": ExportFormat((".trc",)),
    "mot": ExportFormat((".mot",)),
    "sto": ExportFormat((".sto",)),
    "bvh": ExportFormat((".bvh",)),
    "gltf": ExportFormat((".glb", ".gltf")),
    "c3d": ExportFormat((".c3d",), "ezc3d", "export"),
    "parquet": ExportFormat((".parquet",), "pyarrow", "export"),
    "rosbag": ExportFormat((), "rosbags", "export"),
    "usd": ExportFormat((".usda", ".usdc", ".usd"), "pxr", "usd"),
}
# Formats that take the trajectory with all its columns; the others take its poses.
_TABLES = ("csv", "parquet")


def export_trajectory(
    trajectory: Trajectory,
    out: Path,
    to: str | None = None,
    *,
    name: str = "object",
    start: int | None = None,
    stop: int | None = None,
    z_up: bool = False,
    velocity: bool = False,
    angles: str | None = None,
    surroundings: Surroundings | None = None,
) -> list[str]:
    """Write a trajectory in another format.

    Args:
        trajectory: the trajectory to write.
        out: the file, or the folder of a ROS bag.
        to: one of `EXPORT_FORMATS`; None: derived from the file's name.
        name: name of the object, for formats that contain one.
        start, stop: first frame, and first frame that is omitted; None for no limit.
        z_up: the world's z axis is known to point up, as in a user-defined world.
        velocity: add velocities and accelerations, estimated from all frames (`Trajectory.differentiate`).
        angles: axes of the angles (`parse_euler_angles`), for mot and sto; None for XYZ.
        surroundings: cameras and points, for gltf and usd.

    Returns:
        notes on differences between the file and the trajectory.

    Raises:
        ValueError: an unknown format, or a file name that does not match it; a required package is not installed; no
            frames between `start` and `stop`, or no poses in them; content that the format does not support; too few poses
            for velocities.
        OSError: the file cannot be written; the message names it.
    """
    suffix = out.suffix.lower()
    if to is None:
        to = next((key for key, known in EXPORT_FORMATS.items() if suffix in known.suffixes), None)
        if to is None:
            raise ValueError(f"{out}: unknown file name extension; give --to {'|'.join(EXPORT_FORMATS)}")
    if to not in EXPORT_FORMATS:
        raise ValueError(f"--to must be one of {', '.join(EXPORT_FORMATS)}, got {to!r}")
    suffixes, package, extra = EXPORT_FORMATS[to]
    if suffixes and suffix not in suffixes:
        raise ValueError(f"{out}: the file name of {to} must end in one of {', '.join(suffixes)}")
    if package and find_spec(package) is None:
        raise ValueError(f"--to {to} needs {package}, which is not installed: pip install 'sylpose[{extra}]'")
    if velocity and to not in _TABLES:
        raise ValueError(f"--velocity: {to} has no columns for velocities; {' and '.join(_TABLES)} do")
    if angles is not None and to not in ("mot", "sto"):
        raise ValueError(f"--euler: {to} has no angles of chosen axes; mot and sto do")
    from sylpose.geometry.euler_angles import parse_euler_angles
    from sylpose.io.exports.poses import Poses
    from sylpose.kinematics import describe_filter
    from sylpose.report.files import build_columns

    selected, write = select_frames(trajectory, start, stop), _load_writer(to)
    if to not in _TABLES:
        poses = Poses.from_trajectory(selected, name, z_up)
        axes = None if angles is None else parse_euler_angles(angles)
        return write(replace(poses, angles=axes, surroundings=surroundings or poses.surroundings), out)
    if not velocity:
        return write(build_columns(selected), out)
    kinematics, kept = trajectory.differentiate(), {frame.index for frame in selected}
    rows = [k for k, frame in enumerate(trajectory) if frame.index in kept]
    table = {name: [column[k] for k in rows] for name, column in build_columns(trajectory, kinematics).items()}
    notes = [*write(table, out), describe_filter(kinematics, trajectory.unit)]
    if all(frame.time == frame.index for frame in trajectory):
        notes.append("times are numbers of frames, so velocities are per frame (sylpose track --rate sets the rate)")
    return notes


def select_frames(trajectory: Trajectory, start: int | None, stop: int | None) -> Trajectory:
    """Return the part of a trajectory from frame `start` to before frame `stop`.

    Raises:
        ValueError: it contains no frame.
    """
    kept = [f for f in trajectory if (start is None or f.index >= start) and (stop is None or f.index < stop)]
    if not kept:
        requested = " ".join(f"--{end} {n}" for end, n in (("start", start), ("stop", stop)) if n is not None)
        available = f"frames {trajectory[0].index} to {trajectory[-1].index}" if len(trajectory) else "none"
        raise ValueError(f"no frame to export: the trajectory has {available}, requested: {requested or 'all'}")
    return type(trajectory)(kept, trajectory.camera_names, trajectory.unit)


def _load_writer(to: str) -> Callable[[Any, Path], list[str]]:
    """Import the writer of a format."""
    from sylpose.io.exports.gltf import write_gltf
    from sylpose.io.exports.libraries import write_c3d, write_parquet, write_rosbag, write_usd
    from sylpose.io.exports.text import write_bvh, write_csv, write_mot, write_sto, write_trc, write_tum

    writers: tuple[Callable[[Any, Path], list[str]], ...] = (write_csv, write_tum, write_trc, write_bvh, write_gltf)
    writers += (write_mot, write_sto, write_c3d, write_parquet, write_rosbag, write_usd)
    return next(write for write in writers if write.__name__ == f"write_{to}")
