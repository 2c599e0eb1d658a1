"""The displacement of the object, given its rotation, from the same pair moments.

The paper's estimators give a rotation; orthographic second moments hold no more. What is left follows from the means, in
weak perspective, or, where the rotation is good enough, from the epipolar geometry of all matches.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.epipolar import essential, sampson
from sylpose.geometry.matrices import checked_rotation, checked_rotations
from sylpose.geometry.validation import finite, listed, number
from sylpose.moments import LEAST_COUNT, PairMoments
from sylpose.sylvester.orthographic import quadratic_of, views_of

__all__ = ["translation_from_means", "translation_from_moments"]


# Step of the numerical derivative by the rotation, radians: near the root of rounding (derived).
STEP = 1e-6
# Rounds in which the noise's variance, which the prior is weighed against, is found (choice).
VARIANCES = 3


def translation_from_means(
    rotations: ArrayLike,
    centers: ArrayLike,
    moments: Sequence[PairMoments],
    rotation: ArrayLike,
    center: ArrayLike,
    *,
    off: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """The displacement d of the object's centre from the means of the cameras' matches, given the rotation.

    Weak perspective: all that a camera sees of the object is at the depth Z of the centre g, so its mean point in frame
    i is s = o + Z Q'(x̄, 1). It turns with the object about g and moves by d, to s_j = g + R (s - g) + d, and is seen at
    ȳ: with (u, v) = Q (s_j - o), u the first two coordinates, u - ȳ v = 0. That is linear in d; the residuals (u - ȳ v) / Z
    are image distances. The visible surface is in truth nearer than g by some ρ: an error of up to ρ times the angle of the
    turn, per camera, which cameras on opposite sides cancel. With ρ of the size of what is seen, it counts as noise.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        centers: (C, 3) the cameras' centres o in the world.
        moments: C pair moments of normalised points.
        rotation: (3, 3) R of the object's motion, world frame.
        center: (3,) the object's centre g in frame i, world.
        off: variance of the rotation, rad²: a turn that is larger than it is found to be errs by more.

    Returns:
        d: (3,) of least length where a direction is not observable (one camera: along its ray).
        information: (3, 3) of d, by the matches' residual variance about R and the error by the surface; less, from two
            cameras on, where the means' residuals are larger. Zero along what is not observable.

    Raises:
        ValueError: shapes that do not fit, no rotations, no matches, a centre that is not in front of a camera.
    """
    Q, o, used, R, g = _checked(rotations, centers, moments, rotation, center)
    variance = _variance(Q, used, R)
    off = number(off, "off", least=0.0)
    depth = np.einsum("ci,ci->c", Q[:, 2], g - o)
    x, y = _mean_rays(used)
    offset = o + depth[:, None] * np.einsum("cji,cj->ci", Q, x) - g
    # Per camera the two rows [I, -ȳ] Q / Z, over their standard deviation.
    spread = np.array([np.trace(m.s_xx) / m.count for m in used])
    by_surface = spread * (Rotation.from_matrix(R).magnitude() ** 2 + off)
    weight = 1 / (depth * np.sqrt(variance / np.array([m.count for m in used]) + by_surface))
    rows = weight[:, None, None] * (Q[:, :2] - y[:, :2, None] * Q[:, 2:])
    target = np.einsum("cki,ci->ck", rows, o - g - offset @ R.T).ravel()
    jacobian = rows.reshape(-1, 3)
    d = np.linalg.lstsq(jacobian, target, rcond=1e-9)[0]
    excess = 1.0
    if len(used) > 1:
        residuals = target - jacobian @ d
        excess = max(excess, float(residuals @ residuals) / (2 * len(used) - 3))
    return np.asarray(d), np.asarray(jacobian.T @ jacobian / excess)


def translation_from_moments(
    rotations: ArrayLike,
    centers: ArrayLike,
    moments: Sequence[PairMoments],
    rotation: ArrayLike,
    center: ArrayLike,
    start: ArrayLike,
    prior: ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """The displacement d of the object's centre from the epipolar geometry of all matches, given the rotation.

    With E_c = [t_c]x R_c, t_c = Q (t + (R - I) o), t = g + d - R g, the sum over the cameras of vec(E)' M vec(E) / g_c,
    g_c Sampson's denominator at the mean rays, is minimised over d alone (docs/method.md, "Two frames"). It is as good as
    the rotation. Its length comes from the turn: where that is small, or all cameras are one, the first guess decides.

    Args:
        rotations, centers, moments, rotation, center: as in `translation_from_means`.
        start, prior: (3,) a first guess of d and its (3, 3) information: of `translation_from_means`.

    Returns:
        d: (3,).
        information: (6, 6) of (w, d) by these residuals alone: that of the rotation, and the prior, add to it.

    Raises:
        ValueError: as `translation_from_means`; a start or a prior of another shape, or not finite.
    """
    Q, o, used, R, g = _checked(rotations, centers, moments, rotation, center)
    first, known = finite(start, (3,), "start"), finite(prior, (3, 3), "prior")
    x, y = _mean_rays(used)
    values, vectors = np.linalg.eigh(np.array([m.matrix for m in used]))
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]  # M = root root'

    def residuals(d: FloatArray, turned: FloatArray) -> FloatArray:
        t = g + d - turned @ g + o @ turned.T - o
        E = essential(Q @ turned @ np.swapaxes(Q, 1, 2), np.einsum("cij,cj->ci", Q, t))
        distances = np.einsum("cki,ck->ci", roots, E.reshape(-1, 9)) / sampson(E, x, y)[:, None]
        return np.asarray(distances.ravel())

    # Any length will do for the steps: that of the cameras' distances makes them of the size of angles.
    scale = float(np.median(np.linalg.norm(o - g, axis=1)))
    freedom = max(sum(m.count for m in used) - 6, 1.0)
    variance = _variance(Q, used, R)
    d = first
    # The variance is not known before the fit.
    for _ in range(VARIANCES):
        values, vectors = np.linalg.eigh(known * variance)
        toward = (vectors * np.sqrt(np.maximum(values, 0.0))).T

        def both(d: FloatArray, toward: FloatArray = toward) -> FloatArray:
            return np.concatenate([residuals(d, R), toward @ (d - first)])

        found = least_squares(both, d, x_scale=scale, method="lm", max_nfev=200)
        d = found.x
        own = residuals(d, R)
        variance = max(float(own @ own) / freedom, 1e-24)
    by_turn = [(residuals(d, Rotation.from_rotvec(w).as_matrix() @ R) - own) / STEP for w in STEP * np.eye(3)]
    jacobian = np.column_stack([*by_turn, found.jac[: len(own)]])
    return np.asarray(d), np.asarray(jacobian.T @ jacobian / variance)


def _checked(
    rotations: ArrayLike, centers: ArrayLike, moments: Sequence[PairMoments], rotation: ArrayLike, center: ArrayLike
) -> tuple[FloatArray, FloatArray, list[PairMoments], FloatArray, FloatArray]:
    """Q, o and moments of the cameras that have matches; R, g."""
    moments = listed(moments, PairMoments, "moments")
    Q, R = checked_rotations(rotations, len(moments)), checked_rotation(rotation)
    o, g = finite(centers, (len(Q), 3), "centers"), finite(center, (3,), "center")
    seen = np.array([m.count > LEAST_COUNT for m in moments])
    if not seen.any():
        raise ValueError("no camera has matches")
    behind = seen & (np.einsum("ci,ci->c", Q[:, 2], g - o) <= 0)
    if behind.any():
        raise ValueError(f"the object's centre is not in front of camera {int(np.argmax(behind))}")
    return Q[seen], o[seen], [m for m, s in zip(moments, seen, strict=True) if s], R, g


def _variance(Q: FloatArray, moments: Sequence[PairMoments], R: FloatArray) -> float:
    """Mean square residual of the matches about R, per normalised coordinate."""
    q = quadratic_of(views_of(Q, moments))
    return float(q.variance(q.cost(R)))


def _mean_rays(moments: Sequence[PairMoments]) -> tuple[FloatArray, FloatArray]:
    """(C, 3) x̄ and ȳ with a third coordinate of 1."""
    return np.array([[*m.mean_x, 1.0] for m in moments]), np.array([[*m.mean_y, 1.0] for m in moments])
