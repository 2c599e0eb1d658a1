"""The minimum of the cost of `moments_cost`: Levenberg-Marquardt on the motion, the surfaces eliminated term by term.

The plane part of the cost has no trap at the identity, so that is where the search starts. Few cameras, small turns and
bodies that are seen through leave mirrored minima (each camera alone always has one: the turn's part across its axis
reversed, near and far exchanged), so the mirror images of what was found are tried as well, and the likeliest wins.
"""

from __future__ import annotations

import numpy as np

from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.compiled import cholesky_solve, kernel, rotation_of, rotvec_of, turn_by
from sylpose.numerics.normal_equations import eliminate
from sylpose.two_frames.moments_cost import along_variance, term_equations, term_misfit
from sylpose.two_frames.terms import Stack

__all__ = ["log_likelihood", "minimize", "search"]


# A term whose mean square exceeds the usual one by this factor, or this value, is trusted less while searching.
TRUST = 4.0
# Iterations after which a start is looked at, and how far its log-likelihood may then be behind the best.
CHECKED = 3
HOPELESS = 300.0
# Mirror images that are tried, at most, beside the turn reversed.
MIRRORS = 4


@kernel
def _reduce(
    hessian: FloatArray,
    gradient: FloatArray,
    damping: float,
    trust: float,
    gain: FloatArray,
    total: FloatArray,
    right: FloatArray,
) -> bool:
    """Adds a term's normal equations, its surface eliminated, to total (6, 6) and to right (6,), the negative gradient.

    gain (3, 7) becomes the surface's answer: α changes by -(gain[:, 6] + gain[:, :6] (w, d)).
    """
    block, kept = np.empty((3, 3)), np.empty((6, 7))
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
    moments: FloatArray,
    variance: FloatArray,
    soft: bool,
    plane_only: bool,
    iterations: int,
    tolerance: float,
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
) -> tuple[int, float]:
    """Levenberg-Marquardt from one start, which becomes the minimum in place.

    Args:
        moments: (T, 9, 9), each with a positive count.
        variance: (T,) σ² per term, normalised units.
        soft: whether terms that fit much worse than the others are trusted less.
        plane_only: leaves the epipolar part out (κ = 0), as it must be near the identity with parallax not yet explained.
        iterations: bound on their number.
        tolerance: settled when a step promises to lower the cost by less than this: half the square of the step's length in
            standard deviations of the motion.
        rotation: (3, 3), shift: (3,), surface: (T, 3): from the start to the minimum.

    Returns:
        number of iterations; what the last step promised, below `tolerance` where it settled.
    """
    n = moments.shape[0]
    hessian, gradient, gain = np.empty((n, 9, 9)), np.empty((n, 9)), np.empty((n, 3, 7))
    kappa, costs, trust = np.zeros(n), np.empty(n), np.ones(n)
    total, right, step = np.empty((6, 6)), np.empty(6), np.empty(6)
    rotation_, shift_, surface_ = np.empty((3, 3)), np.empty(3), np.empty((n, 3))
    damping, promise = 1e-4, np.inf
    for count in range(1, iterations + 1):
        cost = 0.0
        for t in range(n):
            if not plane_only:
                kappa[t], _ = along_variance(moments[t], stack, t, variance[t], rotation, shift, surface[t])
            costs[t] = term_equations(
                moments[t], stack, t, variance[t], kappa[t], rotation, shift, surface[t], hessian[t], gradient[t], True
            )
        if soft and n > 2:
            _trusts(costs, moments, trust)
        for t in range(n):
            cost += trust[t] * costs[t]
        taken = False
        for _ in range(8):
            total[:] = 0.0
            right[:] = 0.0
            sound = True
            for t in range(n):
                sound = sound and _reduce(hessian[t], gradient[t], damping, trust[t], gain[t], total, right)
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
                if length > 0.5:  # as far as the derivatives speak of
                    step *= 0.5 / length
                turn_by(step[:3], rotation, rotation_)
                promise = 0.0
                for i in range(3):
                    shift_[i] = shift[i] + step[3 + i]
                for i in range(6):
                    promise += 0.5 * step[i] * right[i]
                new = 0.0
                for t in range(n):
                    for i in range(3):
                        surface_[t, i] = surface[t, i] - gain[t, i, 6]
                        promise += 0.5 * trust[t] * gain[t, i, 6] * gradient[t, 6 + i]
                        for k in range(6):
                            surface_[t, i] -= gain[t, i, k] * step[k]
                    new += trust[t] * term_equations(
                        moments[t],
                        stack,
                        t,
                        variance[t],
                        kappa[t],
                        rotation_,
                        shift_,
                        surface_[t],
                        hessian[t],
                        gradient[t],
                        False,
                    )
                if new <= cost * (1.0 + 1e-12):
                    taken = True
                    break
            damping = max(10.0 * damping, 1e-4)
        if not taken:
            return count, promise
        rotation[:], shift[:], surface[:] = rotation_, shift_, surface_
        damping = max(0.1 * damping, 1e-9)
        if promise < tolerance:
            return count, promise
    return iterations, promise


@kernel
def log_likelihood(
    stack: Stack,
    moments: FloatArray,
    variance: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
) -> float:
    """How likely a minimum is, to compare minima by: up to a constant that they share."""
    total, n = 0.0, moments.shape[0]
    squares = np.empty(n)
    for t in range(n):
        _, v = along_variance(moments[t], stack, t, variance[t], rotation, shift, surface[t])
        squares[t] = term_misfit(moments[t], stack, t, rotation, shift) / variance[t]
        squares[t] += moments[t, 8, 8] * np.log(v / (2.0 * variance[t]))
        for j in range(3):
            squares[t] += ((surface[t, j] - stack.plane_mean[t, j]) / stack.plane_sd[t, j]) ** 2
    # A camera gone wrong must not decide: bounded by a multiple of what is usual per match.
    means = squares.copy()
    for t in range(n):
        means[t] /= moments[t, 8, 8]
    usual = np.sort(means)[(n - 1) // 2]
    for t in range(n):
        bound = TRUST * (max(usual, 0.0) + 1.0) if n > 2 else np.inf
        total += min(means[t], bound) * moments[t, 8, 8]
    return -0.5 * total


@kernel
def search(
    stack: Stack,
    moments: FloatArray,
    variance: FloatArray,
    guess_rotations: FloatArray,
    guess_shifts: FloatArray,
    rotations: FloatArray,
    shifts: FloatArray,
    surfaces: FloatArray,
    likelihoods: FloatArray,
) -> int:
    """Minima from the identity, from its minimum's mirror images and from guesses.

    Args:
        guess_rotations: (G, 3, 3) and guess_shifts: (G, 3).
        rotations: (K, 3, 3), shifts: (K, 3), surfaces: (K, T, 3), likelihoods: (K,): filled with the K likeliest minima,
            best first; -inf where there are no more.

    Returns:
        number of iterations.
    """
    n, n_guesses = moments.shape[0], guess_rotations.shape[0]
    rotation, shift, surface = np.eye(3), np.zeros(3), np.empty((n, 3))
    likelihoods[:] = -np.inf
    axes = np.zeros((MIRRORS + 1, 3))
    n_mirrors = _mirror_axes(stack, axes)
    turn, mirrored, base_shift, base_surface = np.zeros(3), np.empty(3), np.zeros(3), np.zeros((n, 3))
    count = 0
    # Each mirror image twice: with near and far exchanged, and after a fresh look at it as a plane.
    for start in range(1 + 2 * n_mirrors + n_guesses):
        mirror, guess = (start - 1) // 2, start - 1 - 2 * n_mirrors
        surface[:] = stack.plane_mean
        if start == 0:
            done, _ = minimize(stack, moments, variance, True, True, 12, 1.0, rotation, shift, surface)
            count += done
        elif guess < 0:
            axis = axes[mirror]
            along = 2.0 * (turn[0] * axis[0] + turn[1] * axis[1] + turn[2] * axis[2])
            for i in range(3):
                mirrored[i] = along * axis[i] - turn[i]
            rotation_of(mirrored, rotation)
            shift[:] = base_shift
            if start % 2 == 1:
                for t in range(n):
                    surface[t, 1], surface[t, 2] = -base_surface[t, 1], -base_surface[t, 2]
            else:
                done, _ = minimize(stack, moments, variance, True, True, 3, 1.0, rotation, shift, surface)
                count += done
        else:
            rotation[:], shift[:] = guess_rotations[guess], guess_shifts[guess]
        done, promise = minimize(stack, moments, variance, True, False, CHECKED, 1e-2, rotation, shift, surface)
        count += done
        value = log_likelihood(stack, moments, variance, rotation, shift, surface)
        # On the way to a minimum that is known, or to nowhere: not worth the rest of the way.
        if start > 0 and (value < likelihoods[0] - HOPELESS or _known(rotation, shift, rotations, shifts, likelihoods)):
            continue
        if promise >= 1e-2:
            done, _ = minimize(stack, moments, variance, True, False, 20, 1e-2, rotation, shift, surface)
            count += done
            value = log_likelihood(stack, moments, variance, rotation, shift, surface)
        if start == 0:
            rotvec_of(rotation, turn)
            base_shift[:] = shift
            base_surface[:] = surface
        if np.isfinite(value):
            _keep(rotation, shift, surface, value, rotations, shifts, surfaces, likelihoods)
    return count


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
            # Opposite cameras see the same mirror image.
            fresh = fresh and abs(dot) < 0.97
        if fresh:
            axes[count] = stack.qx[t, 2]
            count += 1
    axes[count] = 0.0
    return count + 1


@kernel
def _keep(
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
    value: float,
    rotations: FloatArray,
    shifts: FloatArray,
    surfaces: FloatArray,
    likelihoods: FloatArray,
) -> None:
    """Inserts a minimum into the list of the likeliest, unless it is there."""
    last = likelihoods.shape[0] - 1
    for k in range(last + 1):
        if likelihoods[k] > -np.inf and _same(rotations[k], shifts[k], rotation, shift):
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
    rotations[k], shifts[k], surfaces[k] = rotation, shift, surface
    likelihoods[k] = value


@kernel
def _known(
    rotation: FloatArray, shift: FloatArray, rotations: FloatArray, shifts: FloatArray, likelihoods: FloatArray
) -> bool:
    """Whether a minimum is in the list."""
    for k in range(likelihoods.shape[0]):
        if likelihoods[k] > -np.inf and _same(rotations[k], shifts[k], rotation, shift):
            return True
    return False


@kernel
def _same(r1: FloatArray, d1: FloatArray, r2: FloatArray, d2: FloatArray) -> bool:
    """Whether two minima are one: a few thousandths of a radian and of the shift apart at most."""
    gap = 0.0
    for i in range(3):
        for j in range(3):
            gap += (r1[i, j] - r2[i, j]) ** 2
    apart = (d1[0] - d2[0]) ** 2 + (d1[1] - d2[1]) ** 2 + (d1[2] - d2[2]) ** 2
    length = d1[0] ** 2 + d1[1] ** 2 + d1[2] ** 2
    return gap < 2e-5 and apart < 1e-3 * length + 1e-300
