"""Errors and normal equations of one term's matches, in newly allocated arrays."""

from __future__ import annotations

import numpy as np

from sylpose.relative_pose.match_cost import (
    InlierPrior,
    MatchEquations,
    MatchErrors,
    Tolerance,
    build_match_equations,
    make_match_equations,
    make_match_errors,
    make_term,
)
from sylpose.relative_pose.terms import Candidate, Stack


def compute_match_errors(
    stack: Stack,
    t: int,
    candidate: Candidate,
    tolerance: Tolerance,
    usable: InlierPrior | None = None,
    *,
    noise: bool = True,
) -> tuple[MatchErrors, MatchEquations]:
    """Allocate and run `build_match_equations` for term t; the errors are those of its own matches."""
    n = len(stack.x)
    matches, equations = make_match_errors(n), make_match_equations(noise)
    usable_weights = np.ones(n) if usable is None else usable.astype(np.float64)
    build_match_equations(stack, make_term(stack, t, candidate, tolerance), usable_weights, matches, equations)
    rows = slice(stack.offsets[t], stack.offsets[t + 1])
    return MatchErrors(*(values[rows] for values in matches)), equations
