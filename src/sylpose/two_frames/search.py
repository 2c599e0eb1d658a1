"""The minimum of the cost of `moments_cost`: Levenberg-Marquardt on the motion, the surfaces eliminated term by term.

The plane part of the cost has no trap at the identity, so that is where the search starts. Few cameras, small turns and
bodies that are seen through leave mirrored minima (each camera alone always has one: the turn's part across its axis
reversed, near and far exchanged), so the mirror images of what was found are tried as well, and the likeliest wins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.compiled import cholesky_solve, kernel, leaf, rotation_of, rotvec_of, turn_by
from sylpose.numerics.normal_equations import eliminate
from sylpose.two_frames.affine_turns import FEW, affine_turns
from sylpose.two_frames.moments_cost import Normal, Sums, along_variance_at, equations_at, misfit_at, term_cost
from sylpose.two_frames.term_view import look, scratch
from sylpose.two_frames.terms import Candidate, Guesses, Stack, copy_into

__all__ = ["Minima", "log_likelihood", "minimize", "no_minima", "search", "search_all", "settled"]


# A term whose mean square exceeds the usual one by this factor, or this value, is trusted less while searching (choice).
TRUST = 4.0
# Iterations after which a start is looked at, and how far its log-likelihood may then be behind the best. Earlier looks lose
# true motions (measured: creeps in benchmarks/kinds.py, 48 degrees off) (choice).
CHECKED, HOPELESS = 3, 300.0
# A start that has come to a minimum, and is no less likely by more than this, is that minimum (choice).
AS_LIKELY = 60.0
# Steps of the plane part alone, at first and from a mirror image, and what the last may promise; the same of the whole
# cost (choice).
PLANE_STEPS, MIRROR_STEPS, PLANE_SETTLED = 12, 3, 1.0
STEPS, SETTLED = 20, 1e-2
# Steps that are tried, each damped more, before a start counts as settled, and the largest, radians: as far as the
# derivatives speak of (choice).
TRIES, LONGEST_STEP = 8, 0.5
# Damping at first, and again once a step was in vain (choice).
DAMPING = 1e-4
# Mirror images that are tried, at most, beside the turn reversed (choice).
MIRRORS = 4
# Cameras whose optical axes, or opposite ones, are nearer than this cosine see the same mirror image (choice).
SAME_AXIS = 0.97
# Two minima are one where the squared distance of their rotation matrices, and that of their shifts relative to their
# length, are less: a few thousandths of a radian, some hundredths of the shift (choice).
SAME_TURN, SAME_SHIFT = 2e-5, 1e-3


class Minima(NamedTuple):
    """The K likeliest minima, best first: rotations (K, 3, 3), shifts (K, 3), surfaces (K, T, 3), likelihoods (K,)."""

    rotations: FloatArray
    shifts: FloatArray
    surfaces: FloatArray
    likelihoods: FloatArray


@kernel
def no_minima(keep: int, terms: int) -> Minima:
    """Of so many terms, to be filled."""
    return Minima(np.zeros((keep, 3, 3)), np.zeros((keep, 3)), np.zeros((keep, terms, 3)), np.full(keep, -np.inf))


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


@kernel
def _trusts(costs: FloatArray, moments: FloatArray, trust: FloatArray) -> None:
    """Trust in each term: little where its mean square is far above what is usual among them."""
    n = costs.shape[0]
    squares = np.empty(n)
    for t in range(n):
        squares[t] = 2.0 * costs[t] / max(moments[t, 8, 8], 1.0)
    usual = np.sort(squares)[(n - 1) // 2]
    for t in range(n):
        trust[t] = 1.0 / (1.0 + (squares[t] / (TRUST * (usual + 1.0))) ** 2)


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
    n = stack.focal.shape[0]
    normal, gain = Normal(np.empty((n, 9, 9)), np.empty((n, 9))), np.empty((n, 3, 7))
    kappa, costs, trust = np.zeros(n), np.empty(n), np.ones(n)
    total, right, step = np.empty((6, 6)), np.empty(6), np.empty(6)
    block, kept = np.empty((3, 3)), np.empty((6, 7))
    trial = Candidate(np.empty((3, 3)), np.empty(3), np.empty((n, 3)))
    promise, at = np.inf, scratch()
    for count in range(1, iterations + 1):
        cost = 0.0
        for t in range(n):
            look(stack, t, candidate, at)
            if not plane_only:
                kappa[t], _ = along_variance_at(stack, sums, t, at)
            costs[t] = equations_at(stack, sums, t, kappa[t], candidate.surface[t], at, normal)
        if soft and n > 2:
            _trusts(costs, sums.moments, trust)
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
                step[:] = right
                sound = cholesky_solve(total, step)
            if sound:
                length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
                if length > LONGEST_STEP:
                    step *= LONGEST_STEP / length
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
    """How likely a minimum is, to compare minima by: up to a constant that they share."""
    total, n = 0.0, stack.focal.shape[0]
    squares, at = np.empty(n), scratch()
    for t in range(n):
        variance, count = sums.variance[t], sums.moments[t, 8, 8]
        look(stack, t, candidate, at)
        _, v = along_variance_at(stack, sums, t, at)
        squares[t] = misfit_at(sums, t, at) / variance
        squares[t] += count * np.log(v / (2.0 * variance))
        for j in range(3):
            squares[t] += ((candidate.surface[t, j] - stack.plane_mean[t, j]) / stack.plane_sd[t, j]) ** 2
    # A camera gone wrong must not decide: bounded by a multiple of what is usual per match.
    means = squares.copy()
    for t in range(n):
        means[t] /= sums.moments[t, 8, 8]
    usual = np.sort(means)[(n - 1) // 2]
    for t in range(n):
        bound = TRUST * (max(usual, 0.0) + 1.0) if n > 2 else np.inf
        total += min(means[t], bound) * sums.moments[t, 8, 8]
    return -0.5 * total


@kernel
def search(stack: Stack, sums: Sums, guesses: Guesses, minima: Minima) -> int:
    """Minima from the identity, from its minimum's mirror images and from guesses.

    Args:
        minima: filled with the likeliest, best first; their likelihood is -inf where there are no more.

    Returns:
        number of iterations.
    """
    n, n_guesses = stack.focal.shape[0], guesses.rotations.shape[0]
    candidate = Candidate(np.eye(3), np.zeros(3), np.empty((n, 3)))
    minima.likelihoods[:] = -np.inf
    axes = np.zeros((MIRRORS + 1, 3))
    n_mirrors = _mirror_axes(stack, axes)
    affine = np.zeros((2**FEW, 3))
    n_affine = affine_turns(stack, sums, affine)
    turn, mirrored, base_shift, base_surface = np.zeros(3), np.empty(3), np.zeros(3), np.zeros((n, 3))
    count = 0
    # Each mirror image twice: with near and far exchanged, and after a fresh look at it as a plane.
    for start in range(1 + 2 * n_mirrors + n_guesses + n_affine):
        mirror, guess = (start - 1) // 2, start - 1 - 2 * n_mirrors
        candidate.surface[:] = stack.plane_mean
        if start == 0:
            done, _, _ = minimize(stack, sums, True, True, PLANE_STEPS, PLANE_SETTLED, candidate, DAMPING)
            count += done
        elif guess < 0:
            axis = axes[mirror]
            along = 2.0 * (turn[0] * axis[0] + turn[1] * axis[1] + turn[2] * axis[2])
            for i in range(3):
                mirrored[i] = along * axis[i] - turn[i]
            rotation_of(mirrored, candidate.rotation)
            candidate.shift[:] = base_shift
            if start % 2 == 1:
                for t in range(n):
                    for j in range(1, 3):
                        candidate.surface[t, j] = -base_surface[t, j]
            else:
                done, _, _ = minimize(stack, sums, True, True, MIRROR_STEPS, PLANE_SETTLED, candidate, DAMPING)
                count += done
        elif guess < n_guesses:
            candidate.rotation[:], candidate.shift[:] = guesses.rotations[guess], guesses.shifts[guess]
        else:
            rotation_of(affine[guess - n_guesses], candidate.rotation)
            candidate.shift[:] = base_shift
            done, _, _ = minimize(stack, sums, True, True, MIRROR_STEPS, PLANE_SETTLED, candidate, DAMPING)
            count += done
        promise, damping, value = np.inf, DAMPING, -np.inf
        near = _known(candidate, minima)
        dropped = near >= 0 and log_likelihood(stack, sums, candidate) > minima.likelihoods[near] - AS_LIKELY
        for k in range(CHECKED):
            if dropped or promise < SETTLED:
                break
            done, promise, damping = minimize(stack, sums, True, False, 1, SETTLED, candidate, damping)
            count += done
            value = log_likelihood(stack, sums, candidate)
            # On the way to a minimum that is known, or to nowhere: not worth the rest of the way.
            near = _known(candidate, minima)
            dropped = k == CHECKED - 1 and value < minima.likelihoods[0] - HOPELESS
            dropped = dropped or (near >= 0 and value > minima.likelihoods[near] - AS_LIKELY)
        if dropped:
            continue
        if promise >= SETTLED:
            done, _, _ = minimize(stack, sums, True, False, STEPS, SETTLED, candidate, damping)
            count += done
            value = log_likelihood(stack, sums, candidate)
        if start == 0:
            rotvec_of(candidate.rotation, turn)
            base_shift[:] = candidate.shift
            base_surface[:] = candidate.surface
        if np.isfinite(value):
            _keep(candidate, value, minima)
    return count


def settled(
    stack: Stack, sums: Sums, start: Candidate, iterations: int = 60, tolerance: float = 1e-12
) -> tuple[Candidate, int, float]:
    """`minimize` of the whole cost, all terms trusted, from a start that is left as it is; number of iterations; what the
    last step promised."""
    candidate = start.copied()
    count, promise, _ = minimize(stack, sums, False, False, iterations, tolerance, candidate, DAMPING)
    return candidate, count, promise


def search_all(stack: Stack, sums: Sums, guesses: Guesses, keep: int) -> tuple[list[Candidate], FloatArray, int]:
    """`search`: the minima found, `keep` at most, best first; their log-likelihoods; number of iterations."""
    minima = no_minima(keep, len(stack.focal))
    count = search(stack, sums, guesses, minima)
    found = [Candidate(*parts) for parts in zip(minima.rotations, minima.shifts, minima.surfaces, strict=True)]
    n = int(np.count_nonzero(minima.likelihoods > -np.inf))
    return found[:n], minima.likelihoods[:n], count


@kernel
def _mirror_axes(stack: Stack, axes: FloatArray) -> int:
    """axes become the cameras' optical axes, those that differ and `MIRRORS` at most, and one of zero: the turn reversed."""
    n, count = stack.focal.shape[0], 0
    stride = max(1, n // MIRRORS)
    for t in range(0, n, stride):
        fresh = count < MIRRORS
        for k in range(count):
            dot = 0.0
            for i in range(3):
                dot += axes[k, i] * stack.qx[t, 2, i]
            fresh = fresh and abs(dot) < SAME_AXIS
        if fresh:
            axes[count] = stack.qx[t, 2]
            count += 1
    axes[count] = 0.0
    return count + 1


@kernel
def _keep(candidate: Candidate, value: float, minima: Minima) -> None:
    """Inserts a minimum into the list of the likeliest, unless it is there."""
    rotations, shifts, surfaces, likelihoods = minima
    last = likelihoods.shape[0] - 1
    for k in range(last + 1):
        if likelihoods[k] > -np.inf and _same(rotations[k], shifts[k], candidate.rotation, candidate.shift):
            if value <= likelihoods[k]:
                return
            last = k
            break
    if value <= likelihoods[last]:
        return
    k = last
    while k > 0 and value > likelihoods[k - 1]:
        rotations[k], shifts[k], surfaces[k] = rotations[k - 1], shifts[k - 1], surfaces[k - 1]
        likelihoods[k] = likelihoods[k - 1]
        k -= 1
    rotations[k], shifts[k], surfaces[k] = candidate.rotation, candidate.shift, candidate.surface
    likelihoods[k] = value


@leaf
def _known(candidate: Candidate, minima: Minima) -> int:
    """Which minimum in the list a candidate is; -1 where none."""
    for k in range(minima.likelihoods.shape[0]):
        if minima.likelihoods[k] > -np.inf and _same(
            minima.rotations[k], minima.shifts[k], candidate.rotation, candidate.shift
        ):
            return k
    return -1


@leaf
def _same(r1: FloatArray, d1: FloatArray, r2: FloatArray, d2: FloatArray) -> bool:
    """Whether two minima are one."""
    gap = 0.0
    for i in range(3):
        for j in range(3):
            gap += (r1[i, j] - r2[i, j]) ** 2
    apart = (d1[0] - d2[0]) ** 2 + (d1[1] - d2[1]) ** 2 + (d1[2] - d2[2]) ** 2
    length = d1[0] ** 2 + d1[1] ** 2 + d1[2] ** 2
    return gap < SAME_TURN and apart < SAME_SHIFT * length + 1e-300
