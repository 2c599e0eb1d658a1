"""The search for the joint refinement's optimum, with the calibration as it is or refined as well.

Levenberg-Marquardt with re-weighting: K. Levenberg, "A method for the solution of certain non-linear problems in least
squares", 1944; D. Marquardt, 1963.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sylpose.bundle_adjustment.calibration_refinement import freed, relinearised, rescaled
from sylpose.bundle_adjustment.problem import Fit, Problem, State, Summary
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.results import Status
from sylpose.rig import Rig

__all__ = ["minimise", "refined"]


# The noise level follows the residuals until it changes by less than this, or for so many rounds; then it is held (choice).
SIGMA_SETTLED, SIGMA_ROUNDS = 0.05, 8
# Weights follow the residuals until the step's square, in standard deviations and per frame, is less than this, or for
# so many rounds; then they are held: each that is still about to change draws the rest on a little, in ever more rounds
# (choice).
WEIGHTS_SETTLED, WEIGHTS_ROUNDS = 0.02, 10
# Converged when the step, all frames together, is a tenth of a standard deviation: what is left after it is much less
# (choice).
SETTLED = 0.1**2
# Attempts per round to find a step that lowers the cost (choice).
MAX_TRIES = 8
# Lenses that are refined are linearised so often (choice: each time leaves a hundredth of the error).
RELINEARISED = 3


def minimise(
    problem: Problem,
    state: State,
    max_rounds: int,
    on_round: Callable[[int], None] | None,
    *,
    roughly: bool = False,
) -> Fit:
    """Levenberg-Marquardt with re-weighting, from a state to where it settles; roughly, to where the weights would be held:
    what is then left is a seventh of a standard deviation per frame."""
    e = problem.residuals(state)
    sigma = np.full(len(problem.focals), np.inf)
    leverage = np.full(len(e), min(1.0, 3.0 * len(state.points) / max(len(e), 1)))
    damping, settled, held = 0.0, False, None
    for rounds in range(1, max_rounds + 1):
        if on_round is not None:
            on_round(rounds)
        if not settled:
            before, sigma = sigma, problem.noise(e, leverage)
            state = problem.with_strays_back(state, e, sigma)
            e = problem.residuals(state)
            settled = bool(np.all(np.abs(sigma - before) < SIGMA_SETTLED * sigma)) or rounds >= SIGMA_ROUNDS
        cost = problem.cost(e, sigma, state, held)
        views = problem.views(state)
        weights = problem.weights(e, sigma) if held is None else held
        scaled = weights / sigma[problem.sightings.camera] ** 2
        system = problem.system(state, views, scaled)
        leverage = system.reduced.leverage
        for _ in range(MAX_TRIES):
            step, z, size = system.solve(damping)
            trial = problem.moved(state, views, scaled, step, z)
            e = problem.residuals(trial)
            if problem.cost(e, sigma, trial, held) <= cost * (1.0 + 1e-12) or size < 1e-3 * SETTLED:
                break
            damping = max(30.0 * damping, 1e-5)
        else:
            return Fit(state, Status.NOT_CONVERGED, rounds, weights, sigma, leverage)
        damping = damping / 30.0 if damping > 1e-5 else 0.0
        state = problem.with_motion(trial)
        if problem.timed:
            e = problem.residuals(state)
        if settled and size < (WEIGHTS_SETTLED * len(state.turns) if roughly else SETTLED):
            return Fit(state, Status.OK, rounds, weights, sigma, leverage)
        if settled and held is None and (size < WEIGHTS_SETTLED * len(state.turns) or rounds >= WEIGHTS_ROUNDS):
            held = problem.weights(e, sigma)
    return Fit(state, Status.NOT_CONVERGED, max_rounds, weights, sigma, leverage)


def refined(
    problem: Problem,
    fit: Fit,
    rig: Rig,
    image: FloatArray,
    tied: BoolArray,
    max_rounds: int,
    on_round: Callable[[int], None] | None,
) -> tuple[Problem, Fit, Summary]:
    """With the calibration estimated, too; image (n, 2) are the points as the rig normalises them.

    First as the observations ask, which shows how far off it is, and how alike their errors are. Errors that are alike look
    like a wrong calibration, and observations tell as much less of it as they have a larger variance than independent ones:
    so what is believed of it holds it as much closer to what was given.
    """
    problem = freed(problem)
    for _ in range(RELINEARISED):
        fit = minimise(problem, fit.state, max_rounds, on_round)
        problem, state = rescaled(problem, fit.state, problem.summary(fit, tied).doubt_shares)
        problem, fit = relinearised(problem, image, rig, state.z), replace(fit, state=state)
    fit = minimise(problem, fit.state, max_rounds, on_round)
    summary, believed = problem.summary(fit, tied), problem.shared.shares
    # The search takes the noise for no less than its floor, and so for larger by a part of it already.
    larger = np.median(summary.excess[problem.sightings.free >= 0]) * np.mean((summary.sigma / fit.sigma) ** 2)
    closer = np.where(np.arange(4) > 0, max(larger, 1.0) ** -0.5, 1.0)
    fit = minimise(*rescaled(problem, fit.state, believed * closer), max_rounds, on_round)
    state = replace(fit.state, z=fit.state.z * closer[problem.shared.kind])
    return problem, replace(fit, state=state), summary
