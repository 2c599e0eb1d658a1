"""A second body among the matches that the first one's motion leaves over: the larger is given, the other's share is said.

What is left over by the robust fit is mismatches, which go anywhere, or another body, whose neighbours go alike. Where they
do, a motion is fitted to what is left over, and each motion again to all that the other has not taken. The one that more
matches agree with is the object's; where they are nearly as many, nobody can know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel, median_of
from sylpose.matches import STILL_PX
from sylpose.relative_pose.fit import MIN_MATCHES, Solve, Solved
from sylpose.relative_pose.leave_one_out import solved_part
from sylpose.relative_pose.solver import fit_apart
from sylpose.relative_pose.terms import TermData
from sylpose.results import Status

__all__ = ["Bodies", "larger_body"]

# What is left over is looked at where it is more than this share of the inliers, in two cameras at least; a body is more
# than the second (choice).
LEFT_OVER, A_BODY = 0.1, 0.25
# Neighbours go alike where their displacements differ by less than this share of what those of any two matches do, in the
# median: mismatches come to 1, give or take 0.2 (choice).
ALIKE = 0.5
# So many matches of a camera are compared, at most (choice).
COMPARED = 100
# Where the first is left with the same matches but for this share of them, the second has what it had (choice).
SAME = 0.05
# A camera sees both where each has so large a share of its matches (choice).
OF_BOTH = 0.1
# Of two bodies, one with more than this share of the other's matches might be the object as well (choice).
AS_LARGE = 0.8


class Bodies(NamedTuple):
    """The larger of two bodies' motions.

    Attributes:
        solved: its solution.
        share: the other's inliers over its own; 0 where there is no other.
    """

    solved: Solved
    share: float


def larger_body(data: Sequence[TermData], solved: Solved, solve: Solve, least_px: float = 0.0) -> Bodies:
    """The solution, or that of a larger body that it left over.

    Args:
        data: the terms of the solution, all in one reference frame.
        solve: solves a part of them.
        least_px: noise that is believed at least, pixels.
    """
    inliers = [w > 0 for w in solved.fit.weights]
    if sum(len(t) for t in data) < (1.0 + LEFT_OVER) * _count(inliers):
        return Bodies(solved, 0.0)
    left = [_left_over(t.x, t.y, STILL_PX / t.focal, w) for t, w in zip(data, solved.fit.weights, strict=True)]
    # A camera all of whose matches are left over is at fault, and sees no second body.
    for mask, inlier in zip(left, inliers, strict=True):
        if inlier.sum() < MIN_MATCHES or mask.sum() < MIN_MATCHES:
            mask[:] = False
    if sum(bool(m.any()) for m in left) < min(2, len(data)) or _count(left) < LEFT_OVER * _count(inliers):
        return Bodies(solved, 0.0)
    if not _go_alike(data, left):
        return Bodies(solved, 0.0)
    second = solved_part(data, left, solve)
    if not _is_body(second, solved):
        return Bodies(solved, 0.0)
    assert second is not None
    # What each has taken by mistake, the other may have now.
    first = solved_part(data, [~(w > 0) for w in second.fit.weights], solve)
    if first is None or first.fit.status is Status.NO_MOTION:
        return Bodies(solved, 0.0)
    taken = [w > 0 for w in first.fit.weights]
    if _count([a != b for a, b in zip(taken, inliers, strict=True)]) > SAME * _count(inliers):
        again = solved_part(data, [~m for m in taken], solve)
        second = again if again is not None and again.fit.status is not Status.NO_MOTION else second
    counts = [_count([w > 0 for w in s.fit.weights]) for s in (first, second)]
    larger, smaller = (first, second) if counts[0] >= counts[1] else (second, first)
    # About the same centre: both were solved for a place of their own.
    shift = smaller.fit.shift + (smaller.fit.rotation - np.eye(3)) @ (larger.center - smaller.center)
    other = replace(smaller.fit, shift=shift)
    between = fit_apart(data, larger.center, larger.radius, larger.fit, other, least_px)
    share = min(counts) / max(counts)
    if between is not None and between[0].status is Status.OK and not between[0].mixed:
        larger, having = larger._replace(fit=between[0]), between[1]
        share = float(having[1].sum() / having[0].sum())
        # What is at fault with a camera it has of all matches.
        body = int((having.min(axis=0) > OF_BOTH * having.sum(axis=0)).sum()) >= min(2, len(data))
    else:
        body = _count(left) > A_BODY * _count(inliers)
    if not body or share < A_BODY:
        return Bodies(solved, 0.0)
    if share > AS_LARGE:
        larger = larger._replace(fit=replace(larger.fit, other=(smaller.fit.rotation, shift)))
    return Bodies(larger, share)


def _is_body(second: Solved | None, first: Solved) -> bool:
    """Whether what was left over has a motion, of enough of the first one's number of matches."""
    if second is None or second.fit.status is Status.NO_MOTION:
        return False
    counts = [_count([w > 0 for w in s.fit.weights]) for s in (first, second)]
    return counts[1] > LEFT_OVER * counts[0]


def _go_alike(data: Sequence[TermData], left: Sequence[BoolArray]) -> bool:
    """Whether neighbours among the matches that are left over are displaced alike."""
    compared = []
    for term, mask in zip(data, left, strict=True):
        if mask.any():
            compared.append(term.focal * _displaced(term.x, term.y, mask))
    near, far, moved = np.median(np.concatenate(compared), axis=0).tolist()
    # Of a body that shifts, any two go alike.
    return bool(near < ALIKE * max(np.sqrt(2.0) * far, 0.5 * moved))


@kernel
def _left_over(x: FloatArray, y: FloatArray, still: float, weights: FloatArray) -> BoolArray:
    """(n,) matches without weight that do not stand still."""
    out = np.empty(len(x), np.bool_)
    for i in range(len(x)):
        out[i] = not weights[i] > 0.0 and np.hypot(y[i, 0] - x[i, 0], y[i, 1] - x[i, 1]) > still
    return out


@kernel
def _displaced(x: FloatArray, y: FloatArray, mask: BoolArray) -> FloatArray:
    """(m, 3) how far some of the masked matches are displaced otherwise than the nearest of them, than the median of them,
    and than nothing."""
    some = np.flatnonzero(mask)
    some = some[:: 1 + len(some) // COMPARED]
    n = len(some)
    out, middle, by = np.empty((n, 3)), np.empty(2), np.empty((n, 2))
    column = np.empty(n)
    for a in range(2):
        for i in range(n):
            by[i, a] = y[some[i], a] - x[some[i], a]
            column[i] = by[i, a]
        middle[a] = median_of(column)
    for i in range(n):
        least, nearest = np.inf, i
        for j in range(n):
            square = (x[some[i], 0] - x[some[j], 0]) ** 2 + (x[some[i], 1] - x[some[j], 1]) ** 2
            if j != i and square < least:
                least, nearest = square, j
        out[i, 0] = np.sqrt((by[i, 0] - by[nearest, 0]) ** 2 + (by[i, 1] - by[nearest, 1]) ** 2)
        out[i, 1] = np.sqrt((by[i, 0] - middle[0]) ** 2 + (by[i, 1] - middle[1]) ** 2)
        out[i, 2] = np.sqrt(by[i, 0] ** 2 + by[i, 1] ** 2)
    return out


def _count(masks: Sequence[BoolArray]) -> int:
    return int(sum(m.sum() for m in masks))
