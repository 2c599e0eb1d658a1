"""What a robust fit of one motion to terms says: the record that two-frame solvers and the tracker share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.terms import TermData
from sylpose.results import Status

__all__ = ["MIN_MATCHES", "Fit", "Solve", "Solved", "no_fit"]

# Eight matches in all cameras together leave two more equations than unknowns; fewer say nothing about themselves (choice).
MIN_MATCHES = 8


@dataclass(frozen=True, eq=False)
class Fit:
    """A robust fit of one motion to terms: what `estimate_motion` and the tracker share.

    Attributes:
        status: see `Status`.
        rotation: (3, 3) R and shift: (3,) d, X_j = R (X_i - g) + g + d; meaningless without `status.has_pose`.
        weights: per term (n,), 0 for outliers.
        residuals: per term (n,) signed epipolar distances, pixels.
        information: (6, 6) of (w, d).
        information_without_depth: (6, 6) the same when nothing is believed of its surfaces, neither how far away they are
            nor how curved.
        iterations: of the solver, all rounds.
        faults: a sentence for each camera that is recognised to be at fault.
        other: (R, d) of another motion that explains the matches about as well, and is far from this one; None without.
        mixed: whether residuals of neighbours are alike: two bodies that were taken for one, or a camera that is calibrated
            wrongly. The motion is then neither's, and its covariance means nothing.
        cost: negative log-likelihood of the matches, to compare fits of the same ones by.
        standing: the share of the matches that are taken to stand still while the object moves by little.
        at_ease: whether no camera is strained or was rejected (`strain`); False where that was not asked.
    """

    status: Status
    rotation: FloatArray
    shift: FloatArray
    weights: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    information: FloatArray
    information_without_depth: FloatArray
    iterations: int
    faults: tuple[str, ...] = ()
    other: tuple[FloatArray, FloatArray] | None = None
    mixed: bool = False
    cost: float = np.inf
    standing: float = 0.0
    at_ease: bool = False

    def with_matches(self, weights: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> Fit:
        """The same fit, spoken of as one of other terms."""
        return replace(self, weights=tuple(weights), residuals=tuple(residuals), at_ease=False)


class Solved(NamedTuple):
    """A fit and the place that was assumed of the object."""

    fit: Fit
    center: FloatArray
    radius: float


class Solve(Protocol):
    """Solves terms; `near` is tried as a start."""

    def __call__(self, terms: Sequence[TermData], near: Solved | None = None) -> Solved: ...


def no_fit(data: Sequence[TermData], status: Status) -> Fit:
    """What is returned for a status without a pose."""
    weights = tuple(np.zeros(len(term)) for term in data)
    nothing = np.zeros((6, 6))
    return Fit(status, np.eye(3), np.zeros(3), weights, weights, nothing, nothing, 0)
