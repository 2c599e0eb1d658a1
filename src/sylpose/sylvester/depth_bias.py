"""Covariance of rotations estimated with depth ignored: the possible bias by visible surfaces.

Sylvester's equation models y = N x with m z as noise. On a visible surface the part of z that is linear in x is not
noise: camera c observes y = s (N + m a') x, with the slopes a of its surface's depth and a change s of scale. Both are
unknown; their priors are propagated through the normal equations. With S = S_xx, w of exp(w) R and δ_k = ∂/∂w_k,

    B = Σ tr δN S δN',   G_c = tr δN S a m' by a (3, 2),   g_c = tr δN S N' by log s (3),
    covariance of w = B⁻¹ [σ² B + A² (α² Σ G_c G_c' + β² (Σ G_c D_c) (Σ G_c D_c)') + γ² Σ g_c g_c'] B⁻¹.

Slopes are partly independent per camera (α) and partly due to the body's shape (β), which is common to all cameras and
does not average out: an ellipsoid X'E X = 1 has the slope a = -P Q E Q'e3 / (e3'Q E Q'e3), about D_c T for E = I + T, T
symmetric. The overall size A of the slopes is estimated from the data: the likelihood of the residuals of each camera's
best affine map, marginalized over the rotation, for several A with equal priors. B is the Gauss-Newton Hessian: it is
zero about an unobserved axis, also where the bias gives the cost's own Hessian a spurious curvature.

The result follows from sums over the cameras (`SurfaceSums`): nodes that share the rotation and σ² compute it by
exchanging their own terms (`sylvester.distributed`).

Source: our derivation (docs/method/2-sylvester.md, "Bias from surface depth").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import transpose
from sylpose.sylvester.orthographic import Views
from sylpose.sylvester.so3 import MIN_RELATIVE_VARIANCE

# Standard deviations of the surface slopes (depth per image length), of equal prior probability. 0 is the paper's
# model, 1 a board seen obliquely (choice).
SLOPE_GRID = np.array([0.0, 0.25, 0.5, 1.0])
# The shares of that which are independent per camera, and common to all cameras by the body's shape (measured:
# docs/history/benchmarks.md#what-a-surface-does).
CAMERA_SHARE, BODY_SHARE = 0.5, 0.7
# Standard deviation of log s: an approach by 5 % is fast (choice; as in `sylvester.depth_plane`).
LOG_SCALE = 0.03
# Points are collinear where the smaller eigenvalue of S_xx is at most this share of the larger (choice).
COLLINEAR_RATIO = 1e-12
# Relative to the trace of the normal equations: some roundings (derived).
ROUNDING = 1e-15
# The six entries of a symmetric T: off-diagonal ones count twice (derived).
_ROWS, _COLUMNS, _MULTIPLICITY = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2], np.repeat([1.0, np.sqrt(2.0)], 3)


class SurfaceSums(NamedTuple):
    """Sums over the cameras at one rotation for the bias by surfaces. λ indexes the values of A, `SLOPE_GRID`.

    Attributes:
        hessian: (3, 3) B.
        camera_slopes, scales: (3, 3) Σ G_c G_c', Σ g_c g_c'.
        body_slopes: (3, 6) Σ G_c D_c, by the entries of T.
        normal_equations: (λ, 4, 4) normal equations of the rotation, with the residuals of the affine maps as the last
            row and column.
        log_determinants: (λ,) log det V relative to A = 0.
    """

    hessian: FloatArray
    camera_slopes: FloatArray
    scales: FloatArray
    body_slopes: FloatArray
    normal_equations: FloatArray
    log_determinants: FloatArray


def information_with_depth_bias(views: Views, rotation: FloatArray) -> FloatArray:
    """Return the information (3, 3) of w, 1/rad², of a rotation (3, 3) estimated with depth ignored.

    It includes noise and the possible bias by surfaces.
    """
    N = views.rotation_y[:, :2] @ rotation @ transpose(views.rotation_x[:, :2])
    squares = float(np.trace(views.s_yy, axis1=1, axis2=2).sum())
    size = squares / 2 + 2 * float(np.trace(views.s_xx, axis1=1, axis2=2).sum()) / 9
    cost = (squares + float((N * (N @ views.s_xx - 2 * views.s_yx)).sum())) / 2
    noise = max(cost / size, MIN_RELATIVE_VARIANCE) / float(views.weights.sum())
    return information_from_sums(compute_surface_sums(views, rotation, size, noise), noise)


def compute_surface_sums(views: Views, rotation: FloatArray, size: float, noise: float) -> SurfaceSums:
    """Compute the sums of these cameras at a rotation (3, 3).

    Args:
        views: second moments of the cameras.
        rotation: (3, 3) rotation, world frame.
        size: `QuadraticCost.size` of all cameras, the unit of these sums, which makes them independent of the points'
            scale.
        noise: `QuadraticCost.variance` of all cameras over `size`.
    """
    views = views._replace(s_xx=views.s_xx / size, s_yx=views.s_yx / size)
    maps = _compute_maps(views, rotation)
    G = transpose(maps.by_rotation[:, :2]) * maps.by_slopes[:, None]
    g = np.einsum("cik,ci->ck", maps.by_rotation, maps.by_scale)
    return SurfaceSums(
        np.einsum("cik,cil->kl", maps.by_rotation, maps.by_rotation),
        np.einsum("cki,cli->kl", G, G),
        g.T @ g,
        np.einsum("cki,cis->ks", G, maps.shapes),
        *_compute_fits(maps, noise),
    )


def information_from_sums(sums: SurfaceSums, noise: float) -> FloatArray:
    """Return the information (3, 3) of `information_with_depth_bias` from the sums of all cameras."""
    B = sums.hessian
    slopes = CAMERA_SHARE**2 * sums.camera_slopes + BODY_SHARE**2 * sums.body_slopes @ sums.body_slopes.T
    meat = noise * B + _mean_squared_slope(sums) * slopes + LOG_SCALE**2 * sums.scales
    # The meat of the sandwich is singular where B is.
    information = B @ np.linalg.solve(meat + MIN_RELATIVE_VARIANCE * np.trace(meat) * np.eye(3), B)
    return np.asarray((information + information.T) / 2)


class _AffineMaps(NamedTuple):
    """Affine maps F of C cameras as four numbers each: F S^½ along m and across it, each along the axes of S.

    In these coordinates the noise of the matches is equal in all four, and each slope affects one of the first two
    only.

    Attributes:
        residuals: (C, 4) residuals of the best F with respect to N.
        by_rotation, by_scale: (C, 4, 3), (C, 4) derivatives by w and log s; by_slopes: (C, 2) by the slopes, of the
            first two.
        shapes: (C, 2, 6) derivatives of the slopes by the entries of T.
    """

    residuals: FloatArray
    by_rotation: FloatArray
    by_scale: FloatArray
    by_slopes: FloatArray
    shapes: FloatArray


def _compute_maps(views: Views, rotation: FloatArray) -> _AffineMaps:
    C = len(views.weights)
    values, axes = np.linalg.eigh(views.s_xx)
    flat = values <= COLLINEAR_RATIO * values[:, 1:]
    roots, inverse = np.sqrt(np.where(flat, 0.0, values)), 1 / np.sqrt(np.where(flat, np.inf, values))
    # The cameras' axes, aligned with those of S in frame i and with m in frame j.
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
    products = of_x[:, :, _ROWS] * looking[:, None, _COLUMNS] + of_x[:, :, _COLUMNS] * looking[:, None, _ROWS]
    return _AffineMaps(
        residuals=(best - predicted).reshape(C, 4),
        by_rotation=np.cross(turned[:, None], of_y[:, :, None]).reshape(C, 4, 3),
        by_scale=predicted.reshape(C, 4),
        by_slopes=length[:, None] * roots,
        shapes=-0.5 * _MULTIPLICITY * products,
    )


def _compute_fits(maps: _AffineMaps, noise: float) -> tuple[FloatArray, FloatArray]:
    """Return `SurfaceSums.normal_equations` and `log_determinants`.

    V = σ² I + A² L + γ² n n', L from the slopes, n `by_scale`.
    """
    slope_covariance = CAMERA_SHARE**2 * np.eye(2) + BODY_SHARE**2 * maps.shapes @ transpose(maps.shapes)
    values, axes = np.linalg.eigh(maps.by_slopes[:, :, None] * slope_covariance * maps.by_slopes[:, None])
    whole = np.concatenate([maps.by_rotation, maps.residuals[..., None], maps.by_scale[..., None]], axis=2)
    whole[:, :2] = transpose(axes) @ whole[:, :2]  # along the axes of L
    spread = np.zeros((len(SLOPE_GRID), *whole.shape[:2]))
    spread[..., :2] = SLOPE_GRID[:, None, None] ** 2 * np.maximum(values, 0.0)
    spread += noise
    whole = whole / np.sqrt(spread)[..., None]
    whole, n = whole[..., :4], LOG_SCALE * whole[..., 4]
    size = 1.0 + (n**2).sum(axis=-1)
    along = np.einsum("aci,acik->ack", n, whole) / np.sqrt(size)[..., None]
    flat = whole.reshape(len(SLOPE_GRID), -1, 4)
    log_determinants = np.log(spread).sum(axis=(1, 2)) + np.log(size).sum(axis=1)
    return transpose(flat) @ flat - transpose(along) @ along, log_determinants - log_determinants[0]


def _mean_squared_slope(sums: SurfaceSums) -> float:
    """Return the posterior mean of A²; the rotation has a prior variance of 1 rad²."""
    fits, gradient = sums.normal_equations[:, :3, :3], sums.normal_equations[:, :3, 3:]
    # The prior would be lost to rounding where fits are exact and leave an axis unobserved: raise it above rounding.
    least = np.maximum(1.0, ROUNDING * np.trace(fits, axis1=1, axis2=2))
    information = least[:, None, None] * np.eye(3) + fits
    squares = sums.normal_equations[:, 3, 3] - (gradient * np.linalg.solve(information, gradient)).sum(axis=(1, 2))
    log_likelihood = -0.5 * (squares + np.linalg.slogdet(information)[1] + sums.log_determinants)
    share = np.exp(log_likelihood - log_likelihood.max())
    return float(share @ SLOPE_GRID**2 / share.sum())
