"""Steps down the cost of `moments_cost`: Levenberg-Marquardt on the motion, the surfaces eliminated term by term."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import eliminate
from sylpose.geometry.numba_linalg import cholesky_solve, kernel, leaf, turn_by
from sylpose.relative_pose.moments_cost import Normal, Sums, along_variance_at, equations_at, misfit_at, term_cost
from sylpose.relative_pose.plane_projection import Scratch, look, scratch
from sylpose.relative_pose.terms import Candidate, Stack, copy_into

__all__ = ["DAMPING", "Room", "descend", "likelihood", "log_likelihood", "make_room", "minimize", "settled"]


# A term whose mean square exceeds the usual one by this factor, or this value, is trusted less while searching (choice).
TRUST = 4.0
# Steps that are tried, each damped more, before a start counts as settled, and the largest, radians: as far as the
# derivatives speak of (choice).
TRIES, LONGEST_STEP = 8, 0.5
# Damping at first, and again once a step was in vain (choice).
DAMPING = 1e-4


@leaf
def _reduce(
    normal: Normal,
    t: int,
    damping: float,
    trust: float,
    gain: FloatArray,
    block: FloatArray,
    kept: FloatArray,
    total: FloatArray,
    right: FloatArray,
) -> bool:
    """Adds term t's normal equations, its surface eliminated, to total (6, 6) and to right (6,), the negative gradient.

    gain (3, 7) becomes the surface's answer: α changes by -(gain[:, 6] + gain[:, :6] (w, d)). block (3, 3) and kept (6, 7)
    are room.
    """
    hessian, gradient = normal.hessian[t], normal.gradient[t]
    for k in range(3):
        for j in range(6):
            gain[k, j] = hessian[6 + k, j]
        for j in range(3):
            block[k, j] = hessian[6 + k, 6 + j]
        block[k, k] *= 1.0 + damping
        gain[k, 6] = gradient[6 + k]
    for i in range(6):
        for j in range(6):
            kept[i, j] = hessian[i, j]
        kept[i, 6] = gradient[i]
    if not eliminate(block, gain, kept):
        return False
    for i in range(6):
        right[i] -= trust * kept[i, 6]
        for j in range(6):
            total[i, j] += trust * kept[i, j]
    return True


class Room(NamedTuple):
    """For the steps of a search over T terms, taken once: normal equations and their surfaces' answers (T, 3, 7), κ, costs,
    trusts and their room (T,), the joint equations (6, 6), (6,), a step (6,), a surface's block (3, 3), what is kept of it
    (6, 7), a candidate, and room for one term."""

    normal: Normal
    gain: FloatArray
    kappa: FloatArray
    costs: FloatArray
    trust: FloatArray
    squares: FloatArray
    total: FloatArray
    right: FloatArray
    step: FloatArray
    block: FloatArray
    kept: FloatArray
    trial: Candidate
    at: Scratch


@kernel
def make_room(n: int) -> Room:
    """Of so many terms, empty."""
    return Room(
        Normal(np.empty((n, 9, 9)), np.empty((n, 9))),
        np.empty((n, 3, 7)),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty((6, 6)),
        np.empty(6),
        np.empty(6),
        np.empty((3, 3)),
        np.empty((6, 7)),
        Candidate(np.empty((3, 3)), np.empty(3), np.empty((n, 3))),
        scratch(),
    )


@leaf
def _usual(values: FloatArray) -> float:
    """The middle one of values (n,), the lesser of two; their order is lost."""
    n = values.shape[0]
    for i in range(1, n):
        value, k = values[i], i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return float(values[(n - 1) // 2])


@leaf
def _trusts(costs: FloatArray, moments: FloatArray, trust: FloatArray, squares: FloatArray) -> None:
    """Trust in each term: little where its mean square is far above what is usual among them."""
    n = costs.shape[0]
    for t in range(n):
        squares[t] = trust[t] = 2.0 * costs[t] / max(moments[t, 8, 8], 1.0)
    usual = _usual(squares)
    for t in range(n):
        trust[t] = 1.0 / (1.0 + (trust[t] / (TRUST * (usual + 1.0))) ** 2)


@kernel
def minimize(
    stack: Stack,
    sums: Sums,
    soft: bool,
    plane_only: bool,
    iterations: int,
    tolerance: float,
    candidate: Candidate,
    damping: float,
) -> tuple[int, float, float]:
    """`descend`, with room of its own."""
    room = make_room(stack.focal.shape[0])
    return descend(stack, sums, soft, plane_only, iterations, tolerance, candidate, damping, room)


@leaf
def descend(
    stack: Stack,
    sums: Sums,
    soft: bool,
    plane_only: bool,
    iterations: int,
    tolerance: float,
    candidate: Candidate,
    damping: float,
    room: Room,
) -> tuple[int, float, float]:
    """Levenberg-Marquardt from one start, which becomes the minimum in place.

    Args:
        soft: whether terms that fit much worse than the others are trusted less.
        plane_only: leaves the epipolar part out (κ = 0), as it must be near the identity with parallax not yet explained.
        iterations: bound on their number.
        tolerance: settled when a step promises to lower the cost by less than this: half the square of the step's length in
            standard deviations of the motion.
        candidate: from the start to the minimum.
        damping: of the first step.

    Returns:
        number of iterations; what the last step promised, below `tolerance` where it settled; the damping to go on with.
    """
    n, promise = stack.focal.shape[0], np.inf
    normal, gain, kappa, costs, trust, squares, total, right, step, block, kept, trial, at = room
    kappa[:] = 0.0
    trust[:] = 1.0
    for count in range(1, iterations + 1):
        cost = 0.0
        for t in range(n):
            look(stack, t, candidate, at)
            if not plane_only:
                kappa[t], _ = along_variance_at(stack, sums, t, at)
            costs[t] = equations_at(stack, sums, t, kappa[t], candidate.surface[t], at, normal)
        if soft and n > 2:
            _trusts(costs, sums.moments, trust, squares)
        for t in range(n):
            cost += trust[t] * costs[t]
        taken = False
        for _ in range(TRIES):
            total[:] = 0.0
            right[:] = 0.0
            sound = True
            for t in range(n):
                sound = sound and _reduce(normal, t, damping, trust[t], gain[t], block, kept, total, right)
            if sound:
                # Turns and shifts have different units: each block is damped by its own trace.
                turns, shifts = total[0, 0] + total[1, 1] + total[2, 2], total[3, 3] + total[4, 4] + total[5, 5]
                for i in range(3):
                    total[i, i] += (damping + 1e-12) * turns
                    total[3 + i, 3 + i] += (damping + 1e-12) * shifts
                for i in range(6):
                    step[i] = right[i]
                sound = cholesky_solve(total, step)
            if sound:
                length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
                if length > LONGEST_STEP:
                    for i in range(6):
                        step[i] *= LONGEST_STEP / length
                turn_by(step[:3], candidate.rotation, trial.rotation)
                promise = 0.0
                for i in range(3):
                    trial.shift[i] = candidate.shift[i] + step[3 + i]
                for i in range(6):
                    promise += 0.5 * step[i] * right[i]
                new = 0.0
                for t in range(n):
                    for i in range(3):
                        trial.surface[t, i] = candidate.surface[t, i] - gain[t, i, 6]
                        promise += 0.5 * trust[t] * gain[t, i, 6] * normal.gradient[t, 6 + i]
                        for k in range(6):
                            trial.surface[t, i] -= gain[t, i, k] * step[k]
                    new += trust[t] * term_cost(stack, sums, t, kappa[t], trial, at)
                if new <= cost * (1.0 + 1e-12):
                    taken = True
                    break
            damping = max(10.0 * damping, DAMPING)
        if not taken:
            return count, promise, damping
        copy_into(candidate, trial)
        damping = max(0.1 * damping, 1e-9)
        if promise < tolerance:
            return count, promise, damping
    return iterations, promise, damping


@kernel
def log_likelihood(stack: Stack, sums: Sums, candidate: Candidate) -> float:
    """`likelihood`, with room of its own."""
    return likelihood(stack, sums, candidate, make_room(stack.focal.shape[0]))


@leaf
def likelihood(stack: Stack, sums: Sums, candidate: Candidate, room: Room) -> float:
    """How likely a minimum is, to compare minima by: up to a constant that they share."""
    total, n = 0.0, stack.focal.shape[0]
    means, squares, at = room.costs, room.squares, room.at
    for t in range(n):
        variance, count = sums.variance[t], sums.moments[t, 8, 8]
        look(stack, t, candidate, at)
        _, v = along_variance_at(stack, sums, t, at)
        square = misfit_at(sums, t, at) / variance
        square += count * np.log(v / (2.0 * variance))
        for j in range(3):
            square += ((candidate.surface[t, j] - stack.plane_mean[t, j]) / stack.plane_sd[t, j]) ** 2
        # A camera gone wrong must not decide: bounded by a multiple of what is usual per match.
        means[t] = squares[t] = square / count
    usual = _usual(squares)
    for t in range(n):
        bound = TRUST * (max(usual, 0.0) + 1.0) if n > 2 else np.inf
        total += min(means[t], bound) * sums.moments[t, 8, 8]
    return -0.5 * total


def settled(
    stack: Stack, sums: Sums, start: Candidate, iterations: int = 60, tolerance: float = 1e-12
) -> tuple[Candidate, int, float]:
    """`minimize` of the whole cost, all terms trusted, from a start that is left as it is; number of iterations; what the
    last step promised."""
    candidate = start.copied()
    count, promise, _ = minimize(stack, sums, False, False, iterations, tolerance, candidate, DAMPING)
    return candidate, count, promise
