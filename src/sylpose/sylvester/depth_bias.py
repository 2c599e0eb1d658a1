"""What ignoring depth may have done to a rotation: the covariance of the paper's estimators on bodies that have surfaces.

Sylvester's equation takes y = N x and what m z adds as noise. On a visible surface the part of z that is linear in x is no
noise: camera c sees y = s (N + m a') x, with the slopes a of its surface's depth and a change s of scale. Neither is known;
what is believed of them goes through the normal equations. With S = S_xx, w of exp(w) R and δ_k = ∂/∂w_k,

    B = Σ tr δN S δN',   G_c = tr δN S a m' by a (3, 2),   g_c = tr δN S N' by log s (3),
    covariance of w = B⁻¹ [σ² B + A² (α² Σ G_c G_c' + β² (Σ G_c D_c) (Σ G_c D_c)') + γ² Σ g_c g_c'] B⁻¹.

Slopes are in part a camera's own (α), in part of the body's shape (β), which is the same for all cameras, so that more of
them do not average it out: an ellipsoid X'E X = 1 is seen to lean by a = -P Q E Q'e3 / (e3'Q E Q'e3), about D_c T for
E = I + T, T symmetric. How much all lean, A, is what the data tell: the likelihood of what the rotation leaves of each
camera's best affine map, the turn free, of several A with equal beliefs beforehand. B is the Gauss-Newton Hessian: it is
zero about an axis that no camera sees, also where the bias makes the cost's own Hessian look certain.

All of it follows from sums over the cameras (`Sums`), so that cameras which know the rotation and σ² find it by telling each
other their own terms (`sylvester.distributed`).

Source: our derivation (docs/method.md, "What a surface does").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import transpose
from sylpose.sylvester.orthographic import Views
from sylpose.sylvester.so3 import LEAST

__all__ = ["Sums", "information_of", "information_on_surfaces", "sums_of"]


# How much surfaces lean: depth per image length, standard deviation; all are as likely beforehand. 0 is the paper's model, 1
# a board that is seen slantwise (choice).
LEANING = np.array([0.0, 0.25, 0.5, 1.0])
# The share of that which is a camera's own, and that which all cameras have from the body's shape (measured:
# docs/benchmarks.md#what-a-surface-does).
OWN, SHAPE = 0.5, 0.7
# Standard deviation of log s: an object that comes 5 % nearer is a fast one (choice; as in `sylvester.depth_plane`).
LOG_SCALE = 0.03
# Points are collinear where the smaller eigenvalue of S_xx is at most this share of the larger (choice).
COLLINEAR = 1e-12
# As a share of what is seen: some roundings (derived).
ROUNDING = 1e-15
# The six entries of a symmetric T: those off the diagonal stand for two (derived).
_ROWS, _COLUMNS, _TIMES = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2], np.repeat([1.0, np.sqrt(2.0)], 3)


class Sums(NamedTuple):
    """What cameras say of surfaces, at one rotation: sums over them. λ are the values of A, `LEANING`.

    Attributes:
        turns: (3, 3) B.
        own, scales: (3, 3) Σ G_c G_c', Σ g_c g_c'.
        shape: (3, 6) Σ G_c D_c, by the entries of T.
        fits: (λ, 4, 4) normal equations of the turn, and what the rotation leaves of the affine maps.
        doubts: (λ,) log det V, more than of A = 0.
    """

    turns: FloatArray
    own: FloatArray
    scales: FloatArray
    shape: FloatArray
    fits: FloatArray
    doubts: FloatArray


def information_on_surfaces(views: Views, rotation: FloatArray) -> FloatArray:
    """(3, 3) of w at a rotation (3, 3) that was found with depth ignored, 1/rad²: noise, and what surfaces may have done."""
    N = views.rotation_y[:, :2] @ rotation @ transpose(views.rotation_x[:, :2])
    squares = float(np.trace(views.s_yy, axis1=1, axis2=2).sum())
    size = squares / 2 + 2 * float(np.trace(views.s_xx, axis1=1, axis2=2).sum()) / 9
    cost = (squares + float((N * (N @ views.s_xx - 2 * views.s_yx)).sum())) / 2
    noise = max(cost / size, LEAST) / float(views.weights.sum())
    return information_of(sums_of(views, rotation, size, noise), noise)


def sums_of(views: Views, rotation: FloatArray, size: float, noise: float) -> Sums:
    """What these cameras say at a rotation (3, 3).

    Args:
        size: `Quadratic.size` of all cameras, the unit of these sums: points of any size will do.
        noise: `Quadratic.variance` of all cameras over `size`.
    """
    views = views._replace(s_xx=views.s_xx / size, s_yx=views.s_yx / size)
    maps = _maps(views, rotation)
    G = transpose(maps.by_turn[:, :2]) * maps.by_slopes[:, None]
    g = np.einsum("cik,ci->ck", maps.by_turn, maps.by_scale)
    return Sums(
        np.einsum("cik,cil->kl", maps.by_turn, maps.by_turn),
        np.einsum("cki,cli->kl", G, G),
        g.T @ g,
        np.einsum("cki,cis->ks", G, maps.shapes),
        *_fits(maps, noise),
    )


def information_of(sums: Sums, noise: float) -> FloatArray:
    """`information_on_surfaces` of the sums of all cameras."""
    B = sums.turns
    slopes = OWN**2 * sums.own + SHAPE**2 * sums.shape @ sums.shape.T
    meat = noise * B + _leaning(sums) * slopes + LOG_SCALE**2 * sums.scales
    # Where B is singular, so is the meat.
    information = B @ np.linalg.solve(meat + LEAST * np.trace(meat) * np.eye(3), B)
    return np.asarray((information + information.T) / 2)


class _Maps(NamedTuple):
    """What C cameras' affine maps F say, as four numbers each: those of F S^½ along m and across it, each along the axes of
    S. So matches have the same noise in all four, and slopes along the axes change one each of the first two.

    Attributes:
        left: (C, 4) what N leaves of the best F.
        by_turn, by_scale: (C, 4, 3), (C, 4) its derivatives; by_slopes: (C, 2) those of the first two.
        shapes: (C, 2, 6) the slopes by the entries of T.
    """

    left: FloatArray
    by_turn: FloatArray
    by_scale: FloatArray
    by_slopes: FloatArray
    shapes: FloatArray


def _maps(views: Views, rotation: FloatArray) -> _Maps:
    C = len(views.weights)
    values, axes = np.linalg.eigh(views.s_xx)
    flat = values <= COLLINEAR * values[:, 1:]
    roots, inverse = np.sqrt(np.where(flat, 0.0, values)), 1 / np.sqrt(np.where(flat, np.inf, values))
    # The cameras' axes, turned along those of S in frame i and along m in frame j.
    of_x, looking = transpose(axes) @ views.rotation_x[:, :2], views.rotation_x[:, 2]
    of_y = views.rotation_y[:, :2]
    m = (of_y @ rotation @ looking[..., None])[..., 0]
    length = np.linalg.norm(m, axis=1)
    u = np.where(length[:, None] > 0, m, [1.0, 0.0]) / np.where(length > 0, length, 1.0)[:, None]
    to = np.stack([u, u[:, ::-1] * [-1.0, 1.0]], axis=1)
    of_y = to @ of_y
    turned = roots[..., None] * (of_x @ rotation.T)  # R times the axes in frame i, (C, 2, 3)
    predicted = of_y @ transpose(turned)
    best = to @ views.s_yx @ (axes * inverse[:, None])
    both = of_x[:, :, _ROWS] * looking[:, None, _COLUMNS] + of_x[:, :, _COLUMNS] * looking[:, None, _ROWS]
    return _Maps(
        left=(best - predicted).reshape(C, 4),
        by_turn=np.cross(turned[:, None], of_y[:, :, None]).reshape(C, 4, 3),
        by_scale=predicted.reshape(C, 4),
        by_slopes=length[:, None] * roots,
        shapes=-0.5 * _TIMES * both,
    )


def _fits(maps: _Maps, noise: float) -> tuple[FloatArray, FloatArray]:
    """`Sums.fits` and `Sums.doubts`. V = σ² I + A² L + γ² n n', L what slopes do to the first two numbers, n by_scale."""
    unsure = OWN**2 * np.eye(2) + SHAPE**2 * maps.shapes @ transpose(maps.shapes)
    values, axes = np.linalg.eigh(maps.by_slopes[:, :, None] * unsure * maps.by_slopes[:, None])
    whole = np.concatenate([maps.by_turn, maps.left[..., None], maps.by_scale[..., None]], axis=2)
    whole[:, :2] = transpose(axes) @ whole[:, :2]  # along the axes of L
    spread = np.zeros((len(LEANING), *whole.shape[:2]))
    spread[..., :2] = LEANING[:, None, None] ** 2 * np.maximum(values, 0.0)
    spread += noise
    whole = whole / np.sqrt(spread)[..., None]
    whole, n = whole[..., :4], LOG_SCALE * whole[..., 4]
    size = 1.0 + (n**2).sum(axis=-1)
    along = np.einsum("aci,acik->ack", n, whole) / np.sqrt(size)[..., None]
    flat = whole.reshape(len(LEANING), -1, 4)
    doubts = np.log(spread).sum(axis=(1, 2)) + np.log(size).sum(axis=1)
    return transpose(flat) @ flat - transpose(along) @ along, doubts - doubts[0]


def _leaning(sums: Sums) -> float:
    """A², the mean over what is likely; a turn of a radian has a variance of 1 beforehand."""
    fits, gradient = sums.fits[:, :3, :3], sums.fits[:, :3, 3:]
    # What is known beforehand is rounded away where the fits are exact, and some of them see no turn about some axis.
    least = np.maximum(1.0, ROUNDING * np.trace(fits, axis1=1, axis2=2))
    information = least[:, None, None] * np.eye(3) + fits
    squares = sums.fits[:, 3, 3] - (gradient * np.linalg.solve(information, gradient)).sum(axis=(1, 2))
    likely = -0.5 * (squares + np.linalg.slogdet(information)[1] + sums.doubts)
    share = np.exp(likely - likely.max())
    return float(share @ LEANING**2 / share.sum())
