"""Outlier rejection: which matches of a camera can belong to one rigid motion, and the weights used once there is one."""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky_solve, kernel, median_of
from sylpose.geometry.robust_loss import SIGMA_OF_MEDIAN, bisquare

__all__ = ["hyperplane_inliers"]


# Matches that hypotheses are scored on, at most: enough to tell them apart, and the cost stays bounded (choice).
SCORED = 256
# Chance, at most, that no all-inlier quadruple was drawn (choice).
MISS = 1e-3
# Cutoff of the departure from an affine map along the epipolar line, in standard deviations of the bulk (choice).
ALONG_CUTOFF = 6.0


@kernel
def hyperplane_inliers(x: FloatArray, y: FloatArray, threshold: float, picks: FloatArray, weights: FloatArray) -> float:
    """Matches of one camera that fit one affine epipolar constraint.

    Under weak perspective the joint points (x1, x2, y1, y2) of a rigid motion lie on a hyperplane of the 4D space, which
    four of them determine. RANSAC over such quadruples, scored by truncated squares, then two refits to the inliers; of
    those, the ones that lie far from all others along the epipolar line are taken away.

    Args:
        x, y: (n, 2) points in the two frames.
        threshold: largest distance to the hyperplane, same units.
        picks: (h, 4) in [0, 1), choose the quadruples: h at most, fewer when a better one has become unlikely.
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
    # Centred, for the numbers' sake.
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
    stride = max(1, n // SCORED)
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
        length = 0.0
        for a in range(4):
            # The normal of three vectors in 4D: the cofactors of the 3x4 matrix.
            b, c, d = (a + 1) % 4, (a + 2) % 4, (a + 3) % 4
            normal[a] = (
                edge[0, b] * (edge[1, c] * edge[2, d] - edge[1, d] * edge[2, c])
                - edge[0, c] * (edge[1, b] * edge[2, d] - edge[1, d] * edge[2, b])
                + edge[0, d] * (edge[1, b] * edge[2, c] - edge[1, c] * edge[2, b])
            )
            if a % 2 == 1:
                normal[a] = -normal[a]
            length += normal[a] ** 2
        length = np.sqrt(length)
        if not length > 1e-12 * scale**3:
            continue
        offset = 0.0
        for a in range(4):
            normal[a] /= length
            offset += normal[a] * joint[q0, a]
        score, inside, scored = 0.0, 0, 0
        for i in range(0, n, stride):
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
        if score < best_score:
            best_score = score
            best[:4] = normal
            best[4] = offset
            share = min(max(inside / scored, 1e-2), 0.999)
            needed = min(needed, max(10.0, np.log(MISS) / np.log(1.0 - share**4)))
    if not best_score < np.inf:
        return 0.0
    rms = 0.0
    for again in range(3):
        count = 0
        for i in range(n):
            distance = -best[4]
            for a in range(4):
                distance += best[a] * joint[i, a]
            weights[i] = 1.0 if abs(distance) <= threshold else 0.0
            count += abs(distance) <= threshold
        if again == 2 or count < 6:
            break
        rms = _smallest_axis(joint, weights, best)
    _drop_far_along(joint, weights, best)
    return float(rms)


@kernel
def _smallest_axis(joint: FloatArray, weights: FloatArray, plane: FloatArray) -> float:
    """plane (5,) becomes the hyperplane of least squares through the weighted points; returns their rms distance."""
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
    # Inverse iteration, from the plane that is there: the smallest axis is at least ten times shorter than the others.
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
def _drop_far_along(joint: FloatArray, weights: FloatArray, plane: FloatArray) -> None:
    """Sets to 0 the weights of matches that depart much more than the others from an affine map of x, along the line.

    The hyperplane leaves a mismatch that lies on its epipolar line by chance. But depths on one object are alike.
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
            work[a, a] *= 1.0 + 1e-9
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
        sigma = SIGMA_OF_MEDIAN * median_of(sizes[:count])
        for i in range(n):
            kept[i] = 0.0
            if weights[i] > 0.0:
                kept[i] = bisquare((along[i] / (ALONG_CUTOFF * sigma + 1e-300)) ** 2)
    for i in range(n):
        weights[i] = 1.0 if kept[i] > 0.0 else 0.0
