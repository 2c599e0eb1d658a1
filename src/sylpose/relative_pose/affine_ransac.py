"""RANSAC on the affine epipolar constraint: the matches of one camera that can belong to one rigid motion."""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky_solve, compute_median, kernel, leaf
from sylpose.geometry.robust_loss import SIGMA_OF_MEDIAN, SIGNIFICANCE, bisquare
from sylpose.relative_pose.limits import HALF_DIGITS, MAX_SAMPLES, MIN_SHARE

# Distance from the affine epipolar constraint that perspective and noise explain, pixels (choice).
SEED_THRESHOLD_PX = 1.0
# Maximum number of quadruples: one has only inliers, but once in a thousand times, if the least share agrees (derived).
N_QUADRUPLES = int(np.ceil(np.log(SIGNIFICANCE) / np.log1p(-(MIN_SHARE**4))))
# The same random quadruples each time (derived).
QUADRUPLES = np.random.default_rng(0).random((N_QUADRUPLES, 4))
# Cutoff of the deviation from an affine map along the epipolar line, in standard deviations of the bulk (choice).
ALONG_CUTOFF = 6.0


@kernel
def find_inliers(x: FloatArray, y: FloatArray, threshold: float, picks: FloatArray, weights: FloatArray) -> float:
    """Find the matches of one camera that fit one affine epipolar constraint.

    Under weak perspective the joint points (x1, x2, y1, y2) of a rigid motion are on a hyperplane of the 4D space,
    which four of them determine. RANSAC over such quadruples, scored by truncated squares, is followed by two refits to
    the inliers. Inliers that are far from all others along the epipolar line are then removed.

    Args:
        x, y: (n, 2) points in the two frames.
        threshold: largest distance to the hyperplane, same units.
        picks: (h, 4) in [0, 1), select the quadruples: at most h, fewer once a better one has become unlikely.
        weights: (n,) become 1 or 0; all 1 for fewer than 6 matches, which a hyperplane cannot contradict.

    Returns:
        the inliers' rms distance to the hyperplane, corrected for its four unknowns; 0 for fewer than six matches.

    Source: the affine epipolar constraint, Shapiro, Zisserman, Brady 1995; Hartley & Zisserman, section 14.3.
    """
    n = x.shape[0]
    for i in range(n):
        weights[i] = 1.0
    if n < 6:
        return 0.0
    # Center the points for numerical accuracy.
    joint, mean = np.empty((n, 4)), np.zeros(4)
    for i in range(n):
        for a in range(2):
            joint[i, a], joint[i, 2 + a] = x[i, a], y[i, a]
        for a in range(4):
            mean[a] += joint[i, a] / n
    scale = 0.0
    for i in range(n):
        for a in range(4):
            joint[i, a] -= mean[a]
            scale = max(scale, abs(joint[i, a]))
    if not scale > 0.0:
        return 0.0
    normal, best = np.zeros(4), np.zeros(5)
    best_score, needed, drawn = np.inf, float(picks.shape[0]), 0
    edge = np.empty((3, 4))
    while drawn < min(needed, picks.shape[0]):
        q0 = int(picks[drawn, 0] * n)
        for k in range(3):
            qk = int(picks[drawn, k + 1] * n)
            for a in range(4):
                edge[k, a] = joint[qk, a] - joint[q0, a]
        drawn += 1
        length = _compute_normal(edge, normal)
        if not length > 1e-12 * scale**3:
            continue
        offset = 0.0
        for a in range(4):
            normal[a] /= length
            offset += normal[a] * joint[q0, a]
        score, share = _score_hyperplane(joint, normal, offset, threshold, best_score)
        if score < best_score:
            best_score = score
            best[:4] = normal
            best[4] = offset
            share = min(max(share, 1e-2), 0.999)
            # It is unlikely that no quadruple of inliers was drawn.
            needed = min(needed, max(10.0, np.log(SIGNIFICANCE) / np.log(1.0 - share**4)))
    if not best_score < np.inf:
        return 0.0
    rms = 0.0
    for refit in range(3):
        count = 0
        for i in range(n):
            distance = -best[4]
            for a in range(4):
                distance += best[a] * joint[i, a]
            weights[i] = 1.0 if abs(distance) <= threshold else 0.0
            count += abs(distance) <= threshold
        if refit == 2 or count < 6:
            break
        rms = _fit_hyperplane(joint, weights, best)
    _drop_outliers_along_line(joint, weights, best)
    return float(rms)


@leaf
def _compute_normal(edge: FloatArray, normal: FloatArray) -> float:
    """Set the normal (4,) of three vectors in 4D, the rows of edge (3, 4): its cofactors; return its length."""
    length = 0.0
    for a in range(4):
        b, c, d = (a + 1) % 4, (a + 2) % 4, (a + 3) % 4
        first = edge[0, b] * (edge[1, c] * edge[2, d] - edge[1, d] * edge[2, c])
        second = edge[0, c] * (edge[1, b] * edge[2, d] - edge[1, d] * edge[2, b])
        normal[a] = first - second + edge[0, d] * (edge[1, b] * edge[2, c] - edge[1, c] * edge[2, b])
        if a % 2 == 1:
            normal[a] = -normal[a]
        length += normal[a] ** 2
    return float(np.sqrt(length))


@leaf
def _score_hyperplane(
    joint: FloatArray, normal: FloatArray, offset: float, threshold: float, best_score: float
) -> tuple[float, float]:
    """Return the truncated squares of some points, the sum up to the best score, and the share of inliers."""
    score, inside, scored, n = 0.0, 0, 0, joint.shape[0]
    for i in range(0, n, max(1, n // MAX_SAMPLES)):
        distance = -offset
        for a in range(4):
            distance += normal[a] * joint[i, a]
        ratio = (distance / threshold) ** 2
        scored += 1
        if ratio < 1.0:
            inside += 1
            score += ratio
        else:
            score += 1.0
        if score >= best_score:
            break
    return score, inside / scored


@kernel
def _fit_hyperplane(joint: FloatArray, weights: FloatArray, plane: FloatArray) -> float:
    """Fit the least-squares hyperplane plane (5,) to the weighted points; return their rms distance."""
    mean, cov, total = np.zeros(4), np.zeros((4, 4)), 0.0
    for i in range(joint.shape[0]):
        if weights[i] > 0.0:
            total += 1.0
            for a in range(4):
                mean[a] += joint[i, a]
    for a in range(4):
        mean[a] /= total
    for i in range(joint.shape[0]):
        if weights[i] > 0.0:
            for a in range(4):
                for b in range(4):
                    cov[a, b] += (joint[i, a] - mean[a]) * (joint[i, b] - mean[b])
    trace = cov[0, 0] + cov[1, 1] + cov[2, 2] + cov[3, 3]
    # Inverse iteration from the current plane: the smallest axis is at least ten times shorter than the others.
    normal, work = plane[:4].copy(), np.empty((4, 4))
    for _ in range(6):
        for a in range(4):
            for b in range(4):
                work[a, b] = cov[a, b]
            work[a, a] += 1e-12 * trace
        if not cholesky_solve(work, normal):
            return 0.0
        length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2 + normal[3] ** 2)
        for a in range(4):
            normal[a] /= length
    squares = 0.0
    plane[4] = 0.0
    for a in range(4):
        plane[a] = normal[a]
        plane[4] += normal[a] * mean[a]
        for b in range(4):
            squares += normal[a] * cov[a, b] * normal[b]
    return float(np.sqrt(max(squares, 0.0) / max(total - 4.0, 1.0)))


@kernel
def _drop_outliers_along_line(joint: FloatArray, weights: FloatArray, plane: FloatArray) -> None:
    """Reject matches that deviate much more than the others from an affine map of x, along the epipolar line.

    The hyperplane accepts a mismatch that is on its epipolar line by chance, but depths on one object are similar.
    """
    n = joint.shape[0]
    length = np.sqrt(plane[2] ** 2 + plane[3] ** 2)
    if not length > 1e-3:
        return
    b0, b1 = -plane[3] / length, plane[2] / length
    along, kept = np.empty(n), weights.copy()
    work, solution, sizes = np.empty((3, 3)), np.empty(3), np.empty(n)
    for _ in range(4):
        work[:] = 0.0
        solution[:] = 0.0
        for i in range(n):
            if kept[i] > 0.0:
                along[i] = b0 * joint[i, 2] + b1 * joint[i, 3]
                row = (1.0, joint[i, 0], joint[i, 1])
                for a in range(3):
                    solution[a] += kept[i] * row[a] * along[i]
                    for b in range(3):
                        work[a, b] += kept[i] * row[a] * row[b]
        for a in range(3):
            work[a, a] *= 1.0 + HALF_DIGITS
        if not cholesky_solve(work, solution):
            return
        count = 0
        for i in range(n):
            if weights[i] > 0.0:
                along[i] = b0 * joint[i, 2] + b1 * joint[i, 3]
                along[i] -= solution[0] + solution[1] * joint[i, 0] + solution[2] * joint[i, 1]
                sizes[count] = abs(along[i])
                count += 1
        if count < 8:
            return
        sigma = SIGMA_OF_MEDIAN * compute_median(sizes[:count])
        for i in range(n):
            kept[i] = 0.0
            if weights[i] > 0.0:
                kept[i] = bisquare((along[i] / (ALONG_CUTOFF * sigma + 1e-300)) ** 2)
    for i in range(n):
        weights[i] = 1.0 if kept[i] > 0.0 else 0.0
