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

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import checked_rotations, transpose, turn_to
from sylpose.geometry.validation import finite, listed, real, truth
from sylpose.moments import LEAST_COUNT, MOST_MOMENT, PairMoments
from sylpose.sylvester.so3 import Quadratic

__all__ = ["Terms", "Views", "matrices_of", "quadratic_of", "quadratics_of", "terms_of", "views_of"]

_Parts = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]

# Spread up to this share of the squares about the origin is left by centring: some tens of roundings (derived).
ROUNDING = 1e-14


class Views(NamedTuple):
    """The second moments of C cameras, each centred and seen by a camera that is turned onto its mean ray.

    Attributes:
        rotation_x, rotation_y: (C, 3, 3) Q of the turned camera in frames i and j: rows are its axes in the world.
        s_xx, s_yx, s_yy: (C, 2, 2) Σ w xx', Σ w yx', Σ w yy' about the means. Zero for a camera without matches.
        weights: (C,) Σ w, the number of matches when all weights are 1.
        total: Σ w (|x|² + |y|²) about the origin, over all cameras, to judge what is no more than rounding.

    Of N problems (`quadratics_of`) all have an axis of N before these.
    """

    rotation_x: FloatArray
    rotation_y: FloatArray
    s_xx: FloatArray
    s_yx: FloatArray
    s_yy: FloatArray
    weights: FloatArray
    total: FloatArray

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


class Terms(NamedTuple):
    """What C cameras' views are in Sylvester's equation, and in the cost that it is of (`Quadratic.of_terms`).

    Attributes:
        A, B, C: (..., C, 3, 3).
        constant: (..., C) half the sum of squares in frame j. weight: (..., C) Σ w.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    constant: FloatArray
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
    aim, M = truth(aim, "aim"), matrices_of(moments)
    Q = checked_rotations(rotations, len(M))
    return Views(*_second_moments(Q, M, aim), _squares(M))


def matrices_of(moments: Sequence[PairMoments]) -> FloatArray:
    """(C, 9, 9) of C pair moments; zero for a camera that sees less than a match that means anything.

    Raises:
        TypeError: something else than pair moments.
    """
    M = np.array([m.matrix for m in listed(moments, PairMoments, "moments")]).reshape(-1, 9, 9)
    M[M[:, 8, 8] < LEAST_COUNT] = 0.0
    return M


def quadratic_of(views: Views) -> Quadratic:
    """The least squares over all cameras, depth ignored: of `terms_of` these views.

    Raises:
        ValueError: no camera has matches with any spread.
    """
    q = Quadratic.of_terms(*terms_of(views))
    _check_spread(q.scale[None], views.total[None])
    return q


def terms_of(views: Views) -> Terms:
    """Each camera's terms of Sylvester's equation Σ A_c R B_c + L R = Σ C_c:

    A_c = Q'P'PQ,   B_c = Q'P' S_xx P Q,   C_c = Q'P' S_yx P Q,   P = [1 0 0; 0 1 0].
    """
    return _terms(*views[:6])


def quadratics_of(rotations: ArrayLike, moments: ArrayLike, *, aim: bool = True) -> tuple[Quadratic, Views]:
    """`quadratic_of` the `views_of` N problems of C cameras each, and these; each problem's numbers depend on it alone.

    Args:
        rotations: (N, C, 3, 3), or (C, 3, 3) where all problems have the same cameras.
        moments: (N, C, 9, 9) matrices of pair moments.

    Raises:
        ValueError: shapes that do not fit, matrices that are no rotations, moments that are not finite or not symmetric,
            a problem in which no camera has matches with any spread.
    """
    aim = truth(aim, "aim")
    M, Q = finite(moments, ("N", "C", 9, 9), "moments", most=MOST_MOMENT), real(rotations, "(C, 3, 3)", "rotations")
    if np.abs(M - transpose(M)).max(initial=0.0) > 1e-12 + 2e-9 * np.abs(M).max(initial=0.0):  # as PairMoments at most
        raise ValueError("moments must be symmetric")
    if (M.diagonal(axis1=-2, axis2=-1) < 0).any():
        raise ValueError("moments must be sums of squares, but have negative ones")
    few = M[..., 8, 8] < LEAST_COUNT
    if M[few].any():
        M = np.where(few[..., None, None], 0.0, M)
    n, c = M.shape[:2]
    if Q.ndim == 4 and Q.shape[:2] == (n, c):
        Q = checked_rotations(Q.reshape(-1, *Q.shape[2:]), n * c).reshape(n, c, 3, 3)
    else:
        Q = checked_rotations(Q, c)
    views = Views(*_second_moments(Q, M, aim), _squares(M))
    q = Quadratic.of_terms(*_terms(*views[:6]))
    _check_spread(q.scale, views.total)
    return q, views


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
    Tx, Ty = turn_to(np.stack([Ex, Ey]))
    Jx, Jy = Tx[..., :2, :2], Ty[..., :2, :2]
    return Tx @ Q, Ty @ Q, Jx @ Sxx @ transpose(Jx), Jy @ Syx @ transpose(Jx), Jy @ Syy @ transpose(Jy), count


def _terms(
    Qx: FloatArray, Qy: FloatArray, Sxx: FloatArray, Syx: FloatArray, Syy: FloatArray, weights: FloatArray
) -> Terms:
    PQx, PQy = Qx[..., :2, :], Qy[..., :2, :]
    A, B = transpose(PQy) @ PQy, transpose(PQx) @ Sxx @ PQx
    return Terms(A, B, transpose(PQy) @ Syx @ PQx, np.trace(Syy, axis1=-2, axis2=-1) / 2, weights)


def _check_spread(scale: FloatArray, total: FloatArray) -> None:
    """Of N problems: what centring leaves by rounding is no spread."""
    flat = ~(scale > ROUNDING * total)
    if flat.any():
        which = f"problem {int(np.argmax(flat))}: " if len(scale) > 1 else ""
        raise ValueError(f"{which}no camera has matches that are spread over its image: there is nothing to turn")


def _squares(M: FloatArray) -> FloatArray:
    """(..., C, 9, 9) matrices of pair moments -> (...) `Views.total`."""
    return np.asarray(M[..., [2, 5, 6, 7], [2, 5, 6, 7]].sum(axis=(-2, -1)))
