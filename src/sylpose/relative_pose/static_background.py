"""Separation of a static background from an object that moves by little.

If an object moves by a few pixels, static matches are near the epipolar lines of its motion, too. Each match is then
static with some probability, and the motion is fitted to the others (`split_background`). Because the assignment is
uncertain, the information is reduced: by the squared contribution of each match to the motion, times the probabilities
that it belongs to the motion and that it does not.

Source: mixtures by expectation maximization, McLachlan & Krishnan, "The EM Algorithm and Extensions", chapters 2 and 4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel, so3_exp, so3_log
from sylpose.relative_pose.irls import IrlsFit, make_irls_start, run_irls
from sylpose.relative_pose.motion_mixture import (
    MISMATCH_PROBABILITY,
    compute_cost,
    compute_mismatch_density,
    compute_motion_density,
)
from sylpose.relative_pose.observability import is_consistent
from sylpose.relative_pose.robust_fit import RefinedMinima, RobustFit, draw_and_fit
from sylpose.relative_pose.terms import MIN_MATCHES, Candidate, InitialMotions, Stack, copy_into

# Of the displacements between these squares, in units of noise, at most this share and this number are due to chance
# (chi-squared of two degrees of freedom: 1 %, and three times it; choice).
MIN_MOVED_SQUARE, MAX_MOVED_SQUARE, MAX_CHANCE_SHARE, MIN_MOVED_MATCHES = 9.2, 200.0, 0.03, 6
# A background is assumed possible if at least this share of the matches may be static (choice).
MIN_BACKGROUND_SHARE = 0.08
# Larger displacements are not static whatever the noise; those beyond the second value are ignored by the static model,
# pixels (choice).
MAX_STATIC_PX, MAX_MODELED_PX = 6.0, 18.0
# Bounds of the noise of static matches, pixels, and of their share of all matches, some of which are mismatches
# (choice).
SIGMA_RANGE_PX, SHARE_RANGE = (0.02, 3.0), (1e-3, 0.999 - MISMATCH_PROBABILITY)
# Maximum number of rounds for the split of displacements and for the mixture, and the largest change of an assignment
# at convergence (choice).
MAX_SPLIT_ROUNDS, MAX_ROUNDS, CONVERGED_CHANGE = 50, 15, 0.02
# Approximate number of displacements used for the split, and the change of the share at convergence (choice).
MAX_COMPARED, CONVERGED_SHARE_CHANGE = 256, 1e-6
# Upper bound of the noise of moving matches relative to static ones, and the least noise assumed for the latter, which
# may be exact: two frames of a pause (choice).
MAX_MOVING_SIGMA_RATIO, MIN_STATIC_SIGMA_PX = 5.0, 0.1
# A start within three standard deviations of a motion leads to that motion (choice).
SAME_MOTION_SQUARE = 9.0
# Least log-likelihood gain of a mixture over one motion (measured: docs/history/benchmarks.md#hard-pairs; for motions of 1
# to 4 px without a background 2.1 at most in 24 scenes), and the least number of moving matches (choice).
MIN_LIKELIHOOD_GAIN, MIN_MOVING_MATCHES = 3.0, 2 * MIN_MATCHES
# Factors by which the motion of a part may exceed that of all matches; rounds to estimate the static share; and the
# largest loss of log-likelihood, two standard deviations (choice).
MOTION_FACTORS, SHARE_ROUNDS, MAX_LIKELIHOOD_LOSS = (1.25, 1.5, 2.0, 3.0, 5.0, 8.0), 8, 2.0
# Lower bound of the noise of moving matches relative to static ones, and upper bound of the latter relative to all
# matches (choice).
MIN_MOVING_SIGMA_RATIO, MAX_STATIC_SIGMA_RATIO = 0.9, 1.2


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
    return bool(moved_count > MAX_CHANCE_SHARE * usable.sum() + MIN_MOVED_MATCHES)


def split_background(
    stack: Stack,
    usable: BoolArray,
    single: IrlsFit,
    likelihood_gain: float,
    guesses: InitialMotions,
    rng: np.random.Generator,
) -> BackgroundSplit | None:
    """Fit a motion to some of the matches and a static background to the others.

    Args:
        usable: (N,) matches that may be inliers.
        single: the fit of a single motion to all of them; it may have no inliers.
        likelihood_gain: log-likelihood gain of a background, from `bound_hidden_motion`, which detects a possible one.

    Returns:
        the separated motion; None if a single motion is sufficient.
    """
    squared_px = _compute_squared_px(stack)
    sigma, static_probability = _split_displacements(squared_px, usable)
    if not static_probability[usable].sum() >= max(MIN_MATCHES, MIN_BACKGROUND_SHARE * len(squared_px)):
        return None
    # If even the smallest displacements exceed the noise, nothing is static.
    has_single, max_sigma = single.weights.any(), MAX_STATIC_SIGMA_RATIO * float(np.median(single.sigma_px))
    if has_single and not likelihood_gain > 0.0 and sigma > max_sigma:
        return None
    starts, iterations = [single] if has_single else [], 0
    moves = usable & (static_probability < 0.5)
    if moves.sum() >= MIN_MOVING_MATCHES:
        fit, _, iterations, _ = draw_and_fit(stack, moves, guesses, rng)
        starts = [fit, *starts] if fit.weights.any() else starts
    mixtures: list[_Mixture] = []
    for start in starts:
        # Skip starts near a motion that was found from another start.
        if not any(_is_near(mixture.fit, start) for mixture in mixtures):
            mixtures.append(_fit_mixture(stack, usable, start, squared_px, sigma, static_probability))
    mixtures = [mixture for mixture in mixtures if _is_valid_mixture(stack, usable, mixture)]
    if not mixtures:
        return None
    best = min(mixtures, key=lambda mixture: mixture.cost)
    minima = RefinedMinima(
        np.array([mixture.fit.candidate.rotation for mixture in mixtures]),
        np.array([mixture.fit.candidate.translation for mixture in mixtures]),
        np.array([mixture.cost for mixture in mixtures]),
        np.full(len(mixtures), float(usable.sum())),
    )
    iterations += sum(mixture.iterations for mixture in mixtures)
    alone = compute_motion_density(stack, single) if has_single else _compute_static_density(squared_px, best.sigma)
    gain = compute_cost(stack, usable, alone) - best.cost
    result = RobustFit(best.fit, minima, iterations, best.predicted_decrease)
    return BackgroundSplit(result, best.moving_probability, gain)


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
        share = max(1.0 - 1.0 / factor, MIN_BACKGROUND_SHARE)
        for _ in range(SHARE_ROUNDS):
            total, count = 0.0, 0
            for i in range(len(motion_density)):
                if usable[i]:
                    density = share * static_density[i] + (1.0 - share) * motion_density[i]
                    total += share * static_density[i] / max(density, 1e-300)
                    count += 1
            share = total / count
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
    return max(min(sigma, quartile_sigma if np.isfinite(quartile_sigma) and quartile_sigma > 0 else sigma, 3.0), 0.02)


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
    return count >= max(MIN_MATCHES, MIN_BACKGROUND_SHARE * len(stack.x))


def _split_displacements(squared_px: FloatArray, usable: BoolArray) -> tuple[float, FloatArray]:
    """Split squared displacements (N,) into two kinds of noise; large ones belong to neither.

    Returns:
        the smaller noise, as a standard deviation in pixels of a keypoint; (N,) the probability of each match to belong
        to it.
    """
    near = squared_px < MAX_MODELED_PX**2
    sorted_px = np.sort(squared_px[usable & near])
    # A square of two coordinates is exponential; its mean is four times the variance of one keypoint coordinate.
    small_mean, large_mean = (max(float(part.mean()), 1e-12) for part in np.array_split(sorted_px, 2))
    samples = sorted_px[:: 1 + len(sorted_px) // MAX_COMPARED]  # a regular subset is sufficient
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
    for _ in range(MAX_SPLIT_ROUNDS):
        odds, rate = (1.0 - share) / share * small_mean / large_mean, 1.0 / small_mean - 1.0 / large_mean
        mass, square, rest = 0.0, 0.0, 0.0
        for i in range(n):
            p = 1.0 / (1.0 + odds * np.exp(min(samples[i] * rate, 700.0)))
            mass += p
            square += p * samples[i]
            rest += (1.0 - p) * samples[i]
        before, share = share, min(max(mass / n, 1e-3), 1.0 - 1e-3)
        small_mean = max(square / mass, 4.0 * SIGMA_RANGE_PX[0] ** 2)
        large_mean = max(rest / max(n - mass, 1e-300), small_mean)
        if abs(share - before) < CONVERGED_SHARE_CHANGE:
            break
    return share, small_mean, large_mean


def _fit_mixture(
    stack: Stack,
    usable: BoolArray,
    start: IrlsFit,
    squared_px: FloatArray,
    sigma: float,
    static_probability: FloatArray,
) -> _Mixture:
    """Run expectation maximization from one motion, the noise of static matches, and their probabilities (N,)."""
    fit = make_irls_start(stack, start.candidate, start.sigma_px)
    fit.residual_depth[:] = start.residual_depth
    share = float(np.clip(static_probability[usable].mean(), *SHARE_RANGE))
    moving_probability, decrease, iterations = np.zeros(len(squared_px)), np.inf, 0
    probabilities, mismatch_density = np.zeros((3, len(squared_px))), compute_mismatch_density(stack)
    for _ in range(MAX_ROUNDS):
        static = share * _compute_static_density(squared_px, sigma)
        moving = (1 - MISMATCH_PROBABILITY - share) * compute_motion_density(stack, fit)
        probabilities = np.stack([static, moving, MISMATCH_PROBABILITY * mismatch_density])
        probabilities = np.where(usable, probabilities / probabilities.sum(axis=0), 0.0)
        share = float(np.clip(probabilities[0].sum() / usable.sum(), *SHARE_RANGE))
        # Static matches have at most the noise of moving ones: the noise of the motion includes its model error.
        variance = (probabilities[0] * squared_px).sum() / max(4.0 * probabilities[0].sum(), 1e-300)
        sigma = float(np.clip(np.sqrt(variance), *SIGMA_RANGE_PX))
        change = float(np.abs(probabilities[1] - moving_probability).max())
        moving_probability = probabilities[1]
        # Otherwise a few accidental matches, nearly without noise, would become the motion.
        done, decrease, _ = run_irls(stack, moving_probability, fit, MIN_MOVING_SIGMA_RATIO * sigma)
        iterations += done
        if change < CONVERGED_CHANGE or not decrease < np.inf:
            break
    share /= 1.0 - MISMATCH_PROBABILITY
    density = share * _compute_static_density(squared_px, sigma) + (1.0 - share) * compute_motion_density(stack, fit)
    cost = compute_cost(stack, usable, density)
    return _Mixture(fit, moving_probability, probabilities[0], sigma, cost, decrease, iterations)


def _is_near(fit: IrlsFit, start: IrlsFit) -> bool:
    """Return whether a start is indistinguishable from a motion that was found."""
    rotvec = np.empty(3)
    so3_log(start.candidate.rotation @ fit.candidate.rotation.T, rotvec)
    step = np.concatenate([rotvec, start.candidate.translation - fit.candidate.translation])
    return bool(step @ fit.information @ step < SAME_MOTION_SQUARE)


def _is_valid_mixture(stack: Stack, usable: BoolArray, mixture: _Mixture) -> bool:
    """Return whether enough moving matches agree with the motion, beyond chance and about as exactly as static ones."""
    if float(np.median(mixture.fit.sigma_px)) > MAX_MOVING_SIGMA_RATIO * max(mixture.sigma, MIN_STATIC_SIGMA_PX):
        return False
    others = usable & (mixture.static_probability < 0.5)
    moving_fit = mixture.fit._replace(weights=np.where(others, mixture.fit.weights, 0.0))
    return bool(mixture.moving_probability.sum() >= MIN_MOVING_MATCHES and is_consistent(stack, others, moving_fit))


@kernel
def _compute_static_density(squared_px: FloatArray, sigma: float) -> FloatArray:
    """Return (N,) densities of the matches as static ones, per square pixel."""
    out = np.empty(len(squared_px))
    for i in range(len(squared_px)):
        out[i] = np.exp(-0.25 * squared_px[i] / sigma**2) / (4.0 * np.pi * sigma**2)
    return out
