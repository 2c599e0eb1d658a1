"""The reduced system of the joint refinement: six unknowns per frame, and a border of what cameras have once for all."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg
from scipy.sparse import bsr_array, diags_array, tril
from scipy.sparse.linalg import SuperLU, splu

from sylpose.bundle_adjustment.camera_parameters import Shared
from sylpose.bundle_adjustment.schur import Reduced, place_of
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel

__all__ = ["Factor", "Solver", "System", "diagonal_of_inverse", "told_shares"]


# Systems of at most so many frames, or so full, are solved as dense ones (choice).
DENSE_FRAMES, DENSE_SHARE = 100, 0.25
# A calibration may be so much better or worse than calibrations usually are (choice), and the logarithm of how much has this
# standard deviation (choice: with 1.5 the two recordings are said to be known better than they are).
LEAST_SHARE, MOST_SHARE, SHARE_LOG_SD = 0.05, 5.0, 1.0
# The shares of turns, shifts and lenses follow from each other: they are found in turn, so often (choice).
SHARE_ROUNDS = 5
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
class Solver:
    """A factored system.

    Attributes:
        frames: the frames' part, F of them.
        border, gain: (6 F, k) how frames depend on the shared unknowns z, and that solved for.
        told: (k, k) what is told of z, the frames being free; its prior, the identity, not counted.
        held: (k,) those of z that stay.
    """

    frames: Factor
    border: FloatArray
    gain: FloatArray
    told: FloatArray
    held: BoolArray

    def answer(self, gradient: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Frames (6 F, g) and shared unknowns (k, g) that the system gives for g right sides."""
        x, free = self.frames.solve(gradient), ~self.held
        z = np.zeros((len(free), gradient.shape[1]))
        told = self.told[np.ix_(free, free)]
        z[free] = np.linalg.solve(told + np.eye(len(told)), slope[free] - self.border[:, free].T @ x)
        return x - self.gain @ z, z

    def with_held(self, held: BoolArray) -> Solver:
        """The same with others held (k,)."""
        return replace(self, held=held)

    def scaled(self, share: FloatArray) -> Solver:
        """The same in other units of z: what was 1 is share (k,)."""
        told = self.told * share * share[:, None]
        return replace(self, border=self.border * share, gain=self.gain * share, told=told)

    def shared_covariance(self, excess: float = 1.0, *, considered: bool = True) -> FloatArray:
        """(k, k) of the error of z, when all that is told has so many times the variance.

        What is held is as uncertain as it was, and the others err with it (Schmidt's consider covariance: S. F. Schmidt,
        "Application of state-space methods to navigation problems", 1966); unless only noise is asked for.
        """
        free, out = ~self.held, np.zeros_like(self.told)
        told = self.told[np.ix_(free, free)] / excess
        mine = np.linalg.inv(told + np.eye(len(told)))
        out[np.ix_(free, free)] = mine
        if considered and self.held.any():
            drawn = np.eye(len(free))[:, self.held]
            drawn[free] = -mine @ self.told[np.ix_(free, self.held)] / excess
            out += drawn @ drawn.T
        return out

    def variance(self, pattern: FloatArray, excess: float = 1.0) -> float:
        """Of the sum of the frames' unknowns (F, 6), each times what the pattern (F, 6) has there."""
        v = pattern.reshape(-1, 1)
        part = (self.gain.T @ v)[:, 0]
        return excess * float(v[:, 0] @ self.frames.solve(v)[:, 0]) + float(
            part @ self.shared_covariance(excess) @ part
        )


@dataclass(frozen=True, eq=False)
class System:
    """A reduced system, what is believed of the frames added, and how to solve it.

    Attributes:
        reduced: as `reduce` gives it, in the shared unknowns themselves.
        free: (N,) number of each frame among those that move, or -1.
        shared: of which z are the unknowns here; z: (k,) their values.
    """

    reduced: Reduced
    free: IntArray
    shared: Shared
    z: FloatArray

    def frame_blocks(self) -> FloatArray:
        """(F, 6, 6) each frame's information about itself, the other frames given."""
        return self.reduced.blocks[self.reduced.indptr[1:] - 1]

    def solver(self, damping: float = 0.0) -> Solver:
        """The system factored, the diagonals of the frames' part and of what is told of z enlarged by a share."""
        frames, spread = self._factor(damping), self.shared.flat
        n = len(spread)
        border = self.reduced.border.reshape(-1, n) @ spread
        gain = frames.solve(border)
        told = spread.T @ self.reduced.corner.reshape(n, n) @ spread - border.T @ gain
        told[np.diag_indices_from(told)] *= 1.0 + damping
        return Solver(frames, border, gain, told, self.shared.held)

    def slope(self) -> FloatArray:
        """(k,) the gradient by z, its prior included."""
        return np.asarray(self.shared.flat.T @ self.reduced.slope.ravel() + self.z)

    def solve(self, damping: float) -> tuple[FloatArray, FloatArray, float]:
        """Step of the frames (N, 6), of z (k,), and the square of its length in standard deviations."""
        gradient, slope = self.reduced.gradient.reshape(-1, 1), self.slope()[:, None]
        step, z = self.solver(damping).answer(gradient, slope)
        size = float(gradient[:, 0] @ step[:, 0]) + float(slope[:, 0] @ z[:, 0])  # z is zero where it is held
        out = np.zeros((len(self.free), 6))
        out[self.free >= 0] = -step.reshape(-1, 6)
        return out, -z[:, 0], size

    def _factor(self, damping: float) -> Factor:
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


def told_shares(solver: Solver, system: System, excess: float) -> FloatArray:
    """(4,) by what share of what is believed of it at first each kind of the calibration's errors is off; 1 for none.

    Most likely, if they are all off alike: in the directions that the system tells of them, each with a variance of its own,
    which is so many times what the system says, beside share squared; the others being off by their shares. Where little is
    told, about 1, as was believed.
    """
    kinds, before, out = system.shared.kind, system.shared.shares, np.ones(4)
    slope = solver.told @ system.z - (system.slope() - system.z)
    slope += solver.border.T @ solver.frames.solve(system.reduced.gradient.reshape(-1, 1))[:, 0]
    shares = np.geomspace(LEAST_SHARE, MOST_SHARE, 60)
    for kind in SHARE_ROUNDS * np.unique(kinds[kinds > 0]).tolist():
        which = kinds == kind
        other, scale = ~which & ~solver.held, np.where(which, 1.0, (out / before)[kinds])
        told, asks = solver.told * scale * scale[:, None], slope * scale
        inner = told[np.ix_(other, other)] + np.eye(int(other.sum()))
        cross = np.linalg.solve(inner, told[np.ix_(other, which)]).T
        own = told[np.ix_(which, which)] - cross @ told[np.ix_(other, which)]
        values, vectors = np.linalg.eigh(0.5 * (own + own.T))
        values, off = np.maximum(values, 1e-12), vectors.T @ (asks[which] - cross @ asks[other])
        variance = (shares[:, None] / before[kind]) ** 2 + excess / values
        cost = (np.log(variance) + (off / values) ** 2 / variance).sum(axis=1)
        cost += (np.log(shares) / SHARE_LOG_SD) ** 2
        out[kind] = shares[np.argmin(cost)]
    return out


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
