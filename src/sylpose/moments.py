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

import numpy as np
from numpy.typing import ArrayLike

from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.matrices import symmetric_of, upper_of

__all__ = ["PairMoments"]


@dataclass(frozen=True, eq=False)
class PairMoments:
    """Weighted moments of the matches of one camera between two frames.

    Attributes:
        matrix: (9, 9) symmetric, M[3a + b, 3c + d] = Σ w y_a x_b y_c x_d. Normalised units.

    Raises:
        ValueError: a matrix that is not 9x9, not finite or not symmetric.
    """

    matrix: FloatArray

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=float)
        if matrix.shape != (9, 9):
            raise ValueError(f"pair moments are a 9x9 matrix, got shape {matrix.shape}")
        if not np.isfinite(matrix).all():
            raise ValueError("pair moments must be finite")
        if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=1e-12 * (1 + np.abs(matrix).max())):
            raise ValueError("pair moments must be symmetric")
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def zero(cls) -> PairMoments:
        """The moments of no matches: what a camera that sees nothing contributes."""
        return cls(np.zeros((9, 9)))

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
            return cls(k.T @ k)
        w = np.asarray(weights, dtype=float)
        if w.shape != (len(x),) or not np.isfinite(w).all() or (w < 0).any():
            raise ValueError(f"weights must be {len(x)} finite, non-negative numbers")
        return cls((k * w[:, None]).T @ k)

    def __add__(self, other: PairMoments) -> PairMoments:
        """The moments of both sets of matches together."""
        return PairMoments(self.matrix + other.matrix)

    def weighted(self, weight: float) -> PairMoments:
        """The moments of the same matches, each with so many times its weight."""
        return self if weight == 1 else PairMoments(weight * self.matrix)

    def to_bytes(self) -> bytes:
        """360 bytes: the 45 numbers of the upper triangle, row by row, as little-endian float64."""
        return upper_of(self.matrix).astype("<f8").tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> PairMoments:
        """The inverse of `to_bytes`.

        Raises:
            ValueError: not 360 bytes, or values that are not finite.
        """
        if len(data) != 360:
            raise ValueError(f"pair moments are 360 bytes, got {len(data)}")
        return cls(symmetric_of(np.frombuffer(data, "<f8")))

    def transformed(self, to: ArrayLike) -> PairMoments:
        """The moments of A x and A y, for a (3, 3) matrix A: (A ⊗ A) M (A ⊗ A)'."""
        a = np.asarray(to, dtype=float)
        kron = np.kron(a, a)
        matrix = kron @ self.matrix @ kron.T
        return PairMoments((matrix + matrix.T) / 2)

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
        return np.asarray(sums / self.count) if self.count > 0 else np.full(2, np.nan)

    def _outer(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return self.count * np.outer(a, b) if self.count > 0 else np.zeros((2, 2))


def _homogeneous(points: ArrayLike, name: str) -> FloatArray:
    array = np.asarray(points, dtype=float)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ValueError(f"{name} must be (n, 2) or (n, 3), got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has points that are not finite")
    return array if array.shape[1] == 3 else np.column_stack([array, np.ones(len(array))])
