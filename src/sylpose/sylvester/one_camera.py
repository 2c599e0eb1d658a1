"""Rotation estimator for a single camera: Sylvester's equation under pseudo-orthogonality.

In an orthographic view, centered points move by y = N x + m z + noise, N the upper-left 2x2 block of the rotation in
the camera's frame, m the first two entries of its third column, z the depth, which is ignored. The least-squares
problem

    minimize 1/2 Σ |y - N x|²   subject to   N N' + m m' = I

has the stationary points (C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation",
Computer Vision and Image Understanding 114 (2010); what follows is our derivation)

    N S_xx + L N = S_yx,   L = L',   L m = 0.

The constraint means that the largest singular value of N is 1: N = u v' + c u⊥ v⊥', |c| <= 1, m = ±√(1 - c²) u⊥. So L
is λ u u' unless m = 0, the equation gives v = (S_xx + λ)⁻¹ S_yx' u, and u is an eigenvector of

    M(λ) = S_yx S_xx⁻¹ (S_xx + λ)⁻¹ S_yx':   a scalar equation remains, |v| = 1.

With u the eigenvector of the larger eigenvalue μ it is the derivative of g(λ) = λ/2 (μ(λ) - 1). There are two cases, by
the sign of λ.

- The unconstrained N = S_yx S_xx⁻¹ has no singular value above 1 (noise in x shrinks it). The constraint is then
equivalent
  to "one is at least 1", some |N'u| >= 1. For every u, λ/2 (u'M u - 1) is the concave dual of the distance to that set,
  so g, the minimum of these duals, is concave on -s < λ <= 0, s the smaller eigenvalue of S_xx, and the duality gap is
  zero at its maximum: the root is unique and gives the global optimum.
- It has one above 1. The constraint is then equivalent to "all are at most 1", which is convex: any solution with L
  positive semidefinite is the global optimum. Either N is orthogonal, m = 0 (L of rank two), or λ > 0 at the root.

One camera does not determine the sign of m: two mirrored rotations fit equally well. An out-of-plane rotation by φ
changes N by φ²/2 only, so a small one is hardly observable; if there is none, both solutions are equal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import atan2, cos, hypot, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from sylpose.display import Printable
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import transpose
from sylpose.geometry.validation import check_rotation, check_type
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate
from sylpose.status import Status
from sylpose.sylvester.centralized import find_unobservable_rotations, rotation_status
from sylpose.sylvester.depth_bias import information_with_depth_bias
from sylpose.sylvester.orthographic import ROUNDING_SHARE, Views, build_cost, compute_views

# Points are collinear where the smaller eigenvalue of S_xx is at most this share of the larger: well above rounding's
# 1e-16 (choice).
COLLINEAR_RATIO = 1e-12
# If S_yx is zero, "no motion" is selected: this share of S_xx, of the size of rounding, is added to S_yx. The root is
# then above -s also where v would otherwise be undetermined (derived).
REGULARIZATION = 1e-15


@dataclass(frozen=True, eq=False, repr=False)
class OneCameraSolution(Printable):
    """Two mirrored rotations that fit one camera's orthographic view equally well.

    Attributes:
        status: `OK`, the rotation is found up to the mirror ambiguity; `ROTATION_NOT_OBSERVABLE`, `unobservable` is not
            empty; `NOT_CERTIFIED`, not proved to be the global optimum (in 30,000 random problems: never).
        rotations: (2, 3, 3) X_j = R X_i + t, world frame, of equal cost: the one with `m`, then the one with -m. They
            are equal if m = 0. The rotation about unobservable axes is minimal. NaN if the points have no spread.
        N: (2, 2) upper-left block of the rotation in the camera's frame (rotated onto the mean rays, with `aim`).
        m: (2,) third entries of its first two rows, with m[0] > 0, or m[0] = 0 and m[1] >= 0.
        multiplier: (2, 2) L of Sylvester's equation in the units of `cost`; zero for the unconstrained estimate.
        cost: half the sum of squared residuals, in units of 2/9 tr S_xx (`QuadraticCost.scale` of this one camera).
        information: (2, 3, 3) of w, R = exp(w) rotations[k], world axes, 1/rad²: from noise and the possible bias by a
            surface, as in `CentralizedSolution`. It does not include the mirror ambiguity.
        noise_information: (2, 3, 3) information if depth is uncorrelated with the image: the Hessian of the cost on
            SO(3) over the residual variance.
        unobservable: (2, k, 3) per rotation the unit directions of w, world axes, that are not observable
            (`find_unobservable_rotations`).
        iterations: evaluations of the scalar equation.
    """

    status: Status
    rotations: FloatArray
    N: FloatArray
    m: FloatArray
    multiplier: FloatArray
    cost: float
    information: FloatArray
    unobservable: FloatArray
    iterations: int
    noise_information: FloatArray

    def select_nearest(self, guess: FloatArray) -> RotationEstimate:
        """Return the solution that is nearer to a guess (3, 3), which resolves the mirror ambiguity.

        Raises:
            ValueError: guess is not a rotation.
        """
        guess = check_rotation(guess, "guess")
        k = int(np.argmin(np.linalg.norm(self.rotations - guess, axis=(1, 2))))
        selected = self.rotations[k], self.information[k], self.unobservable[k]
        return RotationEstimate(self.status, *selected, self.iterations)


def solve_one_camera(rotation: ArrayLike, moments: PairMoments, *, aim: bool = True) -> OneCameraSolution:
    """Estimate the rotation from one camera: the global optimum under pseudo-orthogonality.

    The constraint is satisfied to rounding for any data. The result is exact for noise-free orthographic data in which
    depth is uncorrelated with the image.

    Args:
        rotation: (3, 3) Q of camera_from_world.
        moments: pair moments of the camera's matches between the two frames.
        aim: as in `compute_views`; False for exactly orthographic points.

    Returns:
        The two mirrored rotations.

    Raises:
        ValueError: rotation is not a rotation matrix.
    """
    return _solve(rotation, moments, aim, _solve_block)


def solve_unconstrained(rotation: ArrayLike, moments: PairMoments, *, aim: bool = True) -> OneCameraSolution:
    """Estimate the rotation by the unconstrained baseline, then project it to the nearest block of a rotation.

    N = S_yx S_xx⁻¹ solves Sylvester's equation with L = 0. The projection is in the Frobenius norm: the larger singular
    value becomes 1, the smaller is limited to 1. The paper's introduction criticizes this two-step estimate. For
    collinear points the equation is singular and the minimum-norm N is used. Away from the optimum the Hessian,
    `noise_information`, may be negative. Arguments, result and errors are those of `solve_one_camera`.
    """
    return _solve(rotation, moments, aim, _project_block)


class _BlockSolution(NamedTuple):
    """Solution for N (in the axes of `_normalize` on its right) and m, with its multiplier and certificate."""

    N: FloatArray
    m: FloatArray
    multiplier: FloatArray
    certified: bool
    iterations: int


def _solve(
    rotation: ArrayLike,
    moments: PairMoments,
    aim: bool,
    solve_block: Callable[[FloatArray, FloatArray, FloatArray], _BlockSolution],
) -> OneCameraSolution:
    """Solve for the block by a function of s, axes and T (`_normalize`)."""
    Q = check_rotation(rotation)
    views = compute_views(Q[None], [check_type(moments, PairMoments, "moments")], aim=aim)
    # Excludes rounding errors of centering; slightly stricter than `build_cost`, which raises an error.
    if not np.trace(views.s_xx[0]) > 10 * ROUNDING_SHARE * views.total:
        return _no_spread_solution()
    s, axes, T = _normalize(views)
    return _make_solution(views, axes, solve_block(s, axes, T))


def _solve_block(s: FloatArray, axes: FloatArray, T: FloatArray) -> _BlockSolution:
    """Solve under pseudo-orthogonality."""
    if s[0] == 0:
        return _solve_collinear(s[1], axes[:, 1], T[:, 1], axes)
    return _solve_constrained(s, T + REGULARIZATION * axes * s)


def _project_block(s: FloatArray, axes: FloatArray, T: FloatArray) -> _BlockSolution:  # noqa: ARG001
    """Project the unconstrained solution to the nearest block of a rotation."""
    U, values, W = np.linalg.svd(T / np.where(s > 0, s, np.inf))
    c = min(float(values[1]), 1.0)
    return _BlockSolution(U @ np.diag([1.0, c]) @ W, _third_column(U[:, 0], c), np.zeros((2, 2)), True, 0)


def _normalize(views: Views) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return s, axes and T: S_xx / tr S_xx = axes diag(s) axes', T = S_yx axes / tr S_xx.

    s (2,) is ascending; s[0] = 0 if the points are collinear.
    """
    trace = np.trace(views.s_xx[0])
    s, axes = np.linalg.eigh(views.s_xx[0] / trace)
    if s[0] <= max(COLLINEAR_RATIO * s[1], ROUNDING_SHARE * views.total / trace):
        s[0] = 0
    return s, axes, views.s_yx[0] @ axes / trace


def _solve_constrained(s: FloatArray, T: FloatArray) -> _BlockSolution:
    """Minimize 1/2 tr N diag(s) N' - tr N'T over the N with largest singular value 1, s > 0."""
    s0, s1 = float(s[0]), float(s[1])
    (a0, a1), (b0, b1) = T.tolist()

    def stationary(d: float) -> tuple[float, float, float, float]:
        """Return u and v for λ = d - s0."""
        w0, w1 = 1 / d, 1 / (s1 - s0 + d)
        p, q = w0 / s0, w1 / s1
        angle = 0.5 * atan2(2 * (p * a0 * b0 + q * a1 * b1), p * (a0 * a0 - b0 * b0) + q * (a1 * a1 - b1 * b1))
        u0, u1 = cos(angle), sin(angle)
        return u0, u1, w0 * (a0 * u0 + b0 * u1), w1 * (a1 * u0 + b1 * u1)

    def excess(d: float) -> float:
        """Return 1 - 1/|v|: the scalar equation in its nearly linear form."""
        _, _, v0, v1 = stationary(d)
        return 1 - 1 / max(hypot(v0, v1), 1e-300)

    if excess(s0) >= 0:
        block = _solve_orthogonal(s, T)
        if block is not None:
            return block
        low, high = s0, 2 * max(float(np.linalg.norm(T)), s0)
    else:
        low, high = s0, s0
        for _ in range(250):  # the first component of v grows as 1 / d
            low /= 16
            if excess(low) > 0:
                break
    rtol = 4 * np.finfo(float).eps
    d, report = brentq(excess, low, high, xtol=1e-300, rtol=rtol, maxiter=300, full_output=True, disp=False)
    u0, u1, v0, v1 = stationary(d)
    if abs(hypot(v0, v1) - 1) > 1e-12:
        u0, u1, v0, v1 = _solve_at_kink(s, T, d)
    u, v = np.array([u0, u1]), np.array([v0, v1]) / hypot(v0, v1)
    u_across, v_across = np.array([-u1, u0]), np.array([-v[1], v[0]])
    c = float(u_across @ T @ v_across / (s @ v_across**2))
    proved = bool(report.converged and abs(c) <= 1 + 1e-9)
    c = min(max(c, -1.0), 1.0)
    N = np.outer(u, v) + c * np.outer(u_across, v_across)
    multiplier = float(u @ T @ v - s @ v**2) * np.outer(u, u)
    return _BlockSolution(N, _third_column(u, c), multiplier, proved, int(report.function_calls))


def _third_column(u: FloatArray, c: float) -> FloatArray:
    """Return m = √(1 - c²) u⊥ of an N with singular values 1 (left vector u) and |c|."""
    return np.asarray(np.sqrt((1 - c) * (1 + c)) * np.array([-u[1], u[0]]))


def _solve_at_kink(s: FloatArray, T: FloatArray, d: float) -> tuple[float, float, float, float]:
    """Return u and v where both eigenvalues of M(λ) are equal and |v| jumps across 1.

    Every u is an eigenvector there; one has |v| = 1. |v|² = u'K u with K = T (diag(s) + λ)⁻² T'; of the two solutions
    the one with the larger u'M u is returned.
    """
    w = 1 / (s - s[0] + d)
    K, M = (T * w**2) @ T.T, (T * (w / s)) @ T.T
    mean, swing = (K[0, 0] + K[1, 1]) / 2, hypot((K[0, 0] - K[1, 1]) / 2, K[0, 1])
    middle = atan2(K[0, 1], (K[0, 0] - K[1, 1]) / 2)
    away = np.arccos(np.clip((1 - mean) / max(swing, 1e-300), -1, 1))
    angles = np.array([middle + away, middle - away]) / 2
    both = np.column_stack([np.cos(angles), np.sin(angles)])
    u = both[np.argmax(((both @ M) * both).sum(axis=1))]
    v = w * (u @ T)
    return float(u[0]), float(u[1]), float(v[0]), float(v[1])


def _solve_orthogonal(s: FloatArray, T: FloatArray) -> _BlockSolution | None:
    """Return the orthogonal N (m = 0) if it is the global optimum (L positive semidefinite), else None.

    Valid only if the unconstrained N violates the constraint. The best rotation and the best reflection have closed
    forms.
    """
    for sign in (1.0, -1.0):
        angle = atan2(T[1, 0] - sign * T[0, 1], T[0, 0] + sign * T[1, 1])
        N = np.array([[cos(angle), -sign * sin(angle)], [sin(angle), sign * cos(angle)]])
        L = (T - N * s) @ N.T
        L = (L + L.T) / 2
        if np.linalg.eigvalsh(L)[0] >= 0:
            return _BlockSolution(N, np.zeros(2), L, True, 1)
    return None


def _solve_collinear(s: float, line: FloatArray, t: FloatArray, axes: FloatArray) -> _BlockSolution:
    """Solve for collinear points: only the line's new direction is observed; the smallest rotation is returned.

    Args:
        s: spread along the line.
        line: (2,) its direction in frame i.
        t: (2,) s N line plus noise.
        axes: (2, 2) as in `_normalize`.
    """
    image_direction, excess = t / s, float(np.linalg.norm(t)) - s
    if excess > 0:
        image_direction = t / np.linalg.norm(t)
    before = np.array([*line, 0.0])
    after = np.array([*image_direction, sqrt(max(0.0, 1 - float(image_direction @ image_direction)))])
    # The smallest rotation between two unit vectors: the product of two half-turn rotations, or a half turn in the
    # image.
    half = before + after
    if half @ half < 1e-15:
        R = np.diag([-1.0, -1.0, 1.0])
    else:
        R = (2 * np.outer(half, half) / (half @ half) - np.eye(3)) @ (2 * np.outer(before, before) - np.eye(3))
    multiplier = max(excess, 0.0) * np.outer(image_direction, image_direction)
    return _BlockSolution(R[:2, :2] @ axes, R[:2, 2], multiplier, True, 0)


def _make_solution(views: Views, axes: FloatArray, block: _BlockSolution) -> OneCameraSolution:
    N, m = block.N @ axes.T, block.m
    m = (-m if m[0] < 0 or (m[0] == 0 and m[1] < 0) else m) + 0.0  # no -0
    in_camera = np.array([_complete_rotation(N, m), _complete_rotation(N, -m)])
    rotations = transpose(views.rotation_y) @ in_camera @ views.rotation_x
    q = build_cost(views)
    at = q.evaluate(rotations)
    information = np.array([information_with_depth_bias(views, R) for R in rotations])
    unobservable = find_unobservable_rotations(information, rotations[0], 1)
    status, cost = rotation_status(True, block.certified, unobservable[0]), float(at.cost[0] / q.scale)
    fit = N, m, 4.5 * block.multiplier, cost
    return OneCameraSolution(status, rotations, *fit, information, unobservable, block.iterations, at.information)


def _complete_rotation(N: FloatArray, m: FloatArray) -> FloatArray:
    rows = np.column_stack([N, m])
    return np.array([rows[0], rows[1], np.cross(rows[0], rows[1])])


def _no_spread_solution() -> OneCameraSolution:
    nan, zero = np.full((2, 3, 3), np.nan), np.zeros((2, 3, 3))
    fit = nan[0, :2, :2], nan[0, 0, :2], np.zeros((2, 2)), 0.0
    return OneCameraSolution(Status.ROTATION_NOT_OBSERVABLE, nan, *fit, zero, np.array([np.eye(3)] * 2), 0, zero.copy())
