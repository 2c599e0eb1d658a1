"""The pose that best aligns landmarks of uncertain depth with where their features are now.

Each match is a landmark X, known well across the ray it was first seen along and less well, by a standard deviation s,
along it, and an image point y. Depths are off in two ways: each for itself, and all of a camera's together, since the
object's surface is not where it was thought to be. So the landmark is at X + s r (a1 + a2 u + a3 v + ε), with r the ray,
(u, v) the place in the image, ε and the camera's three a's of unit variance. The a's are unknowns beside the six of the
motion; ε goes into the weight V = σ² I + J s² r r' J' of the image residual. A landmark that was seen once constrains only
across its epipolar line, one that is well known constrains both ways as in solvePnP, and everything in between is in
between. There is no identity trap and no degenerate object. V is held fixed within an iteration (quasi-likelihood):
letting the cost trade V against the residuals is biased towards too much motion (docs/method.md, "Better than two
frames").
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
SCHEDULE_PX = (32.0, 16.0, 8.0, 4.0, 2.0, 1.0)
# Rounds in which the noise level follows the residuals; then it is held, and the rest converges.
SIGMA_ROUNDS = 5
MAX_ROUNDS = 40
SIGMA_FLOOR_PX, SIGMA_CEILING_PX = 0.2, 1.5


@dataclass(frozen=True, eq=False)
class Sights:
    """One camera's matches between landmarks and the current frame.

    Attributes:
        points: (n, 3) landmarks relative to g, world axes, at the pose that the motion starts from.
        depth_error: (n, 3) s r: the direction in which each is least known, one standard deviation long, away from the
            camera.
        image: (n, 2) normalised points in the current frame.
        feature: (n,) which feature of the current frame each is about. A feature may be matched with landmarks of several
            references: they then share its weight, and one that contradicts the pose takes all of them with it.
        trust: (n,) in (0, 1], multiplies the weights.
        rotation: (3, 3) Q of camera_from_world.
        center: (3,) the camera's centre relative to g.
        focal: pixels per normalised unit.
    """

    points: FloatArray
    depth_error: FloatArray
    image: FloatArray
    feature: NDArray[np.int64]
    trust: FloatArray
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
        residuals: per camera (n,) pixels, across the direction that unknown depth leaves open: the epipolar distance.
        cost: robust, mean over the matches by trust, between 0 and 1: comparable between starts.
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


def align(sights: Sequence[Sights], rotation: FloatArray, shift: FloatArray, first_px: float = 32.0) -> Aligned:
    """Robust Gauss-Newton from one start.

    Args:
        rotation: (3, 3) and shift: (3,), the start.
        first_px: noise that the first round assumes; the start should be right within a few times that.
    """
    schedule = [s for s in SCHEDULE_PX if s <= first_px]
    sigma = np.full(len(sights), schedule[0])
    surface = np.zeros((len(sights), 3))
    basis = [_basis(sight) for sight in sights]
    trusted = np.ones(len(sights), dtype=bool)
    previous = np.zeros(6)
    converged = False
    iteration = 0
    for iteration in range(MAX_ROUNDS):
        final = iteration >= len(schedule)
        if not final:
            sigma[:] = schedule[iteration]
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        blocks = []
        for c, sight in enumerate(sights):
            e, jac, inverse = _linearise(sight, basis[c], surface[c], rotation, shift, sigma[c])
            w = _weights(sight, np.sqrt(np.einsum("ni,nij,nj->n", e, inverse, e)))
            if final and iteration < len(schedule) + SIGMA_ROUNDS:
                across = _across(e, inverse, sight.focal)
                noise = robust_sigma(across[w > 0], SIGMA_FLOOR_PX)
                trusted[c] = noise < SIGMA_CEILING_PX
                sigma[c] = min(noise, SIGMA_CEILING_PX)
            if not trusted[c] and trusted.any():
                w = np.zeros_like(w)
            h, b = _normal_equations(e, jac, inverse * w[:, None, None])
            h[6:, 6:] += np.eye(3)
            b[6:] += surface[c]
            # The surface's three unknowns are this camera's alone: they are eliminated here.
            gain = np.linalg.solve(h[6:, 6:], h[6:, :6])
            hessian += h[:6, :6] - h[:6, 6:] @ gain
            gradient += b[:6] - gain.T @ b[6:]
            blocks.append((h, b))
        damping = 1e-9 * np.diag(np.diag(hessian)) + 1e-300 * np.eye(6)
        step = -np.asarray(np.linalg.lstsq(hessian + damping, gradient, rcond=None)[0], dtype=float)
        size = float(step @ hessian @ step)
        if final:
            # Re-weighting converges linearly; Aitken's extrapolation of its steps makes that a few rounds.
            ratio = float(step @ hessian @ previous) / max(float(previous @ hessian @ previous), 1e-300)
            previous = step.copy()
            if iteration >= len(schedule) + SIGMA_ROUNDS and iteration % 3 == 2:
                step /= 1.0 - np.clip(ratio, -1.0, 0.85)
        step /= max(1.0, float(np.linalg.norm(step[:3])) / 0.5)
        for c, (h, b) in enumerate(blocks):
            surface[c] -= np.linalg.solve(h[6:, 6:], b[6:] + h[6:, :6] @ step)
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        shift = shift + step[3:]
        # Converged when the step is a twentieth of its own standard deviation: what is left is not worth a round.
        if final and iteration >= len(schedule) + SIGMA_ROUNDS and size < 0.05**2:
            converged = True
            break
    return _summary(sights, basis, surface, rotation, shift, sigma, trusted, converged, iteration + 1)


def _basis(sight: Sights) -> FloatArray:
    """(n, 3): 1, u, v, the place in the image in units of its spread."""
    if len(sight.image) == 0:
        return np.empty((0, 3))
    spread = max(float(np.linalg.norm(sight.image.std(axis=0))), 1e-12)
    return np.column_stack([np.ones(len(sight.image)), (sight.image - np.median(sight.image, axis=0)) / spread])


def _normal_equations(e: FloatArray, jac: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """J'WJ (9, 9) and J'We (9,)."""
    wj = weight @ jac
    return np.tensordot(jac, wj, axes=([0, 1], [0, 1])), np.einsum("nik,ni->k", wj, e)


def _linearise(
    sight: Sights, basis: FloatArray, surface: FloatArray, rotation: FloatArray, shift: FloatArray, sigma_px: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (n, 2), their derivatives (n, 2, 9) by (w, d, a), and the inverse of V (n, 2, 2)."""
    turned = (sight.points + (basis @ surface)[:, None] * sight.depth_error) @ rotation.T
    p = (turned + shift - sight.center) @ sight.rotation.T
    behind = p[:, 2] <= 1e-9
    z = np.where(behind, 1.0, p[:, 2])
    image = p[:, :2] / z[:, None]
    by_camera = np.zeros((len(p), 2, 3))
    by_camera[:, 0, 0] = by_camera[:, 1, 1] = 1.0 / z
    by_camera[:, :, 2] = -image / z[:, None]
    by_point = by_camera @ sight.rotation
    by_turn = np.cross(turned[:, None, :], by_point)
    by_depth = np.einsum("nij,nj->ni", by_point, sight.depth_error @ rotation.T)
    # V = σ² I + b b', inverted in closed form: stable also where the depth is unknown.
    variance = (sigma_px / sight.focal) ** 2
    outer = by_depth[:, :, None] * by_depth[:, None, :]
    length = (by_depth**2).sum(axis=1)
    inverse = (np.eye(2) - outer / (variance + length)[:, None, None]) / variance
    e = image - sight.image
    e[behind] = 1e3
    jac = np.concatenate([by_turn, by_point, by_depth[:, :, None] * basis[:, None, :]], axis=2)
    return e, jac, inverse


def _weights(sight: Sights, distance: FloatArray) -> FloatArray:
    """(n,) robust weights; matches of one feature share the least of theirs."""
    w = bisquare(distance, CUTOFF)
    n = int(sight.feature.max(initial=-1)) + 1
    least = np.ones(n)
    np.minimum.at(least, sight.feature, w)
    shared = least / np.maximum(np.bincount(sight.feature, minlength=n), 1)
    return np.asarray(shared[sight.feature] * sight.trust)


def _across(e: FloatArray, inverse: FloatArray, focal: float) -> FloatArray:
    """(n,) residuals in pixels along the direction of V's smaller variance, where only image noise is left."""
    angle = 0.5 * np.arctan2(2.0 * inverse[:, 0, 1], inverse[:, 0, 0] - inverse[:, 1, 1])
    return np.asarray(focal * (e[:, 0] * np.cos(angle) + e[:, 1] * np.sin(angle)))


def _summary(
    sights: Sequence[Sights],
    basis: Sequence[FloatArray],
    surface: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    sigma: FloatArray,
    trusted: NDArray[np.bool_],
    converged: bool,
    count: int,
) -> Aligned:
    information = np.zeros((6, 6))
    weights, residuals = [], []
    cost, total = 0.0, 0.0
    for c, sight in enumerate(sights):
        e, jac, inverse = _linearise(sight, basis[c], surface[c], rotation, shift, sigma[c])
        distance = np.sqrt(np.einsum("ni,nij,nj->n", e, inverse, e))
        w = _weights(sight, distance) * (trusted[c] or not trusted.any())
        h, _ = _normal_equations(e, jac, inverse * w[:, None, None])
        information += h[:6, :6] - h[:6, 6:] @ np.linalg.solve(h[6:, 6:] + np.eye(3), h[6:, :6])
        weights.append(w)
        residuals.append(_across(e, inverse, sight.focal))
        cost += float(sight.trust @ (1.0 - np.maximum(1.0 - (distance / CUTOFF) ** 2, 0.0) ** 3))
        total += float(sight.trust.sum())
    return Aligned(
        rotation,
        shift,
        information,
        tuple(weights),
        tuple(residuals),
        cost / max(total, 1e-12),
        converged,
        count,
    )
