"""Points known in 3D, by their depth or from a model: the same Sylvester's equation with other data.

Every estimator of the paper minimises a cost whose stationary points solve Σ A_c R B_c + L R = Σ C_c, R'R = I, L = L'.

- 2D-3D: points X known in frame i, seen orthographically in frame j, y = P Q (R X + t - o) + noise. A_c = Q'P'PQ,
  B_c = S_XX (3x3), C_c = Q'P' S_yX: the unbalanced Procrustes problem, which no singular value decomposition solves.
- 3D-3D: y = R X + t + noise. A = I, B = S_XX, C = S_yX. As R S_XX = (R S_XX R') R, the equation is K R = C with the
  symmetric K = L + R S_XX R', so K² = C C': a polar decomposition (Kabsch, 1976; Umeyama, 1991).

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation", Computer Vision
and Image Understanding 114 (2010); the derivation is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.display import proof_told, vector
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import checked_rotations, transpose
from sylpose.geometry.observability import UNSEEN_TURN, unseen_directions
from sylpose.geometry.validation import finite, items
from sylpose.results import RotationEstimate, Status
from sylpose.sylvester.centralized import status_of
from sylpose.sylvester.so3 import CERTIFICATE, FLAT, LEAST, Quadratic, minimize

__all__ = ["KnownDepthSolution", "solve_2d3d", "solve_3d3d"]


# Eigenvalues up to this share of others are zero: well above rounding's 1e-16 (choice).
ROUNDING = 1e-12
# Points whose distance from their mean is this share of that from the origin are spread by rounding only (derived).
FALLEN = 16 * float(np.finfo(float).eps)
# No weight is larger, and one that is smaller than the inverse is none: squares stay in range (derived).
MOST = 1e100


@dataclass(frozen=True, eq=False, repr=False)
class KnownDepthSolution(RotationEstimate):
    """The motion of points that are known in 3D.

    Attributes:
        status: OK; NOT_CERTIFIED, the best of all minima found; NOT_CONVERGED; TURN_NOT_OBSERVABLE, something is `unseen`.
        rotation: (3, 3) the first of `candidates`; NaN where no points are spread: then the information is zero, the
            multiplier too.
        information: (3, 3) of w, 1/rad²: the Hessian of the cost on SO(3) over the residuals' variance. Depth is
            known: there is no bias.
        unseen: (k, 3) unit directions of w with a standard deviation beyond `UNSEEN_TURN`.
        iterations: of the minimiser; 0 for the closed form.
        candidates: (k, 3, 3) rotations: the global optimum when proved, else all local minima found, best first
            (two mirrored ones of a flat object in one camera, for instance); where something is not seen they sample a
            continuum.
        costs: (k,) half the sum of squared residuals of each, in units in which H has the mean eigenvalue 1.
        certified: `rotation` is proved to be the global optimum by Sylvester's multiplier alone (`sylvester.so3`).
        multiplier: (3, 3) L of Sylvester's equation at `rotation`, in the units of `costs`.
        center: (3,) weighted mean of all points in frame i, world.
        displacement: (3,) d of the centre, X_j = R (X_i - center) + center + d; of least length where a direction is not
            seen (one camera: along its axis). NaN without a rotation, but for 3D-3D.
        displacement_information: (3, 3) of d given the rotation; zero along what is not seen.
    """

    candidates: FloatArray
    costs: FloatArray
    certified: bool
    multiplier: FloatArray
    center: FloatArray
    displacement: FloatArray
    displacement_information: FloatArray

    @property
    def translation(self) -> FloatArray:
        """(3,) t."""
        return self.center + self.displacement - self.rotation @ self.center

    def _told_besides(self) -> list[tuple[str, str]]:
        return [
            ("displacement", f"{vector(self.displacement, 4)} of the points' centre"),
            proof_told(self.certified, len(self.candidates)),
        ]


def solve_2d3d(
    rotations: ArrayLike,
    points: Sequence[ArrayLike],
    images: Sequence[ArrayLike],
    *,
    centers: ArrayLike | None = None,
    weights: Sequence[ArrayLike] | None = None,
) -> KnownDepthSolution:
    """The motion of points known in 3D in frame i, from their orthographic images in frame j, all cameras together.

    The rotation follows from each camera's points and images about their means, the displacement from the means.
    Images are in the points' unit of length; weak perspective: normalised points of a camera that looks at the object,
    times the object's depth.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        points: per camera (n, 3) in frame i, world; n may be 0.
        images: per camera (n, 2), y = P Q (X_j - o).
        centers: (C, 3) o, the world point at the origin of each image; None for the world's origin.
        weights: per camera (n,) non-negative, at most 1e100, none if below 1e-100; None for ones. A point of weight w counts
            as w points: small weights leave little information.

    Raises:
        ValueError: shapes that do not fit, values that are not finite, matrices that are no rotations, no points at all.
    """
    points = items(points, "points")
    Q = checked_rotations(rotations, len(points))
    images = items(images, "images", len(Q))
    o = np.zeros((len(Q), 3)) if centers is None else finite(centers, (len(Q), 3), "centers")
    w = [None] * len(Q) if weights is None else items(weights, "weights", len(Q))
    sets = [
        _moments(points[c], images[c], w[c], (f"points[{c}]", f"images[{c}]", f"weights[{c}]"), 2)
        for c in range(len(Q))
    ]
    weight = sum(s.weight for s in sets)
    if not weight > 0:
        raise ValueError("no camera has points")
    center = sum((s.weight * s.mean_x for s in sets), start=np.zeros(3)) / weight
    PQ = Q[:, :2]
    q = Quadratic.of_terms(
        transpose(PQ) @ PQ,
        np.array([s.s_xx for s in sets]),
        transpose(PQ) @ np.array([s.s_yx for s in sets]),
        np.array([s.half_yy for s in sets]),
        np.array([s.weight for s in sets]),
    )
    scale = float(q.scale)
    if not scale > FALLEN**2 * sum(s.total for s in sets):
        return _nothing(center, np.full(3, np.nan))
    candidates, _, iterations = minimize(q.H, q.h)
    R = np.asarray(candidates[0])
    best = q.at(R)
    converged, H, L = bool(best.stationary), q.H / scale, best.multiplier / scale
    certified = converged and (
        _proved_by_multiplier(H, L)
        or _proved_by_two_rows(PQ[[s.weight > 0 for s in sets]], H, L)
        or _proved_by_two_columns(np.sum([s.s_xx for s in sets], axis=0), H, R.T @ L @ R)
    )
    if certified:
        candidates = candidates[:1]
    costs = q.cost(candidates) / scale
    unseen = unseen_directions(best.information, UNSEEN_TURN, flat=FLAT)
    status = status_of(converged, certified, unseen)
    d, of_d = _displacement(PQ, o, sets, R, center, float(q.variance(best.cost)))
    return KnownDepthSolution(
        status, R, best.information, unseen, iterations, candidates, costs, certified, L, center, d, of_d
    )


def solve_3d3d(x: ArrayLike, y: ArrayLike, weights: ArrayLike | None = None) -> KnownDepthSolution:
    """The motion of points known in 3D in both frames: the rotation of the polar decomposition, never a reflection.

    K R = C, K² = C C' leaves K's signs free: K = U diag(σ1, σ2, ±σ3) U' with the singular values and left vectors of C,
    and the largest K for which det R = 1 is the global optimum, also for flat sets and for mirrored ones. The turn about
    the line of collinear points is not seen; of all those as good the least turn is given.

    Args:
        x, y: (n, 3) points in frames i and j, world.
        weights: as in `solve_2d3d`, (n,).

    Raises:
        ValueError: shapes that do not fit, values that are not finite, negative weights, no points.
    """
    s = _moments(x, y, weights, ("x", "y", "weights"), 3)
    if not s.weight > 0:
        raise ValueError("there are no points")
    d, scale = s.mean_y - s.mean_x, float(np.trace(s.s_xx)) / 3
    if not scale > FALLEN**2 * s.total:
        return _nothing(s.mean_x, d)
    S, C = s.s_xx / scale, s.s_yx / scale
    U, sigma, W = np.linalg.svd(C)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ W))])
    R, K = (U * signs) @ W, (U * signs * sigma) @ U.T
    hessian = np.trace(K) * np.eye(3) - K
    values, vectors = np.linalg.eigh(hessian)
    if values[0] <= ROUNDING * values[1]:
        R = _least_turn(R, vectors[:, 0])
    squares = (s.half_yy / scale) + 0.5 * float(np.trace(S))
    cost = max(squares - float(np.trace(K)), 0.0)
    variance = max(cost, LEAST * squares) * scale / s.weight * 2 / 3
    information = hessian * scale / variance
    unseen = unseen_directions(information, UNSEEN_TURN, flat=FLAT)
    return KnownDepthSolution(
        status=status_of(True, True, unseen),
        rotation=R,
        candidates=R[None],
        costs=np.array([cost]),
        certified=True,
        multiplier=K - R @ S @ R.T,
        information=information,
        unseen=unseen,
        center=s.mean_x,
        displacement=d,
        displacement_information=s.weight / variance * np.eye(3),
        iterations=0,
    )


class _Moments(NamedTuple):
    """Of one set of points x (n, 3) and y (n, k): weight Σ w, means, Σ w xx' and Σ w yx' about them, half Σ w |y|² about its
    mean, and the half sums of squares of both about the origin, to judge what is no more than rounding."""

    weight: float
    mean_x: FloatArray
    mean_y: FloatArray
    s_xx: FloatArray
    s_yx: FloatArray
    half_yy: float
    total: float


def _moments(
    x: ArrayLike, y: ArrayLike, weights: ArrayLike | None, names: tuple[str, str, str], dimensions: int
) -> _Moments:
    points, images = finite(x, ("n", 3), names[0]), finite(y, ("n", dimensions), names[1])
    n = len(points)
    if len(images) != n:
        raise ValueError(f"{names[0]} has {n} points and {names[1]} has {len(images)}")
    w = np.ones(n) if weights is None else finite(weights, (n,), names[2], most=MOST)
    if (w < 0).any():
        raise ValueError(f"{names[2]} must be {n} finite, non-negative numbers")
    w = np.where(w < 1 / MOST, 0.0, w)
    weight = float(w.sum())
    share = w / weight if weight > 0 else w
    mean_x, mean_y = share @ points, share @ images
    # Once more, of what is left: far from the origin a mean has more rounding than the points.
    mean_x, mean_y = mean_x + share @ (points - mean_x), mean_y + share @ (images - mean_y)
    total = float(w @ (points**2).sum(axis=1))
    dx, dy = points - mean_x, images - mean_y
    return _Moments(weight, mean_x, mean_y, (dx.T * w) @ dx, (dy.T * w) @ dx, float(w @ (dy**2).sum(axis=1)) / 2, total)


def _proved_by_multiplier(H: FloatArray, L: FloatArray) -> bool:
    """The certificate by K. That by all multipliers (`so3_squares`) proves more, but also the better one of two mirrored
    turns that differ by less than noise: whoever has known points is told that these are not certified."""
    return bool(np.linalg.eigvalsh(H + np.kron(L, np.eye(3)))[0] > CERTIFICATE)


def _proved_by_two_rows(PQ: FloatArray, H: FloatArray, L: FloatArray) -> bool:
    """The certificate for cameras that all look the same way, one camera above all.

    Their cost says nothing of the row of R along their axis, so K = H + L ⊗ I is never positive definite. But that row
    follows from the other two: K positive definite on those proves the optimum all the same.
    """
    values, axes = np.linalg.eigh(np.einsum("cki,ckj->ij", PQ, PQ))
    if values[0] > ROUNDING * values[2]:
        return False
    across = np.kron(axes[:, 1:].T, np.eye(3))
    K = H + np.kron(L, np.eye(3))
    return bool(np.linalg.eigvalsh(across @ K @ across.T)[0] > CERTIFICATE)


def _proved_by_two_columns(s_xx: FloatArray, H: FloatArray, M: FloatArray) -> bool:
    """The certificate for points of all cameras on parallel planes: the cost says nothing of R along their normal.

    With M = R'L R, K r = h is also (H + I ⊗ M) r = h; and two columns of R give the third.
    """
    values, axes = np.linalg.eigh(s_xx)
    if values[0] > ROUNDING * values[2]:
        return False
    across = np.kron(np.eye(3), axes[:, 1:].T)
    K = H + np.kron(np.eye(3), M)
    return bool(np.linalg.eigvalsh(across @ K @ across.T)[0] > CERTIFICATE)


def _displacement(
    PQ: FloatArray, o: FloatArray, sets: Sequence[_Moments], R: FloatArray, center: FloatArray, variance: float
) -> tuple[FloatArray, FloatArray]:
    """d from the means, ȳ = P Q (R (x̄ - center) + center + d - o), and its information.

    Over the larger of two variances: the points' residuals' about R and, where the means leave some over, theirs.
    """
    root = np.sqrt([s.weight for s in sets])
    rows = (root[:, None, None] * PQ).reshape(-1, 3)
    target = [
        r * (s.mean_y - p @ (R @ (s.mean_x - center) + center - c))
        for r, p, c, s in zip(root, PQ, o, sets, strict=True)
    ]
    d, _, rank, _ = np.linalg.lstsq(rows, np.concatenate(target), rcond=1e-9)
    freedom = 2 * int((root > 0).sum()) - int(rank)
    if freedom > 0:
        residuals = np.concatenate(target) - rows @ d
        variance = max(variance, float(residuals @ residuals) / freedom)
    return d, rows.T @ rows / variance


def _least_turn(R: FloatArray, axis: FloatArray) -> FloatArray:
    """Of all exp(θ [axis]x) R that of the least angle: with the largest trace, along + across cos θ + other sin θ."""
    along = float(axis @ R @ axis)
    other = float(axis @ [R[1, 2] - R[2, 1], R[2, 0] - R[0, 2], R[0, 1] - R[1, 0]])
    return np.asarray(Rotation.from_rotvec(np.arctan2(other, np.trace(R) - along) * axis).as_matrix() @ R)


def _nothing(center: FloatArray, displacement: FloatArray) -> KnownDepthSolution:
    """Points that fall together: nothing of the turn is seen."""
    return KnownDepthSolution(
        status=Status.TURN_NOT_OBSERVABLE,
        rotation=np.full((3, 3), np.nan),
        candidates=np.full((1, 3, 3), np.nan),
        costs=np.zeros(1),
        certified=False,
        multiplier=np.zeros((3, 3)),
        information=np.zeros((3, 3)),
        unseen=np.eye(3),
        center=center,
        displacement=displacement,
        displacement_information=np.zeros((3, 3)),
        iterations=0,
    )
