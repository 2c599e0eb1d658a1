"""Result of a calibration: the rig, its uncertainty, and what the recording does not determine."""

from __future__ import annotations

from dataclasses import dataclass

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.rig import Rig


class CalibrationRefusedError(RuntimeError):
    """Error for input that does not determine a calibration; the message has the reason and the remedy."""


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """Calibrated rig of C cameras with its uncertainty.

    Attributes:
        rig: the cameras; the world is the first camera's frame.
        extrinsics_covariance: (C, 6, 6) of (w, d) of each camera_from_world, R = exp(w) R̂, t = t̂ + d, in radians and the
            rig's unit; 0 for the first camera.
        intrinsics_covariance: by camera, (4 + K, 4 + K) of fx, fy, cx, cy in pixels and the K distortion coefficients; 0
            for values that were not estimated.
        n_views: (C,) number of views of each camera that were used.
        n_points: (C,) number of its image points that were used, without outliers.
        rms_px: (C,) rms reprojection error of these points, two coordinates together.
        unobservable: sentences about what the recording does not determine, and was therefore not estimated.
        warnings: sentences about what may be wrong, each with a remedy.
    """

    rig: Rig
    extrinsics_covariance: FloatArray
    intrinsics_covariance: tuple[FloatArray, ...]
    n_views: IntArray
    n_points: IntArray
    rms_px: FloatArray
    unobservable: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
