"""First motion: what moves as a rigid body against the static background between two frames, and other bodies that do.

No depth and no surface has to be known.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import invert_information, make_motion_about
from sylpose.relative_pose.affine_ransac import QUADRUPLES, find_inliers
from sylpose.relative_pose.camera_evidence import (
    MIN_KEPT_POOLED,
    compute_f_ratio,
    measure_distances,
    measure_excess,
)
from sylpose.relative_pose.limits import MIN_ERROR_PX, MISMATCH_PROBABILITY
from sylpose.relative_pose.observability import classify_observability
from sylpose.relative_pose.rig_hypotheses import MAX_COMBINED
from sylpose.relative_pose.second_motion import MIN_OUTLIER_RATIO
from sylpose.relative_pose.solver import Division, fit_terms, fit_two_motions
from sylpose.relative_pose.terms import MIN_MATCHES, Fit, Solution, TermData, locate_object, make_failed_fit
from sylpose.rig import Camera
from sylpose.status import FrameStatus, Status
from sylpose.tracking.camera_side.frame import (
    CameraPairs,
    FrameMatches,
    Pairs,
    find_static,
    omit_empty,
    select_inliers,
    triangulate,
)
from sylpose.tracking.context import Context, is_rival
from sylpose.tracking.frame_solvers import scatter_fit
from sylpose.tracking.joint_side.joint_state import PoseEstimate, bound_information
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.reports import InitialMatches, MovingMatches

# Keypoints displaced by less than the first value, pixels, may be static. They define the noise if more than the second one,
# a share of them, is displaced by less than half of it (choice).
MAX_JITTER_PX, MIN_STATIC_RATIO = 4.0, 0.65
# Median of the Rayleigh distribution in standard deviations (derived).
RAYLEIGH_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))
# Unknowns of a motion, and of each camera's surface (derived).
MOTION_UNKNOWNS, SURFACE_UNKNOWNS = 6, 6
# Between consecutive frames, the rotation since the first frame changes by at most this share, or this angle, radians
# (choice).
MAX_ROTATION_CHANGE_RATIO, MAX_ROTATION_CHANGE = 0.6, np.radians(0.75)
# Number of motions fitted one after another: an object, and the trunk and arms of a person (choice).
MAX_BODIES = 4
# Matches of one body have common affine epipolar lines, within so many pixels (choice: sensitivity in
# docs/history/benchmarks.md#trust).
MAX_GROUP_DISTANCE_PX = 0.5


@dataclass(frozen=True, eq=False)
class FirstMotion:
    """Motion of a body since a frame.

    Attributes:
        fit: of the moving matches.
        center: (3,) point that the motion is about.
        inlier_center: (3,) center of its inliers.
        radius: of its inliers about `inlier_center`; NaN without any.
        n_inliers: number of inliers.
        displacement_px: median displacement of the inliers; NaN without any.
        n_cameras: number of cameras that detect it, with enough inliers displaced far enough.
        is_rigid: whether a rigid motion is likelier than independent displacements of the matches.
        is_significant: whether it also exceeds the noise of static keypoints.
        is_observable: whether it is fully observable, including rotation angle and length of translation.
        moving: per camera, its moving matches with the frame, inliers or not, without those of larger bodies.
        failure_status: status to report if this is not the object's motion: too few matches, no motion, or no rigid
            motion.
        inliers: per camera, local.
    """

    fit: Fit
    center: FloatArray
    inlier_center: FloatArray
    radius: float
    n_inliers: int
    displacement_px: float
    n_cameras: int
    is_rigid: bool
    is_significant: bool
    is_observable: bool
    moving: Sequence[Sequence[MovingMatches]]
    failure_status: FrameStatus
    inliers: CameraPairs

    @property
    def motion(self) -> RigidTransform:
        """Motion of the object since the frame."""
        return make_motion_about(self.center, self.fit.rotation, self.fit.translation)

    def measure_displacement(self, center: FloatArray) -> float:
        """Measure the median displacement of moving matches in space, if they are as far away as a center (3,).

        Returns:
            length units; 0 if almost all matches are static; NaN if there are too few matches to know.
        """
        if self.failure_status is FrameStatus.TOO_FEW_MATCHES:
            return np.nan
        reports = [report for own in self.moving for report in own]
        lengths = [r.displacement_px / r.term.focal * np.linalg.norm(r.term.center - center) for r in reports]
        moved = np.concatenate([np.empty(0), *lengths])
        return float(np.median(moved)) if len(moved) >= MIN_MATCHES else 0.0

    def estimate_pose(self, first_pose: RigidTransform, radius: float) -> PoseEstimate:
        """Estimate the object's pose, with the covariance of this motion.

        Args:
            first_pose: world_from_object in the frame since which it is; exact.
            radius: of the object; bounds what is not observable.
        """
        pose = self.motion * first_pose
        shift = pose.translation - self.center - self.fit.translation
        jacobian = np.eye(6)
        jacobian[3:, :3] = -np.cross(np.eye(3), shift)
        own = invert_information(self.fit.information + bound_information(radius))
        return PoseEstimate(pose, jacobian @ own @ jacobian.T)

    def compute_f_ratio(self) -> float:
        """Compute the F ratio of the cameras' own motions (`camera_evidence`); NaN unless several have evidence."""
        return _compute_fit_f_ratio([[report.term for report in own] for own in self.moving], self.fit, self.center)


def _compute_fit_f_ratio(by_camera: Iterable[Sequence[TermData]], fit: Fit, center: FloatArray) -> float:
    """Compute the F ratio of the cameras' own motions to a fit about a center (3,); NaN unless several have evidence."""
    excess = [measure_excess(own, center, fit.rotation, fit.translation) for own in by_camera]
    worst = np.array([np.fmax.reduce(own, initial=np.nan) for own in excess])
    return float(compute_f_ratio(worst, MIN_KEPT_POOLED))


def is_continuing_motion(earlier: RigidTransform | None, later: RigidTransform | None) -> bool:
    """Return whether two frames' motions since the same frame may belong to one continuing body.

    With few cameras and a planar object a second motion fits as well; that one differs in each frame.

    Args:
        earlier, later: motions, in order of time.
    """
    if earlier is None or later is None:
        return False
    angle = max(earlier.rotation.magnitude(), later.rotation.magnitude())
    return bool(
        (later.rotation * earlier.rotation.inv()).magnitude()
        <= max(MAX_ROTATION_CHANGE_RATIO * angle, MAX_ROTATION_CHANGE)
    )


def estimate_jitter(pair: FrameMatches) -> float:
    """Estimate the scatter of static keypoints in each direction, pixels; a minimum if almost none is static."""
    displacement = np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1)
    near = displacement[displacement < MAX_JITTER_PX]
    # A slowly moving object shows all these displacements equally often.
    is_slow = np.count_nonzero(near < MAX_JITTER_PX / 2) <= MIN_STATIC_RATIO * len(near)
    return MIN_ERROR_PX if is_slow else max(float(np.median(near)) / RAYLEIGH_MEDIAN, MIN_ERROR_PX)


# --- estimation -------------------------------------------------------------------------------------------------------


def estimate_first_motion(context: Context, pairs: CameraPairs, first_number: int) -> FirstMotion:
    """Estimate the motion since the frame with the number `first_number`, from its moving matches.

    Args:
        pairs: per camera, local: matches.
    """
    rig, executor = context.rig, context.executor
    first_pairs = [[pair for pair in own if pair.reference == first_number] for own in pairs]
    n_matches = sum(executor.gather([sum(map(len, own)) for own in first_pairs], 0))
    # Per camera, local: moving matches of each pair, and what the others need of them.
    moving, own_reports = list[list[FrameMatches]](), list[InitialMatches]()
    for c, own in zip(executor.local, first_pairs, strict=True):
        jitter = [estimate_jitter(pair) for pair in own]
        selected = [pair.subset(~find_static(pair, px)) for pair, px in zip(own, jitter, strict=True)]
        moving.append(omit_empty(selected))
        reports = [
            _report_moving(part, pair, px, c, rig.cameras[c])
            for part, pair, px in zip(selected, own, jitter, strict=True)
            if len(part)
        ]
        own_reports.append(InitialMatches(tuple(reports)))
    by_camera = [found.reports for found in executor.gather(own_reports, InitialMatches())]
    reports = [report for of_camera in by_camera for report in of_camera]
    failure_status = FrameStatus.TOO_FEW_MATCHES if n_matches < MIN_MATCHES else FrameStatus.NO_MOTION
    if sum(len(report.term) for report in reports) > max(MIN_MATCHES, MISMATCH_PROBABILITY * n_matches):
        failure_status = FrameStatus.NOT_CONSISTENT
    if not reports:
        undefined, fit = np.full(3, np.nan), make_failed_fit([], Status.TOO_FEW_MATCHES)
        nothing = [list[FrameMatches]() for _ in executor.local]
        return FirstMotion(
            fit, undefined, undefined, np.nan, 0, np.nan, 0, False, False, False, (), failure_status, nothing
        )
    fit, center = _fit_consistent(reports, context.create_rng(), context.options)
    is_rigid, detects_motion = _test_significance(fit, reports, context.options)
    weights = scatter_fit(executor, fit, [[report.term for report in of_camera] for of_camera in by_camera])
    inliers = [
        (report.term.subset(w > 0), report.displacement_px[w > 0])
        for report, w in zip(reports, fit.weights, strict=True)
    ]
    inliers = [(term, shift) for term, shift in inliers if len(term)]
    inlier_center, radius = locate_object([term for term, _ in inliers]) if inliers else (np.full(3, np.nan), np.nan)
    displacement = np.concatenate([np.empty(0), *(shift for _, shift in inliers)])
    min_cameras = min(2, len(rig))
    cameras = np.array([report.term.camera for report in reports])
    n_rigid, n_detecting = (len(np.unique(cameras[mask])) for mask in (is_rigid, detects_motion))
    return FirstMotion(
        fit=fit,
        center=center,
        inlier_center=inlier_center,
        radius=radius,
        n_inliers=len(displacement),
        displacement_px=float(np.median(displacement)) if len(displacement) else np.nan,
        n_cameras=n_detecting,
        is_rigid=n_rigid >= min_cameras,
        is_significant=n_detecting >= min_cameras,
        is_observable=fit.status is Status.OK and classify_observability(fit, radius)[0].status is Status.OK,
        moving=by_camera,
        failure_status=failure_status,
        inliers=[select_inliers(own, [w for w, _ in ws]) for own, ws in zip(moving, weights, strict=True)],
    )


def _report_moving(part: FrameMatches, pair: FrameMatches, jitter_px: float, c: int, camera: Camera) -> MovingMatches:
    """Report the moving matches of a pair."""
    displacement_px = np.linalg.norm(part.pixels_i - part.pixels_j, axis=1)
    return MovingMatches(part.to_term(c, camera), displacement_px, jitter_px, len(pair) - len(part))


def _fit_consistent(
    reports: Sequence[MovingMatches], rng: np.random.Generator, options: TrackingOptions
) -> tuple[Fit, FloatArray]:
    """Fit a motion to the cameras that show one; return the fit and the center (3,) that the motion is about."""
    data = [report.term for report in reports]
    center, radius = locate_object(data)
    fit = fit_terms(data, center, radius, [], rng)
    is_usable = [np.ones(len(term), bool) for term in data]
    if fit.is_mixed or _compute_fit_f_ratio([[term] for term in data], fit, center) > options.max_pooled_f_ratio:
        separated = _separate_motions(data, center, radius, rng)
        if separated is not None:
            fit, is_usable = separated, [w > 0 for w in separated.weights]
    is_consistent = ~_find_poor_terms(fit, reports, options) & np.array([own.any() for own in is_usable])
    if 2 <= is_consistent.sum() < len(is_consistent):
        # In the other cameras, inliers are static keypoints with the largest jitter.
        is_chosen = [own & consistent for own, consistent in zip(is_usable, is_consistent, strict=True)]
        consistent_terms = [term.subset(own) for term, own in zip(data, is_chosen, strict=True) if own.any()]
        center, radius = locate_object(consistent_terms)
        fit = _expand_fit(fit_terms(consistent_terms, center, radius, [], rng), is_chosen)
    return fit, center


def _separate_motions(
    data: Sequence[TermData], center: FloatArray, radius: float, rng: np.random.Generator
) -> Fit | None:
    """Return the larger one of two motions that a fit to their matches mixes; None if they cannot be separated.

    Each camera alone sees two groups of matches, of one body each. Which groups of two cameras belong to one body is not
    known: those whose two motions explain all matches best, of the cameras that see most of both bodies. If the calibration
    is wrong, a camera has one group.
    """
    groups = [_find_groups(term, rng) for term in data]
    n_both = np.array([min(a.sum(), b.sum()) for a, b in groups])
    min_both = np.fmax(MIN_MATCHES, MIN_OUTLIER_RATIO * np.array(list(map(len, data))))
    is_seeing_both = n_both >= min_both
    if is_seeing_both.sum() < min(2, len(data)):
        return None
    chosen = np.argsort(-(n_both * is_seeing_both))[: min(is_seeing_both.sum(), MAX_COMBINED)].tolist()

    def fit_two(first: Sequence[BoolArray], second: Sequence[BoolArray]) -> tuple[Fit, Fit] | None:
        fits = list[Fit]()
        for own in (first, second):
            terms = [term.subset(group) for term, group in zip(data, own, strict=True) if group.any()]
            fits.append(_expand_fit(fit_terms(terms, center, radius, [], rng), own))
        return (fits[0], fits[1]) if all(map(_is_moving, fits)) else None

    best_cost, best = np.inf, list[FloatArray]()
    for s, t in combinations(chosen, 2):
        for of_t in (groups[t], groups[t][::-1]):
            first, second = [np.zeros(len(term), bool) for term in data], [np.zeros(len(term), bool) for term in data]
            (first[s], second[s]), (first[t], second[t]) = groups[s], of_t
            if (fits := fit_two(first, second)) is None:
                continue
            distances = [
                np.array([measure_distances(term, center, fit.rotation, fit.translation) for fit in fits])
                for term in data
            ]
            cost = sum(float((np.fmin(own.min(axis=0), MAX_GROUP_DISTANCE_PX) ** 2).sum()) for own in distances)
            if cost < best_cost:
                best_cost, best = cost, distances
    nearest = [np.where(own.min(axis=0) < MAX_GROUP_DISTANCE_PX, own.argmin(axis=0), -1) for own in best]
    if not nearest or (fits := fit_two([own == 0 for own in nearest], [own == 1 for own in nearest])) is None:
        return None
    motions, masks = [(fit.rotation, fit.translation) for fit in fits], [np.concatenate(f.weights) > 0 for f in fits]
    start = Division((motions[0], motions[1]), (masks[0], masks[1]))
    separated = fit_two_motions(data, Solution(fits[0], center, radius), [start])
    return separated.fit if separated is not None and separated.fit.status.has_pose else None


def _find_groups(term: TermData, rng: np.random.Generator) -> tuple[BoolArray, BoolArray]:
    """Find the two largest groups (n,) of a camera's matches that may belong to one body each.

    A group begins with common affine epipolar lines, and is what the motion of its matches, seen by this camera alone,
    explains: parts of one body at different depths are one group.
    """
    groups, rest = list[BoolArray](), np.ones(len(term), bool)
    for _ in range(2):
        at, weights = np.flatnonzero(rest), np.empty(np.count_nonzero(rest))
        find_inliers(term.x[at], term.y[at], MAX_GROUP_DISTANCE_PX / term.focal, QUADRUPLES, weights)
        group = np.isin(np.arange(len(term)), at[weights > 0])
        own = term.subset(group)
        if len(own) >= MIN_MATCHES:
            center, radius = locate_object([own])
            fit = fit_terms([own], center, radius, [], rng)
            if _is_moving(fit):
                distances = measure_distances(term, center, fit.rotation, fit.translation)
                group = rest & (distances < MAX_GROUP_DISTANCE_PX)
        groups.append(group)
        rest = rest & ~group
    return groups[0], groups[1]


def _is_moving(fit: Fit) -> bool:
    """Return whether a fit has a motion: without one, all matches would be on its epipolar lines."""
    return fit.status.has_pose and fit.status is not Status.NO_MOTION


def _expand_fit(fit: Fit, is_chosen: Sequence[BoolArray]) -> Fit:
    """Extend a fit to the chosen matches (terms without any are not part of it) to all; the others get no weight."""
    weights, residuals = ([np.zeros(len(chosen)) for chosen in is_chosen] for _ in range(2))
    terms = [t for t, chosen in enumerate(is_chosen) if chosen.any()]
    for t, w, r in zip(terms, fit.weights, fit.residuals, strict=True):
        weights[t][is_chosen[t]], residuals[t][is_chosen[t]] = w, r
    return fit.with_matches(weights, residuals)


def _find_poor_terms(fit: Fit, reports: Sequence[MovingMatches], options: TrackingOptions) -> BoolArray:
    """Return the terms (T,) in which a fit leaves much of its inliers' displacement unexplained."""
    is_poor = np.zeros(len(reports), bool)
    for t, (record, w, across) in enumerate(zip(reports, fit.weights, fit.residuals, strict=True)):
        good = w > 0
        if good.any():
            rms = float(np.sqrt(np.mean(across[good] ** 2)))
            is_poor[t] = rms > options.max_residual_ratio * float(np.median(record.displacement_px[good]))
    return is_poor


def _test_significance(
    fit: Fit, reports: Sequence[MovingMatches], options: TrackingOptions
) -> tuple[BoolArray, BoolArray]:
    """Test whether a fit is significant against keypoint noise and random displacements.

    A displacement of length d in a random direction has the density 1 / (π √(d² - r²)) of a component r. A rigid
    motion, which predicts the match's epipolar line, has a Gaussian density of the residual r.

    Returns:
        (T,) terms in which a rigid motion is likelier than independent displacements of the matches, none if it is not in
        all of them together; (T,) those of them that detect a motion beyond the noise of static keypoints.
    """
    log_gain, (is_rigid, is_displaced) = 0.0, np.zeros((2, len(reports)), bool)
    for t, (record, w, across) in enumerate(zip(reports, fit.weights, fit.residuals, strict=True)):
        good = w > 0
        if not good.any():
            continue
        r, translation = np.abs(across[good]), record.displacement_px[good]
        sigma = max(MIN_ERROR_PX, record.jitter_px, float(np.sqrt(np.mean(r**2))))
        by_chance = 1.0 / (np.pi * np.sqrt(np.maximum(translation**2 - r**2, sigma**2)))
        motion = np.exp(-0.5 * (r / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
        gain = float(np.log(motion / by_chance).sum()) - options.min_log_gain_per_unknown * SURFACE_UNKNOWNS
        min_displacement = max(options.min_displacement_px, options.min_displacement_sds * record.jitter_px)
        is_displaced[t] = float(np.median(translation)) > min_displacement
        is_rigid[t] = good.sum() >= MIN_MATCHES and gain > 0
        log_gain += gain
    is_rigid &= log_gain > options.min_log_gain_per_unknown * MOTION_UNKNOWNS
    return is_rigid, is_rigid & is_displaced


# --- bodies that move between two frames ------------------------------------------------------------------------------


def find_bodies(context: Context, pairs: CameraPairs, first_number: int) -> list[FirstMotion]:
    """Find the bodies that move between two frames.

    Args:
        pairs: per camera, local: matches with the frame of number `first_number`.

    Returns:
        the rigid motions, significant or not, by decreasing number of inliers.
    """
    bodies, rest = list[FirstMotion](), pairs
    for _ in range(MAX_BODIES):
        motion = estimate_first_motion(context, rest, first_number)
        if motion.n_inliers < MIN_MATCHES:
            break
        if motion.is_rigid and not any(_is_part_of(context, motion, larger) for larger in bodies):
            bodies.append(motion)
        rest = remove_inliers(rest, motion)
    return sorted(bodies, key=lambda body: -body.n_inliers)


def _is_part_of(context: Context, body: FirstMotion, other: FirstMotion) -> bool:
    """Return whether another body's motion explains most matches of a body as well as its own does.

    A fit to a large rotation may leave some matches of the body that it is of.
    """
    counts = list[tuple[int, int]]()
    for c, own in zip(context.executor.local, body.inliers, strict=True):
        terms = [pair.to_term(c, context.rig.cameras[c]) for pair in own]
        distances = [
            [measure_distances(term, its.center, its.fit.rotation, its.fit.translation) for term in terms]
            for its in (other, body)
        ]
        is_nearer = [np.asarray(a <= b) for a, b in zip(*distances, strict=True)]
        counts.append((sum(map(np.count_nonzero, is_nearer)), sum(map(len, own))))
    n_explained, n = np.sum(context.executor.gather(counts, (0, 0)), axis=0)
    return bool(2 * n_explained > n)


def remove_inliers(pairs: CameraPairs, motion: FirstMotion) -> list[list[FrameMatches]]:
    """Remove the inliers of a motion from matches; per camera, local."""
    return [
        omit_empty(pair.subset(~np.isin(pair.indices[:, 0], collect_indices(inliers, 0))) for pair in own)
        for own, inliers in zip(pairs, motion.inliers, strict=True)
    ]


def collect_indices(pairs: Sequence[FrameMatches], side: int) -> IntArray:
    """Return the feature (n,) of each match, of the earlier frame (side 0) or the later one (side 1)."""
    return np.concatenate([np.empty(0, np.int64), *(pair.indices[:, side] for pair in pairs)])


def find_rivals(context: Context, pairs: CameraPairs, first_number: int, motion: FirstMotion) -> list[FirstMotion]:
    """Find other bodies that move as well between two frames and may be the object, too.

    Args:
        pairs: per camera, local: all matches with the frame of number `first_number`.
        motion: of the body with the most matches.
    """
    rest, n = remove_inliers(pairs, motion), len(context.rig)
    others = [body for body in find_bodies(context, rest, first_number) if not _is_part_of(context, body, motion)]
    ratios = [count_rival(context, motion, body) / motion.n_inliers for body in others]
    return [body for body, ratio in zip(others, ratios, strict=True) if is_rival(ratio, n, context.options)]


def count_rival(context: Context, motion: FirstMotion, other: FirstMotion) -> int:
    """Count the matches of another body in the cameras that see both; 0 if these are fewer than two.

    A faulty camera has most of its matches on one side. Where the bodies are does not matter: a hand is at the object.
    """
    counts = [
        np.array(context.executor.gather([sum(map(len, own)) for own in its.inliers], 0)) for its in (motion, other)
    ]
    is_shared = np.minimum(*counts) > MIN_OUTLIER_RATIO * (counts[0] + counts[1])
    return int(counts[1][is_shared].sum()) if is_shared.sum() >= min(2, len(is_shared)) else 0


# --- positions --------------------------------------------------------------------------------------------------------


def estimate_first_points(
    camera: Camera, inliers: Pairs, first_pose: RigidTransform, current_pose: RigidTransform
) -> FloatArray:
    """Estimate positions (m, 3) of a camera's inliers on the object.

    If the motion determines too few depths, all are placed at the depth of the object's center.
    """
    points = triangulate_inliers(camera, inliers, first_pose, current_pose)
    count = sum(map(len, inliers))
    if 2 * len(points) > count or not count:
        return points
    depth = camera.camera_from_world.apply(first_pose.translation)[2]
    rays = np.concatenate([np.column_stack([pair.normalized_i, np.ones(len(pair))]) for pair in inliers])
    return np.asarray(first_pose.inv().apply(camera.camera_from_world.inv().apply(depth * rays)))


def triangulate_inliers(
    camera: Camera, inliers: Pairs, first_pose: RigidTransform, current_pose: RigidTransform
) -> FloatArray:
    """Triangulate a camera's inliers on the object, (m, 3). See `frame.triangulate`."""
    points = [triangulate(pair, camera, first_pose, current_pose) for pair in inliers]
    return np.concatenate([np.empty((0, 3)), *points])
