"""Test whether a camera is inconsistent with the common motion of all cameras.

Under weak perspective the inliers of one camera are near a hyperplane of (x, y), whatever its calibration
(`affine_ransac`). The likelihood ratio between this hyperplane and the common motion measures, at any level of noise,
whether the camera disagrees with the others.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel, symmetric_eigen
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX

__all__ = [
    "HYPERPLANE_UNKNOWNS",
    "MAX_REJECTED_SHARE",
    "MIN_TEST_INLIERS",
    "compute_chance_margin",
    "compute_inconsistency",
    "is_consistent_per_camera",
    "is_inconsistent",
]

# Unknowns of a hyperplane, and the minimum number of inliers for the test (choice).
HYPERPLANE_UNKNOWNS, MIN_TEST_INLIERS = 4, 8
# The cameras are checked if the inconsistency of one exceeds the first value, or the sum over all the second: four
# unknowns each (measured: docs/history/benchmarks.md#hard-pairs, 3 % of rigs of four without a fault exceed 22).
MAX_INCONSISTENCY, MAX_TOTAL_INCONSISTENCY = 16.0, 26.0
# Two variances are equal if their ratio exceeds 1 by at most this over the root of the number (choice).
EIGENVALUE_SCATTER = 6.5
# A camera is rejected as a whole if at most this share of its matches are inliers (choice).
MAX_REJECTED_SHARE = 0.2


@kernel
def is_consistent_per_camera(
    x: FloatArray, y: FloatArray, offsets: IntArray, weights: FloatArray, residuals: FloatArray, focal: FloatArray
) -> bool:
    """Return whether no term is inconsistent or rejected (T terms, N matches).

    No further check is then needed.
    """
    inconsistencies = np.empty(len(focal))
    for t in range(len(focal)):
        first, last = offsets[t], offsets[t + 1]
        inliers = 0
        for i in range(first, last):
            inliers += weights[i] > 0.0
        if last - first >= MIN_TEST_INLIERS and inliers <= MAX_REJECTED_SHARE * (last - first):
            return False
        inconsistencies[t] = compute_inconsistency(
            x[first:last], y[first:last], weights[first:last], residuals[first:last], focal[t]
        )
    return not is_inconsistent(inconsistencies)


@kernel
def is_inconsistent(inconsistencies: FloatArray) -> bool:
    """Return whether one of the inconsistencies (T,), or their sum, exceeds its limit."""
    largest, combined = -np.inf, 0.0
    for t in range(len(inconsistencies)):
        largest, combined = max(largest, inconsistencies[t]), combined + max(inconsistencies[t], 0.0)
    return largest >= MAX_INCONSISTENCY + compute_chance_margin(
        len(inconsistencies)
    ) or combined >= MAX_TOTAL_INCONSISTENCY * max(len(inconsistencies) / 4.0, 1.0)


@kernel
def compute_chance_margin(cameras: int) -> float:
    """Return the expected excess of the largest inconsistency of so many cameras over that of four."""
    return float(2.0 * np.log(max(cameras / 4.0, 1.0)))


@kernel
def compute_inconsistency(
    x: FloatArray, y: FloatArray, weights: FloatArray, residuals: FloatArray, focal: float
) -> float:
    """Return the inconsistency of a camera's inliers with the common fit.

    It is twice the logarithm of the likelihood ratio of their own hyperplane, with unknown noise, to the fit. It is
    negative if perspective bends the hyperplane by more than the error of the fit, and 0 with too few inliers.
    """
    count, mass, squares, least, second = _sum_inliers(x, y, weights, residuals)
    if count < MIN_TEST_INLIERS:
        return 0.0
    # Without parallax both eigenvalues are noise, and the smaller one underestimates it.
    own_variance = second if second < (1.0 + EIGENVALUE_SCATTER / np.sqrt(count)) * least else least
    floor = mass * SIGMA_FLOOR_PX**2
    return float((count - HYPERPLANE_UNKNOWNS) * np.log(max(squares, floor) / max(focal * focal * own_variance, floor)))


@kernel
def _sum_inliers(
    x: FloatArray, y: FloatArray, weights: FloatArray, residuals: FloatArray
) -> tuple[int, float, float, float, float]:
    """Return sums over the inliers.

    Returns:
        number, weight and squared residuals of the inliers, and the two least eigenvalues of the scatter of (x, y).
    """
    count, mass, squares = 0, 0.0, 0.0
    mean, z, joint = np.zeros(4), np.empty(4), np.zeros((4, 4))
    for i in range(len(weights)):
        if weights[i] > 0.0:
            count += 1
            mass += weights[i]
            squares += weights[i] * residuals[i] ** 2
            for a in range(2):
                mean[a] += weights[i] * x[i, a]
                mean[2 + a] += weights[i] * y[i, a]
    if count == 0:
        return 0, 0.0, 0.0, 0.0, 0.0
    for a in range(4):
        mean[a] /= mass
    for i in range(len(weights)):
        if weights[i] > 0.0:
            z[0], z[1], z[2], z[3] = x[i, 0] - mean[0], x[i, 1] - mean[1], y[i, 0] - mean[2], y[i, 1] - mean[3]
            for a in range(4):
                for b in range(a + 1):
                    joint[a, b] += weights[i] * z[a] * z[b]
    for a in range(4):
        for b in range(a):
            joint[b, a] = joint[a, b]
    values, vectors = np.empty(4), np.empty((4, 4))
    symmetric_eigen(joint, values, vectors)
    return count, mass, squares, values[0], values[1]
