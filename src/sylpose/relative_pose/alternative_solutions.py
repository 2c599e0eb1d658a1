"""Alternative motions that explain the same matches about as well as the fit.

The matches of a flat object, or of one whose residual depth is not visible, agree with two homographies in each camera:
of its plane and motion, and of a second plane with another motion. Cameras all around resolve this ambiguity. Cameras
close together do not, nor does the search always find both. The second plane is therefore computed from the first,
camera by camera, and tried as a start. Any refined minimum that is nearly as likely and distant is an alternative: the
result is then ambiguous.

Source: the second plane, Ma, Soatto, Kosecka, Sastry, "An Invitation to 3-D Vision", section 5.3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import UNOBSERVABLE_RATIO
from sylpose.geometry.numba_linalg import kernel, so3_log
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.relative_pose.irls import IrlsFit
from sylpose.relative_pose.robust_fit import RefinedMinima
from sylpose.relative_pose.terms import Candidate, Stack

# An object is flat if residual depth and curvature displace points by less than this, in standard deviations of their
# noise (choice).
MAX_FLAT_SIGMAS = 3.0
# Cameras are close together if the mean of their directions, as seen from the object, is longer: a cone of some 60
# degrees (choice).
MIN_CLOSE_MEAN = 0.85
# Maximum number of cameras whose second plane is tried (choice).
MAX_SECOND_PLANES = 4
# A motion that is less likely by this is no alternative: the accuracy of a likelihood (measured:
# docs/history/benchmarks.md#hard-pairs; deficits of the truth of 0.7 to 11 occurred). The second value is added for each
# inlier that the likelier motion has in excess. It may explain mismatches by chance, and real images' keypoints have longer
# tails than the model (measured: a mirror image with 7 of 108 matches more was likelier than the truth by 22).
MAX_LIKELIHOOD_LOSS, LOSS_PER_EXCESS_INLIER = 12.0, 3.0
# Two motions are distinct if one is outside the covariance of the other (chi-squared, once in a thousand times).
MIN_SEPARATION_SQUARE = chi_squared_bound(6)


class AlternativeMotion(NamedTuple):
    """Alternative motion.

    Attributes:
        rotation: (3, 3) R.
        translation: (3,) d.
        step: (6,) (w, d) from the fit to this motion.
        is_distant: whether it is clearly another motion: the step exceeds half of the motion.
    """

    rotation: FloatArray
    translation: FloatArray
    step: FloatArray
    is_distant: bool


def compute_second_planes(stack: Stack, fit: IrlsFit) -> list[Candidate]:
    """Compute the motion of each camera's second plane, with that plane as depth model of all cameras.

    Returns:
        the motions; none if the object is not flat.
    """
    out: list[Candidate] = []
    if not _is_flat(stack, fit):
        return out
    R, d, depth_model = fit.candidate
    for t in range(len(stack.focal)):
        if not fit.weights[stack.offsets[t] : stack.offsets[t + 1]].any():
            continue
        qx, qy, unit, spread = stack.qx[t], stack.qy[t], stack.inverse_depth[t], stack.spread[t]
        tau = qy @ (R @ stack.a1[t] - stack.a2[t] + d)
        a, b = depth_model[t, 1:3] / spread
        anchor = np.append(stack.anchor[t], 1.0)
        normal = unit * np.array([a, b, depth_model[t, 0] - a * anchor[0] - b * anchor[1]])
        other = _compute_second_plane(qy @ R @ qx.T + np.outer(tau, normal), normal, anchor)
        if other is not None and len(out) < MAX_SECOND_PLANES:
            rotation, translation = qy.T @ other[0] @ qx, qy.T @ other[1]
            plane = _transfer_plane(stack, t, other[2])
            out.append(Candidate(rotation, translation - rotation @ stack.a1[t] + stack.a2[t], plane))
    return out


@kernel
def is_narrow_baseline(centers: FloatArray) -> bool:
    """Return whether cameras at `centers` (T, 3), relative to the object, are close together."""
    mean = np.zeros(3)
    for t in range(len(centers)):
        length = np.sqrt(centers[t, 0] ** 2 + centers[t, 1] ** 2 + centers[t, 2] ** 2)
        for k in range(3):
            mean[k] += centers[t, k] / (max(length, 1e-300) * len(centers))
    return bool(np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2) >= MIN_CLOSE_MEAN)


@kernel
def _is_flat(stack: Stack, fit: IrlsFit) -> bool:
    """Return whether the object appears flat in all cameras with inliers."""
    rotation, translation, depth_model = fit.candidate
    for t in range(len(stack.focal)):
        inliers, curvature, squares = 0, 0.0, 0.0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            inliers += fit.weights[i] > 0.0
        for k in range(3, 6):
            curvature = max(curvature, abs(depth_model[t, k]))
        for i in range(3):
            tau = translation[i] - stack.a2[t, i]
            for j in range(3):
                tau += rotation[i, j] * stack.a1[t, j]
            squares += tau * tau
        parallax = stack.inverse_depth[t] * np.sqrt(squares) * stack.focal[t] / fit.sigma_px[t]
        if inliers > 0 and (fit.residual_depth[t] + curvature) * parallax > MAX_FLAT_SIGMAS:
            return False
    return True


def _transfer_plane(stack: Stack, t: int, normal: FloatArray) -> FloatArray:
    """Express the plane n'X = 1 of term t as depth models (T, 6) of all terms.

    normal (3,) is n in the axes of the camera in the reference frame. A camera that has the plane behind itself keeps
    its prior.
    """
    out, world = stack.depth_model_mean.copy(), stack.qx[t].T @ normal
    for k in range(len(out)):
        plane_distance, anchor = 1.0 - float(world @ (stack.a1[k] - stack.a1[t])), np.append(stack.anchor[k], 1.0)
        n = stack.qx[k] @ world / (plane_distance if abs(plane_distance) > 1e-9 else 1e-9)
        if n @ anchor > 0.0:
            out[k] = 0.0
            out[k, :3] = np.array([n @ anchor, *(stack.spread[k] * n[:2])]) / stack.inverse_depth[k]
    return out


def _compute_second_plane(
    H: FloatArray, normal: FloatArray, anchor: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return (R, τ, n) of the second plane of the homography H = R + τ n'; None if there is only one plane.

    Both planes have the same depth at the anchor.
    """
    _, values, rows = np.linalg.svd(H)
    H, values = H / values[1], values / values[1]
    excess, deficit = values[0] ** 2 - 1.0, 1.0 - values[2] ** 2
    if not (excess > 1e-12 and deficit > 1e-12):
        return None
    middle = rows[1]
    solutions = []
    for sign in (1.0, -1.0):
        u = (np.sqrt(deficit) * rows[0] + sign * np.sqrt(excess) * rows[2]) / np.sqrt(excess + deficit)
        n, mapped = np.cross(middle, u), np.stack([H @ middle, H @ u])
        R = np.column_stack([*mapped, np.cross(mapped[0], mapped[1])]) @ np.stack([middle, u, n])
        solutions.append((abs(float(n @ normal)), R, n))
    _, R, n = min(solutions, key=lambda solution: solution[0])
    if not abs(n @ anchor) > 1e-3:
        return None
    n = n * float(normal @ anchor) / float(n @ anchor)
    return R, (H - R) @ n / float(n @ n), n


def merge_minima(first: RefinedMinima, second: RefinedMinima) -> RefinedMinima:
    """Merge the minima of two searches."""
    return RefinedMinima(*(np.concatenate(parts) for parts in zip(first, second, strict=True)))


def find_likeliest_alternative(
    fit: IrlsFit, minima: RefinedMinima, information: FloatArray, radius: float
) -> AlternativeMotion | None:
    """Find the likeliest distinct minimum that is nearly as likely as the fit; far ones take precedence.

    Args:
        information: (6, 6) of the fit.
        radius: of the object.
    """
    best_one = int(np.argmin(minima.costs))
    excess_inliers = np.maximum(minima.inliers[best_one] - minima.inliers, 0.0)
    max_costs = minima.costs[best_one] + MAX_LIKELIHOOD_LOSS + LOSS_PER_EXCESS_INLIER * excess_inliers
    is_likely = np.isfinite(minima.costs) & (minima.costs < max_costs)
    if is_likely.sum() < 2:
        return None
    R, d, _ = fit.candidate
    rotvec = np.empty(3)
    so3_log(R, rotvec)
    size = np.hypot(radius * np.linalg.norm(rotvec), np.linalg.norm(d))
    best: AlternativeMotion | None = None
    for k in np.argsort(minima.costs, kind="stable").tolist():
        if not is_likely[k]:
            continue
        step = np.concatenate([np.empty(3), minima.translations[k] - d])
        so3_log(minima.rotations[k] @ R.T, rotvec)
        step[:3] = rotvec
        if step @ information @ step > MIN_SEPARATION_SQUARE:
            distance = np.hypot(radius * np.linalg.norm(rotvec), np.linalg.norm(step[3:]))
            is_distant = bool(distance > UNOBSERVABLE_RATIO * size)
            if best is None or (is_distant and not best.is_distant):
                best = AlternativeMotion(minima.rotations[k], minima.translations[k], step, is_distant)
    return best
