"""Text exports: CSV with all columns, TUM, TRC (OpenSim, Mokka), MOT and STO (OpenSim), BVH (Blender, Maya)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.atomic_io import replace_atomically
from sylpose.io.exports.poses import UP_UNKNOWN_NOTE, Poses, find_runs


def write_csv(columns: dict[str, list[Any]], path: Path) -> list[str]:
    """Write the columns of `report.files`; cells are empty for missing values."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows(zip(*([_format_cell(value) for value in column] for column in columns.values()), strict=True))
    _write_text(path, text.getvalue())
    return []


def _format_cell(value: Any) -> str:
    if isinstance(value, float) and math.isnan(value):
        return ""
    return repr(float(value)) if isinstance(value, float) else str(value)


def write_tum(poses: Poses, path: Path) -> list[str]:
    """Write time tx ty tz qx qy qz qw of each pose."""
    rows = np.column_stack([poses.times, poses.positions, poses.quaternions])[poses.has_pose]
    unit = poses.unit or "units of the calibration"
    head = f"# time tx ty tz qx qy qz qw : world_from_object, positions in {unit}\n"
    _write_text(path, head + _format_lines(rows.tolist(), " "))
    return []


def write_trc(poses: Poses, path: Path) -> list[str]:
    """Write four markers, the center and the axis ends; cells are empty in gaps.

    Raises:
        ValueError: frames that are not at a steady rate.
    """
    rate, poses = poses.compute_rate("trc"), poses.in_unit("mm")
    names, positions = poses.compute_markers()
    head = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
    n = len(poses)
    numbers = [f"{rate:g}", f"{rate:g}", n, len(names), poses.unit or "units", f"{rate:g}", 1, n]
    axes = "\t".join(f"{axis}{k}" for k in range(1, len(names) + 1) for axis in "XYZ")
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        head,
        "\t".join(map(str, numbers)),
        "Frame#\tTime\t" + "".join(f"{name}\t\t\t" for name in names),
        f"\t\t{axes}",
        "",
    ]
    for k, (time, row) in enumerate(zip(poses.times - poses.times[0], positions.reshape(n, -1), strict=True), start=1):
        cells = ["" if math.isnan(v) else f"{v:.6f}" for v in row]
        lines.append("\t".join([str(k), f"{time:.6f}", *cells]))
    _write_text(path, "\n".join(lines) + "\n")
    return poses.note_unit("mm")


def write_mot(poses: Poses, path: Path) -> list[str]:
    """Write the coordinates of an OpenSim free joint: three angles, degrees, and positions, meters; no rows in gaps."""
    return _write_storage(poses, path, "Coordinates")


def write_sto(poses: Poses, path: Path) -> list[str]:
    """Write the same table as an OpenSim storage file."""
    return _write_storage(poses, path, "Position")


def _write_storage(poses: Poses, path: Path, kind: str) -> list[str]:
    """Write an OpenSim storage file with the names of a free joint, body-fixed x, y, z by default.

    OpenSim's y is up, so a world with z up is rotated. Angles about given axes are joint angles and not rotated.
    """
    poses = poses.in_unit("m")
    is_rotated, prefix = poses.z_up and poses.angles is None, poses.identifier
    poses = poses.with_y_up() if is_rotated else poses
    found = poses.has_pose
    rotations = Rotation.from_quat(poses.quaternions[found])
    if poses.angles is None:
        names, angles = ["rx", "ry", "rz"], rotations.as_euler("XYZ", suppress_warnings=True)
    else:
        names, angles = list(poses.angles.names), poses.angles.from_rotation(rotations)
    angles = np.degrees(np.unwrap(angles, axis=0))
    rows = np.column_stack([poses.times[found], angles, poses.positions[found]]) + 0.0  # no -0
    columns = ["time", *(f"{prefix}_{name}" for name in (*names, "tx", "ty", "tz"))]
    head = [kind, "version=1", f"nRows={len(rows)}", f"nColumns={len(columns)}", "inDegrees=yes", "endheader"]
    _write_text(path, "\n".join([*head, "\t".join(columns)]) + "\n" + _format_lines(rows.tolist(), "\t"))
    up = "its world is rotated: z up becomes y up" if is_rotated else UP_UNKNOWN_NOTE
    return [*poses.note_unit("m"), *([up] if poses.angles is None else [])]


def write_bvh(poses: Poses, path: Path) -> list[str]:
    """Write a single moving joint with rotation order Z, X, Y, from the first pose to the last.

    BVH readers such as Blender assume y up by default, so a world with z up is rotated.

    Raises:
        ValueError: frames that are not at a steady rate; gaps between poses, which BVH cannot represent.
    """
    poses = poses.trim()
    if not poses.has_pose.all():
        first, stop = max(find_runs(poses.has_pose), key=lambda run: run[1] - run[0])
        raise ValueError(
            f"bvh cannot represent gaps, and {int((~poses.has_pose).sum())} frames between the first pose and the last "
            f"have no pose; the longest run with poses is --start {poses.indices[first]} "
            f"--stop {poses.indices[stop - 1] + 1}"
        )
    rate, is_rotated = poses.compute_rate("bvh"), poses.z_up
    poses = poses.with_y_up()
    rotations = Rotation.from_quat(poses.quaternions)
    angles = np.degrees(np.unwrap(rotations.as_euler("ZXY", suppress_warnings=True), axis=0))
    head = f"""HIERARCHY
ROOT {poses.identifier}
{{
\tOFFSET 0.0 0.0 0.0
\tCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
\tEnd Site
\t{{
\t\tOFFSET 0.0 0.0 {poses.axis_length!r}
\t}}
}}
MOTION
Frames: {len(poses)}
Frame Time: {1 / rate:.9f}
"""
    _write_text(path, head + _format_lines(np.column_stack([poses.positions, angles]).tolist(), " "))
    up_note = "its world is rotated: z up becomes y up" if is_rotated else UP_UNKNOWN_NOTE
    return [f"its frames are {poses.indices[0]} to {poses.indices[-1]} of the recording", up_note]


def _format_lines(rows: Iterable[list[float]], separator: str) -> str:
    return "".join(separator.join(repr(v) for v in row) + "\n" for row in rows)


def _write_text(path: Path, text: str) -> None:
    with replace_atomically(path) as part:
        part.write_text(text, encoding="utf-8")
