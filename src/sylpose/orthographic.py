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
from numpy.typing import ArrayLike, NDArray

from sylpose.equation import transpose
from sylpose.moments import PairMoments

__all__ = ["Quadratic", "Views", "checked_rotations", "quadratic_of", "views_of"]

FloatArray = NDArray[np.float64]


class Views(NamedTuple):
    """The second moments of C cameras, each centred and seen by a camera that is turned onto its mean ray.

    Attributes:
        rotation_x, rotation_y: (C, 3, 3) Q of the turned camera in frames i and j: rows are its axes in the world.
        s_xx, s_yx, s_yy: (C, 2, 2) Σ w xx', Σ w yx', Σ w yy' about the means. Zero for a camera without matches.
        weights: (C,) Σ w, the number of matches when all weights are 1.
        total: Σ of the traces of all moments as given, to judge what is no more than rounding.
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
    # The moments are centred here, all at once, for the sake of thousands of cameras.
    M = np.array([m.matrix for m in moments])
    count = M[:, 8, 8]
    per_count = 1 / np.where(count > 0, count, 1)[:, None]
    Ex, Ey = M[:, 8, 6:8] * per_count, M[:, 8, [2, 5]] * per_count
    n = count[:, None, None]
    Sxx = M[:, 6:8, 6:8] - n * Ex[:, :, None] * Ex[:, None, :]
    Syx = M[:, [2, 5], 6:8] - n * Ey[:, :, None] * Ex[:, None, :]
    Syy = M[:, [[2], [5]], [2, 5]] - n * Ey[:, :, None] * Ey[:, None, :]
    total = float(np.trace(M, axis1=1, axis2=2).sum())
    if not aim:
        return Views(Q, Q, Sxx, Syx, Syy, count, total)
    # Turned by T onto a mean ray, δ away from it in the image, a point is P T Q X / Z at exactly (P T P') δ.
    Tx, Ty = _turn_to(Ex), _turn_to(Ey)
    Jx, Jy = Tx[:, :2, :2], Ty[:, :2, :2]
    return Views(
        Tx @ Q,
        Ty @ Q,
        Jx @ Sxx @ transpose(Jx),
        Jy @ Syx @ transpose(Jx),
        Jy @ Syy @ transpose(Jy),
        count,
        total,
    )


def quadratic_of(views: Views) -> Quadratic:
    """The least squares over all cameras, depth ignored: H = Σ A_c ⊗ B_c, h = vec(Σ C_c) over `scale`, where

        A_c = Q'P'PQ,   B_c = Q'P' S_xx P Q,   C_c = Q'P' S_yx P Q,   P = [1 0 0; 0 1 0].

    Raises:
        ValueError: no camera has matches with any spread.
    """
    PQx, PQy = views.rotation_x[:, :2], views.rotation_y[:, :2]
    A, B = transpose(PQy) @ PQy, transpose(PQx) @ views.s_xx @ PQx
    h = (transpose(PQy) @ views.s_yx @ PQx).sum(axis=0).ravel()
    # Σ A_c ⊗ B_c as one matrix product.
    H = (A.reshape(-1, 9).T @ B.reshape(-1, 9)).reshape(3, 3, 3, 3).transpose(0, 2, 1, 3).reshape(9, 9)
    scale = float(np.trace(H)) / 9
    # What centring leaves by rounding is no spread.
    if not scale > 1e-14 * views.total:
        raise ValueError("no camera has matches that are spread over its image: there is nothing to turn")
    constant = float(np.trace(views.s_yy, axis1=1, axis2=2).sum()) / 2
    return Quadratic((H + H.T) / (2 * scale), h / scale, constant / scale, scale, float(views.weights.sum()))


def checked_rotations(rotations: ArrayLike, n: int) -> FloatArray:
    """(n, 3, 3) rotation matrices, or a ValueError that says which is none."""
    out = np.asarray(rotations, dtype=float)
    if out.ndim != 3 or out.shape[1:] != (3, 3) or len(out) != n or n == 0:
        raise ValueError(f"rotations must be (C, 3, 3) for C = {n} moments, C >= 1; got shape {out.shape}")
    finite = np.where(np.isfinite(out).all(axis=(1, 2), keepdims=True), out, 0)
    wrong = (np.abs(finite @ transpose(finite) - np.eye(3)).max(axis=(1, 2)) > 1e-6) | (np.linalg.det(finite) < 0)
    if wrong.any():
        raise ValueError(f"rotations[{int(np.argmax(wrong))}] is not a rotation matrix")
    return out


def _turn_to(x: FloatArray) -> FloatArray:
    """(C, 2) normalised points -> (C, 3, 3) the least rotations that take their rays to the z axis."""
    u = np.column_stack([x, np.ones(len(x))])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    T = np.empty((len(x), 3, 3))
    T[:, :2, :2] = np.eye(2) - u[:, :2, None] * u[:, None, :2] / (1 + u[:, 2, None, None])
    T[:, :2, 2] = -u[:, :2]
    T[:, 2] = u
    return T
