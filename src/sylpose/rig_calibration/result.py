"""Result of a calibration: the rig, its uncertainty, and what the recording does not determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.rig import Rig

# Cells of an image, columns and rows, in which points are counted (choice).
GRID = (8, 6)


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


@dataclass(frozen=True, eq=False)
class HalvesTest:
    """Differences between two calibrations, of every other frame, or landmark, each.

    Attributes:
        rotation, position: (C,) between the poses of each camera relative to the first, radians and units.
        projection_px: (C,) rms difference between the projections of the board's places, seen from each camera, pixels;
            rotations of the camera that a shift of its principal point compensates do not matter; NaN without a board.
        ratio: (C,) squared difference of lens and pose relative to its covariance, per unknown; 1 is expected.
        is_significant: (C,) whether it exceeds the chi-squared bound at a probability of 0.001.
    """

    rotation: FloatArray
    position: FloatArray
    projection_px: FloatArray
    ratio: FloatArray
    is_significant: FloatArray


@dataclass(frozen=True, eq=False)
class Coverage:
    """Where in its image a camera saw the board, or the object, in cells.

    Attributes:
        counts: (rows, columns) number of points used.
        rms_px: (rows, columns) rms residual of two coordinates, pixels; NaN without any.
        tilt: largest angle between the board's normal and the line of sight, radians; NaN without a board.
    """

    counts: IntArray
    rms_px: FloatArray
    tilt: float

    @property
    def share(self) -> float:
        """Share of the cells that have points."""
        return float((self.counts > 0).mean())


def measure_cells(pixels: FloatArray, squares: FloatArray, size: tuple[int, int]) -> tuple[IntArray, FloatArray]:
    """Return `counts` and `rms_px` of `Coverage`.

    Args:
        pixels: (n, 2) points in an image.
        squares: (n,) squared residuals, two coordinates together.
        size: (width, height) of the image.
    """
    cells = (pixels / np.array(size) * GRID).astype(int).clip(0, np.array(GRID) - 1)
    flat = cells[:, 1] * GRID[0] + cells[:, 0]
    counts = np.bincount(flat, minlength=GRID[0] * GRID[1])
    sums = np.bincount(flat, squares, minlength=len(counts))
    rms = np.sqrt(np.where(counts > 0, sums / np.maximum(counts, 1), np.nan))
    return counts.reshape(GRID[::-1]), rms.reshape(GRID[::-1])
