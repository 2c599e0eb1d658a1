"""Robust fit of one motion to all terms: the Python layer above the compiled solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import remove_direction
from sylpose.geometry.numba_linalg import compute_median, kernel
from sylpose.matches import STATIC_PX
from sylpose.relative_pose.alternative_solutions import (
    MAX_LIKELIHOOD_LOSS,
    compute_second_planes,
    find_likeliest_alternative,
    merge_minima,
)
from sylpose.relative_pose.curvature_correction import (
    compute_curvature_covariance,
    has_weak_direction,
    inflate,
    inflate_covariance,
    refit_along_weak_direction,
)
from sylpose.relative_pose.diagnostics import FitDiagnostics, diagnose_fit, subtract_information
from sylpose.relative_pose.fit import MIN_MATCHES, Fit, make_failed_fit
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX, IrlsFit, make_empty_irls_fit, run_irls
from sylpose.relative_pose.match_likelihood import compute_missing_information
from sylpose.relative_pose.motion_mixture import fit_motion_mixture
from sylpose.relative_pose.observability import find_rod_axis, is_consistent, is_fully_observable, is_static
from sylpose.relative_pose.robust_fit import RandomSource, RefinedMinima, draw_and_fit
from sylpose.relative_pose.static_background import (
    MIN_LIKELIHOOD_GAIN,
    MOTION_FACTORS,
    bound_hidden_motion,
    has_moving_matches,
    split_background,
)
from sylpose.relative_pose.terms import Stack, TermArrays, TermData, copy_into, stack_initial_motions, stack_terms
from sylpose.results import Status

__all__ = ["FAR_MOTION_PX", "fit_terms", "fit_two_motions"]

Hypothesis = tuple[FloatArray, FloatArray]

# If the moving matches of a camera are displaced by more than this, pixels, its static matches are background (choice).
FAR_MOTION_PX = 6.0
# A solver whose last step was one standard deviation long has not converged: half its square (derived).
MAX_PREDICTED_DECREASE = 0.5
# Standard deviation along a nearby alternative motion, as a share of the distance to it (choice: two standard
# deviations).
ALTERNATIVE_SD_RATIO = 0.5
# If most matches are static and the motion may be larger by this factor, it is unknown (choice).
MAX_MOTION_FACTOR = 3.0
# With fewer inliers, or with a weakly observed direction, the solver must return to the same motion from it (choice).
FEW_INLIERS = 50
# With more cameras than this, second planes of flat objects are distinguished without a separate start (choice).
FEW_CAMERAS = 3


def fit_terms(
    data: Sequence[TermData],
    center: FloatArray,
    radius: float,
    guesses: Sequence[Hypothesis],
    rng: RandomSource,
    arrays: TermArrays | None = None,
    min_sigma_px: float = 0.0,
) -> Fit:
    """Fit one robust motion to all terms: per-term RANSAC, minima from several starts, re-weighting.

    Args:
        data: T terms with at least one match each.
        center: (3,) g, the object's center at the motion's start.
        radius: of the object.
        guesses: (R, d) initial motions in addition to the built-in ones.
        rng: seeded random source.
        arrays: the concatenated terms, if already available.
        min_sigma_px: lower bound of the noise, pixels.

    Returns:
        the fit; its `status` has no pose if the matches are too few, inconsistent or mostly static, or without
        convergence.
    """
    if sum(len(term) for term in data) < MIN_MATCHES:
        return make_failed_fit(data, Status.TOO_FEW_MATCHES)
    stack = stack_terms(data, center, radius, arrays, min_sigma_px)
    usable = np.ones(len(stack.x), dtype=bool)
    _exclude_background(stack, usable)
    irls_fit, minima, iterations, decrease = draw_and_fit(stack, usable, stack_initial_motions(guesses), rng)
    all_usable = usable.astype(float)
    checks = diagnose_fit(stack, usable, irls_fit, all_usable, radius, minima.costs, minima.inliers)
    planes = compute_second_planes(stack, irls_fit) if checks.is_narrow_baseline else []
    if planes:
        refit = draw_and_fit(stack, usable, stack_initial_motions([*guesses, *((R, d) for R, d, _ in planes)]), rng)
        iterations += refit[2]
        minima, is_better = merge_minima(minima, refit[1]), refit[1].costs.min() < minima.costs.min()
        irls_fit, decrease = (refit[0], refit[3]) if is_better else (irls_fit, decrease)
        checks = diagnose_fit(stack, usable, irls_fit, all_usable, radius, minima.costs, minima.inliers)
    # If the search diverged, replace its result by the identity.
    single = irls_fit if checks.is_finite else make_empty_irls_fit(stack)
    motion_factor, likelihood_gain = (
        bound_hidden_motion(stack, usable, single) if checks.has_static_candidates else (1.0, -np.inf)
    )
    split = None
    if likelihood_gain > -np.inf and not _is_all_static(stack, usable, single):
        split = split_background(stack, usable, single, likelihood_gain, stack_initial_motions(guesses), rng)
    # A mixture that does not converge is no evidence against a single motion.
    split = split if split is not None and split.predicted_decrease < MAX_PREDICTED_DECREASE else None
    if split is not None and not split.likelihood_gain > MIN_LIKELIHOOD_GAIN:
        minima, split = merge_minima(minima, split.rebase_minima(float(minima.costs.min()))), None
        checks = checks._replace(has_alternative=True)
    if split is not None:
        static_ratio = float(1.0 - split.moving_probability.mean())
        fit = _build_fit(
            data, stack, radius, split.fit, split.minima, split.predicted_decrease, split.moving_probability, usable
        )
        return replace(
            fit,
            iterations=int(iterations + split.iterations),
            static_ratio=static_ratio if fit.status.has_pose else 0.0,
        )
    if checks.has_uniform_residuals or not (checks.has_certain_inliers or is_consistent(stack, usable, irls_fit)):
        return make_failed_fit(data, Status.NOT_CONSISTENT)
    fit = _build_fit(data, stack, radius, irls_fit, minima, decrease, all_usable, usable, motion_factor, checks)
    return replace(fit, iterations=int(iterations))


def _is_all_static(stack: Stack, usable: BoolArray, single: IrlsFit) -> bool:
    """Return whether the motion may be zero and no match has moved."""
    return (
        bool(single.weights.any())
        and is_static(stack, single, single.information)
        and not has_moving_matches(stack, usable, single)
    )


def fit_two_motions(
    data: Sequence[TermData], center: FloatArray, radius: float, first: Fit, second: Fit, min_sigma_px: float = 0.0
) -> tuple[Fit, FloatArray] | None:
    """Fit two motions of the same terms as a mixture, about the same center, with soft assignment of matches.

    Args:
        data, center, radius, min_sigma_px: as for `fit_terms`.
        first, second: fits of the two motions, used as starts.

    Returns:
        the fit of the first motion; (2, T) how many matches of each term each motion has. None without convergence.
    """
    stack = stack_terms(data, center, radius, min_sigma_px=min_sigma_px)
    fits = (first, second)
    mixture = fit_motion_mixture(
        stack, [(f.rotation, f.translation) for f in fits], [np.concatenate(f.weights) > 0 for f in fits]
    )
    counts = mixture.probabilities.sum(axis=1)
    if not (mixture.predicted_decrease < MAX_PREDICTED_DECREASE and counts.min() > MIN_MATCHES):
        return None
    first_fit = mixture.fits[0]
    minima = RefinedMinima(
        first_fit.candidate.rotation[None], first_fit.candidate.translation[None], np.array([mixture.cost]), counts[:1]
    )
    usable = np.ones(len(stack.x), dtype=bool)
    fit = _build_fit(
        data, stack, radius, first_fit, minima, mixture.predicted_decrease, mixture.probabilities[0], usable
    )
    return replace(fit, iterations=mixture.iterations), np.add.reduceat(
        mixture.probabilities, stack.offsets[:-1], axis=1
    )


def _build_fit(
    data: Sequence[TermData],
    stack: Stack,
    radius: float,
    irls_fit: IrlsFit,
    minima: RefinedMinima,
    decrease: float,
    probabilities: FloatArray,
    usable: BoolArray,
    motion_factor: float = 1.0,
    checks: FitDiagnostics | None = None,
) -> Fit:
    """Build the fit of a motion: its covariance, its status and its alternatives.

    Args:
        irls_fit, minima, decrease: as returned by `draw_and_fit`, or of a mixture.
        probabilities: (N,) the probability of each match to belong to the motion, given that it is no mismatch.
        usable: (N,) matches that may be inliers.
        motion_factor: factor by which the motion may be larger (`bound_hidden_motion`).
        checks: diagnostics of the fit, if already computed.
    """
    if checks is None:
        checks = diagnose_fit(stack, usable, irls_fit, probabilities, radius, minima.costs, minima.inliers)
    status = Status.OK if checks.inliers >= MIN_MATCHES else Status.NOT_CONSISTENT
    rod_direction = find_rod_axis(stack, irls_fit) if checks.is_collinear else None
    if status is Status.OK and rod_direction is not None:
        refit = _remove_rod_rotation(stack, probabilities, irls_fit, rod_direction, float(minima.costs.min()))
        if refit is not None:
            irls_fit, decrease = refit
            checks = diagnose_fit(stack, usable, irls_fit, probabilities, radius, minima.costs, minima.inliers)
    (rotation, translation, _), _, weights, residuals_px, information, *_ = irls_fit
    # The unobservable rotation about a rod keeps the solver from converging: that is no failure.
    if status is Status.OK and not (
        (decrease < MAX_PREDICTED_DECREASE or rod_direction is not None) and np.isfinite(information).all()
    ):
        status = Status.NOT_CONVERGED
    if status is not Status.OK:
        return make_failed_fit(data, status)
    information, without_depth, may_be_static = (
        checks.information,
        checks.information_without_depth,
        checks.may_be_static,
    )
    if checks.may_be_curved or checks.has_soft_assignment:
        curvature = compute_curvature_covariance(stack, probabilities, irls_fit, radius)
        if checks.has_soft_assignment:
            missing_information = checks.information_factor * compute_missing_information(
                stack, irls_fit, probabilities
            )
            information, without_depth = (
                subtract_information(information, missing_information, 1.0),
                subtract_information(without_depth, missing_information, 1.0),
            )
        information, without_depth = inflate(information, curvature), inflate(without_depth, curvature)
        may_be_static = is_static(stack, irls_fit, information)
    alternative = None
    if may_be_static:
        if (
            has_moving_matches(stack, usable, irls_fit)
            or find_likeliest_alternative(irls_fit, minima, information, radius) is not None
        ):
            return make_failed_fit(data, Status.MOSTLY_STATIC)
        status, rotation, translation, motion_factor = Status.NO_MOTION, np.eye(3), np.zeros(3), MOTION_FACTORS[-1]
    elif motion_factor >= MAX_MOTION_FACTOR:
        return make_failed_fit(data, Status.MOSTLY_STATIC)
    elif rod_direction is None:
        # Unobservable or ambiguously assigned motions need no further checks.
        needs_alternatives = not (checks.has_soft_assignment or checks.is_mixed) and is_fully_observable(
            information, without_depth, rotation, translation, radius
        )
        weakly_observed, cost = (
            needs_alternatives and checks.may_be_curved and has_weak_direction(stack, irls_fit, radius),
            float(minima.costs.min()),
        )
        if needs_alternatives:
            refined_minima = _refine_from_alternatives(
                stack, probabilities, irls_fit, cost, weakly_observed or checks.inliers < FEW_INLIERS
            )
            if refined_minima is None:
                return make_failed_fit(data, Status.NOT_CONVERGED)
            minima = merge_minima(minima, refined_minima)
        likeliest = find_likeliest_alternative(irls_fit, minima, information, radius)
        if likeliest is not None and likeliest.is_distant:
            alternative = (likeliest.rotation, likeliest.translation)
        elif likeliest is not None:
            column = ALTERNATIVE_SD_RATIO * likeliest.step[:, None]
            information, without_depth = inflate(information, column), inflate(without_depth, column)
        for step, likelihood_loss in (
            refit_along_weak_direction(stack, probabilities, irls_fit, radius, cost)
            if weakly_observed and alternative is None
            else []
        ):
            column = inflate_covariance(information, step, likelihood_loss)
            information, without_depth = inflate(information, column), inflate(without_depth, column)
    if motion_factor > 1.0:
        # Any part of the matches may be background: the motion has any size up to this factor, and fewer matches
        # measure it.
        column = (
            (motion_factor - 1.0)
            / np.sqrt(3.0)
            * np.append(Rotation.from_matrix(rotation).as_rotvec(), translation)[:, None]
        )
        information, without_depth = (inflate(part / motion_factor**2, column) for part in (information, without_depth))
    if rod_direction is not None:
        information, without_depth = (
            remove_direction(information, rod_direction),
            remove_direction(without_depth, rod_direction),
        )
    return Fit(
        status,
        rotation,
        translation,
        _split_by_term(weights * (probabilities > 0.5) if checks.has_soft_assignment else weights, stack.offsets),
        _split_by_term(residuals_px, stack.offsets),
        information,
        without_depth,
        0,
        alternative=alternative,
        is_mixed=checks.is_mixed,
        cost=float(minima.costs.min()),
        cameras_consistent=checks.cameras_consistent and not checks.has_soft_assignment,
    )


def _split_by_term(values: FloatArray, offsets: IntArray) -> tuple[FloatArray, ...]:
    """Split values (N,) by term."""
    ends = offsets.tolist()
    return tuple(values[first:last] for first, last in pairwise(ends))


def _remove_rod_rotation(
    stack: Stack, usable: FloatArray, irls_fit: IrlsFit, rod_direction: FloatArray, cost: float
) -> tuple[IrlsFit, float] | None:
    """Remove the arbitrary rotation of a rod about itself and fit again.

    Returns:
        the fit and the predicted decrease of its last step; None if it is less likely than the fit with this cost.
    """
    refit = make_empty_irls_fit(stack)
    copy_into(refit.candidate, irls_fit.candidate)
    refit.sigma_px[:] = irls_fit.sigma_px
    rotation = Rotation.from_matrix(irls_fit.candidate.rotation)
    x, y, z, w = rotation.as_quat()
    rod_rotation = Rotation.from_rotvec(2.0 * np.arctan2(np.dot((x, y, z), rod_direction[:3]), w) * rod_direction[:3])
    refit.candidate.rotation[:] = (rod_rotation.inv() * rotation).as_matrix()
    _, decrease, new_cost = run_irls(stack, usable, refit, SIGMA_FLOOR_PX)
    return (refit, float(decrease)) if new_cost < cost + MAX_LIKELIHOOD_LOSS else None


def _refine_from_alternatives(
    stack: Stack, probabilities: FloatArray, irls_fit: IrlsFit, cost: float, include_self: bool
) -> RefinedMinima | None:
    """Refit from the second planes of few cameras, and from the motion itself with prior depth models.

    The noise that was found is kept. A motion that does not converge to itself depends on depth models and weights
    left by chance or by another motion: the motion that it converges to counts as equally likely.

    Args:
        probabilities: (N,) the probability of each match to belong to the motion.
        cost: of the fit.
        include_self: whether to refit from the motion itself.

    Returns:
        the minima; None if the refit from the motion itself diverges.
    """
    starts = compute_second_planes(stack, irls_fit) if len(stack.focal) <= FEW_CAMERAS else []
    starts += [irls_fit.candidate._replace(depth_model=stack.depth_model_mean)] if include_self else []
    rotations, translations = np.empty((len(starts), 3, 3)), np.empty((len(starts), 3))
    costs, inliers = np.empty(len(starts)), np.empty(len(starts))
    for k, start in enumerate(starts):
        refit = make_empty_irls_fit(stack)
        copy_into(refit.candidate, start)
        refit.sigma_px[:] = irls_fit.sigma_px
        _, _, costs[k] = run_irls(stack, probabilities, refit, SIGMA_FLOOR_PX)
        rotations[k], translations[k] = refit.candidate.rotation, refit.candidate.translation
        inliers[k] = (refit.weights > 0.0).sum()
    if include_self:
        if not costs[-1] < np.inf:
            return None
        costs[-1] = cost
    # A likelier minimum is treated as an alternative like the others.
    return RefinedMinima(rotations, translations, np.maximum(costs, cost), inliers)


@kernel
def _exclude_background(stack: Stack, usable: BoolArray) -> None:
    """Set usable (N,): matches that may be on the object; static ones are not if their camera sees large motion."""
    for t in range(stack.focal.shape[0]):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        moving, count = np.empty(last - first), 0
        for i in range(first, last):
            dx, dy = stack.y[i, 0] - stack.x[i, 0], stack.y[i, 1] - stack.x[i, 1]
            displacement = np.sqrt(dx * dx + dy * dy) * stack.focal[t]
            usable[i] = displacement > STATIC_PX
            if usable[i]:
                moving[count] = displacement
                count += 1
        if count == 0 or compute_median(moving[:count]) <= FAR_MOTION_PX:
            usable[first:last] = True
