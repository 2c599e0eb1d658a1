"""The reduced system of the joint refinement: six unknowns per frame, and a border of time offsets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.sparse import bsr_array, diags_array, tril
from scipy.sparse.linalg import SuperLU, splu

from sylpose.numerics.arrays import FloatArray, IntArray
from sylpose.numerics.compiled import kernel
from sylpose.smoothing.kernels import Reduced, place_of

__all__ = ["Factor", "System", "diagonal_of_inverse"]


# Systems of at most so many frames, or so full, are solved as dense ones (choice).
DENSE_FRAMES, DENSE_SHARE = 100, 0.25
# The least that the diagonal is enlarged by, against rounding (choice).
RIDGE = 1e-12


@dataclass(frozen=True, eq=False)
class Factor:
    """A factored symmetric, positive definite matrix: a dense lower triangle, or sparse."""

    dense: FloatArray | None
    sparse: SuperLU | None

    def solve(self, right: FloatArray) -> FloatArray:
        if self.dense is not None:
            return np.asarray(linalg.cho_solve((self.dense, True), right, check_finite=False))
        assert self.sparse is not None
        return np.asarray(self.sparse.solve(right))

    def inverse_blocks(self) -> FloatArray:
        """(F, 6, 6) diagonal blocks of the inverse."""
        if self.dense is not None:
            lower = linalg.lapack.dpotri(self.dense, lower=1)[0]
            blocks = np.array([np.tril(lower[k : k + 6, k : k + 6]) for k in range(0, len(lower), 6)])
            return np.asarray(blocks + np.tril(blocks, -1).transpose(0, 2, 1))
        assert self.sparse is not None
        factor = tril(self.sparse.L, -1, format="csc")
        factor.sort_indices()
        out = np.empty((factor.shape[0] // 6, 6, 6))
        diagonal_of_inverse(
            factor.indptr.astype(np.int64),
            factor.indices.astype(np.int64),
            factor.data,
            self.sparse.U.diagonal(),
            self.sparse.perm_c.astype(np.int64),
            out,
        )
        return out


@dataclass(frozen=True, eq=False)
class System:
    """A reduced system with what is believed of poses and offsets added, and how to solve it."""

    reduced: Reduced
    free: IntArray
    basis: FloatArray

    def frame_blocks(self) -> FloatArray:
        """(F, 6, 6) each frame's information about itself, the other frames given."""
        return self.reduced.blocks[self.reduced.indptr[1:] - 1]

    def factor(self, damping: float) -> Factor:
        """The frames' part, its diagonal enlarged by a share."""
        r, n = self.reduced, 6 * len(self.reduced.gradient)
        blocks, k = r.blocks.copy(), np.arange(6)
        blocks[r.indptr[1:, None] - 1, k, k] *= 1.0 + max(damping, RIDGE)
        lower = bsr_array((blocks, r.columns, r.indptr), shape=(n, n))
        if n <= 6 * DENSE_FRAMES or len(blocks) > DENSE_SHARE * (n / 6) ** 2:
            return Factor(linalg.cho_factor(lower.toarray(), lower=True, overwrite_a=True, check_finite=False)[0], None)
        half = tril(lower, -1, format="csc")
        options = {"SymmetricMode": True}
        matrix = (half + half.T + diags_array(lower.diagonal())).tocsc()
        return Factor(None, splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options))

    def solve(self, damping: float) -> tuple[FloatArray, FloatArray, float]:
        """Step of the frames (N, 6), of the offsets (C,), and the square of its length in standard deviations."""
        r = self.reduced
        step, offsets = self.answer(r.gradient.reshape(-1, 1), r.slope[:, None], self.factor(damping))
        size = float(r.gradient.ravel() @ step[:, 0]) + float(r.slope @ offsets[:, 0])
        out = np.zeros((len(self.free), 6))
        out[self.free >= 0] = -step.reshape(-1, 6)
        return out, -self._all(offsets)[:, 0], size

    def answer(self, gradient: FloatArray, slope: FloatArray, factor: Factor) -> tuple[FloatArray, FloatArray]:
        """Frames (6 F, g) and offsets (T, g) that the system, factored, gives for g right sides."""
        x = factor.solve(gradient)
        if not self.basis.shape[1]:
            return x, np.zeros_like(slope)
        border, gain, schur = self._bordered(factor)
        z = np.linalg.solve(schur, self.basis.T @ slope - border.T @ x)
        return x - gain @ z, self.basis @ z

    def _all(self, offsets: FloatArray) -> FloatArray:
        """(C, g) offsets of all cameras: zero without any asked for."""
        return offsets if len(offsets) else np.zeros((len(self.basis), offsets.shape[1]))

    def covariance(self, factor: Factor | None = None) -> tuple[FloatArray, FloatArray]:
        """Of the frames (N, 6, 6), and of the offsets (C, C)."""
        factor = self.factor(0.0) if factor is None else factor
        blocks = factor.inverse_blocks()
        offsets = np.zeros((len(self.basis),) * 2)
        if self.basis.shape[1]:
            _, gain, schur = self._bordered(factor)
            small = np.linalg.inv(schur)
            offsets = self.basis @ small @ self.basis.T
            rows = gain.reshape(len(blocks), 6, -1)
            blocks = blocks + rows @ small @ rows.transpose(0, 2, 1)
        out = np.zeros((len(self.free), 6, 6))
        out[self.free >= 0] = 0.5 * (blocks + blocks.transpose(0, 2, 1))
        return out, offsets

    def _bordered(self, factor: Factor) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Border, border solved for, and what is left for the offsets."""
        border = self.reduced.border.reshape(-1, len(self.basis)) @ self.basis
        gain = factor.solve(border)
        return border, gain, self.basis.T @ self.reduced.corner @ self.basis - border.T @ gain


@kernel
def diagonal_of_inverse(
    indptr: IntArray, rows: IntArray, lower: FloatArray, pivots: FloatArray, order: IntArray, out: FloatArray
) -> None:
    """Diagonal blocks (F, 6, 6) of the inverse of a sparse A = P'L D L'P, at the cost of about two factorisations.

    Args:
        indptr, rows, lower: L below its diagonal of ones, by columns, rows rising.
        pivots: (6 F,) diagonal of D.
        order: (6 F,) where P puts each unknown.

    Source: K. Takahashi, J. Fagan, M.-S. Chen, "Formation of a sparse bus impedance matrix", 1973: the entries of the
    inverse within L's pattern follow from each other, the last column first.
    """
    n = pivots.shape[0]
    inverse, diagonal = np.zeros(lower.shape[0]), np.empty(n)
    column, total, mine = np.zeros(n), np.zeros(n), np.zeros(n, np.bool_)
    for j in range(n - 1, -1, -1):
        first, last = indptr[j], indptr[j + 1]
        for p in range(first, last):
            column[rows[p]], total[rows[p]], mine[rows[p]] = lower[p], 0.0, True
        for p in range(first, last):
            k = rows[p]
            s = diagonal[k] * column[k]
            for q in range(indptr[k], indptr[k + 1]):
                if mine[rows[q]]:
                    s += inverse[q] * column[rows[q]]
                    total[rows[q]] += inverse[q] * column[k]
            total[k] += s
        diagonal[j] = 1.0 / pivots[j]
        for p in range(first, last):
            inverse[p] = -total[rows[p]]
            diagonal[j] -= lower[p] * inverse[p]
            mine[rows[p]] = False
    for f in range(out.shape[0]):
        for a in range(6):
            for b in range(6):
                i, j = order[6 * f + a], order[6 * f + b]
                if i == j:
                    out[f, a, b] = diagonal[i]
                    continue
                i, j = max(i, j), min(i, j)
                out[f, a, b] = 0.0
                if indptr[j] < indptr[j + 1]:
                    p = place_of(rows, indptr[j], indptr[j + 1], i)
                    if rows[p] == i:
                        out[f, a, b] = inverse[p]
