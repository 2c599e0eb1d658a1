"""Rotations of single poses as arrays: what a frame asks for dozens of times, in a tenth of the time of SciPy's checks."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import rotvec_of

__all__ = ["rotvec", "turn_between", "turn_of"]


def turn_of(pose: RigidTransform) -> FloatArray:
    """(3, 3) rotation matrix of a single pose."""
    return np.asarray(pose.as_matrix()[:3, :3])


def rotvec(rotation: FloatArray) -> FloatArray:
    """(3,) rotation vector of a rotation matrix (3, 3)."""
    out = np.empty(3)
    rotvec_of(rotation, out)
    return out


def turn_between(before: RigidTransform, after: RigidTransform) -> FloatArray:
    """(3,) rotation vector w with R of `after` = exp(w) R of `before`."""
    return rotvec(turn_of(after) @ turn_of(before).T)
