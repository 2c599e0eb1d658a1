"""A camera of OpenCV's models that does what one of another model does, where there is one that does so as well as anybody
could tell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from sylpose.calibration.camera_builder import matrix_of
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.lens_distortion import TERMS as ALL_TERMS
from sylpose.geometry.lens_distortion import projected

__all__ = ["LENS_PX", "Fitted", "fitted_lens", "grid"]

# The largest difference, pixels, anywhere in the image: a fifth of the noise of the best features (choice).
LENS_PX = 0.02
# Of fx fy cx cy and k1 k2 p1 p2 k3 k4 k5 k6; points that the fit is told by are at a grid of so many a side (choice).
TERMS, GRID = 8, 16
# Evaluations (choice: twice what polynomial lenses need).
STEPS = 200


class Fitted(NamedTuple):
    """(3, 3) matrix and (8,) terms of OpenCV's standard model."""

    matrix: FloatArray
    distortion: FloatArray


def fitted_lens(normalized: FloatArray, pixels: FloatArray, matrix: FloatArray, where: str) -> Fitted:
    """The camera with which points come to where another model's sees them.

    Args:
        normalized: (n, 2) points on the plane z = 1.
        pixels: (n, 2) where the other model sees them.
        matrix: (3, 3) what is near to its intrinsic matrix.

    Raises:
        ValueError: beginning with `where`; no camera of OpenCV's comes as near as `LENS_PX`.
    """
    refused = ValueError(f"{where}: its lens does not show all that is in the image")
    if len(normalized) < GRID or not np.isfinite(normalized).all() or not np.isfinite(pixels).all():
        raise refused
    points = np.column_stack([normalized, np.ones(len(normalized))])
    focal = float(matrix[0, 0])
    terms, seen = np.zeros(ALL_TERMS), np.empty((len(points), 2))

    def off(unknowns: FloatArray) -> FloatArray:
        """In focal lengths, bounded."""
        terms[:TERMS] = unknowns[4:]
        with np.errstate(all="ignore"):
            projected(points, np.eye(3), np.zeros(3), matrix_of(*focal * unknowns[:4]), terms, seen)
            gap = (seen - pixels) / focal
        return np.clip(np.nan_to_num(gap, nan=1e3), -1e3, 1e3).ravel()

    start = np.concatenate([matrix[[0, 1, 0, 1], [0, 1, 2, 2]] / focal, np.zeros(TERMS)])
    # k1 k2 p1 p2 k3 are linear, and what the rest begins with.
    none = off(start)
    steps = np.column_stack([off(start + np.eye(len(start))[4 + i]) - none for i in range(5)])
    start[4:9] = np.linalg.lstsq(steps, -none, rcond=None)[0]
    found = least_squares(off, start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=STEPS).x
    worst = focal * float(np.linalg.norm(off(found).reshape(-1, 2), axis=1).max())
    if not worst <= LENS_PX:
        raise ValueError(
            f"{where}: none of OpenCV's lens models, which are all that sylpose has, does what its lens does: the nearest "
            f"is up to {worst:.2g} pixels off"
        )
    return Fitted(matrix_of(*focal * found[:4]), np.asarray(found[4:]))


def grid(size: tuple[int, int], margin: float = 0.0) -> FloatArray:
    """(GRID², 2) pixels all over an image, and a margin beyond it, as a share of its sides."""
    u, v = (np.linspace(-margin * (side - 1), (1 + margin) * (side - 1), GRID) for side in size)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
