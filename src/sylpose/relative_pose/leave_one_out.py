"""Detection of faulty cameras by leaving them out: wrong calibration, mismatches only, a frozen image.

Under weak perspective the inliers of one camera are near a hyperplane of (x, y), whatever its calibration
(`affine_ransac`). The likelihood ratio of their own hyperplane to the common motion (`compute_inconsistency`) measures,
at any level of noise, whether the camera disagrees with the others. A faulty camera biases the motion, so that others
look wrong as well. If one is inconsistent, the fit is repeated without each of the cameras, and each camera is fitted
alone. A camera is removed if its own motion and that of the others are together clearly the likeliest. Two swapped
videos are found by swapping them back (`undo_swap`). Matches of a removed camera that agree with the others'
motion within noise are restored if they are not few: then only some of its matches belong to something else.

The directions of the cameras are tested too (`is_other_camera_misaligned`): the rays through the middle of what each
camera sees of one object nearly meet. They reveal a calibration error of 10 degrees that the motion does not. By
themselves they are no evidence against a camera: if half of an object is hidden, the rays miss each other as much
(measured: docs/history/benchmarks.md#hard-pairs). The test can therefore only exonerate a suspected camera.

Source: the leave-one-out test is Chow's (Econometrica 28, 1960); its use here is ours (docs/method/3-pose.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.matrices import essential_matrix, sampson_scale
from sylpose.matches import STATIC_PX
from sylpose.moments import PairMoments
from sylpose.relative_pose import diagnostics
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX
from sylpose.relative_pose.solver import FAR_MOTION_PX
from sylpose.relative_pose.terms import Fit, Solution, TermData, TermSolver, locate_object
from sylpose.status import Status
from sylpose.sylvester.camera_faults import find_faulty_cameras

# Maximum number of removed cameras, and of cameras tried per round: rejected ones first, then the most inconsistent
# (choice).
MAX_REMOVED_CAMERAS, MAX_TRIED_CAMERAS = 8, 8
# A camera is removed if its own motion and that of the others are likelier than a common one by this: six unknowns
# (measured: ibid.; without a fault 23 at most among the cameras tried).
MIN_LIKELIHOOD_GAIN = 25.0
# The faulty camera is identified if removing any other is less likely by the first value; with three cameras, two of
# which always nearly agree, by the second (choice).
MIN_MARGIN, MIN_MARGIN_THREE_CAMERAS = 8.0, 60.0
# With more cameras than this the likeliest is removed even if another is nearly as likely; that one may follow
# (choice).
FEW_CAMERAS = 4
# Maximum number of pairs to test for swapped videos, the share of inliers required after swapping, and the margin to
# the inconsistency of other pairs (choice).
MAX_SWAP_PAIRS, MIN_SWAP_INLIER_SHARE, MIN_SWAP_MARGIN = 15, 0.85, 4.0
# Swapped videos cause a total inconsistency above this, or a rejected camera (measured: ibid., 57 and more).
MIN_SWAP_INCONSISTENCY = 45.0
# After the removal of cameras the others must not exceed this inconsistency, or the cause is another (chi-squared of
# four: 1 in 60).
MAX_REMAINING_INCONSISTENCY = 12.0
# A camera whose own fit explains a share of its matches between these sees two motions: neither junk nor a wrong
# calibration (choice).
TWO_MOTIONS_RANGE = (0.35, 0.6)
# If a smaller share of the others' matches agree, two motions are about equally large, and no camera is at fault
# (choice).
MIN_AGREEING_SHARE = 0.66
# Agreeing matches of a removed camera are not restored if their inconsistency is larger (chi-squared of four: 1 in
# 2000).
MAX_RESTORED_INCONSISTENCY = 20.0
# A camera's noise is normal if its variance exceeds that of the others by at most this many standard deviations
# (choice).
MAX_NOISE_SIGMAS = 3.5
# Pure noise leaves more matches within the first distance of their epipolar lines, in standard deviations, than between
# it and the second. Fewer than the last share of a camera's matches are not restored (choice).
NEAR_SIGMAS, FAR_SIGMAS, MIN_RESTORED_SHARE = 1.5, 4.5, 0.3
# A rejected camera (`MAX_REJECTED_SHARE`) is named if this share of its matches are inliers of a motion of its own
# (choice).
MIN_OWN_SHARE = 0.6
# Increase of the squared ray distances over those without another camera, in radii of the object (measured: ibid., 0.3
# at most without a fault and with nothing hidden, median 0.9 for a camera that is off by 10 degrees).
MIN_MISS_DIFFERENCE = 0.6
SWAPPED_MESSAGE = "its matches are those of camera {}: the two were exchanged"


def solve_without_faulty_cameras(
    data: Sequence[TermData], solution: Solution, names: Sequence[str], solve: TermSolver
) -> Solution:
    """Solve without the faulty cameras, each of which is named in `Fit.faults`.

    With two cameras the faulty one is unknown; with three it is named only if it is by far the likeliest. At most every
    other camera is removed, and no more than eight. If no camera is inconsistent this takes some ten microseconds per
    camera.

    Args:
        data: the terms of the fit, one per camera, all in one reference frame.
        solution: the solution of all of them, with a pose or NOT_CONVERGED.
        names: of the rig's cameras.
        solve: solver for a subset of the terms.
    """
    masks = [np.ones(len(term), dtype=bool) for term in data]
    removed: list[int] = []
    first = solution
    tried: set[int] = set()
    if solution.fit.cameras_consistent or not _has_disagreement(data, solution.fit):
        return solution
    only_junk = solution.fit.status.has_pose and _is_only_junk(data, solution.fit, solve)
    swapped = None if only_junk else undo_swap(data, solution, names, solve)
    if swapped is not None:
        return swapped
    if only_junk:
        removed = np.flatnonzero(_find_rejected(data, solution.fit)).tolist()
        solution = solve_subset(data, [m & (i not in removed) for i, m in enumerate(masks)], solve) or solution
    unclear = None
    for _ in range(0 if only_junk else min((len(data) - 1) // 2, MAX_REMOVED_CAMERAS)):
        worst, unclear = _find_worst_camera(data, masks, solution, solve)
        if worst is None or worst[0] in tried:
            break
        k, solution = worst
        tried.add(k)
        masks[k] = _find_agreeing(data[k], solution)
        refit = solve_subset(data, masks, solve) if masks[k].any() else None
        inconsistency = np.inf if refit is None else float(_compute_inconsistencies(data, refit.fit)[k])
        is_restored = refit is not None and (refit.fit.weights[k] > 0).any()
        if refit and is_restored and not (inconsistency > MAX_RESTORED_INCONSISTENCY and _is_noisy(refit.fit, k)):
            solution = refit
        else:
            masks[k][:] = False
            removed.append(k)
    max_remaining = MAX_REMAINING_INCONSISTENCY + diagnostics.compute_chance_margin(len(data))
    if removed and not only_junk and _compute_inconsistencies(data, solution.fit).max() > max_remaining:
        # Removing cameras does not explain the inconsistency: restore all.
        solution, removed = first, []
    if not solution.fit.status.has_pose:
        return solution
    if unclear is not None and not removed:
        # Possibly no camera is faulty, but the search missed the motion of the others.
        refit = solve(data, unclear)
        if _has_disagreement(data, refit.fit):
            return solution._replace(fit=replace(solution.fit, is_mixed=True))
        return refit
    rejected = _find_rejected(data, solution.fit)
    rejected[removed] = True
    agreeing_count = sum(int((w > 0).sum()) for w in solution.fit.weights)
    match_count = sum(len(term) for term, reject in zip(data, rejected, strict=True) if not reject)
    if not rejected.any() or agreeing_count < MIN_AGREEING_SHARE * match_count:
        return solution
    for k in np.flatnonzero(rejected).tolist():
        inliers = int((solve([data[k]]).fit.weights[0] > 0).sum())
        # A camera of which about half of the matches agree with its own motion sees two.
        rejected[k] = not TWO_MOTIONS_RANGE[0] * len(data[k]) < inliers < TWO_MOTIONS_RANGE[1] * len(data[k])
        # The camera sees a motion that differs from that of the others.
        if rejected[k] and k not in removed and inliers > MIN_OWN_SHARE * len(data[k]):
            removed.append(k)
    faults = _describe_faults(data, solution.fit, rejected, removed, names)
    return solution._replace(fit=replace(solution.fit, faults=faults))


def undo_swap(data: Sequence[TermData], solution: Solution, names: Sequence[str], solve: TermSolver) -> Solution | None:
    """Swap the matches of two cameras back if this, and no other swap, explains all of them.

    Two swapped cameras are consistent with each other: around an object each is the image of the other under a half
    turn. Leaving cameras out is therefore not conclusive with four cameras, two of which are swapped.

    Returns:
        the solution after the swap; the given solution, marked as mixed, if several swaps are as good; None without a
        swap.
    """
    pairs = [(a, b) for a in range(len(data)) for b in range(a)]
    if not len(data) > 3 or len(pairs) > MAX_SWAP_PAIRS:
        return None
    total = np.maximum(_compute_inconsistencies(data, solution.fit), 0.0).sum()
    if total < MIN_SWAP_INCONSISTENCY and not _find_rejected(data, solution.fit).any():
        return None
    costs: list[float] = []
    likely: list[tuple[float, str]] = []
    best: Solution | None = None
    for a, b in pairs:
        swapped = list(data)
        swapped[a] = replace(data[a], x=data[b].x, y=data[b].y, focal=data[b].focal)
        swapped[b] = replace(data[b], x=data[a].x, y=data[a].y, focal=data[a].focal)
        refit = solve(swapped)
        if not refit.fit.status.has_pose or refit.fit.status is Status.NO_MOTION:
            continue
        weights, residuals = list(refit.fit.weights), list(refit.fit.residuals)
        if any(np.count_nonzero(w) < MIN_SWAP_INLIER_SHARE * len(t) for w, t in zip(weights, swapped, strict=True)):
            continue
        inconsistencies = _compute_inconsistencies(swapped, refit.fit)
        costs.append(float(np.maximum(inconsistencies, 0.0).sum()))
        if not inconsistencies.max() <= MAX_REMAINING_INCONSISTENCY:
            continue
        first, second = names[data[b].camera], names[data[a].camera]
        likely.append((costs[-1], f"cameras {first} and {second}"))
        if costs[-1] == min(costs):
            weights[a], weights[b], residuals[a], residuals[b] = weights[b], weights[a], residuals[b], residuals[a]
            pair = ((first, second), (second, first))
            texts = tuple(f"camera {one}: {SWAPPED_MESSAGE.format(other)}" for one, other in pair)
            best = refit._replace(fit=replace(refit.fit.with_matches(weights, residuals), faults=texts))
    if best is None:
        return None
    if len(costs) > 1 and sorted(costs)[1] - min(costs) < MIN_SWAP_MARGIN:
        # In a symmetric rig several swaps are equally good.
        pairs_text = " or of ".join(text for cost, text in sorted(likely) if cost < min(costs) + MIN_SWAP_MARGIN)
        text = f"the videos of {pairs_text} were exchanged"
        return solution._replace(fit=replace(solution.fit, is_mixed=True, faults=(text,)))
    return best


def _has_disagreement(data: Sequence[TermData], fit: Fit) -> bool:
    """Return whether the cameras disagree or there is no pose.

    A small motion in front of a background is no evidence against a camera.
    """
    if not fit.status.has_pose:
        return True
    if fit.static_ratio > 0.0:
        far = np.concatenate([_compute_displacements(term)[w > 0] for term, w in zip(data, fit.weights, strict=True)])
        if not float(np.median(far)) > FAR_MOTION_PX:
            return False
    return bool(diagnostics.is_inconsistent(_compute_inconsistencies(data, fit)) or _find_rejected(data, fit).any())


def _is_only_junk(data: Sequence[TermData], fit: Fit, solve: TermSolver) -> bool:
    """Return whether the only faults are rejected cameras that see no motion by themselves."""
    if diagnostics.is_inconsistent(_compute_inconsistencies(data, fit)):
        return False
    rejected = _find_rejected(data, fit)
    alone = [solve([data[k]]).fit.status for k in np.flatnonzero(rejected).tolist()]
    return not any(status.has_pose and status is not Status.NO_MOTION for status in alone)


def _find_rejected(data: Sequence[TermData], fit: Fit) -> BoolArray:
    """Return (T,) whether hardly any of a camera's matches are inliers."""
    inliers, matches = (np.array(n) for n in ([np.count_nonzero(w) for w in fit.weights], [len(t) for t in data]))
    return np.asarray((matches >= diagnostics.MIN_TEST_INLIERS) & (inliers <= diagnostics.MAX_REJECTED_SHARE * matches))


def _find_worst_camera(
    data: Sequence[TermData], masks: Sequence[BoolArray], solution: Solution, solve: TermSolver
) -> tuple[tuple[int, Solution] | None, Solution | None]:
    """Find the term whose own motion differs most from the common one, and the solution without it.

    It is judged by likelihoods: of all others together plus that of the term alone, against that of all together.

    Returns:
        the term and the solution without it, or None if it is not clear which one; in that case the likeliest solution
        without one term, or None.
    """
    cameras = sum(bool(mask.any()) for mask in masks)
    if cameras < 3 or not _has_disagreement(data, solution.fit):
        return None, None
    # Any camera may have kept the solver from converging.
    has_pose = solution.fit.status.has_pose
    inconsistencies = _compute_inconsistencies(data, solution.fit) if has_pose else np.full(len(data), np.inf)
    rejected = _find_rejected(data, solution.fit)
    order = np.where(rejected, np.inf, inconsistencies)
    costs, solutions_without = dict[int, float](), dict[int, Solution]()
    for k in np.argsort(-order, kind="stable")[:MAX_TRIED_CAMERAS].tolist():
        if not masks[k].any():
            continue
        rest = solve_subset(data, [mask & (i != k) for i, mask in enumerate(masks)], solve)
        if rest is not None:
            costs[k], solutions_without[k] = rest.fit.cost + solve([data[k].subset(masks[k])]).fit.cost, rest
    if not solutions_without or not np.isfinite(min(costs.values())):
        return None, None
    best, *others = sorted(solutions_without, key=lambda k: costs[k])
    # If the remaining cameras are inconsistent too, the model is imperfect, and differences count less.
    remaining = _compute_inconsistencies(data, solutions_without[best].fit)
    scale = max(1.0, float(np.maximum(remaining, 0.0).sum()) / (diagnostics.HYPERPLANE_UNKNOWNS * (cameras - 1)))
    gain = solution.fit.cost - costs[best] if has_pose else np.inf
    if not (_is_frozen(data, best) or gain > MIN_LIKELIHOOD_GAIN * scale):
        return None, None
    margin = (MIN_MARGIN if cameras > 3 else MIN_MARGIN_THREE_CAMERAS) * scale
    clear = _is_frozen(data, best) or cameras > FEW_CAMERAS or all(costs[k] - costs[best] > margin for k in others)
    active_terms = {i: t.subset(mask) for i, (t, mask) in enumerate(zip(data, masks, strict=True)) if mask.any()}
    if clear and not is_other_camera_misaligned(list(active_terms.values()), active_terms[best]):
        return (best, solutions_without[best]), None
    max_remaining = MAX_REMAINING_INCONSISTENCY + diagnostics.compute_chance_margin(cameras)
    return None, solutions_without[best] if remaining.max() <= max_remaining else None


def _compute_displacements(term: TermData) -> FloatArray:
    """Return (n,) the displacements of a term's matches, pixels."""
    return np.asarray(term.focal * np.linalg.norm(term.y - term.x, axis=1))


def _is_frozen(data: Sequence[TermData], k: int) -> bool:
    """Return whether one camera sees no motion while all others do."""
    displacements = [float(np.median(_compute_displacements(term))) for term in data]
    others = displacements[:k] + displacements[k + 1 :]
    return displacements[k] <= STATIC_PX and min(others, default=0.0) > FAR_MOTION_PX


def solve_subset(data: Sequence[TermData], masks: Sequence[BoolArray], solve: TermSolver) -> Solution | None:
    """Solve with the masked matches; weights and residuals cover all terms. None without a pose."""
    indices = [i for i, mask in enumerate(masks) if mask.any()]
    part = solve([data[i].subset(masks[i]) for i in indices])
    if not part.fit.status.has_pose:
        return None
    weights, residuals = [np.zeros(len(term)) for term in data], [_compute_epipolar_px(term, part) for term in data]
    for i, w, r in zip(indices, part.fit.weights, part.fit.residuals, strict=True):
        weights[i][masks[i]], residuals[i][masks[i]] = w, r
    return part._replace(fit=part.fit.with_matches(weights, residuals))


def _compute_inconsistencies(data: Sequence[TermData], fit: Fit) -> FloatArray:
    """Return (T,) `compute_inconsistency` of the terms' inliers."""
    parts = zip(data, fit.weights, fit.residuals, strict=True)
    return np.array([diagnostics.compute_inconsistency(term.x, term.y, w, r, term.focal) for term, w, r in parts])


def _find_agreeing(term: TermData, solution: Solution) -> BoolArray:
    """Return (n,) matches near their epipolar lines under a motion that was found without them.

    None are returned if they are not concentrated as noise is: a bad calibration scatters them evenly.
    """
    inliers = [(w[w > 0], r[w > 0]) for w, r in zip(solution.fit.weights, solution.fit.residuals, strict=True)]
    mass = max(sum(float(w.sum()) for w, _ in inliers), 1e-300)
    sigma = max(float(np.sqrt(sum(float(w @ r**2) for w, r in inliers) / mass)), SIGMA_FLOOR_PX)
    normalized = np.abs(_compute_epipolar_px(term, solution)) / sigma
    moved = _compute_displacements(term) > STATIC_PX
    near = int((moved & (normalized < NEAR_SIGMAS)).sum())
    far = int((moved & (normalized >= NEAR_SIGMAS) & (normalized < FAR_SIGMAS)).sum())
    is_concentrated = near > far and near >= max(diagnostics.MIN_TEST_INLIERS, MIN_RESTORED_SHARE * moved.sum())
    return moved & (normalized < FAR_SIGMAS) if is_concentrated else np.zeros(len(term), dtype=bool)


def _is_noisy(fit: Fit, k: int) -> bool:
    """Return whether a term's inliers have more noise than those of the others, beyond chance; True without inliers."""
    inliers = [(w[w > 0], r[w > 0]) for w, r in zip(fit.weights, fit.residuals, strict=True)]
    if len(inliers[k][0]) < diagnostics.MIN_TEST_INLIERS:
        return True
    variances = [float(w @ r**2) / float(w.sum()) for w, r in inliers if len(w) >= diagnostics.MIN_TEST_INLIERS]
    own_variance = float(inliers[k][0] @ inliers[k][1] ** 2) / float(inliers[k][0].sum())
    max_ratio = 1.0 + MAX_NOISE_SIGMAS * float(np.sqrt(2.0 / len(inliers[k][0])))
    return own_variance > max_ratio * float(np.median(variances))


def _compute_epipolar_px(term: TermData, solution: Solution) -> FloatArray:
    """Return (n,) signed Sampson distances, pixels; 0 without epipolar geometry."""
    fit, center = solution.fit, solution.center
    tau = term.rotation @ (fit.rotation @ (term.center_x - center) - (term.center - center) + fit.translation)
    E = essential_matrix(term.rotation @ fit.rotation @ term.rotation_x.T, tau)
    x, y = (np.column_stack([points, np.ones(len(term))]) for points in (term.x, term.y))
    return np.asarray(term.focal * np.einsum("ni,ni->n", y, x @ E.T) / sampson_scale(E, x, y))


def _describe_faults(
    data: Sequence[TermData], fit: Fit, rejected: BoolArray, removed: Sequence[int], names: Sequence[str]
) -> tuple[str, ...]:
    """Return a sentence for each rejected term; terms that were not removed may have none."""
    labels = [names[term.camera] for term in data]
    weights = [np.ones(len(w)) if reject else w for reject, w in zip(rejected, fit.weights, strict=True)]
    moments = [PairMoments.from_matches(term.x, term.y, w) for term, w in zip(data, weights, strict=True)]
    rotations, at_fault = np.array([term.rotation for term in data]), np.flatnonzero(rejected).tolist()
    diagnosis = find_faulty_cameras(rotations, moments, fit.rotation, at_fault=at_fault, names=labels)
    texts = {i: f.text for i, f in enumerate(diagnosis.faults) if rejected[i] and f is not None}
    reported = sorted({*texts, *(k for k in removed if rejected[k])})
    return tuple(texts.get(i, f"camera {labels[i]}: it disagrees with the others") for i in reported)


def is_other_camera_misaligned(data: Sequence[TermData], suspect: TermData) -> bool:
    """Return whether the rays nearly meet without another term, but not without the suspected one."""
    without = [compute_ray_miss([term for term in data if term is not other]) for other in data]
    suspect_square = next(squares for squares, term in zip(without, data, strict=True) if term is suspect)
    return suspect_square > min(without) + MIN_MISS_DIFFERENCE


def compute_ray_miss(data: Sequence[TermData]) -> float:
    """Return the sum of squared distances of the median rays from the point nearest to all, in radii of the object."""
    center, radius = locate_object(data)
    rays = np.array([np.append(np.median(term.x, axis=0), 1.0) @ term.rotation_x for term in data])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    offsets = center - np.array([term.center_x for term in data])
    misses = offsets - np.einsum("ti,ti->t", offsets, rays)[:, None] * rays
    return float((misses**2).sum()) / radius**2
