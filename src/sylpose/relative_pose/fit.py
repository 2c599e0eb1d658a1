"""Result record of a robust fit of one motion, shared by the two-frame solvers and the tracker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.terms import TermData
from sylpose.results import Status

__all__ = ["MIN_MATCHES", "Fit", "Solution", "TermSolver", "make_failed_fit"]

# Eight matches over all cameras leave two more equations than unknowns; fewer give no redundancy (choice).
MIN_MATCHES = 8


@dataclass(frozen=True, eq=False)
class Fit:
    """Robust fit of one motion to terms, shared by `estimate_motion` and the tracker.

    Attributes:
        status: see `Status`.
        rotation: (3, 3) R, of X_j = R (X_i - g) + g + d; meaningless without `status.has_pose`.
        translation: (3,) d, likewise.
        weights: per term (n,), 0 for outliers.
        residuals: per term (n,) signed epipolar distances, pixels.
        information: (6, 6) of (w, d).
        information_without_depth: (6, 6) the same without the prior on the depth models (distance and curvature).
        iterations: of the solver, all rounds.
        faults: one sentence for each camera identified as faulty.
        alternative: (R, d) of a distant alternative motion that explains the matches about as well; None without.
        is_mixed: whether neighboring residuals are correlated: two bodies fitted as one, or a wrongly calibrated
            camera. The motion then belongs to neither, and its covariance is meaningless.
        cost: negative log-likelihood of the matches, to compare fits of the same matches.
        static_ratio: share of the matches assigned to a static background while the object moves by little.
        cameras_consistent: whether no camera is inconsistent or rejected (`is_consistent_per_camera`); False where this
            was not checked.
    """

    status: Status
    rotation: FloatArray
    translation: FloatArray
    weights: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    information: FloatArray
    information_without_depth: FloatArray
    iterations: int
    faults: tuple[str, ...] = ()
    alternative: tuple[FloatArray, FloatArray] | None = None
    is_mixed: bool = False
    cost: float = np.inf
    static_ratio: float = 0.0
    cameras_consistent: bool = False

    def with_matches(self, weights: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> Fit:
        """Return the same fit with the weights and residuals of other terms."""
        return replace(self, weights=tuple(weights), residuals=tuple(residuals), cameras_consistent=False)


class Solution(NamedTuple):
    """Fit, and the object center and radius that it assumes."""

    fit: Fit
    center: FloatArray
    radius: float


class TermSolver(Protocol):
    """Solver of terms; `start` is tried as an initial motion."""

    def __call__(self, terms: Sequence[TermData], start: Solution | None = None) -> Solution: ...


def make_failed_fit(data: Sequence[TermData], status: Status) -> Fit:
    """Return a fit without a pose, with this status."""
    weights = tuple(np.zeros(len(term)) for term in data)
    nothing = np.zeros((6, 6))
    return Fit(status, np.eye(3), np.zeros(3), weights, weights, nothing, nothing, 0)
