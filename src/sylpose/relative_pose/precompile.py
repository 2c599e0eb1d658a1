"""What there is to compile of two frames: as a whole, and the larger parts of it, which processes may compile beside each
other."""

from __future__ import annotations

import numpy as np

from sylpose.relative_pose.curvature_correction import settle_across
from sylpose.relative_pose.fit import no_fit
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX, nothing_yet, reweight
from sylpose.relative_pose.match_likelihood import missing
from sylpose.relative_pose.moments_cost import Sums, moments_into
from sylpose.relative_pose.motion_mixture import alike
from sylpose.relative_pose.observability import judged
from sylpose.relative_pose.search import search_all
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import Stack, TermData, guesses_of, object_place, stack_terms
from sylpose.results import Status

__all__ = ["warm_up", "warm_up_reweighting", "warm_up_search", "warm_up_verdicts"]


def warm_up() -> None:
    """Compiles what `fit_terms` runs, or loads it where that has been done: a third of a second, a minute or two once."""
    fit_terms(_data(), np.zeros(3), 0.1, [], np.random.default_rng(0))
    warm_up_verdicts()


def warm_up_search() -> None:
    """The search for minima alone."""
    stack = _stack()
    sums = Sums(np.empty((2, 9, 9)), np.full(2, 1e-6))
    for t in range(2):
        moments_into(stack.x[t * 12 : t * 12 + 12], stack.y[t * 12 : t * 12 + 12], np.ones(12), sums.moments[t])
    search_all(stack, sums, guesses_of([]), 2)


def warm_up_reweighting() -> None:
    """The re-weighted fit alone."""
    stack = _stack()
    reweight(stack, np.ones(len(stack.x)), nothing_yet(stack), SIGMA_FLOOR_PX)


def warm_up_verdicts() -> None:
    """What decides what a fit is worth alone."""
    judged(no_fit(_data(), Status.OK), 0.1)
    object_place(_data())
    stack = _stack()
    alike(stack, nothing_yet(stack))
    missing(stack, nothing_yet(stack), np.full(len(stack.x), 0.5))
    settle_across(stack, np.ones(len(stack.x)), nothing_yet(stack), np.zeros(6), np.zeros(6), np.zeros(6))


def _data() -> list[TermData]:
    x = np.random.default_rng(0).uniform(-0.1, 0.1, (12, 2))
    return [TermData(k, x, x + 0.01 * k, np.eye(3), np.array([k - 0.5, 0.0, -1.0]), 1000.0) for k in range(2)]


def _stack() -> Stack:
    return stack_terms(_data(), np.zeros(3), 0.1)
