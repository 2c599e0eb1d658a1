"""Other motions that explain the same matches about as well as the one that was found.

The matches of a flat object, or of one whose relief does not show, are two homographies' in each camera: of its plane and
motion, and of another plane with another motion. Cameras all around tell the two apart, and cameras close together do not,
nor does the search always meet both. So the second is computed from the first, camera by camera, and tried as a start; and
of all minima that were refined, one that is nearly as likely and far away is a rival, about which nothing is certain.

Source: the second plane, Ma, Soatto, Kosecka, Sastry, "An Invitation to 3-D Vision", section 5.3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, rotvec_of
from sylpose.geometry.observability import UNSEEN_SHARE
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.relative_pose.irls import Reweighted
from sylpose.relative_pose.robust_fit import Settled
from sylpose.relative_pose.terms import Candidate, Stack

__all__ = ["LESS_LIKELY", "Rival", "are_close", "has_likely", "second_planes", "strongest_rival", "together"]

# Relief, and what of a quadric is no plane, that displaces points by less than this, in standard deviations of their noise,
# leaves an object flat for all that a camera sees (choice).
FLAT = 3.0
# Cameras are close together where the mean of their directions, as seen from the object, is longer: a cone of some 60
# degrees (choice).
CLOSE = 0.85
# Cameras whose second plane is tried (choice).
PLANES = 4
# A motion that is less likely by this is none to choose from: a likelihood is trusted to so much (measured:
# docs/benchmarks.md#hard-pairs; deficits of the truth of 0.7 to 11 were seen), and by so much less for each match that the
# likelier one has more: it may explain mismatches by chance, and keypoints of real images have longer tails than is
# believed (measured: a mirror image with 7 of 108 matches more was likelier than the truth by 22).
LESS_LIKELY, FOR_EACH_MORE = 12.0, 3.0
# Two motions are apart where the covariance of one has the other outside of it (chi-squared, once in a thousand times).
APART = chi_squared_bound(6)


class Rival(NamedTuple):
    """Another motion.

    Attributes:
        rotation: (3, 3), shift: (3,).
        step: (6,) (w, d) from the motion that was found to this one.
        far: whether it is another motion for all that can be said, so that half of the motion is in doubt.
    """

    rotation: FloatArray
    shift: FloatArray
    step: FloatArray
    far: bool


def second_planes(stack: Stack, found: Reweighted) -> list[Candidate]:
    """Motions of the second plane of each camera, with that plane for all of them; none where the object is not flat."""
    out: list[Candidate] = []
    if not _is_flat(stack, found):
        return out
    R, d, surface = found.candidate
    for t in range(len(stack.focal)):
        if not found.weights[stack.offsets[t] : stack.offsets[t + 1]].any():
            continue
        qx, qy, unit, spread = stack.qx[t], stack.qy[t], stack.inverse_depth[t], stack.spread[t]
        tau = qy @ (R @ stack.a1[t] - stack.a2[t] + d)
        a, b = surface[t, 1:3] / spread
        anchor = np.append(stack.anchor[t], 1.0)
        normal = unit * np.array([a, b, surface[t, 0] - a * anchor[0] - b * anchor[1]])
        other = _other_plane(qy @ R @ qx.T + np.outer(tau, normal), normal, anchor)
        if other is not None and len(out) < PLANES:
            turn, by = qy.T @ other[0] @ qx, qy.T @ other[1]
            plane = _seen_by_all(stack, t, other[2])
            out.append(Candidate(turn, by - turn @ stack.a1[t] + stack.a2[t], plane))
    return out


@kernel
def are_close(places: FloatArray) -> bool:
    """Whether cameras at places (T, 3), relative to the object, are close together."""
    mean = np.zeros(3)
    for t in range(len(places)):
        length = np.sqrt(places[t, 0] ** 2 + places[t, 1] ** 2 + places[t, 2] ** 2)
        for k in range(3):
            mean[k] += places[t, k] / (max(length, 1e-300) * len(places))
    return bool(np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2) >= CLOSE)


@kernel
def _is_flat(stack: Stack, found: Reweighted) -> bool:
    """Whether the object is flat for all that the cameras see that have inliers."""
    turn, shift, surface = found.candidate
    for t in range(len(stack.focal)):
        inliers, bent, squares = 0, 0.0, 0.0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            inliers += found.weights[i] > 0.0
        for k in range(3, 6):
            bent = max(bent, abs(surface[t, k]))
        for i in range(3):
            tau = shift[i] - stack.a2[t, i]
            for j in range(3):
                tau += turn[i, j] * stack.a1[t, j]
            squares += tau * tau
        parallax = stack.inverse_depth[t] * np.sqrt(squares) * stack.focal[t] / found.sigma_px[t]
        if inliers > 0 and (found.relief[t] + bent) * parallax > FLAT:
            return False
    return True


def _seen_by_all(stack: Stack, t: int, normal: FloatArray) -> FloatArray:
    """(T, 6) surfaces of the plane n'X = 1 of term t, n = normal (3,) in the axes of its camera in the reference frame; as
    it is believed beforehand for a camera that has it behind itself."""
    out, world = stack.surface_mean.copy(), stack.qx[t].T @ normal
    for k in range(len(out)):
        away, anchor = 1.0 - float(world @ (stack.a1[k] - stack.a1[t])), np.append(stack.anchor[k], 1.0)
        n = stack.qx[k] @ world / (away if abs(away) > 1e-9 else 1e-9)
        if n @ anchor > 0.0:
            out[k] = 0.0
            out[k, :3] = np.array([n @ anchor, *(stack.spread[k] * n[:2])]) / stack.inverse_depth[k]
    return out


@kernel
def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a x b of two (3,): NumPy's takes twenty times as long."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _other_plane(
    H: FloatArray, normal: FloatArray, anchor: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """(R, τ, n) of the other plane n of the homography H = R + τ n', as far away at the anchor; None where there is but
    one."""
    _, values, rows = np.linalg.svd(H)
    H, values = H / values[1], values / values[1]
    spare, short = values[0] ** 2 - 1.0, 1.0 - values[2] ** 2
    if not (spare > 1e-12 and short > 1e-12):
        return None
    middle = rows[1]
    solutions = []
    for sign in (1.0, -1.0):
        u = (np.sqrt(short) * rows[0] + sign * np.sqrt(spare) * rows[2]) / np.sqrt(spare + short)
        n, seen = _cross(middle, u), np.stack([H @ middle, H @ u])
        R = np.column_stack([*seen, _cross(seen[0], seen[1])]) @ np.stack([middle, u, n])
        solutions.append((abs(float(n @ normal)), R, n))
    _, R, n = min(solutions, key=lambda solution: solution[0])
    if not abs(n @ anchor) > 1e-3:
        return None
    n = n * float(normal @ anchor) / float(n @ anchor)
    return R, (H - R) @ n / float(n @ n), n


def together(one: Settled, other: Settled) -> Settled:
    """The minima of two searches."""
    return Settled(*(np.concatenate(parts) for parts in zip(one, other, strict=True)))


@kernel
def has_likely(costs: FloatArray, inliers: FloatArray) -> bool:
    """Whether one of the minima (K,) is nearly as likely as the best."""
    best, near = 0, 0
    for k in range(len(costs)):
        if costs[k] < costs[best]:
            best = k
    for k in range(len(costs)):
        more = max(inliers[best] - inliers[k], 0.0)
        near += np.isfinite(costs[k]) and costs[k] < costs[best] + LESS_LIKELY + FOR_EACH_MORE * more
    return near > 1


def strongest_rival(found: Reweighted, minima: Settled, information: FloatArray, radius: float) -> Rival | None:
    """The likeliest of the minima that are nearly as likely as what was found and apart from it, far ones first.

    Args:
        information: (6, 6) of what was found.
        radius: of the object.
    """
    if not has_likely(minima.costs, minima.inliers):
        return None
    R, d, _ = found.candidate
    turn = np.empty(3)
    rotvec_of(R, turn)
    size = np.hypot(radius * np.linalg.norm(turn), np.linalg.norm(d))
    best: Rival | None = None
    best_one = int(np.argmin(minima.costs))
    more = np.maximum(minima.inliers[best_one] - minima.inliers, 0.0)
    near = np.isfinite(minima.costs) & (minima.costs < minima.costs[best_one] + LESS_LIKELY + FOR_EACH_MORE * more)
    for k in np.argsort(minima.costs, kind="stable").tolist():
        if not near[k]:
            continue
        step = np.concatenate([np.empty(3), minima.shifts[k] - d])
        rotvec_of(minima.rotations[k] @ R.T, turn)
        step[:3] = turn
        if step @ information @ step > APART:
            far = bool(np.hypot(radius * np.linalg.norm(turn), np.linalg.norm(step[3:])) > UNSEEN_SHARE * size)
            if best is None or (far and not best.far):
                best = Rival(minima.rotations[k], minima.shifts[k], step, far)
    return best
