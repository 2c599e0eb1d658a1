"""Re-weighting: a motion, the matches that agree with it and the noise they have, each from the others until they settle.

A match's distance is that of `sylpose.epipolar`, d² = across² / σ² + along² / v: noise across the epipolar line, noise and
relief along it, so that a mismatch that lies on its epipolar line by chance is found out as well. Bisquare weights
of d; σ per term from the weighted residuals themselves, drawn towards that of the whole rig where matches are few.

Source: M-estimators of regression and scale, Huber & Ronchetti, "Robust Statistics", chapters 6 and 7.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sylpose.compiled import kernel
from sylpose.epipolar import along_variance, match_residuals, moments_into
from sylpose.minimize import information_at, minimize, search
from sylpose.robust import hyperplane_inliers
from sylpose.terms import Stack

__all__ = ["robust_fit"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Cutoff of d. With Gaussian noise in both directions d² is chi-squared with two degrees of freedom, for which
# follow: the mean weight, the weighted mean square over the mean weight, and the information that the estimate has
# over what its weights say (A² / B / mean weight of the sandwich, 95 % efficient).
CUTOFF = 5.0
MEAN_WEIGHT, SHRINKAGE, EFFICIENCY = 0.8528, 0.8425, 1.109
# Cutoffs of the first rounds are wider by these factors: the first motion comes from contaminated matches.
WIDER = (2.0, 1.5, 1.2)
# Rounds at least, while the noise level still moves, and at most.
MIN_ROUNDS, MAX_ROUNDS = 6, 25
# A term's σ counts as that of so many matches more that have the rig's.
RIG_MATCHES = 10.0
# Noise is never believed to be less, pixels.
SIGMA_FLOOR_PX = 0.02
# A camera that agrees with the others in fewer of its matches than this is set aside: junk alone reaches about a tenth.
CAMERA_MIN_SHARE = 0.3
# Distance from the affine epipolar constraint that perspective and noise explain.
SEED_PX = 2.0
# Noise of the seeds, pixels: bounds of what is read off their distances from the hyperplane.
SEED_SIGMA_PX = (0.15, 1.5)
# A second hypothesis is refined as well when its log-likelihood comes so near to the first one's.
SECOND_CHANCE = 20.0


@kernel
def reweight(
    stack: Stack,
    usable: BoolArray,
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
    sigma_px: FloatArray,
    weights: FloatArray,
    across: FloatArray,
    along: FloatArray,
    moments: FloatArray,
    spread_px: FloatArray,
) -> tuple[int, float]:
    """From one motion to the one that its inliers agree on, all in place.

    Args:
        usable: (N,) matches that may be inliers.
        rotation: (3, 3), shift: (3,), surface: (T, 3): start, then result.
        sigma_px: (T,) noise assumed at first, pixels; then measured.
        weights: (N,), across: (N,) and along: (N,) residuals in pixels, moments: (T, 9, 9), spread_px: (T,) the standard
            deviation along the epipolar lines: filled.

    Returns:
        iterations of the solver; what its last step promised (`minimize`), infinite where no match agreed.
    """
    n = sigma_px.shape[0]
    variance, v = np.empty(n), np.empty(n)
    iterations = 0
    for t in range(n):
        # Until its matches are weighted a term's relief is what is believed of it.
        variance[t] = (sigma_px[t] / stack.focal[t]) ** 2
        moments[t] = 0.0
        moments[t, 8, 8] = 1e-3
        for a in range(2):
            moments[t, 8, 6 + a] = moments[t, 6 + a, 8] = 1e-3 * stack.anchor[t, a]
    for count in range(MAX_ROUNDS):
        widen = WIDER[count] if count < 3 else 1.0
        for t in range(n):
            first, last = stack.offsets[t], stack.offsets[t + 1]
            _, v[t] = along_variance(moments[t], stack, t, variance[t], rotation, shift, surface[t])
            match_residuals(stack, t, rotation, shift, surface[t], across[first:last], along[first:last])
            for i in range(first, last):
                d2 = (across[i] ** 2 / variance[t] + along[i] ** 2 / v[t]) / (CUTOFF * widen) ** 2
                weights[i] = (1.0 - d2) ** 2 if usable[i] and d2 < 1.0 else 0.0
                across[i] *= stack.focal[t]
                along[i] *= stack.focal[t]
        if count >= 2:
            _set_aside(stack, usable, weights)
            _scale(stack, weights, across, sigma_px)
            for t in range(n):
                variance[t] = (sigma_px[t] / stack.focal[t]) ** 2
        inliers = 0
        for i in range(weights.shape[0]):
            inliers += weights[i] > 0.0
        if inliers == 0:
            return iterations, np.inf
        for t in range(n):
            first, last = stack.offsets[t], stack.offsets[t + 1]
            moments_into(stack.x[first:last], stack.y[first:last], weights[first:last], moments[t])
            if not moments[t, 8, 8] > 0.0:
                moments[t, 8, 8] = 1e-9
        done, promise = minimize(stack, moments, variance, False, False, 3, 1e-4, rotation, shift, surface)
        iterations += done
        # Settled when a round moves the motion by no more than a hundredth of its standard deviation.
        if count + 1 >= MIN_ROUNDS and promise < 1e-4 and done == 1:
            break
    done, promise = minimize(stack, moments, variance, False, False, 30, 1e-12, rotation, shift, surface)
    for t in range(n):
        _, v[t] = along_variance(moments[t], stack, t, variance[t], rotation, shift, surface[t])
        spread_px[t] = stack.focal[t] * np.sqrt(v[t])
    return iterations + done, promise


@kernel
def _scale(stack: Stack, weights: FloatArray, across: FloatArray, sigma_px: FloatArray) -> None:
    """sigma_px (T,) from the weighted residuals."""
    n = sigma_px.shape[0]
    squares, mass, inliers = np.zeros(n), np.zeros(n), 0
    for t in range(n):
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if weights[i] > 0.0:
                squares[t] += weights[i] * across[i] ** 2 / SHRINKAGE
                mass[t] += weights[i]
                inliers += 1
    if inliers == 0:
        return
    # Six unknowns have taken their share of the squares.
    freedom = max(1.0 - 6.0 / inliers, 0.15)
    rig = squares.sum() / mass.sum() / freedom
    for t in range(n):
        square = (squares[t] / freedom + RIG_MATCHES * rig) / (mass[t] + RIG_MATCHES)
        sigma_px[t] = max(np.sqrt(square), SIGMA_FLOOR_PX)


@kernel
def _set_aside(stack: Stack, usable: BoolArray, weights: FloatArray) -> None:
    """Takes the weights from terms that agree in too few of their matches, when others agree in many."""
    n = stack.focal.shape[0]
    share, best = np.ones(n), 0.0
    for t in range(n):
        agree, could = 0, 0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            could += usable[i]
            agree += weights[i] > 0.0
        if could >= 6:
            share[t] = agree / could
            best = max(best, share[t])
    for t in range(n):
        if best >= 2.0 * CAMERA_MIN_SHARE and share[t] < CAMERA_MIN_SHARE:
            for i in range(stack.offsets[t], stack.offsets[t + 1]):
                weights[i] = 0.0


@kernel
def robust_fit(
    stack: Stack,
    usable: BoolArray,
    picks: FloatArray,
    guess_rotations: FloatArray,
    guess_shifts: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    weights: FloatArray,
    across: FloatArray,
    sigma_px: FloatArray,
    spread_px: FloatArray,
    information: FloatArray,
    without_depth: FloatArray,
) -> tuple[int, float]:
    """One robust motion: seeds per term, minima of all seeds together, the best of them re-weighted.

    Args:
        usable: (N,) matches that may be inliers.
        picks: (h, 4) in [0, 1): draw the seeds' quadruples.
        guess_rotations: (G, 3, 3), guess_shifts: (G, 3).
        rotation: (3, 3), shift: (3,), weights: (N,), across: (N,) pixels, sigma_px: (T,), spread_px: (T,) along the line,
            information: (6, 6), without_depth: (6, 6) (`information_at`): filled.

    Returns:
        iterations of the solver; what its last step promised (`minimize`), infinite where there is no fit.
    """
    n, n_matches = stack.focal.shape[0], stack.x.shape[0]
    moments, along, variance = np.empty((n, 9, 9)), np.empty(n_matches), np.empty(n)
    _seed(stack, usable, picks, weights, sigma_px)
    for t in range(n):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        moments_into(stack.x[first:last], stack.y[first:last], weights[first:last], moments[t])
        if not moments[t, 8, 8] > 0.0:
            moments[t, 8, 8] = 1e-9
        variance[t] = (sigma_px[t] / stack.focal[t]) ** 2
    rotations, shifts, surfaces = np.zeros((2, 3, 3)), np.zeros((2, 3)), np.zeros((2, n, 3))
    likelihoods, first_sigma = np.empty(2), sigma_px.copy()
    iterations = search(
        stack, moments, variance, guess_rotations, guess_shifts, rotations, shifts, surfaces, likelihoods
    )
    best, promise = np.inf, np.inf
    weights_, across_ = np.zeros(n_matches), np.empty(n_matches)
    sigma_, spread_ = np.empty(n), np.empty(n)
    for k in range(2):
        if not likelihoods[k] > likelihoods[0] - SECOND_CHANCE:
            continue
        sigma_[:] = first_sigma
        done, last_promise = reweight(
            stack,
            usable,
            rotations[k],
            shifts[k],
            surfaces[k],
            sigma_,
            weights_,
            across_,
            along,
            moments,
            spread_,
        )
        iterations += done
        if not last_promise < np.inf:
            continue
        cost = _misfit(stack, usable, across_, along, sigma_, spread_)
        if cost < best:
            best, promise = cost, last_promise
            rotation[:], shift[:], weights[:], across[:] = rotations[k], shifts[k], weights_, across_
            sigma_px[:], spread_px[:] = sigma_, spread_
            for t in range(n):
                variance[t] = (sigma_px[t] / stack.focal[t]) ** 2
            information_at(stack, moments, variance, rotation, shift, surfaces[k], information, without_depth)
    for i in range(6):
        for j in range(6):
            information[i, j] *= EFFICIENCY
            without_depth[i, j] *= EFFICIENCY
    return iterations, promise


@kernel
def _seed(stack: Stack, usable: BoolArray, picks: FloatArray, weights: FloatArray, sigma_px: FloatArray) -> None:
    """Each term's matches that one motion can explain: weights (N,) of 1 or 0, and their noise (T,)."""
    n, n_matches = stack.focal.shape[0], stack.x.shape[0]
    x, y, index = np.empty((n_matches, 2)), np.empty((n_matches, 2)), np.empty(n_matches, np.int64)
    mine = np.empty(n_matches)
    lower, upper = SEED_SIGMA_PX
    usual, known = 0.0, 0
    for t in range(n):
        count = 0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            weights[i] = 0.0
            if usable[i]:
                x[count, 0], x[count, 1] = stack.x[i, 0], stack.x[i, 1]
                y[count, 0], y[count, 1] = stack.y[i, 0], stack.y[i, 1]
                index[count] = i
                count += 1
        rms = hyperplane_inliers(x[:count], y[:count], SEED_PX / stack.focal[t], picks, mine[:count])
        kept = 0
        for k in range(count):
            weights[index[k]] = mine[k]
            kept += mine[k] > 0.0
        sigma_px[t] = 0.0
        if kept >= 8:
            # The hyperplane spans both frames' coordinates, as Sampson's distance does.
            sigma_px[t] = min(max(rms * stack.focal[t], lower), upper)
            usual += sigma_px[t]
            known += 1
    for t in range(n):
        if sigma_px[t] == 0.0:
            sigma_px[t] = usual / known if known > 0 else 1.0


@kernel
def _misfit(
    stack: Stack, usable: BoolArray, across: FloatArray, along: FloatArray, sigma_px: FloatArray, spread_px: FloatArray
) -> float:
    """Negative log-likelihood of all usable matches: a Gaussian of inliers, or anywhere in the object's image."""
    total = 0.0
    for t in range(stack.focal.shape[0]):
        area = np.log((4.0 * stack.spread[t] * stack.focal[t]) ** 2)
        density = np.log(2.0 * np.pi * sigma_px[t] * spread_px[t])
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if usable[i]:
                d2 = (across[i] / sigma_px[t]) ** 2 + (along[i] / spread_px[t]) ** 2
                total += min(0.5 * d2 + density, max(area, density))
    return total
