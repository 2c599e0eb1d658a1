"""Trajectories as text: CSV with all columns, TUM, TRC (OpenSim, Mokka) and BVH (Blender, Maya)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.atomic_io import replacing
from sylpose.exports.poses import UP_UNKNOWN, Poses, runs_of
from sylpose.report.tables import columns_of
from sylpose.results import Trajectory

__all__ = ["write_bvh", "write_csv", "write_trc", "write_tum"]


def write_csv(trajectory: Trajectory, path: Path) -> list[str]:
    """All frames and columns (`report.tables`); cells are empty where there is no value."""
    columns = columns_of(trajectory)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows(zip(*([_cell(value) for value in column] for column in columns.values()), strict=True))
    _put(path, text.getvalue())
    return []


def _cell(value: Any) -> str:
    if isinstance(value, float) and math.isnan(value):
        return ""
    return repr(float(value)) if isinstance(value, float) else str(value)


def write_tum(poses: Poses, path: Path) -> list[str]:
    """time tx ty tz qx qy qz qw of each pose."""
    rows = np.column_stack([poses.times, poses.positions, poses.quaternions])[poses.found]
    unit = poses.unit or "units of the calibration"
    _put(path, f"# time tx ty tz qx qy qz qw : world_from_object, positions in {unit}\n" + _lines(rows.tolist(), " "))
    return []


def write_trc(poses: Poses, path: Path) -> list[str]:
    """Four markers, the centre and the ends of the axes; cells are empty in gaps.

    Raises:
        ValueError: frames that are not at a steady rate.
    """
    rate, poses = poses.rate("trc"), poses.in_unit("mm")
    names, places = poses.markers()
    n, head = (
        len(poses),
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
    )
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
    for k, (time, row) in enumerate(zip(poses.times - poses.times[0], places.reshape(n, -1), strict=True), start=1):
        cells = ["" if math.isnan(v) else f"{v:.6f}" for v in row]
        lines.append("\t".join([str(k), f"{time:.6f}", *cells]))
    _put(path, "\n".join(lines) + "\n")
    return _units(poses, "mm")


def write_bvh(poses: Poses, path: Path) -> list[str]:
    """One joint that moves and turns, Z, X, Y in turn; of frames from the first pose to the last. Y goes up in BVH (readers
    that are not told otherwise, such as Blender, take it for that), so a world whose z axis does is turned.

    Raises:
        ValueError: frames that are not at a steady rate; frames between them that have no pose, which BVH cannot say.
    """
    poses = poses.trimmed()
    if not poses.found.all():
        first, stop = max(runs_of(poses.found), key=lambda run: run[1] - run[0])
        raise ValueError(
            f"bvh cannot say that a frame has no pose, and {int((~poses.found).sum())} between the first pose and the last "
            f"have none; the longest stretch with poses is --start {poses.indices[first]} "
            f"--stop {poses.indices[stop - 1] + 1}"
        )
    rate, known = poses.rate("bvh"), poses.z_up
    poses = poses.with_y_up()
    turned = Rotation.from_quat(poses.quaternions)
    angles = np.degrees(np.unwrap(turned.as_euler("ZXY", suppress_warnings=True), axis=0))
    head = f"""HIERARCHY
ROOT {poses.word}
{{
\tOFFSET 0.0 0.0 0.0
\tCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
\tEnd Site
\t{{
\t\tOFFSET 0.0 0.0 {poses.axis!r}
\t}}
}}
MOTION
Frames: {len(poses)}
Frame Time: {1 / rate:.9f}
"""
    _put(path, head + _lines(np.column_stack([poses.positions, angles]).tolist(), " "))
    up = "its world is turned: y is up, which was z" if known else UP_UNKNOWN
    return [f"its frames are {poses.indices[0]} to {poses.indices[-1]} of the recording", up]


def _units(poses: Poses, wanted: str) -> list[str]:
    return (
        []
        if poses.unit == wanted
        else [f"lengths are as in the calibration, which does not say its unit, and not {wanted}"]
    )


def _lines(rows: Iterable[list[float]], between: str) -> str:
    return "".join(between.join(repr(v) for v in row) + "\n" for row in rows)


def _put(path: Path, text: str) -> None:
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
