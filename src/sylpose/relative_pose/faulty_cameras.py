"""Detection of faulty cameras in two frames: wrong calibration, mismatches only, a frozen image.

A camera contradicts the joint motion if its own best motion explains its matches much better (`camera_evidence`). A
faulty camera biases the joint motion, so that others contradict it as well. So the fit is repeated without each camera:
the faulty one is that without which the others agree, if there is only one. With more cameras several may be at fault;
they are removed one after another. With two cameras the faulty one is unknown.

Source: the leave-one-out test is Chow's (Econometrica 28, 1960); its use here is ours (docs/method/5-uncertainty.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import essential_matrix, sampson_distance
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.matches import MAX_STATIC_PX, STATIC_PX
from sylpose.moments import PairMoments
from sylpose.relative_pose.camera_evidence import (
    MAX_F_RATIO,
    MIN_KEPT_POOLED,
    MIN_MATCHES,
    MIN_REDUCTION,
    N_OWN,
    compare_terms,
    compute_f_ratio,
    explains_as_well,
    measure_excess,
    transfer_motion,
)
from sylpose.relative_pose.irls import MAX_REJECTED_SHARE
from sylpose.relative_pose.limits import MOST
from sylpose.relative_pose.rig_hypotheses import find_pixel_axes
from sylpose.relative_pose.terms import Fit, Solution, TermData, TermSolver, make_failed_fit
from sylpose.rig import Rig
from sylpose.status import Status
from sylpose.sylvester.camera_faults import find_faulty_cameras

# A camera agrees while its excess is below this: without a contradiction it has the degrees of freedom of its own motion
# (chi-squared, once in a thousand times).
MAX_CONSISTENT_EXCESS = chi_squared_bound(N_OWN)


class _Agreement(NamedTuple):
    """How well some of the cameras agree.

    Attributes:
        solution: of their matches alone.
        f_ratio: of these cameras; NaN if it is unknown.
        worst: largest excess of one of them.
    """

    solution: Solution
    f_ratio: float
    worst: float


def solve_without_faulty_cameras(data: Sequence[TermData], solution: Solution, rig: Rig, solve: TermSolver) -> Solution:
    """Solve without the faulty cameras, each of which is named in `Fit.faults`.

    Fewer than half of the cameras are removed, none of two. If none explains that they contradict each other, the status is
    NOT_CONSISTENT: wrong pixels or a wrong rig, of which each camera makes a motion of its own. So it is if fewer than
    three agree while another one sees a motion, and if all agree with other axes of pixels.

    Args:
        data: the terms of the fit, one per camera, all in one reference frame.
        solution: the solution of all of them.
        rig: their cameras.
        solve: solver for a subset of the terms.
    """
    fit = solution.fit
    if len(data) < 3 or not fit.status.has_pose or fit.status is Status.NO_MOTION or _is_small(data, fit):
        return solution
    names = rig.names
    removed, agreement = _remove_cameras(data, solution, solve)
    fit = agreement.solution.fit
    inliers, matches = (np.array(n) for n in ([np.count_nonzero(w) for w in fit.weights], [len(t) for t in data]))
    rejected = (matches >= MIN_MATCHES) & (inliers <= MAX_REJECTED_SHARE * matches)
    rejected[removed] = True
    agrees, sees_other = _compare_all(data, agreement.solution, rejected) if rejected.any() else (~rejected, rejected)
    is_contradicted = not removed and agreement.worst > MAX_CONSISTENT_EXCESS
    if is_contradicted or sees_other.any():
        # Before a background only what has moved counts: one essential matrix may explain both.
        moved = _select_moved(data) if solution.fit.static_ratio > 0.0 else data
        excess = measure_excess(moved, solution.center, solution.fit.rotation, solution.fit.translation)
        axes = find_pixel_axes(rig, moved, excess)
        # Any two cameras nearly agree. One that sees no motion of its own is at fault, whatever the others see.
        is_unproven = sees_other.any() and np.count_nonzero(agrees) < MIN_KEPT_POOLED
        # Without the worst camera, as far as three remain.
        f_ratio = float(compute_f_ratio(excess, MIN_KEPT_POOLED if is_contradicted else len(excess)))
        if axes or is_unproven or (is_contradicted and f_ratio > MAX_F_RATIO):
            suspects = [names[data[k].camera] for k in np.flatnonzero(sees_other).tolist()] if is_unproven else []
            text = _describe_contradiction(f_ratio, axes, suspects)
            return solution._replace(fit=replace(make_failed_fit(data, Status.NOT_CONSISTENT), faults=(text,)))
    if rejected.any() and inliers.sum() >= MOST * matches[~rejected].sum():
        fit = replace(fit, faults=_describe_faults(data, fit, rejected, removed, names))
    return agreement.solution._replace(fit=fit)


def _describe_contradiction(f_ratio: float, axes: str, suspects: Sequence[str]) -> str:
    start = f"the cameras see different motions (F ratio {f_ratio:.0f}"
    if axes:
        return f"{start}); they agree if {axes}"
    limit = "" if suspects else f"; the limit is {MAX_F_RATIO:.0f}"
    end = f"; begin with {', '.join(suspects)}: the others agree, as any two cameras nearly do" if suspects else ""
    remedy = "check the calibration, and that pixels are counted to the right and down from the upper left corner"
    return f"{start}{limit}): {remedy}{end}"


def _compare_all(data: Sequence[TermData], solution: Solution, rejected: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Compare each camera's own motion with the solution.

    Returns:
        (T,) whether a camera agrees: it is not rejected, and has a motion of its own; (T,) whether a rejected one sees
        another motion, about as exactly as the others see theirs.
    """
    motion = solution.center, solution.fit.rotation, solution.fit.translation
    n, own_px, _, excess = compare_terms(data, *motion).T
    agrees = ~rejected & (n > 0)
    noise_px = np.max(own_px, initial=0.0, where=agrees)
    displacement_px = np.array([term.focal * np.median(np.linalg.norm(term.y - term.x, axis=1)) for term in data])
    is_motion = (2 * n > [len(term) for term in data]) & (displacement_px > STATIC_PX)
    return agrees, rejected & is_motion & (own_px <= MIN_REDUCTION * noise_px) & (excess > MAX_CONSISTENT_EXCESS)


def _is_small(data: Sequence[TermData], fit: Fit) -> bool:
    """Return whether a motion before a background is too small to be evidence against a camera."""
    if not fit.static_ratio > 0.0:
        return False
    moved = [
        term.focal * np.linalg.norm((term.y - term.x)[w > 0], axis=1) for term, w in zip(data, fit.weights, strict=True)
    ]
    return not float(np.median(np.concatenate(moved))) > MAX_STATIC_PX


def _select_moved(data: Sequence[TermData]) -> list[TermData]:
    """Select the matches that have moved whatever the noise."""
    return [term.subset(term.focal * np.linalg.norm(term.y - term.x, axis=1) > MAX_STATIC_PX) for term in data]


def _remove_cameras(data: Sequence[TermData], solution: Solution, solve: TermSolver) -> tuple[list[int], _Agreement]:
    """Remove the cameras without which the others agree.

    Returns:
        their terms, none if the cameras agree or if it is not clear which of them are at fault; the others' agreement.
    """
    given = agreement = _compare(data, solution, np.arange(len(data)))
    kept, removed, is_clear = [*range(len(data))], list[int](), True
    while agreement.worst > MAX_CONSISTENT_EXCESS and len(removed) < (len(data) - 1) // 2:
        parts = {k: _solve_part(data, [c for c in kept if c != k], solve) for k in kept}
        trials = sorted(
            ((k, part) for k, part in parts.items() if part is not None), key=lambda trial: trial[1].f_ratio
        )
        if not trials:
            break
        (faulty, agreement), *others = trials
        # Several cameras may be at fault: only the last one must be the only explanation.
        is_clear = not others or not explains_as_well(others[0][1].f_ratio, agreement.f_ratio)
        kept.remove(faulty)
        removed.append(faulty)
    is_explained = agreement.worst <= MAX_CONSISTENT_EXCESS and MIN_REDUCTION * agreement.f_ratio < given.f_ratio
    return (removed, agreement) if removed and is_clear and is_explained else ([], given)


def _solve_part(data: Sequence[TermData], kept: Sequence[int], solve: TermSolver) -> _Agreement | None:
    """Solve with some of the terms; None without a motion or without evidence."""
    masks = [np.full(len(term), c in kept) for c, term in enumerate(data)]
    solution = solve_subset(data, masks, solve)
    if solution is None or solution.fit.status is Status.NO_MOTION:
        return None
    agreement = _compare(data, solution, np.array(kept))
    return agreement if np.isfinite(agreement.f_ratio) else None


def _compare(data: Sequence[TermData], solution: Solution, kept: IntArray) -> _Agreement:
    motion = solution.center, solution.fit.rotation, solution.fit.translation
    excess = measure_excess([data[c] for c in kept.tolist()], *motion)
    worst = float(np.nanmax(excess, initial=0.0, where=~np.isnan(excess)))
    return _Agreement(solution, compute_f_ratio(excess, len(excess)), worst)


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


def _compute_epipolar_px(term: TermData, solution: Solution) -> FloatArray:
    """Return (n,) signed Sampson distances, pixels; 0 without epipolar geometry."""
    E = essential_matrix(*transfer_motion(term, solution.center, solution.fit.rotation, solution.fit.translation))
    return term.focal * sampson_distance(E, term.x, term.y)


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
    reported = sorted({*texts, *removed})
    return tuple(texts.get(i, f"camera {labels[i]}: it disagrees with the others") for i in reported)
