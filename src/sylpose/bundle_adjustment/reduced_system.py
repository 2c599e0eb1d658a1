"""Reduced system of the bundle adjustment: the landmarks are eliminated by the Schur complement (compiled).

Six unknowns per frame remain, with a border of shared camera parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import linalg
from scipy.sparse import bsr_array, diags_array, tril
from scipy.sparse.linalg import SuperLU, splu

from sylpose.bundle_adjustment.camera_parameters import CameraParameters
from sylpose.bundle_adjustment.kernels import (
    DEPTH,
    LandmarkSystem,
    Linearization,
    compute_depth_residual,
    eliminate_landmark,
    make_landmark_system,
)
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel


class ReducedSystem(NamedTuple):
    """Normal equations of F free frames and C cameras' K shared parameters; filled by `eliminate_landmarks`.

    The landmarks are eliminated.

    Attributes:
        indptr, columns: (F + 1,), (k,) the blocks' pattern, lower triangle by rows, columns increasing, the diagonal
            last.
        blocks: (k, 6, 6) of frames with frames.
        gradient: (F, 6) of the frames.
        border: (F, 6, C, K) of frames with shared parameters.
        corner: (C, K, C, K) of shared parameters with each other.
        shared_gradient: (C, K) gradient of the shared parameters.
        leverage: (n,) number of an observation's two coordinates that its landmark absorbs.
    """

    indptr: IntArray
    columns: IntArray
    blocks: FloatArray
    gradient: FloatArray
    border: FloatArray
    corner: FloatArray
    shared_gradient: FloatArray
    leverage: FloatArray


@kernel
def find_column(columns: IntArray, low: int, high: int, column: int) -> int:
    """Return the position of a column in columns[low:high], which increase and contain it."""
    high -= 1
    while low < high:
        middle = (low + high) // 2
        if columns[middle] < column:
            low = middle + 1
        else:
            high = middle
    return low


class _Rows(NamedTuple):
    """Rows of one landmark's frames, and of the cameras that observe it, whitened by the landmark's system.

    Attributes:
        frames, poses: (k,), (k, 3, 6) its free frames and their rows.
        cameras, is_involved, shared: (C,) its cameras, (C,) whether each is among them, (C, K, 3) the rows of their
            shared parameters.
        point: (3, 2) rows of one observation.
    """

    frames: IntArray
    poses: FloatArray
    cameras: IntArray
    is_involved: BoolArray
    shared: FloatArray
    point: FloatArray


@kernel
def eliminate_landmarks(at: Linearization, out: ReducedSystem) -> None:
    """Write the reduced system to `out`, which must be zero at the start."""
    system, observations, (n_cameras, n_shared) = make_landmark_system(at), at.observations, at.views.parameters.shape
    longest = system.e.shape[0]
    frames, poses, point = np.empty(longest, np.int64), np.empty((longest, 3, 6)), np.empty((3, 2))
    cameras, is_involved = np.empty(n_cameras, np.int64), np.zeros(n_cameras, np.bool_)
    rows = _Rows(frames, poses, cameras, is_involved, np.zeros((n_cameras, n_shared, 3)), point)
    for i in range(at.points.shape[0]):
        if not eliminate_landmark(at, i, system):
            continue
        first, n_involved = observations.start[i], 0
        for n in range(first - 1, observations.start[i + 1]):
            c = observations.first_viewer[i] if n < first else observations.camera[n]
            if not is_involved[c]:
                is_involved[c], cameras[n_involved] = True, c
                rows.shared[c] = 0.0
                n_involved += 1
        _add_depth_terms(at, i, system.root, rows.shared, out)
        count = _add_observations(at, i, system, rows, out)
        _subtract_products(count, n_involved, system.slope, rows, out)


@kernel
def _add_depth_terms(at: Linearization, i: int, root: FloatArray, shared: FloatArray, out: ReducedSystem) -> None:
    """Add landmark i's depth prior to `out` and to its rows."""
    observations, information = at.observations, at.prior[0]
    u, c = observations.depth_direction[i], observations.first_viewer[i]
    r = information * compute_depth_residual(at, i)
    for p in range(3):
        x = observations.depth_basis[i, p]
        out.shared_gradient[c, DEPTH + p] -= r * x
        for s in range(3):
            out.corner[c, DEPTH + p, c, DEPTH + s] += information * x * observations.depth_basis[i, s]
        for j in range(3):
            for q in range(j + 1):
                shared[c, DEPTH + p, j] -= information * x * root[j, q] * u[q]


@kernel
def whiten(point_jacobian: FloatArray, root: FloatArray, rows: FloatArray) -> None:
    """Write the rows (3, 2) of an observation from its derivatives (2, 3) by the landmark."""
    for a in range(2):
        x, y, z = point_jacobian[a]
        rows[0, a] = root[0, 0] * x
        rows[1, a] = root[1, 0] * x + root[1, 1] * y
        rows[2, a] = root[2, 0] * x + root[2, 1] * y + root[2, 2] * z


@kernel
def _add_observations(at: Linearization, i: int, system: LandmarkSystem, rows: _Rows, out: ReducedSystem) -> int:
    """Add landmark i's observations to `out` and fill its rows; return the number of its free frames."""
    observations, e = at.observations, system.e
    pose_jacobian, shared_jacobian = system.pose_jacobian, system.shared_jacobian
    first, count, previous, n_shared, point = observations.start[i], 0, -1, shared_jacobian.shape[2], rows.point
    for n in range(first, observations.start[i + 1]):
        w = at.weights[n]
        if w <= 0.0:
            continue
        o, k, c = n - first, observations.free_index[observations.frame[n]], observations.camera[n]
        whiten(system.point_jacobian[o], system.root, point)
        lever = 0.0
        for a in range(2):
            lever += point[0, a] ** 2 + point[1, a] ** 2 + point[2, a] ** 2
        out.leverage[n] = w * lever
        for p in range(n_shared):
            t0, t1 = w * shared_jacobian[o, 0, p], w * shared_jacobian[o, 1, p]
            if t0 == 0.0 and t1 == 0.0:
                continue
            out.shared_gradient[c, p] += t0 * e[o, 0] + t1 * e[o, 1]
            for s in range(n_shared):
                out.corner[c, p, c, s] += t0 * shared_jacobian[o, 0, s] + t1 * shared_jacobian[o, 1, s]
            for j in range(3):
                rows.shared[c, p, j] += t0 * point[j, 0] + t1 * point[j, 1]
            if k >= 0:
                for s in range(6):
                    out.border[k, s, c, p] += t0 * pose_jacobian[o, 0, s] + t1 * pose_jacobian[o, 1, s]
        if k < 0:
            continue
        if k != previous:
            rows.frames[count], previous = k, k
            rows.poses[count] = 0.0
            count += 1
        block, frame_rows = out.blocks[out.indptr[k + 1] - 1], rows.poses[count - 1]
        for p in range(6):
            j0, j1 = w * pose_jacobian[o, 0, p], w * pose_jacobian[o, 1, p]
            out.gradient[k, p] += j0 * e[o, 0] + j1 * e[o, 1]
            for s in range(6):
                block[p, s] += j0 * pose_jacobian[o, 0, s] + j1 * pose_jacobian[o, 1, s]
            for j in range(3):
                frame_rows[j, p] += j0 * point[j, 0] + j1 * point[j, 1]
    return count


@kernel
def _subtract_products(count: int, n_involved: int, slope: FloatArray, rows: _Rows, out: ReducedSystem) -> None:
    """Subtract the products of a landmark's rows from `out`; no camera is involved afterwards."""
    frames, poses, cameras, is_involved, shared, _ = rows
    columns, blocks, gradient, za, n_shared = out.columns, out.blocks, out.gradient, np.empty((3, 6)), shared.shape[1]
    # This loop takes most of the time. Values are loaded before any is stored, because compilers cannot assume that the
    # arrays do not overlap.
    for a in range(count):
        row = frames[a]
        low = out.indptr[row]
        for p in range(6):
            za[0, p], za[1, p], za[2, p] = poses[a, 0, p], poses[a, 1, p], poses[a, 2, p]
            gradient[row, p] -= za[0, p] * slope[0] + za[1, p] * slope[1] + za[2, p] * slope[2]
        for b in range(a + 1):
            while columns[low] < frames[b]:  # most landmarks are observed in consecutive frames
                low += 1
            x = poses[b]
            x00, x01, x02, x03, x04, x05 = x[0, 0], x[0, 1], x[0, 2], x[0, 3], x[0, 4], x[0, 5]
            x10, x11, x12, x13, x14, x15 = x[1, 0], x[1, 1], x[1, 2], x[1, 3], x[1, 4], x[1, 5]
            x20, x21, x22, x23, x24, x25 = x[2, 0], x[2, 1], x[2, 2], x[2, 3], x[2, 4], x[2, 5]
            for p in range(6):
                z0, z1, z2 = za[0, p], za[1, p], za[2, p]
                blocks[low, p, 0] -= z0 * x00 + z1 * x10 + z2 * x20
                blocks[low, p, 1] -= z0 * x01 + z1 * x11 + z2 * x21
                blocks[low, p, 2] -= z0 * x02 + z1 * x12 + z2 * x22
                blocks[low, p, 3] -= z0 * x03 + z1 * x13 + z2 * x23
                blocks[low, p, 4] -= z0 * x04 + z1 * x14 + z2 * x24
                blocks[low, p, 5] -= z0 * x05 + z1 * x15 + z2 * x25
        for d in range(n_involved):
            c = cameras[d]
            for s in range(n_shared):
                t0, t1, t2 = shared[c, s, 0], shared[c, s, 1], shared[c, s, 2]
                for p in range(6):
                    out.border[row, p, c, s] -= za[0, p] * t0 + za[1, p] * t1 + za[2, p] * t2
    for a in range(n_involved):
        c = cameras[a]
        is_involved[c] = False
        for p in range(n_shared):
            t0, t1, t2 = shared[c, p, 0], shared[c, p, 1], shared[c, p, 2]
            out.shared_gradient[c, p] -= t0 * slope[0] + t1 * slope[1] + t2 * slope[2]
            for b in range(n_involved):
                d = cameras[b]
                for s in range(n_shared):
                    out.corner[c, p, d, s] -= t0 * shared[d, s, 0] + t1 * shared[d, s, 1] + t2 * shared[d, s, 2]


@kernel
def back_substitute(at: Linearization, step: FloatArray, change: FloatArray, out: FloatArray) -> None:
    """Write the landmarks after a step of the frames and the shared parameters to out.

    The derivatives are recomputed, which saves memory and takes little time.

    Args:
        step: (N, 6) of the frames.
        change: (C, K) of the shared parameters.
        out: (m, 3) landmarks, filled.
    """
    system, observations, x = make_landmark_system(at), at.observations, np.empty(3)
    root, slope = system.root, system.slope
    for i in range(at.points.shape[0]):
        out[i] = at.points[i]
        if not eliminate_landmark(at, i, system):
            continue
        depth_change = 0.0
        for j in range(3):
            depth_change += observations.depth_basis[i, j] * change[observations.first_viewer[i], DEPTH + j]
        for j in range(3):
            x[j] = -at.prior[0] * depth_change * observations.depth_direction[i, j]
        for n in range(observations.start[i], observations.start[i + 1]):
            o = n - observations.start[i]
            if at.weights[n] <= 0.0:
                continue
            frame_step, parameter_change = step[observations.frame[n]], change[observations.camera[n]]
            for a in range(2):
                displacement = 0.0
                for p in range(change.shape[1]):
                    displacement += system.shared_jacobian[o, a, p] * parameter_change[p]
                for p in range(6):
                    displacement += system.pose_jacobian[o, a, p] * frame_step[p]
                for j in range(3):
                    x[j] += at.weights[n] * displacement * system.point_jacobian[o, a, j]
        s0 = slope[0] + root[0, 0] * x[0]
        s1 = slope[1] + root[1, 0] * x[0] + root[1, 1] * x[1]
        s2 = slope[2] + root[2, 0] * x[0] + root[2, 1] * x[1] + root[2, 2] * x[2]
        out[i, 0] -= root[0, 0] * s0 + root[1, 0] * s1 + root[2, 0] * s2
        out[i, 1] -= root[1, 1] * s1 + root[2, 1] * s2
        out[i, 2] -= root[2, 2] * s2


# Systems of at most so many frames, or with this fill ratio, are solved as dense ones (choice).
DENSE_FRAMES, DENSE_FILL_RATIO = 100, 0.25
# Standard deviation of the logarithm of a rig's calibration errors relative to typical ones: where they are held, and where
# they are estimated as well, in turns with their size, which a wide prior lets shrink too far (choice; half and twice the
# first: docs/method/5-uncertainty.md, "Uncertainty").
SCALE_LOG_SD, FREE_SCALE_LOG_SD = 1.0, 0.5
# Smallest relative enlargement of the diagonal, against rounding (choice).
RIDGE = 1e-12
# Information on calibration errors less than this, relative to the largest, is rounding (derived).
KNOWN_RATIO = 1e-9


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
        indptr, rows, order = (a.astype(np.int64) for a in (factor.indptr, factor.indices, self.sparse.perm_c))
        invert_diagonal_blocks(indptr, rows, factor.data, self.sparse.U.diagonal(), order, out)
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

    def parameter_covariance(
        self, excess: float = 1.0, *, include_fixed: bool = True, prior: FloatArray | None = None
    ) -> FloatArray:
        """Return (k, k) covariance of z, with the variance of the observations multiplied by `excess`.

        Fixed elements keep their prior uncertainty, which propagates to the others (Schmidt's consider covariance: S.
        F. Schmidt, "Application of state-space methods to navigation problems", 1966), unless `include_fixed` is False.

        Args:
            prior: (k,) prior information of each element; None: 1.
        """
        free, out = ~self.fixed, np.zeros_like(self.information)
        prior = np.ones(len(free)) if prior is None else prior
        own = np.linalg.inv(self.information[np.ix_(free, free)] / excess + np.diag(prior[free]))
        out[np.ix_(free, free)] = own
        if include_fixed and self.fixed.any():
            propagation = np.diag(prior**-0.5)[:, self.fixed]
            propagation[free] = -own @ self.information[np.ix_(free, self.fixed)] @ propagation[self.fixed] / excess
            out += propagation @ propagation.T
        return out

    def pattern_variance(self, pattern: FloatArray, excess: float = 1.0) -> float:
        """Return the variance of a linear combination of the frames' unknowns with coefficients `pattern` (F, 6)."""
        v = pattern.reshape(-1, 1)
        part = (self.gain.T @ v)[:, 0]
        own = excess * float(v[:, 0] @ self.frames.solve(v)[:, 0])
        return own + float(part @ self.parameter_covariance(excess) @ part)


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


class CalibrationEstimate(NamedTuple):
    """What the observations show of the calibration errors.

    Attributes:
        scale: root of the expected squared size of the errors, relative to their prior.
        excess: variance inflation of the observations in the directions of the errors.
        change: (k,) posterior mean of the change of z: of the fixed errors, with their prior scaled, and of what depends
            on them.
        pose_change: (F, 6) change of the frames that it causes.
    """

    scale: float
    excess: float
    change: FloatArray
    pose_change: FloatArray


def estimate_calibration(solver: Solver, system: System, excess: float) -> CalibrationEstimate:
    """Estimate the size of calibration errors, and what freeing a fixed calibration would change.

    All errors share one scale relative to their prior, whose logarithm is normal with a mean square scale of 1. In the
    eigenvectors of the system's information on the errors, each estimate has the variance of the system, inflated by
    an unknown factor, plus the squared scale. Where there is much information, the estimates show the scale, where there
    is little, the factor: errors along tracks and of neighbors may resemble those of a calibration.

    Args:
        solver: of the system, undamped, with the calibration free.
        system: the reduced system at the minimum of the cost.
        excess: least variance inflation of the observations; the logarithm of a larger one is uniform.
    """
    parameters, change = system.parameters, np.zeros(len(system.z))
    own, other = parameters.is_calibration, ~parameters.is_calibration & ~solver.fixed
    # Gradient of the log-likelihood with the frames free, and by the errors themselves instead of by their change.
    score = system.z - system.shared_gradient()
    score += solver.border.T @ solver.frames.solve(system.reduced.gradient.reshape(-1, 1))[:, 0]
    slope, information = score + solver.information @ system.z, solver.information
    inner = information[np.ix_(other, other)] + excess * np.eye(int(other.sum()))
    cross = np.linalg.solve(inner, information[np.ix_(other, own)]).T
    marginal = information[np.ix_(own, own)] - cross @ information[np.ix_(other, own)]
    values, vectors = np.linalg.eigh(0.5 * (marginal + marginal.T))
    projections = vectors.T @ (slope[own] - cross @ slope[other])
    # What moves all cameras alike, or cameras without observations, shows nothing.
    is_known = values > KNOWN_RATIO * values.max()
    values, projections = values[is_known], projections[is_known]
    is_held = bool((own & parameters.fixed).any())
    normal, log_sd = np.linspace(-6.0, 6.0, 121), SCALE_LOG_SD if is_held else FREE_SCALE_LOG_SD
    scales = np.exp(log_sd * normal - log_sd**2)
    # Up to a thousand times as much, in steps of the root of two; only where the errors are held.
    excesses = excess * 2.0 ** np.arange(0.0, 10.5 if is_held else 0.5, 0.5)
    variance = (scales[:, None, None] / parameters.scale) ** 2 + excesses[:, None] / values
    cost = (np.log(variance) + (projections / values) ** 2 / variance).sum(axis=2) + normal[:, None] ** 2
    weights = np.exp(-0.5 * (cost - cost.min()))
    weights /= weights.sum()
    scale = float(np.sqrt(weights.sum(axis=1) @ scales**2))
    excess = float(np.exp(weights.sum(axis=0) @ np.log(excesses)))
    factors = np.where(own, scale / parameters.scale, 1.0)
    free = ~solver.fixed
    inner = (information * factors * factors[:, None])[np.ix_(free, free)] / excess + np.eye(int(free.sum()))
    change[free] = np.linalg.solve(inner, np.where(own & parameters.fixed, factors * score / excess, 0.0)[free])
    return CalibrationEstimate(scale, excess, change, -(solver.gain @ (factors * change)).reshape(-1, 6))


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
