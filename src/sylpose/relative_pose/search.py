"""The minima of the cost of `moments_cost`: where `descent` comes to from several starts.

The plane part of the cost has no trap at the identity, so that is where the search starts. Few cameras, small turns and
bodies that are seen through leave mirrored minima (each camera alone always has one: the turn's part across its axis
reversed, near and far exchanged), so the mirror images of what was found are tried as well, and the likeliest wins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf, rotation_of, rotvec_of
from sylpose.relative_pose.affine_initialization import FEW, affine_turns
from sylpose.relative_pose.levenberg_marquardt import DAMPING, descend, likelihood, make_room
from sylpose.relative_pose.moments_cost import Sums
from sylpose.relative_pose.terms import Candidate, Guesses, Stack

__all__ = ["Minima", "no_minima", "search", "search_all"]


# Iterations after which a start is looked at, and how far its log-likelihood may then be behind the best. Earlier looks lose
# true motions (measured: creeps in benchmarks/kinds.py, 48 degrees off) (choice).
CHECKED, HOPELESS = 3, 300.0
# A start that has come to a minimum, and is no less likely by more than this, is that minimum (choice).
AS_LIKELY = 60.0
# Steps of the plane part alone, at first and from a mirror image, and what the last may promise; the same of the whole
# cost (choice).
PLANE_STEPS, MIRROR_STEPS, PLANE_SETTLED = 12, 3, 1.0
STEPS, SETTLED = 20, 1e-2
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


@kernel
def search(stack: Stack, sums: Sums, guesses: Guesses, minima: Minima) -> int:
    """Minima from the identity, from its minimum's mirror images and from guesses.

    Args:
        minima: filled with the likeliest, best first; their likelihood is -inf where there are no more.

    Returns:
        number of iterations.
    """
    n, n_guesses = stack.focal.shape[0], guesses.rotations.shape[0]
    candidate, room = Candidate(np.eye(3), np.zeros(3), np.empty((n, 3))), make_room(n)
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
            done, _, _ = descend(stack, sums, True, True, PLANE_STEPS, PLANE_SETTLED, candidate, DAMPING, room)
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
                done, _, _ = descend(stack, sums, True, True, MIRROR_STEPS, PLANE_SETTLED, candidate, DAMPING, room)
                count += done
        elif guess < n_guesses:
            candidate.rotation[:], candidate.shift[:] = guesses.rotations[guess], guesses.shifts[guess]
        else:
            rotation_of(affine[guess - n_guesses], candidate.rotation)
            candidate.shift[:] = base_shift
            done, _, _ = descend(stack, sums, True, True, MIRROR_STEPS, PLANE_SETTLED, candidate, DAMPING, room)
            count += done
        promise, damping, value = np.inf, DAMPING, -np.inf
        near = _known(candidate, minima)
        dropped = near >= 0 and likelihood(stack, sums, candidate, room) > minima.likelihoods[near] - AS_LIKELY
        for k in range(CHECKED):
            if dropped or promise < SETTLED:
                break
            done, promise, damping = descend(stack, sums, True, False, 1, SETTLED, candidate, damping, room)
            count += done
            value = likelihood(stack, sums, candidate, room)
            # On the way to a minimum that is known, or to nowhere: not worth the rest of the way.
            near = _known(candidate, minima)
            dropped = k == CHECKED - 1 and value < minima.likelihoods[0] - HOPELESS
            dropped = dropped or (near >= 0 and value > minima.likelihoods[near] - AS_LIKELY)
        if dropped:
            continue
        if promise >= SETTLED:
            done, _, _ = descend(stack, sums, True, False, STEPS, SETTLED, candidate, damping, room)
            count += done
            value = likelihood(stack, sums, candidate, room)
        if start == 0:
            rotvec_of(candidate.rotation, turn)
            base_shift[:] = candidate.shift
            base_surface[:] = candidate.surface
        if np.isfinite(value):
            _keep(candidate, value, minima)
    return count


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
