"""A trajectory as columns: what they are called, in files and for what works on tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.results import Trajectory

__all__ = ["COLUMNS", "PER_CAMERA", "POSE_COLUMNS", "SD_COLUMNS", "columns_of", "continued", "dataframe"]

POSE_COLUMNS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
ANGLE_COLUMNS = ("pan_deg", "tilt_deg", "roll_deg")
SD_COLUMNS = ("rx_sd_deg", "ry_sd_deg", "rz_sd_deg", "tx_sd", "ty_sd", "tz_sd")
COLUMNS = ("index", "time", "status", "observability", "unit", *POSE_COLUMNS, *ANGLE_COLUMNS, *SD_COLUMNS)
# With a camera's name behind each.
PER_CAMERA = ("inliers", "residual_px", "variance_inflation", "matches")


def columns_of(trajectory: Trajectory) -> dict[str, list[Any]]:
    """The columns of trajectory.csv (docs/formats.md), not rounded: words, whole numbers, and numbers: NaN where there is no
    value, infinity where a standard deviation is unbounded."""
    names = trajectory.camera_names
    per_camera = [f"{what}_{name}" for what in PER_CAMERA for name in names]
    quaternion, rows = None, []
    for f in trajectory:
        pose, nothing = np.full(7, np.nan), np.full(len(names), np.nan)
        if f.world_from_object is not None:
            quaternion = continued(f.world_from_object.rotation.as_quat(), quaternion)
            pose = np.concatenate([f.position, quaternion])
        told: list[Any] = [f.index, f.time, f.status.value, f.observable.value, trajectory.unit]
        told += [
            *pose.tolist(),
            *np.degrees(f.pan_tilt_roll).tolist(),
            *np.degrees(f.sigma[:3]).tolist(),
            *f.sigma[3:].tolist(),
        ]
        for values in (f.inliers, f.residuals, f.doubt, f.matches):
            told += (values if len(values) else nothing).tolist()
        rows.append([*told, "; ".join(f.faults), f.reason])
    columns = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in (*COLUMNS, *per_camera, 0, 0)]
    return dict(zip((*COLUMNS, *per_camera, "faults", "reason"), columns, strict=True))


def dataframe(trajectory: Trajectory) -> Any:
    """The same as a `pandas.DataFrame`.

    Raises:
        ModuleNotFoundError: pandas is not installed.
    """
    try:
        import pandas
    except ModuleNotFoundError as error:
        said = "a DataFrame needs pandas: python3 -m pip install 'sylpose[export]'"
        raise ModuleNotFoundError(said, name=error.name) from None
    return pandas.DataFrame(columns_of(trajectory))


def continued(quaternion: FloatArray, before: FloatArray | None) -> FloatArray:
    """The sign nearer to the frame before; at the start the one with w >= 0."""
    reference = np.array([0.0, 0.0, 0.0, 1.0]) if before is None else before
    return -quaternion if quaternion @ reference < 0 else quaternion
