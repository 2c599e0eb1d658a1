"""What can be said of a motion that was found: more than chance or not, no motion at all, a rod, what of it was not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.matrices import covariance_of
from sylpose.geometry.normal_equations import eliminate
from sylpose.geometry.numba_linalg import kernel, rotvec_of, symmetric_eigen
from sylpose.geometry.observability import UNSEEN_SHARE, about_a_turn, unseen_directions
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.relative_pose.fit import Fit
from sylpose.relative_pose.irls import CUTOFF, Reweighted
from sylpose.relative_pose.match_cost import Tolerance, matched
from sylpose.relative_pose.terms import Stack
from sylpose.results import Status

__all__ = [
    "CERTAIN_SHARE",
    "all_seen",
    "is_consistent",
    "judged",
    "more_than_chance",
    "observed",
    "on_lines",
    "rod_axis",
    "stands_still",
    "unseen",
]


# What no motion at all must cost more, of six unknowns, and a turn, of three: below it, there may be none (chi-squared, once
# in a thousand times).
CERTAIN_MOTION, CERTAIN_TURN = chi_squared_bound(6), chi_squared_bound(3)
# Points that depart from a line by no more than this, in standard deviations of their noise, lie on it (choice).
ROD_SIGMAS = 2.5
# And so do those that depart from it by no more than this, where it is so many times as long: the depth of so thin a thing
# hardly shows, and what it says of a turn about itself is how much its sides are believed to slope (choice).
THIN_SIGMAS, THIN = 9.0, 10.0
# So large a share of inliers is not had by chance (choice).
CERTAIN_SHARE = 0.7
# Inliers that an answer has by choice, per unknown, and how many times what one has by chance the best of many has (choice).
CHOSEN, LUCKY = 2, 4.0
# Times that partners are exchanged to measure chance, at most, and with how many matches once or twice will do (choice).
EXCHANGES, EXCHANGED = 8, 1000


def observed(fit: Fit, radius: float) -> Fit:
    """The fit with its status set to what its information shows: all of it seen, or the scale, or a turn not."""
    return judged(fit, radius)[0]


def judged(fit: Fit, radius: float) -> tuple[Fit, FloatArray]:
    """`observed`, and the directions (k, 6) that its status is about."""
    if fit.status not in (Status.OK, Status.NOT_CERTIFIED):
        return fit, np.empty((0, 6))
    if all_seen(fit.information, fit.information_without_depth, fit.rotation, fit.shift, radius):
        return fit, np.empty((0, 6))
    directions = unseen(fit, radius)
    if len(directions) == 0:
        return fit, directions
    turn = about_a_turn(directions * ([radius] * 3 + [1.0] * 3))
    return replace(fit, status=Status.TURN_NOT_OBSERVABLE if turn else Status.SCALE_NOT_OBSERVABLE), directions


@kernel
def all_seen(
    information: FloatArray, without_depth: FloatArray, rotation: FloatArray, shift: FloatArray, radius: float
) -> bool:
    """Whether `unseen` finds nothing, as a rule: for a fraction of its time; False where it is to be asked."""
    turn, scaled, values, vectors = np.empty(3), np.empty((6, 6)), np.empty(6), np.empty((6, 6))
    rotvec_of(rotation, turn)
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    length = np.sqrt(shift[0] ** 2 + shift[1] ** 2 + shift[2] ** 2)
    limit = UNSEEN_SHARE * np.hypot(radius * angle, length)
    for i in range(6):
        for j in range(6):
            scaled[i, j] = without_depth[i, j] * limit * limit
            scaled[i, j] /= (radius if i < 3 else 1.0) * (radius if j < 3 else 1.0)
    symmetric_eigen(scaled, values, vectors)
    if not values[0] > 1.0 + 1e-9:
        return False
    if not length > radius * angle:
        return True
    # What is known of the turn, whatever the displacement.
    block, coupled, kept = np.empty((3, 3)), np.zeros((3, 4)), np.zeros((3, 4))
    for i in range(3):
        for j in range(3):
            block[i, j], coupled[i, j], kept[i, j] = information[3 + i, 3 + j], information[3 + i, j], information[i, j]
    if not eliminate(block, coupled, kept):
        return False
    known = 0.0
    for i in range(3):
        for j in range(3):
            known += turn[i] * kept[i, j] * turn[j]
    return known > CERTAIN_TURN * (1.0 + 1e-6)


def unseen(fit: Fit, radius: float) -> FloatArray:
    """The directions (k, 6) of (w, d) that the matches leave open, whatever is believed of the object's distance.

    A turn moves the object's surface by radius times angle, a displacement by its length: in that measure, rows are
    orthonormal, and a direction is open when its standard deviation exceeds half of the motion itself
    (`UNSEEN_SHARE`): even the sign of what it adds is then in doubt. A displacement without a turn has no observable
    length; a turn that is mere noise must not pretend to one.
    """
    scale = np.array([1.0 / radius] * 3 + [1.0] * 3)
    turn, length = np.empty(3), float(np.linalg.norm(fit.shift))
    rotvec_of(fit.rotation, turn)
    size = np.hypot(radius * np.linalg.norm(turn), length)
    weak = unseen_directions(fit.information_without_depth, UNSEEN_SHARE * size * scale)
    if len(weak) == 0 and length > radius * np.linalg.norm(turn):
        of_turn = np.linalg.inv(covariance_of(fit.information)[:3, :3])
        if turn @ of_turn @ turn < CERTAIN_TURN:
            weak = np.concatenate([np.zeros(3), fit.shift / length])[None]
    return np.asarray(weak * scale)


def more_than_chance(inliers: float, by_chance: float, unknowns: int) -> bool:
    """Whether so many inliers are more than a wrong answer would have.

    The best of many hypotheses finds more of them than any one has by chance, hence the factor; as many as there are
    unknowns it can always satisfy, and as many again by choice.
    """
    return inliers > CHOSEN * unknowns + LUCKY * by_chance


def is_consistent(stack: Stack, usable: BoolArray, found: Reweighted) -> bool:
    """Whether more matches agree with the fit than would by chance.

    Chance is measured: with the partners exchanged among a camera's matches, those that still agree do so by chance.
    """
    weights = found.weights
    inliers, total = int((weights > 0).sum()), int(usable.sum())
    if inliers >= CERTAIN_SHARE * total:
        return True
    exchanges = min(EXCHANGES, 1 + EXCHANGED // total)
    by_chance, candidate = 0.0, found.candidate._replace(surface=stack.surface_mean)
    for k in range(1, exchanges + 1):
        y = stack.y.copy()
        for first, last in zip(stack.offsets, stack.offsets[1:], strict=False):
            index = first + np.flatnonzero(usable[first:last])
            # By far, since neighbours in the list may be neighbours in the image, or the same match again.
            y[index] = np.roll(y[index], k * max(1, len(index) // (exchanges + 1)), axis=0)
        mixed, agree = stack._replace(y=y), np.zeros(len(y))
        for t, (first, last) in enumerate(zip(stack.offsets, stack.offsets[1:], strict=False)):
            # What is set aside, and a match that cannot be exchanged with another, tells nothing.
            if not (weights[first:last] > 0).any() or usable[first:last].sum() <= k:
                continue
            variance, relief = (found.sigma_px[t] / stack.focal[t]) ** 2, stack.relief[t]
            tolerance = Tolerance(variance, relief, relief, CUTOFF)
            agree[first:last] = matched(mixed, t, candidate, tolerance, usable, noise=False)[0].weights
        other = usable & (y != stack.y).any(axis=1)
        by_chance += float((agree[other] > 0.0).sum()) * total / max(int(other.sum()), 1) / exchanges
    return more_than_chance(inliers, by_chance, 6)


@kernel
def stands_still(stack: Stack, found: Reweighted, information: FloatArray) -> bool:
    """Whether the motion found may be none: it is no further from none than chance takes it, by its own information
    (Wald's test), and none explains the inliers about as well.

    The second asks what the first cannot: a turn that the cameras hardly see has little information and moves the
    matches all the same. Of a match's two coordinates the fit leaves one; the other, along its epipolar line, is counted as
    if it were all noise.
    """
    motion, far = np.empty(6), 0.0
    rotvec_of(found.candidate.rotation, motion[:3])
    motion[3:] = found.candidate.shift
    for i in range(6):
        for j in range(6):
            far += motion[i] * information[i, j] * motion[j]
    if far >= CERTAIN_MOTION:
        return False
    dearer = 0.0
    for t in range(stack.focal.shape[0]):
        sigma_px = found.sigma_px[t]
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            dx, dy = stack.y[i, 0] - stack.x[i, 0], stack.y[i, 1] - stack.x[i, 1]
            stood = 0.5 * (dx * dx + dy * dy) * (stack.focal[t] / sigma_px) ** 2
            if found.weights[i] > 0.0:
                dearer += found.weights[i] * (stood - (found.across[i] / sigma_px) ** 2 - 1.0)
    return dearer < CERTAIN_MOTION


def rod_axis(stack: Stack, found: Reweighted) -> FloatArray | None:
    """(6,) the turn about itself, of points that lie on one line in every camera up to noise; else None.

    Noise across the line, with the surface bent to fit it, would pass for structure that shows this turn.
    """
    normals = np.zeros((3, 3))
    if not on_lines(stack, found.weights, found.sigma_px, normals):
        return None
    return np.concatenate([np.linalg.eigh(normals)[1][:, 0], np.zeros(3)])


@kernel
def on_lines(stack: Stack, weights: FloatArray, sigma_px: FloatArray, normals: FloatArray) -> bool:
    """Whether all terms' inliers lie on lines in both images; normals (3, 3) becomes the sum of n n' over the planes through
    the current cameras and those lines.
    """
    lined, inliers = 0, 0
    for t in range(stack.focal.shape[0]):
        for frame in range(2):
            points = stack.y if frame == 1 else stack.x
            n, mx, my, xx, xy, yy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(stack.offsets[t], stack.offsets[t + 1]):
                if weights[i] > 0.0:
                    n += 1
                    mx += points[i, 0]
                    my += points[i, 1]
            inliers += n
            # Two points always lie on a line.
            if n < 3:
                continue
            lined += n
            mx, my = mx / n, my / n
            for i in range(stack.offsets[t], stack.offsets[t + 1]):
                if weights[i] > 0.0:
                    dx, dy = points[i, 0] - mx, points[i, 1] - my
                    xx += dx * dx / (n - 1)
                    xy += dx * dy / (n - 1)
                    yy += dy * dy / (n - 1)
            # The smaller eigenvalue of the points' covariance.
            least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
            noise, most = (sigma_px[t] / stack.focal[t]) ** 2, xx + yy - least
            thin = least <= THIN_SIGMAS**2 * noise and most > THIN**2 * least
            if least > ROD_SIGMAS**2 * noise and not thin:
                return False
            if frame == 1:
                angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
                a, b = -np.sin(angle), np.cos(angle)
                normal = np.empty(3)
                for k in range(3):
                    normal[k] = a * stack.qy[t, 0, k] + b * stack.qy[t, 1, k] - (a * mx + b * my) * stack.qy[t, 2, k]
                length = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
                for k in range(3):
                    for j in range(3):
                        normals[k, j] += normal[k] * normal[j] / length
    return lined > inliers // 2
