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
from sylpose.two_frames.lanes import (
    ACROSS,
    ALONG,
    BY_LANE,
    LANES,
    PART,
    Tolerance,
    add_missing,
    add_noise,
    add_products,
    add_stretch,
    miss_by,
    total,
)
from sylpose.two_frames.term_view import view_of
from sylpose.two_frames.terms import SURFACE, Candidate, Stack

__all__ = [
    "Equations",
    "Matched",
    "Tolerance",
    "Usable",
    "distances",
    "match_equations",
    "matched",
    "no_equations",
    "no_matched",
]


# Matches that may have a weight, or with which probability.
Usable = BoolArray | FloatArray


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
    hessian, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    return Equations(hessian, gradient, np.zeros(6), np.zeros(1), np.zeros((size, size)), np.zeros((lost, lost)))


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
def distances(
    stack: Stack, t: int, usable: Usable, candidate: Candidate, tolerance: Tolerance, matches: Matched
) -> None:
    """The part of `match_equations` that says where the matches of term t are."""
    rc, tc, turned, lanes = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(BY_LANE * LANES)
    view_of(stack, t, candidate, rc, tc, turned)
    for start in range(stack.offsets[t], stack.offsets[t + 1], LANES):
        _some_matches(stack, t, start, usable, candidate, tolerance, lanes, rc, tc, turned, matches)


@kernel
def _some_matches(
    stack: Stack,
    t: int,
    start: int,
    usable: Usable,
    candidate: Candidate,
    tolerance: Tolerance,
    lanes: FloatArray,
    rc: FloatArray,
    tc: FloatArray,
    turned: FloatArray,
    matches: Matched,
) -> int:
    """The lanes of term t's matches from `start` on, and where they are; returns how many there are."""
    some = min(LANES, stack.offsets[t + 1] - start)
    for k in range(LANES):
        # The last match fills up, without weight.
        i = start + min(k, some - 1)
        lanes[k], lanes[LANES + k] = stack.x[i, 0], stack.x[i, 1]
        lanes[2 * LANES + k], lanes[3 * LANES + k] = stack.y[i, 0], stack.y[i, 1]
        lanes[4 * LANES + k] = usable[i] if k < some else 0.0
    miss_by(stack, t, candidate.surface[t], tolerance, rc, tc, turned, lanes)
    for k in range(some):
        i = start + k
        matches.distance[i], matches.across[i] = lanes[5 * LANES + k], lanes[6 * LANES + k]
        matches.along[i], matches.parallax[i] = lanes[7 * LANES + k], lanes[8 * LANES + k]
        matches.weights[i] = lanes[9 * LANES + k]
    return int(some)


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
    matrix, right, stretch, squares, noise, missing = equations
    rc, tc, turned = np.empty((3, 3)), np.empty(3), np.empty(3)
    view_of(stack, t, candidate, rc, tc, turned)
    matrix[:] = 0.0
    right[:] = 0.0
    stretch[:] = 0.0
    squares[:] = 0.0
    noise[:] = 0.0
    missing[:] = 0.0
    lanes, weighted = np.empty(BY_LANE * LANES), np.empty(LANES)
    along, across = np.zeros((13, 13, PART)), np.zeros((7, 7, PART))
    first, last = stack.offsets[t], stack.offsets[t + 1]
    for start in range(first, last, LANES):
        some = _some_matches(stack, t, start, usable, candidate, tolerance, lanes, rc, tc, turned, matches)
        add_products(lanes, ALONG, 13, 10, weighted, along)
        add_products(lanes, ACROSS, 7, 11, weighted, across)
        squares[0] += add_stretch(lanes, some, turned, stack.inverse_depth[t], stretch)
        if noise.shape[0] > 0:
            add_noise(lanes, some, tolerance.variance, stack.inverse_depth[t], rc, turned, noise)
        if missing.shape[0] > 0:
            for k in range(some):
                if lanes[9 * LANES + k] > 0.0:
                    add_missing(lanes[k::LANES], missing)
    for k in range(12):
        right[k] = total(along[12, k])
        for j in range(k + 1):
            matrix[k, j] = total(along[k, j])
    for k in range(6):
        right[k] += total(across[6, k])
        for j in range(k + 1):
            matrix[k, j] += total(across[k, j])
