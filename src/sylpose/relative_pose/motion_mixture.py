"""Mixtures of a motion with a second motion, or with a static background: their detection and their fits.

Two adjacent bodies that move nearly alike can be explained by one motion and a bent depth model. The residuals are then
slightly too large, which a robust weight does not detect. But residuals across epipolar lines are independent noise,
whereas a wrong motion causes similar errors for neighbors (`correlate_neighbors`).

Or they are interleaved, and a motion between the two explains most matches by a larger noise. Each camera's own motion then
does as well. But a match's residual is the larger, the more the difference of the two motions moves it: the squares of the
residuals depend on the derivatives by the motion, which noise does not (`measure_dependence`). The direction in which they
depend most on it and the signs of the residuals divide the matches (`divide_inliers`).

If both motions are known, many matches of one are near the epipolar lines of the other. Each match is then assigned to
one of them with a probability (`fit_motion_mixture`).

If an object moves by a few pixels, static matches are near the epipolar lines of its motion, too. Each match is then
static with some probability, and the motion is fitted to the others (`split_background`).

Source: contiguity, Moran, Biometrika 37, 1950; varying coefficients, White, Econometrica 48, 1980, Koenker, Journal of
Econometrics 17, 1981 (for noise that is not normal), Chesher, Econometrica 52, 1984; mixtures by expectation maximization,
McLachlan & Krishnan, "The EM Algorithm and Extensions", chapters 2 and 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import cholesky_solve, dot, kernel, so3_exp, so3_log
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.matches import MAX_STATIC_PX
from sylpose.relative_pose.camera_evidence import cross_rows, linearize_distances
from sylpose.relative_pose.irls import (
    MISMATCH_RANGE,
    IrlsFit,
    make_empty_irls_fit,
    make_irls_start,
    run_irls,
)
from sylpose.relative_pose.limits import (
    CUTOFF,
    HALF_DIGITS,
    MAX_ROUNDS,
    MAX_SAMPLES,
    MIN_ERROR_PX,
    MISMATCH_PROBABILITY,
    SIGMA_FLOOR_PX,
)
from sylpose.relative_pose.match_cost import (
    Tolerance,
    compute_distances,
    make_match_errors,
    make_term,
)
from sylpose.relative_pose.robust_fit import RefinedMinima, RobustFit, draw_and_fit, exceeds_chance
from sylpose.relative_pose.terms import MIN_MATCHES, Candidate, InitialMotions, Stack, copy_into, transform_to_camera

# Number of image neighbors that a match's residual is compared with (choice).
N_NEIGHBORS = 3
# Least weight for the comparison; matches below may belong to another motion (choice).
MIN_COMPARED_WEIGHT = 0.3
# Residuals are correlated if their correlation exceeds zero by so many standard deviations, of about 1.3 (measured: 150
# scenes of each of ten settings of benchmarks/nees.py with 120 matches per camera, 4.2 at most), and the second value: with
# many matches, small calibration errors are detected too (choice).
MIN_CORRELATION_SIGMAS, MIN_CORRELATION = 5.0, 0.15
# If a motion is weakly observed (`compute_size_if_curved`) or the assignment of matches is uncertain, a motion between
# two bodies is more frequent, and this is sufficient (measured: of 7,508 right answers 13 that are weakly observed are
# beyond, of 82 wrong ones 16).
MIN_SIGMAS_UNCERTAIN = 2.5
# Products of two of the six unknowns of a motion (derived).
N_PRODUCTS = 21
# The squares of residuals depend on the motion beyond this (derived: chi-squared, once in a hundred times).
MAX_DEPENDENCE = chi_squared_bound(N_PRODUCTS, 0.01)
# Largest change of an assignment at convergence; one motion's noise is at least this share of the other's, or of the static
# matches' (choice).
CONVERGED_CHANGE, MIN_SIGMA_RATIO = 0.02, 0.9
# Largest noise of static matches, pixels: their rms displacement, twice that, is at most `MAX_STATIC_PX` (derived).
MAX_STATIC_SIGMA_PX = 0.5 * MAX_STATIC_PX


@kernel
def correlate_neighbors(stack: Stack, fit: IrlsFit) -> tuple[float, float, float]:
    """Correlate the residuals of neighboring matches.

    Returns:
        the correlation; its number of standard deviations; the covariance, square pixels.
    """
    total, shared, pairs = 0.0, 0.0, 0
    index, nearest, squares = np.empty(MAX_SAMPLES, np.int64), np.empty(N_NEIGHBORS, np.int64), np.empty(N_NEIGHBORS)
    u, v = np.empty(MAX_SAMPLES), np.empty(MAX_SAMPLES)
    for t in range(stack.focal.shape[0]):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        n, stride = 0, 1 + (last - first) // MAX_SAMPLES
        for i in range(first, last, stride):
            if fit.weights[i] > MIN_COMPARED_WEIGHT:
                # Sort from left to right, so that neighbors are found first.
                k = n
                while k > 0 and u[k - 1] > stack.x[i, 0]:
                    index[k], u[k], v[k] = index[k - 1], u[k - 1], v[k - 1]
                    k -= 1
                index[k], u[k], v[k] = i, stack.x[i, 0], stack.x[i, 1]
                n += 1
        if n < MIN_MATCHES:
            continue
        for k in range(n):
            i = index[k]
            squares[:], nearest[:] = np.inf, i
            for direction in range(-1, 2, 2):
                j = k + direction
                while 0 <= j < n:
                    horizontal = (u[k] - u[j]) ** 2
                    if not horizontal < squares[N_NEIGHBORS - 1]:
                        break
                    far = horizontal + (v[k] - v[j]) ** 2
                    # A duplicate match is no evidence.
                    if far < squares[N_NEIGHBORS - 1] and far > 0.0:
                        place = N_NEIGHBORS - 1
                        while place > 0 and far < squares[place - 1]:
                            squares[place], nearest[place] = squares[place - 1], nearest[place - 1]
                            place -= 1
                        squares[place], nearest[place] = far, index[j]
                    j += direction
            for place in range(N_NEIGHBORS):
                if squares[place] < np.inf:
                    product = fit.residuals_px[i] * fit.residuals_px[nearest[place]]
                    shared += product
                    total += product / fit.sigma_px[t] ** 2
                    pairs += 1
    if pairs == 0:
        return 0.0, 0.0, 0.0
    return total / pairs, total / np.sqrt(pairs), shared / pairs


@kernel
def is_mixed(correlation: float, deviations: float, covariance: float, is_uncertain: bool) -> bool:
    """Return whether the correlation of neighbors exceeds what one motion and noise explain.

    Args:
        correlation, deviations, covariance: of `correlate_neighbors`.
        is_uncertain: whether the motion is weakly observed, or the assignment of matches is uncertain.
    """
    significant = deviations > (MIN_SIGMAS_UNCERTAIN if is_uncertain else MIN_CORRELATION_SIGMAS)
    return bool(significant and correlation > MIN_CORRELATION and covariance > MIN_ERROR_PX**2)


@kernel
def compute_motion_density(stack: Stack, fit: IrlsFit) -> FloatArray:
    """Return (N,) densities of the matches under the motion, per square pixel."""
    n_matches = len(stack.x)
    out, all_usable, matches = np.empty(n_matches), np.ones(n_matches), make_match_errors(n_matches)
    for t in range(len(stack.focal)):
        variance, residual_depth = (fit.sigma_px[t] / stack.focal[t]) ** 2, fit.residual_depth[t]
        term = make_term(stack, t, fit.candidate, Tolerance(variance, residual_depth, residual_depth, CUTOFF))
        compute_distances(stack, term, all_usable, matches)
        peak_density = 1.0 / (4.0 * np.pi * fit.sigma_px[t] ** 2)
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            spread = np.sqrt(1.0 + (residual_depth * matches.parallax[i]) ** 2 / variance)
            out[i] = peak_density * np.exp(-0.5 * min(matches.distance[i], 1e3)) / spread
    return out


def compute_mismatch_density(stack: Stack) -> FloatArray:
    """Return (N,) densities of the matches as mismatches, per square pixel."""
    return np.repeat(1.0 / (MISMATCH_RANGE * stack.spread * stack.focal) ** 2, np.diff(stack.offsets))


@kernel
def compute_cost(stack: Stack, usable: BoolArray, density: FloatArray) -> float:
    """Return the negative log-likelihood of densities (N,) per square pixel, comparable to the cost of `run_irls`."""
    cost = 0.0
    for t in range(len(stack.focal)):
        least = 0.5 / (MISMATCH_RANGE * stack.spread[t] * stack.focal[t]) ** 2
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if usable[i] and density[i] > least:
                cost -= np.log(density[i] / least)
    return cost


@kernel
def _linearize_inliers(stack: Stack, fit: IrlsFit) -> tuple[FloatArray, FloatArray]:
    """Return the epipolar residuals (N,) in units of their rms in each term, and their derivatives (N, 6) by the motion.

    Both are 0 for outliers.
    """
    residuals, slopes = np.zeros(len(stack.x)), np.zeros((len(stack.x), 6))
    rc, tc, rotated_center, axis, moved = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    essential, part, derivatives = np.empty((3, 3)), np.empty((3, 3)), np.empty((6, 3, 3))
    for t in range(len(stack.focal)):
        first, last, q = stack.offsets[t], stack.offsets[t + 1], stack.qy[t]
        transform_to_camera(stack, t, fit.candidate, rc, tc, rotated_center)
        cross_rows(tc, rc, essential)
        for k in range(3):
            # A rotation about g moves the camera relative to the object.
            axis[:] = q[:, k]
            moved[0] = axis[1] * rotated_center[2] - axis[2] * rotated_center[1]
            moved[1] = axis[2] * rotated_center[0] - axis[0] * rotated_center[2]
            moved[2] = axis[0] * rotated_center[1] - axis[1] * rotated_center[0]
            cross_rows(axis, rc, derivatives[3 + k])
            cross_rows(tc, derivatives[3 + k], derivatives[k])
            cross_rows(moved, rc, part)
            derivatives[k] += part
        x, y, weights = stack.x[first:last], stack.y[first:last], fit.weights[first:last]
        residuals[first:last], slopes[first:last] = linearize_distances(
            x, y, weights, essential, derivatives.reshape(6, 9)
        )
        count, squares = 0, 0.0
        for i in range(first, last):
            count += weights[i - first] > 0.0
            squares += residuals[i] ** 2
        rms = max(np.sqrt(squares / max(count, 1)), SIGMA_FLOOR_PX / stack.focal[t])
        residuals[first:last] /= rms
        slopes[first:last] /= rms
    return residuals, slopes


@kernel
def measure_dependence(stack: Stack, fit: IrlsFit) -> float:
    """Return White's test of a fit, chi-squared of `N_PRODUCTS` degrees of freedom if the residuals are noise.

    It is n R² of a regression of the squares of n residuals on the products of their derivatives, each term with a mean of
    its own; 0 with too few inliers. Of one camera, which shows no scale, only 14 products are independent: the test is
    then conservative.
    """
    residuals, slopes = _linearize_inliers(stack, fit)
    products, squares, n = np.empty((len(residuals), N_PRODUCTS)), np.empty(len(residuals)), 0
    for t in range(len(stack.focal)):
        start = n
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if fit.weights[i] > 0.0:
                squares[n], k = residuals[i] ** 2, 0
                for a in range(6):
                    for b in range(a + 1):
                        products[n, k] = slopes[i, a] * slopes[i, b]
                        k += 1
                n += 1
        if n > start:
            squares[start:n] -= squares[start:n].mean()
            for k in range(N_PRODUCTS):
                products[start:n, k] -= products[start:n, k].mean()
    if n <= N_PRODUCTS + len(stack.focal):
        return 0.0
    normal, right = products[:n].T @ products[:n], products[:n].T @ squares[:n]
    for k in range(N_PRODUCTS):
        # Units differ, and products may depend on each other.
        scale = 1.0 / (np.sqrt(normal[k, k]) + 1e-300)
        normal[k] *= scale
        normal[:, k] *= scale
        right[k] *= scale
        normal[k, k] += HALF_DIGITS
    solved = right.copy()
    if not cholesky_solve(normal, solved):
        return 0.0
    return float(n * dot(right, solved) / (dot(squares[:n], squares[:n]) + 1e-300))


def divide_inliers(stack: Stack, fit: IrlsFit) -> list[tuple[BoolArray, BoolArray]]:
    """Divide the inliers of a fit in two (N,), by the signs of residuals and derivatives along six directions of the motion.

    The squares of the residuals depend most on the first one; two bodies may differ in another one.
    """
    residuals, slopes = _linearize_inliers(stack, fit)
    excess, total = slopes.T @ ((residuals**2 - 1.0)[:, None] * slopes), slopes.T @ slopes
    if not (np.diag(total).min() > 0.0 and np.isfinite(total).all() and np.isfinite(excess).all()):
        return []
    _, directions = eigh(excess, total + HALF_DIGITS * np.diag(np.diag(total)))
    inliers = fit.weights > 0.0
    firsts = [inliers & (residuals * (slopes @ v) > 0.0) for v in directions[:, ::-1].T]
    return [(first, inliers & ~first) for first in firsts]


class MotionMixture(NamedTuple):
    """Mixture of two motions.

    Attributes:
        fits: the two motions; their weights include the assignment probabilities.
        probabilities: (2, N) the assignment probabilities.
        cost: negative log-likelihood of the matches.
        predicted_decrease: the predicted decrease of the last steps (`run_irls`), the larger of the two.
        iterations: of the solver.
    """

    fits: tuple[IrlsFit, IrlsFit]
    probabilities: FloatArray
    cost: float
    predicted_decrease: float
    iterations: int


def fit_motion_mixture(
    stack: Stack,
    starts: Sequence[tuple[FloatArray, FloatArray]],
    inliers: Sequence[BoolArray],
    max_rounds: int = MAX_ROUNDS,
) -> MotionMixture:
    """Fit a mixture of two motions by expectation maximization.

    Args:
        starts: two motions (R, d).
        inliers: (N,) their inliers, which may overlap.
        max_rounds: of expectation maximization; few suffice to compare starts.
    """
    fits, probabilities = (make_empty_irls_fit(stack), make_empty_irls_fit(stack)), np.zeros((2, len(stack.x)))
    decreases, iterations = [np.inf, np.inf], 0
    for k, ((rotation, translation), own_inliers) in enumerate(zip(starts, inliers, strict=True)):
        fits[k].candidate.rotation[:], fits[k].candidate.translation[:] = rotation, translation
        iterations += run_irls(stack, (own_inliers & ~inliers[1 - k]).astype(float), fits[k], SIGMA_FLOOR_PX)[0]
    shares, all_usable = np.full(2, 0.5), np.ones(len(stack.x), dtype=bool)
    mismatch_density = MISMATCH_PROBABILITY * compute_mismatch_density(stack)
    for _ in range(max_rounds):
        densities = [compute_motion_density(stack, f) for f in fits]
        joint = np.stack([s * (1.0 - MISMATCH_PROBABILITY) * d for s, d in zip(shares, densities, strict=True)])
        previous, probabilities = probabilities, joint / (joint.sum(axis=0) + mismatch_density)
        shares = probabilities.sum(axis=1) / max(float(probabilities.sum()), 1e-300)
        for k in range(2):
            # Bound the noise ratio: otherwise a few accidental matches with little noise would form a body.
            min_sigma_px = MIN_SIGMA_RATIO * float(np.median(fits[1 - k].sigma_px))
            done, decreases[k], _ = run_irls(stack, probabilities[k], fits[k], min_sigma_px)
            iterations += done
        if np.abs(probabilities - previous).max() < CONVERGED_CHANGE or not max(decreases) < np.inf:
            break
    density = shares[0] * compute_motion_density(stack, fits[0]) + shares[1] * compute_motion_density(stack, fits[1])
    return MotionMixture(fits, probabilities, compute_cost(stack, all_usable, density), max(decreases), iterations)


# Displacements whose squares, in units of noise, exceed this have moved; chance exceeds it with the next probability
# (chi-squared of two degrees of freedom).
MIN_MOVED_SQUARE, CHANCE_SHARE = 9.2, 0.01
# Mismatches are displaced farther than this (measured: without it, an object at rest with 5 % mismatches is mostly static,
# instead of without motion, in 25 of 25 scenes).
MAX_MOVED_SQUARE = 200.0
# Least log-likelihood gain of a mixture over one motion (measured: docs/history/benchmarks.md#hard-pairs; for motions of 1
# to 4 px without a background 2.1 at most in 24 scenes).
MIN_LIKELIHOOD_GAIN = 3.0
# Least number of matches of a body that moves, or of inliers by which a camera shows it: as many as a fit needs, and as many
# again (derived).
MIN_MOVING_MATCHES = 2 * MIN_MATCHES
# Factors by which the motion of a part may exceed that of all matches (choice).
MOTION_FACTORS = (1.25, 1.5, 2.0, 3.0, 5.0, 8.0)
# Largest loss of log-likelihood of such a motion: two standard deviations, 2² / 2 (derived).
MAX_LIKELIHOOD_LOSS = 2.0


class BackgroundSplit(NamedTuple):
    """Motion separated from its static background.

    Attributes:
        result: fit of the moving matches; its weights include the probabilities. Its minima and iterations are those of
            the mixtures from several starts.
        moving_probability: (N,) the probabilities of the matches to move.
        likelihood_gain: log-likelihood gain over a single motion of all matches.
    """

    result: RobustFit
    moving_probability: FloatArray
    likelihood_gain: float

    def rebase_minima(self, cost: float) -> RefinedMinima:
        """Return the minima with costs relative to a single motion of this cost."""
        minima = self.result.minima
        return minima._replace(costs=minima.costs - minima.costs.min() + cost - self.likelihood_gain)


class _Mixture(NamedTuple):
    """Result of expectation maximization.

    Attributes:
        fit: the motion.
        moving_probability, static_probability: (N,) the probabilities of each match to move and to be static.
        sigma: noise of the static matches, pixels.
        cost: negative log-likelihood of the mixture.
        predicted_decrease, iterations: of `run_irls` in the last round, and of all rounds.
    """

    fit: IrlsFit
    moving_probability: FloatArray
    static_probability: FloatArray
    sigma: float
    cost: float
    predicted_decrease: float
    iterations: int


def has_moving_matches(stack: Stack, usable: BoolArray, single: IrlsFit) -> bool:
    """Return whether more matches have moved by little than a static scene explains.

    Mismatches move farther.
    """
    squared_px = _compute_squared_px(stack)
    squares = 0.5 * squared_px / _estimate_static_sigma(squared_px, usable, single) ** 2
    moved_count = int((usable & (squares > MIN_MOVED_SQUARE) & (squares < MAX_MOVED_SQUARE)).sum())
    by_chance = CHANCE_SHARE * usable.sum()
    return bool(moved_count > by_chance + CUTOFF * np.sqrt(by_chance))


def split_background(
    stack: Stack,
    usable: BoolArray,
    single: IrlsFit,
    gain: float,
    guesses: InitialMotions,
    rng: np.random.Generator,
) -> BackgroundSplit | None:
    """Fit a motion to some of the matches and a static background to the others.

    Args:
        usable: (N,) matches that may be inliers.
        single: the fit of a single motion to all of them; it may have no inliers.
        gain: log-likelihood gain of a background, from `bound_hidden_motion`, which detects a possible one.

    Returns:
        the separated motion; None if a single motion is sufficient.
    """
    squared_px = _compute_squared_px(stack)
    sigma, static_probability = _split_displacements(squared_px, usable)
    if not static_probability[usable].sum() >= max(MIN_MATCHES, MISMATCH_PROBABILITY * len(squared_px)):
        return None
    # If even the smallest displacements exceed the noise, nothing is static.
    has_single = single.weights.any()
    if has_single and not gain > 0.0 and sigma > float(np.median(single.sigma_px)):
        return None
    starts, iterations = [single] if has_single else [], 0
    moves = usable & (static_probability < 0.5)
    if moves.sum() >= MIN_MOVING_MATCHES:
        fit, _, iterations, *_ = draw_and_fit(stack, moves, guesses, rng)
        starts = [fit, *starts] if fit.weights.any() else starts
    mixtures = [_fit_mixture(stack, usable, start, squared_px, sigma, static_probability) for start in starts]
    mixtures = [mixture for mixture in mixtures if _is_valid_mixture(stack, usable, mixture, guesses, rng)]
    if not mixtures:
        return None
    best = min(mixtures, key=lambda mixture: mixture.cost)
    candidates = [mixture.fit.candidate for mixture in mixtures]
    rotations, translations = np.array([c.rotation for c in candidates]), np.array([c.translation for c in candidates])
    costs, counts = np.array([mixture.cost for mixture in mixtures]), np.full(len(mixtures), float(usable.sum()))
    iterations += sum(mixture.iterations for mixture in mixtures)
    alone = compute_motion_density(stack, single) if has_single else _compute_static_density(squared_px, best.sigma)
    total_gain = compute_cost(stack, usable, alone) - best.cost
    result = RobustFit(
        best.fit, RefinedMinima(rotations, translations, costs, counts), iterations, best.predicted_decrease, False
    )
    return BackgroundSplit(result, best.moving_probability, total_gain)


def bound_hidden_motion(stack: Stack, usable: BoolArray, single: IrlsFit) -> tuple[float, float]:
    """Bound the size of the motion if some matches are static background.

    The mean displacement is the same if half of the matches move by twice as much; only its scatter is larger.

    Returns:
        the factor by which the motion may be larger than that of all matches: 1 if it cannot be, the last of
        `MOTION_FACTORS` if the matches give no bound; the log-likelihood gain of a background, -inf if there cannot be
        one.
    """
    squared_px = _compute_squared_px(stack)
    scaled = make_irls_start(stack, single.candidate, single.sigma_px)
    scaled.residual_depth[:] = single.residual_depth
    static_density = _compute_static_density(squared_px, float(np.median(single.sigma_px)))
    return _bound_motion_factor(stack, usable, single.candidate, scaled, static_density)


@kernel
def _bound_motion_factor(
    stack: Stack, usable: BoolArray, single: Candidate, scaled: IrlsFit, static_density: FloatArray
) -> tuple[float, float]:
    """Compute `bound_hidden_motion` for a motion and densities (N,) of static matches.

    `scaled` provides the noise and is overwritten.
    """
    rotvec, max_factor, single_cost, min_cost = np.empty(3), 1.0, 0.0, np.inf
    so3_log(single.rotation, rotvec)
    for k in range(1 + len(MOTION_FACTORS)):
        factor = MOTION_FACTORS[k - 1] if k > 0 else 1.0
        copy_into(scaled.candidate, single)
        so3_exp(factor * rotvec, scaled.candidate.rotation)
        scaled.candidate.translation[:] = factor * single.translation
        motion_density = compute_motion_density(stack, scaled)
        if k == 0:
            single_cost = compute_cost(stack, usable, motion_density)
        share = max(1.0 - 1.0 / factor, MISMATCH_PROBABILITY)
        for _ in range(MAX_ROUNDS):
            total, count = 0.0, 0
            for i in range(len(motion_density)):
                if usable[i]:
                    density = share * static_density[i] + (1.0 - share) * motion_density[i]
                    total += share * static_density[i] / max(density, 1e-300)
                    count += 1
            before, share = share, total / count
            if abs(share - before) < HALF_DIGITS:
                break
        cost = compute_cost(stack, usable, share * static_density + (1.0 - share) * motion_density)
        # The first cost is that of no background.
        if cost > min(min_cost, single_cost) + MAX_LIKELIHOOD_LOSS:
            return max_factor, single_cost - min(min_cost, cost)
        min_cost, max_factor = min(min_cost, cost), factor
    return max_factor, single_cost - min_cost


def _estimate_static_sigma(squared_px: FloatArray, usable: BoolArray, single: IrlsFit) -> float:
    """Estimate the noise of static matches, pixels.

    It is that of the inliers, or less if the smallest displacements show less.
    """
    sigma = float(np.median(single.sigma_px)) if single.weights.any() else np.inf
    sorted_px = np.sort(squared_px[usable])
    # Half of a squared displacement of two coordinates, of twice the variance, is below its median half of the time.
    least = sorted_px[: max(len(sorted_px) // 4, 1)]
    quartile_sigma = float(np.sqrt(least[-1] / (4.0 * -np.log(0.75)))) if len(least) else 1.0
    if np.isfinite(quartile_sigma) and quartile_sigma > 0.0:
        sigma = min(sigma, quartile_sigma)
    return float(np.clip(sigma, SIGMA_FLOOR_PX, MAX_STATIC_SIGMA_PX))


@kernel
def _compute_squared_px(stack: Stack) -> FloatArray:
    """Return (N,) squared displacements, square pixels."""
    out = np.empty(len(stack.x))
    for t in range(len(stack.focal)):
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            dx, dy = stack.y[i, 0] - stack.x[i, 0], stack.y[i, 1] - stack.x[i, 1]
            out[i] = (dx * dx + dy * dy) * stack.focal[t] ** 2
    return out


@kernel
def has_static_candidates(stack: Stack, usable: BoolArray) -> bool:
    """Return whether enough matches have small displacements for a background.

    Displacements in terms with other references than the motion's (earlier frames, moved by a known motion) are no
    evidence.
    """
    count = 0
    for t in range(len(stack.focal)):
        for i in range(3):
            if stack.a1[t, i] != stack.a2[t, i]:
                return False
            for j in range(3):
                if stack.qx[t, i, j] != stack.qy[t, i, j]:
                    return False
        far = (MAX_STATIC_PX / stack.focal[t]) ** 2
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            dx, dy = stack.y[i, 0] - stack.x[i, 0], stack.y[i, 1] - stack.x[i, 1]
            count += usable[i] and dx * dx + dy * dy < far
    return count >= max(MIN_MATCHES, MISMATCH_PROBABILITY * len(stack.x))


def _split_displacements(squared_px: FloatArray, usable: BoolArray) -> tuple[float, FloatArray]:
    """Split squared displacements (N,) into two kinds of noise; large ones belong to neither.

    Returns:
        the smaller noise, as a standard deviation in pixels of a keypoint; (N,) the probability of each match to belong
        to it.
    """
    near = squared_px < MAX_STATIC_PX**2
    sorted_px = np.sort(squared_px[usable & near])
    # A square of two coordinates is exponential; its mean is four times the variance of one keypoint coordinate.
    small_mean, large_mean = (max(float(part.mean()), 1e-12) for part in np.array_split(sorted_px, 2))
    # A regular subset is sufficient; one memory layout is compiled.
    samples = np.ascontiguousarray(sorted_px[:: 1 + len(sorted_px) // MAX_SAMPLES])
    share, small_mean, large_mean = _fit_exponentials(samples, small_mean, large_mean)
    odds, rate = (1.0 - share) / share * small_mean / large_mean, 1.0 / small_mean - 1.0 / large_mean
    static_probability = 1.0 / (1.0 + odds * np.exp(np.minimum(squared_px * rate, 700.0)))
    return float(np.sqrt(small_mean / 4.0)), np.where(near, static_probability, 0.0)


@kernel
def _fit_exponentials(samples: FloatArray, small_mean: float, large_mean: float) -> tuple[float, float, float]:
    """Fit two exponential distributions, starting from the means of the halves.

    Returns:
        the share of the smaller one, and the means of both.
    """
    share, n = 0.5, len(samples)
    for _ in range(MAX_ROUNDS):
        odds, rate = (1.0 - share) / share * small_mean / large_mean, 1.0 / small_mean - 1.0 / large_mean
        mass, square, rest = 0.0, 0.0, 0.0
        for i in range(n):
            p = 1.0 / (1.0 + odds * np.exp(min(samples[i] * rate, 700.0)))
            mass += p
            square += p * samples[i]
            rest += (1.0 - p) * samples[i]
        # At least half a sample is of each kind.
        before, share = share, min(max(mass, 0.5), n - 0.5) / n
        small_mean = max(square / mass, 4.0 * SIGMA_FLOOR_PX**2)
        large_mean = max(rest / max(n - mass, 1e-300), small_mean)
        if abs(share - before) < HALF_DIGITS:
            break
    return share, small_mean, large_mean


def _fit_mixture(
    stack: Stack,
    usable: BoolArray,
    start: IrlsFit,
    squared_px: FloatArray,
    sigma: float,
    probability: FloatArray,
) -> _Mixture:
    """Run expectation maximization from one motion, the noise of static matches, and their probabilities (N,)."""
    fit = make_irls_start(stack, start.candidate, start.sigma_px)
    fit.residual_depth[:] = start.residual_depth
    # At least one match of each kind is possible.
    share_range = 1.0 / usable.sum(), 1.0 - MISMATCH_PROBABILITY - 1.0 / usable.sum()
    share = float(np.clip(probability[usable].mean(), *share_range))
    moving_probability, decrease, iterations = np.zeros(len(squared_px)), np.inf, 0
    probabilities, mismatch_density = np.zeros((3, len(squared_px))), compute_mismatch_density(stack)
    for _ in range(MAX_ROUNDS):
        static = share * _compute_static_density(squared_px, sigma)
        moving = (1 - MISMATCH_PROBABILITY - share) * compute_motion_density(stack, fit)
        probabilities = np.stack([static, moving, MISMATCH_PROBABILITY * mismatch_density])
        probabilities = np.where(usable, probabilities / probabilities.sum(axis=0), 0.0)
        share = float(np.clip(probabilities[0].sum() / usable.sum(), *share_range))
        # Static matches have at most the noise of moving ones: the noise of the motion includes its model error.
        variance = (probabilities[0] * squared_px).sum() / max(4.0 * probabilities[0].sum(), 1e-300)
        sigma = float(np.clip(np.sqrt(variance), SIGMA_FLOOR_PX, MAX_STATIC_SIGMA_PX))
        change = float(np.abs(probabilities[1] - moving_probability).max())
        moving_probability = probabilities[1]
        # Otherwise a few accidental matches, nearly without noise, would become the motion.
        done, decrease, _ = run_irls(stack, moving_probability, fit, MIN_SIGMA_RATIO * sigma)
        iterations += done
        if change < CONVERGED_CHANGE or not decrease < np.inf:
            break
    share /= 1.0 - MISMATCH_PROBABILITY
    density = share * _compute_static_density(squared_px, sigma) + (1.0 - share) * compute_motion_density(stack, fit)
    cost = compute_cost(stack, usable, density)
    return _Mixture(fit, moving_probability, probabilities[0], sigma, cost, decrease, iterations)


def _is_valid_mixture(
    stack: Stack, usable: BoolArray, mixture: _Mixture, guesses: InitialMotions, rng: np.random.Generator
) -> bool:
    """Return whether enough moving matches agree with the motion, beyond chance."""
    if not mixture.moving_probability.sum() >= MIN_MOVING_MATCHES:
        return False
    others = usable & (mixture.static_probability < 0.5)
    fit = make_irls_start(stack, mixture.fit.candidate, mixture.fit.sigma_px)
    _, _, cost = run_irls(stack, others.astype(np.float64), fit, SIGMA_FLOOR_PX)
    return exceeds_chance(stack, others, float(cost), int((fit.weights > 0.0).sum()), guesses, rng)


@kernel
def _compute_static_density(squared_px: FloatArray, sigma: float) -> FloatArray:
    """Return (N,) densities of the matches as static ones, per square pixel."""
    out = np.empty(len(squared_px))
    for i in range(len(squared_px)):
        out[i] = np.exp(-0.25 * squared_px[i] / sigma**2) / (4.0 * np.pi * sigma**2)
    return out
