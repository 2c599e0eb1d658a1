"""Motion in boxes: depth and background from the first motion, and whether the object is what moves.

Until the object has moved, its surface is a guess. The first motion separates it from the background and determines the
depths. A box contains more than the object: a person passing behind it, a wall, or an arm before it. The object is at the
center, so of several bodies that move it is the one with the most matches near the center.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import invert_information
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.matches import STATIC_PX
from sylpose.relative_pose.camera_evidence import EXPECTED_RATIO, MIN_KEPT_POOLED, CameraEvidence, compute_f_ratio
from sylpose.relative_pose.limits import MISMATCH_PROBABILITY
from sylpose.relative_pose.observability import classify_observability
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.rig import Camera
from sylpose.status import Status
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.camera_side.frame import (
    CameraFrame,
    CameraPairs,
    FrameMatches,
    Pairs,
    Region,
    collect_features,
    mark_others_as_background,
    measure_displacement,
    omit_empty,
)
from sylpose.tracking.context import Context, Frame
from sylpose.tracking.first_motion import (
    FirstMotion,
    estimate_first_motion,
    find_rivals,
    is_continuing_motion,
    triangulate_inliers,
)
from sylpose.tracking.joint_side.joint_state import JointState, KnownMotion, PoseEstimate, bound_information
from sylpose.tracking.joint_side.object_model import MIN_SURFACE_POINTS
from sylpose.tracking.reports import BoxMotionReport, quantize_positions

# The center of a box is this share of its width and height (choice).
CENTER_RATIO = 0.5
# The center is static if its displacement is within the noise and below this share of that of moving features, both
# medians (choice: a body rotating about itself moves its center by about a third).
MAX_CENTER_MOTION_RATIO = 0.15
# Reasons for an ambiguous object in boxes.
OUTSIDE_REASON = "most of what moves like the content of the boxes is outside of them: another body, or too small boxes"
RIVAL_REASON = "two bodies move in the boxes, the larger one not at their centers; draw the boxes close to the object"


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
    initial_motion, is_ambiguous = estimate_first_motion(context, pairs, first.number), False
    if state.object.is_bounded:
        initial_motion, is_ambiguous = _select_central(context, state, pairs, initial_motion)
    if state.object.is_depth_guessed:
        known = bound_pose(context, state, initial_motion.measure_displacement(first.world_from_object.translation))
        state = replace(state, motion=replace(state.motion, independent_pose=known))
    # Something may pass by behind the object.
    is_far = np.linalg.norm(initial_motion.inlier_center - first.world_from_object.translation) > state.object.radius
    is_unclear = initial_motion.fit.is_mixed or initial_motion.fit.alternative is not None
    if not initial_motion.is_rigid or is_unclear or is_far:
        return state, None
    counts = _count_all_central(context, state, pairs, initial_motion)
    if state.object.is_depth_guessed and (
        initial_motion.compute_f_ratio() > context.options.max_pooled_f_ratio or _is_at_edges(counts)
    ):
        return state, None  # all later frames would build on it
    accepted_statuses = (Status.OK,) if len(context.rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
    is_observable = classify_observability(initial_motion.fit, state.object.radius)[0].status in accepted_statuses
    # With two cameras another motion may fit as well, of two bodies, unless most of what is at the centers of the boxes
    # follows it. It differs in each frame; a frame may be examined more than once.
    number, earlier = state.motion.first_motion or (frame.number, None)
    is_continuing = number != frame.number and is_continuing_motion(earlier, initial_motion.motion)
    is_sufficient = len(context.rig) == 1 or initial_motion.n_cameras > 2
    _, n_central, _, n_central_others = counts
    is_central = state.object.is_bounded and n_central >= n_central_others
    is_confirmed = is_sufficient or is_continuing or is_central
    if is_observable and is_confirmed and state.object.is_depth_guessed:
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
    if not is_confirmed:
        motion_of_frame = (frame.number, initial_motion.motion)
        return replace(state, motion=replace(state.motion, first_motion=motion_of_frame)), None
    if not state.object.is_depth_guessed:
        return state, initial_motion
    points = [
        quantize_positions(triangulate_inliers(camera.camera, inliers, first.world_from_object, current_pose), radius)
        for camera, inliers in zip(context.cameras, initial_motion.inliers, strict=True)
    ]
    surface = np.concatenate(context.executor.gather(points, np.empty((0, 3))))
    if len(surface) < MIN_SURFACE_POINTS:
        return state, initial_motion
    if is_ambiguous:
        state = replace(state, ambiguity=RIVAL_REASON)
    pose = initial_motion.estimate_pose(first.world_from_object, radius)
    state = state.reset_to_first_frame(radius, pose.covariance if context.refines_window else None)
    for camera in context.cameras:
        model = replace(state.object, points=surface)
        camera.table.update(camera.reinitialize_landmarks(state.frames.first, camera.camera, model))
    return state, initial_motion


def _select_central(
    context: Context, state: JointState, pairs: CameraPairs, motion: FirstMotion
) -> tuple[FirstMotion, bool]:
    """Select the motion of the body that is the object; return it, and whether it is ambiguous.

    It is the one with the most matches per square of its distance from the centers of the boxes: an arm before the object
    may have more matches, a hand that holds it may be nearer. If another body has the most, which one is the object is the
    user's knowledge. Its motion need not be significant yet: that of an arm is no substitute.

    Args:
        pairs: per camera, local: the matches.
        motion: with the most matches.
    """
    if not motion.n_inliers:
        return motion, False
    center, first = state.frames.first.world_from_object.translation, state.frames.first.number
    bodies = [body for body in (motion, *find_rivals(context, pairs, first, motion)) if body.is_rigid] or [motion]
    squares_per_match = [float(((body.inlier_center - center) ** 2).sum()) / body.n_inliers for body in bodies]
    selected = bodies[int(np.argmin(squares_per_match))]
    return selected, motion.is_rigid and selected is not motion


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


def _is_at_edges(counts: IntArray) -> bool:
    """Return whether a motion since the first frame is that of something at the edges of the boxes.

    Its matches are at the centers less often than if they were spread evenly, by three standard deviations, and less often
    than those of what does not follow it: the object, which moves slowly before a person.

    Args:
        counts: of `_count_all_central`.
    """
    n, n_central, n_others, n_central_others = counts
    share = CENTER_RATIO**2
    least = share * n - 3.0 * np.sqrt(share * (1.0 - share) * n)
    return bool(n_central < least and n_central * n_others < n_central_others * n)


def _count_all_central(context: Context, state: JointState, pairs: CameraPairs, motion: FirstMotion) -> IntArray:
    """Count the matched features of the first frame that follow a motion, and the others: all, and those at the centers.

    Args:
        pairs: per camera, local: the matches.
    """
    first = state.frames.first
    regions = context.project_regions(state, first.world_from_object)
    sides = zip(context.cameras, regions, pairs, motion.inliers, strict=True)
    own_counts = [_count_central(camera, region, first.number, own, inliers) for camera, region, own, inliers in sides]
    return np.asarray(np.array(context.executor.gather(own_counts, (0, 0, 0, 0))).sum(axis=0))


def _count_central(
    camera: CameraTracker, region: Region, first_number: int, pairs: Pairs, inliers: Pairs
) -> tuple[int, int, int, int]:
    """Count one camera's features for `_count_all_central`."""
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
