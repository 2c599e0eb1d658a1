"""Optimizer of the bundle adjustment, with fixed or refined calibration.

Levenberg-Marquardt with re-weighting: K. Levenberg, "A method for the solution of certain non-linear problems in least
squares", 1944; D. Marquardt, 1963.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sylpose.bundle_adjustment.calibration_refinement import (
    free_calibration,
    relinearize_lenses,
    rescale_calibration_prior,
)
from sylpose.bundle_adjustment.problem import Fit, FitSummary, Problem, State
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.results import Status
from sylpose.rig import Rig

__all__ = ["minimize", "refine_with_calibration"]


# The noise is re-estimated until it changes by less than this, or for so many iterations; then it is fixed (choice).
SIGMA_TOLERANCE, MAX_SIGMA_ITERATIONS = 0.05, 8
# Weights are updated until the step's square, in standard deviations and per frame, is less than this, or for so many
# iterations; then they are fixed: each weight that still changes moves the rest slightly, in ever more iterations
# (choice).
WEIGHTS_TOLERANCE, MAX_WEIGHT_ITERATIONS = 0.02, 10
# Converged when the step of all frames together is a tenth of a standard deviation: the remaining error is much smaller
# (choice).
STEP_TOLERANCE = 0.1**2
# Attempts per iteration to find a step that reduces the cost (choice).
MAX_TRIES = 8
# Number of lens linearizations (choice: each leaves a hundredth of the error).
LENS_LINEARIZATIONS = 3


def minimize(
    problem: Problem,
    state: State,
    max_iterations: int,
    on_iteration: Callable[[int], None] | None,
    *,
    coarse: bool = False,
) -> Fit:
    """Run Levenberg-Marquardt with re-weighting from a state until it converges.

    With `coarse`, stop where the weights would be fixed: the remaining error is a seventh of a standard deviation per
    frame.
    """
    e = problem.compute_residuals(state)
    sigma = np.full(len(problem.focals), np.inf)
    leverage = np.full(len(e), min(1.0, 3.0 * len(state.points) / max(len(e), 1)))
    damping, is_sigma_fixed, fixed_weights = 0.0, False, None
    for iteration in range(1, max_iterations + 1):
        if on_iteration is not None:
            on_iteration(iteration)
        if not is_sigma_fixed:
            previous_sigma, sigma = sigma, problem.estimate_noise(e, leverage)
            state = problem.reset_stray_landmarks(state, e, sigma)
            e = problem.compute_residuals(state)
            is_sigma_fixed = (
                bool(np.all(np.abs(sigma - previous_sigma) < SIGMA_TOLERANCE * sigma))
                or iteration >= MAX_SIGMA_ITERATIONS
            )
        cost = problem.compute_cost(e, sigma, state, fixed_weights)
        views = problem.view_frames(state)
        weights = problem.compute_weights(e, sigma) if fixed_weights is None else fixed_weights
        scaled = weights / sigma[problem.observations.camera] ** 2
        system = problem.build_system(state, views, scaled)
        leverage = system.reduced.leverage
        for _ in range(MAX_TRIES):
            step, z, size = system.solve(damping)
            trial = problem.apply_step(state, views, scaled, step, z)
            e = problem.compute_residuals(trial)
            if (
                problem.compute_cost(e, sigma, trial, fixed_weights) <= cost * (1.0 + 1e-12)
                or size < 1e-3 * STEP_TOLERANCE
            ):
                break
            damping = max(30.0 * damping, 1e-5)
        else:
            return Fit(state, Status.NOT_CONVERGED, iteration, weights, sigma, leverage)
        damping = damping / 30.0 if damping > 1e-5 else 0.0
        state = problem.update_derivatives(trial)
        if problem.has_time_shifts:
            e = problem.compute_residuals(state)
        if is_sigma_fixed and size < (WEIGHTS_TOLERANCE * len(state.rotations) if coarse else STEP_TOLERANCE):
            return Fit(state, Status.OK, iteration, weights, sigma, leverage)
        if (
            is_sigma_fixed
            and fixed_weights is None
            and (size < WEIGHTS_TOLERANCE * len(state.rotations) or iteration >= MAX_WEIGHT_ITERATIONS)
        ):
            fixed_weights = problem.compute_weights(e, sigma)
    return Fit(state, Status.NOT_CONVERGED, max_iterations, weights, sigma, leverage)


def refine_with_calibration(
    problem: Problem,
    fit: Fit,
    rig: Rig,
    image: FloatArray,
    connected: BoolArray,
    max_iterations: int,
    on_iteration: Callable[[int], None] | None,
) -> tuple[Problem, Fit, FitSummary]:
    """Refine with the calibration estimated as well.

    The first pass uses the observations as they are and measures the size of the calibration errors and the correlation
    of errors. Correlated errors resemble calibration errors, and the information of observations is smaller by their
    variance inflation. So the calibration prior is narrowed correspondingly for the last pass.

    Args:
        image: (n, 2) points as normalized by the rig.
    """
    problem = free_calibration(problem)
    for _ in range(LENS_LINEARIZATIONS):
        fit = minimize(problem, fit.state, max_iterations, on_iteration)
        problem, state = rescale_calibration_prior(
            problem, fit.state, problem.summarize(fit, connected).calibration_scales
        )
        problem, fit = relinearize_lenses(problem, image, rig, state.z), replace(fit, state=state)
    fit = minimize(problem, fit.state, max_iterations, on_iteration)
    summary, scales = problem.summarize(fit, connected), problem.camera_parameters.scales
    # The noise floor of the search already inflates the variance in part.
    inflation = np.median(summary.variance_inflation[problem.observations.free_index >= 0]) * np.mean(
        (summary.sigma / fit.sigma) ** 2
    )
    scale_factors = np.where(np.arange(4) > 0, max(inflation, 1.0) ** -0.5, 1.0)
    fit = minimize(*rescale_calibration_prior(problem, fit.state, scales * scale_factors), max_iterations, on_iteration)
    state = replace(fit.state, z=fit.state.z * scale_factors[problem.camera_parameters.kind])
    return problem, replace(fit, state=state), summary
