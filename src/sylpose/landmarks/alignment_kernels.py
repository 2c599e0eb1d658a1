"""The hot loop of `alignment`: one pass over all matches of all cameras per round of Gauss-Newton.

All rows are in the axes of their camera, and turned into the world's only once they are summed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.numerics.arrays import FloatArray, IntArray
from sylpose.numerics.compiled import cholesky, cholesky_solve, kernel, solve_factored, turn_by
from sylpose.numerics.normal_equations import add_turned, eliminate, image_row, turn_rows
from sylpose.numerics.robust import bisquare

__all__ = ["CUTOFF", "Stacked", "iterate", "linearise"]


# Cutoff of the bisquare weights, in standard deviations: 93 % efficient for Gaussian noise in both coordinates (choice).
CUTOFF = 4.7
# Neighbours are off in depth alike: of a camera's matches only so many count as independent of each other along their
# lines.
INDEPENDENT = 10.0
# Rounds in which noise and doubt follow the residuals; then they are held, and the rest converges.
SETTLING_ROUNDS = 5
MAX_ROUNDS = 40
SIGMA_FLOOR_PX = 0.2
# A camera's noise counts as that of so many matches more that have the rig's.
RIG_MATCHES = 10.0
# How far a camera is from the others by chance: the mean of chi-squared with six degrees of freedom.
DISAGREEMENT = 6.0
# From so many times that on it is something else than chance.
FAR_OFF = 3.0
DOUBT_ROUNDS = 8
# A match farther off than this, by its camera's noise or by this much noise, pixels or the rig's, is no inlier, however
# bad its camera.
INLIER_PX, INLIER_RIG = 1.0, 3.0
# Converged when the step is a twentieth of its own standard deviation: what is left is not worth a round.
SETTLED = 0.05**2


class Stacked(NamedTuple):
    """All cameras' matches as arrays (C cameras, N matches), see `Sights`.

    Attributes:
        points, depth_error: (N, 3); image: (N, 2); trust: (N,); feature: (N,), from 0 for each camera.
        basis: (N, 3) 1, u, v: how the surface's unknowns move each landmark, in units of its own depth error.
        offsets: (C + 1,) camera c has the matches offsets[c] to offsets[c + 1].
        rotation: (C, 3, 3); center: (C, 3); focal: (C,).
    """

    points: FloatArray
    depth_error: FloatArray
    image: FloatArray
    trust: FloatArray
    feature: IntArray
    basis: FloatArray
    offsets: IntArray
    rotation: FloatArray
    center: FloatArray
    focal: FloatArray


@kernel
def linearise(
    stacked: Stacked,
    c: int,
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
    variance: float,
    place: FloatArray,
    distance: FloatArray,
    across: FloatArray,
) -> None:
    """Where camera c's landmarks are and what they miss their image points by.

    Args:
        surface: (3,) a.
        variance: σ², normalised units.
        place: (N, 13) the landmark as seen from g, turned (3), in the camera's axes; its image (2) and its depth; the unit
            vector (2) along which its image moves with its depth error, by how much, and how far along it it is off; its
            depth error (3), camera's axes.
        distance: (N,) d, the square root of e'V⁻¹e; infinite behind the camera.
        across: (N,) how far it is off across that direction. Of all three, the camera's own part is filled.
    """
    q = stacked.rotation[c]
    turn, move = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        move[i] = 0.0
        for j in range(3):
            turn[i, j] = q[i, 0] * rotation[0, j] + q[i, 1] * rotation[1, j] + q[i, 2] * rotation[2, j]
            move[i] += q[i, j] * (shift[j] - stacked.center[c, j])
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        far = 0.0
        for k in range(3):
            far += stacked.basis[i, k] * surface[k]
        d0, d1, d2 = stacked.depth_error[i, 0], stacked.depth_error[i, 1], stacked.depth_error[i, 2]
        x0, x1, x2 = (
            stacked.points[i, 0] + far * d0,
            stacked.points[i, 1] + far * d1,
            stacked.points[i, 2] + far * d2,
        )
        s0 = turn[0, 0] * x0 + turn[0, 1] * x1 + turn[0, 2] * x2
        s1 = turn[1, 0] * x0 + turn[1, 1] * x1 + turn[1, 2] * x2
        s2 = turn[2, 0] * x0 + turn[2, 1] * x1 + turn[2, 2] * x2
        z = s2 + move[2]
        if not z > 1e-9:
            distance[i], across[i] = np.inf, 1e3
            continue
        g0 = turn[0, 0] * d0 + turn[0, 1] * d1 + turn[0, 2] * d2
        g1 = turn[1, 0] * d0 + turn[1, 1] * d1 + turn[1, 2] * d2
        g2 = turn[2, 0] * d0 + turn[2, 1] * d1 + turn[2, 2] * d2
        u, v = (s0 + move[0]) / z, (s1 + move[1]) / z
        b0, b1 = (g0 - u * g2) / z, (g1 - v * g2) / z
        length = np.sqrt(b0 * b0 + b1 * b1)
        b0, b1 = (b0 / length, b1 / length) if length > 0.0 else (1.0, 0.0)
        e0, e1 = u - stacked.image[i, 0], v - stacked.image[i, 1]
        along = b0 * e0 + b1 * e1
        across[i] = b0 * e1 - b1 * e0
        distance[i] = np.sqrt(across[i] ** 2 / variance + along * along / (variance + length * length))
        row = place[i]
        row[0], row[1], row[2], row[3], row[4], row[5] = s0, s1, s2, u, v, z
        row[6], row[7], row[8], row[9] = b0, b1, length, along
        row[10], row[11], row[12] = g0, g1, g2


@kernel
def weigh(stacked: Stacked, c: int, distance: FloatArray, least: FloatArray, weights: FloatArray) -> float:
    """weights (N,), camera c's part: bisquare; matches of one feature share the least of theirs. least (F, 2): to work in.

    Returns:
        the weights' sum.
    """
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        least[stacked.feature[i], 0], least[stacked.feature[i], 1] = 1.0, 0.0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        k = stacked.feature[i]
        least[k, 0] = min(least[k, 0], bisquare((distance[i] / CUTOFF) ** 2))
        least[k, 1] += 1.0
    mass = 0.0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        k = stacked.feature[i]
        weights[i] = least[k, 0] / least[k, 1] * stacked.trust[i]
        mass += weights[i]
    return mass


@kernel
def camera_equations(
    stacked: Stacked,
    c: int,
    variance: float,
    mass: float,
    place: FloatArray,
    across: FloatArray,
    weights: FloatArray,
    equations: FloatArray,
) -> None:
    """equations (9, 10): lower triangle of J'WJ in (w, d, a), and J'We; camera's axes. mass: the weights' sum."""
    equations[:] = 0.0
    row, phi = np.empty(6), np.empty(3)
    shared = max(1.0, mass / INDEPENDENT)
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        if not weights[i] > 0.0:
            continue
        s0, s1, s2, u, v, z = place[i, 0], place[i, 1], place[i, 2], place[i, 3], place[i, 4], place[i, 5]
        b0, b1, length, along = place[i, 6], place[i, 7], place[i, 8], place[i, 9]
        spare = length * length
        w = weights[i] / (variance + shared * spare)
        image_row(b0, b1, u, v, z, s0, s1, s2, 1.0, row)
        for k in range(3):
            phi[k] = length * stacked.basis[i, k]
        for k in range(6):
            share = w * row[k]
            for j in range(k + 1):
                equations[k, j] += share * row[j]
            for j in range(3):
                equations[6 + j, k] += share * phi[j]
            equations[k, 9] += share * along
        for k in range(3):
            share = w * phi[k]
            for j in range(k + 1):
                equations[6 + k, 6 + j] += share * phi[j]
            equations[6 + k, 9] += share * along
        # Across its line a match's derivative is that of the depth where the match itself lies, as far as that can be
        # told from noise; along it, it would take that noise for motion.
        w = weights[i] / variance
        nearer = -length * along / (variance + spare)
        deeper = z + nearer * place[i, 12]
        if deeper > 0.2 * z:
            s0, s1, s2 = s0 + nearer * place[i, 10], s1 + nearer * place[i, 11], s2 + nearer * place[i, 12]
            u, v = (u * z + nearer * place[i, 10]) / deeper, (v * z + nearer * place[i, 11]) / deeper
            z = deeper
        image_row(-b1, b0, u, v, z, s0, s1, s2, 1.0, row)
        for k in range(6):
            share = w * row[k]
            for j in range(k + 1):
                equations[k, j] += share * row[j]
            equations[k, 9] += share * across[i]


@kernel
def without_surface(
    q: FloatArray, surface: FloatArray, equations: FloatArray, gain: FloatArray, reduced: FloatArray
) -> None:
    """reduced (6, 7): hessian and gradient of (w, d) without a camera's surface, world axes.

    gain (3, 7) becomes the surface's answer to a step: a changes by -(gain[:, 6] + gain[:, :6] (w, d)).
    """
    block = np.empty((3, 3))
    turn_rows(equations[6:, :6], q, gain)
    for k in range(3):
        for j in range(k + 1):
            block[k, j] = equations[6 + k, 6 + j]
        block[k, k] += 1.0
        gain[k, 6] = equations[6 + k, 9] + surface[k]
    reduced[:] = 0.0
    add_turned(equations, q, reduced)
    for h in range(2):
        for i in range(3):
            for a in range(3):
                reduced[3 * h + i, 6] += q[a, i] * equations[3 * h + a, 9]
    eliminate(block, gain, reduced)


@kernel
def disagreement(reduced: FloatArray, doubt: FloatArray, found: FloatArray) -> None:
    """found (C,): how far each camera is from what the others say, chi-squared with six degrees of freedom.

    At the others' own solution x its gradient is g + H x, by chance H + H A⁻¹ H, A being the others' information.
    """
    n = len(doubt)
    others, x, off, spread, column = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((6, 6)), np.empty(6)
    for c in range(n):
        others[:] = 0.0
        x[:] = 0.0
        for o in range(n):
            if o != c:
                for i in range(6):
                    x[i] -= reduced[o, i, 6] / doubt[o]
                    for j in range(6):
                        others[i, j] += reduced[o, i, j] / doubt[o]
        found[c] = 0.0
        for i in range(6):
            others[i, i] += 1e-6 * others[i, i] + 1e-9 * reduced[c, i, i] + 1e-300
        if not cholesky(others):
            continue
        solve_factored(others, x)
        for j in range(6):
            off[j] = reduced[c, j, 6]
            for i in range(6):
                off[j] += reduced[c, j, i] * x[i]
                column[i] = reduced[c, i, j]
            solve_factored(others, column)
            for i in range(6):
                spread[i, j] = reduced[c, i, j]
                for k in range(6):
                    spread[i, j] += reduced[c, i, k] * column[k]
            spread[j, j] += 1e-9 * spread[j, j] + 1e-300
        column[:] = off
        if cholesky_solve(spread, column):
            for i in range(6):
                found[c] += off[i] * column[i]


@kernel
def doubt_cameras(reduced: FloatArray, doubt: FloatArray) -> None:
    """doubt (C,): by how much the variance of what each camera says is larger than its matches think.

    What one says weighs less in what the others are compared with the more it is doubted, so the odd one is found.
    """
    found, voices = np.empty(len(doubt)), 0
    for c in range(len(doubt)):
        voices += np.trace(reduced[c, :, :6]) > 0.0
    for _ in range(DOUBT_ROUNDS):
        disagreement(reduced, doubt, found)
        for c in range(len(doubt)):
            excess = max(1.0, found[c] / DISAGREEMENT)
            if voices > 2:
                # Beyond what chance explains the pull of a camera falls with its disagreement instead of levelling off.
                # Of two, nobody can tell which one is right.
                excess *= max(1.0, excess / FAR_OFF)
            doubt[c] = np.sqrt(doubt[c] * excess)


@kernel
def measure_noise(
    stacked: Stacked, across: FloatArray, weights: FloatArray, mass: FloatArray, work: FloatArray, sigma_px: FloatArray
) -> float:
    """sigma_px (C,): each camera's noise, from the median residual, drawn towards the rig's, which is returned.

    mass: (C,) sums of the weights.
    """
    n, known, levels = len(sigma_px), 0, np.empty(len(sigma_px))
    for c in range(n):
        count = 0
        for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
            if weights[i] > 0.0:
                work[count] = abs(across[i])
                count += 1
        if count > 0:
            sigma_px[c] = max(1.4826 * stacked.focal[c] * np.median(work[:count]), SIGMA_FLOOR_PX)
            levels[known] = sigma_px[c]
            known += 1
    if known == 0:
        return float(sigma_px[0])
    rig = float(np.median(levels[:known]))
    for c in range(n):
        own = sigma_px[c] if mass[c] > 0.0 else rig
        sigma_px[c] = np.sqrt((mass[c] * own * own + RIG_MATCHES * rig * rig) / (mass[c] + RIG_MATCHES))
    return rig


@kernel
def iterate(
    stacked: Stacked,
    schedule: FloatArray,
    left_out: int,
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
    sigma_px: FloatArray,
    doubt: FloatArray,
    weights: FloatArray,
    across: FloatArray,
    distance: FloatArray,
    information: FloatArray,
) -> tuple[int, bool]:
    """Gauss-Newton from one start, all in place.

    Args:
        schedule: (S,) noise that the first rounds assume, pixels.
        left_out: a camera that has no say; -1: none.
        rotation: (3, 3), shift: (3,), surface: (C, 3), doubt: (C,): start, then result.
        sigma_px: (C,), weights: (N,), across: (N,) in pixels, distance: (N,) d, information: (6, 6): filled.

    Returns:
        number of rounds; whether they converged.
    """
    n, n_matches, first = len(doubt), len(weights), len(schedule)
    place, work = np.empty((n_matches, 13)), np.empty(n_matches)
    least = np.empty((1 + (stacked.feature.max() if n_matches else 0), 2))
    equations, gains, reduced = np.empty((9, 10)), np.empty((n, 3, 7)), np.empty((n, 6, 7))
    total, factor, turned = np.empty((6, 6)), np.empty((6, 6)), np.empty((3, 3))
    right, step, previous, mass = np.empty(6), np.empty(6), np.zeros(6), np.zeros(n)
    count, converged, last, rig = 0, False, False, schedule[0]
    for count in range(1, MAX_ROUNDS + 2):
        settling = count <= first + SETTLING_ROUNDS
        if count <= first:
            sigma_px[:] = schedule[count - 1]
        for c in range(n):
            variance = (sigma_px[c] / stacked.focal[c]) ** 2
            linearise(stacked, c, rotation, shift, surface[c], variance, place, distance, across)
            mass[c] = weigh(stacked, c, distance, least, weights)
            if c == left_out:
                mass[c] = 0.0
                weights[stacked.offsets[c] : stacked.offsets[c + 1]] = 0.0
            camera_equations(stacked, c, variance, mass[c], place, across, weights, equations)
            without_surface(stacked.rotation[c], surface[c], equations, gains[c], reduced[c])
        if count == 1 and (mass > 0.0).any():
            # At first all have about the same say, however many matches they have.
            middle = float(np.median(mass[mass > 0.0]))
            for c in range(n):
                doubt[c] = max(doubt[c], mass[c] / middle)
        if settling:
            doubt_cameras(reduced, doubt)
        total[:] = 0.0
        right[:] = 0.0
        for c in range(n):
            for i in range(6):
                right[i] += reduced[c, i, 6] / doubt[c]
                for j in range(6):
                    total[i, j] += reduced[c, i, j] / doubt[c]
        if last:
            break
        if count >= first and settling:
            rig = measure_noise(stacked, across, weights, mass, work, sigma_px)
        for i in range(6):
            step[i] = -right[i]
            for j in range(6):
                factor[i, j] = total[i, j]
            factor[i, i] += 1e-9 * total[i, i] + 1e-300
        if not cholesky_solve(factor, step) or not np.isfinite(step).all():
            break
        size = step @ total @ step
        if count > first:
            # Re-weighting converges linearly; Aitken's extrapolation of its steps makes that a few rounds.
            ratio = float(step @ total @ previous) / max(float(previous @ total @ previous), 1e-300)
            previous[:] = step
            if not settling and count % 3 == 0:
                step /= 1.0 - min(max(ratio, -1.0), 0.85)
        step /= max(1.0, np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2) / 0.5)
        for c in range(n):
            for k in range(3):
                surface[c, k] -= gains[c, k, 6]
                for j in range(6):
                    surface[c, k] -= gains[c, k, j] * step[j]
        turn_by(step[:3], rotation, turned)
        rotation[:] = turned
        for i in range(3):
            shift[i] += step[3 + i]
        converged = not settling and float(size) < SETTLED
        last = converged or count == MAX_ROUNDS
    information[:] = total
    for c in range(n):
        # Who is an inlier is a matter of the rig's noise as well.
        level = min(sigma_px[c], max(INLIER_PX, INLIER_RIG * rig))
        linearise(stacked, c, rotation, shift, surface[c], (level / stacked.focal[c]) ** 2, place, distance, across)
        if c != left_out:
            weigh(stacked, c, distance, least, weights)
        for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
            across[i] *= stacked.focal[c]
    # Three points are the least that fix a pose.
    return min(count, MAX_ROUNDS), converged and int((weights > 0.0).sum()) >= 3
