"""Terms of a two-frame motion problem: the matches of each camera and the priors on depth.

A **term** is the matches of one camera between a reference frame and the current frame. All terms share one pair of
unknowns, the motion X_j = R (X_i - g) + g + d about the object's center g. With a1 = (camera center at frame i) - g and
a2 = (the same at frame j) - g, in world axes, a feature of inverse depth ρ on the ray x is seen in frame j along

    y ~ R x + ρ τ,      τ = R a1 - a2 + d

A static camera has a1 = a2. If the reference is not the frame in which the motion starts, the known motion between the
two is applied to the camera instead. Several references are therefore more terms of the same problem.

Each term has a **depth model**, which gives the inverse depth of the visible surface over the image: a quadric with six
coefficients α, or a plane with three. The **residual depth** is the spread of the true inverse depths about that model.
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
from sylpose.geometry.numba_linalg import apply_rotvec, kernel, leaf
from sylpose.relative_pose.ray_intersection import COINCIDENCE_TOLERANCE, compute_distance_sd, locate_from_rays

__all__ = [
    "COINCIDENCE_TOLERANCE",
    "DEPTH_MODEL_SIZE",
    "Candidate",
    "InitialMotions",
    "Stack",
    "TermArrays",
    "TermData",
    "apply_step",
    "concatenate_terms",
    "copy_into",
    "locate_object",
    "stack_initial_motions",
    "stack_terms",
]


# Coefficients of a term's depth model. The inverse depth, in units of that of g, is α·(1, p, q, p², pq, q²) with (p, q)
# the image position relative to the anchor, in units of the spread (derived).
DEPTH_MODEL_SIZE = 6
# Prior of the quadric depth model (`match_cost`), in radii of the object (`locate_object`). Bodies range from flat, at
# g, to a sphere about g, whose visible side bulges towards the camera by 0.34 and is 0.72 nearer: the mean is half of
# that, and so is the standard deviation (derived). The additional scatter of offset and curvatures (choice)
BULGE, OFFSET_PER_BULGE = 0.15, 2.1
OFFSET_SD, CURVATURE_SD = 0.3, 0.12
# Scatter of the slopes, with Cauchy tails because a plane may be seen at a grazing angle, and the residual depth
# (choice).
SLOPE_SD = 0.4
RESIDUAL_DEPTH_SD = 0.25
# Prior of the planar depth model (`moments_cost`): a plane through the visible side, nearer than g by as much as the
# quadric at the anchor (derived, rounded). Its tails are Gaussian, hence wider than the Cauchy scale; all else is
# residual depth (choice).
PLANE_OFFSET, PLANE_OFFSET_SD, PLANE_SLOPE_SD, PLANE_RESIDUAL_DEPTH_SD = 0.3, OFFSET_SD, 1.0, 0.3
# Upper bound of the standard deviation of g's inverse depth in the search (choice).
MAX_INVERSE_DEPTH_SD = 0.3
# Prior of the quadric in radii of the object, without the 1 of its inverse depth; slopes are per spread and are scaled
# separately (derived).
_PRIOR_MEAN = np.array([OFFSET_PER_BULGE, 0.0, 0.0, -1.0, 0.0, -1.0]) * BULGE
_PRIOR_SCATTER = np.array([OFFSET_SD, 1.0, 1.0, CURVATURE_SD, CURVATURE_SD, CURVATURE_SD])
_PRIOR_INFORMATION = np.linalg.inv(np.outer(_PRIOR_MEAN, _PRIOR_MEAN) + np.diag(_PRIOR_SCATTER**2))

# Related priors elsewhere describe the visible side of a body in their own unknowns:
# - `sylvester.depth_plane_kernels`: a plane without an offset, which moments about the mean do not have; all normals
#   are equally likely (slopes about 1); residual depth is 0.3 of the points' spread and has its own unknown.
# - `sylvester.affine_consensus`: no depth but the affine image of a plane: slopes of 0.5, near `SLOPE_SD`, with a tail
#   as for equally likely normals; residual depth is part of the affine residual and grows with the rotation.
# - `landmarks.landmark_filter.predict_depths`: depths of known neighbors, hence their scatter, 0.3 to 1 radii: no less
#   than `OFFSET_SD`, no more than the depth of a body. Its bulge of 0.5 radii, for one camera with boxes, is a body
#   between flat and round: half of the offset of a sphere's visible side from g.
# - `landmarks.alignment`: a plane's three unknowns of variance 1, in units of each landmark's own uncertainty.


@dataclass(frozen=True, eq=False)
class TermData:
    """Matches of one camera between one reference frame and the current frame.

    Attributes:
        camera: index in the rig.
        x, y: (n, 2) normalized points in the reference frame and in the current frame.
        rotation: (3, 3) Q of camera_from_world.
        center: (3,) the camera's center, world.
        focal: pixels per normalized unit.
        start_from_reference: moves the object from its pose in the reference frame to its pose at the start of the
            motion; None if the motion starts in the reference frame.
    """

    camera: int
    x: FloatArray
    y: FloatArray
    rotation: FloatArray
    center: FloatArray
    focal: float
    start_from_reference: RigidTransform | None = None

    def __len__(self) -> int:
        return len(self.x)

    def subset(self, index: BoolArray | IntArray) -> TermData:
        """Return the term with the matches selected by a mask or an index array."""
        return replace(self, x=self.x[index], y=self.y[index])

    @cached_property
    def center_x(self) -> FloatArray:
        """(3,) camera center of the reference frame, relative to the object at the motion's start."""
        if self.start_from_reference is None:
            return self.center
        return np.asarray(self.start_from_reference.apply(self.center))

    @cached_property
    def rotation_x(self) -> FloatArray:
        """(3, 3) Q of the camera of the reference frame, relative to the object at the motion's start."""
        if self.start_from_reference is None:
            return self.rotation
        return np.asarray(self.rotation @ self.start_from_reference.rotation.as_matrix().T)


class Stack(NamedTuple):
    """All terms of one problem as arrays, for the compiled solver (T terms, N matches in all).

    Attributes:
        x, y: (N, 2) normalized points, term after term.
        offsets: (T + 1,) term t has the matches offsets[t] to offsets[t + 1].
        qx, qy: (T, 3, 3) camera rotations in the reference frame and in the current frame.
        a1, a2: (T, 3) camera centers in these frames, relative to g.
        anchor: (T, 2) image of g in the reference frame, the origin of the depth model.
        spread: (T,) half of the object's radius in that image: about the median distance of its points from the anchor.
        inverse_depth: (T,) of g in the reference frame.
        depth_model_mean: (T, 6) prior mean of the depth model (`DEPTH_MODEL_SIZE`), if g is the object's center.
        depth_model_information: (T, 6, 6) its prior information.
        distance_gain: (T,) derivative of α's first prior mean with respect to the distance offset: one unknown of all
            terms for the error of g along the viewing direction, in standard deviations of its prior.
        residual_depth: (T,) prior standard deviation of the residual depth, in units of g's inverse depth.
        plane_mean, plane_sd: (T, 3) prior of a planar depth model, used by the search.
        plane_residual_depth: (T,) prior standard deviation of its residual depth.
        focal: (T,) pixels per normalized unit.
        min_sigma_px: lower bound of the noise, pixels.
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
    depth_model_mean: FloatArray
    depth_model_information: FloatArray
    distance_gain: FloatArray
    residual_depth: FloatArray
    plane_mean: FloatArray
    plane_sd: FloatArray
    plane_residual_depth: FloatArray
    focal: FloatArray
    min_sigma_px: float


class Candidate(NamedTuple):
    """Motion with the depth models of all terms; solvers start from it and update it in place.

    Attributes:
        rotation: (3, 3) R.
        translation: (3,) d.
        depth_model: (T, 6) α, or (T, 3) of planes in the search.
    """

    rotation: FloatArray
    translation: FloatArray
    depth_model: FloatArray

    def copy(self) -> Candidate:
        """Return a deep copy."""
        return Candidate(self.rotation.copy(), self.translation.copy(), self.depth_model.copy())


@leaf
def copy_into(target: Candidate, source: Candidate) -> None:
    """Copy the values of `source` into the arrays of `target`."""
    for i in range(3):
        target.translation[i] = source.translation[i]
        for j in range(3):
            target.rotation[i, j] = source.rotation[i, j]
    for t in range(target.depth_model.shape[0]):
        for k in range(target.depth_model.shape[1]):
            target.depth_model[t, k] = source.depth_model[t, k]


@kernel
def apply_step(
    candidate: Candidate, distance_offset: FloatArray, step: FloatArray, gains: FloatArray, length: float
) -> None:
    """Apply `length` times a step (7,) to candidate and `distance_offset` (1,).

    The depth models follow by gains (T, 6, 8).
    """
    rotvec, rotation = length * step[:3], np.empty((3, 3))
    apply_rotvec(rotvec, candidate.rotation, rotation)
    candidate.rotation[:] = rotation
    for i in range(3):
        candidate.translation[i] += length * step[3 + i]
    distance_offset[0] += length * step[6]
    for t in range(gains.shape[0]):
        for k in range(DEPTH_MODEL_SIZE):
            change = gains[t, k, 7]
            for j in range(7):
                change -= gains[t, k, j] * step[j]
            candidate.depth_model[t, k] += length * change


class InitialMotions(NamedTuple):
    """G initial motions in addition to the built-in ones: `rotations` (G, 3, 3), `translations` (G, 3)."""

    rotations: FloatArray
    translations: FloatArray


def stack_initial_motions(motions: Sequence[tuple[FloatArray, FloatArray]]) -> InitialMotions:
    """Stack motions (R, d) into arrays."""
    rotations, translations = [r for r, _ in motions], [d for _, d in motions]
    return InitialMotions(
        np.array(rotations, dtype=float).reshape(-1, 3, 3), np.array(translations, dtype=float).reshape(-1, 3)
    )


class TermArrays(NamedTuple):
    """Concatenated arrays of all terms, before they are expressed relative to the object's center (`Stack`).

    Attributes:
        x, y, offsets, qx, qy, focal: as in `Stack`.
        cx, cy: (T, 3) camera centers in the reference frame and in the current frame.
    """

    x: FloatArray
    y: FloatArray
    offsets: IntArray
    qx: FloatArray
    qy: FloatArray
    cx: FloatArray
    cy: FloatArray
    focal: FloatArray


def concatenate_terms(data: Sequence[TermData]) -> TermArrays:
    """Concatenate terms, each with at least one match."""
    x, y = np.concatenate([term.x for term in data]), np.concatenate([term.y for term in data])
    qy, cy = np.concatenate([term.rotation for term in data]), np.concatenate([term.center for term in data])
    qx, cx = qy, cy
    if any(term.start_from_reference is not None for term in data):
        qx, cx = np.concatenate([term.rotation_x for term in data]), np.concatenate([term.center_x for term in data])
    offsets = np.array([0, *accumulate(len(term) for term in data)])
    rotations, focal = (
        (qx.reshape(-1, 3, 3), qy.reshape(-1, 3, 3)),
        np.array([term.focal for term in data], dtype=float),
    )
    return TermArrays(x, y, offsets, *rotations, cx.reshape(-1, 3), cy.reshape(-1, 3), focal)


def stack_terms(
    data: Sequence[TermData],
    center: FloatArray,
    radius: float,
    arrays: TermArrays | None = None,
    min_sigma_px: float = 0.0,
) -> Stack:
    """Stack terms, each with at least one match, and set the priors of their depth models.

    Args:
        center: (3,) g.
        radius: of the object, length units.
        arrays: the concatenated terms, if already available.
        min_sigma_px: lower bound of the noise, pixels.
    """
    return _build_stack(
        concatenate_terms(data) if arrays is None else arrays, center, float(radius), float(min_sigma_px)
    )


@kernel
def _build_stack(arrays: TermArrays, center: FloatArray, radius: float, min_sigma_px: float) -> Stack:
    """Express the terms relative to g and set the depth priors."""
    n = len(arrays.focal)
    stack = Stack(
        arrays.x,
        arrays.y,
        arrays.offsets,
        arrays.qx,
        arrays.qy,
        arrays.cx - center,
        arrays.cy - center,
        np.empty((n, 2)),
        np.empty(n),
        np.empty(n),
        np.empty((n, DEPTH_MODEL_SIZE)),
        np.empty((n, DEPTH_MODEL_SIZE, DEPTH_MODEL_SIZE)),
        np.empty(n),
        np.empty(n),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty(n),
        arrays.focal,
        min_sigma_px,
    )
    _set_depth_priors(stack, radius)
    return stack


@kernel
def _set_depth_priors(stack: Stack, radius: float) -> None:
    """Set the depth priors of all terms."""
    distance_sd = stack.distance_gain
    compute_distance_sd(stack.a1, stack.qx, OFFSET_SD, distance_sd)
    scale = np.empty(DEPTH_MODEL_SIZE)
    for t in range(len(distance_sd)):
        q, a = stack.qx[t], stack.a1[t]
        signed_depth = -(q[2, 0] * a[0] + q[2, 1] * a[1] + q[2, 2] * a[2])
        depth = max(abs(signed_depth), 1e-12)
        for i in range(2):
            stack.anchor[t, i] = -(q[i, 0] * a[0] + q[i, 1] * a[1] + q[i, 2] * a[2]) / depth
        # If the object reaches its camera, bound its depth.
        share = min(radius / depth, 1.0)
        spread = 0.5 * share
        stack.inverse_depth[t], stack.spread[t] = 1.0 / depth, spread
        scale[:] = 1.0 / share
        scale[1:3] = 1.0 / (SLOPE_SD * spread)
        for k in range(DEPTH_MODEL_SIZE):
            stack.depth_model_mean[t, k] = share * _PRIOR_MEAN[k] + (1.0 if k == 0 else 0.0)
            for j in range(DEPTH_MODEL_SIZE):
                stack.depth_model_information[t, k, j] = _PRIOR_INFORMATION[k, j] * scale[k] * scale[j]
        stack.residual_depth[t], stack.plane_residual_depth[t] = (
            RESIDUAL_DEPTH_SD * share,
            PLANE_RESIDUAL_DEPTH_SD * share,
        )
        # In the search, depths must not become negative: errors in length are acceptable.
        stack.plane_sd[t, 0] = min(np.hypot(PLANE_OFFSET_SD, distance_sd[t]) * share, MAX_INVERSE_DEPTH_SD)
        stack.plane_mean[t, 0] = 1.0 + PLANE_OFFSET * share
        for j in range(1, 3):
            stack.plane_mean[t, j], stack.plane_sd[t, j] = 0.0, PLANE_SLOPE_SD * spread
        distance_sd[t] *= share


def locate_object(data: Sequence[TermData], arrays: TermArrays | None = None) -> tuple[FloatArray, float]:
    """Estimate where the object is and how large, from the matched points of the reference frame.

    Args:
        data: terms, each with at least one match.
        arrays: the concatenated terms, if already available.

    Returns:
        center (3,), the point nearest to the rays through each camera's median point (at distance 1 with one camera);
        radius, length units: twice the median distance of the points from it.
    """
    x, _, offsets, rotations, _, centers, _, _ = concatenate_terms(data) if arrays is None else arrays
    center = np.empty(3)
    return center, float(locate_from_rays(x, offsets, rotations, centers, OFFSET_SD, center))
