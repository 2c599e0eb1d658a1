"""Small matrices: products and transposes of stacks, rotations, covariances of information."""

from __future__ import annotations

from math import isqrt

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, symmetric_eigen
from sylpose.geometry.validation import finite, real

__all__ = [
    "carried",
    "checked_rotation",
    "checked_rotations",
    "covariance_of",
    "forget",
    "kron",
    "symmetric_of",
    "transpose",
    "turn_to",
    "upper_of",
]


def kron(a: FloatArray, b: FloatArray) -> FloatArray:
    """Kronecker product over the last two axes, leading axes broadcast."""
    out = a[..., :, None, :, None] * b[..., None, :, None, :]
    rows, columns = a.shape[-2] * b.shape[-2], a.shape[-1] * b.shape[-1]
    return np.asarray(out.reshape(*out.shape[:-4], rows, columns))


def transpose(a: FloatArray) -> FloatArray:
    """Of the last two axes."""
    return a.swapaxes(-1, -2)


def carried(covariance: FloatArray, by: FloatArray) -> FloatArray:
    """The covariance (n, n) of what is `by` (n, n) times as much; an infinite variance makes each infinite that has a part
    in it."""
    unknown = ~np.isfinite(np.diag(covariance))
    known = np.where(unknown | unknown[:, None], 0.0, covariance)
    out = by @ known @ by.T
    lost = (np.abs(by[:, unknown]) > 1e-12).any(axis=1)
    out[lost] = out[:, lost] = 0.0
    out[lost, lost] = np.inf
    return np.asarray(out)


def checked_rotations(rotations: ArrayLike, n: int, name: str = "rotations") -> FloatArray:
    """(n, 3, 3) rotation matrices, or a ValueError that says which is none."""
    out = real(rotations, "(C, 3, 3)", name)
    if out.ndim != 3 or out.shape[1:] != (3, 3) or len(out) != n or n == 0:
        raise ValueError(f"{name} must be (C, 3, 3) for C = {n} moments, C >= 1; got shape {out.shape}")
    # No entry of a rotation is beyond 1.
    sane = np.where((np.abs(out) < 2.0).all(axis=(1, 2), keepdims=True), out, 0)
    off = np.abs(sane @ transpose(sane) - np.eye(3)).max(axis=(1, 2)) > 1e-6
    wrong = off | (np.linalg.det(np.where(off[:, None, None], np.eye(3), sane)) < 0)
    if wrong.any():
        raise ValueError(f"{name}[{int(np.argmax(wrong))}] is not a rotation matrix")
    return out


def checked_rotation(rotation: ArrayLike, name: str = "rotation") -> FloatArray:
    """(3, 3) a rotation matrix, or a ValueError that names the argument."""
    out = finite(rotation, (3, 3), name)
    if np.abs(out).max() > 2.0 or np.abs(out @ out.T - np.eye(3)).max() > 1e-6 or np.linalg.det(out) < 0:
        raise ValueError(f"{name} is not a rotation matrix")
    return out


def upper_of(matrix: FloatArray) -> FloatArray:
    """(n (n + 1) / 2,) the upper triangle of a matrix (n, n), row by row."""
    return np.asarray(matrix[np.triu_indices(len(matrix))])


def symmetric_of(upper: FloatArray) -> FloatArray:
    """(n, n) the inverse of `upper_of`, for symmetric matrices."""
    n = (isqrt(8 * len(upper) + 1) - 1) // 2
    matrix, at = np.empty((n, n)), np.triu_indices(n)
    matrix[at] = matrix.T[at] = upper
    return matrix


def turn_to(x: FloatArray) -> FloatArray:
    """(..., 2) normalised points -> (..., 3, 3) the least rotations that take their rays to the z axis."""
    u = np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)
    u /= np.sqrt((u * u).sum(axis=-1, keepdims=True))
    T = np.empty((*u.shape, 3))
    T[..., :2, :2] = np.eye(2) - u[..., :2, None] * u[..., None, :2] / (1 + u[..., 2, None, None])
    T[..., :2, 2] = -u[..., :2]
    T[..., 2, :] = u
    return T


def forget(information: FloatArray, direction: FloatArray) -> FloatArray:
    """Information (6, 6) less all that it says of one direction (6,)."""
    along = information @ direction
    known = float(direction @ along)
    # Nothing is known of it already, up to rounding.
    if known <= 1e-12 * float(direction**2 @ np.diag(information)):
        return information
    return np.asarray(information - np.outer(along, along) / known)


def covariance_of(information: FloatArray) -> FloatArray:
    """The inverse (n, n), with infinite variance in directions that the information knows nothing of.

    Turns and displacements have different units, so it is scaled to a unit diagonal before its rank is
    judged. Infinite variances stand on the diagonal; the covariances of such directions are 0.
    """
    covariance = np.empty(information.shape)
    _invert(np.ascontiguousarray(information, dtype=float), covariance)
    return covariance


@kernel
def _invert(information: FloatArray, covariance: FloatArray) -> None:
    """covariance (n, n) becomes `covariance_of`."""
    n = len(information)
    scale, scaled, values, vectors = np.empty(n), np.empty((n, n)), np.empty(n), np.empty((n, n))
    for i in range(n):
        scale[i] = 1.0 / np.sqrt(max(information[i, i], 1e-300))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * scale[i] * scale[j]
    symmetric_eigen(scaled, values, vectors)
    covariance[:] = 0.0
    least = 1e-10 * max(values[n - 1], 1e-300)
    for k in range(n):
        if values[k] > least:
            for i in range(n):
                for j in range(n):
                    covariance[i, j] += vectors[i, k] * scale[i] * vectors[j, k] * scale[j] / values[k]
    for i in range(n):
        unknown = False
        for k in range(n):
            unknown = unknown or (not values[k] > least and abs(vectors[i, k]) > 1e-3)
        if unknown:
            covariance[i, :], covariance[:, i] = 0.0, 0.0
            covariance[i, i] = np.inf
