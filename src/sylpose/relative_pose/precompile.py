"""Precompilation of the two-frame solver, as a whole or in parts that processes can compile in parallel."""

from __future__ import annotations

import numpy as np

from sylpose.relative_pose.curvature_correction import minimize_across_valley
from sylpose.relative_pose.fit import make_failed_fit
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX, make_empty_irls_fit, run_irls
from sylpose.relative_pose.match_likelihood import compute_missing_information
from sylpose.relative_pose.moments_cost import MomentSums, compute_moments
from sylpose.relative_pose.motion_mixture import correlate_neighbors
from sylpose.relative_pose.observability import classify_observability
from sylpose.relative_pose.search import find_minima
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import Stack, TermData, locate_object, stack_initial_motions, stack_terms
from sylpose.results import Status

__all__ = ["warm_up", "warm_up_diagnostics", "warm_up_irls", "warm_up_search"]


def warm_up() -> None:
    """Compile what `fit_terms` runs, or load it from the cache: a minute or two at first, then a third of a second."""
    fit_terms(_make_terms(), np.zeros(3), 0.1, [], np.random.default_rng(0))
    warm_up_diagnostics()


def warm_up_search() -> None:
    """Compile the search for minima only."""
    stack = _make_stack()
    sums = MomentSums(np.empty((2, 9, 9)), np.full(2, 1e-6))
    for t in range(2):
        compute_moments(stack.x[t * 12 : t * 12 + 12], stack.y[t * 12 : t * 12 + 12], np.ones(12), sums.moments[t])
    find_minima(stack, sums, stack_initial_motions([]), 2)


def warm_up_irls() -> None:
    """Compile the re-weighted fit only."""
    stack = _make_stack()
    run_irls(stack, np.ones(len(stack.x)), make_empty_irls_fit(stack), SIGMA_FLOOR_PX)


def warm_up_diagnostics() -> None:
    """Compile the diagnostics of a fit only."""
    classify_observability(make_failed_fit(_make_terms(), Status.OK), 0.1)
    locate_object(_make_terms())
    stack = _make_stack()
    correlate_neighbors(stack, make_empty_irls_fit(stack))
    compute_missing_information(stack, make_empty_irls_fit(stack), np.full(len(stack.x), 0.5))
    minimize_across_valley(
        stack, np.ones(len(stack.x)), make_empty_irls_fit(stack), np.zeros(6), np.zeros(6), np.zeros(6)
    )


def _make_terms() -> list[TermData]:
    x = np.random.default_rng(0).uniform(-0.1, 0.1, (12, 2))
    return [TermData(k, x, x + 0.01 * k, np.eye(3), np.array([k - 0.5, 0.0, -1.0]), 1000.0) for k in range(2)]


def _make_stack() -> Stack:
    return stack_terms(_make_terms(), np.zeros(3), 0.1)
