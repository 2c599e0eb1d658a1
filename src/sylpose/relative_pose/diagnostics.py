"""What is asked of every fit, in one go: as a rule the answers are the usual ones, and nothing more need be asked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel, symmetric_eigen
from sylpose.relative_pose.alternative_solutions import are_close, has_likely
from sylpose.relative_pose.camera_inconsistency import at_ease
from sylpose.relative_pose.curvature_correction import unless_straight
from sylpose.relative_pose.irls import Reweighted, spread_evenly
from sylpose.relative_pose.motion_mixture import alike, is_mixed
from sylpose.relative_pose.observability import CERTAIN_SHARE, on_lines, stands_still
from sylpose.relative_pose.static_background import may_stand
from sylpose.relative_pose.terms import Stack

__all__ = ["Checks", "check", "without"]


class Checks(NamedTuple):
    """Of a fit.

    Attributes:
        inliers: how many.
        finite: whether the search has ended somewhere.
        certain: whether so many of the matches that may be inliers are not by chance (`is_consistent`).
        even: whether the inliers are spread evenly rather than as noise is: chosen by what is held to be noise.
        close: whether the cameras are close together (`second_planes`).
        quiet: whether a background may be among the matches (`hidden`).
        lined: whether they lie on lines (`on_lines`).
        parted: whether it is not certain of some whether they have the motion.
        bent: whether the valley of the cost may be (`bend`).
        still: whether the motion may be none, if the valley is straight (`stands_still`).
        rivalled: whether another minimum is nearly as likely (`has_likely`).
        mixed: whether neighbours are off alike (`alike`).
        at_ease: whether no camera is strained (`strain`).
        known: the share of the information that is left as noise is estimated, too: the covariance is that of Student's
            distribution.
        information, without_depth: (6, 6) that share, less what noise alone puts there.
    """

    inliers: int
    finite: bool
    certain: bool
    even: bool
    close: bool
    quiet: bool
    lined: bool
    parted: bool
    bent: bool
    still: bool
    rivalled: bool
    mixed: bool
    at_ease: bool
    known: float
    information: FloatArray
    without_depth: FloatArray


@kernel
def check(
    stack: Stack,
    usable: BoolArray,
    found: Reweighted,
    having: FloatArray,
    radius: float,
    costs: FloatArray,
    counts: FloatArray,
) -> Checks:
    """Of a fit that was found.

    Args:
        usable: (N,) matches that may be inliers.
        having: (N,) the probability of each match to have the motion, if it is not wrong.
        radius: of the object.
        costs, counts: (K,) of the minima that were refined, and their numbers of inliers.
    """
    inliers, could, parted, finite = 0, 0, False, True
    for i in range(6):
        finite = finite and (i > 2 or np.isfinite(found.candidate.shift[i % 3]))
        for j in range(6):
            finite = finite and np.isfinite(found.information[i, j])
    for i in range(len(having)):
        could += usable[i]
        inliers += found.weights[i] > 0.0
        parted = parted or (having[i] > 0.0 and having[i] < 1.0)
    freedom = max(inliers - 6, 1)
    known = max(freedom - 2, 1) / freedom
    information = known * without(found.information, found.noise, 2.0)
    without_depth = known * without(found.without_depth, found.noise, 2.0)
    bent = unless_straight(found, radius) > 0.0
    unsure = bent or parted
    mixed = is_mixed(*alike(stack, found), unsure)
    return Checks(
        inliers,
        finite,
        inliers >= CERTAIN_SHARE * could,
        not parted and spread_evenly(found.weights),
        are_close(stack.a2),
        may_stand(stack, usable),
        on_lines(stack, found.weights, found.sigma_px, np.zeros((3, 3))),
        parted,
        bent,
        stands_still(stack, found, information),
        has_likely(costs, counts),
        mixed,
        at_ease(stack.x, stack.y, stack.offsets, found.weights, found.across, stack.focal),
        known,
        information,
        without_depth,
    )


@kernel
def without(information: FloatArray, part: FloatArray, power: float) -> FloatArray:
    """Information (6, 6) less a part (6, 6) that tells nothing.

    With both as quadratic forms in axes where the information is the identity: 1 - ν of each axis is left, to the power.
    Of what noise put there the second: the sandwich H J'J^-1 H of M-estimation with H = J'J - noise. A trace always stays.
    """
    n, largest = information.shape[0], 0.0
    for i in range(n):
        largest = max(largest, information[i, i])
    if not largest > 1e-100:
        return information.copy()
    unit, values = np.empty(n), np.empty(n)
    scaled, vectors, axes = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        unit[i] = 1.0 / np.sqrt(max(information[i, i], 1e-12 * largest))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * unit[i] * unit[j]
    symmetric_eigen(scaled, values, vectors)
    root = np.sqrt(np.maximum(values, 1e-14 * values[n - 1]))
    # The part in axes where the information is the identity.
    for i in range(n):
        for k in range(n):
            axes[i, k] = 0.0
            for j in range(n):
                axes[i, k] += part[i, j] * unit[j] * vectors[j, k] / root[k]
    for k in range(n):
        for m in range(n):
            scaled[k, m] = 0.0
            for i in range(n):
                scaled[k, m] += unit[i] * vectors[i, k] / root[k] * axes[i, m]
    symmetric_eigen(scaled, values, axes)
    half, out = np.empty((n, n)), np.empty((n, n))
    for m in range(n):
        left = min(max(1.0 - values[m], 1e-3), 1.0) ** (0.5 * power)
        for i in range(n):
            half[i, m] = 0.0
            for k in range(n):
                half[i, m] += vectors[i, k] * root[k] / unit[i] * axes[k, m] * left
    for i in range(n):
        for j in range(i + 1):
            out[i, j] = 0.0
            for m in range(n):
                out[i, j] += half[i, m] * half[j, m]
            out[j, i] = out[i, j]
    return out
