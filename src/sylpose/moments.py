"""Pair moments: all that one camera saw of the motion between two frames, in 45 numbers.

With k = y ⊗ x (the row-major vec of y x') for each match of normalised points x = (x1, x2, 1) in frame i and
y = (y1, y2, 1) in frame j, the pair moments are M = Σ w k k', symmetric 9x9. They hold the count, the means and all
second moments, so every estimator from here on costs the same whatever the number of matches. Moments of disjoint
sets add.

Source: the epipolar cost vec(E)' M vec(E) is classical (e.g. Hartley & Zisserman, section 11.3, A'A); that the same
numbers carry the second moments that Chen & Schonfeld (2010) need is our observation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import symmetric_of, upper_of
from sylpose.geometry.validation import finite, finite_rows, kind_of, number

__all__ = ["LEAST_COUNT", "MOST_MOMENT", "PairMoments"]

# No moment is larger, no point and no weight (choice: products of a few moments stay in range), and a count that is smaller
# than this is none: a part of a match that means nothing (choice).
MOST_MOMENT, MOST_POINT, MOST_WEIGHT, LEAST_COUNT = 1e100, 1e15, 1e36, 1e-36
# What is no more than rounding, as a share of the largest moment, in a matrix of somebody else (choice).
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class PairMoments:
    """Weighted moments of the matches of one camera between two frames.

    Attributes:
        matrix: (9, 9) symmetric, M[3a + b, 3c + d] = Σ w y_a x_b y_c x_d. Normalised units.

    Raises:
        ValueError: a matrix that is not 9x9, not finite, not symmetric, no sum of squares (an eigenvalue is negative), or
            has moments beyond 1e100.
    """

    matrix: FloatArray

    def __post_init__(self) -> None:
        matrix = np.array(finite(self.matrix, (9, 9), "pair moments: matrix", most=MOST_MOMENT))
        largest = float(np.abs(matrix).max())
        if np.abs(matrix - matrix.T).max() > 1e-12 + ROUNDING * largest:
            raise ValueError("pair moments: matrix must be symmetric")
        if largest > 0 and np.linalg.eigvalsh(matrix / largest)[0] < -ROUNDING:
            raise ValueError("pair moments: matrix must be a sum of squares, but has a negative eigenvalue")
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def _of(cls, matrix: FloatArray) -> PairMoments:
        """Of a matrix (9, 9) that is symmetric and a sum of squares as it was made."""
        largest = np.abs(matrix).max()
        if not largest <= MOST_MOMENT:  # nor not a number
            raise ValueError(f"pair moments: matrix has values beyond {MOST_MOMENT:g}")
        out = object.__new__(cls)
        matrix.setflags(write=False)
        object.__setattr__(out, "matrix", matrix)
        return out

    @classmethod
    def zero(cls) -> PairMoments:
        """The moments of no matches: what a camera that sees nothing contributes."""
        return cls._of(np.zeros((9, 9)))

    @classmethod
    def from_matches(cls, x: ArrayLike, y: ArrayLike, weights: ArrayLike | None = None) -> PairMoments:
        """Moments of matched points.

        Args:
            x, y: (n, 2) normalised points in frames i and j, or (n, 3) homogeneous ones used as they are (rays turned
                into another frame, for example).
            weights: (n,) non-negative; None for ones.

        Raises:
            ValueError: shapes that do not fit, values that are not finite, negative weights.
        """
        x, y = _homogeneous(x, "x"), _homogeneous(y, "y")
        if len(x) != len(y):
            raise ValueError(f"x has {len(x)} points and y has {len(y)}")
        k = (y[:, :, None] * x[:, None, :]).reshape(-1, 9)
        if weights is None:
            return cls._of(k.T @ k)
        w = finite(weights, (len(x),), "weights", most=MOST_WEIGHT)
        if (w < 0).any():
            raise ValueError(f"weights must be {len(x)} finite, non-negative numbers")
        return cls._of((k * w[:, None]).T @ k)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> FloatArray:
        """Its matrix, so that `solve_centralized_batch` takes N lists of C of them."""
        return np.array(self.matrix, dtype=dtype) if copy or dtype is not None else self.matrix

    def __add__(self, other: PairMoments) -> PairMoments:
        """The moments of both sets of matches together."""
        if not isinstance(other, PairMoments):
            return NotImplemented
        return PairMoments._of(self.matrix + other.matrix)

    def weighted(self, weight: float) -> PairMoments:
        """The moments of the same matches, each with so many times its weight.

        Raises:
            ValueError: a weight that is negative, not finite or beyond 1e36.
        """
        weight = number(weight, "weight", least=0.0, most=MOST_WEIGHT)
        return self if weight == 1 else PairMoments._of(weight * self.matrix)

    def to_bytes(self) -> bytes:
        """360 bytes: the 45 numbers of the upper triangle, row by row, as little-endian float64."""
        return upper_of(self.matrix).astype("<f8").tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> PairMoments:
        """The inverse of `to_bytes`.

        Raises:
            ValueError: not 360 bytes, or what `PairMoments` refuses.
        """
        if len(kind_of(data, bytes, "data")) != 360:
            raise ValueError(f"data: pair moments are 360 bytes, got {len(data)}")
        return cls(symmetric_of(np.frombuffer(data, "<f8")))

    def transformed(self, to: ArrayLike) -> PairMoments:
        """The moments of A x and A y, for a (3, 3) matrix A: (A ⊗ A) M (A ⊗ A)'.

        Raises:
            ValueError: another shape, values that are not finite or beyond 1e15.
        """
        a = finite(to, (3, 3), "to", most=MOST_POINT)
        kron = np.kron(a, a)
        matrix = kron @ self.matrix @ kron.T
        return PairMoments._of((matrix + matrix.T) / 2)

    # The numbers below assume points with a third coordinate of 1, as `from_matches` makes of (n, 2) arrays.

    @property
    def count(self) -> float:
        """Σ w: the number of matches when all weights are 1."""
        return float(self.matrix[8, 8])

    @property
    def mean_x(self) -> FloatArray:
        """(2,) weighted mean of x; NaN without matches."""
        return self._mean(self.matrix[8, 6:8])

    @property
    def mean_y(self) -> FloatArray:
        """(2,) weighted mean of y; NaN without matches."""
        return self._mean(self.matrix[8, [2, 5]])

    @property
    def s_xx(self) -> FloatArray:
        """(2, 2) Σ w (x - mean)(x - mean)'."""
        return np.asarray(self.matrix[6:8, 6:8] - self._outer(self.mean_x, self.mean_x))

    @property
    def s_yx(self) -> FloatArray:
        """(2, 2) Σ w (y - mean)(x - mean)'."""
        return np.asarray(self.matrix[[2, 5], 6:8] - self._outer(self.mean_y, self.mean_x))

    @property
    def s_yy(self) -> FloatArray:
        """(2, 2) Σ w (y - mean)(y - mean)'."""
        return np.asarray(self.matrix[np.ix_([2, 5], [2, 5])] - self._outer(self.mean_y, self.mean_y))

    def _mean(self, sums: FloatArray) -> FloatArray:
        return np.asarray(sums / self.count) if self.count > LEAST_COUNT else np.full(2, np.nan)

    def _outer(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return self.count * np.outer(a, b) if self.count > LEAST_COUNT else np.zeros((2, 2))


def _homogeneous(points: ArrayLike, name: str) -> FloatArray:
    try:
        shape = np.shape(points)
    except ValueError:
        raise ValueError(f"{name} must be (n, 2) or (n, 3), got rows of different lengths") from None
    if shape[1:] == (3,):
        return finite_rows(points, 3, name, most=MOST_POINT)
    if shape[1:] != (2,) and shape != (0,):
        raise ValueError(f"{name} must be (n, 2) or (n, 3), got shape {shape}")
    array = finite_rows(points, 2, name, most=MOST_POINT)
    return np.column_stack([array, np.ones(len(array))])
