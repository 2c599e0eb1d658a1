"""Small matrices: stacked products, rotations, and conversion between information and covariance."""

from __future__ import annotations

from math import isqrt

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, symmetric_eigen
from sylpose.geometry.validation import check_finite, check_real

__all__ = [
    "check_rotation",
    "check_rotations",
    "invert_information",
    "kron",
    "pack_upper",
    "propagate_covariance",
    "remove_direction",
    "rotation_to_z_axis",
    "transpose",
    "unpack_symmetric",
]


def kron(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the Kronecker product over the last two axes, leading axes broadcast."""
    out = a[..., :, None, :, None] * b[..., None, :, None, :]
    rows, columns = a.shape[-2] * b.shape[-2], a.shape[-1] * b.shape[-1]
    return np.asarray(out.reshape(*out.shape[:-4], rows, columns))


def transpose(a: FloatArray) -> FloatArray:
    """Transpose the last two axes."""
    return a.swapaxes(-1, -2)


def propagate_covariance(covariance: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Propagate a covariance (n, n) by a Jacobian (n, n).

    Combinations with infinite variances become infinite.
    """
    unknown = ~np.isfinite(np.diag(covariance))
    finite_part = np.where(unknown | unknown[:, None], 0.0, covariance)
    out = jacobian @ finite_part @ jacobian.T
    is_unbounded = (np.abs(jacobian[:, unknown]) > 1e-12).any(axis=1)
    out[is_unbounded] = out[:, is_unbounded] = 0.0
    out[is_unbounded, is_unbounded] = np.inf
    return np.asarray(out)


def check_rotations(rotations: ArrayLike, n: int, name: str = "rotations") -> FloatArray:
    """Return (n, 3, 3) rotation matrices, checked.

    Raises:
        ValueError: naming the first matrix that is not a rotation.
    """
    out = check_real(rotations, "(C, 3, 3)", name)
    if out.ndim != 3 or out.shape[1:] != (3, 3) or len(out) != n or n == 0:
        raise ValueError(f"{name} must be (C, 3, 3) for C = {n} moments, C >= 1; got shape {out.shape}")
    # Entries of a rotation are at most 1 in magnitude.
    bounded = np.where((np.abs(out) < 2.0).all(axis=(1, 2), keepdims=True), out, 0)
    off = np.abs(bounded @ transpose(bounded) - np.eye(3)).max(axis=(1, 2)) > 1e-6
    wrong = off | (np.linalg.det(np.where(off[:, None, None], np.eye(3), bounded)) < 0)
    if wrong.any():
        raise ValueError(f"{name}[{int(np.argmax(wrong))}] is not a rotation matrix")
    return out


def check_rotation(rotation: ArrayLike, name: str = "rotation") -> FloatArray:
    """Return a (3, 3) rotation matrix, checked.

    Raises:
        ValueError: naming the argument.
    """
    out = check_finite(rotation, (3, 3), name)
    if np.abs(out).max() > 2.0 or np.abs(out @ out.T - np.eye(3)).max() > 1e-6 or np.linalg.det(out) < 0:
        raise ValueError(f"{name} is not a rotation matrix")
    return out


def pack_upper(matrix: FloatArray) -> FloatArray:
    """Return (n (n + 1) / 2,) the upper triangle of a matrix (n, n), row by row."""
    return np.asarray(matrix[np.triu_indices(len(matrix))])


def unpack_symmetric(upper: FloatArray) -> FloatArray:
    """Return the symmetric matrix (n, n) of an upper triangle: the inverse of `pack_upper`."""
    n = (isqrt(8 * len(upper) + 1) - 1) // 2
    matrix, indices = np.empty((n, n)), np.triu_indices(n)
    matrix[indices] = matrix.T[indices] = upper
    return matrix


def rotation_to_z_axis(x: FloatArray) -> FloatArray:
    """Return (..., 3, 3) smallest rotations that take the rays of normalized points (..., 2) to the z axis."""
    u = np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)
    u /= np.sqrt((u * u).sum(axis=-1, keepdims=True))
    T = np.empty((*u.shape, 3))
    T[..., :2, :2] = np.eye(2) - u[..., :2, None] * u[..., None, :2] / (1 + u[..., 2, None, None])
    T[..., :2, 2] = -u[..., :2]
    T[..., 2, :] = u
    return T


def remove_direction(information: FloatArray, direction: FloatArray) -> FloatArray:
    """Return information (6, 6) without the information on one direction (6,)."""
    projection = information @ direction
    projected_information = float(direction @ projection)
    # Already without information on it, up to rounding.
    if projected_information <= 1e-12 * float(direction**2 @ np.diag(information)):
        return information
    return np.asarray(information - np.outer(projection, projection) / projected_information)


def invert_information(information: FloatArray) -> FloatArray:
    """Return the inverse (n, n) of an information matrix, with infinite variance in unobservable directions.

    Rotations and translations have different units, so it is scaled to a unit diagonal before its rank is determined.
    Infinite variances are on the diagonal; their covariances are 0.
    """
    covariance = np.empty(information.shape)
    _invert_information(np.ascontiguousarray(information, dtype=float), covariance)
    return covariance


@kernel
def _invert_information(information: FloatArray, covariance: FloatArray) -> None:
    """Write `invert_information` to covariance (n, n)."""
    n = len(information)
    scale, scaled, values, vectors = np.empty(n), np.empty((n, n)), np.empty(n), np.empty((n, n))
    for i in range(n):
        scale[i] = 1.0 / np.sqrt(max(information[i, i], 1e-300))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * scale[i] * scale[j]
    symmetric_eigen(scaled, values, vectors)
    covariance[:] = 0.0
    threshold = 1e-10 * max(values[n - 1], 1e-300)
    for k in range(n):
        if values[k] > threshold:
            for i in range(n):
                for j in range(n):
                    covariance[i, j] += vectors[i, k] * scale[i] * vectors[j, k] * scale[j] / values[k]
    for i in range(n):
        unknown = False
        for k in range(n):
            unknown = unknown or (not values[k] > threshold and abs(vectors[i, k]) > 1e-3)
        if unknown:
            covariance[i, :], covariance[:, i] = 0.0, 0.0
            covariance[i, i] = np.inf
