"""Some matches at once: by how much they miss, and what they say of the motion.

What `match_cost` does for every match is done for 32 of them at a time, so that the processor works on several in one
instruction: loops over lanes, arrays with constant strides. Sums are taken in the same order on every machine.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.terms import SURFACE

__all__ = [
    "ACROSS",
    "ALONG",
    "BY_LANE",
    "LANES",
    "PART",
    "Place",
    "Tolerance",
    "add_missing",
    "add_noise",
    "add_products",
    "add_stretch",
    "miss_by",
    "total",
]

# Matches that are worked on together, and what there is of each: x, y, usable; distance, across, along, parallax, weight;
# the weights of its two rows; h of `image_row` along the line and |Jρ|, h across it, what noise makes of ρ; the row along
# the line with what it misses by, and that across (derived).
LANES, PART, ALONG, ACROSS = 32, 8, 20, 33
BY_LANE = ACROSS + 7


class Tolerance(NamedTuple):
    """How far off a match may be.

    Attributes:
        variance: σ², normalised units.
        relief: ζ, in units of the inverse depth of g.
        shared_relief: what is left of it in the mean of many matches, times the root of their number: the equations have it.
        cutoff: of d.
    """

    variance: float
    relief: float
    shared_relief: float
    cutoff: float


class Place(NamedTuple):
    """Where a term's surface is anchored (`Stack`): the inverse depth of g, one over the spread, and its image."""

    unit: float
    per_spread: float
    anchor0: float
    anchor1: float


@leaf
def miss_by(
    place: Place,
    surface: FloatArray,
    tolerance: Tolerance,
    rc: FloatArray,
    tc: FloatArray,
    turned: FloatArray,
    lanes: FloatArray,
) -> None:
    """By how much some matches miss, and what they say of (w, d, α): all lanes (`BY_LANE`) from the first five."""
    variance, relief, shared_relief, cutoff = tolerance
    unit, per_spread, anchor0, anchor1 = place
    a0, a1, a2, a3, a4, a5 = surface[0], surface[1], surface[2], surface[3], surface[4], surface[5]
    r00, r01, r02 = rc[0, 0], rc[0, 1], rc[0, 2]
    r10, r11, r12 = rc[1, 0], rc[1, 1], rc[1, 2]
    r20, r21, r22 = rc[2, 0], rc[2, 1], rc[2, 2]
    t0, t1, t2 = tc[0], tc[1], tc[2]
    g0, g1, g2 = turned[0], turned[1], turned[2]
    per_cutoff, per_variance = 1.0 / (cutoff * cutoff), 1.0 / variance
    for k in range(LANES):
        x0, x1 = lanes[k], lanes[1 * LANES + k]
        p, q = (x0 - anchor0) * per_spread, (x1 - anchor1) * per_spread
        rho = unit * (a0 + a1 * p + a2 * q + a3 * p * p + a4 * p * q + a5 * q * q)
        # By the image point in the reference frame: the surface's slope moves the depth along.
        rho0 = (a1 + 2.0 * a3 * p + a4 * q) * per_spread
        rho1 = (a2 + a4 * p + 2.0 * a5 * q) * per_spread
        v0, v1, v2 = r00 * x0 + r01 * x1 + r02, r10 * x0 + r11 * x1 + r12, r20 * x0 + r21 * x1 + r22
        z = v2 + rho * t2
        before = z > 1e-6
        per_z = 1.0 / (z if before else 1.0)
        u, v = (v0 + rho * t0) * per_z, (v1 + rho * t1) * per_z
        e0, e1 = lanes[2 * LANES + k] - u, lanes[3 * LANES + k] - v
        # Jρ, per unit of g's inverse depth, and Jx.
        b0, b1 = unit * (t0 - u * t2) * per_z, unit * (t1 - v * t2) * per_z
        j00, j01 = (r00 - u * r20) * per_z + b0 * rho0, (r01 - u * r21) * per_z + b0 * rho1
        j10, j11 = (r10 - v * r20) * per_z + b1 * rho0, (r11 - v * r21) * per_z + b1 * rho1
        s00, s01, s11 = 1.0 + j00 * j00 + j01 * j01, j00 * j10 + j01 * j11, 1.0 + j10 * j10 + j11 * j11
        length = np.sqrt(b0 * b0 + b1 * b1)
        seen = length > 0.0
        per_length = 1.0 / (length if seen else 1.0)
        b0, b1 = (b0 * per_length if seen else 1.0), (b1 * per_length if seen else 0.0)
        noise_n = b1 * b1 * s00 - 2.0 * b0 * b1 * s01 + b0 * b0 * s11
        noise_b = b0 * b0 * s00 + 2.0 * b0 * b1 * s01 + b1 * b1 * s11
        per_noise, per_root = 1.0 / noise_n, 1.0 / np.sqrt(noise_b)
        off, beside = b0 * e0 + b1 * e1, b0 * e1 - b1 * e0
        spare = (relief * length) * (relief * length)
        per_both = 1.0 / (variance * noise_b + spare)
        distance = beside * beside * per_noise * per_variance + off * off * per_both
        inside = 1.0 - distance * per_cutoff
        weight = lanes[4 * LANES + k] * (inside * inside if before and inside > 0.0 else 0.0)
        lanes[5 * LANES + k] = distance if before else np.inf
        lanes[6 * LANES + k] = beside * np.sqrt(per_noise) if before else np.inf
        lanes[7 * LANES + k] = off * per_root if before else np.inf
        lanes[8 * LANES + k] = length * per_root if before else 0.0
        lanes[9 * LANES + k] = weight
        # Along the line: where the surface puts it.
        shared = shared_relief * length
        lanes[10 * LANES + k] = weight / (variance * noise_b + shared * shared)
        h0, h1 = b0 * per_z, b1 * per_z
        h2 = -(h0 * u + h1 * v)
        s0, s1, s2 = v0 + rho * g0, v1 + rho * g1, v2 + rho * g2
        lanes[(ALONG) * LANES + k], lanes[(ALONG + 1) * LANES + k] = s1 * h2 - s2 * h1, s2 * h0 - s0 * h2
        lanes[(ALONG + 2) * LANES + k], lanes[(ALONG + 3) * LANES + k] = s0 * h1 - s1 * h0, rho * h0
        lanes[(ALONG + 4) * LANES + k], lanes[(ALONG + 5) * LANES + k] = rho * h1, rho * h2
        lanes[(ALONG + 6) * LANES + k], lanes[(ALONG + 7) * LANES + k], lanes[(ALONG + 8) * LANES + k] = (
            length,
            length * p,
            length * q,
        )
        lanes[(ALONG + 9) * LANES + k], lanes[(ALONG + 10) * LANES + k] = length * p * p, length * p * q
        lanes[(ALONG + 11) * LANES + k], lanes[(ALONG + 12) * LANES + k] = length * q * q, off
        lanes[12 * LANES + k], lanes[13 * LANES + k], lanes[14 * LANES + k], lanes[15 * LANES + k] = h0, h1, h2, length
        # Across it: where the match itself puts it, as far as its parallax can be told from noise. Were that depth used
        # along the line as well, the noise in it would be taken for motion.
        told = spare * per_both
        further = unit * told * off * per_length
        further = further if further > -0.5 * rho else -0.5 * rho
        further = further if further < 2.0 * rho else 2.0 * rho
        rho += further if seen else 0.0
        z = v2 + rho * t2
        behind = not z > 1e-6
        per_z = 1.0 / (1.0 if behind else z)
        u, v = (v0 + rho * t0) * per_z, (v1 + rho * t1) * per_z
        lanes[11 * LANES + k] = 0.0 if behind else weight * per_variance * per_noise
        h0, h1 = -b1 * per_z, b0 * per_z
        h2 = -(h0 * u + h1 * v)
        s0, s1, s2 = v0 + rho * g0, v1 + rho * g1, v2 + rho * g2
        lanes[(ACROSS) * LANES + k], lanes[(ACROSS + 1) * LANES + k] = s1 * h2 - s2 * h1, s2 * h0 - s0 * h2
        lanes[(ACROSS + 2) * LANES + k], lanes[(ACROSS + 3) * LANES + k] = s0 * h1 - s1 * h0, rho * h0
        lanes[(ACROSS + 4) * LANES + k], lanes[(ACROSS + 5) * LANES + k], lanes[(ACROSS + 6) * LANES + k] = (
            rho * h1,
            rho * h2,
            beside,
        )
        lanes[16 * LANES + k], lanes[17 * LANES + k], lanes[18 * LANES + k] = h0, h1, h2
        lanes[19 * LANES + k] = told * np.sqrt(variance * noise_b) * (per_length if seen else 0.0)


@leaf
def add_products(lanes: FloatArray, first: int, size: int, weight: int, weighted: FloatArray, sums: FloatArray) -> None:
    """Adds the weighted products of all pairs of so many rows, the lower triangle, to sums (size, size, LANES / 4).

    Each sum is in as many parts as are worked on at once; a number that is known beforehand would unroll the loop instead.
    """
    parts = sums.shape[2]
    for k in range(size):
        for i in range(LANES):
            weighted[i] = lanes[weight * LANES + i] * lanes[(first + k) * LANES + i]
        for j in range(k + 1):
            row, into = lanes[(first + j) * LANES : (first + j + 1) * LANES], sums[k, j]
            for i in range(parts):
                into[i] += (weighted[i] * row[i] + weighted[PART + i] * row[PART + i]) + (
                    weighted[2 * PART + i] * row[2 * PART + i] + weighted[3 * PART + i] * row[3 * PART + i]
                )


@leaf
def total(parts: FloatArray) -> float:
    """Of the parts of a sum."""
    return float(((parts[0] + parts[4]) + (parts[1] + parts[5])) + ((parts[2] + parts[6]) + (parts[3] + parts[7])))


@leaf
def add_stretch(lanes: FloatArray, some: int, turned: FloatArray, unit: float, stretch: FloatArray) -> float:
    """Adds W Jρ² ∂log|Jρ| by (w, d) of some matches to stretch (6,); returns W Jρ²."""
    h0, h1, h2, all_of_them = 0.0, 0.0, 0.0, 0.0
    for k in range(some):
        length = lanes[15 * LANES + k]
        share = lanes[10 * LANES + k] * length
        h0 += share * lanes[12 * LANES + k]
        h1 += share * lanes[13 * LANES + k]
        h2 += share * lanes[14 * LANES + k]
        all_of_them += share * length
    stretch[0] += unit * (turned[1] * h2 - turned[2] * h1)
    stretch[1] += unit * (turned[2] * h0 - turned[0] * h2)
    stretch[2] += unit * (turned[0] * h1 - turned[1] * h0)
    stretch[3] += unit * h0
    stretch[4] += unit * h1
    stretch[5] += unit * h2
    return all_of_them


@kernel
def add_missing(lane: FloatArray, missing: FloatArray) -> None:
    """Adds what is missing of a match that may be another's."""
    said = np.empty(6 + SURFACE)
    for k in range(6 + SURFACE):
        said[k] = lane[10] * lane[ALONG + k] * lane[ALONG + 12]
        if k < 6:
            said[k] += lane[11] * lane[ACROSS + k] * lane[ACROSS + 6]
    if lane[11] > 0.0:
        for k in range(6 + SURFACE):
            for j in range(6 + SURFACE):
                missing[k, j] += (1.0 - lane[4]) / lane[4] * said[k] * said[j]


@kernel
def add_noise(
    lanes: FloatArray, some: int, variance: float, unit: float, rc: FloatArray, turned: FloatArray, noise: FloatArray
) -> None:
    """Adds the expected square of what noise in x (both coordinates) and in ρ does to the rows of some matches.

    What moves by c in the camera's axes moves the image by h·c, and the row's turn by c × h: of all matches the products of
    h are enough.
    """
    h, cross, by = np.zeros((2, 3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for k in range(some):
        for across in range(2):
            w = lanes[(10 + across) * LANES + k]
            told = unit * lanes[19 * LANES + k]
            for i in range(3):
                x = w * lanes[(12 + 4 * across + i) * LANES + k]
                for j in range(i + 1):
                    square = x * lanes[(12 + 4 * across + j) * LANES + k]
                    h[0, i, j] += variance * square
                    if across == 1:
                        h[1, i, j] += told * told * square
    for source in range(3):
        c0, c1, c2 = (turned[0], turned[1], turned[2]) if source == 2 else (rc[0, source], rc[1, source], rc[2, source])
        cross[0, 1], cross[0, 2], cross[1, 2] = -c2, c1, -c0
        cross[1, 0], cross[2, 0], cross[2, 1] = c2, -c1, c0
        of = h[1] if source == 2 else h[0]
        for i in range(3):
            for j in range(i):
                of[j, i] = of[i, j]
        for i in range(3):
            for j in range(3):
                by[i, j] = cross[i, 0] * of[0, j] + cross[i, 1] * of[1, j] + cross[i, 2] * of[2, j]
        for i in range(3):
            for j in range(3):
                noise[i, j] += by[i, 0] * cross[j, 0] + by[i, 1] * cross[j, 1] + by[i, 2] * cross[j, 2]
                if source == 2:
                    noise[i, 3 + j] += by[i, j]
                    noise[3 + j, i] += by[i, j]
                    noise[3 + i, 3 + j] += of[i, j]
