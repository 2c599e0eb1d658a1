"""Per-camera parameters of the bundle adjustment and their joint Gaussian prior.

Time offsets, surface depths and calibration corrections are parameters that each camera has once for all frames, so
their errors do not average out over frames or landmarks. They are written as mean + basis z with z standard normal;
directions outside the range of `basis` are not free. The bundle adjustment solves for z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import helmert

from sylpose.bundle_adjustment.kernels import DEPTH, ROTATION, TIME_OFFSET
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray

# Depth of the visible surface of an ordinary body in front of its center; its standard deviation common to all cameras
# (the center and the shape are unknown) and per camera; in radii (measured: docs/history/benchmarks.md, "Slides").
MEAN_DEPTH_RADII, COMMON_DEPTH_SD_RADII, OWN_DEPTH_SD_RADII = 0.5, 0.4, 0.3
# Standard deviation of its slope in any direction: 60 degrees (choice).
SLOPE_SD = 1.7


@dataclass(frozen=True, eq=False)
class CameraParameters:
    """Prior of the parameters that C cameras have once for all frames.

    Attributes:
        mean: (C, K), columns as in `kernels`.
        basis: (C, K, k) the parameters are mean + basis z, z standard normal.
        n_offsets: number of time offsets, which are the first elements of z; the next C are the surfaces' depths.
        is_calibration: (k,) mask of the calibration errors in z, without the poses of moved cameras.
        scale: their scale relative to the initial prior.
        fixed: (k,) fixed elements of z: their uncertainty is only in the covariance.
    """

    mean: FloatArray
    basis: FloatArray
    n_offsets: int
    is_calibration: BoolArray
    scale: float
    fixed: BoolArray

    def evaluate(self, z: FloatArray) -> FloatArray:
        """Return (C, K) parameters."""
        return np.asarray(self.mean + self.basis @ z)

    @property
    def depth_mask(self) -> BoolArray:
        """(k,) mask of the surfaces' depths in z."""
        k = np.arange(self.basis.shape[2]) - self.n_offsets
        return (k >= 0) & (k < len(self.mean))

    @property
    def flat_basis(self) -> FloatArray:
        """(C K, k) `basis` as a matrix."""
        return self.basis.reshape(-1, self.basis.shape[2])


def default_depth_prior(radius: float, n_cameras: int) -> tuple[FloatArray, FloatArray]:
    """Return mean (C,) and covariance (C, C) of the depth of the observed surfaces in front of the object's origin."""
    covariance = COMMON_DEPTH_SD_RADII**2 * np.ones((n_cameras, n_cameras)) + OWN_DEPTH_SD_RADII**2 * np.eye(n_cameras)
    return np.full(n_cameras, MEAN_DEPTH_RADII * radius), radius**2 * covariance


def compute_depth_basis(
    points: FloatArray, centers: FloatArray, axes: FloatArray, max_offset: float
) -> tuple[FloatArray, FloatArray]:
    """Return the basis in which the depths of points (m, 3) on a camera's surface are linear.

    All in the object's frame.

    Args:
        centers: (m, 3) of the camera when it observes each.
        axes: (m, 2, 3) its x and y axis.
        max_offset: limit of the lateral offsets.

    Returns:
        (m, 3) unit vectors from the origin towards the camera; (m, 3) 1 and each point's offset to the right of the
        origin and below it.
    """
    directions = centers / np.linalg.norm(centers, axis=1, keepdims=True)
    lateral_axes = axes - np.einsum("mki,mi->mk", axes, directions)[..., None] * directions[:, None]
    offset = np.clip(np.einsum("mki,mi->mk", lateral_axes, points), -max_offset, max_offset)
    return directions, np.column_stack([np.ones(len(points)), offset])


def make_camera_parameters(
    n_cameras: int, offsets_sd: float | None, used: IntArray, depth: ArrayLike, covariance: ArrayLike
) -> CameraParameters:
    """Return the prior of time offsets, if estimated, and of all cameras' surface depths.

    The time offsets of the used cameras have mean 0.

    Args:
        offsets_sd: seconds, of each; None: not estimated.
        depth, covariance: (C,) and (C, C) as of `default_depth_prior`.

    Raises:
        ValueError: a covariance that is not positive definite.
    """
    basis = helmert(len(used)).T if offsets_sd is not None and len(used) > 1 else np.zeros((len(used), 0))
    n = basis.shape[1]
    mean, parameter_basis = np.zeros((n_cameras, ROTATION)), np.zeros((n_cameras, ROTATION, n + 3 * n_cameras))
    parameter_basis[used, TIME_OFFSET, :n] = basis * (offsets_sd or 0.0)
    mean[:, DEPTH] = depth
    try:
        parameter_basis[:, DEPTH, n : n + n_cameras] = np.linalg.cholesky(np.asarray(covariance, float))
    except np.linalg.LinAlgError:
        raise ValueError("depth_prior: the covariance is not positive definite") from None
    for j in (1, 2):
        parameter_basis[:, DEPTH + j, n + j * n_cameras : n + (j + 1) * n_cameras] = SLOPE_SD * np.eye(n_cameras)
    k = parameter_basis.shape[2]
    return CameraParameters(mean, parameter_basis, n, np.zeros(k, bool), 1.0, np.zeros(k, bool))
