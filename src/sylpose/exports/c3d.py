"""C3D, of biomechanics, through ezc3d: four markers, the object's centre and the ends of its axes; missing ones in gaps."""

from __future__ import annotations

from pathlib import Path

import ezc3d
import numpy as np

from sylpose.atomic_io import replacing
from sylpose.exports.poses import Poses

__all__ = ["write_c3d"]


def write_c3d(poses: Poses, path: Path) -> list[str]:
    """In mm; in gaps the markers have the residual -1, which says that they were not seen. Where z is known to go up,
    X_SCREEN and Y_SCREEN say so, the parameters that C3D has for how a scene is shown first.

    Raises:
        ValueError: frames that are not at a steady rate.
    """
    rate, poses = poses.rate("c3d"), poses.in_unit("mm")
    names, places = poses.markers()
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [rate]
    point["LABELS"]["value"] = names
    point["UNITS"]["value"] = [poses.unit or "units"]
    if poses.z_up:
        file.add_parameter("POINT", "X_SCREEN", ["+X"])
        file.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    found = np.asarray(np.isfinite(places).all(axis=2))
    data = np.ones((4, len(names), len(poses)))
    data[:3] = np.where(found[:, :, None], places, 0.0).transpose(2, 1, 0)
    file["data"]["points"] = data
    file["data"]["meta_points"]["residuals"] = np.where(found, 0.0, -1.0).T[None]
    with replacing(path) as part:
        file.write(str(part))
    return [] if poses.unit == "mm" else ["lengths are as in the calibration, which does not say its unit, and not mm"]
