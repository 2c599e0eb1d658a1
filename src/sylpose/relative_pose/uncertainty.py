"""Uncertainty beyond a quadratic cost: curved valleys, and alternative motions.

A covariance assumes a quadratic cost. If a direction is weakly observed, usually the length of a translation, the
minimum is in a narrow valley that may curve and flatten: narrow baselines, pure translations, small rotations. One
standard deviation along it then leaves the straight line by more than the width of the valley. The motion is therefore
displaced by one standard deviation along each weak direction, both ways, and minimized across it. The deviation from
the line, and the deficit of the restoring force relative to a quadratic cost, are added to the uncertainty.

This uses the noise and the residual depth of the fit, which may differ for another motion: if residual depth is weakly
observed, for example, every motion has its own. Along the weakest direction the motion is therefore displaced much
further, and everything else and then the motion are fitted again.

Other motions may explain the same matches about as well. The matches of a flat object, or of one whose residual depth
is not visible, agree with two homographies in each camera: of its plane and motion, and of a second plane with another
motion. Cameras all around resolve this ambiguity, cameras close together do not. Any refined minimum that is nearly as
likely and distant is an alternative: the result is then ambiguous. A near one, with its own covariance, is included in the
covariance.

The errors of neighbors may be alike, and those of a camera. So the covariance is inflated by the scatter of groups of
matches, as that of a trajectory is (`bundle_adjustment.covariance_inflation`).

Source: second-order terms of a profile likelihood, Bates & Watts, "Nonlinear Regression Analysis", chapter 7; their use
here is ours (docs/method/3-pose.md). Scatter of groups: K.-Y. Liang, S. L. Zeger, Biometrika 73, 1986.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import UNOBSERVABLE_RATIO
from sylpose.geometry.numba_linalg import (
    apply_rotvec,
    cholesky,
    cholesky_solve,
    compute_median,
    compute_sum,
    dot,
    kernel,
    so3_log,
    solve_factored,
)
from sylpose.geometry.robust_loss import bisquare_noise_response, chi_squared_bound
from sylpose.relative_pose.irls import (
    N_MOTION,
    IrlsFit,
    make_irls_start,
    make_joint_system,
    make_tolerance,
    reduce_term,
    run_constrained_irls,
)
from sylpose.relative_pose.limits import CUTOFF, HALF_DIGITS, MAX_ROUNDS, ROUGHLY_CONVERGED_DECREASE, SIGMA_FLOOR_PX
from sylpose.relative_pose.match_cost import (
    InlierPrior,
    Term,
    build_match_equations,
    make_match_equations,
    make_match_errors,
    make_term,
)
from sylpose.relative_pose.robust_fit import RefinedMinima
from sylpose.relative_pose.terms import (
    COINCIDENCE_TOLERANCE,
    DEPTH_MODEL_SIZE,
    Candidate,
    Stack,
    apply_step,
    copy_into,
)

# A motion that is less likely by this is no alternative: the accuracy of a likelihood (measured:
# docs/history/benchmarks.md#hard-pairs; deficits of the truth of 0.7 to 11 occurred). The second value is added for each
# inlier that the likelier motion has in excess. It may explain mismatches by chance, and real images' keypoints have longer
# tails than the model (measured: a mirror image with 7 of 108 matches more was likelier than the truth by 22).
MAX_LIKELIHOOD_LOSS, LOSS_PER_EXCESS_INLIER = 12.0, 3.0
# Unknowns of a plane, which a term's matches determine; its curvature comes mostly from the prior (derived).
N_PLANE = 3
# Two motions are distinct if one is outside the covariance of the other (chi-squared, once in a thousand times).
MIN_SEPARATION_SQUARE = chi_squared_bound(6)


class AlternativeMotion(NamedTuple):
    """Alternative motion.

    Attributes:
        rotation: (3, 3) R.
        translation: (3,) d.
        step: (6,) (w, d) from the fit to this motion.
        is_distant: whether it is clearly another motion: the step exceeds half of the motion.
    """

    rotation: FloatArray
    translation: FloatArray
    step: FloatArray
    is_distant: bool


def merge_minima(first: RefinedMinima, second: RefinedMinima) -> RefinedMinima:
    """Merge the minima of two searches."""
    return RefinedMinima(*(np.concatenate(parts) for parts in zip(first, second, strict=True)))


def list_other_minima(fit: IrlsFit, minima: RefinedMinima) -> list[tuple[FloatArray, FloatArray]]:
    """List the motions (R, d) of minima that are distinct from the fit and from each other, likeliest first."""
    found = [(fit.candidate.rotation, fit.candidate.translation)]
    for k in np.argsort(minima.costs, kind="stable").tolist():
        if not np.isfinite(minima.costs[k]):
            continue
        motion = minima.rotations[k], minima.translations[k]
        steps = [_compute_step(*motion, *other) for other in found]
        if min(step @ fit.information @ step for step in steps) > MIN_SEPARATION_SQUARE:
            found.append(motion)
    return found[1:]


def _compute_step(R: FloatArray, d: FloatArray, from_R: FloatArray, from_d: FloatArray) -> FloatArray:
    """Return the step (6,) of (w, d) between two motions."""
    step = np.append(np.empty(3), d - from_d)
    so3_log(R @ from_R.T, step[:3])
    return step


def compute_freedom(stack: Stack, fit: IrlsFit) -> float:
    """Return the degrees of freedom that a motion and planes leave, as a share of the residuals."""
    counts = np.diff(np.append(0, np.cumsum(fit.weights > 0.0))[stack.offsets])  # terms may be without matches
    n_residuals, n_unknowns = max(2 * int(counts.sum()), 1), N_MOTION + int(np.minimum(counts, N_PLANE).sum())
    return max(n_residuals - n_unknowns, 1) / n_residuals


def find_likeliest_alternative(
    stack: Stack, fit: IrlsFit, minima: RefinedMinima, information: FloatArray, radius: float
) -> AlternativeMotion | None:
    """Find the likeliest distinct minimum that is nearly as likely as the fit; far ones take precedence.

    Args:
        information: (6, 6) of the fit.
        radius: of the object.
    """
    if np.count_nonzero(np.isfinite(minima.costs)) < 2:
        return None
    best_one = int(np.argmin(minima.costs))
    excess_inliers = np.maximum(minima.inliers[best_one] - minima.inliers, 0.0)
    # The noise is estimated from the same residuals: with few degrees of freedom, that exaggerates differences.
    max_loss = MAX_LIKELIHOOD_LOSS / compute_freedom(stack, fit)
    max_costs = minima.costs[best_one] + max_loss + LOSS_PER_EXCESS_INLIER * excess_inliers
    is_likely = np.isfinite(minima.costs) & (minima.costs < max_costs)
    if is_likely.sum() < 2:
        return None
    R, d, _ = fit.candidate
    rotvec = np.empty(3)
    so3_log(R, rotvec)
    size = np.hypot(radius * np.linalg.norm(rotvec), np.linalg.norm(d))
    best: AlternativeMotion | None = None
    for k in np.argsort(minima.costs, kind="stable").tolist():
        step = _compute_step(minima.rotations[k], minima.translations[k], R, d)
        if is_likely[k] and step @ information @ step > MIN_SEPARATION_SQUARE:
            distance = np.hypot(radius * np.linalg.norm(step[:3]), np.linalg.norm(step[3:]))
            is_distant = bool(distance > UNOBSERVABLE_RATIO * size)
            if best is None or (is_distant and not best.is_distant):
                best = AlternativeMotion(minima.rotations[k], minima.translations[k], step, is_distant)
    return best


# Largest deviation across the valley, relative to the distance along it, and the least restoring curvature as a share of the
# quadratic one (choice).
MAX_DEVIATION_RATIO, MIN_CURVATURE_SHARE = 0.5, 0.05
# The mean fourth power of a normal variable: the variance that results from a deviation at one standard deviation
# (derived).
NORMAL_FOURTH_MOMENT = 3.0
# A direction whose standard deviation exceeds this share of the motion is weak: better known ones are straight (measured: of
# 2,952 answers with a direction above 5 %, half have one above this, and 58 of the 68 confidently wrong ones; of 800 usual
# answers 26).
WEAKLY_OBSERVED_SHARE = 0.08
# What is likely enough to be included in a covariance is at most so many squared standard deviations away (chi-squared, once
# in a thousand times).
MAX_INCLUDED_SQUARE = chi_squared_bound(1)


def compute_curvature_covariance(stack: Stack, usable: InlierPrior, fit: IrlsFit, radius: float) -> FloatArray:
    """Return (6, m) columns F such that F F' is the covariance of (w, d) that a straight valley lacks.

    m is 0 if the valley is straight.

    Args:
        usable: (N,) matches that may be inliers, or their probabilities.
        fit: the result of `run_irls`.
        radius: of the object: a rotation moves its surface by radius times angle.
    """
    size, sd, vectors, scale = _find_weak_axes(stack, fit, radius)
    columns: list[FloatArray] = []
    for k in range(len(sd)):
        length = min(float(sd[k]), size)  # no farther than zero motion
        along, deviations = scale * vectors[:, k], np.empty((2, 6))
        restoring = 0.0
        for side in range(2):
            start, constraint = (1 - 2 * side) * length * along, vectors[:, k] / scale
            force = minimize_across_valley(stack, usable, fit, start, constraint, deviations[side])
            if not np.isfinite(force):
                return np.column_stack([*columns, sd[k] * along])
            # The deviation is small relative to the displacement; otherwise another minimum was reached.
            deviation = float(np.linalg.norm(deviations[side] / scale))
            deviations[side] *= min(1.0, MAX_DEVIATION_RATIO * length / max(deviation, 1e-300))
            restoring += 0.5 * max(force * float(sd[k]) ** 2 / length, 0.0)
        columns += [np.sqrt(0.5 * NORMAL_FOURTH_MOMENT) * row for row in deviations]
        if restoring < 1.0:
            columns.append(sd[k] * np.sqrt(1.0 / max(restoring, MIN_CURVATURE_SHARE) - 1.0) * along)
    return np.column_stack(columns) if columns else np.empty((6, 0))


def has_weak_direction(stack: Stack, fit: IrlsFit, radius: float) -> bool:
    """Return whether some direction of the motion is weakly observed."""
    _, sd, *_ = _find_weak_axes(stack, fit, radius)
    return len(sd) > 0


def displace_along_weak_direction(
    stack: Stack, usable: InlierPrior, fit: IrlsFit, radius: float
) -> list[tuple[Candidate, float]]:
    """Displace the motion far along its weakest direction, both ways, and fit everything else again.

    Args:
        usable, fit, radius: as for `compute_curvature_covariance`.

    Returns:
        the results with their costs (`run_irls`); none if no direction is weak.
    """
    size, sd, vectors, scale = _find_weak_axes(stack, fit, radius)
    if len(sd) == 0:
        return []
    along, constraint = scale * vectors[:, 0], vectors[:, 0] / scale
    constraint /= np.linalg.norm(constraint)
    out, length = list[tuple[Candidate, float]](), min(CUTOFF * float(sd[0]), size)
    for step_length in (-length, length):
        refit = make_irls_start(stack, fit.candidate, fit.sigma_px)
        apply_rotvec(step_length * along[:3], fit.candidate.rotation, refit.candidate.rotation)
        refit.candidate.translation[:] += step_length * along[3:]
        _, _, cost = run_constrained_irls(stack, usable, refit, SIGMA_FLOOR_PX, constraint)
        if cost < np.inf:
            out.append((refit.candidate, float(cost)))
    return out


def inflate_covariance(
    information: FloatArray, fit: IrlsFit, candidate: Candidate, likelihood_loss: float
) -> FloatArray:
    """Return a column (6, m) that inflates the covariance of (w, d) to include another motion.

    m is 0 if the covariance is large enough for it, or for chance.

    Args:
        likelihood_loss: decrease of the log-likelihood at that motion.
    """
    step = _compute_step(*candidate[:2], *fit.candidate[:2])
    square, target_square = float(step @ information @ step), max(2.0 * likelihood_loss, MAX_INCLUDED_SQUARE)
    if not square > target_square:
        return np.empty((6, 0))
    return np.asarray(step[:, None] * np.sqrt(1.0 / target_square - 1.0 / square))


def _find_weak_axes(stack: Stack, fit: IrlsFit, radius: float) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Find the weakly observed directions.

    Returns:
        the size of the motion; (k,) standard deviations, largest first; (6, 6) the directions, as columns; (6,) the
        units of (w, d).
    """
    scale = np.array([1.0 / radius] * 3 + [1.0] * 3)
    size, no_directions = compute_size_if_curved(fit, radius), (0.0, np.empty(0), np.empty((6, 6)), scale)
    if not size > 0:
        return no_directions
    values, vectors = np.linalg.eigh(fit.information * np.outer(scale, scale))
    # With all cameras in one place every length is equally undetermined, and that valley is straight.
    has_baseline = np.ptp(stack.a1, axis=0).max() > COINCIDENCE_TOLERANCE * np.abs(stack.a1).max()
    if not (values[-1] > 0 and has_baseline):
        return no_directions
    sd = 1.0 / np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    return size, sd[sd > WEAKLY_OBSERVED_SHARE * size], vectors, scale


@kernel
def compute_size_if_curved(fit: IrlsFit, radius: float) -> float:
    """Return the size of the motion if a direction may be weak, else 0.

    Usually it is 0: the sum of all variances is too small for a weak direction.
    """
    scaled, column, variance = np.empty((6, 6)), np.empty(6), 0.0
    size = 0.0
    so3_log(fit.candidate.rotation, column[:3])
    for i in range(3):
        size += (radius * column[i]) ** 2 + fit.candidate.translation[i] ** 2
    size = np.sqrt(size)
    for i in range(6):
        for j in range(6):
            scaled[i, j] = fit.information[i, j] / ((radius if i < 3 else 1.0) * (radius if j < 3 else 1.0))
    if not cholesky(scaled):
        return float(size)
    for i in range(6):
        column[:] = 0.0
        column[i] = 1.0
        solve_factored(scaled, column)
        variance += column[i]
    return float(size) if variance > (WEAKLY_OBSERVED_SHARE * size) ** 2 else 0.0


def compute_square_root(information: FloatArray, radius: float) -> FloatArray:
    """Return (6, m) columns F such that F F' is the covariance of an information (6, 6); m is 0 if there is none.

    Unobservable directions are bounded, as displacements of the surface at a radius.
    """
    scale = np.array([1.0 / radius] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if not values[-1] > 0:
        return np.empty((6, 0))
    return np.asarray(scale[:, None] * vectors / np.sqrt(np.maximum(values, HALF_DIGITS * values[-1])))


def inflate(information: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the information (6, 6) of a covariance inflated by F F', F (6, m); also valid if it is singular."""
    if columns.shape[1] == 0:
        return information
    projected = information @ columns
    inner = np.eye(columns.shape[1]) + columns.T @ projected
    try:
        inflated = information - projected @ np.linalg.solve(inner, projected.T)
    except np.linalg.LinAlgError:  # overflow: no information is left
        return np.zeros_like(information)
    return np.asarray(0.5 * (inflated + inflated.T))


# Parts of a camera's image whose errors may be alike (derived: halves in both directions, the fewest that show a slope).
N_PARTS = 4
# The scatter of the weighted errors of independent matches, over their information (derived).
INDEPENDENT_SCATTER = bisquare_noise_response(CUTOFF).score / bisquare_noise_response(CUTOFF).weight
# Least degrees of freedom of a scatter (choice: that of two cameras has 0.8; with 1, twice as many pairs with smooth errors
# are wrong and sure).
MIN_SCATTER_FREEDOM = 0.5


@kernel
def measure_variance_inflation(stack: Stack, usable: InlierPrior, fit: IrlsFit) -> float:
    """Return the variance of a fit relative to that with independent errors, at least 1.

    Parts of the images disagree if errors vary smoothly over them, and cameras if the calibration is wrong. With few
    cameras neither is precise, so their excesses are added, which is conservative.

    Args:
        usable: (N,) matches that may be inliers, or their probabilities.
        fit: the result of `run_irls`.
    """
    n, m = stack.focal.shape[0], stack.x.shape[0]
    matches, equations, joint = make_match_errors(m), make_match_equations(False), make_joint_system(n)
    joint.total[6, 6] = 1.0
    scores, information = np.zeros((N_PARTS * n, 7)), np.zeros((N_PARTS * n, 7, 7))
    matrices, rights, motion = np.empty((N_PARTS, 12, 12)), np.empty((N_PARTS, 12)), np.zeros((12, 7))
    # The inliers of each term, part after part.
    x, y, probabilities = np.empty((m, 2)), np.empty((m, 2)), np.empty(m)
    by_part = Stack(x, y, *stack[2:])
    for t in range(n):
        start, end = stack.offsets[t], stack.offsets[t + 1]
        weights = fit.weights[start:end]
        mass = compute_sum(weights)
        if not mass > 0.0:
            continue
        inliers = stack.x[start:end][weights > 0.0]
        middle0, middle1 = compute_median(inliers[:, 0]), compute_median(inliers[:, 1])
        term = make_term(stack, t, fit.candidate, make_tolerance(stack, t, fit, mass, CUTOFF))
        last = start
        for k in range(N_PARTS):
            first = last
            for i in range(start, end):
                if fit.weights[i] > 0.0 and (stack.x[i, 0] > middle0) + 2 * (stack.x[i, 1] > middle1) == k:
                    x[last], y[last], probabilities[last] = stack.x[i], stack.y[i], usable[i]
                    last += 1
            build_match_equations(by_part, Term(first, last, *term[2:]), probabilities, matches, equations)
            matrices[k], rights[k] = equations.matrix, equations.right
        equations.matrix[:], equations.right[:] = 0.0, 0.0
        for k in range(N_PARTS):
            equations.matrix[:] += matrices[k]
            equations.right[:] += rights[k]
        if not reduce_term(stack, t, fit.candidate, fit.distance_offset[0], equations, 1.0, joint):
            return 1.0
        # Derivatives by motion and distance offset, with the response of the depth model.
        motion[:3, :3], motion[3:6, 3:6], motion[6:] = stack.qy[t], stack.qy[t], -joint.gains[t][:, :7]
        across = np.ascontiguousarray(motion.T)
        for k in range(N_PARTS):
            lower = matrices[k]
            symmetric = lower + lower.T
            for i in range(12):
                symmetric[i, i] = lower[i, i]
            scores[N_PARTS * t + k] = np.dot(across, rights[k])
            information[N_PARTS * t + k] = np.dot(np.dot(across, symmetric), motion)
    if not cholesky(joint.total):
        return 1.0
    inflation = 1.0
    for size in (1, N_PARTS):
        scatter, expected = 0.0, 0.0
        for first in range(0, N_PARTS * n, size):
            score, share = np.zeros(7), np.zeros((7, 7))
            for k in range(first, first + size):
                score += scores[k]
                share += information[k]
            step = score.copy()
            solve_factored(joint.total, step)
            scatter += dot(score, step)
            for i in range(7):
                solve_factored(joint.total, share[i])
            for i in range(7):
                expected += share[i, i]
                for j in range(7):
                    expected -= share[i, j] * share[j, i]
        if expected > MIN_SCATTER_FREEDOM:
            inflation += max(scatter / (INDEPENDENT_SCATTER * expected) - 1.0, 0.0)
    return inflation


@kernel
def minimize_across_valley(
    stack: Stack, usable: InlierPrior, fit: IrlsFit, start: FloatArray, constraint: FloatArray, deviation: FloatArray
) -> float:
    """Displace the motion by start (6,) and minimize across the valley under a constraint.

    Args:
        constraint: (6,) c, the steps keep c' (w, d) constant.
        deviation: (6,) receives the deviation from the displaced position.

    Returns:
        the restoring force, the derivative of the cost along the displacement; infinite without convergence.
    """
    n, distance_offset = stack.focal.shape[0], fit.distance_offset.copy()
    candidate = Candidate(np.empty((3, 3)), np.empty(3), np.empty((n, DEPTH_MODEL_SIZE)))
    copy_into(candidate, fit.candidate)
    matches, equations = make_match_errors(len(stack.x)), make_match_equations(False)
    joint, step = make_joint_system(n), np.zeros(7)
    total, right, gains = joint.total, joint.right, joint.gains
    step[:6] = start
    # The depth models follow in the first step.
    apply_step(candidate, distance_offset, step, gains, 1.0)
    size, converged = 0.0, False
    for count in range(MAX_ROUNDS + 1):
        total[:], right[:] = 0.0, 0.0
        total[6, 6], right[6] = 1.0, -distance_offset[0]
        for t in range(n):
            mass, gains[t] = fit.weights[stack.offsets[t] : stack.offsets[t + 1]].sum(), 0.0
            if not mass > 0.0:
                continue
            term = make_term(stack, t, candidate, make_tolerance(stack, t, fit, mass, CUTOFF))
            build_match_equations(stack, term, usable, matches, equations)
            if not reduce_term(stack, t, candidate, distance_offset[0], equations, 1.0, joint):
                return np.inf
        if converged or count == MAX_ROUNDS:
            break
        for i in range(6):
            size = max(size, total[i, i])
        for i in range(6):
            for j in range(6):
                total[i, j] += size / HALF_DIGITS * constraint[i] * constraint[j]
        for i in range(7):
            total[i, i] *= 1.0 + HALF_DIGITS
        step[:] = right
        if not cholesky_solve(total, step):
            return np.inf
        apply_step(candidate, distance_offset, step, gains, 1.0)
        converged = 0.5 * dot(right, step) < ROUGHLY_CONVERGED_DECREASE
    relative_rotation = candidate.rotation @ fit.candidate.rotation.T
    so3_log(relative_rotation, deviation[:3])
    for i in range(3):
        deviation[i] -= start[i]
        deviation[3 + i] = candidate.translation[i] - fit.candidate.translation[i] - start[3 + i]
    force, length = 0.0, 0.0
    for i in range(6):
        force -= right[i] * start[i]
        length += constraint[i] * start[i]
    return float(force / abs(length))
