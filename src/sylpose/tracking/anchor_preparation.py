"""Preparation of the next anchor in a background thread.

New features are needed before the anchor's tracks run out. A thread detects the remaining features of a solved frame
and matches them with the keyframes by descriptors. A fixed number of frames later that frame becomes the anchor. Its
pose was solved from tracked features alone, so each camera decides by itself which new matches agree with it. The
timing depends on frame numbers only, never on computing time.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sylpose.features.klt import start_tracks, track_features
from sylpose.features.sift import MAX_FAINT_FEATURES, Features, detect_features, find_static_features, match_features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, Image, IntArray
from sylpose.geometry.future import BackgroundResult
from sylpose.landmarks.alignment import stack_matches
from sylpose.landmarks.camera_terms import compute_camera_terms, make_camera_state
from sylpose.rig import Camera
from sylpose.tracking.camera import CameraTracker
from sylpose.tracking.context import Region, TrackerContext
from sylpose.tracking.frame import CameraFrame, FrameMatches, SolvedFrame, drop_background, match_frames
from sylpose.tracking.joint_state import JointState
from sylpose.tracking.keyframes import add_keyframe, select_references
from sylpose.tracking.klt_frontend import (
    N_ANCHOR_FEATURES,
    Anchor,
    CameraAnchor,
    NextAnchor,
    TrackedFeatures,
    append_new_features,
    create_anchor,
    select_tracked,
)
from sylpose.tracking.observations import build_observations, split_by_pair
from sylpose.tracking.pose_search import MAX_KLT_FEATURES, PoseCandidate
from sylpose.tracking.region import rasterize_outline
from sylpose.tracking.reobserved import ReobservedFeatures

__all__ = ["begin_preparation", "can_prepare", "find_new_features", "join_anchor"]

# Delay in frames until the new features are added: at 30 frames per second the time needed on a busy processor
# (choice).
JOIN_DELAY = 7
# Minimum noise by which a match is judged, pixels (choice).
MIN_NOISE_PX = 1.0


def can_prepare(state: JointState) -> bool:
    """Return whether the last frame may become the next anchor."""
    return state.next_anchor_number is None and state.has_moved and not state.object.is_depth_guessed


def begin_preparation(
    context: TrackerContext, state: JointState, frames: FrameSet, candidate: PoseCandidate
) -> JointState:
    """Start detecting new features in the last solved frame."""
    assert candidate.tracked is not None
    last, tracked = state.last_frame, candidate.tracked

    def begin_in_camera(c: int) -> None:
        camera_tracker, tracked_features = context.camera_trackers[c], tracked[c]
        camera_tracker.next_anchor = None
        if tracked_features.image is None:
            return
        keyframes = select_references(state.keyframes, c, last.viewpoints[c], last)
        references = {k.number: camera_tracker.frames[k.number].features for k in keyframes}
        area = _search_area(candidate.regions[c], frames.masks[c], camera_tracker.camera)
        detection = BackgroundResult(
            find_new_features,
            tracked_features.image,
            camera_tracker.camera,
            area,
            state.is_feature_poor,
            tracked_features,
            camera_tracker.background_features,
            camera_tracker.static_px,
            references,
        )
        camera_tracker.next_anchor = NextAnchor(
            last.number,
            tracked_features.image,
            candidate.rig.cameras[c],
            len(tracked_features),
            tracked_features.rows,
            detection,
        )

    context.executor.map_cameras(begin_in_camera)
    return replace(state, next_anchor_number=last.number)


def _search_area(region: Region, mask: BoolArray | None, camera: Camera) -> BoolArray:
    area = rasterize_outline(region, camera.size)
    return area if mask is None else area & mask


def find_new_features(
    image: Image,
    camera: Camera,
    area: BoolArray,
    faint: bool,
    tracked: TrackedFeatures,
    background_features: Features,
    static_px: float,
    references: dict[int, Features],
) -> tuple[Features, dict[int, IntArray]]:
    """Detect new features in an area (h, w) of an image and match them with earlier frames.

    Args:
        faint: whether low-contrast features are included.
        tracked: tracked features, which are not detected again.
        background_features: known background features.
        references: features of earlier frames, by number.

    Returns:
        the new features; by frame number, match indices (m, 2).
    """
    detected = detect_features(image, camera, area, MAX_FAINT_FEATURES if faint else MAX_KLT_FEATURES, faint=faint)
    new = append_new_features(
        tracked, detected, find_static_features(detected, background_features, static_px), N_ANCHOR_FEATURES
    )
    new = new.subset(np.arange(len(tracked), len(new)))
    return new, {number: match_features(features, new) for number, features in references.items()}


def join_anchor(context: TrackerContext, state: JointState, number: int) -> JointState:
    """Switch to the next anchor once it is due in the frame with this number."""
    if (
        state.next_anchor_number is None
        or number < state.next_anchor_number + JOIN_DELAY
        or state.next_anchor_number not in state.known_frames
    ):
        return state
    frame = state.known_frames[state.next_anchor_number]
    context.executor.map_cameras(lambda c: _join_camera(context.camera_trackers[c], state, frame), is_slow=True)
    keyframes = tuple(sorted(add_keyframe(state.keyframes, frame), key=lambda k: k.number))
    return replace(
        state,
        anchor=Anchor(frame, state.last_frame.number - frame.number),
        keyframes=keyframes,
        next_anchor_number=None,
    )


def _join_camera(camera_tracker: CameraTracker, state: JointState, frame: SolvedFrame) -> None:
    """Add the new features to one camera's frame and track them from now on."""
    next_anchor, old, previous_anchor = (
        camera_tracker.next_anchor,
        camera_tracker.frames[frame.number],
        camera_tracker.anchor,
    )
    camera_tracker.next_anchor = None
    if (
        next_anchor is None
        or previous_anchor is None
        or next_anchor.number != frame.number
        or next_anchor.n_tracked != len(old.features)
    ):
        # The camera had no image of the frame, or was rejected.
        camera_tracker.anchor = create_anchor(frame.number, old, None, None)
        return
    features, matches = next_anchor.result.value()
    new_frame, pose, radius = camera_tracker.create_frame(features), frame.world_from_object, state.object.radius
    pairs = []
    for number, indices in matches.items():
        if number in camera_tracker.frames and number in state.known_frames:
            pair = match_frames(number, camera_tracker.frames[number], new_frame, indices)
            reference_pose = state.known_frames[number].world_from_object
            pairs.append(drop_background(pair, new_frame, next_anchor.camera, reference_pose, pose, radius))
    reobserved = _select_agreeing(next_anchor.camera, [pair for pair in pairs if len(pair)], new_frame, frame, radius)
    camera_tracker.update_landmarks(new_frame, next_anchor.camera, pose, reobserved, state.object.points, radius)
    merged = CameraFrame(
        Features.concatenate([old.features, features]),
        np.concatenate([old.background, new_frame.background]),
        camera_tracker.table,
        np.concatenate([old.landmark_ids, new_frame.landmark_ids]),
        camera_tracker.static_px,
    )
    camera_tracker.frames[frame.number] = merged
    camera_tracker.anchor = _track_to_last_image(
        next_anchor, new_frame, merged, frame, state.last_frame, previous_anchor
    )


def _select_agreeing(
    camera: Camera, pairs: list[FrameMatches], new: CameraFrame, frame: SolvedFrame, radius: float
) -> ReobservedFeatures:
    """Select a camera's matches that agree with its frame's pose."""
    if not pairs:
        return ReobservedFeatures.empty()
    observations, _ = build_observations(camera, pairs, new, frame)
    stacked = stack_matches([replace(observations, prior_weight=np.ones(len(observations.prior_weight)))])
    terms = make_camera_state(stacked)
    compute_camera_terms(stacked, 0, np.eye(3), np.zeros(3), MIN_NOISE_PX, True, terms, np.empty((6, 7)))
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
    tracks, new_tracks = (
        previous_anchor.tracks.subset(next_anchor.rows),
        start_tracks(next_anchor.image, new_features.features.pixels),
    )
    alive = select_tracked(
        np.concatenate([previous_anchor.is_alive[next_anchor.rows], new_tracks.tracked & ~new_features.background]),
        next_anchor.n_tracked,
    )
    alive[: next_anchor.n_tracked] = previous_anchor.is_alive[next_anchor.rows]
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
