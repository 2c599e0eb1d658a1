"""Small matrices: stacked products, rotations, epipolar geometry, and covariance from information."""

from __future__ import annotations

from math import isqrt

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, so3_log, symmetric_eigen

# Squared gradient of a residual y'Ex by its points below which there is no epipolar geometry (choice).
MIN_SQUARED_GRADIENT = 1e-24


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
    compute_covariance(np.ascontiguousarray(information, dtype=float), covariance)
    return covariance


@kernel
def compute_covariance(information: FloatArray, covariance: FloatArray) -> None:
    """Write the inverse of an information matrix to covariance (n, n), as `invert_information` does."""
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


def rotation_matrix_of(pose: RigidTransform) -> FloatArray:
    """Return the (3, 3) rotation matrix of a single pose, in a tenth of the time of SciPy's checked functions."""
    return np.asarray(pose.as_matrix()[:3, :3])


def rotvec(rotation: FloatArray) -> FloatArray:
    """Return the (3,) rotation vector of a rotation matrix (3, 3)."""
    out = np.empty(3)
    so3_log(rotation, out)
    return out


def relative_rotvec(first: RigidTransform, second: RigidTransform) -> FloatArray:
    """Return the (3,) rotation vector w with R of `second` = exp(w) R of `first`."""
    return rotvec(rotation_matrix_of(second) @ rotation_matrix_of(first).T)


def make_motion_about(center: FloatArray, rotation: FloatArray, translation: FloatArray) -> RigidTransform:
    """Return X -> R (X - g) + g + d as a transform; g (3,), R (3, 3), d (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, center + translation - rotation @ center
    # Solvers keep R orthonormal to rounding; normalizing again would take twice as long as the rest of this function.
    return RigidTransform(matrix, normalize=False)


def essential_matrix(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return (..., 3, 3) E = [t]x R of the motion X -> R X + t in the camera's axes: y'E x = 0."""
    return np.asarray(np.cross(np.eye(3), translation[..., None, :]) @ rotation)


def sampson_scale(E: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return (...,) √g, the divisor that turns a residual y'E x into a Sampson distance, with noise in both frames.

    Without any motion the residual vanishes and √g is 1e-12.

    Args:
        E: (..., 3, 3), or one for all.
        x, y: (..., 3) points in the two frames, with a third coordinate of 1.

    Source: Hartley & Zisserman, "Multiple View Geometry", section 11.4.3.
    """
    gradient_y, gradient_x = np.einsum("...ij,...j->...i", E, x), np.einsum("...ji,...j->...i", E, y)
    squared_gradient = (gradient_y[..., :2] ** 2).sum(axis=-1) + (gradient_x[..., :2] ** 2).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(squared_gradient, MIN_SQUARED_GRADIENT)))


def sampson_distance(E: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return (n,) signed Sampson distances of points x, y (n, 2) in the two frames; 0 without epipolar geometry.

    Args:
        E: (3, 3).
        x, y: normalized; the unit of the result.
    """
    before, after = (np.insert(points, 2, 1.0, axis=1) for points in (x, y))
    return np.asarray(np.einsum("ni,ni->n", after, before @ E.T) / sampson_scale(E, before, after))


def enlarge_covariance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) not smaller than either input in any direction.

    Args:
        a: positive definite; enlarged wherever it is smaller than b.
        b: lower bound.
    """
    root = np.linalg.cholesky(a)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    out = root @ vectors @ np.diag(np.maximum(values, 1.0)) @ vectors.T @ root.T
    return np.asarray(0.5 * (out + out.T))
