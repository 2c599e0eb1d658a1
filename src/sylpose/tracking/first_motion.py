"""First motion of the object: what moves against the static background, without boxes or within them.

Until the object has moved, its surface is a guess. The first motion separates it from the background and determines the
depths. A box contains more than the object: a person passing behind it, or a wall, is visible near the box's edges. The
object is at the center, so motion at the center is the object's.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.matrices import invert_information, make_motion_about
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.matches import STATIC_PX
from sylpose.relative_pose.affine_ransac import QUADRUPLES, find_inliers
from sylpose.relative_pose.camera_evidence import (
    EXPECTED_RATIO,
    MIN_KEPT_POOLED,
    CameraEvidence,
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
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.camera_side.frame import (
    CameraFrame,
    CameraPairs,
    FrameMatches,
    Pairs,
    Region,
    collect_features,
    find_static,
    mark_others_as_background,
    measure_displacement,
    omit_empty,
    select_inliers,
    triangulate,
)
from sylpose.tracking.context import Context, Frame
from sylpose.tracking.frame_solvers import scatter_fit
from sylpose.tracking.joint_side.joint_state import JointState, KnownMotion, PoseEstimate, bound_information
from sylpose.tracking.joint_side.object_model import MIN_SURFACE_POINTS
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.reports import BoxMotionReport, InitialMatches, MovingMatches, quantize_positions

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
# The center of a box is this share of its width and height (choice).
CENTER_RATIO = 0.5
# The center is static if its displacement is within the noise and below this share of that of moving features, both
# medians (choice: a body rotating about itself moves its center by about a third).
MAX_CENTER_MOTION_RATIO = 0.15
# Matches of one body have common affine epipolar lines, within so many pixels (choice: sensitivity in
# docs/history/benchmarks.md#trust).
MAX_GROUP_DISTANCE_PX = 0.5


# Reason for an ambiguous object in boxes.
OUTSIDE_REASON = "most of what moves like the content of the boxes is outside of them: another body, or too small boxes"


@dataclass(frozen=True, eq=False)
class FirstMotion:
    """Motion since a frame, of the only object that moves.

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
        moving: per camera, its moving matches with the frame, inliers or not.
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
    excess = [measure_excess(own, center, fit.rotation, fit.translation)[0] for own in by_camera]
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
    return FirstMotion(
        fit=fit,
        center=center,
        inlier_center=inlier_center,
        radius=radius,
        n_inliers=len(displacement),
        displacement_px=float(np.median(displacement)) if len(displacement) else np.nan,
        n_cameras=int(detects_motion.sum()),
        is_rigid=int(is_rigid.sum()) >= min_cameras,
        is_significant=int(detects_motion.sum()) >= min_cameras,
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
    """Return the cameras (T,) in which a fit leaves much of its inliers' displacement unexplained."""
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
        (T,) cameras in which a rigid motion is likelier than independent displacements of the matches, none if it is not
        in all of them together; (T,) those of them that detect a motion beyond the noise of static keypoints.
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


# --- depth and background from the first motion -----------------------------------------------------------------------


def update_from_matches(
    context: Context, state: JointState, frame: Frame, pairs: CameraPairs
) -> tuple[JointState, RigidTransform | None, CameraPairs]:
    """Update depth and motion from a frame's matches (`JointState.needs_first_motion`).

    Args:
        frame: not solved yet.
        pairs: per camera, local: its matches.

    Returns:
        the state; the pose estimated from the matches, or None; per camera, local: the remaining matches, with frames
        that are still known and without background.
    """
    was_guessed = state.object.is_depth_guessed
    state, initial_motion = _update_depth(context, state, frame, pairs)
    known_frames = state.frames.by_number
    remaining = [
        [pair.subset(~current.background[pair.indices[:, 1]]) for pair in own if pair.reference in known_frames]
        for current, own in zip(frame.cameras, pairs, strict=True)
    ]
    if initial_motion is None:
        return state, None, remaining
    pose = initial_motion.motion * state.frames.first.world_from_object
    is_depth_new = was_guessed and not state.object.is_depth_guessed
    if state.motion.velocity.n_frames and not is_depth_new:
        return state, pose, remaining
    # The first motion that determines depth also separates the background: whatever does not take part, however much of
    # the boxes it fills. Static features near points where the object barely moves may agree with it, so only moving
    # features are kept. Other methods need every match.
    if not context.refines_window:
        return state, pose, context.drop_static_matches(state, frame, remaining, pose)
    if state.object.is_bounded:
        # New features in the boxes may be background: the next frames decide.
        for inliers, current in zip(initial_motion.inliers, frame.cameras, strict=True):
            mark_others_as_background(inliers, current)
    return state, pose, initial_motion.inliers


def _update_depth(
    context: Context, state: JointState, frame: Frame, pairs: CameraPairs
) -> tuple[JointState, FirstMotion | None]:
    """Replace depths guessed from boxes by those of a motion since the first frame.

    Boxes allow far more depth than the object has. Epipolar geometry needs no depth: its motion determines the surface,
    and the landmarks are reinitialized with it.

    Args:
        frame: not solved yet; background is marked in it.
        pairs: per camera, local: its matches.

    Returns:
        the state; the motion, or None. If depth is already known, only the motion is estimated.
    """
    first = state.frames.first
    initial_motion = estimate_first_motion(context, pairs, first.number)
    if state.object.is_depth_guessed:
        known = bound_pose(context, state, initial_motion.measure_displacement(first.world_from_object.translation))
        state = replace(state, motion=replace(state.motion, independent_pose=known))
    # Something may pass by behind the object.
    is_far = np.linalg.norm(initial_motion.inlier_center - first.world_from_object.translation) > state.object.radius
    is_unclear = initial_motion.fit.is_mixed or initial_motion.fit.alternative is not None
    if not initial_motion.is_rigid or is_unclear or is_far:
        return state, None
    if state.object.is_depth_guessed and (
        initial_motion.compute_f_ratio() > context.options.max_pooled_f_ratio
        or _is_at_edges(context, state, pairs, initial_motion)
    ):
        return state, None  # all later frames would build on it
    accepted_statuses = (Status.OK,) if len(context.rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
    is_observable = classify_observability(initial_motion.fit, state.object.radius)[0].status in accepted_statuses
    if is_observable and state.object.is_depth_guessed:
        known = initial_motion.estimate_pose(first.world_from_object, state.object.radius)
        state = replace(state, motion=replace(state.motion, independent_pose=known))
    if not initial_motion.is_significant:
        return state, None
    radius, current_pose = initial_motion.radius, initial_motion.motion * first.world_from_object
    motion = KnownMotion({first.number: first.world_from_object}, current_pose, radius)
    for camera, current, own in zip(context.cameras, frame.cameras, pairs, strict=True):
        # Boxes may contain more background than object.
        with_first = [pair for pair in own if pair.reference == first.number]
        camera.learn_background(with_first, current, motion)
    if not is_observable:
        return state, None
    # With two cameras a planar object has a second solution, which differs in each frame.
    if initial_motion.n_cameras == 2 and not is_continuing_motion(state.motion.first_motion, initial_motion.motion):
        return replace(state, motion=replace(state.motion, first_motion=initial_motion.motion)), None
    if not state.object.is_depth_guessed:
        return state, initial_motion
    points = [
        quantize_positions(triangulate_inliers(camera.camera, inliers, first.world_from_object, current_pose), radius)
        for camera, inliers in zip(context.cameras, initial_motion.inliers, strict=True)
    ]
    surface = np.concatenate(context.executor.gather(points, np.empty((0, 3))))
    if len(surface) < MIN_SURFACE_POINTS:
        return state, initial_motion
    state = state.reset_to_first_frame(radius)
    for camera in context.cameras:
        model = replace(state.object, points=surface)
        camera.table.update(camera.reinitialize_landmarks(state.frames.first, camera.camera, model))
    return state, initial_motion


def bound_pose(context: Context, state: JointState, displacement: float = 0.0) -> PoseEstimate:
    """Bound an object's pose by the displacement of its surface since the first frame, of unknown direction.

    The displacement is seen across the cameras' views. A bottle that turns about its axis moves its surface little: the
    rotation that moves it so far is large.

    Args:
        displacement: length units; the smallest one that is detected, if it is less; NaN if unknown: the object's radius.
    """
    pose, model = state.frames.first.world_from_object, state.object
    offsets = np.array([pose.translation - camera.center for camera in context.rig])
    distances = np.linalg.norm(offsets, axis=1)
    least = STATIC_PX * float(np.median(distances / [camera.focal for camera in context.rig]))
    size = model.radius if np.isnan(displacement) else max(displacement, least)
    views = offsets / distances[:, None]
    across = np.eye(3) - views.T @ views / len(views)
    points = pose.rotation.apply(model.points) if len(model.points) else np.zeros((1, 3))
    jacobian = np.concatenate([-np.cross(np.eye(3), points[:, None]), np.tile(np.eye(3), (len(points), 1, 1))], axis=2)
    information = np.einsum("nki,kl,nlj->ij", jacobian, across, jacobian) / (len(points) * size**2)
    return PoseEstimate(pose, invert_information(information + bound_information(model.radius)))


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


# --- motion in boxes --------------------------------------------------------------------------------------------------


def is_box_center_static(context: Context, state: JointState, frame: Frame, pairs: CameraPairs) -> bool:
    """Return whether something moves in the boxes but not at their centers, in most cameras.

    Args:
        pairs: per camera, local: the frame's matches.
    """
    points = state.frames.first.world_from_object.apply(state.object.points)
    own_reports = [
        _report_box_motion(camera.camera, points, own, current.static_px)
        for camera, own, current in zip(context.cameras, pairs, frame.cameras, strict=True)
    ]
    reports = context.executor.gather(own_reports, BoxMotionReport())
    displacements = [report.moving_displacement_px for report in reports if report.n_moving >= MIN_MATCHES]
    usable = [report for report in reports if report.n_center >= MIN_MATCHES]
    max_displacement = MAX_CENTER_MOTION_RATIO * float(np.median(displacements)) if displacements else 0.0
    return 2 * sum(
        report.is_center_static and report.center_displacement_px < max_displacement for report in usable
    ) > len(usable)


def _report_box_motion(camera: Camera, points: FloatArray, pairs: Pairs, static_px: float) -> BoxMotionReport:
    """Report the motion in one camera's box.

    Args:
        points: (n, 3) points on the object, world.
        static_px: smaller displacements are within the noise, pixels.
    """
    outline = camera.project(points)
    outline = outline[np.isfinite(outline).all(axis=1)]
    if not len(outline) or not pairs:
        return BoxMotionReport()
    low, high = outline.min(axis=0), outline.max(axis=0)
    landmarks = Landmarks.concatenate([pair.landmarks for pair in pairs])
    displacement = measure_displacement(landmarks, np.concatenate([pair.pixels_j for pair in pairs]))
    offset = np.abs(landmarks.origin - 0.5 * (low + high)) / np.maximum(0.5 * (high - low), 1e-9)
    is_center, is_moving = (offset < CENTER_RATIO).all(axis=1), displacement > static_px
    feature = collect_features(pairs)
    counts = [len(np.unique(feature[some])) for some in (is_center, is_moving)]
    pixels = [float(np.median(displacement[some])) if some.any() else np.nan for some in (is_center, is_moving)]
    return BoxMotionReport(counts[0], pixels[0], pixels[0] <= static_px, counts[1], pixels[1])


def _is_at_edges(context: Context, state: JointState, pairs: CameraPairs, motion: FirstMotion) -> bool:
    """Return whether a motion since the first frame is that of something at the edges of the boxes.

    Its matches are at the centers less often than if they were spread evenly, by three standard deviations, and less often
    than those of what does not follow it: the object, which moves slowly before a person.

    Args:
        pairs: per camera, local: the matches.
    """
    first = state.frames.first
    regions = context.project_regions(state, first.world_from_object)
    sides = zip(context.cameras, regions, pairs, motion.inliers, strict=True)
    own_counts = [_count_central(camera, region, first.number, own, inliers) for camera, region, own, inliers in sides]
    counts = np.array(context.executor.gather(own_counts, (0, 0, 0, 0))).sum(axis=0)
    (n, n_central), (n_others, n_central_others) = counts[:2], counts[2:]
    share = CENTER_RATIO**2
    least = share * n - 3.0 * np.sqrt(share * (1.0 - share) * n)
    return bool(n_central < least and n_central * n_others < n_central_others * n)


def _count_central(
    camera: CameraTracker, region: Region, first_number: int, pairs: Pairs, inliers: Pairs
) -> tuple[int, int, int, int]:
    """Count the matched features of the first frame that follow a motion, and the others: all, and those at the center."""
    if region is None or first_number not in camera.frames:
        return 0, 0, 0, 0
    features = camera.frames[first_number].features
    is_matched, is_following = np.zeros((2, len(features)), bool)
    for mask, parts in ((is_matched, pairs), (is_following, inliers)):
        for pair in parts:
            if pair.reference == first_number:
                mask[pair.indices[:, 0]] = True
    is_central, is_other = camera.find_inside(features, _shrink(region)), is_matched & ~is_following
    both = (is_following, is_following & is_central, is_other, is_other & is_central)
    counts = [int(np.count_nonzero(mask)) for mask in both]
    return counts[0], counts[1], counts[2], counts[3]


def is_mostly_outside(context: Context, state: JointState, frame: Frame, pose: RigidTransform) -> bool:
    """Return whether most of what follows the first motion was outside of the boxes: in all and in most cameras.

    Boxes hold the whole object: a body that fills them and continues outside is another one, as a person behind an object
    without texture. The epipolar geometry of the motion needs no depths. If the cameras' own motions agree inside, and
    contradict it outside, another body moves alike.

    Args:
        frame: in which the object has moved.
        pose: its world_from_object.
    """
    compare = partial(CameraTracker.compare_surroundings, images=frame.images, first=state.frames.first, pose=pose)
    nothing = 0.0, CameraEvidence(), 0.0, CameraEvidence()
    sides = context.executor.gather(context.executor.run(compare, context.cameras), nothing)
    counts = np.array([(inside, outside) for inside, _, outside, _ in sides])
    inside, outside = np.maximum(counts, 0.0).T
    # Three standard deviations of what a coin decides: too few matches may be another body that moves alike.
    is_significant = (outside - inside).sum() > 3.0 * np.sqrt((outside + inside).sum())
    if not is_significant or 2 * np.sum(outside > inside) <= np.sum(np.maximum(inside, outside) > 0.0):
        return False
    excess = np.array([(of_inside.excess, of_outside.excess) for _, of_inside, _, of_outside in sides]).T
    of_inside, of_outside = (compute_f_ratio(np.ascontiguousarray(own), MIN_KEPT_POOLED) for own in excess)
    return not (of_inside < EXPECTED_RATIO and of_outside > context.options.max_f_ratio)


def is_replaced(context: Context, state: JointState, frame: Frame) -> bool:
    """Return whether the images show something else at the centers of the boxes than in the first frame.

    At least two cameras have to, if there are: something may pass in front of one. It is evidence of a motion without any
    match: what moves fast, or behind a static pattern, leaves only static ones.
    """
    regions = context.project_regions(state, state.frames.first.world_from_object)
    count = partial(CameraTracker.count_replaced, images=frame.images, first=state.frames.first)
    own_counts = context.executor.run(count, context.cameras, list(map(_shrink, regions)))
    total, replaced = np.array(context.executor.gather(own_counts, (0, 0))).T
    is_other = replaced > MISMATCH_PROBABILITY * total
    return bool(replaced.sum() >= MIN_MATCHES and is_other.sum() >= min(2, len(context.rig)))


def count_center_features(camera: CameraTracker, features: Features, region: Region) -> int:
    """Count a camera's features in the center of the object's region."""
    return 0 if region is None else int(camera.find_inside(features, _shrink(region)).sum())


def _shrink(region: Region) -> Region:
    """Return the center of an object's region."""
    if region is None:
        return None
    middle = region.mean(axis=0)
    return np.asarray(middle + CENTER_RATIO * (region - middle))


def select_static_matches(frame: Frame, pairs: CameraPairs) -> CameraPairs:
    """Select matches of features that have not moved since they were first observed; per camera, local."""
    return [
        omit_empty(pair.subset(_is_static(pair, current)) for pair in own)
        for own, current in zip(pairs, frame.cameras, strict=True)
    ]


def _is_static(pair: FrameMatches, current: CameraFrame) -> BoolArray:
    return np.asarray(measure_displacement(pair.landmarks, pair.pixels_j) <= current.static_px)
