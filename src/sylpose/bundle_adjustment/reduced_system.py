"""Reduced system of the bundle adjustment: six unknowns per frame, with a border of shared camera parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg
from scipy.sparse import bsr_array, diags_array, tril
from scipy.sparse.linalg import SuperLU, splu

from sylpose.bundle_adjustment.camera_parameters import CameraParameters
from sylpose.bundle_adjustment.schur import ReducedSystem, find_column
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel

# Systems of at most so many frames, or with this fill ratio, are solved as dense ones (choice).
DENSE_FRAMES, DENSE_FILL_RATIO = 100, 0.25
# Range of the scale of calibration errors relative to typical ones (choice), and the standard deviation of its
# logarithm (choice: with 1.5 the uncertainty of the two recordings is underestimated).
MIN_SCALE, MAX_SCALE, SCALE_LOG_SD = 0.05, 5.0, 1.0
# Iterations of the scales of rotations, translations and lenses, which depend on each other (choice).
SCALE_ITERATIONS = 5
# Smallest relative enlargement of the diagonal, against rounding (choice).
RIDGE = 1e-12


@dataclass(frozen=True, eq=False)
class Factor:
    """Factorized symmetric, positive definite matrix: a dense lower triangle, or sparse."""

    dense: FloatArray | None
    sparse: SuperLU | None

    def solve(self, right: FloatArray) -> FloatArray:
        if self.dense is not None:
            return np.asarray(linalg.cho_solve((self.dense, True), right, check_finite=False))
        assert self.sparse is not None
        return np.asarray(self.sparse.solve(right))

    def inverse_blocks(self) -> FloatArray:
        """Return (F, 6, 6) diagonal blocks of the inverse."""
        if self.dense is not None:
            lower = linalg.lapack.dpotri(self.dense, lower=1)[0]
            blocks = np.array([np.tril(lower[k : k + 6, k : k + 6]) for k in range(0, len(lower), 6)])
            return np.asarray(blocks + np.tril(blocks, -1).transpose(0, 2, 1))
        assert self.sparse is not None
        factor = tril(self.sparse.L, -1, format="csc")
        factor.sort_indices()
        out = np.empty((factor.shape[0] // 6, 6, 6))
        invert_diagonal_blocks(
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
    """Factorized system.

    Attributes:
        frames: factor of the frames' part, F of them.
        border, gain: (6 F, k) coupling of the frames with the shared parameters z, and the solution for it.
        information: (k, k) information on z with the frames free, without its prior, the identity.
        fixed: (k,) fixed elements of z.
    """

    frames: Factor
    border: FloatArray
    gain: FloatArray
    information: FloatArray
    fixed: BoolArray

    def solve(self, gradient: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve for the frames (6 F, g) and shared parameters (k, g) of g right sides."""
        x, free = self.frames.solve(gradient), ~self.fixed
        z = np.zeros((len(free), gradient.shape[1]))
        information = self.information[np.ix_(free, free)]
        z[free] = np.linalg.solve(information + np.eye(len(information)), slope[free] - self.border[:, free].T @ x)
        return x - self.gain @ z, z

    def with_fixed(self, fixed: BoolArray) -> Solver:
        """Return the same with other fixed elements (k,)."""
        return replace(self, fixed=fixed)

    def rescale(self, factors: FloatArray) -> Solver:
        """Return the same in other units of z: one new unit is `factors` (k,) old units."""
        information = self.information * factors * factors[:, None]
        return replace(self, border=self.border * factors, gain=self.gain * factors, information=information)

    def parameter_covariance(self, excess: float = 1.0, *, include_fixed: bool = True) -> FloatArray:
        """Return (k, k) covariance of z, with the variance of the observations multiplied by `excess`.

        Fixed elements keep their prior uncertainty, which propagates to the others (Schmidt's consider covariance: S.
        F. Schmidt, "Application of state-space methods to navigation problems", 1966), unless `include_fixed` is False.
        """
        free, out = ~self.fixed, np.zeros_like(self.information)
        information = self.information[np.ix_(free, free)] / excess
        own = np.linalg.inv(information + np.eye(len(information)))
        out[np.ix_(free, free)] = own
        if include_fixed and self.fixed.any():
            propagation = np.eye(len(free))[:, self.fixed]
            propagation[free] = -own @ self.information[np.ix_(free, self.fixed)] / excess
            out += propagation @ propagation.T
        return out

    def pattern_variance(self, pattern: FloatArray, excess: float = 1.0) -> float:
        """Return the variance of a linear combination of the frames' unknowns with coefficients `pattern` (F, 6)."""
        v = pattern.reshape(-1, 1)
        part = (self.gain.T @ v)[:, 0]
        return excess * float(v[:, 0] @ self.frames.solve(v)[:, 0]) + float(
            part @ self.parameter_covariance(excess) @ part
        )


@dataclass(frozen=True, eq=False)
class System:
    """Reduced system including the prior of the frames.

    Attributes:
        reduced: as of `eliminate_landmarks`, in the shared parameters themselves.
        free: (N,) number of each frame among the free ones, or -1.
        parameters: prior of the shared parameters, whose z are the unknowns.
        z: (k,) their values.
    """

    reduced: ReducedSystem
    free: IntArray
    parameters: CameraParameters
    z: FloatArray

    def frame_blocks(self) -> FloatArray:
        """Return (F, 6, 6) each frame's information with the other frames fixed."""
        return self.reduced.blocks[self.reduced.indptr[1:] - 1]

    def factorize(self, damping: float = 0.0) -> Solver:
        """Factorize the system, with the diagonals of both parts enlarged by the relative damping."""
        frames, spread = self._factor(damping), self.parameters.flat_basis
        n = len(spread)
        border = self.reduced.border.reshape(-1, n) @ spread
        gain = frames.solve(border)
        information = spread.T @ self.reduced.corner.reshape(n, n) @ spread - border.T @ gain
        information[np.diag_indices_from(information)] *= 1.0 + damping
        return Solver(frames, border, gain, information, self.parameters.fixed)

    def shared_gradient(self) -> FloatArray:
        """Return (k,) gradient by z, including its prior."""
        return np.asarray(self.parameters.flat_basis.T @ self.reduced.shared_gradient.ravel() + self.z)

    def solve(self, damping: float) -> tuple[FloatArray, FloatArray, float]:
        """Return the step of the frames (N, 6) and of z (k,), and its squared length in standard deviations."""
        gradient, slope = self.reduced.gradient.reshape(-1, 1), self.shared_gradient()[:, None]
        step, z = self.factorize(damping).solve(gradient, slope)
        size = float(gradient[:, 0] @ step[:, 0]) + float(slope[:, 0] @ z[:, 0])  # z is zero where it is fixed
        out = np.zeros((len(self.free), 6))
        out[self.free >= 0] = -step.reshape(-1, 6)
        return out, -z[:, 0], size

    def _factor(self, damping: float) -> Factor:
        r, n = self.reduced, 6 * len(self.reduced.gradient)
        blocks, k = r.blocks.copy(), np.arange(6)
        blocks[r.indptr[1:, None] - 1, k, k] *= 1.0 + max(damping, RIDGE)
        lower = bsr_array((blocks, r.columns, r.indptr), shape=(n, n))
        if n <= 6 * DENSE_FRAMES or len(blocks) > DENSE_FILL_RATIO * (n / 6) ** 2:
            return Factor(linalg.cho_factor(lower.toarray(), lower=True, overwrite_a=True, check_finite=False)[0], None)
        half = tril(lower, -1, format="csc")
        options = {"SymmetricMode": True}
        matrix = (half + half.T + diags_array(lower.diagonal())).tocsc()
        return Factor(None, splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options))


def estimate_calibration_scales(solver: Solver, system: System, excess: float) -> FloatArray:
    """Estimate the scale (4,) of each kind of calibration error relative to its prior.

    The first, unused kind has 1. Maximum likelihood with a common scale per kind: in the eigenvectors of the system's
    information on them, each error has the variance of the system, inflated by `excess`, plus the squared scale; the
    other kinds have their current scales. With little information the result is about 1, as in the prior.
    """
    kinds, current_scales, out = system.parameters.kind, system.parameters.scales, np.ones(4)
    slope = solver.information @ system.z - (system.shared_gradient() - system.z)
    slope += solver.border.T @ solver.frames.solve(system.reduced.gradient.reshape(-1, 1))[:, 0]
    scales = np.geomspace(MIN_SCALE, MAX_SCALE, 60)
    for kind in SCALE_ITERATIONS * np.unique(kinds[kinds > 0]).tolist():
        is_kind = kinds == kind
        is_other, scale = ~is_kind & ~solver.fixed, np.where(is_kind, 1.0, (out / current_scales)[kinds])
        information, gradient = solver.information * scale * scale[:, None], slope * scale
        inner = information[np.ix_(is_other, is_other)] + np.eye(int(is_other.sum()))
        cross = np.linalg.solve(inner, information[np.ix_(is_other, is_kind)]).T
        marginal = information[np.ix_(is_kind, is_kind)] - cross @ information[np.ix_(is_other, is_kind)]
        values, vectors = np.linalg.eigh(0.5 * (marginal + marginal.T))
        values, projections = np.maximum(values, 1e-12), vectors.T @ (gradient[is_kind] - cross @ gradient[is_other])
        variance = (scales[:, None] / current_scales[kind]) ** 2 + excess / values
        cost = (np.log(variance) + (projections / values) ** 2 / variance).sum(axis=1)
        cost += (np.log(scales) / SCALE_LOG_SD) ** 2
        out[kind] = scales[np.argmin(cost)]
    return out


@kernel
def invert_diagonal_blocks(
    indptr: IntArray, rows: IntArray, lower: FloatArray, pivots: FloatArray, order: IntArray, out: FloatArray
) -> None:
    """Write the diagonal blocks (F, 6, 6) of the inverse of a sparse A = P'L D L'P to out.

    The cost is about that of two factorizations.

    Args:
        indptr, rows, lower: L below its diagonal of ones, by columns, with increasing rows.
        pivots: (6 F,) diagonal of D.
        order: (6 F,) where P puts each unknown.

    Source: K. Takahashi, J. Fagan, M.-S. Chen, "Formation of a sparse bus impedance matrix", 1973: the entries of the
    inverse within L's pattern follow from each other, starting with the last column.
    """
    n = pivots.shape[0]
    inverse, diagonal = np.zeros(lower.shape[0]), np.empty(n)
    column, total, is_in_column = np.zeros(n), np.zeros(n), np.zeros(n, np.bool_)
    for j in range(n - 1, -1, -1):
        first, last = indptr[j], indptr[j + 1]
        for p in range(first, last):
            column[rows[p]], total[rows[p]], is_in_column[rows[p]] = lower[p], 0.0, True
        for p in range(first, last):
            k = rows[p]
            s = diagonal[k] * column[k]
            for q in range(indptr[k], indptr[k + 1]):
                if is_in_column[rows[q]]:
                    s += inverse[q] * column[rows[q]]
                    total[rows[q]] += inverse[q] * column[k]
            total[k] += s
        diagonal[j] = 1.0 / pivots[j]
        for p in range(first, last):
            inverse[p] = -total[rows[p]]
            diagonal[j] -= lower[p] * inverse[p]
            is_in_column[rows[p]] = False
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
                    p = find_column(rows, indptr[j], indptr[j + 1], i)
                    if rows[p] == i:
                        out[f, a, b] = inverse[p]
