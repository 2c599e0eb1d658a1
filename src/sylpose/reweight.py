"""Re-weighting: a motion, the matches that agree with it and the noise they have, each from the others until they settle.

Here every match counts by itself, in full perspective. Its feature lies on the ray x at the inverse depth ρ of the term's
surface, a quadric whose six coefficients α are unknown beside the motion, give or take a relief ζ. With
e = y - image(R x + ρ τ) and J its derivatives,

    V = σ² (I + Jx Jx') + ζ² Jρ Jρ',      d² = e' V^-1 e

so d² is chi-squared with two degrees of freedom whatever the parallax: where it is below the noise both coordinates of a
match measure the motion, where it is large only the one across its epipolar line does. A mismatch that lies on that
line by chance is found out as well. V is held fixed within a step (quasi-likelihood); weights are bisquare in d; σ comes
from the weighted residuals across the lines, per term but drawn towards that of the rig; ζ from those along them.

Source: M-estimators of regression and scale, Huber & Ronchetti, "Robust Statistics", chapters 6 and 7; errors in variables
by linearised covariance, Hartley & Zisserman, section 5.2; the quasi-likelihood, docs/method.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sylpose.compiled import cholesky_solve, kernel, turn_by
from sylpose.epipolar import moments_into, view_of
from sylpose.minimize import search
from sylpose.robust import hyperplane_inliers
from sylpose.terms import SURFACE, Stack

__all__ = ["match_equations", "reweight", "robust_fit"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Cutoff of d. With Gaussian noise in both directions d² is chi-squared with two degrees of freedom, for which
# follow: the weighted mean square over the mean weight, and the information that the estimate has over what its
# weights say (A² / B / mean weight of the sandwich, 95 % efficient).
CUTOFF = 5.0
SHRINKAGE, EFFICIENCY = 0.8425, 1.109
# Cutoffs of the first rounds are wider by these factors: the first motion comes from contaminated matches.
WIDER = (2.0, 1.5, 1.2)
# Rounds at least, while the noise level still moves, and at most.
MIN_ROUNDS, MAX_ROUNDS = 6, 40
# Settled when a step promises to lower the cost by less than this: a hundredth of a standard deviation.
SETTLED = 1e-4
# A term's σ counts as that of so many matches more that have the rig's.
RIG_MATCHES = 10.0
# Noise is never believed to be less, pixels.
SIGMA_FLOOR_PX = 0.02
# Fitting α to noise makes the parallax, and so the motion, look larger than it is. Integrating α out of the likelihood
# instead takes that back where surfaces are as curved as is believed, and too much of it where they are flatter: this share
# of it lies between, and is hardly worse than either at its best (docs/benchmarks.md).
INTEGRATED = 0.5
# Neighbours have like relief: of all a term's matches only so many are independent of each other in it.
INDEPENDENT = 20.0
# A camera that agrees with the others in fewer of its matches than this is set aside: junk alone reaches about a tenth.
CAMERA_MIN_SHARE = 0.3
# Distance from the affine epipolar constraint that perspective and noise explain.
SEED_PX = 2.0
# Noise of the seeds, pixels: bounds of what is read off their distances from the hyperplane.
SEED_SIGMA_PX = (0.15, 1.5)
# A second hypothesis is refined as well when its log-likelihood comes so near to the first one's.
SECOND_CHANCE = 20.0


@kernel
def match_equations(
    stack: Stack,
    t: int,
    usable: BoolArray,
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
    variance: float,
    relief: float,
    shared_relief: float,
    cutoff: float,
    distance: FloatArray,
    across: FloatArray,
    along: FloatArray,
    parallax: FloatArray,
    weights: FloatArray,
    equations: FloatArray,
) -> None:
    """How far each match of term t is from where the motion and the surface put it, and the weighted normal equations.

    Args:
        surface: (6,) α.
        variance: σ², normalised units.
        relief: ζ, in units of the inverse depth of g; shared_relief: what is left of it in the mean of many matches,
            times the root of their number: the equations have it.
        cutoff: of d.
        distance: (N,) d²; infinite for a point that the motion takes behind its camera.
        across: (N,) distance across the epipolar line over √(n'(I + Jx Jx')n): Sampson's distance, signed, with σ as its
            standard deviation. along: (N,) distance along it, likewise normalised by √(b'(I + Jx Jx')b).
        parallax: (N,) by how many of these units a unit of inverse depth (of g's) moves it along.
        weights: (N,) bisquare. Of all five, the term's own part is filled.
        equations: (12, 14) lower triangle of J'WJ in (w, d, α); J'We; Σ W Jρ² ∂log|Jρ| by (w, d), then Σ W Jρ². In the
            axes of the current camera.
    """
    rc, tc, turned = np.empty((3, 3)), np.empty(3), np.empty(3)
    view_of(stack, t, rotation, shift, rc, tc, turned)
    unit, spread = stack.inverse_depth[t], stack.spread[t]
    c0, c1 = stack.anchor[t, 0], stack.anchor[t, 1]
    equations[:] = 0.0
    phi, row = np.empty(SURFACE), np.empty(6)
    phi[0] = 1.0
    for i in range(stack.offsets[t], stack.offsets[t + 1]):
        x0, x1 = stack.x[i, 0], stack.x[i, 1]
        p, q = (x0 - c0) / spread, (x1 - c1) / spread
        phi[1], phi[2], phi[3], phi[4], phi[5] = p, q, p * p, p * q, q * q
        rho = 0.0
        for k in range(SURFACE):
            rho += unit * surface[k] * phi[k]
        # By the image point in the reference frame: the surface's slope moves the depth along.
        rho0 = (surface[1] + 2.0 * surface[3] * p + surface[4] * q) / spread
        rho1 = (surface[2] + surface[4] * p + 2.0 * surface[5] * q) / spread
        r0 = rc[0, 0] * x0 + rc[0, 1] * x1 + rc[0, 2]
        r1 = rc[1, 0] * x0 + rc[1, 1] * x1 + rc[1, 2]
        r2 = rc[2, 0] * x0 + rc[2, 1] * x1 + rc[2, 2]
        z = r2 + rho * tc[2]
        if not z > 1e-6:
            distance[i] = across[i] = along[i] = np.inf
            parallax[i] = weights[i] = 0.0
            continue
        u, v = (r0 + rho * tc[0]) / z, (r1 + rho * tc[1]) / z
        e0, e1 = stack.y[i, 0] - u, stack.y[i, 1] - v
        # Jρ, per unit of g's inverse depth, and Jx.
        b0, b1 = unit * (tc[0] - u * tc[2]) / z, unit * (tc[1] - v * tc[2]) / z
        j00 = (rc[0, 0] - u * rc[2, 0]) / z + b0 * rho0
        j01 = (rc[0, 1] - u * rc[2, 1]) / z + b0 * rho1
        j10 = (rc[1, 0] - v * rc[2, 0]) / z + b1 * rho0
        j11 = (rc[1, 1] - v * rc[2, 1]) / z + b1 * rho1
        s00 = 1.0 + j00 * j00 + j01 * j01
        s01 = j00 * j10 + j01 * j11
        s11 = 1.0 + j10 * j10 + j11 * j11
        length = np.sqrt(b0 * b0 + b1 * b1)
        b0, b1 = (b0 / length, b1 / length) if length > 0.0 else (1.0, 0.0)
        noise_n = b1 * b1 * s00 - 2.0 * b0 * b1 * s01 + b0 * b0 * s11
        noise_b = b0 * b0 * s00 + 2.0 * b0 * b1 * s01 + b1 * b1 * s11
        off = b0 * e0 + b1 * e1
        across[i] = (b0 * e1 - b1 * e0) / np.sqrt(noise_n)
        along[i] = off / np.sqrt(noise_b)
        parallax[i] = length / np.sqrt(noise_b)
        spare = (relief * length) ** 2
        distance[i] = across[i] ** 2 / variance + off * off / (variance * noise_b + spare)
        ratio = distance[i] / (cutoff * cutoff)
        weights[i] = (1.0 - ratio) ** 2 if usable[i] and ratio < 1.0 else 0.0
        if not weights[i] > 0.0:
            continue
        # Along the line: where the surface puts it.
        w = weights[i] / (variance * noise_b + (shared_relief * length) ** 2)
        _row(b0, b1, u, v, z, r0 + rho * turned[0], r1 + rho * turned[1], r2 + rho * turned[2], rho, row)
        for k in range(6):
            for j in range(k + 1):
                equations[k, j] += w * row[k] * row[j]
                equations[6 + k, 6 + j] += w * length * length * phi[k] * phi[j]
            for j in range(6):
                equations[6 + j, k] += w * row[k] * length * phi[j]
            equations[k, 12] += w * row[k] * off
            equations[6 + k, 12] += w * length * phi[k] * off
        # How the motion stretches the parallax, for `_reduce`.
        h2, share = -(b0 * u + b1 * v), w * length * unit / z
        equations[0, 13] += share * (turned[1] * h2 - turned[2] * b1)
        equations[1, 13] += share * (turned[2] * b0 - turned[0] * h2)
        equations[2, 13] += share * (turned[0] * b1 - turned[1] * b0)
        equations[3, 13] += share * b0
        equations[4, 13] += share * b1
        equations[5, 13] += share * h2
        equations[6, 13] += w * length * length
        # Across it: where the match itself puts it, as far as its parallax can be told from noise. Were that depth used
        # along the line as well, the noise in it would be taken for motion.
        if length > 0.0:
            further = spare / (variance * noise_b + spare) * off / length
            rho += unit * min(max(further, -0.5 * rho / unit), 2.0 * rho / unit)
            z = r2 + rho * tc[2]
            if not z > 1e-6:
                continue
            u, v = (r0 + rho * tc[0]) / z, (r1 + rho * tc[1]) / z
        w = weights[i] / (variance * noise_n)
        _row(-b1, b0, u, v, z, r0 + rho * turned[0], r1 + rho * turned[1], r2 + rho * turned[2], rho, row)
        off = b0 * e1 - b1 * e0
        for k in range(6):
            for j in range(k + 1):
                equations[k, j] += w * row[k] * row[j]
            equations[k, 12] += w * row[k] * off


@kernel
def _row(
    n0: float, n1: float, u: float, v: float, z: float, s0: float, s1: float, s2: float, rho: float, row: FloatArray
) -> None:
    """How (w, d), in the camera's axes, move a point's image (u, v) in the direction n: (s × h, ρ h) with h = n' D, D the
    derivative of the image by the point, scaled by ρ, and s = ρ (the point as seen from g, turned).
    """
    h0, h1 = n0 / z, n1 / z
    h2 = -(h0 * u + h1 * v)
    row[0], row[1], row[2] = s1 * h2 - s2 * h1, s2 * h0 - s0 * h2, s0 * h1 - s1 * h0
    row[3], row[4], row[5] = rho * h0, rho * h1, rho * h2


@kernel
def _reduce(
    stack: Stack,
    t: int,
    surface: FloatArray,
    prior: FloatArray,
    equations: FloatArray,
    total: FloatArray,
    right: FloatArray,
    gain: FloatArray,
) -> bool:
    """Adds term t's equations, its surface eliminated, to total (6, 6) and right (6,), in world axes.

    gain (6, 7) becomes the surface's answer: α changes by gain[:, 6] - gain[:, :6] (w, d).
    """
    block, column, small = np.empty((SURFACE, SURFACE)), np.empty(SURFACE), np.empty((6, 7))
    q = stack.qy[t]
    # From the camera's axes to the world's: both halves of (w, d) turn with Q.
    for k in range(SURFACE):
        for h in range(2):
            for j in range(3):
                s = 0.0
                for a in range(3):
                    s += equations[6 + k, 3 * h + a] * q[a, j]
                gain[k, 3 * h + j] = s
        gain[k, 6] = equations[6 + k, 12]
        for j in range(SURFACE):
            gain[k, 6] -= prior[k, j] * (surface[j] - stack.surface_mean[t, j])
    for k in range(SURFACE):
        for j in range(7):
            small[k, j] = gain[k, j]
    for c in range(7):
        for i in range(SURFACE):
            for j in range(SURFACE):
                block[i, j] = equations[6 + max(i, j), 6 + min(i, j)]
                block[i, j] += prior[i, j]
            column[i] = gain[i, c]
        if not cholesky_solve(block, column):
            return False
        for i in range(SURFACE):
            gain[i, c] = column[i]
    # What the data say of α, as a number of unknowns: trace of block^-1 (block - prior).
    unknowns = float(SURFACE)
    for c in range(SURFACE):
        for i in range(SURFACE):
            for j in range(SURFACE):
                block[i, j] = equations[6 + max(i, j), 6 + min(i, j)]
                block[i, j] += prior[i, j]
            column[i] = 1.0 if i == c else 0.0
        if not cholesky_solve(block, column):
            return False
        for i in range(SURFACE):
            unknowns -= column[i] * prior[i, c]
    # The derivative of log det(block) / 2, from the likelihood with α integrated out.
    pull = INTEGRATED * unknowns / max(equations[6, 13], 1e-300)
    for h in range(2):
        for g in range(2):
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for a in range(3):
                        for b in range(3):
                            k, l = 3 * h + a, 3 * g + b
                            s += q[a, i] * equations[max(k, l), min(k, l)] * q[b, j]
                    total[3 * h + i, 3 * g + j] += s
    for i in range(6):
        h, j = i // 3, i % 3
        for a in range(3):
            right[i] += q[a, j] * (equations[3 * h + a, 12] - pull * equations[3 * h + a, 13])
        for k in range(SURFACE):
            right[i] -= small[k, i] * gain[k, 6]
            for j2 in range(6):
                total[i, j2] -= small[k, i] * gain[k, j2]
    return True


@kernel
def _surface_prior(stack: Stack, t: int, surface: FloatArray, prior: FloatArray) -> float:
    """prior (6, 6): information about α; returns what α's departure from its mean costs.

    Slopes are heavy-tailed (a Cauchy distribution in two dimensions): a plane may be seen at a grazing angle.
    """
    steep, cost = 0.0, 0.0
    for k in range(SURFACE):
        for j in range(SURFACE):
            prior[k, j] = stack.surface_information[t, k, j]
            part = prior[k, j] * (surface[k] - stack.surface_mean[t, k]) * (surface[j] - stack.surface_mean[t, j])
            if k == 1 or k == 2:
                steep += part
            else:
                cost += 0.5 * part
    for k in range(1, 3):
        prior[k, k] *= 3.0 / (1.0 + steep)
    return cost + 1.5 * np.log(1.0 + steep)


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
    information: FloatArray,
    without_depth: FloatArray,
) -> tuple[int, float, float]:
    """From one motion to the one that its inliers agree on, all in place.

    Args:
        usable: (N,) matches that may be inliers.
        rotation: (3, 3), shift: (3,), surface: (T, 6): start, then result.
        sigma_px: (T,) noise assumed at first, pixels; then measured.
        weights: (N,), across: (N,) signed epipolar distances in pixels: filled.
        information: (6, 6) about (w, d), without_depth: (6, 6) the same when nothing is believed of how far away the
            surfaces are: filled.

    Returns:
        number of rounds; what the last step promised to lower the cost by, infinite where no match agreed; the negative
        log-likelihood of all usable matches, to compare hypotheses by.
    """
    n, n_matches = sigma_px.shape[0], weights.shape[0]
    distance, along, parallax = np.empty(n_matches), np.empty(n_matches), np.empty(n_matches)
    equations, gains = np.empty((12, 14)), np.empty((n, SURFACE, 7))
    total, right, step, prior = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((SURFACE, SURFACE))
    open_prior = np.empty((SURFACE, SURFACE))
    turned, relief, mass = np.empty((3, 3)), stack.relief.copy(), np.zeros(n)
    trusted = np.ones(n, np.bool_)
    promise, length, count, settled = np.inf, 1.0, 0, False
    for count in range(1, MAX_ROUNDS + 2):
        cutoff = CUTOFF * (WIDER[count - 1] if count <= 3 else 1.0)
        total[:] = 0.0
        without_depth[:] = 0.0
        right[:] = 0.0
        for t in range(n):
            match_equations(
                stack,
                t,
                usable,
                rotation,
                shift,
                surface[t],
                (sigma_px[t] / stack.focal[t]) ** 2,
                relief[t],
                relief[t] * np.sqrt(max(1.0, mass[t] / INDEPENDENT)),
                cutoff,
                distance,
                across,
                along,
                parallax,
                weights,
                equations,
            )
            _surface_prior(stack, t, surface[t], prior)
            if settled and trusted[t]:
                # The last round: nothing moves any more.
                _forget_offset(prior, open_prior)
                _reduce(stack, t, surface[t], open_prior, equations, without_depth, right, gains[t])
            if not trusted[t]:
                gains[t] = 0.0
            elif not _reduce(stack, t, surface[t], prior, equations, total, right, gains[t]):
                return count, np.inf, np.inf
        information[:] = total
        if settled:
            break
        # Turns and shifts have different units; a trace of each keeps what is not seen at all in place.
        turns, shifts = total[0, 0] + total[1, 1] + total[2, 2], total[3, 3] + total[4, 4] + total[5, 5]
        for i in range(3):
            total[i, i] += 1e-9 * turns
            total[3 + i, 3 + i] += 1e-9 * shifts
        step[:] = right
        if not cholesky_solve(total, step):
            return count, np.inf, np.inf
        last_promise, promise = promise, 0.0
        for i in range(6):
            promise += 0.5 * step[i] * right[i]
        # Steps that grow overshoot: shorter ones settle.
        length = max(0.5 * length, 0.1) if promise > last_promise and count > 4 else min(1.3 * length, 1.0)
        angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        length_now = length * min(1.0, 0.3 / max(angle, 1e-300))
        for i in range(6):
            step[i] *= length_now
        turn_by(step[:3], rotation, turned)
        rotation[:] = turned
        for i in range(3):
            shift[i] += step[3 + i]
        for t in range(n):
            for k in range(SURFACE):
                surface[t, k] += length_now * gains[t, k, 6]
                for j in range(6):
                    surface[t, k] -= gains[t, k, j] * step[j]
        for t in range(n):
            mass[t] = 0.0
            for i in range(stack.offsets[t], stack.offsets[t + 1]):
                mass[t] += weights[i]
        if count >= 2:
            _set_aside(stack, usable, weights, trusted)
            _scale(stack, weights, across, trusted, sigma_px)
            _reliefs(stack, weights, along, parallax, sigma_px, relief)
        settled = (count >= MIN_ROUNDS and promise < SETTLED) or count == MAX_ROUNDS
    cost, density = 0.0, 0.0
    for t in range(n):
        cost += _surface_prior(stack, t, surface[t], prior)
        f, variance = stack.focal[t], (sigma_px[t] / stack.focal[t]) ** 2
        anywhere = np.log((4.0 * stack.spread[t]) ** 2 / (2.0 * np.pi))
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if usable[i]:
                density = 0.5 * np.log(variance * (variance + (relief[t] * parallax[i]) ** 2))
                cost += min(0.5 * distance[i] + density, max(anywhere, density)) - anywhere
            across[i] *= f
            if not trusted[t]:
                weights[i] = 0.0
    for i in range(6):
        for j in range(6):
            information[i, j] *= EFFICIENCY
            without_depth[i, j] *= EFFICIENCY
    return count, promise, cost


@kernel
def _forget_offset(prior: FloatArray, out: FloatArray) -> None:
    """out (6, 6) becomes the prior's information about all of α but its offset; a trace of that stays."""
    for i in range(SURFACE):
        for j in range(SURFACE):
            out[i, j] = prior[i, j] - (1.0 - 1e-9) * prior[i, 0] * prior[0, j] / prior[0, 0]


@kernel
def _reliefs(
    stack: Stack,
    weights: FloatArray,
    along: FloatArray,
    parallax: FloatArray,
    sigma_px: FloatArray,
    relief: FloatArray,
) -> None:
    """relief (T,): ζ by moments, what the squares along the epipolar lines exceed the noise by; drawn towards what is
    believed of it, where the parallax is too small to tell.
    """
    for t in range(relief.shape[0]):
        variance = (sigma_px[t] / stack.focal[t]) ** 2
        believed = stack.relief[t] ** 2
        excess, certainty, mass = 0.0, 0.0, 0.0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if weights[i] > 0.0:
                p2 = parallax[i] ** 2
                # A normal variable's square scatters by twice the square of its variance.
                w = weights[i] / (2.0 * (variance + relief[t] ** 2 * p2) ** 2)
                excess += w * p2 * (along[i] ** 2 / SHRINKAGE - variance)
                certainty += w * p2 * p2
                mass += weights[i]
        # The surface's unknowns have taken a share of the squares: six of them at most.
        freedom = max(1.0 - 6.0 / max(mass, 6.0), 0.1)
        z2 = (excess + 1.0 / believed) / (freedom * certainty + 1.0 / believed**2)
        relief[t] = np.sqrt(max(z2, 1e-3 * believed))


@kernel
def _scale(stack: Stack, weights: FloatArray, across: FloatArray, trusted: BoolArray, sigma_px: FloatArray) -> None:
    """sigma_px (T,) from the weighted residuals."""
    n = sigma_px.shape[0]
    squares, mass, inliers = np.zeros(n), np.zeros(n), 0
    for t in range(n):
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if weights[i] > 0.0:
                squares[t] += weights[i] * (across[i] * stack.focal[t]) ** 2 / SHRINKAGE
                mass[t] += weights[i]
                inliers += trusted[t]
    if inliers == 0:
        return
    # Six unknowns have taken their share of the squares.
    freedom = max(1.0 - 6.0 / inliers, 0.15)
    rig = (squares * trusted).sum() / max((mass * trusted).sum(), 1e-12) / freedom
    for t in range(n):
        square = (squares[t] / freedom + RIG_MATCHES * rig) / (mass[t] + RIG_MATCHES)
        sigma_px[t] = max(np.sqrt(square), SIGMA_FLOOR_PX)


@kernel
def _set_aside(stack: Stack, usable: BoolArray, weights: FloatArray, trusted: BoolArray) -> None:
    """trusted (T,): not the terms that agree in too few of their matches, when others agree in many."""
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
        trusted[t] = best < 2.0 * CAMERA_MIN_SHARE or share[t] >= CAMERA_MIN_SHARE


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
    information: FloatArray,
    without_depth: FloatArray,
) -> tuple[int, float]:
    """One robust motion: seeds per term, minima of all seeds together, the best of them re-weighted.

    Args:
        usable: (N,) matches that may be inliers.
        picks: (h, 4) in [0, 1): draw the seeds' quadruples.
        guess_rotations: (G, 3, 3), guess_shifts: (G, 3).
        rotation: (3, 3), shift: (3,), weights: (N,), across: (N,) pixels, sigma_px: (T,),
            information: (6, 6), without_depth: (6, 6) (`reweight`): filled.

    Returns:
        iterations of the solver; what its last step promised (`minimize`), infinite where there is no fit.
    """
    n, n_matches = stack.focal.shape[0], stack.x.shape[0]
    moments, variance = np.empty((n, 9, 9)), np.empty(n)
    _seed(stack, usable, picks, weights, sigma_px)
    for t in range(n):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        moments_into(stack.x[first:last], stack.y[first:last], weights[first:last], moments[t])
        if not moments[t, 8, 8] > 0.0:
            moments[t, 8, 8] = 1e-9
        variance[t] = (sigma_px[t] / stack.focal[t]) ** 2
    rotations, shifts, planes = np.zeros((2, 3, 3)), np.zeros((2, 3)), np.zeros((2, n, 3))
    likelihoods, first_sigma = np.empty(2), sigma_px.copy()
    iterations = search(stack, moments, variance, guess_rotations, guess_shifts, rotations, shifts, planes, likelihoods)
    best, promise = np.inf, np.inf
    weights_, across_, sigma_ = np.zeros(n_matches), np.zeros(n_matches), np.empty(n)
    information_, without_ = np.empty((6, 6)), np.empty((6, 6))
    surface = np.empty((n, SURFACE))
    for k in range(2):
        if not likelihoods[k] > likelihoods[0] - SECOND_CHANCE:
            continue
        sigma_[:] = first_sigma
        surface[:] = stack.surface_mean
        for t in range(n):
            for j in range(1, 3):
                surface[t, j] = planes[k, t, j]
        done, promised, cost = reweight(
            stack,
            usable,
            rotations[k],
            shifts[k],
            surface,
            sigma_,
            weights_,
            across_,
            information_,
            without_,
        )
        iterations += done
        if cost < best:
            best, promise = cost, promised
            rotation[:], shift[:], weights[:], across[:] = rotations[k], shifts[k], weights_, across_
            sigma_px[:], information[:], without_depth[:] = sigma_, information_, without_
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
