"""C3D export for biomechanics, through ezc3d: markers at the object's center and axis ends, missing in gaps."""

from __future__ import annotations

from pathlib import Path

import ezc3d
import numpy as np

from sylpose.atomic_io import replace_atomically
from sylpose.io.exports.poses import Poses

__all__ = ["write_c3d"]


def write_c3d(poses: Poses, path: Path) -> list[str]:
    """Write a C3D file in mm and return notes on it.

    In gaps, markers have the residual -1, which marks them as missing. If z is known to be up, the parameters X_SCREEN
    and Y_SCREEN set the initial view accordingly.

    Raises:
        ValueError: frames that are not at a steady rate.
    """
    rate, poses = poses.compute_rate("c3d"), poses.in_unit("mm")
    names, positions = poses.compute_markers()
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [rate]
    point["LABELS"]["value"] = names
    point["UNITS"]["value"] = [poses.unit or "units"]
    if poses.z_up:
        file.add_parameter("POINT", "X_SCREEN", ["+X"])
        file.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    is_present = np.asarray(np.isfinite(positions).all(axis=2))
    data = np.ones((4, len(names), len(poses)))
    data[:3] = np.where(is_present[:, :, None], positions, 0.0).transpose(2, 1, 0)
    file["data"]["points"] = data
    file["data"]["meta_points"]["residuals"] = np.where(is_present, 0.0, -1.0).T[None]
    with replace_atomically(path) as part:
        file.write(str(part))
    return [] if poses.unit == "mm" else ["lengths are in the calibration's unknown unit, not mm"]
