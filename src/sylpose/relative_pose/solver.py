"""Robust fit of one motion to all terms: the Python layer above the compiled solver, and its compilation.

`warm_up` and `warm_up_evidence` compile what the solver and the comparison with the cameras' own motions call.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.matrices import remove_direction
from sylpose.geometry.normal_equations import UNOBSERVABLE_RATIO
from sylpose.relative_pose import motion_mixture, observability, uncertainty
from sylpose.relative_pose.camera_evidence import (
    MIN_REDUCTION,
    compute_f_ratio,
    measure_distances,
    measure_excess,
    pool_f_ratios,
)
from sylpose.relative_pose.diagnostics import FitDiagnostics, diagnose
from sylpose.relative_pose.irls import N_MOTION, IrlsFit, make_empty_irls_fit, make_irls_start, run_irls
from sylpose.relative_pose.limits import DECREASE_OF_ONE_SD, SIGMA_FLOOR_PX
from sylpose.relative_pose.planes import fit_edge_on, is_flat
from sylpose.relative_pose.robust_fit import RefinedMinima, RobustFit, draw_and_fit, exceeds_chance
from sylpose.relative_pose.terms import (
    DEPTH_MODEL_SIZE,
    MAX_INVERSE_DEPTH_SD,
    MIN_MATCHES,
    Candidate,
    Fit,
    InitialMotions,
    Solution,
    Stack,
    TermData,
    change_center,
    find_usable,
    locate_object,
    make_failed_fit,
    stack_initial_motions,
    stack_terms,
)
from sylpose.status import Status

Hypothesis = tuple[FloatArray, FloatArray]
# The information of a fit, and the same without the prior on the depth models: (6, 6) each.
Information = tuple[FloatArray, FloatArray]

# If most matches are static and the motion may be larger by this factor, it is unknown (choice).
MAX_MOTION_FACTOR = 3.0


class _Problem(NamedTuple):
    """Terms of one motion.

    Attributes:
        data, stack: the terms, with at least one match each.
        center: (3,) g, the object's center at the motion's start.
        radius: of the object.
        usable: (N,) matches that may be inliers.
        is_relocated: whether the depths of a fit, not the rays, determine the distance of the center.
    """

    data: Sequence[TermData]
    stack: Stack
    center: FloatArray
    radius: float
    usable: BoolArray
    is_relocated: bool = False

    def diagnose(self, fit: IrlsFit, probabilities: FloatArray) -> FitDiagnostics:
        """Compute the diagnostics of a fit."""
        return diagnose(self.stack, self.usable, fit, probabilities, self.radius)

    def fail(self, status: Status) -> Fit:
        """Return a fit without a pose."""
        return make_failed_fit(self.data, status)

    def split_by_term(self, values: FloatArray) -> tuple[FloatArray, ...]:
        """Split values (N,) by term."""
        return tuple(values[first:last] for first, last in pairwise(self.stack.offsets.tolist()))


def fit_terms(
    data: Sequence[TermData],
    center: FloatArray,
    radius: float,
    guesses: Sequence[Hypothesis],
    rng: np.random.Generator,
    min_sigma_px: float = 0.0,
) -> Fit:
    """Fit one robust motion to all terms: per-term RANSAC, minima from several starts, re-weighting.

    Args:
        data: T terms with at least one match each.
        center: (3,) g, the object's center at the motion's start.
        radius: of the object.
        guesses: (R, d) initial motions in addition to the built-in ones.
        rng: random source.
        min_sigma_px: lower bound of the noise, pixels.

    Returns:
        the fit; its `status` has no pose if the matches are too few, inconsistent or mostly static, or without
        convergence.
    """
    if sum(len(term) for term in data) < MIN_MATCHES:
        return make_failed_fit(data, Status.TOO_FEW_MATCHES)
    problem, starts = _make_problem(data, center, radius, min_sigma_px), stack_initial_motions(guesses)
    return _build_best_fit(problem, draw_and_fit(problem.stack, problem.usable, starts, rng), starts, rng)


def locate_and_fit(
    data: Sequence[TermData],
    guesses: Sequence[Hypothesis],
    rng: np.random.Generator,
    radius: float | None = None,
    min_sigma_px: float = 0.0,
) -> Solution:
    """Locate an object and fit one robust motion to all terms, as `fit_terms` does.

    The object is where the cameras' rays meet (`locate_object`). The rays of cameras close together hardly determine its
    distance, but the depths that follow from the motion do: where they contradict it, the search is repeated at theirs,
    once.

    Args:
        data: T terms with at least one match each.
        guesses: (R, d) initial motions about the world's origin, in addition to the built-in ones.
        rng: random source.
        radius: of the object; None: from the spread of the matches.
        min_sigma_px: lower bound of the noise, pixels.
    """
    center, found_radius = locate_object(data)
    size, origin = found_radius if radius is None else radius, np.zeros(3)
    if sum(len(term) for term in data) < MIN_MATCHES:
        return Solution(make_failed_fit(data, Status.TOO_FEW_MATCHES), center, size)

    def search(center: FloatArray, size: float) -> tuple[_Problem, RobustFit, InitialMotions]:
        problem = _make_problem(data, center, size, min_sigma_px)
        starts = stack_initial_motions([change_center(guess, origin, center) for guess in guesses])
        return problem, draw_and_fit(problem.stack, problem.usable, starts, rng), starts

    problem, result, starts = search(center, size)
    ratio = _measure_distance_ratio(problem.stack, result.fit)
    if ratio != 1.0:
        motion = result.fit.candidate.rotation, result.fit.candidate.translation
        guesses = [*guesses, change_center(motion, center, origin)]
        center = center + (1.0 - ratio) * problem.stack.a1.mean(axis=0)
        relocated = search(center, size if radius is not None else ratio * size)
        if relocated[1].minima.costs.min() < np.inf:
            problem, result, starts = relocated
            problem = problem._replace(is_relocated=True)
    return Solution(_build_best_fit(problem, result, starts, rng), problem.center, problem.radius)


def _measure_distance_ratio(stack: Stack, fit: IrlsFit) -> float:
    """Return the object's distance from the cameras by a fit's depths, over the assumed one; 1 while the two agree.

    They agree if the offset that all cameras share is within what the search allows for. That of opposite cameras is no
    change of distance.
    """
    offset = float(stack.distance_gain.mean() * fit.distance_offset[0])
    inverse_ratios = fit.candidate.depth_model[:, 0] / stack.depth_model_mean[:, 0]
    is_contradicted = abs(offset) > MAX_INVERSE_DEPTH_SD and inverse_ratios.min() > 0.0
    return 1.0 / float(inverse_ratios.mean()) if is_contradicted else 1.0


def _make_problem(data: Sequence[TermData], center: FloatArray, radius: float, min_sigma_px: float) -> _Problem:
    """Stack terms about a center."""
    usable = np.concatenate([find_usable(term.x, term.y, term.focal) for term in data])
    return _Problem(data, stack_terms(data, center, radius, min_sigma_px), center, radius, usable)


def _build_best_fit(problem: _Problem, result: RobustFit, starts: InitialMotions, rng: np.random.Generator) -> Fit:
    """Build the fit of a single motion, or that of a mixture with a static background if it is likelier."""
    stack, usable = problem.stack, problem.usable
    all_usable = usable.astype(float)
    checks = problem.diagnose(result.fit, all_usable)
    # If the search diverged, replace its result by the identity.
    single = result.fit if checks.is_finite else make_empty_irls_fit(stack)
    motion_factor, likelihood_gain, split = 1.0, -np.inf, None
    if checks.has_static_candidates:
        motion_factor, likelihood_gain = motion_mixture.bound_hidden_motion(stack, usable, single)
    if likelihood_gain > -np.inf and not _is_all_static(stack, usable, single):
        split = motion_mixture.split_background(stack, usable, single, likelihood_gain, starts, rng)
    # A mixture that does not converge is no evidence against a single motion.
    split = split if split is not None and split.result.decrease < DECREASE_OF_ONE_SD else None
    if split is not None and split.likelihood_gain > motion_mixture.MIN_LIKELIHOOD_GAIN:
        moving = split.moving_probability
        fit = _build_fit(problem, split.result, moving, problem.diagnose(split.result.fit, moving))
        static_ratio = float(1.0 - moving.mean()) if fit.status.has_pose else 0.0
        return replace(fit, iterations=int(result.iterations + split.result.iterations), static_ratio=static_ratio)
    if split is not None:
        minima = uncertainty.merge_minima(result.minima, split.rebase_minima(float(result.minima.costs.min())))
        result = result._replace(minima=minima)
    cost = float(result.minima.costs.min())
    if checks.has_uniform_residuals or not exceeds_chance(stack, usable, cost, checks.inliers, starts, rng):
        return problem.fail(Status.NOT_CONSISTENT)
    return replace(_build_fit(problem, result, all_usable, checks, motion_factor), iterations=int(result.iterations))


def _is_all_static(stack: Stack, usable: BoolArray, single: IrlsFit) -> bool:
    """Return whether the motion may be zero and no match has moved."""
    may_be_static = bool(single.weights.any()) and observability.is_static(stack, single, single.information)
    return may_be_static and not motion_mixture.has_moving_matches(stack, usable, single)


class Division(NamedTuple):
    """Start of a fit of two motions.

    Attributes:
        motions: (R, d) of both, which may be the same.
        masks: (N,) the matches of each.
    """

    motions: tuple[Hypothesis, Hypothesis]
    masks: tuple[BoolArray, BoolArray]


class TwoMotions(NamedTuple):
    """Fit of two motions of the same terms as a mixture, with soft assignment of matches.

    Attributes:
        fit: of the one with more matches.
        other: (R, d) of the other.
        probabilities: per motion and term (n,), the probability of each match to belong to it.
        likelihood_gain: over the single motion.
        penalty: of the second motion's unknowns, its own and per camera a depth model and a noise (Schwarz's criterion).
    """

    fit: Fit
    other: Hypothesis
    probabilities: tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]
    likelihood_gain: float
    penalty: float


def divide_inliers(data: Sequence[TermData], single: Solution, min_sigma_px: float = 0.0) -> list[Division]:
    """Divide the inliers of a single motion in two, in several ways (`motion_mixture.divide_inliers`)."""
    stack, (fit, *_) = stack_terms(data, single.center, single.radius, min_sigma_px), single
    motion, masks = (fit.rotation, fit.translation), motion_mixture.divide_inliers(stack, _refit(stack, fit))
    return [Division((motion, motion), parts) for parts in masks]


def _refit(stack: Stack, fit: Fit) -> IrlsFit:
    """Return the re-weighted fit to all matches from a motion and its noise."""
    squares = [r[w > 0.0] ** 2 for r, w in zip(fit.residuals, fit.weights, strict=True)]
    known = np.concatenate(squares)
    mean = float(known.mean()) if len(known) else 1.0
    sigma_px = np.sqrt([max(square.mean() if len(square) else mean, SIGMA_FLOOR_PX**2) for square in squares])
    start = make_irls_start(stack, Candidate(fit.rotation, fit.translation, stack.depth_model_mean), sigma_px)
    run_irls(stack, np.ones(len(stack.x)), start, SIGMA_FLOOR_PX)
    return start


def fit_two_motions(
    data: Sequence[TermData], single: Solution, divisions: Sequence[Division], min_sigma_px: float = 0.0
) -> TwoMotions | None:
    """Fit two motions of the same terms as a mixture, about the center of a single one.

    Args:
        data: T terms.
        single: a single motion of them.
        divisions: starts; the likeliest result counts, of the likelier half after a round.
        min_sigma_px: lower bound of the noise, pixels.

    Returns:
        None without convergence.
    """
    stack = stack_terms(data, single.center, single.radius, min_sigma_px)
    all_usable = np.ones(len(stack.x), dtype=bool)
    if len(divisions) > 1:
        # The likelier half of the starts after a round.
        costs = [motion_mixture.fit_motion_mixture(stack, d.motions, d.masks, max_rounds=1).cost for d in divisions]
        divisions = [divisions[k] for k in np.argsort(costs, kind="stable")[: (len(divisions) + 1) // 2]]
    mixtures = [motion_mixture.fit_motion_mixture(stack, *division) for division in divisions]
    converged = [mixture for mixture in mixtures if mixture.predicted_decrease < DECREASE_OF_ONE_SD]
    mixture = min(converged, key=lambda mixture: mixture.cost, default=None)
    if mixture is None or not (mixture.probabilities > 0.5).sum(axis=1).min() > MIN_MATCHES:
        return None
    counts = mixture.probabilities.sum(axis=1)
    larger = int(np.argmax(counts))
    fit, other = mixture.fits[larger], mixture.fits[1 - larger].candidate
    probabilities = mixture.probabilities[[larger, 1 - larger]]
    rotation, translation, _ = fit.candidate
    minima = RefinedMinima(rotation[None], translation[None], np.array([mixture.cost]), counts[[larger]])
    result = RobustFit(fit, minima, mixture.iterations, mixture.predicted_decrease, False)
    problem = _Problem(data, stack, single.center, single.radius, all_usable)
    built = _build_fit(problem, result, probabilities[0], problem.diagnose(fit, probabilities[0]))
    density = motion_mixture.compute_motion_density(stack, _refit(stack, single.fit))
    cost = motion_mixture.compute_cost(stack, all_usable, density)
    unknowns = N_MOTION + len(data) * (DEPTH_MODEL_SIZE + 1) + 1
    return TwoMotions(
        replace(built, iterations=mixture.iterations),
        (other.rotation, other.translation),
        (problem.split_by_term(probabilities[0]), problem.split_by_term(probabilities[1])),
        cost - mixture.cost,
        0.5 * unknowns * float(np.log(len(stack.x))),
    )


def _build_fit(
    problem: _Problem, result: RobustFit, probabilities: FloatArray, checks: FitDiagnostics, motion_factor: float = 1.0
) -> Fit:
    """Build the fit of a motion: its covariance, its status and its alternatives.

    Args:
        result: of `draw_and_fit`, or of a mixture.
        probabilities: (N,) the probability of each match to belong to the motion, given that it is no mismatch.
        checks: diagnostics of the fit.
        motion_factor: factor by which the motion may be larger (`bound_hidden_motion`).
    """
    stack, radius, usable = problem.stack, problem.radius, problem.usable
    if checks.inliers < MIN_MATCHES:
        return problem.fail(Status.NOT_CONSISTENT)
    rod_direction = observability.find_rod_axis(stack, result.fit) if checks.is_collinear else None
    if rod_direction is not None:
        refit = _remove_rod_rotation(stack, probabilities, result, rod_direction)
        if refit is not None:
            result, checks = refit, problem.diagnose(refit.fit, probabilities)
    irls_fit, minima = result.fit, result.minima
    (rotation, translation, _), status, alternative = irls_fit.candidate, Status.OK, None
    # The unobservable rotation about a rod keeps the solver from converging: that is no failure.
    has_converged = result.decrease < DECREASE_OF_ONE_SD or rod_direction is not None
    if not (has_converged and np.isfinite(irls_fit.information).all()):
        return problem.fail(Status.NOT_CONVERGED)
    if checks.is_mixed and not checks.has_soft_assignment:
        # If the cameras' own motions agree with it, it is no mixture: neighbors share an error.
        excess = measure_excess(problem.data, problem.center, rotation, translation)
        checks = checks._replace(is_mixed=not compute_f_ratio(excess, len(excess)) <= MIN_REDUCTION)
    information, may_be_static = (checks.information, checks.information_without_depth), checks.may_be_static
    if checks.may_be_curved or checks.has_soft_assignment:
        curvature = uncertainty.compute_curvature_covariance(stack, probabilities, irls_fit, radius)
        information = _inflate_both(information, curvature)
        may_be_static = observability.is_static(stack, irls_fit, information[0])
    if may_be_static:
        likeliest = uncertainty.find_likeliest_alternative(stack, irls_fit, minima, information[0], radius)
        if likeliest is not None or motion_mixture.has_moving_matches(stack, usable, irls_fit):
            return problem.fail(Status.MOSTLY_STATIC)
        status, rotation, translation = Status.NO_MOTION, np.eye(3), np.zeros(3)
        motion_factor = motion_mixture.MOTION_FACTORS[-1]
    elif motion_factor >= MAX_MOTION_FACTOR:
        return problem.fail(Status.MOSTLY_STATIC)
    elif rod_direction is None:
        considered = _consider_alternatives(problem, result, probabilities, checks, information)
        if considered is None:
            return problem.fail(Status.NOT_CONVERGED)
        minima, alternative, information = considered
    if motion_factor > 1.0:
        # Any part of the matches may be background: the motion has any size up to this factor, and fewer matches
        # measure it.
        motion = np.append(Rotation.from_matrix(rotation).as_rotvec(), translation)
        column = (motion_factor - 1.0) / np.sqrt(3.0) * motion[:, None]
        first, second = (part / motion_factor**2 for part in information)
        information = _inflate_both((first, second), column)
    if rod_direction is not None:
        information = remove_direction(information[0], rod_direction), remove_direction(information[1], rod_direction)
    weights = irls_fit.weights * (probabilities > 0.5) if checks.has_soft_assignment else irls_fit.weights
    matches = problem.split_by_term(weights), problem.split_by_term(irls_fit.residuals_px)
    may_be_two = result.is_noisy or checks.dependence > motion_mixture.MAX_DEPENDENCE
    pose, cost = (status, rotation, translation), float(minima.costs.min())
    return Fit(
        *pose,
        *matches,
        *information,
        0,
        alternative=alternative,
        is_mixed=checks.is_mixed,
        cost=cost,
        may_be_two=may_be_two,
    )


def _inflate_both(information: Information, columns: FloatArray) -> Information:
    """Inflate both covariances by F F', F (6, m)."""
    return uncertainty.inflate(information[0], columns), uncertainty.inflate(information[1], columns)


def _consider_alternatives(
    problem: _Problem, result: RobustFit, probabilities: FloatArray, checks: FitDiagnostics, information: Information
) -> tuple[RefinedMinima, Hypothesis | None, Information] | None:
    """Find alternative motions; near ones, with their own covariances, inflate the covariance.

    Returns:
        all minima, a distant alternative or None, and the information; None if the fit does not converge to itself, or if
        it determines the object's distance but converges nowhere along its weakest direction.
    """
    stack, radius, irls_fit, minima = problem.stack, problem.radius, result.fit, result.minima
    R, d, _ = irls_fit.candidate
    # Unobservable or ambiguously assigned motions need no further checks.
    is_clear = not (checks.has_soft_assignment or checks.is_mixed)
    is_clear &= not len(observability.find_unobservable_motions(R, d, *information, radius))
    weakly_observed = is_clear and checks.may_be_curved and uncertainty.has_weak_direction(stack, irls_fit, radius)
    displaced, cost = list[tuple[Candidate, float]](), float(minima.costs.min())
    if weakly_observed or (is_clear and is_flat(stack, irls_fit)):
        if weakly_observed:
            displaced = uncertainty.displace_along_weak_direction(stack, probabilities, irls_fit, radius)
            # What determines the distance of the center must converge elsewhere along the valley as well.
            if problem.is_relocated and not displaced:
                return None
        others = uncertainty.list_other_minima(irls_fit, minima)
        starts = [Candidate(*motion, stack.depth_model_mean) for motion in others]
        starts += [candidate for candidate, _ in displaced]
        refined_minima = _refine_from_alternatives(stack, probabilities, irls_fit, cost, starts, weakly_observed)
        if refined_minima is None:
            return None
        minima = uncertainty.merge_minima(minima, refined_minima)
    # Each round includes one minimum in the covariance, which is then no alternative any more.
    for _ in minima.costs:
        likeliest = uncertainty.find_likeliest_alternative(stack, irls_fit, minima, information[0], radius)
        if likeliest is None:
            break
        motion = likeliest.rotation, likeliest.translation
        if likeliest.is_distant:
            return minima, motion, information
        start = make_irls_start(stack, Candidate(*motion, stack.depth_model_mean), irls_fit.sigma_px)
        _, _, refit_cost = fit_edge_on(stack, probabilities, start, False)
        # A near alternative is two standard deviations away.
        columns = [UNOBSERVABLE_RATIO * likeliest.step[:, None]]
        columns += [uncertainty.compute_square_root(start.information, radius)] if refit_cost < np.inf else []
        information = _inflate_both(information, np.column_stack(columns))
    for candidate, displaced_cost in displaced:
        column = uncertainty.inflate_covariance(information[0], irls_fit, candidate, displaced_cost - cost)
        information = _inflate_both(information, column)
    return minima, None, information


def _remove_rod_rotation(stack: Stack, usable: FloatArray, result: RobustFit, rod_axis: FloatArray) -> RobustFit | None:
    """Remove the arbitrary rotation of a rod about itself and fit again.

    Returns:
        the result with this fit; None if it is less likely than the present one.
    """
    refit = make_irls_start(stack, result.fit.candidate, result.fit.sigma_px)
    rotation = Rotation.from_matrix(result.fit.candidate.rotation)
    x, y, z, w = rotation.as_quat()
    rod_rotation = Rotation.from_rotvec(2.0 * np.arctan2(np.dot((x, y, z), rod_axis[:3]), w) * rod_axis[:3])
    refit.candidate.rotation[:] = (rod_rotation.inv() * rotation).as_matrix()
    _, decrease, new_cost = run_irls(stack, usable, refit, SIGMA_FLOOR_PX)
    is_likely = new_cost < float(result.minima.costs.min()) + uncertainty.MAX_LIKELIHOOD_LOSS
    return result._replace(fit=refit, decrease=float(decrease)) if is_likely else None


def _refine_from_alternatives(
    stack: Stack,
    probabilities: FloatArray,
    irls_fit: IrlsFit,
    cost: float,
    candidates: Sequence[Candidate],
    include_self: bool,
) -> RefinedMinima | None:
    """Refit the motion with other depths, and other candidates.

    The noise that was found is kept. Flat objects and weakly observed motions depend on how curved surfaces are assumed to
    be: they are also fitted as if as curved as the prior, and as if flat. A motion that does not converge to itself from
    prior depth models, at the distance found, depends on models and weights left by chance or by another motion: the motion
    that it converges to counts as equally likely.

    Args:
        probabilities: (N,) the probability of each match to belong to the motion.
        cost: of the likeliest minimum.
        include_self: whether to refit from the motion itself.

    Returns:
        the minima; None if the refit from the motion itself diverges.
    """
    starts = [(stack._replace(marginalized_share=share), irls_fit.candidate) for share in (0.0, 1.0)]
    starts += [(stack, candidate) for candidate in candidates]
    if include_self:
        depth_model = stack.depth_model_mean.copy()
        depth_model[:, 0] += stack.distance_gain * irls_fit.distance_offset[0]
        starts.append((stack, irls_fit.candidate._replace(depth_model=depth_model)))
    rotations, translations = np.empty((len(starts), 3, 3)), np.empty((len(starts), 3))
    costs, inliers = np.empty(len(starts)), np.empty(len(starts))
    for k, (assumed, start) in enumerate(starts):
        refit = make_irls_start(stack, start, irls_fit.sigma_px)
        _, _, costs[k] = fit_edge_on(assumed, probabilities, refit, False)
        rotations[k], translations[k] = refit.candidate.rotation, refit.candidate.translation
        inliers[k] = (refit.weights > 0.0).sum()
    if include_self:
        if not costs[-1] < np.inf:
            return None
        costs[-1] = cost
    # A likelier minimum is treated as an alternative like the others.
    return RefinedMinima(rotations, translations, np.maximum(costs, cost), inliers)


# --- compilation -------------------------------------------------------------------------------------------------------


def warm_up() -> None:
    """Compile what `fit_terms` runs, or load it from the cache: a minute or two at first, then a third of a second."""
    fit_terms(_make_terms(), np.zeros(3), 0.1, [], np.random.default_rng(0))
    observability.classify_observability(make_failed_fit(_make_terms(), Status.OK), 0.1)
    locate_object(_make_terms())
    stack = _make_stack()
    fit, usable = make_empty_irls_fit(stack), np.ones(len(stack.x))
    run_irls(stack, usable, fit, SIGMA_FLOOR_PX)
    observability.is_static(stack, fit, np.eye(6))
    motion_mixture.correlate_neighbors(stack, fit)
    motion_mixture.divide_inliers(stack, fit)
    motion_mixture.compute_cost(stack, usable > 0, motion_mixture.compute_motion_density(stack, fit))
    is_flat(stack, fit)
    fit_edge_on(stack, usable, make_empty_irls_fit(stack), False)
    uncertainty.compute_size_if_curved(fit, 0.1)
    uncertainty.minimize_across_valley(stack, usable, fit, np.zeros(6), np.zeros(6), np.zeros(6))


def warm_up_evidence() -> None:
    """Compile the comparison of the cameras' own motions with the joint one."""
    terms, motion = _make_terms(), (np.zeros(3), np.eye(3), np.array([0.1, 0.0, 0.0]))
    measure_distances(terms[0], *motion)
    excess = measure_excess(terms, *motion)
    compute_f_ratio(excess)
    compute_f_ratio(excess, len(excess))
    pool_f_ratios(excess)


def _make_terms() -> list[TermData]:
    x = np.random.default_rng(0).uniform(-0.1, 0.1, (12, 2))
    return [TermData(k, x, x + 0.01 * k, np.eye(3), np.array([k - 0.5, 0.0, -1.0]), 1000.0) for k in range(2)]


def _make_stack() -> Stack:
    return stack_terms(_make_terms(), np.zeros(3), 0.1)
