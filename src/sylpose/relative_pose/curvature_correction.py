"""What a covariance lacks where the cost is a bent valley: cameras close together, slides, little turns.

A covariance is of a cost that is quadratic. Where something is hardly seen, the length of a slide as a rule, the matches
put the motion in a narrow valley of the cost, and a valley that is bent: going along it by a standard deviation leads away
from the straight line by more than the valley is wide, and the valley may be flatter there. So the motion is displaced by a
standard deviation along each direction that is hardly seen, both ways, and settles across it: the way from the line to where
it comes to rest, and how much less it is drawn back than a quadratic cost would have it, become uncertainty.

All that is for the noise and relief that were found, which another motion may have otherwise: where the object is hardly
seen to have relief, say, every motion has its own. So along the direction that is least seen the motion is displaced by far
more, and all but that way is fitted again. Where that is about as likely, the covariance takes it in.

Source: second-order terms of a profile likelihood, Bates & Watts, "Nonlinear Regression Analysis", chapter 7; their use here
is ours (docs/method.md).
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky, cholesky_solve, kernel, rotvec_of, solve_factored, turn_by
from sylpose.relative_pose.irls import (
    CUTOFF,
    FIRM,
    INDEPENDENT,
    SIGMA_FLOOR_PX,
    Reweighted,
    nothing_yet,
    reweight_held,
)
from sylpose.relative_pose.match_cost import Matched, Tolerance, Usable, match_equations, no_equations
from sylpose.relative_pose.schur import make_room, reduce_term, surface_prior
from sylpose.relative_pose.terms import ROUNDING, SURFACE, Candidate, Stack, copy_into, take_step

__all__ = ["bend", "far_along", "is_hardly_seen", "less_certain", "settle_across", "taken_in", "unless_straight"]

# A direction is followed where its variance, over the size of the motion and the least standard deviation, exceeds this: the
# bend that a valley has whose direction changes by as much as the motion does (choice).
BENT = 0.25
# ... and where it is less sure than this share of the motion: surer ones are straight (choice).
SURE = 0.05
# Directions that are followed, at most, and steps across the valley (choice).
FOLLOWED, STEPS = 3, 4
# ... of which none is taken where the last promised to lower the cost by less than this: a seventh of a standard deviation
# (choice).
SETTLED_ACROSS = 1e-2
# A bend is no longer than this, of the way along (choice).
LONGEST_BEND = 0.5
# The largest step and by how much the valley may be flatter, as shares of the motion and of its curvature (choice).
LONGEST, FLATTEST = 1.0, 0.05
# The mean fourth power of a normal variable: what the bend at a standard deviation comes to in variance (derived).
FOURTH = 3.0
# Where a direction is less sure than this share of the motion, it is hardly seen (measured: half of 2,952 answers that have
# a direction to follow are, with 58 of 68 wrong and sure ones; of 800 usual answers 26 are).
HARDLY_SEEN = 0.08
# So many standard deviations are far. What is there is taken in as if it were no farther than the second, since likelihoods
# are trusted to so much (choice) ...
FAR, NEAR = 6.0, 3.0
# ... where the covariance is too small for it by more than this (measured: where all is taken in, the mean square of errors
# in their own standard deviations before two cameras is 3.9, with this 4.1, without any 4.4; 6 is right).
TOO_SMALL = 4.0


def bend(stack: Stack, usable: Usable, found: Reweighted, radius: float) -> FloatArray:
    """(6, m) columns F, F F' is the covariance of (w, d) that a straight valley lacks; m is 0 where the valley is straight.

    Args:
        usable: (N,) matches that may be inliers.
        found: what `reweight` came to.
        radius: of the object: a turn moves its surface by radius times angle.
    """
    scale = np.array([1.0 / radius] * 3 + [1.0] * 3)
    size, sd, vectors = _ways(stack, found, radius, scale)
    columns: list[FloatArray] = []
    for k in range(min(len(sd), FOLLOWED)):
        length = min(float(sd[k]), LONGEST * size)
        along, off = scale * vectors[:, k], np.empty((2, 6))
        drawn = 0.0
        for way in range(2):
            force = settle_across(stack, usable, found, (1 - 2 * way) * length * along, vectors[:, k] / scale, off[way])
            if not np.isfinite(force):
                return np.column_stack([*columns, sd[k] * along])
            # A bend is small beside the way; what is not has come to another minimum.
            far = float(np.linalg.norm(off[way] / scale))
            off[way] *= min(1.0, LONGEST_BEND * length / max(far, 1e-300))
            drawn += 0.5 * max(force * float(sd[k]) ** 2 / length, 0.0)
        columns += [np.sqrt(0.5 * FOURTH) * off[0], np.sqrt(0.5 * FOURTH) * off[1]]
        if drawn < 1.0:
            columns.append(sd[k] * np.sqrt(1.0 / max(drawn, FLATTEST) - 1.0) * along)
    return np.column_stack(columns) if columns else np.empty((6, 0))


def is_hardly_seen(stack: Stack, found: Reweighted, radius: float) -> bool:
    """Whether some direction of the motion is."""
    size, sd, _ = _ways(stack, found, radius, np.array([1.0 / radius] * 3 + [1.0] * 3))
    return bool(len(sd) > 0 and sd[0] > HARDLY_SEEN * size)


def far_along(
    stack: Stack, usable: Usable, found: Reweighted, radius: float, cost: float
) -> list[tuple[FloatArray, float]]:
    """Where the motion comes to, (w, d) from where it is, displaced far along the direction that is least seen, both ways,
    and all but that fitted again; and by how much that is less likely, logarithm.

    Args:
        usable, found, radius: as `bend` takes them.
        cost: of what was found (`reweight`).
    """
    scale = np.array([1.0 / radius] * 3 + [1.0] * 3)
    size, sd, vectors = _ways(stack, found, radius, scale)
    if len(sd) == 0:
        return []
    along, held = scale * vectors[:, 0], vectors[:, 0] / scale
    held /= np.linalg.norm(held)
    out = []
    for length in (-min(FAR * float(sd[0]), LONGEST * size), min(FAR * float(sd[0]), LONGEST * size)):
        again = nothing_yet(stack)
        copy_into(again.candidate, found.candidate)
        turn_by(length * along[:3], found.candidate.rotation, again.candidate.rotation)
        again.candidate.shift[:] += length * along[3:]
        again.sigma_px[:] = found.sigma_px
        _, _, cost_there = reweight_held(stack, usable, again, SIGMA_FLOOR_PX, held)
        if np.isfinite(cost_there):
            step = np.append(np.empty(3), again.candidate.shift - found.candidate.shift)
            rotvec_of(again.candidate.rotation @ found.candidate.rotation.T, step[:3])
            out.append((step, float(cost_there) - cost))
    return out


def taken_in(information: FloatArray, step: FloatArray, dearer: float) -> FloatArray:
    """(6, m) a column that makes the covariance of (w, d) take in what is a step (6,) away and less likely by `dearer`,
    logarithm; m is 0 where it is not much too small for that."""
    square, most = float(step @ information @ step), max(2.0 * dearer, NEAR**2)
    return step[:, None] * np.sqrt(1.0 / most - 1.0 / square) if square > TOO_SMALL * most else np.empty((6, 0))


def _ways(stack: Stack, found: Reweighted, radius: float, scale: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """The directions that are hardly seen.

    Args:
        scale: (6,) units of (w, d).

    Returns:
        the size of the motion; (k,) standard deviations, largest first; (6, 6) the directions, as columns.
    """
    size, nothing = unless_straight(found, radius), (0.0, np.empty(0), np.empty((6, 6)))
    if not size > 0:
        return nothing
    values, vectors = np.linalg.eigh(found.information * np.outer(scale, scale))
    # Of cameras in one place all lengths are open alike, and that valley is straight.
    apart = np.ptp(stack.a1, axis=0).max() > ROUNDING * np.abs(stack.a1).max()
    if not (values[-1] > 0 and apart):
        return nothing
    sd = 1.0 / np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    return size, sd[(sd**2 > BENT * size * sd[-1]) & (sd > SURE * size)], vectors


@kernel
def unless_straight(found: Reweighted, radius: float) -> float:
    """The size of the motion; 0 where no direction can be one that is followed, which is so as a rule: the sum of all
    variances is too small for one of them."""
    scaled, column, variance = np.empty((6, 6)), np.empty(6), 0.0
    known, size = 0.0, 0.0
    rotvec_of(found.candidate.rotation, column[:3])
    for i in range(3):
        size += (radius * column[i]) ** 2 + found.candidate.shift[i] ** 2
    size = np.sqrt(size)
    for i in range(6):
        for j in range(6):
            scaled[i, j] = found.information[i, j] / ((radius if i < 3 else 1.0) * (radius if j < 3 else 1.0))
        known += scaled[i, i]
    if not cholesky(scaled):
        return float(size)
    for i in range(6):
        column[:] = 0.0
        column[i] = 1.0
        solve_factored(scaled, column)
        variance += column[i]
    followed = variance > BENT * size / np.sqrt(known) and variance > (SURE * size) ** 2
    return float(size) if followed else 0.0


def less_certain(information: FloatArray, columns: FloatArray) -> FloatArray:
    """The information (6, 6) of a covariance that has grown by F F', F (6, m): defined where it is singular, too."""
    if columns.shape[1] == 0:
        return information
    known = information @ columns
    inner = np.eye(columns.shape[1]) + columns.T @ known
    try:
        less = information - known @ np.linalg.solve(inner, known.T)
    except np.linalg.LinAlgError:  # grown beyond all numbers: nothing is known
        return np.zeros_like(information)
    return np.asarray(0.5 * (less + less.T))


@kernel
def settle_across(
    stack: Stack, usable: Usable, found: Reweighted, start: FloatArray, held: FloatArray, off: FloatArray
) -> float:
    """The motion displaced by start (6,) settles across the valley, held' (w, d) being held.

    Args:
        off: (6,) becomes by how much it came away from where it was put.

    Returns:
        how much it is drawn back, the derivative of the cost along the way it was displaced; infinite without an end.
    """
    n, n_matches = stack.focal.shape[0], stack.x.shape[0]
    candidate, place = Candidate(np.empty((3, 3)), np.empty(3), np.empty((n, SURFACE))), found.place.copy()
    copy_into(candidate, found.candidate)
    matches = Matched(
        np.empty(n_matches), np.empty(n_matches), np.empty(n_matches), np.empty(n_matches), np.empty(n_matches)
    )
    equations, gains, prior = no_equations(False, False), np.zeros((n, SURFACE, 8)), np.empty((SURFACE, SURFACE))
    total, right, step, room = np.empty((7, 7)), np.empty(7), np.zeros(7), make_room()
    step[:6] = start
    # The surfaces follow in the first step.
    take_step(candidate, place, step, gains, 1.0)
    size, settled = 0.0, False
    for count in range(STEPS + 1):
        total[:], right[:] = 0.0, 0.0
        total[6, 6], right[6] = 1.0, -place[0]
        for t in range(n):
            mass = 0.0
            for i in range(stack.offsets[t], stack.offsets[t + 1]):
                mass += found.weights[i]
            gains[t] = 0.0
            if not mass > 0.0:
                continue
            relief = found.relief[t]
            shared = relief * np.sqrt(max(1.0, mass / INDEPENDENT))
            tolerance = Tolerance((found.sigma_px[t] / stack.focal[t]) ** 2, relief, shared, CUTOFF)
            match_equations(stack, t, usable, candidate, tolerance, matches, equations)
            surface_prior(stack, t, candidate.surface[t], place[0], prior)
            if not reduce_term(
                stack, t, candidate.surface[t], place[0], prior, equations, total, right, gains[t], room
            ):
                return np.inf
        if settled or count == STEPS:
            break
        for i in range(6):
            size = max(size, total[i, i])
        for i in range(6):
            for j in range(6):
                total[i, j] += FIRM * held[i] * held[j] * size
        for i in range(7):
            total[i, i] *= 1.0 + 1e-9
        step[:] = right
        if not cholesky_solve(total, step):
            return np.inf
        take_step(candidate, place, step, gains, 1.0)
        promise = 0.0
        for i in range(7):
            promise += 0.5 * right[i] * step[i]
        settled = promise < SETTLED_ACROSS
    turned = candidate.rotation @ found.candidate.rotation.T
    rotvec_of(turned, off[:3])
    for i in range(3):
        off[i] -= start[i]
        off[3 + i] = candidate.shift[i] - found.candidate.shift[i] - start[3 + i]
    force, length = 0.0, 0.0
    for i in range(6):
        force -= right[i] * start[i]
        length += held[i] * start[i]
    return float(force / abs(length))
