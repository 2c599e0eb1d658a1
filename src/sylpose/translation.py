"""The displacement of the object, given its rotation, from the same pair moments.

The paper's estimators give a rotation; orthographic second moments hold no more. What is left follows from the means, in
weak perspective, or, where the rotation is good enough, from the epipolar geometry of all matches.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sylpose.moments import PairMoments
from sylpose.orthographic import checked_rotations, quadratic_of, views_of

__all__ = ["translation_from_means", "translation_from_moments"]

FloatArray = NDArray[np.float64]

# Step of the numerical derivative by the rotation, radians.
STEP = 1e-6


def translation_from_means(
    rotations: ArrayLike, centers: ArrayLike, moments: Sequence[PairMoments], rotation: ArrayLike, center: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """The displacement d of the object's centre from the means of the cameras' matches, given the rotation.

    Weak perspective: all that a camera sees of the object is at the depth Z of the centre g, so its mean point in frame
    i is s = o + Z Q'(x̄, 1). It turns with the object about g and moves by d, to s_j = g + R (s - g) + d, and is seen at
    ȳ: with (u, v) = Q (s_j - o), u the first two coordinates, u - ȳ v = 0. That is linear in d; the residuals (u - ȳ v) / Z
    are image distances, weighted by the matches' count. The visible surface is in truth nearer than g by some
    ρ: an error of up to ρ times the angle of the turn, per camera, which cameras on opposite sides cancel.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        centers: (C, 3) the cameras' centres o in the world.
        moments: C pair moments of normalised points.
        rotation: (3, 3) R of the object's motion, world frame.
        center: (3,) the object's centre g in frame i, world.

    Returns:
        d: (3,) of least length where a direction is not observable (one camera: along its ray).
        information: (3, 3) of d, over the larger of two variances: the matches' residual variance about R and, from two
            cameras on, that which the means' residuals imply. Zero along what is not observable.

    Raises:
        ValueError: shapes that do not fit, no rotations, no matches, a centre that is not in front of a camera.
    """
    Q, o, R, g, seen = _checked(rotations, centers, moments, rotation, center)
    depth = np.einsum("ci,ci->c", Q[:, 2], g - o)
    if (depth[seen] <= 0).any():
        raise ValueError(f"the object's centre is not in front of camera {int(np.argmax(seen & (depth <= 0)))}")
    variance = quadratic_of(views_of(Q, moments)).variance(R)

    Q, o, depth = Q[seen], o[seen], depth[seen]
    used = [m for m, s in zip(moments, seen, strict=True) if s]
    x = np.array([[*m.mean_x, 1.0] for m in used])
    y = np.array([[*m.mean_y, 1.0] for m in used])
    offset = o + depth[:, None] * np.einsum("cji,cj->ci", Q, x) - g
    # Per camera the two rows [I, -ȳ] Q / Z, times the square root of the weight.
    weight = np.sqrt([m.count for m in used]) / depth
    rows = weight[:, None, None] * (Q[:, :2] - y[:, :2, None] * Q[:, 2:])
    target = np.einsum("cki,ci->ck", rows, o - g - offset @ R.T).ravel()
    jacobian = rows.reshape(-1, 3)
    d = np.linalg.lstsq(jacobian, target, rcond=1e-9)[0]
    if len(used) > 1:
        residuals = target - jacobian @ d
        variance = max(variance, float(residuals @ residuals) / (2 * len(used) - 3))
    return np.asarray(d), np.asarray(jacobian.T @ jacobian / variance)


def translation_from_moments(
    rotations: ArrayLike,
    centers: ArrayLike,
    moments: Sequence[PairMoments],
    rotation: ArrayLike,
    center: ArrayLike,
    start: ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """The displacement d of the object's centre from the epipolar geometry of all matches, given the rotation.

    With E_c = [t_c]x R_c, t_c = Q (t + (R - I) o), t = g + d - R g, the sum over the cameras of vec(E)' M vec(E) / g_c,
    g_c Sampson's denominator at the mean rays, is minimised over d alone (docs/method.md, "Two frames"). Nothing is
    believed of the surface's depth, so it is as good as the rotation, and its length comes from the turn: a small
    turn leaves it open.

    Args:
        rotations, centers, moments, rotation, center: as in `translation_from_means`.
        start: (3,) a first guess of d.

    Returns:
        d: (3,).
        information: (6, 6) of (w, d), without what is known of w itself: to it, the information of the rotation is added.

    Raises:
        ValueError: as `translation_from_means`; a start that is not (3,) and finite.
    """
    Q, o, R, g, seen = _checked(rotations, centers, moments, rotation, center)
    first = np.asarray(start, dtype=float)
    if first.shape != (3,) or not np.isfinite(first).all():
        raise ValueError(f"start must be (3,) and finite, got shape {first.shape}")
    Q, o = Q[seen], o[seen]
    used = [m for m, s in zip(moments, seen, strict=True) if s]
    x = np.array([[*m.mean_x, 1.0] for m in used])
    y = np.array([[*m.mean_y, 1.0] for m in used])
    values, vectors = np.linalg.eigh(np.array([m.matrix for m in used]))
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]  # M = root root'

    def residuals(d: FloatArray, turned: FloatArray) -> FloatArray:
        t = g + d - turned @ g + o @ turned.T - o
        E = np.cross(np.eye(3), np.einsum("cij,cj->ci", Q, t)[:, None, :]) @ (Q @ turned @ np.swapaxes(Q, 1, 2))
        lines = np.einsum("cij,cj->ci", E, x)[:, :2], np.einsum("cji,cj->ci", E, y)[:, :2]
        sampson = sum((line**2).sum(axis=1) for line in lines)
        return np.asarray(np.einsum("cki,ck->ci", roots, E.reshape(-1, 9)) / np.sqrt(sampson)[:, None]).ravel()

    # Any length will do for the steps: that of the cameras' distances makes them of the size of angles.
    scale = float(np.median(np.linalg.norm(o - g, axis=1)))
    found = least_squares(residuals, first, x_scale=scale, method="lm", args=(R,), max_nfev=200)
    by_turn = [
        (residuals(found.x, Rotation.from_rotvec(w).as_matrix() @ R) - found.fun) / STEP for w in STEP * np.eye(3)
    ]
    jacobian = np.column_stack([*by_turn, found.jac])
    freedom = max(sum(m.count for m in used) - 6, 1.0)
    variance = max(2 * float(found.cost) / freedom, 1e-24)
    return np.asarray(found.x), np.asarray(jacobian.T @ jacobian / variance)


def _checked(
    rotations: ArrayLike, centers: ArrayLike, moments: Sequence[PairMoments], rotation: ArrayLike, center: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Q, o, R, g and which cameras have matches."""
    Q = checked_rotations(rotations, len(moments))
    R = checked_rotations(np.asarray(rotation, dtype=float)[None], 1)[0]
    o, g = np.asarray(centers, dtype=float), np.asarray(center, dtype=float)
    if o.shape != (len(Q), 3) or g.shape != (3,) or not (np.isfinite(o).all() and np.isfinite(g).all()):
        raise ValueError(f"centers must be ({len(Q)}, 3) and center (3,), finite; got {o.shape} and {g.shape}")
    seen = np.array([m.count > 0 for m in moments])
    if not seen.any():
        raise ValueError("no camera has matches")
    return Q, o, R, g, seen
