"""One camera's part of `alignment`: what its matches say of the pose, without its own unknowns.

All rows are in the axes of the camera, and turned into the world's only once they are summed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.normal_equations import add_turned, eliminate, image_row, turn_rows
from sylpose.geometry.numba_linalg import kernel
from sylpose.geometry.robust_loss import SIGMA_OF_MEDIAN, bisquare

__all__ = [
    "CUTOFF",
    "VOTE_PX",
    "Own",
    "Stacked",
    "camera_terms",
    "judge",
    "linearise",
    "noise_of",
    "own_of",
    "take_step",
]

# Cutoff of the bisquare weights, in standard deviations: 93 % efficient for Gaussian noise in both coordinates (choice).
CUTOFF = 4.7
# Poses are compared by the robust cost at this noise, pixels, whatever noise each was fitted with (choice).
VOTE_PX = 0.5
# Neighbours are off in depth alike: of a camera's matches only so many count as independent of each other along their
# lines (measured: docs/method.md, "Better than two frames").
INDEPENDENT = 10.0


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


class Own(NamedTuple):
    """What cameras keep to themselves from round to round (C cameras, N matches, F features at most), and room to work in.

    Attributes:
        surface: (C, 3) a.
        gains: (C, 3, 7) its answer to a step: a changes by -(gain[:, 6] + gain[:, :6] (w, d)).
        weights: (N,), 0 for outliers.
        place: (N, 13) the landmark as seen from g, turned (3), in the camera's axes; its image (2) and its depth; the unit
            vector (2) along which its image moves with its depth error, by how much, and how far along it it is off; its
            depth error (3), camera's axes.
        distance: (N,) d, the square root of e'V⁻¹e; infinite behind the camera.
        across: (N,) how far it is off across that direction.
        equations: (9, 10), least: (F, 2), work: (N,).
    """

    surface: FloatArray
    gains: FloatArray
    weights: FloatArray
    place: FloatArray
    distance: FloatArray
    across: FloatArray
    equations: FloatArray
    least: FloatArray
    work: FloatArray


def own_of(stacked: Stacked) -> Own:
    """Where nothing is known of the surfaces yet."""
    n, cameras = len(stacked.trust), len(stacked.focal)
    return Own(
        surface=np.zeros((cameras, 3)),
        gains=np.zeros((cameras, 3, 7)),
        weights=np.zeros(n),
        place=np.empty((n, 13)),
        distance=np.zeros(n),
        across=np.zeros(n),
        equations=np.empty((9, 10)),
        least=np.empty((int(stacked.feature.max(initial=-1)) + 1, 2)),
        work=np.empty(n),
    )


@kernel
def linearise(
    stacked: Stacked,
    c: int,
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
    variance: float,
    own: Own,
) -> None:
    """Where camera c's landmarks are and what they miss their image points by.

    Args:
        surface: (3,) a.
        variance: σ², normalised units.
        own: its place, distance and across are filled.
    """
    q, place, distance, across = stacked.rotation[c], own.place, own.distance, own.across
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
def weigh(stacked: Stacked, c: int, own: Own) -> float:
    """The weights of camera c's matches by their distances: bisquare; those of one feature share the least of theirs.

    Returns:
        the weights' sum.
    """
    distance, least, weights = own.distance, own.least, own.weights
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
    own: Own,
) -> None:
    """The equations: lower triangle of J'WJ in (w, d, a), and J'We; camera's axes. mass: the weights' sum."""
    place, across, weights, equations = own.place, own.across, own.weights, own.equations
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
def _without_surface(
    q: FloatArray, surface: FloatArray, equations: FloatArray, gain: FloatArray, reduced: FloatArray
) -> None:
    """reduced (6, 7): hessian and gradient of (w, d) without a camera's surface (3,), world axes; gain (3, 7), see `Own`."""
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
    # But for rounding it is symmetric: one half is all that is sent.
    for i in range(6):
        for j in range(i):
            reduced[i, j] = reduced[j, i]


@kernel
def camera_terms(
    stacked: Stacked,
    c: int,
    rotation: FloatArray,
    shift: FloatArray,
    sigma_px: float,
    heard: bool,
    own: Own,
    reduced: FloatArray,
) -> float:
    """What camera c says of a pose: reduced (6, 7), hessian and gradient of (w, d) without its surface, world axes.

    Args:
        sigma_px: its noise, pixels.
        heard: whether it has a say.
        own: its part is filled.

    Returns:
        the weights' sum.
    """
    variance = (sigma_px / stacked.focal[c]) ** 2
    linearise(stacked, c, rotation, shift, own.surface[c], variance, own)
    mass = weigh(stacked, c, own)
    if not heard:
        mass = 0.0
        own.weights[stacked.offsets[c] : stacked.offsets[c + 1]] = 0.0
    camera_equations(stacked, c, variance, mass, own)
    _without_surface(stacked.rotation[c], own.surface[c], own.equations, own.gains[c], reduced)
    return mass


@kernel
def noise_of(stacked: Stacked, c: int, own: Own) -> float:
    """Camera c's noise, pixels, from the median of its inliers' distances across; NaN without any."""
    count = 0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        if own.weights[i] > 0.0:
            own.work[count] = abs(own.across[i])
            count += 1
    if count == 0:
        return np.nan
    return float(SIGMA_OF_MEDIAN * stacked.focal[c] * np.median(own.work[:count]))


@kernel
def take_step(c: int, step: FloatArray, own: Own) -> None:
    """Camera c's surface after all have taken a step (6,) of (w, d)."""
    for k in range(3):
        own.surface[c, k] -= own.gains[c, k, 6]
        for j in range(6):
            own.surface[c, k] -= own.gains[c, k, j] * step[j]


@kernel
def _cost(q: float) -> float:
    """The bisquare's cost of a squared distance over the cutoff's, between 0 and 1."""
    return 1.0 - max(1.0 - q, 0.0) ** 3


@kernel
def cost_of(
    stacked: Stacked, c: int, rotation: FloatArray, shift: FloatArray, surface: FloatArray, level_px: float, own: Own
) -> float:
    """The sum of camera c's robust costs by trust at some noise, pixels; surface: (3,)."""
    linearise(stacked, c, rotation, shift, surface, (level_px / stacked.focal[c]) ** 2, own)
    cost = 0.0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        cost += stacked.trust[i] * _cost((own.distance[i] / CUTOFF) ** 2)
    return cost


@kernel
def judge(
    stacked: Stacked, c: int, rotation: FloatArray, shift: FloatArray, level_px: float, heard: bool, own: Own
) -> tuple[float, float, int]:
    """Which of camera c's matches agree with a pose; own.across becomes pixels.

    Args:
        level_px: noise that decides who is an inlier.
        heard: whether it had a say; else its weights stay 0.

    Returns:
        the sum of its matches' robust costs, each between 0 and 1, by trust; the same at `VOTE_PX`; number of inliers.
    """
    vote = cost_of(stacked, c, rotation, shift, own.surface[c], VOTE_PX, own)
    variance = (level_px / stacked.focal[c]) ** 2
    linearise(stacked, c, rotation, shift, own.surface[c], variance, own)
    if heard:
        weigh(stacked, c, own)
    cost, inliers = 0.0, 0
    for i in range(stacked.offsets[c], stacked.offsets[c + 1]):
        own.across[i] *= stacked.focal[c]
        cost += stacked.trust[i] * _cost((own.distance[i] / CUTOFF) ** 2)
        inliers += own.weights[i] > 0.0
    return cost, vote, inliers
