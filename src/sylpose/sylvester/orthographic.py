"""Orthographic views: second moments of all cameras and the quadratic cost of the rotation that they define.

Each camera observes y = N x + m z + noise on centered points, N the upper-left 2x2 block of the rotation in that
camera's frame, m the first two entries of its third column, z the depth. All estimators of the paper start here, from
pair moments.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation", Computer Vision
and Image Understanding 114 (2010); the derivation is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import rotation_to_z_axis, transpose
from sylpose.geometry.validation import check_bool, check_finite, check_list, check_real, check_rotations
from sylpose.moments import MAX_MOMENT, MIN_COUNT, PairMoments
from sylpose.sylvester.so3 import QuadraticCost

# Spread up to this share of the squares about the origin is a rounding error of centering: some tens of roundings
# (derived).
ROUNDING_SHARE = 1e-14


class Views(NamedTuple):
    """Centered second moments of C cameras, each rotated onto its mean ray.

    Attributes:
        rotation_x, rotation_y: (C, 3, 3) Q of the rotated camera in frames i and j: rows are its axes in the world.
        s_xx, s_yx, s_yy: (C, 2, 2) Σ w xx', Σ w yx', Σ w yy' about the means. Zero for a camera without matches.
        weights: (C,) Σ w, the number of matches if all weights are 1.
        total: Σ w (|x|² + |y|²) about the origin, over all cameras: the scale for detecting rounding errors.

    For N problems (`build_costs`) all arrays have a leading axis of N.
    """

    rotation_x: FloatArray
    rotation_y: FloatArray
    s_xx: FloatArray
    s_yx: FloatArray
    s_yy: FloatArray
    weights: FloatArray
    total: FloatArray

    def subset(self, cameras: ArrayLike) -> Views:
        """Return the views of the cameras selected by a mask or an index array."""
        i = np.asarray(cameras)
        return Views._make([*(array[i] for array in self[:6]), self.total])


class SylvesterTerms(NamedTuple):
    """Terms of C cameras in Sylvester's equation and in its cost (`QuadraticCost.from_terms`).

    Attributes:
        A, B, C: (..., C, 3, 3).
        constant: (..., C) half the sum of squares in frame j. weight: (..., C) Σ w.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    constant: FloatArray
    weight: FloatArray


def compute_views(rotations: ArrayLike, moments: Sequence[PairMoments], *, aim: bool = True) -> Views:
    """Compute the views of C cameras.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: rotate each camera, in each frame, onto the mean ray of its matches: perspective images are orthographic to
            first order only about that ray. False for orthographic points, whose mean is not a direction.

    Raises:
        ValueError: shapes do not match, or matrices are not rotations.
    """
    aim, M = check_bool(aim, "aim"), moment_matrices(moments)
    Q = check_rotations(rotations, len(M))
    return _compute_views(Q, M, aim)


def moment_matrices(moments: Sequence[PairMoments]) -> FloatArray:
    """Return the matrices (C, 9, 9) of C pair moments; zero for a camera with a count below `MIN_COUNT`.

    Raises:
        TypeError: an item is not a `PairMoments`.
    """
    M = np.array([m.matrix for m in check_list(moments, PairMoments, "moments")]).reshape(-1, 9, 9)
    M[M[:, 8, 8] < MIN_COUNT] = 0.0
    return M


def build_cost(views: Views) -> QuadraticCost:
    """Build the least-squares cost of all cameras, depth ignored, from their `compute_terms`.

    Raises:
        ValueError: no camera has matches with any spread.
    """
    q = QuadraticCost.from_terms(*compute_terms(views))
    _check_spread(q.scale[None], views.total[None])
    return q


def compute_terms(views: Views) -> SylvesterTerms:
    """Compute each camera's terms of Sylvester's equation Σ A_c R B_c + L R = Σ C_c:

    A_c = Q'P'PQ,   B_c = Q'P' S_xx P Q,   C_c = Q'P' S_yx P Q,   P = [1 0 0; 0 1 0].
    """
    PQx, PQy = views.rotation_x[..., :2, :], views.rotation_y[..., :2, :]
    A, B = transpose(PQy) @ PQy, transpose(PQx) @ views.s_xx @ PQx
    half_yy = np.trace(views.s_yy, axis1=-2, axis2=-1) / 2
    return SylvesterTerms(A, B, transpose(PQy) @ views.s_yx @ PQx, half_yy, views.weights)


def build_costs(rotations: ArrayLike, moments: ArrayLike, *, aim: bool = True) -> tuple[QuadraticCost, Views]:
    """Build the costs and views of N problems of C cameras each; each problem's result depends on that problem alone.

    Args:
        rotations: (N, C, 3, 3), or (C, 3, 3) if all problems have the same cameras.
        moments: (N, C, 9, 9) matrices of pair moments.
        aim: as in `compute_views`.

    Raises:
        ValueError: shapes do not match, matrices are not rotations, moments are not finite or not symmetric, or no
            camera of a problem has matches with any spread.
    """
    aim = check_bool(aim, "aim")
    M = check_finite(moments, ("N", "C", 9, 9), "moments", maximum=MAX_MOMENT)
    Q = check_real(rotations, "(C, 3, 3)", "rotations")
    if np.abs(M - transpose(M)).max(initial=0.0) > 1e-12 + 2e-9 * np.abs(M).max(initial=0.0):  # as PairMoments at most
        raise ValueError("moments must be symmetric")
    if (M.diagonal(axis1=-2, axis2=-1) < 0).any():
        raise ValueError("moments must be sums of squares, but some are negative")
    is_empty = M[..., 8, 8] < MIN_COUNT
    if M[is_empty].any():
        M = np.where(is_empty[..., None, None], 0.0, M)
    n, c = M.shape[:2]
    if Q.ndim == 4 and Q.shape[:2] == (n, c):
        Q = check_rotations(Q.reshape(-1, *Q.shape[2:]), n * c).reshape(n, c, 3, 3)
    else:
        Q = check_rotations(Q, c)
    views = _compute_views(Q, M, aim)
    q = QuadraticCost.from_terms(*compute_terms(views))
    _check_spread(q.scale, views.total)
    return q, views


# The moments of all cameras are centered at once, for speed with thousands of problems. Leading axes are problems.


def _compute_views(Q: FloatArray, M: FloatArray, aim: bool) -> Views:
    """Return the views of rotations (..., C, 3, 3) and matrices (..., C, 9, 9) of pair moments."""
    count, total = M[..., 8, 8], np.asarray(M[..., [2, 5, 6, 7], [2, 5, 6, 7]].sum(axis=(-2, -1)))
    per_count = 1 / np.where(count > 0, count, 1)[..., None]
    Ex, Ey = M[..., 8, 6:8] * per_count, M[..., 8, 2:6:3] * per_count
    n = count[..., None, None]
    Sxx = M[..., 6:8, 6:8] - n * Ex[..., :, None] * Ex[..., None, :]
    Syx = M[..., 2:6:3, 6:8] - n * Ey[..., :, None] * Ex[..., None, :]
    Syy = M[..., 2:6:3, 2:6:3] - n * Ey[..., :, None] * Ey[..., None, :]
    if not aim:
        Q = np.array(np.broadcast_to(Q, (*count.shape, 3, 3)))
        return Views(Q, Q, Sxx, Syx, Syy, count, total)
    # A point at image offset δ from the mean ray is, after rotation by T onto that ray, at exactly P T Q X / Z = (P T
    # P') δ.
    Tx, Ty = rotation_to_z_axis(np.stack([Ex, Ey]))
    Jx, Jy = Tx[..., :2, :2], Ty[..., :2, :2]
    Sxx, Syx, Syy = Jx @ Sxx @ transpose(Jx), Jy @ Syx @ transpose(Jx), Jy @ Syy @ transpose(Jy)
    return Views(Tx @ Q, Ty @ Q, Sxx, Syx, Syy, count, total)


def _check_spread(scale: FloatArray, total: FloatArray) -> None:
    """Check that each of N problems has more spread than the rounding errors of centering."""
    flat = ~(scale > ROUNDING_SHARE * total)
    if flat.any():
        which = f"problem {int(np.argmax(flat))}: " if len(scale) > 1 else ""
        raise ValueError(f"{which}no camera has matches that are spread over its image: the rotation is undetermined")
