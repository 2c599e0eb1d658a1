"""How much cameras would rather have a motion of their own: whether any is to be asked.

Under weak perspective the inliers of one camera lie near a hyperplane of (x, y), whatever its calibration (`seeds`). How
much worse the common motion fits them than their own hyperplane does tells, at any level of noise, that a camera disagrees
with the rest.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel, symmetric_eigen
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX

__all__ = ["ENOUGH", "REJECTED", "UNKNOWNS", "at_ease", "by_chance", "strain", "too_much"]

# Unknowns of a hyperplane, and inliers that tell something of it, at least (choice).
UNKNOWNS, ENOUGH = 4, 8
# Cameras are asked once one is strained by more than the first, or all together by more than the second: four unknowns each
# (measured: docs/benchmarks.md#hard-pairs, 3 % of rigs of four without a fault exceed 22).
STRAINED, STRAINED_TOGETHER = 16.0, 26.0
# Two variances are taken for one where their ratio exceeds 1 by no more than this over the root of the number (choice).
SCATTER = 6.5
# A camera of whose matches no more than this share are inliers was rejected as a whole (choice).
REJECTED = 0.2


@kernel
def at_ease(
    x: FloatArray, y: FloatArray, offsets: IntArray, weights: FloatArray, residuals: FloatArray, focal: FloatArray
) -> bool:
    """Whether no term (T of them, N matches) is strained or was rejected, so that nobody need be asked."""
    strains = np.empty(len(focal))
    for t in range(len(focal)):
        first, last = offsets[t], offsets[t + 1]
        inliers = 0
        for i in range(first, last):
            inliers += weights[i] > 0.0
        if last - first >= ENOUGH and inliers <= REJECTED * (last - first):
            return False
        strains[t] = strain(x[first:last], y[first:last], weights[first:last], residuals[first:last], focal[t])
    return not too_much(strains)


@kernel
def too_much(strains: FloatArray) -> bool:
    """Whether a camera of those with strains (T,) is strained, or all are together."""
    most, together = -np.inf, 0.0
    for t in range(len(strains)):
        most, together = max(most, strains[t]), together + max(strains[t], 0.0)
    return most >= STRAINED + by_chance(len(strains)) or together >= STRAINED_TOGETHER * max(len(strains) / 4.0, 1.0)


@kernel
def by_chance(cameras: int) -> float:
    """By how much more the most strained of so many cameras is strained by chance than one of four."""
    return float(2.0 * np.log(max(cameras / 4.0, 1.0)))


@kernel
def strain(x: FloatArray, y: FloatArray, weights: FloatArray, residuals: FloatArray, focal: float) -> float:
    """How much a camera's inliers would rather have a motion of their own: twice the logarithm of the likelihood ratio of
    their own hyperplane, their noise unknown, to the fit. Below 0 where perspective bends the hyperplane by more than the
    fit is off; 0 where there are too few inliers.
    """
    count, mass, squares, least, second = _sums(x, y, weights, residuals)
    if count < ENOUGH:
        return 0.0
    # Without parallax both are noise, and the least of them is less than that.
    own = second if second < (1.0 + SCATTER / np.sqrt(count)) * least else least
    floor = mass * SIGMA_FLOOR_PX**2
    return float((count - UNKNOWNS) * np.log(max(squares, floor) / max(focal * focal * own, floor)))


@kernel
def _sums(
    x: FloatArray, y: FloatArray, weights: FloatArray, residuals: FloatArray
) -> tuple[int, float, float, float, float]:
    """Of the inliers their number, weight and squared residuals, and the least two eigenvalues of the scatter of (x, y)."""
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
