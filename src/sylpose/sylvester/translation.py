"""Translation of the object, given its rotation, from the same pair moments.

The paper's estimators return a rotation only, as orthographic second moments contain no more. The translation follows
from the means, in weak perspective, or, if the rotation is accurate enough, from the epipolar geometry of all matches.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import essential_matrix, sampson_scale
from sylpose.geometry.validation import check_finite, check_list, check_number, check_rotation, check_rotations
from sylpose.moments import MIN_COUNT, PairMoments
from sylpose.sylvester.orthographic import build_cost, compute_views

# Step of the numerical derivative by the rotation, radians: near the root of rounding (derived).
DERIVATIVE_STEP = 1e-6
# Iterations for the noise variance, against which the prior is weighted (choice).
VARIANCE_ITERATIONS = 3


def solve_translation_from_means(
    rotations: ArrayLike,
    centers: ArrayLike,
    moments: Sequence[PairMoments],
    rotation: ArrayLike,
    center: ArrayLike,
    *,
    rotation_variance: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Estimate the translation d of the object's center from the mean matches of the cameras, given the rotation.

    Weak perspective: all points that a camera observes have the depth Z of the center g, so its mean point in frame i
    is s = o + Z Q'(x̄, 1). It moves with the object to s_j = g + R (s - g) + d and is observed at ȳ: with (u, v) = Q
    (s_j - o), u the first two coordinates, u - ȳ v = 0. This is linear in d; the residuals (u - ȳ v) / Z are image
    distances. The visible surface is nearer than g by some ρ, which causes an error of up to ρ times the rotation angle
    per camera; it cancels for cameras on opposite sides. It is modeled as noise, with ρ of the size of the observed
    points' spread.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        centers: (C, 3) the cameras' centers o in the world.
        moments: C pair moments of normalized points.
        rotation: (3, 3) R of the object's motion, world frame.
        center: (3,) the object's center g in frame i, world.
        rotation_variance: variance of the rotation, rad²; added to the squared rotation angle in the error by the
            surface.

    Returns:
        d: (3,), of minimum norm if a direction is not observable (one camera: along its ray).
        information: (3, 3) of d, from the residual variance of the matches about R and the error by the surface;
            reduced, for two cameras or more, if the residuals of the means are larger. Zero along unobservable
            directions.

    Raises:
        ValueError: shapes do not match, matrices are not rotations, there are no matches, or the center is not in front
            of a camera.
    """
    Q, o, used, R, g = _check_input(rotations, centers, moments, rotation, center)
    variance = _residual_variance(Q, used, R)
    rotation_variance = check_number(rotation_variance, "rotation_variance", minimum=0.0)
    depth = np.einsum("ci,ci->c", Q[:, 2], g - o)
    x, y = _mean_rays(used)
    offset = o + depth[:, None] * np.einsum("cji,cj->ci", Q, x) - g
    # Per camera the two rows [I, -ȳ] Q / Z, over their standard deviation.
    spread = np.array([np.trace(m.s_xx) / m.count for m in used])
    surface_variance = spread * (Rotation.from_matrix(R).magnitude() ** 2 + rotation_variance)
    weight = 1 / (depth * np.sqrt(variance / np.array([m.count for m in used]) + surface_variance))
    rows = weight[:, None, None] * (Q[:, :2] - y[:, :2, None] * Q[:, 2:])
    target = np.einsum("cki,ci->ck", rows, o - g - offset @ R.T).ravel()
    jacobian = rows.reshape(-1, 3)
    d = np.linalg.lstsq(jacobian, target, rcond=1e-9)[0]
    excess = 1.0
    if len(used) > 1:
        residuals = target - jacobian @ d
        excess = max(excess, float(residuals @ residuals) / (2 * len(used) - 3))
    return np.asarray(d), np.asarray(jacobian.T @ jacobian / excess)


def refine_translation(
    rotations: ArrayLike,
    centers: ArrayLike,
    moments: Sequence[PairMoments],
    rotation: ArrayLike,
    center: ArrayLike,
    initial: ArrayLike,
    prior: ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """Estimate the translation d of the object's center from the epipolar geometry of all matches, given the rotation.

    With E_c = [t_c]x R_c, t_c = Q (t + (R - I) o), t = g + d - R g, the sum over the cameras of vec(E)' M vec(E) / g_c,
    g_c Sampson's denominator at the mean rays, is minimized over d alone
    (docs/method/3-pose.md, "Two frames"). The accuracy
    is limited by that of the rotation. The length of d is determined by the rotation angle: if that is small, or there
    is one camera only, the initial value decides.

    Args:
        rotations, centers, moments, rotation, center: as in `solve_translation_from_means`.
        initial, prior: (3,) initial value of d and its (3, 3) information, from `solve_translation_from_means`.

    Returns:
        d: (3,).
        information: (6, 6) of (w, d) from these residuals alone; those of the rotation and of the prior are to be
            added.

    Raises:
        ValueError: as `solve_translation_from_means`, or initial or prior have another shape or are not finite.
    """
    Q, o, used, R, g = _check_input(rotations, centers, moments, rotation, center)
    d_initial, prior_information = check_finite(initial, (3,), "initial"), check_finite(prior, (3, 3), "prior")
    x, y = _mean_rays(used)
    values, vectors = np.linalg.eigh(np.array([m.matrix for m in used]))
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]  # M = root root'

    def residuals(d: FloatArray, turned: FloatArray) -> FloatArray:
        t = g + d - turned @ g + o @ turned.T - o
        E = essential_matrix(Q @ turned @ np.swapaxes(Q, 1, 2), np.einsum("cij,cj->ci", Q, t))
        distances = np.einsum("cki,ck->ci", roots, E.reshape(-1, 9)) / sampson_scale(E, x, y)[:, None]
        return np.asarray(distances.ravel())

    # Scale of the solver's steps: with the distance of the cameras as the unit, steps are of the size of angles.
    scale = float(np.median(np.linalg.norm(o - g, axis=1)))
    freedom = max(sum(m.count for m in used) - 6, 1.0)
    variance = _residual_variance(Q, used, R)
    d = d_initial
    # The variance is only available after the fit.
    for _ in range(VARIANCE_ITERATIONS):
        values, vectors = np.linalg.eigh(prior_information * variance)
        prior_root = (vectors * np.sqrt(np.maximum(values, 0.0))).T

        def both(d: FloatArray, toward: FloatArray = prior_root) -> FloatArray:
            return np.concatenate([residuals(d, R), toward @ (d - d_initial)])

        result = least_squares(both, d, x_scale=scale, method="lm", max_nfev=200)
        d = result.x
        final_residuals = residuals(d, R)
        variance = max(float(final_residuals @ final_residuals) / freedom, 1e-24)
    rotation_columns = [
        (residuals(d, Rotation.from_rotvec(w).as_matrix() @ R) - final_residuals) / DERIVATIVE_STEP
        for w in DERIVATIVE_STEP * np.eye(3)
    ]
    jacobian = np.column_stack([*rotation_columns, result.jac[: len(final_residuals)]])
    return np.asarray(d), np.asarray(jacobian.T @ jacobian / variance)


def _check_input(
    rotations: ArrayLike, centers: ArrayLike, moments: Sequence[PairMoments], rotation: ArrayLike, center: ArrayLike
) -> tuple[FloatArray, FloatArray, list[PairMoments], FloatArray, FloatArray]:
    """Check the input; return Q, o and moments of the cameras that have matches, R and g."""
    moments = check_list(moments, PairMoments, "moments")
    Q, R = check_rotations(rotations, len(moments)), check_rotation(rotation)
    o, g = check_finite(centers, (len(Q), 3), "centers"), check_finite(center, (3,), "center")
    seen = np.array([m.count > MIN_COUNT for m in moments])
    if not seen.any():
        raise ValueError("no camera has matches")
    behind = seen & (np.einsum("ci,ci->c", Q[:, 2], g - o) <= 0)
    if behind.any():
        raise ValueError(f"the object's center is not in front of camera {int(np.argmax(behind))}")
    return Q[seen], o[seen], [m for m, s in zip(moments, seen, strict=True) if s], R, g


def _residual_variance(Q: FloatArray, moments: Sequence[PairMoments], R: FloatArray) -> float:
    """Return the mean square residual of the matches about R, per normalized coordinate."""
    q = build_cost(compute_views(Q, moments))
    return float(q.variance(q.cost(R)))


def _mean_rays(moments: Sequence[PairMoments]) -> tuple[FloatArray, FloatArray]:
    """Return x̄ and ȳ (C, 3), with a third coordinate of 1."""
    return np.array([[*m.mean_x, 1.0] for m in moments]), np.array([[*m.mean_y, 1.0] for m in moments])
