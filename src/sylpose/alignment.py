"""The pose that best aligns landmarks of uncertain depth with where their features are now.

Each match is a landmark X with covariance Σ (along its ray mostly) and an image point y. The residual of the projection
is weighted with V = σ² I + J Σ J': a landmark that was seen once constrains only across its epipolar line, one that is
well known constrains both ways as in solvePnP, and everything in between is in between. There is no identity trap and no
degenerate object. V is held fixed within an iteration (quasi-likelihood): letting the cost trade V against the residuals
is biased towards too much motion (docs/method.md, "Better than two frames").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sylpose.robust import bisquare, robust_sigma

__all__ = ["Aligned", "Sights", "align"]

FloatArray = NDArray[np.float64]

# Cutoff of the bisquare weights, in standard deviations: 95 % efficient for Gaussian noise.
CUTOFF = 4.7
# Noise that the first, forgiving rounds assume, pixels: from a bad prediction to a keypoint's own noise.
SCHEDULE_PX = (16.0, 8.0, 4.0, 2.0, 1.0)
SIGMA_FLOOR_PX, SIGMA_CEILING_PX = 0.2, 1.5


@dataclass(frozen=True, eq=False)
class Sights:
    """One camera's matches between landmarks and the current frame.

    Attributes:
        points: (n, 3) landmarks relative to g, world axes, at the pose that the motion starts from.
        covariance: (n, 3, 3) of them.
        image: (n, 2) normalised points in the current frame.
        rotation: (3, 3) Q of camera_from_world.
        center: (3,) the camera's centre relative to g.
        focal: pixels per normalised unit.
    """

    points: FloatArray
    covariance: FloatArray
    image: FloatArray
    rotation: FloatArray
    center: FloatArray
    focal: float


@dataclass(frozen=True, eq=False)
class Aligned:
    """The motion X -> R (X - g) + g + d that aligns them.

    Attributes:
        rotation: (3, 3); shift: (3,).
        information: (6, 6) of (w, d).
        weights: per camera (n,), 0 for outliers.
        residuals: per camera (n,) whitened distance times sigma: pixels, across what depth leaves open.
        cost: robust, per match between 0 and 1: comparable between starts.
        converged: whether the last step was negligible.
        iterations: of Gauss-Newton.
    """

    rotation: FloatArray
    shift: FloatArray
    information: FloatArray
    weights: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    cost: float
    converged: bool
    iterations: int


def align(
    sights: Sequence[Sights], rotation: FloatArray, shift: FloatArray, length: float, first_px: float = 16.0
) -> Aligned:
    """Robust Gauss-Newton from one start.

    Args:
        rotation: (3, 3) and shift: (3,), the start.
        length: of the object: what a step is compared with.
        first_px: noise that the first round assumes; the start should be right within a few times that.
    """
    schedule = [s for s in SCHEDULE_PX if s <= first_px]
    sigma = np.full(len(sights), schedule[0])
    converged = False
    iteration = 0
    # Without bad cameras the noise levels settle in a few rounds; 30 bounds the rest.
    for iteration in range(30):
        final = iteration >= len(schedule)
        if not final:
            sigma[:] = schedule[iteration]
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        for c, sight in enumerate(sights):
            e, jac, inverse = _linearise(sight, rotation, shift, sigma[c])
            squared = np.einsum("ni,nij,nj->n", e, inverse, e)
            if final:
                scale = robust_sigma(np.sqrt(squared[squared < CUTOFF**2]) / 1.177 * 0.6745 * 1.4826, 0.1)
                sigma[c] = np.clip(sigma[c] * np.clip(scale, 0.7, 1.4), SIGMA_FLOOR_PX, SIGMA_CEILING_PX)
            w = bisquare(np.sqrt(squared), CUTOFF)
            weighted = inverse * w[:, None, None]
            hessian += np.einsum("nik,nij,njl->kl", jac, weighted, jac)
            gradient += np.einsum("nik,nij,nj->k", jac, weighted, e)
        damping = 1e-9 * np.diag(np.diag(hessian)) + 1e-300 * np.eye(6)
        step = -np.linalg.lstsq(hessian + damping, gradient, rcond=None)[0]
        step /= max(1.0, float(np.linalg.norm(step[:3])) / 0.5)
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        shift = shift + step[3:]
        size = float(np.linalg.norm(step[:3]) * length + np.linalg.norm(step[3:]))
        if final and size < 1e-5 * length and iteration >= len(schedule) + 3:
            converged = True
            break
    return _summary(sights, rotation, shift, sigma, converged, iteration + 1)


def _linearise(
    sight: Sights, rotation: FloatArray, shift: FloatArray, sigma_px: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (n, 2), their derivatives (n, 2, 6) by (w, d), and the inverse of V (n, 2, 2)."""
    turned = sight.points @ rotation.T
    p = (turned + shift - sight.center) @ sight.rotation.T
    z = np.where(p[:, 2] > 1e-9, p[:, 2], np.nan)
    image = p[:, :2] / z[:, None]
    by_camera = np.zeros((len(p), 2, 3))
    by_camera[:, 0, 0] = by_camera[:, 1, 1] = 1.0 / z
    by_camera[:, :, 2] = -image / z[:, None]
    by_point = by_camera @ sight.rotation
    by_turn = np.cross(turned[:, None, :], by_point)
    by_landmark = by_point @ rotation
    v = by_landmark @ sight.covariance @ np.swapaxes(by_landmark, 1, 2)
    v[:, [0, 1], [0, 1]] += (sigma_px / sight.focal) ** 2
    e = image - sight.image
    behind = ~np.isfinite(z)
    e[behind], v[behind] = 1e3, np.eye(2)
    jac = np.concatenate([by_turn, by_point], axis=2)
    jac[behind] = 0.0
    return e, jac, _inverse_2x2(v)


def _inverse_2x2(v: FloatArray) -> FloatArray:
    out = np.empty_like(v)
    out[:, 0, 0], out[:, 1, 1] = v[:, 1, 1], v[:, 0, 0]
    out[:, 0, 1], out[:, 1, 0] = -v[:, 0, 1], -v[:, 1, 0]
    return np.asarray(out / (v[:, 0, 0] * v[:, 1, 1] - v[:, 0, 1] * v[:, 1, 0])[:, None, None])


def _summary(
    sights: Sequence[Sights], rotation: FloatArray, shift: FloatArray, sigma: FloatArray, converged: bool, count: int
) -> Aligned:
    information = np.zeros((6, 6))
    weights, residuals = [], []
    cost, n = 0.0, 0
    for sight, s in zip(sights, sigma, strict=True):
        e, jac, inverse = _linearise(sight, rotation, shift, s)
        distance = np.sqrt(np.einsum("ni,nij,nj->n", e, inverse, e))
        w = bisquare(distance, CUTOFF)
        information += np.einsum("nik,nij,njl->kl", jac, inverse * w[:, None, None], jac)
        weights.append(w)
        residuals.append(distance * s / np.sqrt(2.0))
        cost += float((1.0 - np.maximum(1.0 - (distance / CUTOFF) ** 2, 0.0) ** 3).sum())
        n += len(w)
    return Aligned(rotation, shift, information, tuple(weights), tuple(residuals), cost / max(n, 1), converged, count)
