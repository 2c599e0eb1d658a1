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

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.plane_projection import view_of
from sylpose.relative_pose.simd_kernels import (
    ACROSS,
    ALONG,
    BY_LANE,
    LANES,
    PART,
    Place,
    Tolerance,
    add_missing,
    add_noise,
    add_products,
    add_stretch,
    miss_by,
    total,
)
from sylpose.relative_pose.terms import SURFACE, Candidate, Stack

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
    place, surface = _place(stack, t), candidate.surface[t]
    first, last = stack.offsets[t], stack.offsets[t + 1]
    for start in range(first, last, LANES):
        some = min(LANES, last - start)
        _some_matches(stack.x, stack.y, usable, start, some, place, surface, tolerance, lanes, rc, tc, turned, matches)


@leaf
def _place(stack: Stack, t: int) -> Place:
    """Of term t."""
    return Place(stack.inverse_depth[t], 1.0 / stack.spread[t], stack.anchor[t, 0], stack.anchor[t, 1])


@leaf
def _copy(lanes: FloatArray, lane: int, to: FloatArray) -> None:
    """One of the lanes, as far as there are matches."""
    for k in range(len(to)):
        to[k] = lanes[lane * LANES + k]


@leaf
def _some_matches(
    x: FloatArray,
    y: FloatArray,
    usable: Usable,
    start: int,
    some: int,
    place: Place,
    surface: FloatArray,
    tolerance: Tolerance,
    lanes: FloatArray,
    rc: FloatArray,
    tc: FloatArray,
    turned: FloatArray,
    matches: Matched,
) -> None:
    """The lanes of some matches from `start` on, and where they are."""
    x, y, may = x[start : start + some], y[start : start + some], usable[start : start + some]
    for k in range(some):
        lanes[k], lanes[LANES + k] = x[k, 0], x[k, 1]
        lanes[2 * LANES + k], lanes[3 * LANES + k] = y[k, 0], y[k, 1]
        lanes[4 * LANES + k] = may[k]
    # The last match fills up, without weight.
    for k in range(some, LANES):
        for j in range(4):
            lanes[j * LANES + k] = lanes[j * LANES + some - 1]
        lanes[4 * LANES + k] = 0.0
    miss_by(place, surface, tolerance, rc, tc, turned, lanes)
    last = start + some
    _copy(lanes, 5, matches.distance[start:last])
    _copy(lanes, 6, matches.across[start:last])
    _copy(lanes, 7, matches.along[start:last])
    _copy(lanes, 8, matches.parallax[start:last])
    _copy(lanes, 9, matches.weights[start:last])


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
    place, surface, unit = _place(stack, t), candidate.surface[t], stack.inverse_depth[t]
    for start in range(first, last, LANES):
        some = min(LANES, last - start)
        _some_matches(stack.x, stack.y, usable, start, some, place, surface, tolerance, lanes, rc, tc, turned, matches)
        add_products(lanes, ALONG, 13, 10, weighted, along)
        add_products(lanes, ACROSS, 7, 11, weighted, across)
        squares[0] += add_stretch(lanes, some, turned, unit, stretch)
        if noise.shape[0] > 0:
            add_noise(lanes, some, tolerance.variance, unit, rc, turned, noise)
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
