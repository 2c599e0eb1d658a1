"""Multi-start search for the minima of `moments_cost`.

The planar part of the cost has no local minimum near the identity, so the search starts there. Few cameras, small
rotations and transparent bodies cause mirrored minima. Each camera alone always has one: the rotation component across
its axis reversed, near and far exchanged. Mirror images of the first minimum are therefore tried as well, and the
likeliest wins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf, so3_exp, so3_log
from sylpose.relative_pose.affine_initialization import N_AFFINE_TERMS, estimate_affine_rotations
from sylpose.relative_pose.levenberg_marquardt import (
    INITIAL_DAMPING,
    descend,
    evaluate_log_likelihood,
    make_descent_workspace,
)
from sylpose.relative_pose.moments_cost import MomentSums
from sylpose.relative_pose.terms import Candidate, InitialMotions, Stack

__all__ = ["Minima", "find_minima", "make_minima", "search_minima"]


# Iterations after which a start is checked, and how far its log-likelihood may then be behind the best. Earlier checks
# lose true motions (measured: creeps in benchmarks/kinds.py, 48 degrees off) (choice).
CHECK_ITERATIONS, MAX_LIKELIHOOD_GAP = 3, 300.0
# A start near a known minimum whose log-likelihood is at most this much lower converges to that minimum (choice).
SAME_MINIMUM_GAP = 60.0
# Steps of the planar part alone, at first and from a mirror image, and the predicted decrease at convergence; the same
# for the full cost (choice).
PLANE_STEPS, MIRROR_STEPS, PLANE_TOLERANCE = 12, 3, 1.0
MAX_STEPS, TOLERANCE = 20, 1e-2
# Maximum number of mirror images, in addition to the reversed rotation (choice).
MAX_MIRRORS = 4
# Cameras whose optical axes, up to sign, have a larger cosine share the same mirror image (choice).
SAME_AXIS_COSINE = 0.97
# Two minima are the same if the squared distance of their rotation matrices, and that of their translations relative to
# the squared length, are below these: a few thousandths of a radian, some hundredths of the translation (choice).
SAME_ROTATION, SAME_TRANSLATION = 2e-5, 1e-3


class Minima(NamedTuple):
    """The K likeliest minima, best first.

    Attributes:
        rotations: (K, 3, 3).
        translations: (K, 3).
        depth_models: (K, T, 3) planar depth models.
        likelihoods: (K,) log-likelihoods, -inf for unused entries.
    """

    rotations: FloatArray
    translations: FloatArray
    depth_models: FloatArray
    likelihoods: FloatArray


@kernel
def make_minima(max_minima: int, terms: int) -> Minima:
    """Allocate `max_minima` minima for the given number of terms."""
    return Minima(
        np.zeros((max_minima, 3, 3)),
        np.zeros((max_minima, 3)),
        np.zeros((max_minima, terms, 3)),
        np.full(max_minima, -np.inf),
    )


@kernel
def search_minima(stack: Stack, sums: MomentSums, guesses: InitialMotions, minima: Minima) -> int:
    """Find minima from the identity, from the mirror images of its minimum and from initial motions.

    Args:
        minima: receives the likeliest, best first; unused entries have a likelihood of -inf.

    Returns:
        number of iterations.
    """
    n, n_guesses = stack.focal.shape[0], guesses.rotations.shape[0]
    candidate, workspace = Candidate(np.eye(3), np.zeros(3), np.empty((n, 3))), make_descent_workspace(n)
    minima.likelihoods[:] = -np.inf
    axes = np.zeros((MAX_MIRRORS + 1, 3))
    n_mirrors = _find_mirror_axes(stack, axes)
    affine_rotvecs = np.zeros((2**N_AFFINE_TERMS, 3))
    n_affine = estimate_affine_rotations(stack, sums, affine_rotvecs)
    rotvec, mirrored_rotvec, first_translation, first_depth_model = (
        np.zeros(3),
        np.empty(3),
        np.zeros(3),
        np.zeros((n, 3)),
    )
    count = 0
    # Try each mirror image twice: with near and far exchanged, and after steps with the planar part alone.
    for start in range(1 + 2 * n_mirrors + n_guesses + n_affine):
        mirror, guess = (start - 1) // 2, start - 1 - 2 * n_mirrors
        candidate.depth_model[:] = stack.plane_mean
        if start == 0:
            done, _, _ = descend(
                stack, sums, True, True, PLANE_STEPS, PLANE_TOLERANCE, candidate, INITIAL_DAMPING, workspace
            )
            count += done
        elif guess < 0:
            axis = axes[mirror]
            along = 2.0 * (rotvec[0] * axis[0] + rotvec[1] * axis[1] + rotvec[2] * axis[2])
            for i in range(3):
                mirrored_rotvec[i] = along * axis[i] - rotvec[i]
            so3_exp(mirrored_rotvec, candidate.rotation)
            candidate.translation[:] = first_translation
            if start % 2 == 1:
                for t in range(n):
                    for j in range(1, 3):
                        candidate.depth_model[t, j] = -first_depth_model[t, j]
            else:
                done, _, _ = descend(
                    stack, sums, True, True, MIRROR_STEPS, PLANE_TOLERANCE, candidate, INITIAL_DAMPING, workspace
                )
                count += done
        elif guess < n_guesses:
            candidate.rotation[:], candidate.translation[:] = guesses.rotations[guess], guesses.translations[guess]
        else:
            so3_exp(affine_rotvecs[guess - n_guesses], candidate.rotation)
            candidate.translation[:] = first_translation
            done, _, _ = descend(
                stack, sums, True, True, MIRROR_STEPS, PLANE_TOLERANCE, candidate, INITIAL_DAMPING, workspace
            )
            count += done
        decrease, damping, value = np.inf, INITIAL_DAMPING, -np.inf
        nearest = _find_same_minimum(candidate, minima)
        dropped = (
            nearest >= 0
            and evaluate_log_likelihood(stack, sums, candidate, workspace)
            > minima.likelihoods[nearest] - SAME_MINIMUM_GAP
        )
        for k in range(CHECK_ITERATIONS):
            if dropped or decrease < TOLERANCE:
                break
            done, decrease, damping = descend(stack, sums, True, False, 1, TOLERANCE, candidate, damping, workspace)
            count += done
            value = evaluate_log_likelihood(stack, sums, candidate, workspace)
            # Stop a start that approaches a known minimum or is far behind the best.
            nearest = _find_same_minimum(candidate, minima)
            dropped = k == CHECK_ITERATIONS - 1 and value < minima.likelihoods[0] - MAX_LIKELIHOOD_GAP
            dropped = dropped or (nearest >= 0 and value > minima.likelihoods[nearest] - SAME_MINIMUM_GAP)
        if dropped:
            continue
        if decrease >= TOLERANCE:
            done, _, _ = descend(stack, sums, True, False, MAX_STEPS, TOLERANCE, candidate, damping, workspace)
            count += done
            value = evaluate_log_likelihood(stack, sums, candidate, workspace)
        if start == 0:
            so3_log(candidate.rotation, rotvec)
            first_translation[:] = candidate.translation
            first_depth_model[:] = candidate.depth_model
        if np.isfinite(value):
            _insert_minimum(candidate, value, minima)
    return count


def find_minima(
    stack: Stack, sums: MomentSums, guesses: InitialMotions, max_minima: int
) -> tuple[list[Candidate], FloatArray, int]:
    """Run `search_minima` with newly allocated arrays.

    Returns:
        the minima, at most `max_minima`, best first; their log-likelihoods; number of iterations.
    """
    minima = make_minima(max_minima, len(stack.focal))
    count = search_minima(stack, sums, guesses, minima)
    candidates = [
        Candidate(*parts) for parts in zip(minima.rotations, minima.translations, minima.depth_models, strict=True)
    ]
    n = int(np.count_nonzero(minima.likelihoods > -np.inf))
    return candidates[:n], minima.likelihoods[:n], count


@kernel
def _find_mirror_axes(stack: Stack, axes: FloatArray) -> int:
    """Set axes to the distinct optical axes of the cameras, at most `MAX_MIRRORS`.

    A zero row for the reversed rotation is appended.

    Returns:
        number of axes.
    """
    n, count = stack.focal.shape[0], 0
    stride = max(1, n // MAX_MIRRORS)
    for t in range(0, n, stride):
        is_new = count < MAX_MIRRORS
        for k in range(count):
            dot = 0.0
            for i in range(3):
                dot += axes[k, i] * stack.qx[t, 2, i]
            is_new = is_new and abs(dot) < SAME_AXIS_COSINE
        if is_new:
            axes[count] = stack.qx[t, 2]
            count += 1
    axes[count] = 0.0
    return count + 1


@kernel
def _insert_minimum(candidate: Candidate, value: float, minima: Minima) -> None:
    """Insert a minimum into the sorted list unless it is a duplicate."""
    rotations, translations, depth_models, likelihoods = minima
    last = likelihoods.shape[0] - 1
    for k in range(last + 1):
        if likelihoods[k] > -np.inf and _is_same_motion(
            rotations[k], translations[k], candidate.rotation, candidate.translation
        ):
            if value <= likelihoods[k]:
                return
            last = k
            break
    if value <= likelihoods[last]:
        return
    k = last
    while k > 0 and value > likelihoods[k - 1]:
        rotations[k], translations[k], depth_models[k] = rotations[k - 1], translations[k - 1], depth_models[k - 1]
        likelihoods[k] = likelihoods[k - 1]
        k -= 1
    rotations[k], translations[k], depth_models[k] = candidate.rotation, candidate.translation, candidate.depth_model
    likelihoods[k] = value


@leaf
def _find_same_minimum(candidate: Candidate, minima: Minima) -> int:
    """Return the index of the minimum that equals a candidate, or -1."""
    for k in range(minima.likelihoods.shape[0]):
        if minima.likelihoods[k] > -np.inf and _is_same_motion(
            minima.rotations[k], minima.translations[k], candidate.rotation, candidate.translation
        ):
            return k
    return -1


@leaf
def _is_same_motion(r1: FloatArray, d1: FloatArray, r2: FloatArray, d2: FloatArray) -> bool:
    """Return whether two minima are the same motion."""
    gap = 0.0
    for i in range(3):
        for j in range(3):
            gap += (r1[i, j] - r2[i, j]) ** 2
    distance = (d1[0] - d2[0]) ** 2 + (d1[1] - d2[1]) ** 2 + (d1[2] - d2[2]) ** 2
    length = d1[0] ** 2 + d1[1] ** 2 + d1[2] ** 2
    return gap < SAME_ROTATION and distance < SAME_TRANSLATION * length + 1e-300
