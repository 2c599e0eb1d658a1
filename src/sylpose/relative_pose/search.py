"""Multi-start search for the minima of `moments_cost`: Levenberg-Marquardt, depth models eliminated term by term.

The planar part of the cost has no local minimum near the identity, so the search starts there. Few cameras, small
rotations and transparent bodies cause mirrored minima. Each camera alone always has one: the rotation component across
its axis reversed, near and far exchanged. Mirror images of the first minimum are therefore tried as well, and the
likeliest wins.

The affine image motion of a flat object adds initial rotations.

To first order, a plane that rotates by w and whose depth has the relative slopes s across the image is mapped by

    A = (1 + σ) 1 + ω J + r s',      r = (w_y, -w_x),  ω = w_z in the camera's axes,  J a quarter turn,

with σ from its approach. A without σ and ω has determinant zero: a quadratic equation with two solutions, that of the
plane and that of the second plane. Neither determines the length of r, so each gives a line of rotations. The lines of
the cameras meet in the rotation. Others may pass each other nearly as closely, with two cameras in particular: the search
starts at the points where one line of each camera meets best.

Source: first-order structure from motion of planes, Longuet-Higgins, "The reconstruction of a plane surface from two
perspective projections", 1984; the bas-relief ambiguity, Belhumeur, Kriegman, Yuille 1999; the intersection of the
lines is ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.normal_equations import eliminate_block
from sylpose.geometry.numba_linalg import apply_rotvec, cholesky_solve, dot, kernel, leaf, so3_exp, so3_log
from sylpose.relative_pose.limits import (
    DECREASE_OF_ONE_SD,
    HALF_DIGITS,
    MAX_ROTATION_STEP,
    MAX_ROUNDS,
    MAX_STEPS,
    ROUGHLY_CONVERGED_DECREASE,
)
from sylpose.relative_pose.moments_cost import (
    MomentSums,
    NormalEquations,
    TermView,
    build_view_equations,
    compute_view_misfit,
    estimate_view_variance,
    evaluate_term,
    make_term_view,
    update_view,
)
from sylpose.relative_pose.terms import COINCIDENCE_TOLERANCE, MIN_MATCHES, Candidate, InitialMotions, Stack, copy_into

# Steps after which a start is checked, and how far its log-likelihood may then be behind the best. Earlier checks lose true
# motions (measured: creeps in benchmarks/kinds.py, 48 degrees off); without one, two bodies are found as one motion
# (tests/tracking/test_bodies.py) (choice).
CHECK_STEPS, MAX_LIKELIHOOD_GAP = 3, 300.0
# Two minima are the same if their rotations, radians, and their translations, relative to their length, differ by less; so
# are two starts if their rotations, relative to their angle, do (choice).
SAME_MOTION = 0.01
# A term whose mean square exceeds the median of the terms by this factor, or this value, is down-weighted in the search
# (choice).
MAX_COST_RATIO = 4.0
# Damping at first, and again after a rejected step (choice).
INITIAL_DAMPING = 1e-4
# Maximum number of points where lines of rotations meet that are tried, as many as two cameras have; of terms whose axes
# mirror, and that the lines are first taken from; and of minima (choice: docs/history/benchmarks.md).
MAX_HYPOTHESES = 4


class Workspace(NamedTuple):
    """Work arrays of a search over T terms, allocated once.

    Attributes:
        normal, gain: normal equations, and the responses of the depth models (T, 3, 7): α changes by
            -(gain[:, 6] + gain[:, :6] (w, d)).
        kappa, costs, term_weights, squares: (T,) κ, costs, weights of the terms and their mean squares.
        total, right, step: (6, 6), (6,), (6,) the joint equations and a step.
        block, reduced: (3, 3), (6, 7) for the elimination of a depth model.
        trial, term_view: a candidate, and the view of one term.
        tolerance: predicted decrease of the full cost at convergence.
    """

    normal: NormalEquations
    gain: FloatArray
    kappa: FloatArray
    costs: FloatArray
    term_weights: FloatArray
    squares: FloatArray
    total: FloatArray
    right: FloatArray
    step: FloatArray
    block: FloatArray
    reduced: FloatArray
    trial: Candidate
    term_view: TermView
    tolerance: float


@kernel
def make_workspace(n: int) -> Workspace:
    """Allocate the work arrays for n terms."""
    normal, gain = NormalEquations(np.empty((n, 9, 9)), np.empty((n, 9))), np.empty((n, 3, 7))
    kappa, costs, weights, squares = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    total, right, step, block, reduced = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((3, 3)), np.empty((6, 7))
    trial, view = Candidate(np.empty((3, 3)), np.empty(3), np.empty((n, 3))), make_term_view()
    return Workspace(
        normal,
        gain,
        kappa,
        costs,
        weights,
        squares,
        total,
        right,
        step,
        block,
        reduced,
        trial,
        view,
        ROUGHLY_CONVERGED_DECREASE,
    )


@leaf
def _lower_median(values: FloatArray) -> float:
    """Return the lower median of values (n,), which are sorted in place."""
    n = values.shape[0]
    for i in range(1, n):
        value, k = values[i], i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return float(values[(n - 1) // 2])


@leaf
def _update_term_weights(costs: FloatArray, moments: FloatArray, term_weights: FloatArray, squares: FloatArray) -> None:
    """Set the weight of each term: small if its mean square is far above the median."""
    n = costs.shape[0]
    for t in range(n):
        squares[t] = term_weights[t] = 2.0 * costs[t] / max(moments[t, 8, 8], 1.0)
    median = _lower_median(squares)
    for t in range(n):
        term_weights[t] = 1.0 / (1.0 + (term_weights[t] / (MAX_COST_RATIO * (median + 1.0))) ** 2)


@leaf
def _solve_step(damping: float, workspace: Workspace) -> bool:
    """Compute a damped step, the depth models eliminated term by term; return False if it is undetermined."""
    normal, total, right, step = workspace.normal, workspace.total, workspace.right, workspace.step
    block, reduced = workspace.block, workspace.reduced
    total[:] = 0.0
    right[:] = 0.0
    for t in range(workspace.gain.shape[0]):
        hessian, gradient = normal.hessian[t], normal.gradient[t]
        gain, weight = workspace.gain[t], workspace.term_weights[t]
        for k in range(3):
            for j in range(6):
                gain[k, j] = hessian[6 + k, j]
            for j in range(3):
                block[k, j] = hessian[6 + k, 6 + j]
            block[k, k] *= 1.0 + damping
            gain[k, 6] = gradient[6 + k]
        for i in range(6):
            for j in range(6):
                reduced[i, j] = hessian[i, j]
            reduced[i, 6] = gradient[i]
        if not eliminate_block(block, gain, reduced):
            return False
        for i in range(6):
            right[i] -= weight * reduced[i, 6]
            for j in range(6):
                total[i, j] += weight * reduced[i, j]
    # Rotations and translations have different units: each block is damped by its own trace.
    rotation_trace = total[0, 0] + total[1, 1] + total[2, 2]
    translation_trace = total[3, 3] + total[4, 4] + total[5, 5]
    for i in range(3):
        total[i, i] += (damping + 1e-12) * rotation_trace
        total[3 + i, 3 + i] += (damping + 1e-12) * translation_trace
    for i in range(6):
        step[i] = right[i]
    return cholesky_solve(total, step)


@leaf
def descend(
    stack: Stack, sums: MomentSums, planar: bool, steps: int, candidate: Candidate, damping: float, work: Workspace
) -> tuple[int, float, float]:
    """Run Levenberg-Marquardt from one start, which becomes the minimum in place.

    Terms that fit much worse than the others are down-weighted.

    Args:
        planar: omit the epipolar part (κ = 0), as is necessary near the identity while the parallax is not yet
            explained.
        steps: maximum number of iterations.
        candidate: the start; receives the minimum.
        damping: of the first step.
        work: work arrays.

    Returns:
        number of iterations; the predicted decrease of the last step: half the squared length of the step, in standard
        deviations of the motion, below the tolerance if converged, 0 if no step lowers the cost; the current damping.
    """
    n, decrease, tolerance = stack.focal.shape[0], np.inf, DECREASE_OF_ONE_SD if planar else work.tolerance
    normal, gain, kappa, costs, term_weights, squares, _, right, step, _, _, trial, view, _ = work
    kappa[:] = 0.0
    term_weights[:] = 1.0
    for count in range(1, steps + 1):
        cost = 0.0
        for t in range(n):
            update_view(stack, t, candidate, view)
            if not planar:
                kappa[t], _ = estimate_view_variance(stack, sums, t, view)
            costs[t] = build_view_equations(stack, sums, t, kappa[t], candidate.depth_model[t], view, normal)
        if n > 2:
            _update_term_weights(costs, sums.moments, term_weights, squares)
        for t in range(n):
            cost += term_weights[t] * costs[t]
        accepted = False
        for _ in range(MAX_ROUNDS):
            if _solve_step(damping, work):
                length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
                if length > MAX_ROTATION_STEP:
                    for i in range(6):
                        step[i] *= MAX_ROTATION_STEP / length
                apply_rotvec(step[:3], candidate.rotation, trial.rotation)
                new, decrease = 0.0, 0.5 * dot(step, right)
                for i in range(3):
                    trial.translation[i] = candidate.translation[i] + step[3 + i]
                for t in range(n):
                    for i in range(3):
                        trial.depth_model[t, i] = candidate.depth_model[t, i] - gain[t, i, 6]
                        decrease += 0.5 * term_weights[t] * gain[t, i, 6] * normal.gradient[t, 6 + i]
                        for k in range(6):
                            trial.depth_model[t, i] -= gain[t, i, k] * step[k]
                    new += term_weights[t] * evaluate_term(stack, sums, t, kappa[t], trial, view)
                if new <= cost * (1.0 + 1e-12):
                    accepted = True
                    break
            damping = max(10.0 * damping, INITIAL_DAMPING)
        if not accepted:
            return count, 0.0, damping
        copy_into(candidate, trial)
        damping = max(0.1 * damping, 1e-9)
        if decrease < tolerance:
            return count, decrease, damping
    return steps, decrease, damping


@leaf
def compute_log_likelihood(stack: Stack, sums: MomentSums, candidate: Candidate, workspace: Workspace) -> float:
    """Return the log-likelihood of a minimum up to a constant, to compare minima."""
    total, n = 0.0, stack.focal.shape[0]
    means, squares, view = workspace.costs, workspace.squares, workspace.term_view
    for t in range(n):
        variance, count = sums.variance[t], sums.moments[t, 8, 8]
        update_view(stack, t, candidate, view)
        _, v = estimate_view_variance(stack, sums, t, view)
        square = compute_view_misfit(sums, t, view) / variance
        square += count * np.log(v / (2.0 * variance))
        for j in range(3):
            square += ((candidate.depth_model[t, j] - stack.plane_mean[t, j]) / stack.plane_sd[t, j]) ** 2
        # Bound the cost of a faulty camera by a multiple of the median per match, so that it does not decide.
        means[t] = squares[t] = square / count
    median = _lower_median(squares)
    for t in range(n):
        bound = MAX_COST_RATIO * (max(median, 0.0) + 1.0) if n > 2 else np.inf
        total += min(means[t], bound) * sums.moments[t, 8, 8]
    return -0.5 * total


@kernel
def estimate_affine_rotations(stack: Stack, sums: MomentSums, rotvecs: FloatArray) -> int:
    """Set `rotvecs` to rotation vectors that fit the affine maps of the matches.

    Args:
        rotvecs: (K, 3), filled with the points where one line of each term meets best, in this order.

    Returns:
        number of rotation vectors.
    """
    n, n_lines = stack.focal.shape[0], 0
    points, along = np.empty((n, 2, 3)), np.empty((n, 2, 3))
    translation = _estimate_translation(stack, sums)
    for t in range(n):
        n_lines += _compute_rotation_lines(stack, sums, t, translation, points[n_lines], along[n_lines])
    points, along = points[:n_lines], along[:n_lines]
    gaps, rotvec, chosen = np.full(len(rotvecs), np.inf), np.empty(3), np.empty(n_lines, np.int64)
    # Two lines meet somewhere; of each other term the line that passes nearer belongs to the same rotation. Of many terms,
    # a few are enough to begin with.
    n_first = min(n_lines, MAX_HYPOTHESES)
    for a in range(n_first):
        for b in range(a + 1, n_first):
            s, t = a * n_lines // n_first, b * n_lines // n_first
            for k in range(4):
                chosen[:] = -1
                chosen[s], chosen[t] = k & 1, k >> 1
                if not _intersect_lines(points, along, chosen, rotvec):
                    continue
                for other in range(n_lines):
                    if chosen[other] < 0:
                        first = _measure_distance(points[other, 0], along[other, 0], rotvec)
                        second = _measure_distance(points[other, 1], along[other, 1], rotvec)
                        chosen[other] = 0 if first <= second else 1
                # Lines that are nearly parallel meet beyond all rotations.
                if not _intersect_lines(points, along, chosen, rotvec) or dot(rotvec, rotvec) > np.pi**2:
                    continue
                gap = 0.0
                for term in range(n_lines):
                    gap += _measure_distance(points[term, chosen[term]], along[term, chosen[term]], rotvec)
                _insert_rotvec(rotvec, gap, rotvecs, gaps)
    return int(np.isfinite(gaps).sum())


@kernel
def _intersect_lines(points: FloatArray, along: FloatArray, chosen: IntArray, rotvec: FloatArray) -> bool:
    """Set rotvec (3,) to the point nearest to one chosen line of each term, or to none if -1; False without a point."""
    left = np.zeros((3, 3))
    rotvec[:] = 0.0
    for t in range(len(chosen)):
        if chosen[t] < 0:
            continue
        u, p = along[t, chosen[t]], points[t, chosen[t]]
        along_line = dot(p, u)
        for i in range(3):
            rotvec[i] += p[i] - along_line * u[i]
            for j in range(3):
                left[i, j] -= u[i] * u[j]
            left[i, i] += 1.0 + HALF_DIGITS
    return cholesky_solve(left, rotvec)


@leaf
def _measure_distance(point: FloatArray, along: FloatArray, rotvec: FloatArray) -> float:
    """Return the squared distance of a rotation vector from a line."""
    square, along_line = 0.0, 0.0
    for i in range(3):
        difference = rotvec[i] - point[i]
        square += difference * difference
        along_line += difference * along[i]
    return square - along_line * along_line


@kernel
def _insert_rotvec(rotvec: FloatArray, gap: float, rotvecs: FloatArray, gaps: FloatArray) -> None:
    """Insert a rotation vector into the list sorted by gaps unless it is a duplicate."""
    last = len(gaps) - 1
    for k in range(last + 1):
        difference = rotvecs[k] - rotvec
        if np.isfinite(gaps[k]) and dot(difference, difference) <= SAME_MOTION**2 * dot(rotvec, rotvec):
            return
    if not gap < gaps[last]:
        return
    k = last
    while k > 0 and gap < gaps[k - 1]:
        rotvecs[k], gaps[k] = rotvecs[k - 1], gaps[k - 1]
        k -= 1
    rotvecs[k], gaps[k] = rotvec, gap


@kernel
def _estimate_translation(stack: Stack, sums: MomentSums) -> FloatArray:
    """Estimate the translation (3,) of the object's center from the mean displacements."""
    left, right = np.zeros((3, 3)), np.zeros(3)
    for t in range(stack.focal.shape[0]):
        m, q = sums.moments[t], stack.qy[t]
        count = m[8, 8]
        for f in range(2):
            x, y = m[8, 6 + f] / count, m[8, 3 * f + 2] / count
            for i in range(3):
                row_i = (q[f, i] - x * q[2, i]) * stack.inverse_depth[t]
                right[i] += row_i * (y - x)
                for j in range(3):
                    left[i, j] += row_i * (q[f, j] - x * q[2, j]) * stack.inverse_depth[t]
    trace = left[0, 0] + left[1, 1] + left[2, 2]
    for i in range(3):
        left[i, i] += 1e-6 * trace
    if not cholesky_solve(left, right):
        right[:] = 0.0
    return right


@kernel
def _compute_rotation_lines(
    stack: Stack, sums: MomentSums, t: int, translation: FloatArray, points: FloatArray, along: FloatArray
) -> bool:
    """Compute a camera's two lines of rotations: points (2, 3) and directions (2, 3), world.

    Returns:
        whether the lines exist.
    """
    m, q = sums.moments[t], stack.qy[t]
    count = m[8, 8]
    if not count >= MIN_MATCHES:
        return False
    for i in range(3):
        for j in range(3):
            if abs(q[i, j] - stack.qx[t, i, j]) > COINCIDENCE_TOLERANCE:
                return False
    # The least-squares affine map.
    x0, x1 = m[8, 6] / count, m[8, 7] / count
    c00, c01, c11 = m[6, 6] / count - x0 * x0, m[6, 7] / count - x0 * x1, m[7, 7] / count - x1 * x1
    det = c00 * c11 - c01 * c01
    # Points on a line, up to noise, determine no map.
    if not det > sums.variance[t] * (c00 + c11):
        return False
    approach = (q[2, 0] * translation[0] + q[2, 1] * translation[1] + q[2, 2] * translation[2]) * stack.inverse_depth[t]
    a = np.empty((2, 2))
    for f in range(2):
        y = m[8, 3 * f + 2] / count
        b0, b1 = m[8, 3 * f] / count - y * x0, m[8, 3 * f + 1] / count - y * x1
        a[f, 0], a[f, 1] = (c11 * b0 - c01 * b1) / det, (c00 * b1 - c01 * b0) / det
        a[f, f] += approach - 1.0
    # det (a - ω J) = ω² + (a01 - a10) ω + det a = 0
    half = 0.5 * (a[1, 0] - a[0, 1])
    root = np.sqrt(max(half * half - (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]), 0.0))
    for k in range(2):
        omega = half + (root if k == 0 else -root)
        b00, b01, b10, b11 = a[0, 0], a[0, 1] + omega, a[1, 0] - omega, a[1, 1]
        # r is the image of b = r s', its longer column.
        first = b00 * b00 + b10 * b10 > b01 * b01 + b11 * b11
        r0, r1 = (b00, b10) if first else (b01, b11)
        length = np.sqrt(r0 * r0 + r1 * r1)
        if not length > 0.0:
            return False
        for i in range(3):
            points[k, i] = omega * q[2, i]
            along[k, i] = (-r1 * q[0, i] + r0 * q[1, i]) / length
    return True


class Minima(NamedTuple):
    """The K likeliest minima, best first.

    Attributes:
        rotations: (K, 3, 3).
        translations: (K, 3).
        depth_models: (K, T, 3) planar depth models.
        likelihoods: (K,) log-likelihoods, -inf for unused entries.
    """

    rotations: FloatArray
    translations: FloatArray
    depth_models: FloatArray
    likelihoods: FloatArray


@kernel
def make_minima(max_minima: int, terms: int) -> Minima:
    """Allocate `max_minima` minima for the given number of terms."""
    n = max_minima
    return Minima(np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, terms, 3)), np.full(n, -np.inf))


@kernel
def search_minima(stack: Stack, sums: MomentSums, guesses: InitialMotions, minima: Minima) -> int:
    """Find minima from the identity, from the mirror images of its minimum and from initial motions.

    Args:
        minima: receives the likeliest, best first; unused entries have a likelihood of -inf.

    Returns:
        number of iterations.
    """
    n, n_guesses = stack.focal.shape[0], guesses.rotations.shape[0]
    candidate, workspace = Candidate(np.eye(3), np.zeros(3), np.empty((n, 3))), make_workspace(n)
    minima.likelihoods[:] = -np.inf
    # Some optical axes, and a zero row for the reversed rotation.
    n_axes = min(n, MAX_HYPOTHESES)
    n_mirrors, axes = n_axes + 1, np.zeros((n_axes + 1, 3))
    for k in range(n_axes):
        axes[k] = stack.qx[k * n // n_axes, 2]
    affine_rotvecs = np.zeros((MAX_HYPOTHESES, 3))
    n_affine = estimate_affine_rotations(stack, sums, affine_rotvecs)
    rotvec, mirrored_rotvec = np.zeros(3), np.empty(3)
    first_translation, first_depth_model, count = np.zeros(3), np.zeros((n, 3)), 0
    # Try each mirror image twice: with near and far exchanged, and after steps with the planar part alone.
    for start in range(1 + 2 * n_mirrors + n_guesses + n_affine):
        mirror, guess = (start - 1) // 2, start - 1 - 2 * n_mirrors
        candidate.depth_model[:] = stack.plane_mean
        if start == 0:
            done, _, _ = descend(stack, sums, True, MAX_STEPS, candidate, INITIAL_DAMPING, workspace)
            count += done
        elif guess < 0:
            axis = axes[mirror]
            along = 2.0 * (rotvec[0] * axis[0] + rotvec[1] * axis[1] + rotvec[2] * axis[2])
            for i in range(3):
                mirrored_rotvec[i] = along * axis[i] - rotvec[i]
            so3_exp(mirrored_rotvec, candidate.rotation)
            candidate.translation[:] = first_translation
            if start % 2 == 1:
                for t in range(n):
                    for j in range(1, 3):
                        candidate.depth_model[t, j] = -first_depth_model[t, j]
        elif guess < n_guesses:
            candidate.rotation[:], candidate.translation[:] = guesses.rotations[guess], guesses.translations[guess]
        else:
            so3_exp(affine_rotvecs[guess - n_guesses], candidate.rotation)
            candidate.translation[:] = first_translation
        if 0 < start <= 2 * n_mirrors and start % 2 == 0:
            done, _, _ = descend(stack, sums, True, CHECK_STEPS, candidate, INITIAL_DAMPING, workspace)
            count += done
        decrease, damping = np.inf, INITIAL_DAMPING
        dropped = _is_known(candidate, minima)
        for k in range(MAX_STEPS):
            # Stop a start that approaches a known minimum or is far behind the best.
            if dropped or decrease < ROUGHLY_CONVERGED_DECREASE:
                break
            done, decrease, damping = descend(stack, sums, False, 1, candidate, damping, workspace)
            count += done
            dropped = _is_known(candidate, minima)
            if k == CHECK_STEPS - 1:
                value = compute_log_likelihood(stack, sums, candidate, workspace)
                dropped = dropped or value < minima.likelihoods[0] - MAX_LIKELIHOOD_GAP
        if dropped:
            continue
        value = compute_log_likelihood(stack, sums, candidate, workspace)
        if start == 0:
            so3_log(candidate.rotation, rotvec)
            first_translation[:] = candidate.translation
            first_depth_model[:] = candidate.depth_model
        if np.isfinite(value):
            _insert_minimum(candidate, value, minima)
    return count


@kernel
def _insert_minimum(candidate: Candidate, value: float, minima: Minima) -> None:
    """Insert a minimum into the sorted list unless it is a duplicate."""
    rotations, translations, depth_models, likelihoods = minima
    last = likelihoods.shape[0] - 1
    for k in range(last + 1):
        if likelihoods[k] > -np.inf and _is_same_motion(
            rotations[k], translations[k], candidate.rotation, candidate.translation
        ):
            if value <= likelihoods[k]:
                return
            last = k
            break
    if value <= likelihoods[last]:
        return
    k = last
    while k > 0 and value > likelihoods[k - 1]:
        rotations[k], translations[k], depth_models[k] = rotations[k - 1], translations[k - 1], depth_models[k - 1]
        likelihoods[k] = likelihoods[k - 1]
        k -= 1
    rotations[k], translations[k], depth_models[k] = candidate.rotation, candidate.translation, candidate.depth_model
    likelihoods[k] = value


@leaf
def _is_known(candidate: Candidate, minima: Minima) -> bool:
    """Return whether a candidate equals one of the minima."""
    for k in range(minima.likelihoods.shape[0]):
        if minima.likelihoods[k] > -np.inf and _is_same_motion(
            minima.rotations[k], minima.translations[k], candidate.rotation, candidate.translation
        ):
            return True
    return False


@leaf
def _is_same_motion(r1: FloatArray, d1: FloatArray, r2: FloatArray, d2: FloatArray) -> bool:
    """Return whether two minima are the same motion."""
    gap = 0.0
    for i in range(3):
        for j in range(3):
            gap += (r1[i, j] - r2[i, j]) ** 2
    distance = (d1[0] - d2[0]) ** 2 + (d1[1] - d2[1]) ** 2 + (d1[2] - d2[2]) ** 2
    length = d1[0] ** 2 + d1[1] ** 2 + d1[2] ** 2
    # Matrices of rotations that differ by a small angle have a distance of √2 times this angle.
    return gap < 2.0 * SAME_MOTION**2 and distance <= SAME_MOTION**2 * length
