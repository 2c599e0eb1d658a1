"""Detection of a second moving body: selects the larger one and reports the ratio.

The fit of a single motion leaves the matches of one of them, outliers whose neighbors move alike. Or its inliers are those
of both, and their residuals depend on the motion (`motion_mixture.measure_dependence`). Both kinds of division are starts of
a mixture of two motions. It is right if it is likelier than a single motion by more than its unknowns cost, and if the
cameras agree on the larger body's motion. The larger body is taken as the object; if both have nearly as many matches, the
result is ambiguous.

Source: G. Schwarz, Annals of Statistics 6, 1978 (what unknowns cost); docs/method/3-pose.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import compute_median, kernel
from sylpose.matches import STATIC_PX
from sylpose.relative_pose.camera_evidence import compute_f_ratio, measure_excess
from sylpose.relative_pose.faulty_cameras import MAX_CONSISTENT_EXCESS, solve_subset
from sylpose.relative_pose.limits import MAX_SAMPLES
from sylpose.relative_pose.rig_hypotheses import MAX_AGREEING, find_pixel_axes
from sylpose.relative_pose.solver import Division, TwoMotions, divide_inliers, fit_two_motions
from sylpose.relative_pose.terms import MIN_MATCHES, Fit, Solution, TermData, TermSolver, change_center
from sylpose.rig import Rig
from sylpose.status import Status

# Outliers are examined if they are more than this share of the inliers; a camera sees both bodies if each has more than
# this share of its matches (choice).
MIN_OUTLIER_RATIO = 0.1
# Neighbors move alike if their displacements differ by less than this share of the difference between any two matches, in
# the median: mismatches have about 1 ± 0.2 (choice).
MAX_NEIGHBOR_RATIO = 0.5
# Two motions are likelier than one by this multiple of what their unknowns cost: those of a wrong rig, whose cameras see
# different motions, by up to two, those of two bodies by 2.7 or more (measured: some 30 pairs of benchmarks/honesty.py,
# seeds 9900 to 10039).
MIN_GAIN_RATIO = 2.0
# A body with more than this share of the other's matches might be the object as well (choice).
AMBIGUOUS_RATIO = 0.8


def select_larger_body(
    data: Sequence[TermData], solution: Solution, rig: Rig, solve: TermSolver, min_sigma_px: float = 0.0
) -> tuple[Solution, float] | None:
    """Return the solution of the larger of two bodies, of which one is in a solution's outliers, or both are its inliers.

    Args:
        data: the terms of the solution, all in one reference frame.
        solution: the solution.
        rig: their cameras.
        solve: solver for a subset of the terms.
        min_sigma_px: lower bound of the noise, pixels.

    Returns:
        the solution of the larger body; the other's inliers over its own. If two motions are likelier, but the cameras do
        not agree on the larger one's, the solution itself, marked as mixed, and 0. None without another body, or if the
        single motion is right nevertheless.
    """
    two = _fit_bodies(data, solution, rig, solve, min_sigma_px)
    if two is None:
        return None
    counts = np.array([[p.sum() for p in parts] for parts in two.probabilities])
    # A faulty camera has most of its matches on one side; a second body must share those of at least two cameras.
    is_shared = counts.min(axis=0) > MIN_OUTLIER_RATIO * counts.sum(axis=0)
    if np.count_nonzero(is_shared) < min(2, len(data)):
        return None
    own, other = ([p > 0.5 for p in part] for part in two.probabilities)
    fit = solution.fit
    # A background is no body.
    if min(_measure_displacement(data, masks) for masks in (own, other)) <= STATIC_PX:
        return None
    is_likely = two.likelihood_gain > MIN_GAIN_RATIO * two.penalty
    if not (is_likely and _agree(data, own, solution.center, two.fit)):
        # Robust against a smaller body, the single motion may be right nevertheless.
        is_right = not fit.may_be_two and _agree(data, [w > 0.0 for w in fit.weights], solution.center, fit)
        return None if is_right else (solution._replace(fit=replace(fit, is_mixed=True)), 0.0)
    larger, smaller = counts.sum(axis=1).tolist()
    alternative, alone = two.fit.alternative, solve_subset(data, own, solve)
    if smaller > AMBIGUOUS_RATIO * larger:
        alternative = two.other
    elif alone is not None and alone.fit.alternative is not None:
        alternative = change_center(alone.fit.alternative, alone.center, solution.center)
    return solution._replace(fit=replace(two.fit, alternative=alternative)), smaller / larger


def _fit_bodies(
    data: Sequence[TermData], solution: Solution, rig: Rig, solve: TermSolver, min_sigma_px: float
) -> TwoMotions | None:
    """Fit two motions; None if they are no likelier than one.

    Where other axes of pixels explain the matches, inliers are not divided.
    """
    fit, center = solution.fit, solution.center

    def fit_two(divisions: Sequence[Division]) -> TwoMotions | None:
        two = fit_two_motions(data, solution, divisions, min_sigma_px) if divisions else None
        return two if two is not None and two.likelihood_gain > two.penalty else None

    first, two = fit_two(_divide_outliers(data, solution, solve)), None
    if fit.may_be_two and fit.status is not Status.NO_MOTION:
        two = fit_two(divide_inliers(data, solution, min_sigma_px))
    if two is None or (first is not None and first.likelihood_gain >= two.likelihood_gain):
        return first
    excess = measure_excess(data, center, fit.rotation, fit.translation)
    if len(data) > 2 and find_pixel_axes(rig, data, excess):
        return first
    # The mixture may be at a local maximum: search the motions of its parts.
    parts = [solve_subset(data, [p > 0.5 for p in own], solve) for own in two.probabilities]
    motions = [change_center((p.fit.rotation, p.fit.translation), p.center, center) for p in parts if p is not None]
    masks = [np.concatenate(p.fit.weights) > 0.0 for p in parts if p is not None]
    if len(motions) < len(parts):
        return two
    again = fit_two([Division((motions[0], motions[1]), (masks[0], masks[1]))])
    return again if again is not None and again.likelihood_gain > two.likelihood_gain else two


def _agree(data: Sequence[TermData], masks: Sequence[BoolArray], center: FloatArray, fit: Fit) -> bool:
    """Return whether the cameras agree on the motion of the masked matches; of several, two must have evidence."""
    kept = [term.subset(mask) for term, mask in zip(data, masks, strict=True)]
    excess = measure_excess(kept, center, fit.rotation, fit.translation)
    known = excess[np.isfinite(excess)]
    # With many cameras one may exceed the bound: assigned matches are cut off where the other body begins.
    is_small = float(np.max(known, initial=0.0)) <= MAX_CONSISTENT_EXCESS
    return len(known) >= min(2, len(data)) and (is_small or compute_f_ratio(excess, len(excess)) <= MAX_AGREEING)


def _measure_displacement(data: Sequence[TermData], masks: Sequence[BoolArray]) -> float:
    """Return the median displacement of the masked matches, pixels."""
    parts = [term.focal * np.linalg.norm(term.y[m] - term.x[m], axis=1) for term, m in zip(data, masks, strict=True)]
    return float(np.median(np.concatenate(parts)))


def _divide_outliers(data: Sequence[TermData], solution: Solution, solve: TermSolver) -> list[Division]:
    """Divide the matches into the inliers and a motion of the outliers, if there is one."""
    fit = solution.fit
    inliers = [w > 0 for w in fit.weights]
    min_count = MIN_OUTLIER_RATIO * _count_true(inliers)
    if sum(map(len, data)) < _count_true(inliers) + min_count:
        return []
    outliers = [_find_moving_outliers(t.x, t.y, STATIC_PX / t.focal, w) for t, w in zip(data, fit.weights, strict=True)]
    # A camera whose matches are all outliers is faulty and no evidence of a second body.
    for mask, inlier in zip(outliers, inliers, strict=True):
        if inlier.sum() < MIN_MATCHES or mask.sum() < MIN_MATCHES:
            mask[:] = False
    if _count_true(outliers) < max(min_count, MIN_MATCHES) or not _is_coherent(data, outliers):
        return []
    second = solve_subset(data, outliers, solve)
    if second is None:
        return []
    other = change_center((second.fit.rotation, second.fit.translation), second.center, solution.center)
    masks = np.concatenate(inliers), np.concatenate(second.fit.weights) > 0
    return [Division(((fit.rotation, fit.translation), other), masks)]


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
