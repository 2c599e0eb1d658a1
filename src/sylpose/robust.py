"""Outlier rejection that needs no solution yet, and the weights used once there is one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["affine_epipolar_inliers", "bisquare", "robust_sigma"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def affine_epipolar_inliers(
    x: FloatArray, y: FloatArray, threshold: float, rng: np.random.Generator, *, hypotheses: int = 250
) -> BoolArray:
    """Matches of one camera that fit one affine epipolar constraint.

    Under weak perspective the joint points (x1, x2, y1, y2) of a rigid motion lie on a hyperplane of the 4D space, which
    four of them determine. RANSAC over such quadruples, scored by truncated squares, then two refits to the inliers.

    Args:
        x, y: (n, 2) points in the two frames.
        threshold: largest distance to the hyperplane, same units.
        rng: seeded generator.
        hypotheses: number of quadruples.

    Returns:
        (n,) mask. All True for fewer than 6 matches, which a hyperplane cannot contradict.

    Source: the affine epipolar constraint, Shapiro, Zisserman, Brady 1995; Hartley & Zisserman, section 14.3.
    """
    joint = np.concatenate([x, y], axis=1)
    n = len(joint)
    if n < 6:
        return np.ones(n, dtype=bool)
    picks = rng.random((hypotheses, n)).argpartition(4, axis=1)[:, :4] if n < 40 else _quadruples(n, hypotheses, rng)
    base = joint[picks[:, 0]]
    edges = joint[picks[:, 1:]] - base[:, None]
    # The normal of three vectors in 4D: the cofactors of the 3x4 matrix.
    normals = np.stack([(-1) ** i * np.linalg.det(np.delete(edges, i, axis=2)) for i in range(4)], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(length, 1e-300)
    distance = joint @ normals.T - np.einsum("hi,hi->h", base, normals)
    score = np.minimum((distance / threshold) ** 2, 1.0).sum(axis=0)
    score[length[:, 0] == 0] = np.inf
    inliers = np.abs(distance[:, int(np.argmin(score))]) <= threshold
    for _ in range(2):
        if inliers.sum() < 5:
            break
        mean = joint[inliers].mean(axis=0)
        normal = np.linalg.svd(joint[inliers] - mean, full_matrices=False)[2][-1]
        inliers = np.abs((joint - mean) @ normal) <= threshold
    return np.asarray(inliers)


def _quadruples(n: int, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """(count, 4) indices below n; those that repeat an index give a zero normal and lose."""
    return rng.integers(0, n, (count, 4))


def robust_sigma(residuals: FloatArray, floor: float) -> float:
    """Standard deviation of the bulk of zero-mean residuals (median absolute value), at least `floor`."""
    if len(residuals) == 0:
        return floor
    return max(float(1.4826 * np.median(np.abs(residuals))), floor)


def bisquare(residuals: FloatArray, cutoff: FloatArray | float) -> FloatArray:
    """Tukey's bisquare weights: (1 - (r / cutoff)^2)^2 inside the cutoff, 0 outside."""
    return np.asarray(np.maximum(1.0 - (residuals / cutoff) ** 2, 0.0) ** 2)
