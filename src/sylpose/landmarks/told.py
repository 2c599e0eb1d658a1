"""What cameras that align the same landmarks' object tell each other: three small records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.matrices import symmetric_of, upper_of

__all__ = ["Exchange", "Has", "Judges", "Says"]


@dataclass(frozen=True, eq=False)
class Has:
    """What a camera tells all others at first: how many matches it has, and the sum of their trust."""

    matches: int
    trust: float


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

    @property
    def reduced(self) -> FloatArray:
        """(6, 7) hessian and gradient."""
        return np.column_stack([symmetric_of(self.upper[:21]), self.upper[21:]])


@dataclass(frozen=True, eq=False)
class Judges:
    """What a camera tells all others of the pose that was found.

    Attributes:
        cost, vote: the sum of its robust costs by trust, at its own noise and at `alignment.VOTE_PX`.
        inliers: number of matches that agree.
    """

    cost: float
    vote: float
    inliers: int


Told = TypeVar("Told", Has, Says, Judges)


class Exchange(Protocol):
    """Tells all others something, waits for theirs, and returns all, by camera."""

    def __call__(self, told: Told, nothing: Told, /) -> Sequence[Told]:
        """`nothing`: what a camera says that has no matches, and what is taken for the word of one that is not heard."""
