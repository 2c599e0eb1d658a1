"""What one camera alone says of a rotation: Sylvester's equation under pseudo-orthogonality.

Seen orthographically, centred points move by y = N x + m z + noise, N the upper-left 2x2 block of the rotation as the
camera sees it, m the first two entries of its third column, z the depth, which is ignored. The least squares

    minimise 1/2 Σ |y - N x|²   subject to   N N' + m m' = I

has the stationary points (C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation",
Computer Vision and Image Understanding 114 (2010); what follows is our derivation)

    N S_xx + L N = S_yx,   L = L',   L m = 0.

The constraint says that the largest singular value of N is 1: N = u v' + c u⊥ v⊥', |c| <= 1, m = ±√(1 - c²) u⊥. So L is
λ u u' unless m = 0, and the equation gives v = (S_xx + λ)⁻¹ S_yx' u and makes u an eigenvector of

    M(λ) = S_yx S_xx⁻¹ (S_xx + λ)⁻¹ S_yx':   a scalar equation is left, |v| = 1.

With u the eigenvector of the larger eigenvalue μ it is the derivative of g(λ) = λ/2 (μ(λ) - 1), and 0 divides two cases.

- The unconstrained N = S_yx S_xx⁻¹ has no singular value above 1 (noise in x shrinks it). Then the constraint may be
  read as "one at least 1", some |N'u| >= 1. For every u, λ/2 (u'M u - 1) is the concave dual of the distance to that,
  so g, the least of these duals, is concave on -s < λ <= 0, s the smaller eigenvalue of S_xx, and the duality gap is
  zero at its maximum: the root is unique and the answer the global optimum.
- It has one above 1. Then the constraint may be read as "all at most 1", which is convex: whatever satisfies it with L
  positive semidefinite is the global optimum. Either N is orthogonal, m = 0 (L of rank two), or λ > 0 at the root.

One camera cannot tell the sign of m: two mirrored rotations fit equally well. And an out-of-plane turn of φ changes N
by φ²/2 only: a small one is hardly seen, and where there is none the two solutions are one.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from sylpose.display import Telling, Told, turned
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import checked_rotation, covariance_of, transpose
from sylpose.geometry.validation import kind_of
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate, Status
from sylpose.sylvester.centralized import status_of, unseen_turns
from sylpose.sylvester.depth_bias import information_on_surfaces
from sylpose.sylvester.orthographic import ROUNDING, Views, quadratic_of, views_of

__all__ = ["OneCameraSolution", "solve_one_camera", "solve_unconstrained"]


# Points are collinear where the smaller eigenvalue of S_xx is at most this share of the larger: well above rounding's
# 1e-16 (choice).
COLLINEAR = 1e-12
# Where S_yx says nothing at all no motion decides: this share of S_xx, of the size of rounding, is added to it. So the
# root is above -s also where without it v would be left free there (derived).
STILL = 1e-15


@dataclass(frozen=True, eq=False, repr=False)
class OneCameraSolution(Told):
    """The two rotations that one camera cannot tell apart, orthographic views: two `RotationEstimate` in one.

    Attributes:
        status: OK, the rotation is found but for the mirror; TURN_NOT_OBSERVABLE, besides that something is `unseen`;
            NOT_CERTIFIED, not proved to be the global optimum (in 30,000 random problems: never).
        rotations: (2, 3, 3) X_j = R X_i + t, world frame, of equal cost: the one with `m`, then the one with -m. They
            are equal where m = 0. What is unseen is as little turned as it may be. NaN if the points have no spread.
        N: (2, 2) upper-left block of the rotation as the camera sees it (turned onto the mean rays, with `aim`).
        m: (2,) the rest of its first two rows, with m[0] > 0, or m[0] = 0 and m[1] >= 0.
        multiplier: (2, 2) L of Sylvester's equation in the units of `cost`; zero for the unconstrained estimate.
        cost: half the sum of squared residuals, in units of 2/9 tr S_xx (`Quadratic.scale` of this one camera).
        information: (2, 3, 3) of w, R = exp(w) rotations[k], world axes, 1/rad²: of noise and of what a surface may have
            done, as in `CentralizedSolution`. It knows nothing of the other, mirrored solution.
        noise_information: (2, 3, 3) what it would be if depth were known to be uncorrelated with the image: the Hessian of
            the cost on SO(3) over the residuals' variance.
        unseen: (2, k, 3) for each rotation the unit directions of w, world axes, that are not seen (`unseen_turns`).
        iterations: evaluations of the scalar equation.
    """

    status: Status
    rotations: FloatArray
    N: FloatArray
    m: FloatArray
    multiplier: FloatArray
    cost: float
    information: FloatArray
    unseen: FloatArray
    iterations: int
    noise_information: FloatArray

    def nearest(self, guess: FloatArray) -> RotationEstimate:
        """Of the two that which is nearer to a guess (3, 3): the camera itself cannot tell.

        Raises:
            ValueError: a guess that is no rotation.
        """
        guess = checked_rotation(guess, "guess")
        k = int(np.argmin(np.linalg.norm(self.rotations - guess, axis=(1, 2))))
        return RotationEstimate(self.status, self.rotations[k], self.information[k], self.unseen[k], self.iterations)

    def _told(self) -> Telling:
        status = f"{self.status.value}. {self.status.text}"
        if not np.isfinite(self.rotations).all():
            return Telling(self.status.value, sentence=status)
        first, second = (Rotation.from_matrix(R) for R in self.rotations)
        sure, mirrored = (covariance_of(information) for information in self.information)
        rows = [("turned", turned(first, sure)), ("or, mirrored", turned(second, mirrored))]
        return Telling(f"{self.status.value}, turned {turned(first)} or {turned(second)}", rows, status)


def solve_one_camera(rotation: ArrayLike, moments: PairMoments, *, aim: bool = True) -> OneCameraSolution:
    """The global optimum under pseudo-orthogonality, which holds to rounding whatever the data.

    Exact for noise-free orthographic data in which depth is uncorrelated with the image.

    Args:
        rotation: (3, 3) Q of camera_from_world.
        moments: of the camera's matches between the two frames.
        aim: as in `views_of`; False for exactly orthographic points.

    Raises:
        ValueError: a matrix that is no rotation.
    """
    views = _views(rotation, moments, aim)
    if not _has_spread(views):
        return _nothing()
    s, axes, T = _normalised(views)
    if s[0] == 0:
        return _solution(views, axes, _of_a_line(s[1], axes[:, 1], T[:, 1], axes))
    return _solution(views, axes, _constrained(s, T + STILL * axes * s))


def solve_unconstrained(rotation: ArrayLike, moments: PairMoments, *, aim: bool = True) -> OneCameraSolution:
    """The baseline: N = S_yx S_xx⁻¹, Sylvester's equation with L = 0, then adjusted to the nearest block of a rotation.

    Nearest in the Frobenius norm: the larger singular value becomes 1, the smaller is made 1 where it is more.
    The paper's introduction finds fault with this two-step estimate. Of collinear points, which leave the equation
    singular, the least N. Off the optimum the Hessian, `noise_information`, may be negative. Arguments and errors as in
    `solve_one_camera`.
    """
    views = _views(rotation, moments, aim)
    if not _has_spread(views):
        return _nothing()
    s, axes, T = _normalised(views)
    U, values, W = np.linalg.svd(T / np.where(s > 0, s, np.inf))
    c = min(float(values[1]), 1.0)
    return _solution(views, axes, _Block(U @ np.diag([1.0, c]) @ W, _rest(U[:, 0], c), np.zeros((2, 2)), True, 0))


class _Block(NamedTuple):
    """N, in the axes of `_normalised` on its right, m, the multiplier, whether it is proved optimal, iterations."""

    N: FloatArray
    m: FloatArray
    multiplier: FloatArray
    proved: bool
    iterations: int


def _views(rotation: ArrayLike, moments: PairMoments, aim: bool) -> Views:
    Q = checked_rotation(rotation)
    return views_of(Q[None], [kind_of(moments, PairMoments, "moments")], aim=aim)


def _has_spread(views: Views) -> bool:
    # What centring leaves by rounding is no spread; a little stricter than `quadratic_of`, which refuses such.
    return bool(np.trace(views.s_xx[0]) > 10 * ROUNDING * views.total)


def _normalised(views: Views) -> tuple[FloatArray, FloatArray, FloatArray]:
    """S_xx / tr S_xx = axes diag(s) axes', s (2,) ascending, s[0] = 0 if collinear, and T = S_yx axes / tr S_xx."""
    trace = np.trace(views.s_xx[0])
    s, axes = np.linalg.eigh(views.s_xx[0] / trace)
    if s[0] <= max(COLLINEAR * s[1], ROUNDING * views.total / trace):
        s[0] = 0
    return s, axes, views.s_yx[0] @ axes / trace


def _constrained(s: FloatArray, T: FloatArray) -> _Block:
    """Minimise 1/2 tr N diag(s) N' - tr N'T over the N with largest singular value 1, s > 0."""
    s0, s1 = float(s[0]), float(s[1])
    (a0, a1), (b0, b1) = T.tolist()

    def stationary(d: float) -> tuple[float, float, float, float]:
        """u and v of λ = d - s0."""
        w0, w1 = 1 / d, 1 / (s1 - s0 + d)
        p, q = w0 / s0, w1 / s1
        angle = 0.5 * atan2(2 * (p * a0 * b0 + q * a1 * b1), p * (a0 * a0 - b0 * b0) + q * (a1 * a1 - b1 * b1))
        u0, u1 = cos(angle), sin(angle)
        return u0, u1, w0 * (a0 * u0 + b0 * u1), w1 * (a1 * u0 + b1 * u1)

    def excess(d: float) -> float:
        """1 - 1/|v|: the scalar equation, in the form that is nearly linear."""
        _, _, v0, v1 = stationary(d)
        return 1 - 1 / max(hypot(v0, v1), 1e-300)

    if excess(s0) >= 0:
        block = _orthogonal(s, T)
        if block is not None:
            return block
        low, high = s0, 2 * max(float(np.linalg.norm(T)), s0)
    else:
        low, high = s0, s0
        for _ in range(250):  # the first component of v grows as 1 / d
            low /= 16
            if excess(low) > 0:
                break
    d, report = brentq(
        excess, low, high, xtol=1e-300, rtol=4 * np.finfo(float).eps, maxiter=300, full_output=True, disp=False
    )
    u0, u1, v0, v1 = stationary(d)
    if abs(hypot(v0, v1) - 1) > 1e-12:
        u0, u1, v0, v1 = _at_kink(s, T, d)
    u, v = np.array([u0, u1]), np.array([v0, v1]) / hypot(v0, v1)
    u_across, v_across = np.array([-u1, u0]), np.array([-v[1], v[0]])
    c = float(u_across @ T @ v_across / (s @ v_across**2))
    proved = bool(report.converged and abs(c) <= 1 + 1e-9)
    c = min(max(c, -1.0), 1.0)
    N = np.outer(u, v) + c * np.outer(u_across, v_across)
    multiplier = float(u @ T @ v - s @ v**2) * np.outer(u, u)
    return _Block(N, _rest(u, c), multiplier, proved, int(report.function_calls))


def _rest(u: FloatArray, c: float) -> FloatArray:
    """m of an N whose singular values are 1, on the left with u, and |c|: √(1 - c²) u⊥."""
    return np.asarray(np.sqrt((1 - c) * (1 + c)) * np.array([-u[1], u[0]]))


def _at_kink(s: FloatArray, T: FloatArray, d: float) -> tuple[float, float, float, float]:
    """u and v where both eigenvalues of M(λ) are equal and |v| jumps past 1: every u is an eigenvector, one has |v| = 1.

    |v|² = u'K u with K = T (diag(s) + λ)⁻² T'. Of its two solutions that with the larger u'M u.
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


def _orthogonal(s: FloatArray, T: FloatArray) -> _Block | None:
    """The orthogonal N (m = 0) that is the global optimum, its L being positive semidefinite; None if there is none.

    Only for an unconstrained N outside of the constraint. The best rotation and the best reflection, closed forms.
    """
    for sign in (1.0, -1.0):
        angle = atan2(T[1, 0] - sign * T[0, 1], T[0, 0] + sign * T[1, 1])
        N = np.array([[cos(angle), -sign * sin(angle)], [sin(angle), sign * cos(angle)]])
        L = (T - N * s) @ N.T
        L = (L + L.T) / 2
        if np.linalg.eigvalsh(L)[0] >= 0:
            return _Block(N, np.zeros(2), L, True, 1)
    return None


def _of_a_line(s: float, line: FloatArray, t: FloatArray, axes: FloatArray) -> _Block:
    """Collinear points: only where the line's direction goes is seen, and the turn about it is free: the least turn.

    Args:
        s: the spread along the line, `line` (2,) its direction in frame i, t = s N line in the absence of noise.
    """
    seen, excess = t / s, float(np.linalg.norm(t)) - s
    if excess > 0:
        seen = t / np.linalg.norm(t)
    before, after = np.array([*line, 0.0]), np.array([*seen, sqrt(max(0.0, 1 - float(seen @ seen)))])
    # The least rotation of one unit vector to another: the product of two half turns, or a half turn in the image.
    half = before + after
    if half @ half < 1e-15:
        R = np.diag([-1.0, -1.0, 1.0])
    else:
        R = (2 * np.outer(half, half) / (half @ half) - np.eye(3)) @ (2 * np.outer(before, before) - np.eye(3))
    return _Block(R[:2, :2] @ axes, R[:2, 2], max(excess, 0.0) * np.outer(seen, seen), True, 0)


def _solution(views: Views, axes: FloatArray, block: _Block) -> OneCameraSolution:
    N, m = block.N @ axes.T, block.m
    m = (-m if m[0] < 0 or (m[0] == 0 and m[1] < 0) else m) + 0.0  # no -0
    rotations = transpose(views.rotation_y) @ np.array([_rotation(N, m), _rotation(N, -m)]) @ views.rotation_x
    q = quadratic_of(views)
    at = q.at(rotations)
    information = np.array([information_on_surfaces(views, R) for R in rotations])
    unseen = unseen_turns(information, rotations[0], 1)
    return OneCameraSolution(
        status=status_of(True, block.proved, unseen[0]),
        rotations=rotations,
        N=N,
        m=m,
        multiplier=4.5 * block.multiplier,
        cost=float(at.cost[0] / q.scale),
        information=information,
        unseen=unseen,
        iterations=block.iterations,
        noise_information=at.information,
    )


def _rotation(N: FloatArray, m: FloatArray) -> FloatArray:
    rows = np.column_stack([N, m])
    return np.array([rows[0], rows[1], np.cross(rows[0], rows[1])])


def _nothing() -> OneCameraSolution:
    nan = np.full((2, 3, 3), np.nan)
    return OneCameraSolution(
        status=Status.TURN_NOT_OBSERVABLE,
        rotations=nan,
        N=nan[0, :2, :2],
        m=nan[0, 0, :2],
        multiplier=np.zeros((2, 2)),
        cost=0.0,
        information=np.zeros((2, 3, 3)),
        unseen=np.array([np.eye(3)] * 2),
        iterations=0,
        noise_information=np.zeros((2, 3, 3)),
    )
