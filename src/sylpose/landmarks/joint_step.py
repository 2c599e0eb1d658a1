"""Joint part of `alignment`: one Gauss-Newton step from all cameras' terms, and their variance inflation.

A deterministic function of the cameras' numbers, with equal results on every node that received them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import apply_rotvec, cholesky, cholesky_solve, kernel, solve_factored
from sylpose.geometry.robust_loss import RIG_PRIOR_MATCHES

# Iterations in which noise and variance inflation are updated; then they are constant, and the rest converges (choice).
SETTLING_ITERATIONS = 5
MAX_ITERATIONS = 40
MIN_SIGMA_PX = 0.2
# Expected disagreement of a camera with the others: the mean of chi-squared with six degrees of freedom (chi-squared).
MEAN_CHI_SQUARED = 6.0
# Multiples of that which are not due to chance (chi-squared: once in 160 times).
OUTLIER_RATIO = 3.0
INFLATION_ITERATIONS = 8
# A disagreeing camera is down-weighted further if its information on the rotation exceeds the median camera's by this
# factor (choice: more than in most rigs).
MAX_INFORMATION_RATIO = 10.0
# Maximum rotation of a step, radians (choice).
MAX_ROTATION_STEP = 0.5
# Converged when the step is a twentieth of its standard deviation: another iteration would not pay (choice).
STEP_TOLERANCE = 0.05**2


class AlignmentState(NamedTuple):
    """Shared state of C cameras; updated in place.

    Attributes:
        rotation, translation: (3, 3) and (3,), the pose.
        sigma_px, rig_px: (C,) each camera's noise, and (1,) the rig's.
        variance_inflation: (C,) variance inflation factor of each camera's terms.
        information: (6, 6) of (w, d), from all cameras.
        step, previous_step: (6,) the last step and the one before, of (w, d), before extrapolation.
    """

    rotation: FloatArray
    translation: FloatArray
    sigma_px: FloatArray
    rig_px: FloatArray
    variance_inflation: FloatArray
    information: FloatArray
    step: FloatArray
    previous_step: FloatArray


@kernel
def compute_disagreement(reduced: FloatArray, inflation: FloatArray, chi_squared: FloatArray) -> None:
    """Write each camera's disagreement with the others to chi_squared (C,).

    Without a fault it is chi-squared with six degrees of freedom.

    At the others' solution x its gradient is g + H x, with covariance H + H A⁻¹ H, A being the others' information.
    """
    n = len(inflation)
    others, x, gradient, spread, column = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((6, 6)), np.empty(6)
    for c in range(n):
        others[:] = 0.0
        x[:] = 0.0
        for o in range(n):
            if o != c:
                for i in range(6):
                    x[i] -= reduced[o, i, 6] / inflation[o]
                    for j in range(6):
                        others[i, j] += reduced[o, i, j] / inflation[o]
        chi_squared[c] = 0.0
        for i in range(6):
            others[i, i] += 1e-6 * others[i, i] + 1e-9 * reduced[c, i, i] + 1e-300
        if not cholesky(others):
            continue
        solve_factored(others, x)
        for j in range(6):
            gradient[j] = reduced[c, j, 6]
            for i in range(6):
                gradient[j] += reduced[c, j, i] * x[i]
                column[i] = reduced[c, i, j]
            solve_factored(others, column)
            for i in range(6):
                spread[i, j] = reduced[c, i, j]
                for k in range(6):
                    spread[i, j] += reduced[c, i, k] * column[k]
            spread[j, j] += 1e-9 * spread[j, j] + 1e-300
        column[:] = gradient
        if cholesky_solve(spread, column):
            for i in range(6):
                chi_squared[c] += gradient[i] * column[i]


@kernel
def inflate_variances(reduced: FloatArray, inflation: FloatArray) -> None:
    """Update (C,) the variance inflation of each camera's terms.

    An inflated camera weighs less in the comparison of the others, so the inconsistent one is identified.
    """
    chi_squared, rotation_traces, n_active = np.empty(len(inflation)), np.empty(len(inflation)), 0
    for c in range(len(inflation)):
        if np.trace(reduced[c, :, :6]) > 0.0:
            rotation_traces[n_active] = reduced[c, 0, 0] + reduced[c, 1, 1] + reduced[c, 2, 2]
            n_active += 1
    max_information = MAX_INFORMATION_RATIO * float(np.median(rotation_traces[:n_active])) if n_active > 0 else 0.0
    for _ in range(INFLATION_ITERATIONS):
        compute_disagreement(reduced, inflation, chi_squared)
        for c in range(len(inflation)):
            excess = max(1.0, chi_squared[c] / MEAN_CHI_SQUARED)
            if n_active > 2:
                # Beyond chance the influence of a camera decreases with its disagreement instead of leveling off. With
                # two cameras, either may be the wrong one.
                excess *= max(1.0, excess / OUTLIER_RATIO)
                if excess > OUTLIER_RATIO and max_information > 0.0:
                    excess *= max(1.0, (reduced[c, 0, 0] + reduced[c, 1, 1] + reduced[c, 2, 2]) / max_information)
            inflation[c] = np.sqrt(inflation[c] * excess)


@kernel
def is_noise_estimated(iteration: int, first: int) -> bool:
    """Return whether an iteration estimates the noise; `first` is the number of iterations with an assumed one."""
    return first <= iteration <= first + SETTLING_ITERATIONS


@kernel
def _update_noise(state: AlignmentState, weight_sums: FloatArray, noise: FloatArray) -> None:
    """Update each camera's noise, regularized towards the rig's, from its estimate (C,), NaN for none.

    Args:
        weight_sums: (C,) sums of the cameras' weights.
        noise: (C,) estimates, pixels.
    """
    n, known, levels = len(weight_sums), 0, np.empty(len(weight_sums))
    for c in range(n):
        if np.isfinite(noise[c]):
            state.sigma_px[c] = max(noise[c], MIN_SIGMA_PX)
            levels[known] = state.sigma_px[c]
            known += 1
    if known == 0:
        state.rig_px[0] = state.sigma_px[0]
        return
    rig = float(np.median(levels[:known]))
    for c in range(n):
        own = state.sigma_px[c] if weight_sums[c] > 0.0 else rig
        state.sigma_px[c] = np.sqrt(
            (weight_sums[c] * own * own + RIG_PRIOR_MATCHES * rig * rig) / (weight_sums[c] + RIG_PRIOR_MATCHES)
        )
    state.rig_px[0] = rig


@kernel
def take_joint_step(
    state: AlignmentState,
    reduced: FloatArray,
    weight_sums: FloatArray,
    noise: FloatArray,
    schedule: FloatArray,
    iteration: int,
    is_last: bool,
) -> tuple[bool, bool]:
    """Take one Gauss-Newton step, in place.

    Args:
        reduced, weight_sums: (C, 6, 7) the cameras' terms (`compute_camera_terms`), (C,) the sums of their weights.
        noise: (C,) their noise where `is_noise_estimated`.
        schedule: (S,) noise assumed in the first iterations, pixels.
        iteration: number of the iteration, from 1.
        is_last: whether only the information is required.

    Returns:
        whether a step was taken; whether it was negligible.
    """
    n, first = len(weight_sums), len(schedule)
    settling = iteration <= first + SETTLING_ITERATIONS
    if iteration == 1 and (weight_sums > 0.0).any():
        # Initially all cameras have about equal weight, whatever their numbers of matches.
        middle = float(np.median(weight_sums[weight_sums > 0.0]))
        for c in range(n):
            state.variance_inflation[c] = max(state.variance_inflation[c], weight_sums[c] / middle)
    if settling:
        inflate_variances(reduced, state.variance_inflation)
    factor, right, step = np.empty((6, 6)), np.zeros(6), state.step
    state.information[:] = 0.0
    for c in range(n):
        for i in range(6):
            right[i] += reduced[c, i, 6] / state.variance_inflation[c]
            for j in range(6):
                state.information[i, j] += reduced[c, i, j] / state.variance_inflation[c]
    if is_last:
        return False, True
    if is_noise_estimated(iteration, first):
        _update_noise(state, weight_sums, noise)
    for i in range(6):
        step[i] = -right[i]
        for j in range(6):
            factor[i, j] = state.information[i, j]
        factor[i, i] += 1e-9 * state.information[i, i] + 1e-300
    if not cholesky_solve(factor, step) or not np.isfinite(step).all():
        return False, False
    size = step @ state.information @ step
    if iteration > first:
        # Re-weighting converges linearly; Aitken's extrapolation of its steps reduces that to a few iterations.
        previous_size = float(state.previous_step @ state.information @ state.previous_step)
        ratio = float(step @ state.information @ state.previous_step) / max(previous_size, 1e-300)
        state.previous_step[:] = step
        if not settling and iteration % 3 == 0:
            step /= 1.0 - min(max(ratio, -1.0), 0.85)
    step /= max(1.0, np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2) / MAX_ROTATION_STEP)
    rotated = np.empty((3, 3))
    apply_rotvec(step[:3], state.rotation, rotated)
    state.rotation[:] = rotated
    for i in range(3):
        state.translation[i] += step[3 + i]
    if iteration < first:
        state.sigma_px[:] = schedule[iteration]
    return True, not settling and float(size) < STEP_TOLERANCE
