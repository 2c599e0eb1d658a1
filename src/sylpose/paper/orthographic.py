"""What orthographic views say of a rotation: the second moments of all cameras, and the quadratic cost that they make.

Each camera sees y = N x + m z + noise on centred points, N the upper-left 2x2 block of the rotation as that camera sees
it, m the first two entries of its third column, z the depth. All estimators of the paper start here, from pair moments.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation", Computer Vision
and Image Understanding 114 (2010); the derivation is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sylpose.moments import PairMoments
from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.matrices import checked_rotations, transpose, turn_to

__all__ = ["Quadratic", "Quadratics", "Views", "quadratic_of", "quadratics_of", "views_of"]

_Parts = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


class Views(NamedTuple):
    """The second moments of C cameras, each centred and seen by a camera that is turned onto its mean ray.

    Attributes:
        rotation_x, rotation_y: (C, 3, 3) Q of the turned camera in frames i and j: rows are its axes in the world.
        s_xx, s_yx, s_yy: (C, 2, 2) Σ w xx', Σ w yx', Σ w yy' about the means. Zero for a camera without matches.
        weights: (C,) Σ w, the number of matches when all weights are 1.
        total: Σ w (|x|² + |y|²) about the origin, over all cameras, to judge what is no more than rounding.
    """

    rotation_x: FloatArray
    rotation_y: FloatArray
    s_xx: FloatArray
    s_yx: FloatArray
    s_yy: FloatArray
    weights: FloatArray
    total: float

    def subset(self, cameras: ArrayLike) -> Views:
        """The cameras that a mask or an index array picks."""
        i = np.asarray(cameras)
        return Views(
            self.rotation_x[i],
            self.rotation_y[i],
            self.s_xx[i],
            self.s_yx[i],
            self.s_yy[i],
            self.weights[i],
            self.total,
        )


class Quadratic(NamedTuple):
    """Half the sum of squared residuals over `scale`: 1/2 r'Hr - h'r + constant, r = vec(R), trace H = 9; weight = Σ w."""

    H: FloatArray
    h: FloatArray
    constant: float
    scale: float
    weight: float

    def cost(self, rotation: FloatArray) -> float:
        """At a rotation (3, 3), in units in which H has the mean eigenvalue 1."""
        r = rotation.ravel()
        return float(r @ (0.5 * self.H @ r - self.h)) + self.constant

    def variance(self, rotation: FloatArray) -> float:
        """Mean square residual per coordinate, normalised units; at least 1e-12 of the points' own."""
        return max(self.cost(rotation), 1e-12 * max(self.constant, 1.0)) * self.scale / self.weight


class Quadratics(NamedTuple):
    """N of them: H (N, 9, 9), h (N, 9), and constant, scale, weight (N,)."""

    H: FloatArray
    h: FloatArray
    constant: FloatArray
    scale: FloatArray
    weight: FloatArray


def views_of(rotations: ArrayLike, moments: Sequence[PairMoments], *, aim: bool = True) -> Views:
    """The views of C cameras.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: turn each camera, in each frame, onto the mean ray of its matches: perspective images are orthographic to
            first order only about that ray. False for points that are orthographic, whose mean is no direction.

    Raises:
        ValueError: shapes that do not fit, matrices that are no rotations.
    """
    Q = checked_rotations(rotations, len(moments))
    M = np.array([m.matrix for m in moments])
    return Views(*_second_moments(Q, M, aim), float(_squares(M)))


def quadratic_of(views: Views, *, symmetric: bool = False) -> Quadratic:
    """The least squares over all cameras, depth ignored: H = Σ A_c ⊗ B_c, h = vec(Σ C_c) over `scale`, where

        A_c = Q'P'PQ,   B_c = Q'P' S_xx P Q,   C_c = Q'P' S_yx P Q,   P = [1 0 0; 0 1 0].

    Args:
        symmetric: the mean of this and of the least squares of x = N'y + noise, so that exchanging the frames gives the
            inverse rotation: two Sylvester terms per camera, A_c ⊗ B_c / 2 and Q'P' S_yy P Q ⊗ A_c / 2, and the same C_c.
            See `solve_centralized`.

    Raises:
        ValueError: no camera has matches with any spread.
    """
    H, h, constant = _normal_equations(*views[:5], symmetric)
    H, h, constant, scale = _scaled(H[None], h[None], constant[None], np.array([views.total]))
    return Quadratic(H[0], h[0], float(constant[0]), float(scale[0]), float(views.weights.sum()))


def quadratics_of(rotations: ArrayLike, moments: ArrayLike, *, aim: bool = True, symmetric: bool = False) -> Quadratics:
    """`quadratic_of` the `views_of` N problems of C cameras each; each problem's numbers depend on that problem alone.

    Args:
        rotations: (N, C, 3, 3), or (C, 3, 3) where all problems have the same cameras.
        moments: (N, C, 9, 9) matrices of pair moments.

    Raises:
        ValueError: shapes that do not fit, matrices that are no rotations, moments that are not finite or not symmetric,
            a problem in which no camera has matches with any spread.
    """
    M, Q = np.asarray(moments, dtype=float), np.asarray(rotations, dtype=float)
    if M.ndim != 4 or M.shape[2:] != (9, 9) or not np.isfinite(M).all():
        raise ValueError(f"moments must be finite (N, C, 9, 9), got shape {M.shape}")
    if np.abs(M - transpose(M)).max(initial=0.0) > 1e-12 + 2e-9 * np.abs(M).max(initial=0.0):  # as PairMoments at most
        raise ValueError("moments must be symmetric")
    n, c = M.shape[:2]
    if Q.ndim == 4 and Q.shape[:2] == (n, c):
        Q = checked_rotations(Q.reshape(-1, *Q.shape[2:]), n * c).reshape(n, c, 3, 3)
    else:
        Q = checked_rotations(Q, c)
    parts = _second_moments(Q, M, aim)
    H, h, constant = _normal_equations(*parts[:5], symmetric)
    H, h, constant, scale = _scaled(H, h, constant, _squares(M))
    return Quadratics(H, h, constant, scale, parts[5].sum(axis=1))


# The moments are centred and summed here, all cameras at once, for the sake of thousands of them. Axes before the
# cameras' are problems.


def _second_moments(Q: FloatArray, M: FloatArray, aim: bool) -> _Parts:
    """Rotations (..., C, 3, 3) and matrices (..., C, 9, 9) of pair moments -> the arrays of `Views`."""
    count = M[..., 8, 8]
    per_count = 1 / np.where(count > 0, count, 1)[..., None]
    Ex, Ey = M[..., 8, 6:8] * per_count, M[..., 8, 2:6:3] * per_count
    n = count[..., None, None]
    Sxx = M[..., 6:8, 6:8] - n * Ex[..., :, None] * Ex[..., None, :]
    Syx = M[..., 2:6:3, 6:8] - n * Ey[..., :, None] * Ex[..., None, :]
    Syy = M[..., 2:6:3, 2:6:3] - n * Ey[..., :, None] * Ey[..., None, :]
    if not aim:
        Q = np.array(np.broadcast_to(Q, (*count.shape, 3, 3)))
        return Q, Q, Sxx, Syx, Syy, count
    # Turned by T onto a mean ray, δ away from it in the image, a point is P T Q X / Z at exactly (P T P') δ.
    Tx, Ty = turn_to(Ex), turn_to(Ey)
    Jx, Jy = Tx[..., :2, :2], Ty[..., :2, :2]
    return Tx @ Q, Ty @ Q, Jx @ Sxx @ transpose(Jx), Jy @ Syx @ transpose(Jx), Jy @ Syy @ transpose(Jy), count


def _normal_equations(
    Qx: FloatArray, Qy: FloatArray, Sxx: FloatArray, Syx: FloatArray, Syy: FloatArray, symmetric: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Summed over the cameras: H (..., 9, 9), h (..., 9), half the sum of squares of what is to be explained (...)."""
    PQx, PQy = Qx[..., :2, :], Qy[..., :2, :]
    A, B = transpose(PQy) @ PQy, transpose(PQx) @ Sxx @ PQx
    h = (transpose(PQy) @ Syx @ PQx).sum(axis=-3)
    constant = _trace_sum(Syy) / 2
    if symmetric:
        A = np.concatenate([A / 2, transpose(PQy) @ Syy @ PQy / 2], axis=-3)
        B = np.concatenate([B, transpose(PQx) @ PQx], axis=-3)
        constant = (constant + _trace_sum(Sxx) / 2) / 2
    shape = h.shape[:-2]
    # Σ A_c ⊗ B_c as one matrix product.
    H = transpose(A.reshape(*A.shape[:-2], 9)) @ B.reshape(*B.shape[:-2], 9)
    H = np.swapaxes(H.reshape(*shape, 3, 3, 3, 3), -2, -3).reshape(*shape, 9, 9)
    return H, h.reshape(*shape, 9), constant


def _scaled(
    H: FloatArray, h: FloatArray, constant: FloatArray, total: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """N problems' H, h and constant over their scale; and the scale (N,)."""
    scale = np.trace(H, axis1=1, axis2=2) / 9
    # What centring leaves by rounding is no spread.
    flat = ~(scale > 1e-14 * total)
    if flat.any():
        which = f"problem {int(np.argmax(flat))}: " if len(H) > 1 else ""
        raise ValueError(f"{which}no camera has matches that are spread over its image: there is nothing to turn")
    return (H + transpose(H)) / (2 * scale[:, None, None]), h / scale[:, None], constant / scale, scale


def _squares(M: FloatArray) -> FloatArray:
    """(..., C, 9, 9) matrices of pair moments -> (...) `Views.total`."""
    return np.asarray(M[..., [2, 5, 6, 7], [2, 5, 6, 7]].sum(axis=(-2, -1)))


def _trace_sum(S: FloatArray) -> FloatArray:
    return np.asarray(np.trace(S, axis1=-2, axis2=-1).sum(axis=-1))
