"""Re-weighting: a motion, the matches that agree with it and the noise they have, each from the others until they settle.

Gauss-Newton on the distances of `match_cost`, the surfaces eliminated term by term. V is held fixed within a step
(quasi-likelihood); weights are bisquare in d; σ comes from the weighted residuals across the epipolar lines, per term
but drawn towards that of the rig; ζ from those along them. A mismatch that lies on its epipolar line by chance is found
out by its distance along it.

Source: M-estimators of regression and scale, Huber & Ronchetti, "Robust Statistics", chapters 6 and 7; docs/method.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.normal_equations import add_turned
from sylpose.geometry.numba_linalg import cholesky_solve, kernel, leaf, total_of
from sylpose.geometry.robust_loss import bisquare_on_noise
from sylpose.relative_pose.match_cost import Matched, Tolerance, Usable, match_equations, no_equations
from sylpose.relative_pose.schur import make_room, reduce_term, surface_prior
from sylpose.relative_pose.terms import SURFACE, Candidate, Stack, take_step

__all__ = [
    "CUTOFF",
    "INDEPENDENT",
    "SETTLED",
    "SIGMA_FLOOR_PX",
    "SIGMA_GROWTH",
    "Reweighted",
    "nothing_yet",
    "reweight",
    "reweight_held",
    "spread_evenly",
]


# Cutoff of d: 94 % efficient with Gaussian noise in both directions, for which d² is chi-squared with two degrees of
# freedom (choice); what the weighted mean square and the information of the weights then lack (derived).
CUTOFF = 5.0
SHRINKAGE, GAIN = bisquare_on_noise(CUTOFF).shrinkage, bisquare_on_noise(CUTOFF).gain
# Mean weights of matches that are spread evenly up to the cutoff, and half way from there to those of noise (derived).
EVENLY = 8.0 / 15.0
EVEN = 0.5 * (EVENLY + bisquare_on_noise(CUTOFF).weight)
# Cutoffs of the first rounds are wider by these factors: the first motion comes from contaminated matches (choice).
WIDER = (2.0, 1.5, 1.2)
# Rounds at least, while the noise level still moves, and at most (choice).
MIN_ROUNDS, MAX_ROUNDS = 5, 40
# From the second round on noise, reliefs and cameras that are set aside follow the residuals (choice).
SECOND_ROUND = 2
# From this round on, steps are cut shorter and shorter; after the first few also where they grow, by a half and down to a
# tenth, else they may be longer again. None turns by more than this, radians (choice).
LONG_ROUNDS, FREE_ROUNDS = 12, 4
SHORTER, SHORTEST, LONGER = 0.5, 0.1, 1.3
LONGEST_STEP = 0.3
# Nor does any change an inverse depth by more than this share of it (choice).
NEARER = 0.5
# What is added to a step's diagonal, of its trace (choice).
RIDGE = 1e-9
# How firmly what is held is, of what holds a motion in any direction (choice).
FIRM = 1e6
# Settled when a step promises to lower the cost by less than this: a thirtieth of a standard deviation (choice).
SETTLED = 5e-4
# A term's σ counts as that of so many matches more that have the rig's (choice).
RIG_MATCHES = 10.0
# Noise is never believed to be less, pixels, nor more than so many times the seeds': else two motions, or none, would be
# explained by it (choice).
SIGMA_FLOOR_PX = 0.02
SIGMA_GROWTH = 2.0
# What is left of the surfaces' prior where nothing is believed of them: as much as keeps them determined (choice).
OPEN_PRIOR = 1e-6
# One keypoint in ten is so many times as noisy as the others (choice): what that costs when motions are compared, minus the
# logarithm of its density in two directions over theirs (derived). Without these a motion with more noise, which reaches
# some of them, would be likelier than the right one, whose noise is less: the second plane of a flat object, say.
COARSE = 5.0
SLOPPY = float(2.0 * np.log(COARSE) + np.log(10.0))
# A mismatch lies anywhere in a square of so many spreads (choice).
ANYWHERE = 4.0
# Unknowns never take all of the squares, across the lines and along them (choice).
LEAST_FREEDOM, LEAST_FREEDOM_ALONG = 0.15, 0.1
# A relief's square is never believed to be less, of what it is believed to be beforehand (choice).
LEAST_RELIEF = 1e-3
# Neighbours have like relief: of all a term's matches only so many are independent of each other in it (choice).
INDEPENDENT = 6.0
# A camera of so many matches that agrees with the others in fewer of them than this is set aside, junk alone reaches about a
# tenth; where another agrees in many, else nobody knows who is right (choice).
JUDGED, CAMERA_MIN_SHARE = 6, 0.3
MANY = 2.0 * CAMERA_MIN_SHARE


class Reweighted(NamedTuple):
    """A motion and what its inliers say (T terms, N matches).

    Attributes:
        candidate: the motion, with quadrics as surfaces.
        sigma_px: (T,) noise, pixels.
        weights: (N,).
        across: (N,) signed epipolar distances, pixels.
        information: (6, 6) about (w, d).
        without_depth: (6, 6) the same when nothing is believed of the surfaces, of how far away they are nor how curved.
        noise: (6, 6) the part of both that tells nothing (`Equations`).
        relief: (T,) ζ.
        place: (1,) of the object (`Stack`).
    """

    candidate: Candidate
    sigma_px: FloatArray
    weights: FloatArray
    across: FloatArray
    information: FloatArray
    without_depth: FloatArray
    noise: FloatArray
    relief: FloatArray
    place: FloatArray


@kernel
def nothing_yet(stack: Stack) -> Reweighted:
    """No motion, with no inliers."""
    n, n_matches = stack.focal.shape[0], stack.x.shape[0]
    return Reweighted(
        Candidate(np.eye(3), np.zeros(3), stack.surface_mean.copy()),
        np.ones(n),
        np.zeros(n_matches),
        np.zeros(n_matches),
        np.zeros((6, 6)),
        np.zeros((6, 6)),
        np.zeros((6, 6)),
        stack.relief.copy(),
        np.zeros(1),
    )


@kernel
def reweight(stack: Stack, usable: Usable, fit: Reweighted, least_px: float) -> tuple[int, float, float]:
    """From one motion to the one that its inliers agree on, all in place: `reweight_held` with nothing held."""
    return reweight_held(stack, usable, fit, least_px, np.zeros(6))


@kernel
def reweight_held(
    stack: Stack, usable: Usable, fit: Reweighted, least_px: float, held: FloatArray
) -> tuple[int, float, float]:
    """From one motion to the one that its inliers agree on, as far as it may move, all in place.

    Args:
        usable: (N,) matches that may be inliers, or the probability of each that it is one of them.
        fit: its candidate and noise are the start; all of it becomes the result.
        least_px: noise is not believed to be less, nor than the stack's; as a rule `SIGMA_FLOOR_PX`.
        held: (6,) held' (w, d) stays as it is; zero where nothing is held. The information is as if nothing were.

    Returns:
        number of rounds; what the last step promised to lower the cost by, infinite where no match agreed; the negative
        log-likelihood of all usable matches, to compare hypotheses by.
    """
    least_px = max(least_px, stack.least_px)
    candidate, sigma_px, weights, across, information, without_depth, noise, relief, place = fit
    surface = candidate.surface
    n, n_matches = sigma_px.shape[0], weights.shape[0]
    distance, along, parallax = np.empty(n_matches), np.empty(n_matches), np.empty(n_matches)
    terms = np.empty((2, n_matches))
    matches = Matched(distance, across, along, parallax, weights)
    searching, ending, gains = no_equations(False, False), no_equations(True, False), np.empty((n, SURFACE, 8))
    total, right, step, prior = np.empty((7, 7)), np.empty(7), np.empty(7), np.empty((SURFACE, SURFACE))
    open_prior, open_total = np.empty((SURFACE, SURFACE)), np.empty((7, 7))
    unused, mass, room = np.empty(7), np.zeros(n), make_room()
    relief[:], place[:] = stack.relief, 0.0
    trusted = np.ones(n, np.bool_)
    bound = max(SIGMA_GROWTH * sigma_px.max(), least_px)
    promise, length, count, settled = np.inf, 1.0, 0, False
    for count in range(1, MAX_ROUNDS + 2):
        cutoff = CUTOFF * (WIDER[count - 1] if count <= len(WIDER) else 1.0)
        total[:] = 0.0
        open_total[:] = 0.0
        noise[:] = 0.0
        right[:] = 0.0
        # Where the object is is believed with a standard deviation of 1.
        total[6, 6], right[6] = 1.0, -place[0]
        for t in range(n):
            equations = ending if settled else searching
            shared = relief[t] * np.sqrt(max(1.0, mass[t] / INDEPENDENT))
            tolerance = Tolerance((sigma_px[t] / stack.focal[t]) ** 2, relief[t], shared, cutoff)
            match_equations(stack, t, usable, candidate, tolerance, matches, equations)
            surface_prior(stack, t, surface[t], place[0], prior)
            if settled and trusted[t]:
                # The last round: nothing moves any more.
                for k in range(SURFACE):
                    for j in range(SURFACE):
                        open_prior[k, j] = OPEN_PRIOR * prior[k, j]
                reduce_term(stack, t, surface[t], place[0], open_prior, equations, open_total, unused, gains[t], room)
                add_turned(equations.noise, stack.qy[t], noise)
            if not trusted[t]:
                gains[t] = 0.0
            elif not reduce_term(stack, t, surface[t], place[0], prior, equations, total, right, gains[t], room):
                return count, np.inf, np.inf
        without_depth[:] = open_total[:6, :6]
        for i in range(6):
            for j in range(6):
                information[i, j] = total[i, j] - total[i, 6] * total[6, j] / total[6, 6]
        if settled:
            # A turn that nothing but noise shows never settles, nor need it.
            step[:] = right
            if promise >= SETTLED and cholesky_solve(total, step):
                promise = 0.5 * step[6] * right[6]
                for i in range(6):
                    promise += 0.5 * step[i] * right[i]
                    for j in range(6):
                        promise -= 0.5 * step[i] * noise[i, j] * step[j]
                promise = max(promise, 0.0)
            break
        # Turns and shifts have different units; a trace of each keeps what is not seen at all in place.
        turns, shifts = total[0, 0] + total[1, 1] + total[2, 2], total[3, 3] + total[4, 4] + total[5, 5]
        for i in range(3):
            total[i, i] += RIDGE * turns
            total[3 + i, 3 + i] += RIDGE * shifts
        most = 0.0
        for i in range(6):
            most = max(most, total[i, i])
        for i in range(6):
            for j in range(6):
                total[i, j] += FIRM * most * held[i] * held[j]
        step[:] = right
        if not cholesky_solve(total, step):
            return count, np.inf, np.inf
        last_promise, promise = promise, 0.0
        for i in range(7):
            promise += 0.5 * step[i] * right[i]
        # Steps that grow overshoot, and matches that come and go make them circle: shorter ones settle.
        growing = promise > last_promise and count > FREE_ROUNDS
        length = max(SHORTER * length, SHORTEST) if growing else min(LONGER * length, 1.0)
        if count > LONG_ROUNDS:
            length = min(length, LONG_ROUNDS / count)
        angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        length_now = length * min(1.0, LONGEST_STEP / max(angle, 1e-300))
        for t in range(n):
            # The object stays before its cameras.
            nearer = gains[t, 0, 7]
            for j in range(7):
                nearer -= gains[t, 0, j] * step[j]
            length_now = min(length_now, NEARER * abs(surface[t, 0]) / max(abs(nearer), 1e-300))
        take_step(candidate, place, step, gains, length_now)
        for t in range(n):
            mass[t] = total_of(weights[stack.offsets[t] : stack.offsets[t + 1]])
        if count >= SECOND_ROUND:
            _set_aside(stack, usable, weights, trusted)
            _scale(stack, weights, across, trusted, sigma_px, mass, terms[0])
            sigma_px[:] = np.minimum(np.maximum(sigma_px, least_px), bound)
            _reliefs(stack, weights, along, parallax, sigma_px, relief, terms)
        settled = (count >= MIN_ROUNDS and promise < SETTLED) or count == MAX_ROUNDS
    cost, density = 0.5 * place[0] ** 2, 0.0
    for t in range(n):
        cost += surface_prior(stack, t, surface[t], place[0], prior)
        f, variance = stack.focal[t], (sigma_px[t] / stack.focal[t]) ** 2
        anywhere = np.log((ANYWHERE * stack.spread[t]) ** 2 / (2.0 * np.pi))
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if usable[i]:
                density = 0.5 * np.log(variance * (variance + (relief[t] * parallax[i]) ** 2))
                near = min(0.5 * distance[i], 0.5 * distance[i] / COARSE**2 + SLOPPY)
                cost += usable[i] * (min(near + density, max(anywhere, density)) - anywhere)
            across[i] *= f
            if not trusted[t]:
                weights[i] = 0.0
    for i in range(6):
        for j in range(6):
            information[i, j] *= GAIN
            without_depth[i, j] *= GAIN
            noise[i, j] *= GAIN
    return count, promise, cost


@leaf
def _reliefs(
    stack: Stack,
    weights: FloatArray,
    along: FloatArray,
    parallax: FloatArray,
    sigma_px: FloatArray,
    relief: FloatArray,
    room: FloatArray,
) -> None:
    """relief (T,): ζ by moments, what the squares along the epipolar lines exceed the noise by; drawn towards what is
    believed of it, where the parallax is too small to tell. room (2, N) is lost.
    """
    for t in range(relief.shape[0]):
        variance = (sigma_px[t] / stack.focal[t]) ** 2
        believed, square = stack.relief[t] ** 2, relief[t] ** 2
        first, last = stack.offsets[t], stack.offsets[t + 1]
        w, p, off, terms = weights[first:last], parallax[first:last], along[first:last], room[:, first:last]
        for i in range(last - first):
            # A normal variable's square scatters by twice the square of its variance.
            p2, some = p[i] * p[i], w[i] > 0.0
            by = w[i] * p2 / (2.0 * (variance + square * p2) * (variance + square * p2))
            terms[0, i] = by * (off[i] * off[i] / SHRINKAGE - variance) if some else 0.0
            terms[1, i] = by * p2
        excess, certainty, mass = total_of(terms[0]), total_of(terms[1]), total_of(w)
        # The surface's unknowns have taken a share of the squares: all of them at most.
        freedom = max(1.0 - SURFACE / max(mass, float(SURFACE)), LEAST_FREEDOM_ALONG)
        z2 = (excess + 1.0 / believed) / (freedom * certainty + 1.0 / believed**2)
        relief[t] = np.sqrt(max(z2, LEAST_RELIEF * believed))


@kernel
def _scale(
    stack: Stack,
    weights: FloatArray,
    across: FloatArray,
    trusted: BoolArray,
    sigma_px: FloatArray,
    mass: FloatArray,
    room: FloatArray,
) -> None:
    """sigma_px (T,) from the weighted residuals; mass (T,) are the sums of the weights. room (N,) is lost."""
    n = sigma_px.shape[0]
    squares, inliers, rig, all_of_them = np.zeros(n), 0, 0.0, 0.0
    for t in range(n):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        w, off, terms, some = weights[first:last], across[first:last], room[first:last], 0
        for i in range(last - first):
            inside = w[i] > 0.0
            terms[i] = w[i] * off[i] * off[i] if inside else 0.0
            some += inside
        squares[t] = total_of(terms) * stack.focal[t] ** 2 / SHRINKAGE
        if trusted[t]:
            inliers += some
            rig += squares[t]
            all_of_them += mass[t]
    if inliers == 0:
        return
    # The motion's six unknowns have taken their share of the squares.
    freedom = max(1.0 - 6.0 / inliers, LEAST_FREEDOM)
    rig = rig / max(all_of_them, 1e-12) / freedom
    for t in range(n):
        square = (squares[t] / freedom + RIG_MATCHES * rig) / (mass[t] + RIG_MATCHES)
        sigma_px[t] = np.sqrt(square)


@kernel
def _set_aside(stack: Stack, usable: Usable, weights: FloatArray, trusted: BoolArray) -> None:
    """trusted (T,): not the terms that agree in too few of their matches, when others agree in many."""
    n = stack.focal.shape[0]
    share, best = np.ones(n), 0.0
    for t in range(n):
        agree, could = 0.0, 0.0
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            could += usable[i]
            agree += usable[i] if weights[i] > 0.0 else 0.0
        if could >= JUDGED:
            share[t] = agree / could
            best = max(best, share[t])
    for t in range(n):
        trusted[t] = best < MANY or share[t] >= CAMERA_MIN_SHARE


@kernel
def spread_evenly(weights: FloatArray) -> bool:
    """Whether inliers, by their weights (N,), are spread evenly rather than as noise is: chosen by what is held to be it."""
    inliers, mass = 0, 0.0
    for w in weights:
        inliers += w > 0.0
        mass += w
    return bool(mass < EVEN * inliers)
