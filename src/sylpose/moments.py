"""Pair moments: sufficient statistics of one camera's matches between two frames, in 45 numbers.

With k = y ⊗ x (the row-major vec of y x') for each match of normalized points x = (x1, x2, 1) in frame i and y = (y1,
y2, 1) in frame j, the pair moments are M = Σ w k k', symmetric 9x9. They contain the count, the means and all second
moments, so the cost of every estimator that uses them is independent of the number of matches. Moments of disjoint sets
add.

Source: the epipolar cost vec(E)' M vec(E) is classical (e.g. Hartley & Zisserman, section 11.3, A'A); that the same
numbers contain the second moments that Chen & Schonfeld (2010) need is our observation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import pack_upper, unpack_symmetric
from sylpose.geometry.validation import check_finite, check_finite_rows, check_number, check_type

# Largest moment, point coordinate and weight (choice: products of a few moments stay in range); a smaller count is
# zero: a negligible part of a match (choice).
MAX_MOMENT, MAX_COORDINATE, MAX_WEIGHT, MIN_COUNT = 1e100, 1e15, 1e36, 1e-36
# Rounding error allowed in a matrix from elsewhere, as a fraction of its largest moment (choice).
MAX_RELATIVE_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class PairMoments:
    """Weighted moments of the matches of one camera between two frames.

    Attributes:
        matrix: (9, 9) symmetric, M[3a + b, 3c + d] = Σ w y_a x_b y_c x_d. Normalized units.

    Raises:
        ValueError: a matrix that is not 9x9, not finite, not symmetric, not positive semidefinite, or has moments
            beyond 1e100.
    """

    matrix: FloatArray

    def __post_init__(self) -> None:
        matrix = np.array(check_finite(self.matrix, (9, 9), "pair moments: matrix", maximum=MAX_MOMENT))
        largest = float(np.abs(matrix).max())
        if np.abs(matrix - matrix.T).max() > 1e-12 + MAX_RELATIVE_ROUNDING * largest:
            raise ValueError("pair moments: matrix must be symmetric")
        if largest > 0 and np.linalg.eigvalsh(matrix / largest)[0] < -MAX_RELATIVE_ROUNDING:
            raise ValueError("pair moments: matrix must be positive semidefinite, but has a negative eigenvalue")
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def _from_valid_matrix(cls, matrix: FloatArray) -> PairMoments:
        """Make moments from a (9, 9) matrix that is symmetric and positive semidefinite by construction."""
        largest = np.abs(matrix).max()
        if not largest <= MAX_MOMENT:  # also rejects NaN
            raise ValueError(f"pair moments: matrix has values beyond {MAX_MOMENT:g}")
        out = object.__new__(cls)
        matrix.setflags(write=False)
        object.__setattr__(out, "matrix", matrix)
        return out

    @classmethod
    def zero(cls) -> PairMoments:
        """Return the moments of no matches, for a camera that does not observe the object."""
        return cls._from_valid_matrix(np.zeros((9, 9)))

    @classmethod
    def from_matches(cls, x: ArrayLike, y: ArrayLike, weights: ArrayLike | None = None) -> PairMoments:
        """Compute the moments of matched points.

        Args:
            x, y: (n, 2) normalized points in frames i and j, or (n, 3) homogeneous ones used as they are (for example
                rays rotated into another frame).
            weights: (n,) non-negative; None for ones.

        Raises:
            ValueError: incompatible shapes, values that are not finite, negative weights.
        """
        x, y = _homogeneous(x, "x"), _homogeneous(y, "y")
        if len(x) != len(y):
            raise ValueError(f"x has {len(x)} points and y has {len(y)}")
        k = (y[:, :, None] * x[:, None, :]).reshape(-1, 9)
        if weights is None:
            return cls._from_valid_matrix(k.T @ k)
        w = check_finite(weights, (len(x),), "weights", maximum=MAX_WEIGHT)
        if (w < 0).any():
            raise ValueError(f"weights must be {len(x)} finite, non-negative numbers")
        return cls._from_valid_matrix((k * w[:, None]).T @ k)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> FloatArray:
        """Return its matrix, so that `solve_centralized_batch` accepts N lists of C of them."""
        return np.array(self.matrix, dtype=dtype) if copy or dtype is not None else self.matrix

    def __add__(self, other: PairMoments) -> PairMoments:
        """Return the moments of the union of both sets of matches."""
        if not isinstance(other, PairMoments):
            return NotImplemented
        return PairMoments._from_valid_matrix(self.matrix + other.matrix)

    def scale_weights(self, weight: float) -> PairMoments:
        """Return the moments of the same matches with all weights multiplied by a factor.

        Raises:
            ValueError: a weight that is negative, not finite or beyond 1e36.
        """
        weight = check_number(weight, "weight", minimum=0.0, maximum=MAX_WEIGHT)
        return self if weight == 1 else PairMoments._from_valid_matrix(weight * self.matrix)

    def to_bytes(self) -> bytes:
        """Return 360 bytes: the 45 numbers of the upper triangle, row by row, as little-endian float64."""
        return pack_upper(self.matrix).astype("<f8").tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> PairMoments:
        """Parse the bytes of `to_bytes`.

        Raises:
            ValueError: not 360 bytes, or a matrix that `PairMoments` rejects.
        """
        if len(check_type(data, bytes, "data")) != 360:
            raise ValueError(f"data: pair moments are 360 bytes, got {len(data)}")
        return cls(unpack_symmetric(np.frombuffer(data, "<f8")))

    def transform(self, transformation: ArrayLike) -> PairMoments:
        """Return the moments of A x and A y, for a (3, 3) matrix A: (A ⊗ A) M (A ⊗ A)'.

        Raises:
            ValueError: another shape, values that are not finite or beyond 1e15.
        """
        a = check_finite(transformation, (3, 3), "transformation", maximum=MAX_COORDINATE)
        kron = np.kron(a, a)
        matrix = kron @ self.matrix @ kron.T
        return PairMoments._from_valid_matrix((matrix + matrix.T) / 2)

    # The properties below assume points with a third coordinate of 1, as `from_matches` makes of (n, 2) arrays.

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
        return np.asarray(sums / self.count) if self.count > MIN_COUNT else np.full(2, np.nan)

    def _outer(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return self.count * np.outer(a, b) if self.count > MIN_COUNT else np.zeros((2, 2))


def _homogeneous(points: ArrayLike, name: str) -> FloatArray:
    try:
        shape = np.shape(points)
    except ValueError:
        raise ValueError(f"{name} must be (n, 2) or (n, 3), got rows of different lengths") from None
    if shape[1:] == (3,):
        return check_finite_rows(points, 3, name, maximum=MAX_COORDINATE)
    if shape[1:] != (2,) and shape != (0,):
        raise ValueError(f"{name} must be (n, 2) or (n, 3), got shape {shape}")
    array = check_finite_rows(points, 2, name, maximum=MAX_COORDINATE)
    return np.column_stack([array, np.ones(len(array))])
