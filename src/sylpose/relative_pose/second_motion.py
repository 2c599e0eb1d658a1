"""Detection of a second moving body among the outliers of a fit: selects the larger body and reports the ratio.

The outliers of the robust fit are mismatches, with arbitrary displacements, or another body, whose neighbors move
alike. In the second case a motion is fitted to the outliers, and each motion again to all matches that are not
inliers of the other. The motion with more matches is taken as the object's. If both have nearly as many, the result is
ambiguous.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import compute_median, kernel
from sylpose.matches import STATIC_PX
from sylpose.relative_pose.faulty_cameras import solve_subset
from sylpose.relative_pose.limits import MAX_SAMPLES, MISMATCH_PROBABILITY
from sylpose.relative_pose.solver import fit_two_motions
from sylpose.relative_pose.terms import MIN_MATCHES, Solution, TermData, TermSolver
from sylpose.status import Status

# Outliers are examined if they are more than this share of the inliers, in at least two cameras; a camera sees both
# bodies if each has more than this share of its matches. A second body has more than the second share (choice).
MIN_OUTLIER_RATIO, MIN_BODY_RATIO = 0.1, 0.25
# Neighbors move alike if their displacements differ by less than this share of the difference between any two matches,
# in the median: mismatches have about 1 ± 0.2 (choice).
MAX_NEIGHBOR_RATIO = 0.5
# A body with more than this share of the other's matches might be the object as well (choice).
AMBIGUOUS_RATIO = 0.8


def select_larger_body(
    data: Sequence[TermData], solution: Solution, solve: TermSolver, min_sigma_px: float = 0.0
) -> tuple[Solution, float] | None:
    """Return the solution of the larger of two bodies, of which one is among a solution's outliers.

    Args:
        data: the terms of the solution, all in one reference frame.
        solution: the solution.
        solve: solver for a subset of the terms.
        min_sigma_px: lower bound of the noise, pixels.

    Returns:
        the solution of the larger body; the other's inliers over its own. None without another body.
    """
    weights = solution.fit.weights
    inliers = [w > 0 for w in weights]
    if sum(len(t) for t in data) < (1.0 + MIN_OUTLIER_RATIO) * _count_true(inliers):
        return None
    outliers = [_find_moving_outliers(t.x, t.y, STATIC_PX / t.focal, w) for t, w in zip(data, weights, strict=True)]
    # A camera whose matches are all outliers is faulty and no evidence of a second body.
    for mask, inlier in zip(outliers, inliers, strict=True):
        if inlier.sum() < MIN_MATCHES or mask.sum() < MIN_MATCHES:
            mask[:] = False
    min_cameras, min_count = min(2, len(data)), MIN_OUTLIER_RATIO * _count_true(inliers)
    if sum(bool(m.any()) for m in outliers) < min_cameras or _count_true(outliers) < min_count:
        return None
    second = _solve_motion(data, outliers, solve) if _is_coherent(data, outliers) else None
    if second is None or not _count_true([w > 0 for w in second.fit.weights]) > min_count:
        return None
    # Reassign matches that are inliers of the other fit by mistake.
    first = _solve_motion(data, [~(w > 0) for w in second.fit.weights], solve)
    if first is None:
        return None
    first_inliers = [w > 0 for w in first.fit.weights]
    changed = _count_true([a != b for a, b in zip(first_inliers, inliers, strict=True)])
    # If the first motion keeps its matches but for mismatches, the second keeps its own.
    if changed > MISMATCH_PROBABILITY * _count_true(inliers):
        second = _solve_motion(data, [~m for m in first_inliers], solve) or second
    counts = [_count_true([w > 0 for w in s.fit.weights]) for s in (first, second)]
    larger, smaller = (first, second) if counts[0] >= counts[1] else (second, first)
    # Both were solved about their own centers: express them about the same one.
    translation = smaller.fit.translation + (smaller.fit.rotation - np.eye(3)) @ (larger.center - smaller.center)
    other = replace(smaller.fit, translation=translation)
    mixture = fit_two_motions(data, larger.center, larger.radius, larger.fit, other, min_sigma_px)
    share = min(counts) / max(counts)
    if mixture is not None and mixture[0].status is Status.OK and not mixture[0].is_mixed:
        larger, probabilities = larger._replace(fit=mixture[0]), mixture[1]
        share = float(probabilities[1].sum() / probabilities[0].sum())
        # A faulty camera has most of its matches on one side; a second body must share those of at least two cameras.
        is_shared = probabilities.min(axis=0) > MIN_OUTLIER_RATIO * probabilities.sum(axis=0)
        has_second_body = int(is_shared.sum()) >= min_cameras
    else:
        has_second_body = _count_true(outliers) > MIN_BODY_RATIO * _count_true(inliers)
    if not has_second_body or share < MIN_BODY_RATIO:
        return None
    if share > AMBIGUOUS_RATIO:
        larger = larger._replace(fit=replace(larger.fit, alternative=(smaller.fit.rotation, translation)))
    return larger, share


def _solve_motion(data: Sequence[TermData], masks: Sequence[BoolArray], solve: TermSolver) -> Solution | None:
    """Solve with the masked matches; None without a motion."""
    solution = solve_subset(data, masks, solve)
    return solution if solution is not None and solution.fit.status is not Status.NO_MOTION else None


def _is_coherent(data: Sequence[TermData], outliers: Sequence[BoolArray]) -> bool:
    """Return whether neighboring outliers have similar displacements."""
    compared = []
    for term, mask in zip(data, outliers, strict=True):
        if mask.any():
            compared.append(term.focal * _compare_displacements(term.x, term.y, mask))
    near, far, moved = np.median(np.concatenate(compared), axis=0).tolist()
    # Under a pure translation any two matches move alike.
    return bool(near < MAX_NEIGHBOR_RATIO * max(np.sqrt(2.0) * far, 0.5 * moved))


@kernel
def _find_moving_outliers(x: FloatArray, y: FloatArray, max_static: float, weights: FloatArray) -> BoolArray:
    """Return (n,) moving matches without weight."""
    out = np.empty(len(x), np.bool_)
    for i in range(len(x)):
        out[i] = not weights[i] > 0.0 and np.hypot(y[i, 0] - x[i, 0], y[i, 1] - x[i, 1]) > max_static
    return out


@kernel
def _compare_displacements(x: FloatArray, y: FloatArray, mask: BoolArray) -> FloatArray:
    """Return (m, 3) differences of displacements: to the nearest masked match, to the median, and to zero."""
    picks = np.flatnonzero(mask)
    picks = picks[:: 1 + len(picks) // MAX_SAMPLES]
    n = len(picks)
    out, medians, displacements = np.empty((n, 3)), np.empty(2), np.empty((n, 2))
    column = np.empty(n)
    for a in range(2):
        for i in range(n):
            displacements[i, a] = y[picks[i], a] - x[picks[i], a]
            column[i] = displacements[i, a]
        medians[a] = compute_median(column)
    for i in range(n):
        min_square, nearest = np.inf, i
        for j in range(n):
            square = (x[picks[i], 0] - x[picks[j], 0]) ** 2 + (x[picks[i], 1] - x[picks[j], 1]) ** 2
            if j != i and square < min_square:
                min_square, nearest = square, j
        own, other = displacements[i], displacements[nearest]
        out[i, 0] = np.sqrt((own[0] - other[0]) ** 2 + (own[1] - other[1]) ** 2)
        out[i, 1] = np.sqrt((own[0] - medians[0]) ** 2 + (own[1] - medians[1]) ** 2)
        out[i, 2] = np.sqrt(own[0] ** 2 + own[1] ** 2)
    return out


def _count_true(masks: Sequence[BoolArray]) -> int:
    return int(sum(m.sum() for m in masks))
