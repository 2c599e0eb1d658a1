"""One robust motion for all terms: the front of the compiled solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import forget
from sylpose.geometry.numba_linalg import kernel, median_of
from sylpose.matches import STILL_PX
from sylpose.relative_pose.alternative_solutions import LESS_LIKELY, second_planes, strongest_rival, together
from sylpose.relative_pose.curvature_correction import bend, far_along, is_hardly_seen, less_certain, taken_in
from sylpose.relative_pose.diagnostics import Checks, check, without
from sylpose.relative_pose.fit import MIN_MATCHES, Fit, no_fit
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX, Reweighted, nothing_yet, reweight
from sylpose.relative_pose.match_likelihood import missing
from sylpose.relative_pose.motion_mixture import apart
from sylpose.relative_pose.observability import all_seen, is_consistent, rod_axis, stands_still
from sylpose.relative_pose.robust_fit import Settled, Uniform, fitted
from sylpose.relative_pose.static_background import LARGER, LIKELIER, hidden, parted, some_move
from sylpose.relative_pose.terms import Joined, Stack, TermData, copy_into, guesses_of, stack_terms
from sylpose.results import Status

__all__ = ["FAR_PX", "fit_apart", "fit_terms"]

Hypothesis = tuple[FloatArray, FloatArray]

# Where the moving matches of a camera go further than this, those that stand still are background (choice).
FAR_PX = 6.0
# A solver whose last step was a standard deviation long had not converged: half its square (derived).
CONVERGED = 0.5
# A motion nearby that is nearly as likely is within so many of its own distances (choice: two standard deviations).
DOUBT = 0.5
# Where a motion may be larger by this factor, most of the matches standing still, it is not known (choice).
HARDLY = 3.0
# With fewer inliers, or where it is hardly seen, a motion has to lead to itself (choice).
FEW_INLIERS = 50
# Second planes of flat objects are told apart by more cameras than this (choice).
FEW_CAMERAS = 3


def fit_terms(
    data: Sequence[TermData],
    center: FloatArray,
    radius: float,
    guesses: Sequence[Hypothesis],
    rng: Uniform,
    joined: Joined | None = None,
    least_px: float = 0.0,
) -> Fit:
    """One robust motion for all terms: per-term RANSAC, minima from several starts, re-weighting.

    Args:
        data: T terms with at least one match each.
        center: (3,) g, the object's centre at the motion's start.
        radius: of the object.
        guesses: (R, d) tried as starts besides the built-in ones.
        rng: seeded.
        joined: the terms, where that has been done.
        least_px: noise that is believed at least, pixels.
    """
    if sum(len(term) for term in data) < MIN_MATCHES:
        return no_fit(data, Status.TOO_FEW_MATCHES)
    stack = stack_terms(data, center, radius, joined, least_px)
    usable = np.ones(len(stack.x), dtype=bool)
    _not_background(stack, usable)
    found, minima, iterations, promise = fitted(stack, usable, guesses_of(guesses), rng)
    every = usable.astype(float)
    checks = check(stack, usable, found, every, radius, minima.costs, minima.inliers)
    planes = second_planes(stack, found) if checks.close else []
    if planes:
        again = fitted(stack, usable, guesses_of([*guesses, *((R, d) for R, d, _ in planes)]), rng)
        iterations += again[2]
        minima, best = together(minima, again[1]), again[1].costs.min() < minima.costs.min()
        found, promise = (again[0], again[3]) if best else (found, promise)
        checks = check(stack, usable, found, every, radius, minima.costs, minima.inliers)
    # Where the search ended nowhere there is no motion, whatever it left behind.
    one = found if checks.finite else nothing_yet(stack)
    larger, likelier = hidden(stack, usable, one) if checks.quiet else (1.0, -np.inf)
    part = None
    if likelier > -np.inf and not _all_stand(stack, usable, one):
        part = parted(stack, usable, one, likelier, guesses_of(guesses), rng)
    # A mixture that does not settle says nothing against the one motion.
    part = part if part is not None and part.promise < CONVERGED else None
    if part is not None and not part.gain > LIKELIER:
        minima, part = together(minima, part.rivals(float(minima.costs.min()))), None
        checks = checks._replace(rivalled=True)
    if part is not None:
        standing = float(1.0 - part.moving.mean())
        fit = _answer(data, stack, radius, part.found, part.minima, part.promise, part.moving, usable)
        return replace(
            fit, iterations=int(iterations + part.iterations), standing=standing if fit.status.has_pose else 0.0
        )
    if checks.even or not (checks.certain or is_consistent(stack, usable, found)):
        return no_fit(data, Status.NOT_CONSISTENT)
    fit = _answer(data, stack, radius, found, minima, promise, every, usable, larger, checks)
    return replace(fit, iterations=int(iterations))


def _all_stand(stack: Stack, usable: BoolArray, one: Reweighted) -> bool:
    """Whether a motion may be none, and no match has moved."""
    return bool(one.weights.any()) and stands_still(stack, one, one.information) and not some_move(stack, usable, one)


def fit_apart(
    data: Sequence[TermData], center: FloatArray, radius: float, first: Fit, second: Fit, least_px: float = 0.0
) -> tuple[Fit, FloatArray] | None:
    """The first of two motions of the same terms, about the same centre, it not being certain which match has which; and
    (2, T) how many matches of each term have the one and the other. None where they do not settle.

    Args:
        data, center, radius, least_px: as `fit_terms` takes them.
    """
    stack = stack_terms(data, center, radius, least_px=least_px)
    fits = (first, second)
    both = apart(stack, [(f.rotation, f.shift) for f in fits], [np.concatenate(f.weights) > 0 for f in fits])
    counts = both.having.sum(axis=1)
    if not (both.promise < CONVERGED and counts.min() > MIN_MATCHES):
        return None
    one = both.found[0]
    minima = Settled(one.candidate.rotation[None], one.candidate.shift[None], np.array([both.cost]), counts[:1])
    usable = np.ones(len(stack.x), dtype=bool)
    fit = _answer(data, stack, radius, one, minima, both.promise, both.having[0], usable)
    return replace(fit, iterations=both.iterations), np.add.reduceat(both.having, stack.offsets[:-1], axis=1)


def _answer(
    data: Sequence[TermData],
    stack: Stack,
    radius: float,
    found: Reweighted,
    minima: Settled,
    promise: float,
    having: FloatArray,
    usable: BoolArray,
    larger: float = 1.0,
    checks: Checks | None = None,
) -> Fit:
    """What is said of a motion: how certain it is, whether it is one, what else it may be.

    Args:
        found, minima, promise: of `fitted`, or of a mixture.
        having: (N,) the probability of each match to have the motion, if it is not wrong.
        usable: (N,) matches that may be inliers.
        larger: by how much the motion may be larger (`hidden`).
        checks: of the fit, where it has been asked.
    """
    if checks is None:
        checks = check(stack, usable, found, having, radius, minima.costs, minima.inliers)
    status = Status.OK if checks.inliers >= MIN_MATCHES else Status.NOT_CONSISTENT
    rod = rod_axis(stack, found) if checks.lined else None
    if status is Status.OK and rod is not None:
        again = _least_turned(stack, having, found, rod, float(minima.costs.min()))
        if again is not None:
            found, promise = again
            checks = check(stack, usable, found, having, radius, minima.costs, minima.inliers)
    (rotation, shift, _), _, weights, across, information, *_ = found
    # About a rod the solver circles: that is no failure.
    if status is Status.OK and not ((promise < CONVERGED or rod is not None) and np.isfinite(information).all()):
        status = Status.NOT_CONVERGED
    if status is not Status.OK:
        return no_fit(data, status)
    information, without_depth, still = checks.information, checks.without_depth, checks.still
    if checks.bent or checks.parted:
        bent = bend(stack, having, found, radius)
        if checks.parted:
            lost = checks.known * missing(stack, found, having)
            information, without_depth = without(information, lost, 1.0), without(without_depth, lost, 1.0)
        information, without_depth = less_certain(information, bent), less_certain(without_depth, bent)
        still = stands_still(stack, found, information)
    other = None
    if still:
        if some_move(stack, usable, found) or strongest_rival(found, minima, information, radius) is not None:
            return no_fit(data, Status.MOSTLY_STILL)
        status, rotation, shift, larger = Status.NO_MOTION, np.eye(3), np.zeros(3), LARGER[-1]
    elif larger >= HARDLY:
        return no_fit(data, Status.MOSTLY_STILL)
    elif rod is None:
        # What is not seen, or nobody's, needs no more doubts.
        asked = not (checks.parted or checks.mixed) and all_seen(information, without_depth, rotation, shift, radius)
        hardly, cost = asked and checks.bent and is_hardly_seen(stack, found, radius), float(minima.costs.min())
        if asked:
            others = _led_to(stack, having, found, cost, hardly or checks.inliers < FEW_INLIERS)
            if others is None:
                return no_fit(data, Status.NOT_CONVERGED)
            minima = together(minima, others)
        rival = strongest_rival(found, minima, information, radius)
        if rival is not None and rival.far:
            other = (rival.rotation, rival.shift)
        elif rival is not None:
            column = DOUBT * rival.step[:, None]
            information, without_depth = less_certain(information, column), less_certain(without_depth, column)
        for step, dearer in far_along(stack, having, found, radius, cost) if hardly and other is None else []:
            column = taken_in(information, step, dearer)
            information, without_depth = less_certain(information, column), less_certain(without_depth, column)
    if larger > 1.0:
        # Of a background all, or some, may be: the motion has any size up to this, and fewer matches tell of it.
        column = (larger - 1.0) / np.sqrt(3.0) * np.append(Rotation.from_matrix(rotation).as_rotvec(), shift)[:, None]
        information, without_depth = (less_certain(part / larger**2, column) for part in (information, without_depth))
    if rod is not None:
        information, without_depth = forget(information, rod), forget(without_depth, rod)
    return Fit(
        status,
        rotation,
        shift,
        _split(weights * (having > 0.5) if checks.parted else weights, stack.offsets),
        _split(across, stack.offsets),
        information,
        without_depth,
        0,
        other=other,
        mixed=checks.mixed,
        cost=float(minima.costs.min()),
        at_ease=checks.at_ease and not checks.parted,
    )


def _split(values: FloatArray, offsets: IntArray) -> tuple[FloatArray, ...]:
    """Of each term."""
    ends = offsets.tolist()
    return tuple(values[first:last] for first, last in pairwise(ends))


def _least_turned(
    stack: Stack, usable: FloatArray, found: Reweighted, rod: FloatArray, cost: float
) -> tuple[Reweighted, float] | None:
    """What was found, without the turn about itself of a rod, which may be any, and what its last step promised; None where
    that is not as likely as with it, at this cost."""
    again = nothing_yet(stack)
    copy_into(again.candidate, found.candidate)
    again.sigma_px[:] = found.sigma_px
    turn = Rotation.from_matrix(found.candidate.rotation)
    x, y, z, w = turn.as_quat()
    about = Rotation.from_rotvec(2.0 * np.arctan2(np.dot((x, y, z), rod[:3]), w) * rod[:3])
    again.candidate.rotation[:] = (about.inv() * turn).as_matrix()
    _, promise, cost_again = reweight(stack, usable, again, SIGMA_FLOOR_PX)
    return (again, float(promise)) if cost_again < cost + LESS_LIKELY else None


def _led_to(stack: Stack, having: FloatArray, found: Reweighted, cost: float, itself: bool) -> Settled | None:
    """Where the second planes of few cameras lead to, and the motion itself, with the noise that was found and all else as
    it is believed before anything is measured. None where the motion leads nowhere.

    A motion that does not lead to itself rests on surfaces and weights that chance, or another motion, has left: where it
    leads to is counted as as likely.

    Args:
        having: (N,) the probability of each match to have the motion.
        cost: of what was found.
        itself: whether that is asked.
    """
    starts = second_planes(stack, found) if len(stack.focal) <= FEW_CAMERAS else []
    starts += [found.candidate._replace(surface=stack.surface_mean)] if itself else []
    rotations, shifts = np.empty((len(starts), 3, 3)), np.empty((len(starts), 3))
    costs, inliers = np.empty(len(starts)), np.empty(len(starts))
    for k, start in enumerate(starts):
        again = nothing_yet(stack)
        copy_into(again.candidate, start)
        again.sigma_px[:] = found.sigma_px
        _, _, costs[k] = reweight(stack, having, again, SIGMA_FLOOR_PX)
        rotations[k], shifts[k] = again.candidate.rotation, again.candidate.shift
        inliers[k] = (again.weights > 0.0).sum()
    if itself:
        if not costs[-1] < np.inf:
            return None
        costs[-1] = cost
    # What is likelier than what was found is no more than a rival of it, as others are.
    return Settled(rotations, shifts, np.maximum(costs, cost), inliers)


@kernel
def _not_background(stack: Stack, usable: BoolArray) -> None:
    """usable (N,): matches that may lie on the object. In a camera that sees it move by far, what stands still does not."""
    for t in range(stack.focal.shape[0]):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        moving, count = np.empty(last - first), 0
        for i in range(first, last):
            dx, dy = stack.y[i, 0] - stack.x[i, 0], stack.y[i, 1] - stack.x[i, 1]
            far = np.sqrt(dx * dx + dy * dy) * stack.focal[t]
            usable[i] = far > STILL_PX
            if usable[i]:
                moving[count] = far
                count += 1
        if count == 0 or median_of(moving[:count]) <= FAR_PX:
            usable[first:last] = True
