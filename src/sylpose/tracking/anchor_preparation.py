"""Preparation of the next anchor in a background thread.

New features are needed before the anchor's tracks run out. A thread detects the remaining features of a solved frame
and matches them with the keyframes by descriptors. A fixed number of frames later that frame becomes the anchor. Its
pose was solved from tracked features alone, so each camera decides by itself which new matches agree with it. The
timing depends on frame numbers only, never on computing time.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from sylpose.features.klt import start_tracks, track_features
from sylpose.features.sift import MAX_FAINT_FEATURES, Features, detect_features, find_static_features, match_features
from sylpose.geometry.arrays import BoolArray, Image, IntArray
from sylpose.geometry.future import BackgroundResult
from sylpose.landmarks.alignment import make_camera_state, stack_matches
from sylpose.landmarks.camera_terms import compute_camera_terms
from sylpose.rig import Camera
from sylpose.tracking.camera_side.camera import (
    CameraAnchor,
    CameraTracker,
    NextAnchor,
    TrackedFeatures,
    append_new_features,
    create_anchor,
    select_tracked,
)
from sylpose.tracking.camera_side.frame import (
    CameraFrame,
    FrameMatches,
    ReobservedFeatures,
    build_observations,
    drop_background,
    match_frames,
    split_by_pair,
)
from sylpose.tracking.context import Context
from sylpose.tracking.frame_solvers import NARROW_START_PX
from sylpose.tracking.joint_side.joint_state import Anchor, JointState, SolvedFrame, add_keyframe, select_references
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.pose_search import PoseCandidate


def can_prepare(state: JointState) -> bool:
    """Return whether the last frame may become the next anchor."""
    is_idle = state.frames.next_anchor_number is None
    is_learned = state.motion.has_moved and not state.last.n_uncertain
    return is_idle and is_learned and not state.object.is_depth_guessed


def begin_preparation(context: Context, state: JointState, candidate: PoseCandidate) -> JointState:
    """Start detecting new features in the last solved frame."""
    frame, last = candidate.frame, state.last
    assert frame.tracked is not None
    assert frame.regions is not None
    for camera, tracked, region in zip(context.cameras, frame.tracked, frame.regions, strict=True):
        camera.next_anchor = None
        if tracked.image is None:
            continue
        keyframes = select_references(state.frames.keyframes, camera.index, last.viewpoints[camera.index], last)
        area, mask = camera.rasterize(region), frame.images.masks[camera.index]
        detection = BackgroundResult(
            find_new_features,
            tracked.image,
            camera.camera,
            area if mask is None else area & mask,
            state.is_feature_poor,
            tracked,
            camera.background_features,
            camera.static_px,
            {k.number: camera.frames[k.number].features for k in keyframes},
            context.options,
        )
        frame_camera = candidate.rig.cameras[camera.index]
        camera.next_anchor = NextAnchor(last.number, tracked.image, frame_camera, len(tracked), tracked.rows, detection)
    return replace(state, frames=replace(state.frames, next_anchor_number=last.number))


def find_new_features(
    image: Image,
    camera: Camera,
    area: BoolArray,
    faint: bool,
    tracked: TrackedFeatures,
    background_features: Features,
    static_px: float,
    references: dict[int, Features],
    options: TrackingOptions,
) -> tuple[Features, dict[int, IntArray]]:
    """Detect new features in an area (h, w) of an image and match them with earlier frames.

    Args:
        faint: whether low-contrast features are included.
        tracked: tracked features, which are not detected again.
        background_features: known background features.
        references: features of earlier frames, by number.
        options: numbers of features.

    Returns:
        the new features; by frame number, match indices (m, 2).
    """
    max_features = MAX_FAINT_FEATURES if faint else options.max_klt_features
    detected = detect_features(image, camera, area, max_features, faint=faint)
    new = append_new_features(
        tracked, detected, find_static_features(detected, background_features, static_px), options.n_anchor_features
    )
    new = new.subset(np.arange(len(tracked), len(new)))
    return new, {number: match_features(features, new) for number, features in references.items()}


def join_anchor(context: Context, state: JointState) -> JointState:
    """Switch to the next anchor, which is due (`KnownFrames.is_next_anchor_due`)."""
    assert state.frames.next_anchor_number is not None
    frame = state.frames.by_number[state.frames.next_anchor_number]
    context.executor.run(partial(_join_camera, state=state, frame=frame), context.cameras)
    keyframes = tuple(sorted(add_keyframe(state.frames.keyframes, frame, context.options), key=lambda k: k.number))
    anchor = Anchor(frame, state.last.number - frame.number)
    return replace(state, frames=replace(state.frames, anchor=anchor, keyframes=keyframes, next_anchor_number=None))


def _join_camera(camera: CameraTracker, state: JointState, frame: SolvedFrame) -> None:
    """Add the new features to one camera's frame and track them from now on."""
    next_anchor, old, previous_anchor = camera.next_anchor, camera.frames[frame.number], camera.anchor
    camera.next_anchor = None
    if (
        next_anchor is None
        or previous_anchor is None
        or next_anchor.number != frame.number
        or next_anchor.n_tracked != len(old.features)
    ):
        # The camera had no image of the frame, or was rejected.
        camera.anchor = create_anchor(frame.number, old, None, None)
        return
    features, matches = next_anchor.result.value()
    new_frame, pose, radius = camera.create_frame(features), frame.world_from_object, state.object.radius
    motion, pairs = state.motion_to(pose), list[FrameMatches]()
    for number, indices in matches.items():
        if number in camera.frames and number in motion.earlier:
            pair = match_frames(number, camera.frames[number], new_frame, indices)
            pairs += drop_background([pair], new_frame, next_anchor.camera, motion)
    reobserved = _select_agreeing(next_anchor.camera, pairs, new_frame, frame, radius)
    camera.update_landmarks(new_frame, next_anchor.camera, pose, reobserved, state.object)
    merged = old.append(new_frame)
    camera.frames[frame.number] = merged
    camera.anchor = _track_to_last_image(next_anchor, new_frame, merged, frame, state.last, previous_anchor)


def _select_agreeing(
    camera: Camera, pairs: list[FrameMatches], new: CameraFrame, frame: SolvedFrame, radius: float
) -> ReobservedFeatures:
    """Select a camera's matches that agree with its frame's pose."""
    if not pairs:
        return ReobservedFeatures.empty()
    observations, *_ = build_observations(camera, pairs, new, frame)
    stacked = stack_matches([replace(observations, prior_weight=np.ones(len(observations.prior_weight)))])
    terms = make_camera_state(stacked)
    compute_camera_terms(stacked, 0, np.eye(3), np.zeros(3), NARROW_START_PX, True, terms, np.empty((6, 7)))
    return ReobservedFeatures.from_matches(
        pairs, split_by_pair(terms.weights, terms.cross_residual * camera.focal, pairs), new.static_px, radius
    )


def _track_to_last_image(
    next_anchor: NextAnchor,
    new_features: CameraFrame,
    merged: CameraFrame,
    frame: SolvedFrame,
    last: SolvedFrame,
    previous_anchor: CameraAnchor,
) -> CameraAnchor:
    """Track the frame's features to the last image and create the anchor.

    Features with tracks keep their present pixels; new ones are tracked from the frame in a single step.

    Args:
        next_anchor: the prepared anchor's data.
        new_features, merged: the frame's new features; all its features, tracked ones first.
        frame, last: the anchor's frame; the last solved frame.
        previous_anchor: the anchor until now.
    """
    tracks, was_alive = previous_anchor.tracks.subset(next_anchor.rows), previous_anchor.is_alive[next_anchor.rows]
    new_tracks = start_tracks(next_anchor.image, new_features.features.pixels)
    is_tracked = np.concatenate([was_alive, new_tracks.tracked & ~new_features.background])
    alive = select_tracked(is_tracked, next_anchor.n_tracked)
    alive[: next_anchor.n_tracked] = was_alive
    if previous_anchor.image is not None:
        means = new_features.landmarks.mean
        start_pixels, end_pixels = (
            next_anchor.camera.project(solved.world_from_object.apply(means)) for solved in (frame, last)
        )
        new_tracks = track_features(
            new_tracks.keep(alive[next_anchor.n_tracked :]),
            next_anchor.image,
            previous_anchor.image,
            new_tracks.pixels + end_pixels - start_pixels,
        )
    alive[next_anchor.n_tracked :] &= new_tracks.tracked
    return CameraAnchor(frame.number, merged, tracks.concatenate(new_tracks), alive, previous_anchor.image)
