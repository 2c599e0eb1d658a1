"""What cameras that align the same landmarks' object tell each other: two small records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import symmetric_of, upper_of

__all__ = ["DIAGONAL", "Exchange", "Judges", "Says"]

# Where the diagonal of a hessian is in its upper triangle, and by which share it is larger in `Says.coarse`: 24 bits round
# off less than a tenth of that (derived).
DIAGONAL, DAMPED = [0, 6, 11, 15, 18, 20], 1e-6


@dataclass(frozen=True, eq=False)
class Says:
    """What a camera tells all others in a round.

    Attributes:
        upper: (27,) what it says of the pose, without its surface: the upper triangle of the hessian (6, 6) of (w, d), row
            by row, and the gradient.
        mass: the sum of its weights.
        level_px: its noise, or NaN.
    """

    upper: FloatArray
    mass: float
    level_px: float

    @classmethod
    def of(cls, reduced: FloatArray, mass: float, level_px: float) -> Says:
        """Of hessian and gradient (6, 7)."""
        return cls(np.concatenate([upper_of(reduced[:, :6]), reduced[:, 6]]), mass, level_px)

    def coarse(self) -> Says:
        """In half the bytes, each number to 24 bits; with a hessian that stays positive definite for all that rounds off."""
        upper = self.upper.copy()
        upper[DIAGONAL] *= 1.0 + DAMPED
        return Says(upper.astype(np.float32).astype(float), self.mass, self.level_px)

    @property
    def reduced(self) -> FloatArray:
        """(6, 7) hessian and gradient."""
        return np.column_stack([symmetric_of(self.upper[:21]), self.upper[21:]])


@dataclass(frozen=True, eq=False)
class Judges:
    """What a camera tells all others of the pose that was found.

    Attributes:
        cost, vote: the sum of its robust costs by trust, at its own noise and at `alignment.VOTE_PX`.
        inliers: number of matches that agree, of so many matches.
        trust: the sum of theirs.
    """

    cost: float
    vote: float
    inliers: int
    matches: int
    trust: float


Told = TypeVar("Told", Judges, Says)


class Exchange(Protocol):
    """Tells all others something of each of several poses, waits for theirs, and returns all, by camera."""

    def __call__(self, told: tuple[Told, ...], nothing: tuple[Told, ...], /) -> Sequence[tuple[Told, ...]]:
        """`nothing`: what a camera says that has no matches, and what is taken for the word of one that is not heard."""
