"""Messages between camera nodes that align the same object's landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import pack_upper, unpack_symmetric

# Positions of the hessian's diagonal in its upper triangle, and its relative enlargement in
# `TermsMessage.to_single_precision`: rounding to 24 bits changes less than a tenth of that (derived).
DIAGONAL, DIAGONAL_MARGIN = [0, 6, 11, 15, 18, 20], 1e-6


@dataclass(frozen=True, eq=False)
class TermsMessage:
    """A camera's message in an iteration.

    Attributes:
        upper: (27,) its terms for the pose, with its depth model eliminated: the upper triangle of the hessian (6, 6)
            of (w, d), row by row, and the gradient.
        weight_sum: the sum of its weights.
        noise_px: its noise, or NaN.
    """

    upper: FloatArray
    weight_sum: float
    noise_px: float

    @classmethod
    def from_reduced(cls, reduced: FloatArray, weight_sum: float, noise_px: float) -> TermsMessage:
        """Make a message from hessian and gradient (6, 7)."""
        return cls(np.concatenate([pack_upper(reduced[:, :6]), reduced[:, 6]]), weight_sum, noise_px)

    def to_single_precision(self) -> TermsMessage:
        """Return the message in half the bytes, each number with 24 bits; the hessian stays positive definite."""
        upper = self.upper.copy()
        upper[DIAGONAL] *= 1.0 + DIAGONAL_MARGIN
        return TermsMessage(upper.astype(np.float32).astype(float), self.weight_sum, self.noise_px)

    @property
    def reduced(self) -> FloatArray:
        """(6, 7) hessian and gradient."""
        return np.column_stack([unpack_symmetric(self.upper[:21]), self.upper[21:]])


@dataclass(frozen=True, eq=False)
class EvaluationMessage:
    """A camera's evaluation of the final pose.

    Attributes:
        cost, reference_cost: the sum of its robust costs, weighted by `prior_weight`, at its noise and at
            `camera_terms.REFERENCE_NOISE_PX`.
        inliers, matches: numbers of inliers and of matches.
        prior_weight: the sum of the matches' `prior_weight`.
    """

    cost: float
    reference_cost: float
    inliers: int
    matches: int
    prior_weight: float


Message = TypeVar("Message", EvaluationMessage, TermsMessage)


class Exchange(Protocol):
    """Send this camera's messages on several poses to all others, wait for theirs, and return all, by camera."""

    def __call__(
        self, messages: tuple[Message, ...], defaults: tuple[Message, ...], /
    ) -> Sequence[tuple[Message, ...]]:
        """Exchange messages.

        Args:
            messages: this camera's messages.
            defaults: messages of a camera without matches, which replace those of unreachable cameras.
        """
