"""The terms of one motion problem: what each camera saw between a reference frame and the current one.

A **term** is the matches of one camera between two frames. All terms share one pair of unknowns, the motion
X_j = R (X_i - g) + g + d about the object's centre g. With a1 = (camera's centre at frame i) - g and a2 = (the same at
frame j) - g, in the world's axes, a feature of inverse depth ρ on the ray x is seen in frame j along

    y ~ R x + ρ τ,      τ = R a1 - a2 + d

A static camera has a1 = a2. When the reference is not the frame that the motion starts from, the known motion between the
two moves the camera instead, so several references are more terms of the same problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import kernel, leaf, turn_by
from sylpose.relative_pose.ray_intersection import ROUNDING, misplaced, placed

__all__ = [
    "ROUNDING",
    "SURFACE",
    "Candidate",
    "Guesses",
    "Joined",
    "Stack",
    "TermData",
    "copy_into",
    "guesses_of",
    "join",
    "object_place",
    "stack_terms",
    "take_step",
]


# Unknowns of a term's surface: the inverse depth, in units of that of g, is α·(1, p, q, p², pq, q²) with (p, q) the place in
# the image, from the anchor and in units of the spread (derived).
SURFACE = 6
# The prior of the last word (`match_cost`): what is believed of the surface before anything is measured, in radii of the
# object (`object_place`). Bodies are something between flat, at g, and a sphere about g, whose visible side bulges towards
# the camera by 0.34 and lies 0.72 nearer: half of that, give or take half (derived). Beyond that, offset and curvatures
# scatter by so much, ... (choice)
BULGE, OFFSET_PER_BULGE = 0.15, 2.1
OFFSET_SD, CURVATURE_SD = 0.3, 0.12
# ... slopes by this, with Cauchy's tails, since a plane may be seen at a grazing angle, and the relief about it all is this
# (choice).
SLOPE_SD = 0.4
RELIEF_SD = 0.25
# The prior of the first look (`moments_cost`): a plane through the visible side alone, as much nearer than g as the quadric
# is at the anchor (derived, rounded); with Gauss's tails, so wider than Cauchy's, and all else for relief (choice).
PLANE_OFFSET, PLANE_OFFSET_SD, PLANE_SLOPE_SD, PLANE_RELIEF_SD = 0.3, OFFSET_SD, 1.0, 0.3
# In a first look the inverse depth of g is never believed to be worse known than this (choice).
FARTHEST = 0.3
# What is believed of a surface, in radii of the object, less the 1 of its inverse depth; slopes, which are per spread, come
# on their own (derived).
_MEAN = np.array([OFFSET_PER_BULGE, 0.0, 0.0, -1.0, 0.0, -1.0]) * BULGE
_SCATTER = np.array([OFFSET_SD, 1.0, 1.0, CURVATURE_SD, CURVATURE_SD, CURVATURE_SD])
_INFORMATION = np.linalg.inv(np.outer(_MEAN, _MEAN) + np.diag(_SCATTER**2))

# Others believe the same of the visible side of a body, in their own unknowns:
# - `sylvester.depth_plane_kernels`: a plane without an offset, which moments about the mean do not have; any normal is as
#   likely (slopes about 1); relief 0.3 of the points' spread, its own unknown.
# - `sylvester.affine_consensus`: no depth but the affine image of a plane: slopes of 0.5, near `SLOPE_SD`, with a tail as
#   where any normal is as likely; relief is a part of what that image leaves over, more with the turn.
# - `landmarks.landmark_filter.depth_prior`: depths of neighbours that are known, so their scatter, of 0.3 to 1
# radii: no less than
#   `OFFSET_SD`, no more than a body is deep. Its bulge of 0.5 radii, of one camera with boxes, is a body between flat and
#   round again: half of what a sphere's middle lies nearer than g.
# - `landmarks.alignment`: a plane's three unknowns of variance 1, in units of each landmark's own uncertainty.


@dataclass(frozen=True, eq=False)
class TermData:
    """The matches of one camera between one reference frame and the current frame.

    Attributes:
        camera: index in the rig.
        x, y: (n, 2) normalised points in the reference and in the current frame.
        rotation: (3, 3) Q of camera_from_world.
        center: (3,) the camera's centre, world.
        focal: pixels per normalised unit.
        base_from_reference: moves the object from where it was in the reference frame to the frame that the motion
            starts from; None for that frame itself.
    """

    camera: int
    x: FloatArray
    y: FloatArray
    rotation: FloatArray
    center: FloatArray
    focal: float
    base_from_reference: RigidTransform | None = None

    def __len__(self) -> int:
        return len(self.x)

    def subset(self, index: BoolArray | IntArray) -> TermData:
        """The matches that a mask or an index array picks."""
        return replace(self, x=self.x[index], y=self.y[index])

    @cached_property
    def center_x(self) -> FloatArray:
        """(3,) the camera's centre seen from the object at the motion's start."""
        if self.base_from_reference is None:
            return self.center
        return np.asarray(self.base_from_reference.apply(self.center))

    @cached_property
    def rotation_x(self) -> FloatArray:
        """(3, 3) Q of the camera that the object, at the motion's start, sees the reference frame from."""
        if self.base_from_reference is None:
            return self.rotation
        return np.asarray(self.rotation @ self.base_from_reference.rotation.as_matrix().T)


class Stack(NamedTuple):
    """All terms of one problem as arrays, for the compiled solver (T terms, N matches in all).

    Attributes:
        x, y: (N, 2) normalised points, term after term.
        offsets: (T + 1,) term t has the matches offsets[t] to offsets[t + 1].
        qx, qy: (T, 3, 3) rotation of the camera in the reference frame and now.
        a1, a2: (T, 3) its centre, relative to g.
        anchor: (T, 2) g in the image of the reference frame: where the surface is anchored.
        spread: (T,) half of the object's radius there: about the median distance of its points from the anchor.
        inverse_depth: (T,) of g in the reference frame.
        surface_mean: (T, 6), surface_information: (T, 6, 6) prior of the surface (`SURFACE`), if g is the object's centre.
        place: (T,) by how much α's mean, its first coefficient, changes with the one unknown that says by how much it is
            not: how far away all terms' surfaces are, in standard deviations of what is believed of it.
        relief: (T,) prior standard deviation of the inverse depth about that surface, in units of g's.
        plane_mean, plane_sd: (T, 3), plane_relief: (T,) the same of a plane, for a first look.
        focal: (T,) pixels per normalised unit.
        least_px: noise that is believed at least, pixels.
    """

    x: FloatArray
    y: FloatArray
    offsets: IntArray
    qx: FloatArray
    qy: FloatArray
    a1: FloatArray
    a2: FloatArray
    anchor: FloatArray
    spread: FloatArray
    inverse_depth: FloatArray
    surface_mean: FloatArray
    surface_information: FloatArray
    place: FloatArray
    relief: FloatArray
    plane_mean: FloatArray
    plane_sd: FloatArray
    plane_relief: FloatArray
    focal: FloatArray
    least_px: float


class Candidate(NamedTuple):
    """A motion and the terms' surfaces: what a solver starts from and, in place, comes to.

    Attributes:
        rotation: (3, 3) R.
        shift: (3,) d.
        surface: (T, 6) α, or (T, 3) of a plane, for a first look.
    """

    rotation: FloatArray
    shift: FloatArray
    surface: FloatArray

    def copied(self) -> Candidate:
        """The same, in arrays of its own."""
        return Candidate(self.rotation.copy(), self.shift.copy(), self.surface.copy())


@leaf
def copy_into(to: Candidate, source: Candidate) -> None:
    """to becomes equal to source."""
    for i in range(3):
        to.shift[i] = source.shift[i]
        for j in range(3):
            to.rotation[i, j] = source.rotation[i, j]
    for t in range(to.surface.shape[0]):
        for k in range(to.surface.shape[1]):
            to.surface[t, k] = source.surface[t, k]


@kernel
def take_step(candidate: Candidate, place: FloatArray, step: FloatArray, gains: FloatArray, length: float) -> None:
    """candidate and place (1,) change by `length` times a step (7,), the surfaces as their gains (T, 6, 8) say."""
    turn, turned = length * step[:3], np.empty((3, 3))
    turn_by(turn, candidate.rotation, turned)
    candidate.rotation[:] = turned
    for i in range(3):
        candidate.shift[i] += length * step[3 + i]
    place[0] += length * step[6]
    for t in range(gains.shape[0]):
        for k in range(SURFACE):
            change = gains[t, k, 7]
            for j in range(7):
                change -= gains[t, k, j] * step[j]
            candidate.surface[t, k] += length * change


class Guesses(NamedTuple):
    """G motions to start from besides the built-in ones: rotations (G, 3, 3), shifts (G, 3)."""

    rotations: FloatArray
    shifts: FloatArray


def guesses_of(motions: Sequence[tuple[FloatArray, FloatArray]]) -> Guesses:
    """Motions (R, d) as arrays."""
    rotations, shifts = [r for r, _ in motions], [d for _, d in motions]
    return Guesses(np.array(rotations, dtype=float).reshape(-1, 3, 3), np.array(shifts, dtype=float).reshape(-1, 3))


class Joined(NamedTuple):
    """What terms are given as, joined: `Stack` has it about the object's centre.

    Attributes:
        x, y, offsets, qx, qy, focal: as in `Stack`.
        cx, cy: (T, 3) the cameras' centres in the reference frame and now.
    """

    x: FloatArray
    y: FloatArray
    offsets: IntArray
    qx: FloatArray
    qy: FloatArray
    cx: FloatArray
    cy: FloatArray
    focal: FloatArray


def join(data: Sequence[TermData]) -> Joined:
    """Terms, each with a match at least."""
    x, y = np.concatenate([term.x for term in data]), np.concatenate([term.y for term in data])
    qy, cy = np.concatenate([term.rotation for term in data]), np.concatenate([term.center for term in data])
    qx, cx = qy, cy
    if any(term.base_from_reference is not None for term in data):
        qx, cx = np.concatenate([term.rotation_x for term in data]), np.concatenate([term.center_x for term in data])
    offsets = np.array([0, *accumulate(len(term) for term in data)])
    turns, focal = (qx.reshape(-1, 3, 3), qy.reshape(-1, 3, 3)), np.array([term.focal for term in data], dtype=float)
    return Joined(x, y, offsets, *turns, cx.reshape(-1, 3), cy.reshape(-1, 3), focal)


def stack_terms(
    data: Sequence[TermData], center: FloatArray, radius: float, joined: Joined | None = None, least_px: float = 0.0
) -> Stack:
    """Stack terms, each with a match at least.

    Args:
        center: (3,) g.
        radius: of the object, length units.
        joined: the terms, where that has been done.
        least_px: noise that is believed at least, pixels.
    """
    return _laid_out(join(data) if joined is None else joined, center, float(radius), float(least_px))


@kernel
def _laid_out(joined: Joined, center: FloatArray, radius: float, least_px: float) -> Stack:
    """About g, with what is believed of the surfaces."""
    n = len(joined.focal)
    stack = Stack(
        joined.x,
        joined.y,
        joined.offsets,
        joined.qx,
        joined.qy,
        joined.cx - center,
        joined.cy - center,
        np.empty((n, 2)),
        np.empty(n),
        np.empty(n),
        np.empty((n, SURFACE)),
        np.empty((n, SURFACE, SURFACE)),
        np.empty(n),
        np.empty(n),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty(n),
        joined.focal,
        least_px,
    )
    _believe(stack, radius)
    return stack


@kernel
def _believe(stack: Stack, radius: float) -> None:
    """What is believed of all surfaces before anything is measured."""
    place_sd = stack.place
    misplaced(stack.a1, stack.qx, OFFSET_SD, place_sd)
    scale = np.empty(SURFACE)
    for t in range(len(place_sd)):
        q, a = stack.qx[t], stack.a1[t]
        place = -(q[2, 0] * a[0] + q[2, 1] * a[1] + q[2, 2] * a[2])
        depth = max(abs(place), 1e-12)
        for i in range(2):
            stack.anchor[t, i] = -(q[i, 0] * a[0] + q[i, 1] * a[1] + q[i, 2] * a[2]) / depth
        # An object that reaches to its camera: its depth is bounded as well as can be.
        share = min(radius / depth, 1.0)
        spread = 0.5 * share
        stack.inverse_depth[t], stack.spread[t] = 1.0 / depth, spread
        scale[:] = 1.0 / share
        scale[1:3] = 1.0 / (SLOPE_SD * spread)
        for k in range(SURFACE):
            stack.surface_mean[t, k] = share * _MEAN[k] + (1.0 if k == 0 else 0.0)
            for j in range(SURFACE):
                stack.surface_information[t, k, j] = _INFORMATION[k, j] * scale[k] * scale[j]
        stack.relief[t], stack.plane_relief[t] = RELIEF_SD * share, PLANE_RELIEF_SD * share
        # In a first look lengths may as well be wrong as depths negative.
        stack.plane_sd[t, 0] = min(np.hypot(PLANE_OFFSET_SD, place_sd[t]) * share, FARTHEST)
        stack.plane_mean[t, 0] = 1.0 + PLANE_OFFSET * share
        for j in range(1, 3):
            stack.plane_mean[t, j], stack.plane_sd[t, j] = 0.0, PLANE_SLOPE_SD * spread
        place_sd[t] *= share


def object_place(data: Sequence[TermData], joined: Joined | None = None) -> tuple[FloatArray, float]:
    """Where the object is and how large, from the matched points of the reference frame.

    Returns:
        center (3,), the point nearest to the rays through each camera's median point (at distance 1 with one camera);
        radius, length units: twice the median distance of points from it.
    """
    x, _, offsets, turns, _, centers, _, _ = join(data) if joined is None else joined
    center = np.empty(3)
    return center, float(placed(x, offsets, turns, centers, OFFSET_SD, center))
