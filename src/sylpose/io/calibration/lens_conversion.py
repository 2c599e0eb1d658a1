"""Fit of an OpenCV camera model to another lens model, accepted if the difference is negligible."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.lens_distortion import N_TERMS as ALL_TERMS
from sylpose.geometry.lens_distortion import project_points
from sylpose.io.calibration.camera_builder import intrinsic_matrix

# Largest accepted difference anywhere in the image, pixels: a fifth of the noise of the best features (choice).
MAX_LENS_ERROR_PX = 0.02
# Number of fitted distortion terms, k1 k2 p1 p2 k3 k4 k5 k6, in addition to fx fy cx cy; grid points per side for the
# fit (choice).
FITTED_TERMS, GRID_SIDE = 8, 16
# Maximum number of function evaluations (choice: twice what polynomial lenses need).
MAX_EVALUATIONS = 200


class FittedLens(NamedTuple):
    """Fitted camera: (3, 3) matrix and (8,) terms of OpenCV's standard model."""

    matrix: FloatArray
    distortion: FloatArray


def fit_lens(normalized: FloatArray, pixels: FloatArray, matrix: FloatArray, where: str) -> FittedLens:
    """Fit OpenCV's camera model to point correspondences of another model.

    Args:
        normalized: (n, 2) points on the plane z = 1.
        pixels: (n, 2) their projections by the other model.
        matrix: (3, 3) initial intrinsic matrix.
        where: prefix of the messages.

    Raises:
        ValueError: beginning with `where`; no OpenCV model fits to within `MAX_LENS_ERROR_PX`.
    """
    error = ValueError(f"{where}: its lens model is not valid in the whole image")
    if len(normalized) < GRID_SIDE or not np.isfinite(normalized).all() or not np.isfinite(pixels).all():
        raise error
    points = np.column_stack([normalized, np.ones(len(normalized))])
    focal = float(matrix[0, 0])
    terms, projections = np.zeros(ALL_TERMS), np.empty((len(points), 2))

    def compute_residuals(unknowns: FloatArray) -> FloatArray:
        """Compute residuals in focal lengths, clipped to a finite range."""
        terms[:FITTED_TERMS] = unknowns[4:]
        with np.errstate(all="ignore"):
            project_points(points, np.eye(3), np.zeros(3), intrinsic_matrix(*focal * unknowns[:4]), terms, projections)
            gap = (projections - pixels) / focal
        return np.clip(np.nan_to_num(gap, nan=1e3), -1e3, 1e3).ravel()

    start = np.concatenate([matrix[[0, 1, 0, 1], [0, 1, 2, 2]] / focal, np.zeros(FITTED_TERMS)])
    # k1 k2 p1 p2 k3 are linear: their least-squares solution is the initial value.
    initial_residuals = compute_residuals(start)
    jacobian = np.column_stack(
        [compute_residuals(start + np.eye(len(start))[4 + i]) - initial_residuals for i in range(5)]
    )
    start[4:9] = np.linalg.lstsq(jacobian, -initial_residuals, rcond=None)[0]
    found = least_squares(
        compute_residuals, start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=MAX_EVALUATIONS
    ).x
    worst = focal * float(np.linalg.norm(compute_residuals(found).reshape(-1, 2), axis=1).max())
    if not worst <= MAX_LENS_ERROR_PX:
        raise ValueError(
            f"{where}: none of OpenCV's lens models matches its lens: the nearest one "
            f"deviates by up to {worst:.2g} pixels"
        )
    return FittedLens(intrinsic_matrix(*focal * found[:4]), np.asarray(found[4:]))


def sample_image_grid(size: tuple[int, int], margin: float = 0.0) -> FloatArray:
    """Return (GRID², 2) pixels that cover an image and a margin around it, given as a fraction of its sides."""
    u, v = (np.linspace(-margin * (side - 1), (1 + margin) * (side - 1), GRID_SIDE) for side in size)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
