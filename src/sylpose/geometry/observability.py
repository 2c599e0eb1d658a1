"""Unobservable directions of an estimate: those whose standard deviation exceeds a limit.

The limits of each estimator and their reasons: docs/conventions.md, "Limits".
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray

__all__ = [
    "OBSERVABLE_ROTATION_SD",
    "UNOBSERVABLE_RATIO",
    "UNOBSERVABLE_ROTATION_SD",
    "find_unobservable_directions",
    "has_rotation_direction",
]

# A rotation with a larger standard deviation, radians, is unobservable where there is no reference to compare with
# (choice).
UNOBSERVABLE_ROTATION_SD = 0.25
# A motion, rotation or distance with a larger relative standard deviation is unobservable: even its sign is uncertain
# (choice).
UNOBSERVABLE_RATIO = 0.5
# A rotation with a smaller standard deviation, radians, is observable, however small it is: a degree (choice).
OBSERVABLE_ROTATION_SD = float(np.deg2rad(1.0))


def find_unobservable_directions(
    information: FloatArray, limits: FloatArray | float, *, min_ratio: float = 0.0
) -> FloatArray:
    """Return the directions whose standard deviation exceeds the limits.

    Args:
        information: (..., n, n) of n unknowns; several matrices must have the first one's eigenvalues (mirrored
            solutions).
        limits: (n,) in the unknowns' units, or one for all.
        min_ratio: directions with less than this fraction of the largest eigenvalue are unobservable as well: rounding.

    Returns:
        (..., k, n) orthonormal rows in units of the limits: multiplied by `limits`, they are in the unknowns' units.
    """
    in_limits = information * (limits * limits if isinstance(limits, float) else np.outer(limits, limits))
    if information.ndim == 2:
        # Usually all is observable, and no eigenvectors are needed. (A Cholesky factor would be faster still, but it
        # also exists where rounding of the largest eigenvalue hides an unobservable direction.)
        values = np.linalg.eigvalsh(in_limits)
        if values[0] >= max(1.0, min_ratio * values[-1]):
            return np.empty((0, len(in_limits)))
    values, vectors = np.linalg.eigh(in_limits)
    first = values.reshape(-1, values.shape[-1])[0]
    k = int(np.searchsorted(first, max(1.0, min_ratio * first[-1])))
    return vectors[..., :k].swapaxes(-1, -2)


def has_rotation_direction(directions: FloatArray) -> bool:
    """Return whether one of the directions (k, 6) of (w, d) is mostly a rotation.

    The directions are as of `find_unobservable_directions`.
    """
    return bool(np.linalg.norm(directions[:, :3], 2) ** 2 > 0.5)
