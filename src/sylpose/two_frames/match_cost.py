"""The last word: where every match ought to be, in full perspective, and the normal equations of what they miss by.

`moments_cost`, the first look, found the way here.

A feature lies on its ray x at the inverse depth ρ of its term's surface, a quadric whose six coefficients α are unknown
beside the motion, give or take a relief ζ. With e = y - image(R x + ρ τ), its derivatives J and
V = σ² (I + Jx Jx') + ζ² Jρ Jρ',

    d² = e' V^-1 e = across² / σ² + along² / (σ² + ζ² parallax²)

so d² is chi-squared with two degrees of freedom whatever the parallax: where it is below the noise, both coordinates of a
match measure the motion; where it is large, only the one across its epipolar line does.

Source: errors in variables by linearised covariance, Hartley & Zisserman, section 5.2; Sampson's distance, ibid. 11.4.3;
the rest is ours (docs/method.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.numerics.arrays import BoolArray, FloatArray
from sylpose.numerics.compiled import kernel
from sylpose.numerics.normal_equations import image_row
from sylpose.numerics.robust import bisquare
from sylpose.two_frames.moments_cost import view_of
from sylpose.two_frames.terms import SURFACE, Candidate, Stack

__all__ = ["Equations", "Matched", "Tolerance", "Usable", "match_equations", "matched", "no_equations", "no_matched"]


# Matches that may have a weight, or with which probability.
Usable = BoolArray | FloatArray


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


class Matched(NamedTuple):
    """How far each of N matches is from where the motion and its term's surface put it.

    Attributes:
        distance: (N,) d²; infinite for a point that the motion takes behind its camera.
        across: (N,) distance across the epipolar line over √(n'(I + Jx Jx')n): Sampson's distance, signed, with σ as its
            standard deviation.
        along: (N,) distance along it, likewise normalised by √(b'(I + Jx Jx')b).
        parallax: (N,) by how many of these units a unit of inverse depth (of g's) moves it along.
        weights: (N,) bisquare.
    """

    distance: FloatArray
    across: FloatArray
    along: FloatArray
    parallax: FloatArray
    weights: FloatArray


class Equations(NamedTuple):
    """The weighted normal equations of one term, in the axes of its current camera.

    Attributes:
        matrix: (12, 12) lower triangle of J'WJ in (w, d, α).
        right: (12,) J'We.
        stretch: (6,) Σ W Jρ² ∂log|Jρ| by (w, d): how the motion stretches the parallax.
        squares: (1,) Σ W Jρ².
        noise: (6, 6) the part of J'WJ in (w, d) that is there because J is taken at noisy points: it tells nothing, but a
            small motion, or a rod that is seen to turn about itself, would be thought known by it. (0, 0) where it is not
            wanted.
        missing: (12, 12) the part of J'WJ that is there because matches which may be another's are taken to be the motion's,
            each with its probability p: p (1 - p) times the square of what it says of (w, d, α). (0, 0) where it is not
            wanted.
    """

    matrix: FloatArray
    right: FloatArray
    stretch: FloatArray
    squares: FloatArray
    noise: FloatArray
    missing: FloatArray


@kernel
def no_matched(n: int) -> Matched:
    """Of n matches, to be filled."""
    return Matched(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n))


@kernel
def no_equations(noise: bool, missing: bool) -> Equations:
    """To be filled, with the parts of noise and of what is missing or without."""
    unknowns, size, lost = 6 + SURFACE, 6 if noise else 0, 6 + SURFACE if missing else 0
    return Equations(
        np.zeros((unknowns, unknowns)),
        np.zeros(unknowns),
        np.zeros(6),
        np.zeros(1),
        np.zeros((size, size)),
        np.zeros((lost, lost)),
    )


def matched(
    stack: Stack,
    t: int,
    candidate: Candidate,
    tolerance: Tolerance,
    usable: Usable | None = None,
    *,
    noise: bool = True,
) -> tuple[Matched, Equations]:
    """`match_equations` of term t; of `Matched`, its own matches."""
    n = len(stack.x)
    matches, equations = no_matched(n), no_equations(noise, False)
    some = np.ones(n) if usable is None else usable.astype(np.float64)
    match_equations(stack, t, some, candidate, tolerance, matches, equations)
    mine = slice(stack.offsets[t], stack.offsets[t + 1])
    return Matched(*(values[mine] for values in matches)), equations


@kernel
def match_equations(
    stack: Stack,
    t: int,
    usable: Usable,
    candidate: Candidate,
    tolerance: Tolerance,
    matches: Matched,
    equations: Equations,
) -> None:
    """Where the matches of term t are and what they say of the motion.

    Args:
        usable: (N,) matches that may have a weight, or the probability of each that it is one of them.
        candidate: with quadrics as surfaces.
        matches: of all terms; the term's own part is filled.
        equations: filled.
    """
    variance, relief, shared_relief, cutoff = tolerance
    distance, across, along, parallax, weights = matches
    matrix, right, stretch, squares, noise, missing = equations
    surface = candidate.surface[t]
    rc, tc, turned = np.empty((3, 3)), np.empty(3), np.empty(3)
    view_of(stack, t, candidate, rc, tc, turned)
    unit, spread = stack.inverse_depth[t], stack.spread[t]
    c0, c1 = stack.anchor[t, 0], stack.anchor[t, 1]
    matrix[:] = 0.0
    right[:] = 0.0
    stretch[:] = 0.0
    squares[:] = 0.0
    noise[:] = 0.0
    missing[:] = 0.0
    phi, row, said = np.empty(SURFACE), np.empty(6), np.empty(6 + SURFACE)
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
        weights[i] = usable[i] * bisquare(distance[i] / (cutoff * cutoff))
        if not weights[i] > 0.0:
            continue
        # Along the line: where the surface puts it.
        w = weights[i] / (variance * noise_b + (shared_relief * length) ** 2)
        image_row(b0, b1, u, v, z, r0 + rho * turned[0], r1 + rho * turned[1], r2 + rho * turned[2], rho, row)
        for k in range(6):
            for j in range(k + 1):
                matrix[k, j] += w * row[k] * row[j]
                matrix[6 + k, 6 + j] += w * length * length * phi[k] * phi[j]
            for j in range(6):
                matrix[6 + j, k] += w * row[k] * length * phi[j]
            right[k] += w * row[k] * off
            right[6 + k] += w * length * phi[k] * off
        h2, share = -(b0 * u + b1 * v), w * length * unit / z
        stretch[0] += share * (turned[1] * h2 - turned[2] * b1)
        stretch[1] += share * (turned[2] * b0 - turned[0] * h2)
        stretch[2] += share * (turned[0] * b1 - turned[1] * b0)
        stretch[3] += share * b0
        stretch[4] += share * b1
        stretch[5] += share * h2
        squares[0] += w * length * length
        if noise.shape[0] > 0:
            _add_noise(w * variance, 0.0, b0, b1, u, v, z, rc, turned, noise)
        if missing.shape[0] > 0:
            for k in range(6):
                said[k], said[6 + k] = w * row[k] * off, w * length * phi[k] * off
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
        image_row(-b1, b0, u, v, z, r0 + rho * turned[0], r1 + rho * turned[1], r2 + rho * turned[2], rho, row)
        off = b0 * e1 - b1 * e0
        for k in range(6):
            for j in range(k + 1):
                matrix[k, j] += w * row[k] * row[j]
            right[k] += w * row[k] * off
        if noise.shape[0] > 0:
            told = unit * spare / (variance * noise_b + spare) * np.sqrt(variance * noise_b) / max(length, 1e-300)
            _add_noise(w * variance, w * told * told, -b1, b0, u, v, z, rc, turned, noise)
        if missing.shape[0] > 0:
            for k in range(6):
                said[k] += w * row[k] * off
            for k in range(6 + SURFACE):
                for j in range(6 + SURFACE):
                    missing[k, j] += (1.0 - usable[i]) / usable[i] * said[k] * said[j]


@kernel
def _add_noise(
    of_x: float,
    of_rho: float,
    n0: float,
    n1: float,
    u: float,
    v: float,
    z: float,
    rc: FloatArray,
    turned: FloatArray,
    noise: FloatArray,
) -> None:
    """Adds the expected square of what noise in x (both coordinates) and in ρ does to `image_row`."""
    h0, h1 = n0 / z, n1 / z
    h2 = -(h0 * u + h1 * v)
    by = np.empty(6)
    for source in range(3):
        c0, c1, c2 = (turned[0], turned[1], turned[2]) if source == 2 else (rc[0, source], rc[1, source], rc[2, source])
        by[0], by[1], by[2] = c1 * h2 - c2 * h1, c2 * h0 - c0 * h2, c0 * h1 - c1 * h0
        by[3], by[4], by[5] = h0, h1, h2
        size, weight = (6, of_rho) if source == 2 else (3, of_x)
        for k in range(size):
            for j in range(size):
                noise[k, j] += weight * by[k] * by[j]
