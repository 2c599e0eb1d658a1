"""The first frames: with boxes, the object is what is visible in them; without, it is what moves.

Without boxes frames are buffered until the object has moved, and then solved together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.status import FrameStatus
from sylpose.tracking.box_motion import count_center_features
from sylpose.tracking.camera_side.camera import MAX_SEARCH_PIXELS, CameraTracker
from sylpose.tracking.camera_side.frame import (
    CameraFrame,
    CameraPairs,
    FrameMatches,
    Pairs,
    collect_detected_features,
    find_background,
    match_frames,
    omit_empty,
)
from sylpose.tracking.context import Context, Frame, FrameResult, TrackedFrame, create_unsolved_frame
from sylpose.tracking.first_motion import (
    FirstMotion,
    estimate_first_motion,
    estimate_first_points,
    estimate_jitter,
    find_rivals,
    is_continuing_motion,
)
from sylpose.tracking.joint_side.joint_state import Anchor, JointState, KnownMotion, MotionModel, Refinement
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.map_update import accept_first_frame, accept_frame, handle_missing_object
from sylpose.tracking.pose_search import find_pose, is_scattered
from sylpose.tracking.relocalization import search_again
from sylpose.tracking.reports import quantize_positions

# Without boxes the object is unknown until it moves: frames are buffered with their features, and with their images up
# to so many bytes (choice).
MAX_BUFFERED_BYTES = 1 << 29
AMBIGUITY_REASON = "another body moves as well; select the object"
AMBIGUITY_NOTE = (
    "Without boxes, the largest moving body is tracked, but another one moves as well. Provide a box or a mask to select "
    "the object."
)


class BufferedFrame(NamedTuple):
    """A buffered frame before the first pose; its motion since the first buffered frame, if any."""

    frame: Frame
    motion: RigidTransform | None = None


def initialize_tracking(
    context: Context, state: JointState, buffered: Sequence[BufferedFrame], frame: Frame
) -> tuple[JointState, list[BufferedFrame], list[TrackedFrame]]:
    """Process a frame before the first pose.

    Args:
        frame: without features.

    Returns:
        the state; the buffered frames; the decided frames.
    """
    if state.object.center is not None:
        state, tracked = _initialize_from_boxes(context, state, frame, state.object.center)
        return state, [], [tracked]
    candidate = context.candidate
    if candidate is not None and frame.images.index < candidate.first:
        nothing = [Features.empty() for _ in context.cameras]
        tracked = _create_unmatched_frame(context, frame, FrameStatus.NO_MOTION, nothing)
        reason = f"the object is not seen to move before frame {candidate.first}"
        return state, [], [replace(tracked, pose=replace(tracked.pose, reason=reason))]
    features = context.detect_everywhere(frame.images, context.options.max_start_features, max_pixels=MAX_SEARCH_PIXELS)
    if not buffered and _count_features(context, features) < MIN_MATCHES:
        # Later frames need one to be compared with.
        return state, [], [_create_unmatched_frame(context, frame, FrameStatus.TOO_FEW_MATCHES, features)]
    buffered = [*buffered, BufferedFrame(context.with_features(frame, features))]
    status = FrameStatus.NO_MOTION
    if len(buffered) > 1:
        pairs, first_motion = _match_first_motion(context, buffered)
        if first_motion.is_significant:
            buffered[-1] = buffered[-1]._replace(motion=first_motion.motion)
            is_large = first_motion.is_observable or first_motion.displacement_px > context.options.min_first_motion_px
            is_due = is_large and is_continuing_motion(buffered[-2].motion, first_motion.motion)
            if candidate is not None:
                # The search measured the motion up to this frame: over less time two bodies may not be separable.
                after_last = frame.images.index - candidate.last
                is_due = after_last > 0 or (is_due and after_last == 0)
            is_due |= len(buffered) > context.options.max_buffered_frames
            if is_due and (started := _initialize_from_motion(context, buffered, pairs, first_motion)):
                return replace(started[0], nudges=state.nudges), [], started[1]
        elif started := _initialize_from_steps(context, buffered):
            return replace(started[0], nudges=state.nudges), [], started[1]
        status = first_motion.failure_status
    if len(buffered) <= context.options.max_buffered_frames:
        return state, _limit_memory(buffered), []
    # Motions since the dropped frame are no longer defined.
    remaining = [buffered_frame._replace(motion=None) for buffered_frame in buffered[1:]]
    dropped = buffered[0].frame
    return state, remaining, [_create_unmatched_frame(context, dropped, status, dropped.features)]


def finish_initialization(context: Context, buffered: Sequence[BufferedFrame]) -> list[TrackedFrame]:
    """Decide the frames buffered at the recording's end; a smaller motion is accepted now."""
    status = FrameStatus.NO_MOTION
    if len(buffered) > 1:
        pairs, first_motion = _match_first_motion(context, buffered)
        if first_motion.is_significant and (started := _initialize_from_motion(context, buffered, pairs, first_motion)):
            return started[1]
        status = first_motion.failure_status
    return [_create_unmatched_frame(context, frame, status, frame.features) for frame, _ in buffered]


def _count_features(context: Context, features: Sequence[Features]) -> int:
    """Count the features of all cameras."""
    return sum(context.executor.gather([len(own) for own in features], 0))


def _create_unmatched_frame(
    context: Context, frame: Frame, status: FrameStatus, features: Sequence[Features], radius: float = np.nan
) -> TrackedFrame:
    """Create the result of a frame whose features are not matched."""
    return create_unsolved_frame(context, frame, status, [collect_detected_features(own) for own in features], radius)


# --- with boxes -------------------------------------------------------------------------------------------------------


def _initialize_from_boxes(context: Context, state: JointState, frame: Frame, center: FloatArray) -> FrameResult:
    """Accept the first frame with enough features in the boxes; center (3,) of the object, world."""
    regions = context.project_regions(state, RigidTransform.from_translation(center))
    frame = replace(frame, regions=regions)
    features = context.detect(frame, faint=False)
    own_counts = [count_center_features(*own) for own in zip(context.cameras, features, regions, strict=True)]
    n_center = sum(context.executor.gather(own_counts, 0))
    state = replace(state, is_feature_poor=n_center < context.options.min_strong_inliers * len(context.rig))
    if state.is_feature_poor:
        features = context.detect(frame, faint=True)
    if _count_features(context, features) < MIN_MATCHES:
        status = FrameStatus.TOO_FEW_MATCHES
        return state, _create_unmatched_frame(context, frame, status, features, state.object.radius)
    detect_around = partial(CameraTracker.detect_surroundings, images=frame.images, faint=state.is_feature_poor)
    around = context.executor.run(detect_around, context.cameras, regions)
    return accept_first_frame(context, state, context.with_features(frame, features), around, center)


# --- without boxes ----------------------------------------------------------------------------------------------------


def _limit_memory(buffered: Sequence[BufferedFrame]) -> list[BufferedFrame]:
    """Drop images of buffered frames, oldest but the first, above the memory limit."""
    sizes = [sum(image.nbytes for image in frame.images.images if image is not None) for frame, _ in buffered]
    total, limited = sum(sizes), list(buffered)
    for k in range(1, len(buffered)):
        if total <= MAX_BUFFERED_BYTES:
            break
        frame = buffered[k].frame
        no_images = replace(frame.images, images=(None,) * len(frame.images.images))
        limited[k] = buffered[k]._replace(frame=replace(frame, images=no_images))
        total -= sizes[k]
    return limited


def _match_first_motion(
    context: Context, buffered: Sequence[BufferedFrame]
) -> tuple[list[list[FrameMatches]], FirstMotion]:
    """Match the last buffered frame with the first and estimate the motion."""
    first, current = buffered[0].frame, buffered[-1].frame
    matches = context.executor.run(partial(match_frames, first.number), first.cameras, current.cameras)
    pairs = [omit_empty([pair]) for pair in matches]
    selected = pairs
    if context.candidate is not None and context.candidate.rival_ratio > 0:
        # Other bodies move as well.
        outlines = context.candidate.outlines
        selected = [
            [
                pair.subset(camera.find_inside(own.features, outlines[camera.index])[pair.indices[:, 0]])
                for pair in of_camera
            ]
            for camera, own, of_camera in zip(context.cameras, first.cameras, pairs, strict=True)
        ]
    return pairs, estimate_first_motion(context, list(map(omit_empty, selected)), first.number)


def _initialize_from_motion(
    context: Context, buffered: Sequence[BufferedFrame], pairs: CameraPairs, first_motion: FirstMotion
) -> tuple[JointState, list[TrackedFrame]] | None:
    """Initialize the object from the first motion and solve all buffered frames.

    The last frame is solved first; with the landmarks it provides, those between are solved in order.

    Args:
        pairs: per camera, local: matches of the last frame with the first.
        first_motion: the motion between them.

    Returns:
        the state and the results; None if what moved was not a rigid body.
    """
    first, *between, end_frame = (buffered_frame.frame for buffered_frame in buffered)
    first_pose = RigidTransform.from_translation(first_motion.inlier_center)
    end_pose = first_motion.motion * first_pose
    candidate = context.candidate
    is_ambiguous = (
        bool(find_rivals(context, pairs, first.number, first_motion))
        if candidate is None
        else candidate.is_ambiguous(context.options)
    )
    ambiguity = AMBIGUITY_REASON if is_ambiguous else ""
    state = JointState(
        _create_model(context, first_motion, first_pose, end_pose),
        refinement=Refinement(
            first_motion.estimate_pose(first_pose, first_motion.radius).covariance if context.refines_window else None
        ),
        ambiguity=ambiguity,
    )
    frame = replace(first, regions=context.project_regions(state, first_pose))
    motion = KnownMotion({first.number: first_pose}, end_pose, first_motion.radius)
    sides = [
        _split_foreground(camera, current, region, own, frame, motion)
        for camera, current, region, own in zip(context.cameras, first.cameras, frame.regions or (), pairs, strict=True)
    ]
    frame = context.with_features(frame, [inside for inside, _ in sides])
    around = [outside for _, outside in sides]
    state, tracked = accept_first_frame(context, state, frame, around, first_motion.inlier_center)
    decided, start = [replace(tracked, note=AMBIGUITY_NOTE if is_ambiguous else "")], state.last
    state, last_tracked = _solve_buffered_frame(context, state, end_frame, end_pose)
    if not (state.motion.has_moved and last_tracked.pose.is_observed):
        # No rigid motion that lasted: wait for another one.
        for camera in context.cameras:
            camera.reset()
        return None
    end = state.last
    # The velocity is unknown for the frames between.
    frames = replace(state.frames, last=start, keyframes=(start, end), anchor=None)
    state = replace(state, frames=frames, motion=replace(state.motion, velocity=MotionModel()))
    for camera in context.cameras:
        camera.view = camera.view_of(first.images)
    for buffered_frame in between:
        pose = state.predict_pose(buffered_frame.time)
        state, tracked = _solve_buffered_frame(context, state, buffered_frame, pose)
        decided.append(tracked)
    if end.number in state.frames.by_number:
        motion = end.world_from_object * state.last.world_from_object.inv()
        state = state.add_solved_frame(end, motion, context.options, has_new_features=False)
        for camera in context.cameras:
            camera.view = camera.view_of(end_frame.images)
            if context.uses_klt:
                camera.set_anchor(end.number, end_frame.images, None)
        keyframes = tuple(sorted(state.frames.keyframes, key=lambda k: k.number))
        anchor = Anchor(end) if context.uses_klt else state.frames.anchor
        state = replace(state, frames=replace(state.frames, keyframes=keyframes, anchor=anchor))
    else:  # one of them determined the depth: the end frame, based on guessed depth, was discarded
        state, last_tracked = _solve_buffered_frame(context, state, end_frame, state.predict_pose(end_frame.time))
    return state, [*decided, last_tracked]


def _initialize_from_steps(
    context: Context, buffered: Sequence[BufferedFrame]
) -> tuple[JointState, list[TrackedFrame]] | None:
    """Initialize the object from the motion up to the frame before the last, if that to the last continues it.

    Views of a fast or repetitive object may only match in adjacent frames.

    Returns:
        as `_initialize_from_motion`; None without two such motions.
    """
    *before, last = buffered
    if len(before) < 2 or before[-1].motion is None:
        return None
    # Images may have been dropped.
    if all(image is None for image in before[-1].frame.images.images):
        return None
    _, step = _match_first_motion(context, [before[-1], last])
    if not step.is_significant or not is_continuing_motion(before[-1].motion, step.motion * before[-1].motion):
        return None
    pairs, first_motion = _match_first_motion(context, before)
    if not first_motion.is_observable:
        return None
    started = _initialize_from_motion(context, before, pairs, first_motion)
    if started is None:
        return None
    state, decided = started
    state, tracked = _solve_buffered_frame(context, state, last.frame, state.predict_pose(last.frame.time))
    return state, [*decided, tracked]


def _create_model(
    context: Context, first_motion: FirstMotion, first_pose: RigidTransform, end_pose: RigidTransform
) -> ObjectModel:
    """Create the object's model from its first motion."""
    radius = first_motion.radius
    # If a second motion fits as well, depth depends on which one is true.
    is_guessed = first_motion.fit.alternative is not None
    model = ObjectModel(first_motion.inlier_center, radius, is_depth_guessed=is_guessed)
    points = [
        quantize_positions(estimate_first_points(camera.camera, inliers, first_pose, end_pose), radius)
        for camera, inliers in zip(context.cameras, first_motion.inliers, strict=True)
    ]
    return model.add_points(np.concatenate(context.executor.gather(points, np.empty((0, 3)))), context.seed)


def _split_foreground(
    camera: CameraTracker,
    current: CameraFrame,
    region: FloatArray | None,
    pairs: Pairs,
    frame: Frame,
    motion: KnownMotion,
) -> tuple[Features, Features]:
    """Split the first frame's features into object candidates and static or surrounding ones.

    Args:
        current: the camera's data of the first frame.
        pairs: its matches of the last frame with the first.
        frame: the first frame.
        motion: from the first to the last frame.
    """
    for pair in pairs:
        camera.update_noise(estimate_jitter(pair))
    is_static, empty = np.zeros(len(current.features), bool), camera.create_empty_frame()
    for pair in pairs:
        still = find_background(pair, empty, camera.camera, motion)
        is_static[pair.indices[still, 0]] = True
    return camera.split_foreground(current.features, region, is_static, frame.images)


def _solve_buffered_frame(context: Context, state: JointState, frame: Frame, pose: RigidTransform) -> FrameResult:
    """Solve a buffered frame from a guess of its pose (world_from_object).

    Its features cover the whole image: static surroundings would seem to belong to an object at rest.
    """
    regions = context.project_regions(state, pose)
    detect_inside = partial(CameraTracker.detect_at_full_res, images=frame.images, faint=False)
    inside = context.executor.run(detect_inside, context.cameras, frame.features, regions)
    frame = context.with_features(replace(frame, regions=regions), inside)
    state, candidate = find_pose(context, state, frame, pose)
    if candidate is None or is_scattered(context, state, candidate):
        state, candidate = search_again(context, state, frame, pose, candidate)
    if candidate is None:
        return handle_missing_object(context, state, frame, pose)
    return accept_frame(context, state, candidate)
