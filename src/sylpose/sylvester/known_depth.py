"""Motion estimators for points known in 3D (2D-3D and 3D-3D), by the same Sylvester equation.

Every estimator of the paper minimizes a cost whose stationary points solve Σ A_c R B_c + L R = Σ C_c, R'R = I, L = L'.

- 2D-3D: points X known in frame i, orthographic images in frame j, y = P Q (R X + t - o) + noise. A_c = Q'P'PQ,
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

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import transpose
from sylpose.geometry.normal_equations import UNOBSERVABLE_ROTATION_SD, find_unobservable_directions
from sylpose.geometry.validation import check_finite, check_rotations, check_sequence
from sylpose.results import RotationEstimate
from sylpose.status import Status
from sylpose.sylvester.centralized import rotation_status
from sylpose.sylvester.so3 import MIN_RELATIVE_VARIANCE, ZERO_CURVATURE, QuadraticCost, minimize
from sylpose.sylvester.so3_sos_certificate import CERTIFICATE

# Eigenvalues up to this share of the largest ones count as zero: well above rounding's 1e-16 (choice).
ROUNDING = 1e-12
# Spread relative to the distance from the origin below which it is due to rounding only (derived).
COINCIDENT_SPREAD = 16 * float(np.finfo(float).eps)
# Largest weight; weights below its inverse count as zero, so that squares stay in range (derived).
MAX_WEIGHT = 1e100


@dataclass(frozen=True, eq=False, repr=False)
class KnownDepthSolution(RotationEstimate):
    """Motion of points known in 3D.

    Attributes:
        status: `OK`; `NOT_CERTIFIED` (the best of all minima found); `NOT_CONVERGED`; `ROTATION_NOT_OBSERVABLE`
            (`unobservable` is not empty).
        rotation: (3, 3) the first of `candidates`; NaN if the points have no spread: then information and multiplier
            are zero.
        information: (3, 3) of w, 1/rad²: the Hessian of the cost on SO(3) over the residual variance. There is no bias,
            as depth is known.
        unobservable: (k, 3) unit directions of w with a standard deviation above `UNOBSERVABLE_ROTATION_SD`.
        iterations: iterations of the minimizer; 0 for the closed form.
        candidates: (k, 3, 3) rotations: the global optimum if certified, else all local minima found, best first
            (for instance the two mirrored ones of a flat object in one camera). Along unobservable directions they
            sample a continuum.
        costs: (k,) half the sum of squared residuals of each, in units in which H has the mean eigenvalue 1.
        certified: `rotation` is proved to be the global optimum by Sylvester's multiplier alone (`sylvester.so3`).
        multiplier: (3, 3) L of Sylvester's equation at `rotation`, in the units of `costs`.
        center: (3,) weighted mean of all points in frame i, world.
        center_translation: (3,) translation d of the center, X_j = R (X_i - center) + center + d; of minimum norm along
            unobservable directions (one camera: its axis). NaN without a rotation, except for 3D-3D.
        center_translation_information: (3, 3) of d given the rotation; zero along unobservable directions.
    """

    candidates: FloatArray
    costs: FloatArray
    certified: bool
    multiplier: FloatArray
    center: FloatArray
    center_translation: FloatArray
    center_translation_information: FloatArray

    @property
    def translation(self) -> FloatArray:
        """(3,) t of X_j = R X_i + t."""
        return self.center + self.center_translation - self.rotation @ self.center


def solve_2d3d(
    rotations: ArrayLike,
    points: Sequence[ArrayLike],
    images: Sequence[ArrayLike],
    *,
    centers: ArrayLike | None = None,
    weights: Sequence[ArrayLike] | None = None,
) -> KnownDepthSolution:
    """Estimate the motion of points known in 3D in frame i from their orthographic images in frame j in all cameras.

    The rotation follows from each camera's points and images about their means, the translation from the means. Images
    are in the points' unit of length; for weak perspective pass the normalized points of a camera that looks at the
    object, multiplied by the object's depth.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        points: per camera (n, 3) in frame i, world; n may be 0.
        images: per camera (n, 2), y = P Q (X_j - o).
        centers: (C, 3) o, the world point at the origin of each image; None for the world's origin.
        weights: per camera (n,) non-negative, at most 1e100, zero if below 1e-100; None for ones. A point of weight w
            counts as w points: small weights give little information.

    Returns:
        The motion with its information and certificate.

    Raises:
        ValueError: shapes do not match, values are not finite, matrices are not rotations, or there are no points.
    """
    points = check_sequence(points, "points")
    Q = check_rotations(rotations, len(points))
    images = check_sequence(images, "images", len(Q))
    o = np.zeros((len(Q), 3)) if centers is None else check_finite(centers, (len(Q), 3), "centers")
    w = [None] * len(Q) if weights is None else check_sequence(weights, "weights", len(Q))
    names = [(f"points[{c}]", f"images[{c}]", f"weights[{c}]") for c in range(len(Q))]
    sets = [_compute_moments(points[c], images[c], w[c], names[c], 2) for c in range(len(Q))]
    weight = sum(s.weight for s in sets)
    if not weight > 0:
        raise ValueError("no camera has points")
    center = sum((s.weight * s.mean_x for s in sets), start=np.zeros(3)) / weight
    PQ = Q[:, :2]
    set_weights, _, _, s_xx, s_yx, half_yy, _ = (np.array(values) for values in zip(*sets, strict=True))
    q = QuadraticCost.from_terms(transpose(PQ) @ PQ, s_xx, transpose(PQ) @ s_yx, half_yy, set_weights)
    scale = float(q.scale)
    if not scale > COINCIDENT_SPREAD**2 * sum(s.total for s in sets):
        return _no_spread_solution(center, np.full(3, np.nan))
    candidates, _, iterations = minimize(q.H, q.h)
    R = np.asarray(candidates[0])
    best = q.evaluate(R)
    converged, H, L = bool(best.stationary), q.H / scale, best.multiplier / scale
    views = PQ[set_weights > 0]
    certified = converged and (
        _is_positive(H + np.kron(L, np.eye(3)))
        or _is_certified_by_rows(np.einsum("cki,ckj->ij", views, views), H, L)
        or _is_certified_by_columns(s_xx.sum(axis=0), H, R.T @ L @ R)
    )
    if certified:
        candidates = candidates[:1]
    costs = q.cost(candidates) / scale
    unobservable = find_unobservable_directions(best.information, UNOBSERVABLE_ROTATION_SD, min_ratio=ZERO_CURVATURE)
    status = rotation_status(converged, certified, unobservable)
    d, d_information = _solve_translation(PQ, o, sets, R, center, float(q.variance(best.cost)))
    minima, motion = (candidates, costs, certified, L), (center, d, d_information)
    return KnownDepthSolution(status, R, best.information, unobservable, iterations, *minima, *motion)


def solve_3d3d(x: ArrayLike, y: ArrayLike, weights: ArrayLike | None = None) -> KnownDepthSolution:
    """Estimate the motion of points known in 3D in both frames, by polar decomposition (never a reflection).

    K R = C, K² = C C' leaves K's signs free: K = U diag(σ1, σ2, ±σ3) U' with the singular values and left vectors of C,
    and the largest K for which det R = 1 is the global optimum, also for flat and mirrored sets. The rotation about the
    line of collinear points is not observable; the smallest of the equivalent rotations is returned.

    Args:
        x, y: (n, 3) points in frames i and j, world.
        weights: (n,) as in `solve_2d3d`.

    Returns:
        The motion with its information.

    Raises:
        ValueError: shapes do not match, values are not finite, weights are negative, or there are no points.
    """
    s = _compute_moments(x, y, weights, ("x", "y", "weights"), 3)
    if not s.weight > 0:
        raise ValueError("there are no points")
    d, scale = s.mean_y - s.mean_x, float(np.trace(s.s_xx)) / 3
    if not scale > COINCIDENT_SPREAD**2 * s.total:
        return _no_spread_solution(s.mean_x, d)
    S, C = s.s_xx / scale, s.s_yx / scale
    U, sigma, W = np.linalg.svd(C)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ W))])
    R, K = (U * signs) @ W, (U * signs * sigma) @ U.T
    hessian = np.trace(K) * np.eye(3) - K
    values, vectors = np.linalg.eigh(hessian)
    if values[0] <= ROUNDING * values[1]:
        R = _smallest_rotation(R, vectors[:, 0])
    squares = (s.half_yy / scale) + 0.5 * float(np.trace(S))
    cost = max(squares - float(np.trace(K)), 0.0)
    variance = max(cost, MIN_RELATIVE_VARIANCE * squares) * scale / s.weight * 2 / 3
    information = hessian * scale / variance
    unobservable = find_unobservable_directions(information, UNOBSERVABLE_ROTATION_SD, min_ratio=ZERO_CURVATURE)
    status, motion = rotation_status(True, True, unobservable), (s.mean_x, d, s.weight / variance * np.eye(3))
    minimum = R[None], np.array([cost]), True, K - R @ S @ R.T
    return KnownDepthSolution(status, R, information, unobservable, 0, *minimum, *motion)


class _Moments(NamedTuple):
    """Weighted moments of points x (n, 3) and y (n, k).

    Weight Σ w; means; Σ w xx', Σ w yx' and half Σ w |y|² about the means; Σ w |x|² about the origin, the scale for
    detecting rounding errors.
    """

    weight: float
    mean_x: FloatArray
    mean_y: FloatArray
    s_xx: FloatArray
    s_yx: FloatArray
    half_yy: float
    total: float


def _compute_moments(
    x: ArrayLike, y: ArrayLike, weights: ArrayLike | None, names: tuple[str, str, str], dimensions: int
) -> _Moments:
    points, images = check_finite(x, ("n", 3), names[0]), check_finite(y, ("n", dimensions), names[1])
    n = len(points)
    if len(images) != n:
        raise ValueError(f"{names[0]} has {n} points and {names[1]} has {len(images)}")
    w = np.ones(n) if weights is None else check_finite(weights, (n,), names[2], maximum=MAX_WEIGHT)
    if (w < 0).any():
        raise ValueError(f"{names[2]} must be {n} finite, non-negative numbers")
    w = np.where(w < 1 / MAX_WEIGHT, 0.0, w)
    weight = float(w.sum())
    share = w / weight if weight > 0 else w
    mean_x, mean_y = share @ points, share @ images
    # A second pass on the residuals: far from the origin the mean has larger rounding errors than the points.
    mean_x, mean_y = mean_x + share @ (points - mean_x), mean_y + share @ (images - mean_y)
    total = float(w @ (points**2).sum(axis=1))
    dx, dy = points - mean_x, images - mean_y
    return _Moments(weight, mean_x, mean_y, (dx.T * w) @ dx, (dy.T * w) @ dx, float(w @ (dy**2).sum(axis=1)) / 2, total)


def _is_positive(K: FloatArray) -> bool:
    """Return whether K certifies the optimum.

    The certificate by all multipliers (`so3_sos_certificate`) is stronger, but would also certify the better one of two
    mirrored rotations that differ by less than noise; for known points these are reported as not certified.
    """
    return bool(np.linalg.eigvalsh(K)[0] > CERTIFICATE)


def _is_certified_by_rows(views: FloatArray, H: FloatArray, L: FloatArray) -> bool:
    """Return whether K certifies the optimum of cameras with parallel axes (in particular one camera).

    Their cost does not depend on the row of R along their axis, so K = H + L ⊗ I is never positive definite. But that
    row follows from the other two: K positive definite on those two certifies the optimum. `views` is Σ Q'P'PQ.
    """
    values, axes = np.linalg.eigh(views)
    across = np.kron(axes[:, 1:].T, np.eye(3))
    return bool(values[0] <= ROUNDING * values[2]) and _is_positive(across @ (H + np.kron(L, np.eye(3))) @ across.T)


def _is_certified_by_columns(s_xx: FloatArray, H: FloatArray, M: FloatArray) -> bool:
    """Return whether K certifies the optimum of points on parallel planes.

    Their cost does not depend on R along the planes' normal. With M = R'L R, K r = h is also (H + I ⊗ M) r = h; and two
    columns of R determine the third.
    """
    values, axes = np.linalg.eigh(s_xx)
    across = np.kron(np.eye(3), axes[:, 1:].T)
    return bool(values[0] <= ROUNDING * values[2]) and _is_positive(across @ (H + np.kron(np.eye(3), M)) @ across.T)


def _solve_translation(
    PQ: FloatArray, o: FloatArray, sets: Sequence[_Moments], R: FloatArray, center: FloatArray, variance: float
) -> tuple[FloatArray, FloatArray]:
    """Return d from the means, ȳ = P Q (R (x̄ - center) + center + d - o), and its information.

    The information uses the larger of two variances: of the points' residuals about R and, if redundant, of the means.
    """
    root = np.sqrt([s.weight for s in sets])
    rows = (root[:, None, None] * PQ).reshape(-1, 3)
    parts = zip(root, PQ, o, sets, strict=True)
    target = [r * (s.mean_y - p @ (R @ (s.mean_x - center) + center - c)) for r, p, c, s in parts]
    d, _, rank, _ = np.linalg.lstsq(rows, np.concatenate(target), rcond=1e-9)
    freedom = 2 * int((root > 0).sum()) - int(rank)
    if freedom > 0:
        residuals = np.concatenate(target) - rows @ d
        variance = max(variance, float(residuals @ residuals) / freedom)
    return d, rows.T @ rows / variance


def _smallest_rotation(R: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the exp(θ [axis]x) R of the smallest angle: of the largest trace, along + across cos θ + other sin θ."""
    along = float(axis @ R @ axis)
    other = float(axis @ [R[1, 2] - R[2, 1], R[2, 0] - R[0, 2], R[0, 1] - R[1, 0]])
    return np.asarray(Rotation.from_rotvec(np.arctan2(other, np.trace(R) - along) * axis).as_matrix() @ R)


def _no_spread_solution(center: FloatArray, center_translation: FloatArray) -> KnownDepthSolution:
    """Return the solution for coincident points, whose rotation is not observable."""
    status, nan, zero = Status.ROTATION_NOT_OBSERVABLE, np.full((3, 3), np.nan), np.zeros((3, 3))
    minimum, motion = (nan[None], np.zeros(1), False, zero.copy()), (center, center_translation, zero.copy())
    return KnownDepthSolution(status, nan, zero, np.eye(3), 0, *minimum, *motion)
