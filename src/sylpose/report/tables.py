"""Trajectories as tables: column names and values."""

from __future__ import annotations

from typing import Any

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.results import Trajectory

__all__ = [
    "CAMERA_COLUMNS",
    "COLUMNS",
    "POSE_COLUMNS",
    "SD_COLUMNS",
    "align_quaternion_sign",
    "build_columns",
    "to_dataframe",
]

POSE_COLUMNS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
ANGLE_COLUMNS = ("pan_deg", "tilt_deg", "roll_deg")
SD_COLUMNS = ("rx_sd_deg", "ry_sd_deg", "rz_sd_deg", "tx_sd", "ty_sd", "tz_sd")
COLUMNS = ("index", "time", "status", "observability", "unit", *POSE_COLUMNS, *ANGLE_COLUMNS, *SD_COLUMNS)
# Prefixes of the per-camera columns, followed by the camera's name.
CAMERA_COLUMNS = ("inliers", "residual_px", "variance_inflation", "matches")


def build_columns(trajectory: Trajectory) -> dict[str, list[Any]]:
    """Build the columns of trajectory.csv (docs/formats.md), not rounded.

    Values are text, integers or floats; NaN where there is no value, infinity for an unbounded standard deviation.
    """
    names = trajectory.camera_names
    per_camera = [f"{what}_{name}" for what in CAMERA_COLUMNS for name in names]
    quaternion, rows = None, []
    for f in trajectory:
        pose, missing = np.full(7, np.nan), np.full(len(names), np.nan)
        if f.world_from_object is not None:
            quaternion = align_quaternion_sign(f.world_from_object.rotation.as_quat(), quaternion)
            pose = np.concatenate([f.position, quaternion])
        cells: list[Any] = [f.index, f.time, f.status.value, f.observability.value, trajectory.unit]
        cells += [
            *pose.tolist(),
            *np.degrees(f.pan_tilt_roll).tolist(),
            *np.degrees(f.sigma[:3]).tolist(),
            *f.sigma[3:].tolist(),
        ]
        for values in (f.inliers, f.residuals, f.variance_inflation, f.matches):
            cells += (values if len(values) else missing).tolist()
        rows.append([*cells, "; ".join(f.faults), f.reason])
    columns = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in (*COLUMNS, *per_camera, 0, 0)]
    return dict(zip((*COLUMNS, *per_camera, "faults", "reason"), columns, strict=True))


def to_dataframe(trajectory: Trajectory) -> Any:
    """Build the same table as a `pandas.DataFrame`.

    Raises:
        ModuleNotFoundError: pandas is not installed.
    """
    try:
        import pandas
    except ModuleNotFoundError as error:
        message = "a DataFrame needs pandas: python3 -m pip install 'sylpose[export]'"
        raise ModuleNotFoundError(message, name=error.name) from None
    return pandas.DataFrame(build_columns(trajectory))


def align_quaternion_sign(quaternion: FloatArray, previous: FloatArray | None) -> FloatArray:
    """Choose the quaternion's sign nearer to the previous frame; for the first frame w >= 0."""
    reference = np.array([0.0, 0.0, 0.0, 1.0]) if previous is None else previous
    return -quaternion if quaternion @ reference < 0 else quaternion
