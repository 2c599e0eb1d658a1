"""Terms of a two-frame motion problem: the matches of each camera, the priors on depth, the fit of a motion.

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
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import apply_rotvec, compute_median, compute_sum, dot, kernel, leaf, symmetric_eigen
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.matches import MAX_STATIC_PX, STATIC_PX
from sylpose.relative_pose.limits import HALF_DIGITS, MAX_ROUNDS
from sylpose.rig import MIN_EIGENVALUE_RATIO
from sylpose.status import Status

# Eight matches over all cameras leave two more equations than unknowns; fewer give no redundancy (choice).
MIN_MATCHES = 8
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
# The scatter of the deviations from it, in the same units (derived).
_PRIOR_SCATTER = np.array([OFFSET_SD, 1.0, 1.0, CURVATURE_SD, CURVATURE_SD, CURVATURE_SD])
# The information of the mean's own scatter and of these deviations (derived).
_PRIOR_INFORMATION = np.linalg.inv(np.outer(_PRIOR_MEAN, _PRIOR_MEAN) + np.diag(_PRIOR_SCATTER**2))

# Location of the object, where the cameras' rays meet: the least sum of squared distances to lines is that of
# `rig.intersect_rays`; the rest is ours (docs/method/3-pose.md).
# Centers whose distance is below this share of their coordinates coincide (derived: rounding).
COINCIDENCE_TOLERANCE = 1e-9
# Rays converge if their inverse distance is so many standard deviations above zero (chi-squared, once in a thousand times).
MIN_CONVERGENCE_SIGMAS = float(np.sqrt(chi_squared_bound(1)))
# Rays also converge if their mean is shorter than this, a cone of some 36 degrees (choice).
MIN_PARALLEL_MEAN = 0.95

# Related priors elsewhere describe the visible side of a body in their own unknowns:
# - `sylvester.depth_plane`: a plane without an offset, which moments about the mean do not have; all normals
#   are equally likely (slopes about 1); residual depth is 0.3 of the points' spread and has its own unknown.
# - `sylvester.camera_faults`: no depth but the affine image of a plane: slopes of 0.5, near `SLOPE_SD`, with a tail
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


# Fitting α to noise makes the parallax, and so the motion, look larger than it is. Integrating α out of the likelihood
# removes this bias if surfaces are as curved as the prior, and overcorrects if they are flatter. This share of the
# correction is a compromise, hardly worse than either at its best (measured: docs/history/benchmarks.md#two-frames).
MARGINALIZED_SHARE = 0.5


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
        marginalized_share: share of the correction for depth models that fit noise (`MARGINALIZED_SHARE`).
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
    marginalized_share: float


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


@leaf
def transform_to_camera(
    stack: Stack, t: int, candidate: Candidate, rc: FloatArray, tc: FloatArray, rotated_center: FloatArray
) -> None:
    """Transform the motion into term t's camera: `rc` = Qy R Qx', `tc` = Qy τ, `rotated_center` = Qy R a1."""
    rotation, translation = candidate.rotation, candidate.translation
    qx, qy, a1, a2 = stack.qx[t], stack.qy[t], stack.a1[t], stack.a2[t]
    for i in range(3):
        r0 = qy[i, 0] * rotation[0, 0] + qy[i, 1] * rotation[1, 0] + qy[i, 2] * rotation[2, 0]
        r1 = qy[i, 0] * rotation[0, 1] + qy[i, 1] * rotation[1, 1] + qy[i, 2] * rotation[2, 1]
        r2 = qy[i, 0] * rotation[0, 2] + qy[i, 1] * rotation[1, 2] + qy[i, 2] * rotation[2, 2]
        for j in range(3):
            rc[i, j] = r0 * qx[j, 0] + r1 * qx[j, 1] + r2 * qx[j, 2]
        rotated_center[i] = r0 * a1[0] + r1 * a1[1] + r2 * a1[2]
        tc[i] = rotated_center[i]
        for j in range(3):
            tc[i] += qy[i, j] * (translation[j] - a2[j])


@kernel
def apply_step(candidate: Candidate, offset: FloatArray, step: FloatArray, gains: FloatArray, length: float) -> None:
    """Apply `length` times a step (7,) to candidate and `offset` (1,).

    The depth models follow by gains (T, 6, 8).
    """
    rotvec, rotation = length * step[:3], np.empty((3, 3))
    apply_rotvec(rotvec, candidate.rotation, rotation)
    candidate.rotation[:] = rotation
    for i in range(3):
        candidate.translation[i] += length * step[3 + i]
    offset[0] += length * step[6]
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
    rotations, translations = (np.array([motion[k] for motion in motions], dtype=float) for k in range(2))
    return InitialMotions(rotations.reshape(-1, 3, 3), translations.reshape(-1, 3))


def concatenate_terms(data: Sequence[TermData]) -> tuple[Any, ...]:
    """Return x, y, offsets, the rotations and centers in both frames, and the focal lengths of T terms, as in `Stack`."""
    names = "x", "y", "rotation_x", "rotation", "center_x", "center"
    x, y, qx, qy, centers_x, centers = (np.concatenate([getattr(term, name) for term in data]) for name in names)
    offsets, focal = np.array([0, *accumulate(len(t) for t in data)]), np.array([float(t.focal) for t in data])
    rotations = qx.reshape(-1, 3, 3), qy.reshape(-1, 3, 3)
    return x, y, offsets, *rotations, centers_x.reshape(-1, 3), centers.reshape(-1, 3), focal


def stack_terms(data: Sequence[TermData], center: FloatArray, radius: float, min_sigma_px: float = 0.0) -> Stack:
    """Stack terms, each with at least one match, and set the priors of their depth models.

    Args:
        center: (3,) g.
        radius: of the object, length units.
        min_sigma_px: lower bound of the noise, pixels.
    """
    n, k = len(data), DEPTH_MODEL_SIZE
    *views, centers_x, centers, focal = concatenate_terms(data)
    shapes: Sequence[Any] = ((n, 2), n, n, (n, k), (n, k, k), n, n, (n, 3), (n, 3), n)
    relative_centers = centers_x - center, centers - center
    stack = Stack._make(
        [*views, *relative_centers, *map(np.empty, shapes), focal, float(min_sigma_px), MARGINALIZED_SHARE]
    )
    _set_depth_priors(stack, float(radius))
    return stack


@kernel
def _set_depth_priors(stack: Stack, radius: float) -> None:
    """Set the depth priors of all terms."""
    distance_sd = stack.distance_gain
    _compute_distance_sd(stack.a1, stack.qx, radius, distance_sd)
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
        stack.residual_depth[t] = RESIDUAL_DEPTH_SD * share
        stack.plane_residual_depth[t] = PLANE_RESIDUAL_DEPTH_SD * share
        # In the search, depths must not become negative: errors in length are acceptable.
        stack.plane_sd[t, 0] = min(np.hypot(PLANE_OFFSET_SD, distance_sd[t]) * share, MAX_INVERSE_DEPTH_SD)
        stack.plane_mean[t, 0] = 1.0 + PLANE_OFFSET * share
        for j in range(1, 3):
            stack.plane_mean[t, j], stack.plane_sd[t, j] = 0.0, PLANE_SLOPE_SD * spread
        distance_sd[t] *= share


@dataclass(frozen=True, eq=False)
class Fit:
    """Robust fit of one motion to terms, shared by `estimate_motion` and the tracker.

    Attributes:
        status: see `Status`.
        rotation: (3, 3) R, of X_j = R (X_i - g) + g + d; meaningless without `status.has_pose`.
        translation: (3,) d, likewise.
        weights: per term (n,), 0 for outliers.
        residuals: per term (n,) signed epipolar distances, pixels.
        information: (6, 6) of (w, d).
        information_without_depth: (6, 6) the same without the prior on the depth models (distance and curvature).
        iterations: of the solver, all rounds.
        faults: one sentence for each camera identified as faulty, or on what all may have wrong.
        alternative: (R, d) of a distant alternative motion that explains the matches about as well; None without.
        is_mixed: whether neighboring residuals are correlated, or two motions are likelier: two bodies fitted as one, or a
            wrongly calibrated camera. The motion then belongs to neither, and its covariance is meaningless.
        cost: negative log-likelihood of the matches, to compare fits of the same matches.
        may_be_two: whether the residuals depend on the motion or reach the bound of their noise, as those of two interleaved
            bodies do.
        static_ratio: share of the matches assigned to a static background while the object moves by little.
    """

    status: Status
    rotation: FloatArray
    translation: FloatArray
    weights: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    information: FloatArray
    information_without_depth: FloatArray
    iterations: int
    faults: tuple[str, ...] = ()
    alternative: tuple[FloatArray, FloatArray] | None = None
    is_mixed: bool = False
    cost: float = np.inf
    may_be_two: bool = False
    static_ratio: float = 0.0

    def with_matches(self, weights: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> Fit:
        """Return the same fit with the weights and residuals of other terms."""
        return replace(self, weights=tuple(weights), residuals=tuple(residuals))


class Solution(NamedTuple):
    """Fit, and the object center and radius that it assumes."""

    fit: Fit
    center: FloatArray
    radius: float


class TermSolver(Protocol):
    """Solver of terms; `start` is tried as an initial motion."""

    def __call__(self, terms: Sequence[TermData], start: Solution | None = None) -> Solution: ...


def change_center(
    motion: tuple[FloatArray, FloatArray], center: FloatArray, new_center: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a motion (R, d) about another center."""
    rotation, translation = motion
    return rotation, translation + (rotation - np.eye(3)) @ (new_center - center)


def make_failed_fit(data: Sequence[TermData], status: Status) -> Fit:
    """Return a fit without a pose, with this status."""
    weights = tuple(np.zeros(len(term)) for term in data)
    nothing = np.zeros((6, 6))
    return Fit(status, np.eye(3), np.zeros(3), weights, weights, nothing, nothing, 0)


def locate_object(data: Sequence[TermData], center: FloatArray | None = None) -> tuple[FloatArray, float]:
    """Estimate where the object is and how large, from the matched points of the reference frame.

    Args:
        data: terms, each with at least one match.
        center: (3,) where it is, if that is known.

    Returns:
        center (3,), the point nearest to the rays through each camera's median point (at distance 1 with one camera);
        radius, length units: twice the median distance of the points from it.
    """
    x, _, offsets, rotations, _, centers, *_ = concatenate_terms(data)
    found = np.empty(3) if center is None else np.array(center, dtype=float)
    return found, float(_locate_from_rays(x, offsets, rotations, centers, center is not None, found))


@kernel
def _locate_from_rays(
    x: FloatArray, offsets: IntArray, rotations: FloatArray, centers: FloatArray, is_known: bool, center: FloatArray
) -> float:
    """Set center (3,) to the location of the object, unless it is known; return its radius.

    Args:
        x: (N, 2) normalized points of all terms, split by offsets (T + 1,).
        rotations, centers: (T, 3, 3), (T, 3) of the cameras that see them.
    """
    n = len(centers)
    rays, spread, anchor = np.empty((n, 3)), np.empty(n), np.empty(2)
    for t in range(n):
        points = x[offsets[t] : offsets[t + 1]]
        distances = np.empty(len(points))
        for a in range(2):
            distances[:] = points[:, a]
            anchor[a] = compute_median(distances)
        for i in range(len(points)):
            distances[i] = np.sqrt((points[i, 0] - anchor[0]) ** 2 + (points[i, 1] - anchor[1]) ** 2)
        spread[t] = compute_median(distances)
        length = np.sqrt(anchor[0] ** 2 + anchor[1] ** 2 + 1.0)
        for i in range(3):
            rays[t, i] = (rotations[t, 0, i] * anchor[0] + rotations[t, 1, i] * anchor[1] + rotations[t, 2, i]) / length
    if not is_known:
        _intersect_rays(centers, rays, spread, center)
    radius, depths = 0.0, 0.0
    for t in range(n):
        depth = 0.0
        for i in range(3):
            depth += rotations[t, 2, i] * (center[i] - centers[t, i])
        depths += abs(depth) / n
        radius += 2.0 * (offsets[t + 1] - offsets[t]) * spread[t] * abs(depth) / offsets[n]
    return max(radius, 1e-6 * depths)


@kernel
def _intersect_rays(centers: FloatArray, rays: FloatArray, spread: FloatArray, out: FloatArray) -> None:
    """Intersect rays (T, 3) from centers (T, 3), each of which misses the object's center.

    If the centers are close together, the errors of the rays, a part `OFFSET_SD` of the object's radius of 2 spread,
    outweigh their convergence: they may meet at any distance, or behind the cameras. The object is then placed no
    farther away than one standard deviation of its inverse distance allows.
    """
    n = len(centers)
    middle, along, slope, max_coordinate = np.zeros(3), np.zeros(3), np.zeros(3), 0.0
    for t in range(n):
        for i in range(3):
            middle[i] += centers[t, i] / n
            along[i] += rays[t, i] / n
            max_coordinate = max(max_coordinate, abs(centers[t, i]))
    length = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    if not length > MIN_PARALLEL_MEAN:
        _find_nearest_point(centers, rays, middle, along, spread, out)
        return
    squares, convergence = 0.0, 0.0
    for t in range(n):
        across, forward = 0.0, 0.0
        for i in range(3):
            across += (centers[t, i] - middle[i]) * along[i] / length
            forward += rays[t, i] * along[i] / length
        # In the transverse plane, a ray from position b has the slope (c - b) / depth for an object at c.
        for i in range(3):
            lateral = centers[t, i] - middle[i] - across * along[i] / length
            squares += lateral**2
            convergence -= rays[t, i] / forward * lateral
            slope[i] += rays[t, i] / forward / n
    near = squares > (COINCIDENCE_TOLERANCE * max_coordinate) ** 2
    sd = OFFSET_SD * 2.0 * spread.sum() / n / np.sqrt(squares) if near else np.inf
    inverse = convergence / squares if near else 0.0
    if inverse > MIN_CONVERGENCE_SIGMAS * sd or not np.isfinite(sd):
        _find_nearest_point(centers, rays, middle, along, spread, out)
        return
    for i in range(3):
        out[i] = middle[i] + slope[i] / (0.5 * (inverse + np.hypot(inverse, 2.0 * sd)))


@kernel
def _find_nearest_point(
    centers: FloatArray, rays: FloatArray, middle: FloatArray, along: FloatArray, spread: FloatArray, out: FloatArray
) -> None:
    """Find the point with the least sum of squared distances to rays.

    middle and along are the means of the centers and of the rays. Along themselves, rays of opposite cameras do not
    determine it as `rig.intersect_rays` does, but the object appears about as large from all sides.
    """
    near, right, total = np.empty(3), np.zeros(3), np.zeros((3, 3))
    length = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    for i in range(3):
        near[i] = middle[i] + (along[i] / length if length > 0.5 else 0.0)
    for t in range(len(centers)):
        along_ray = 0.0
        for i in range(3):
            along_ray += rays[t, i] * (centers[t, i] - near[i])
        for i in range(3):
            right[i] += centers[t, i] - near[i] - along_ray * rays[t, i]
            total[i, i] += 1.0
            for j in range(3):
                total[i, j] -= rays[t, i] * rays[t, j]
    values, vectors = np.empty(3), np.empty((3, 3))
    symmetric_eigen(total, values, vectors)
    out[:] = near
    for k in range(3):
        if values[k] > MIN_EIGENVALUE_RATIO * values[2]:
            part = (vectors[0, k] * right[0] + vectors[1, k] * right[1] + vectors[2, k] * right[2]) / values[k]
            for i in range(3):
                out[i] += part * vectors[i, k]
    _balance_sizes(centers, rays, spread, vectors[:, 0], values[0], out)


@kernel
def _balance_sizes(
    centers: FloatArray,
    rays: FloatArray,
    spread: FloatArray,
    direction: FloatArray,
    certainty: float,
    point: FloatArray,
) -> None:
    """Move a point along a direction (3,) so that the object is equally large from all cameras.

    A ray misses the object's center by about `OFFSET_SD` radii, and the size that it appears to have varies by the same
    share. Nothing is done where the rays determine the point better than the sizes.

    Args:
        spread: (T,) its size in the images, normalized units.
        direction: the least certain one.
        certainty: sum of the squared sines between it and the rays.
        point: (3,) changed.
    """
    if not spread.min() > 0.0:
        return
    n, start, to_middle = len(rays), point.copy(), 0.0
    depth, along, log_size = np.empty(n), np.zeros(n), np.empty(n)
    for t in range(n):
        for i in range(3):
            along[t] += rays[t, i] * direction[i]
            to_middle += (centers[t, i] - point[i]) * direction[i] / n
    if not _measure_depths(centers, rays, point, depth) > 0.0:
        # The rays meet behind a camera: begin between the cameras.
        point[:] = start + to_middle * direction
        if not _measure_depths(centers, rays, point, depth) > 0.0:
            point[:] = start
            return
    for _ in range(MAX_ROUNDS):
        log_size[:], shift = np.log(spread * depth), 0.0
        for i in range(3):
            shift += (point[i] - start[i]) * direction[i]
        radius, growth = 2.0 * compute_sum(spread * depth) / n, along / depth
        log_size -= compute_sum(log_size) / n
        growth -= compute_sum(growth) / n
        contrast = dot(growth, growth) * radius**2
        if not contrast > max(certainty, HALF_DIGITS):
            point[:] = start
            return  # the rays determine it better
        step = -(certainty * shift + dot(growth, log_size) * radius**2) / (certainty + contrast)
        bound = 0.5 * depth.min()
        step = min(max(step, -bound), bound)
        point += step * direction
        _measure_depths(centers, rays, point, depth)
        if abs(step) < HALF_DIGITS * radius:
            return


@leaf
def _measure_depths(centers: FloatArray, rays: FloatArray, point: FloatArray, depth: FloatArray) -> float:
    """Set depth (T,), how far a point is along rays (T, 3) from centers (T, 3); return the least."""
    least = np.inf
    for t in range(len(rays)):
        depth[t] = 0.0
        for i in range(3):
            depth[t] += rays[t, i] * (point[i] - centers[t, i])
        least = min(least, depth[t])
    return float(least)


@kernel
def _compute_distance_sd(a1: FloatArray, qx: FloatArray, radius: float, out: FloatArray) -> None:
    """Set out (T,) to the additional standard deviation of each term's inverse depth of g, in radii of the object.

    It is signed, since all terms share one unknown. g is the intersection of the terms' median rays, each of which
    misses the object's center by about `OFFSET_SD` radii. Cameras close together as seen from the object, or on
    opposite sides of it, magnify that error along their viewing direction; from opposite sides, the object's apparent
    sizes bound it (`_balance_sizes`). Cameras in one place do not determine the distance, and nothing is added.
    """
    n = len(a1)
    total, values, vectors = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    for t in range(n):
        length = max(np.sqrt(a1[t, 0] ** 2 + a1[t, 1] ** 2 + a1[t, 2] ** 2), 1e-300)
        for i in range(3):
            total[i, i] += 1.0
            for j in range(3):
                total[i, j] -= a1[t, i] * a1[t, j] / (length * length)
    # The sum of the eigenvalues is twice the number of rays, and none exceeds that number: at most one is below 1.
    symmetric_eigen(total, values, vectors)
    certainty, mean_growth = values[0], 0.0
    for k in range(2):
        for t in range(n):
            growth, square = 0.0, 1e-300
            for i in range(3):
                growth -= radius * a1[t, i] * vectors[i, 0]
                square += a1[t, i] * a1[t, i]
            if k == 0:
                mean_growth += growth / square / n
            else:
                certainty += (growth / square - mean_growth) ** 2
    if not certainty > HALF_DIGITS:
        out[:] = 0.0
        return
    excess_sd = OFFSET_SD * np.sqrt(max(1.0 / certainty - 1.0, 0.0))
    for t in range(n):
        out[t] = -excess_sd * (qx[t, 2, 0] * vectors[0, 0] + qx[t, 2, 1] * vectors[1, 0] + qx[t, 2, 2] * vectors[2, 0])


@kernel
def find_usable(x: FloatArray, y: FloatArray, focal: float) -> BoolArray:
    """Return which of a term's matches (n,) may be on the object; static ones are not if the camera sees large motion."""
    n, count = len(x), 0
    usable, moving = np.empty(n, np.bool_), np.empty(n)
    for i in range(n):
        dx, dy = y[i, 0] - x[i, 0], y[i, 1] - x[i, 1]
        displacement = np.sqrt(dx * dx + dy * dy) * focal
        usable[i] = displacement > STATIC_PX
        if usable[i]:
            moving[count] = displacement
            count += 1
    if count == 0 or compute_median(moving[:count]) <= MAX_STATIC_PX:
        usable[:] = True
    return usable
