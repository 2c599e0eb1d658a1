"""Search for a lost object: near the prediction or anywhere, with bounded work per frame.

A lost frame must not cost much more than a tracked one, so that live tracking is not late when the object returns. Nearly
all of a search is the detection of features, whose time is proportional to the number of pixels: SIFT takes 0.4 us for
each, a frame tracked by KLT 10 ms for a camera (benchmarks/lost_frames.py). So each lost frame examines one region per
camera, downscaled to `TrackingOptions.search_pixels`, in an order that depends on images and frame numbers only:

1. While the pose can be predicted, every other frame: the object's region at the predicted pose.
2. Else a window as large as the object (`features.search_windows`), in turn the one that has changed most and the one
   searched longest ago.
3. After a pose was found, but not confirmed: its region in all cameras.

The features are matched with some keyframes, in rotation (`relocalize`), and the pose is solved again from the result.
During live tracking `search_clock` limits the pixels further.

The search with all features takes as long as several usual ones. It is only done for objects whose tracked frames take
as long: those that jump. Frames whose pose is weakly supported are searched again (`search_again`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.features.sift import Features, match_features
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import relative_rotvec
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.rig import Rig
from sylpose.status import Status
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.camera_side.frame import CameraFrame, DetectedFeatures
from sylpose.tracking.context import Context, Frame
from sylpose.tracking.joint_side.joint_state import (
    RETRY_FRAMES,
    JointState,
    SolvedFrame,
    compute_viewpoints,
    find_nearest_views,
)
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.pose_search import (
    OTHER_SIDE_ROTATION,
    SAME_PLACE_RATIO,
    PoseCandidate,
    SearchResult,
    detect_in_regions,
    find_pose,
    find_pose_by_guided_matching,
    find_pose_with_all_features,
    is_fast,
    is_jumping,
    is_near_start,
    is_scattered,
    is_weakly_supported,
)
from sylpose.tracking.reports import RelocalizationMatches

# Number of keyframes compared per camera and frame: so many nearest to its last viewpoint, as a tracked frame is matched
# with, and as many others from all sides in rotation (choice).
N_KEYFRAMES = 3
# Successive multiples of it, modulo 1, are spread evenly (derived).
GOLDEN_RATIO = 0.5 * (1.0 + np.sqrt(5.0))
# Features match others elsewhere on the object if the ratio of descriptor distances is below this one, where few do so by
# chance; largest ratio of their number to that of those that match themselves (measured: 0.08 to 1 where sides look alike,
# up to 0.043 of 20 other objects) (choice).
ALIKE_DESCRIPTOR_RATIO, MAX_ALIKE_RATIO = 0.7, 0.06


def search_lost_object(
    context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> SearchResult:
    """Search for an object that was missed in the previous frame.

    A pose is accepted only if solving again from it confirms it, and if no other side of the object looks alike.

    Args:
        frame: without regions.
        predicted_pose: predicted world_from_object.
    """
    # Before its first motion it may be nearby.
    has_prediction = not state.motion.is_lost or not state.motion.velocity.n_frames
    is_costly, candidate = has_prediction and is_jumping(state), None
    if is_costly and context.has_time_for("all features"):
        with context.measure_search("all features", 1.0):
            state, candidate = _search_thoroughly(context, state, frame, predicted_pose)
            if candidate is not None:
                return state, reject_other_side(context, state, candidate, predicted_pose)
    near_pose = predicted_pose if has_prediction and not is_costly else None
    # In the first missed frame it is near; a known object is required from the first frame on.
    is_likely = state.motion.hypothesis is not None or state.motion.n_missed == 1
    options = context.options
    kind, n_pixels = ("likely region", options.likely_search_pixels) if is_likely else ("region", options.search_pixels)
    share = context.share_of_search(kind)
    if not share:
        return state, None
    with context.measure_search(kind, share):
        if state.motion.hypothesis is not None:
            state, candidate = _search_at_hypothesis(context, state, frame, round(share * n_pixels))
        else:
            state, candidate = _search_next_region(context, state, frame, near_pose, round(share * n_pixels))
        return state, reject_other_side(context, state, candidate, predicted_pose)


def _search_next_region(
    context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform | None, max_pixels: int
) -> SearchResult:
    """Search the next region of each camera's image.

    Args:
        predicted_pose: predicted world_from_object, near which every other frame is searched; None: search anywhere.
        max_pixels: number of pixels per camera.
    """
    n, candidate = state.motion.n_missed, None
    is_near, count = predicted_pose is not None and n % 2 == 1, n if predicted_pose is None else n // 2
    if is_near and predicted_pose is not None:
        frame = replace(frame, regions=context.project_regions(state, predicted_pose))
        features = context.detect(frame, faint=state.is_feature_poor, max_pixels=max_pixels)
        current = context.with_features(frame, features)
        state, near = find_pose(context, state, current, predicted_pose)
        if near is not None:
            state, candidate = _confirm_pose(context, state, frame, features, near.pose)
    else:
        features = _detect_in_windows(context, state, frame, count, max_pixels)
    if candidate is not None:
        return state, candidate
    return _confirm_relocalized(context, state, frame, features, count)


def _search_at_hypothesis(context: Context, state: JointState, frame: Frame, max_pixels: int) -> SearchResult:
    """Search where the previous frame indicated the object, in all cameras, with more pixels."""
    assert state.motion.hypothesis is not None
    frame = replace(frame, regions=context.project_regions(state, state.motion.hypothesis))
    features = context.detect(frame, faint=state.is_feature_poor, max_pixels=max_pixels)
    motion = replace(state.motion, next_hypothesis=state.motion.n_missed + RETRY_FRAMES, hypothesis=None)
    return _confirm_relocalized(context, replace(state, motion=motion), frame, features, state.motion.n_missed)


def _confirm_relocalized(
    context: Context, state: JointState, frame: Frame, features: Sequence[Features], count: int
) -> SearchResult:
    """Relocalize the object and confirm the pose, or leave it to the next frame as a hypothesis."""
    pose = relocalize(context, state, context.with_features(frame, features), count)
    if pose is None:
        return state, None
    state, candidate = _confirm_pose(context, state, frame, features, pose)
    if candidate is None and state.motion.n_missed >= state.motion.next_hypothesis:
        state = replace(state, motion=replace(state.motion, hypothesis=pose))
    return state, candidate


def _search_thoroughly(
    context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> SearchResult:
    """Search near the prediction at full resolution, with the usual features and with all."""
    frame = replace(frame, regions=context.project_regions(state, predicted_pose))
    current, candidate = detect_in_regions(context, state, frame, predicted_pose), None
    state, near = find_pose(context, state, current, predicted_pose)
    if near is not None:
        state, candidate = _confirm_pose(context, state, frame, current.features, near.pose)
    if candidate is None:
        state, near = find_pose_with_all_features(context, state, frame, predicted_pose)
        if near is not None:
            state, candidate = _confirm_pose(context, state, frame, near.frame.features, near.pose)
    return state, candidate


def _detect_in_windows(
    context: Context, state: JointState, frame: Frame, count: int, max_pixels: int
) -> list[Features]:
    """Detect features in the next window of each camera's image; per camera, local.

    Args:
        count: number of searches of windows since the object was lost.
        max_pixels: number of pixels per camera.
    """
    sides = [2.0 * radius for radius in context.object_radius_px(state, state.last.world_from_object)]
    search = partial(CameraTracker.search_window, images=frame.images, oldest=count % 2 == 0, max_pixels=max_pixels)
    return context.executor.run(search, context.cameras, [sides[c] for c in context.executor.local])


def _confirm_pose(
    context: Context, state: JointState, frame: Frame, features: Sequence[Features], pose: RigidTransform
) -> SearchResult:
    """Solve the frame again from a relocalized pose, with features inside the object's region only.

    Args:
        features: per camera, local: those detected.
        pose: world_from_object.
    """
    regions = context.project_regions(state, pose)
    inside = [
        own.subset(camera.find_inside(own, region))
        for camera, own, region in zip(context.cameras, features, regions, strict=True)
    ]
    frame = context.with_features(replace(frame, regions=regions, tracked=None, has_new_features=True), inside)
    state, candidate = find_pose(context, state, frame, pose)
    if candidate is None or not is_near_start(state, candidate, pose) or is_weakly_supported(context, state, candidate):
        return state, None
    return state, candidate


# --- relocalization ---------------------------------------------------------------------------------------------------


def relocalize(context: Context, state: JointState, frame: Frame, count: int) -> RigidTransform | None:
    """Relocalize the object from the keyframes' landmarks alone.

    Args:
        frame: with the features of the examined windows.
        count: number of searches since the object was lost; each uses other keyframes.

    Returns:
        world_from_object; None if not found.
    """
    keyframes = [select_keyframes(state.frames.keyframes, c, state.last, count) for c in context.executor.local]
    match = partial(_match_keyframes_of, radius=state.object.radius, options=context.options)
    matches = context.executor.run(match, context.cameras, keyframes, frame.cameras)
    gathered = context.executor.gather(matches, RelocalizationMatches())
    return estimate_relocalized_pose(context.rig, gathered, context.options)


def _match_keyframes_of(
    camera: CameraTracker,
    keyframes: Sequence[SolvedFrame],
    current: CameraFrame,
    radius: float,
    options: TrackingOptions,
) -> RelocalizationMatches:
    """Match a camera's features with its keyframes; record what was detected."""
    found = match_keyframes([camera.frames[k.number] for k in keyframes], current, radius, options)
    if not len(camera.detections.rejected):
        camera.detections = DetectedFeatures(current.features.pixels, found.pixels)
    return found


def match_keyframes(
    keyframes: Sequence[CameraFrame], current: CameraFrame, radius: float, options: TrackingOptions
) -> RelocalizationMatches:
    """Match a camera's features with the landmarks of its keyframes.

    Args:
        current: with the examined features.
        radius: of the object.
        options: limits of matches.
    """
    points, pixels = [np.empty((0, 3))], [np.empty((0, 2))]
    for keyframe in keyframes:
        features, places = _select_located(keyframe, radius)
        # The robust pose solver tolerates half of the matches being wrong.
        max_ratio = options.max_relocalization_descriptor_ratio
        index = match_features(features, current.features, max_ratio)
        points.append(places[index[:, 0]])
        pixels.append(current.features.pixels[index[:, 1]])
    # A feature matched in several keyframes counts once.
    _, first = np.unique(np.round(np.concatenate(pixels), 1), axis=0, return_index=True)
    return RelocalizationMatches(np.concatenate(points)[first], np.concatenate(pixels)[first])


def _select_located(keyframe: CameraFrame, radius: float) -> tuple[Features, FloatArray]:
    """Select the features of a camera's keyframe whose depth is known; return them and their places (n, 3)."""
    is_located = (keyframe.landmarks.depth_sd < SAME_PLACE_RATIO * radius) & ~keyframe.background
    return keyframe.features.subset(is_located), keyframe.landmarks.mean[is_located]


def estimate_relocalized_pose(
    rig: Rig, records: Sequence[RelocalizationMatches], options: TrackingOptions
) -> RigidTransform | None:
    """Estimate world_from_object from all cameras' matches; None with too few inliers."""
    points, pixels = [record.points for record in records], [record.pixels for record in records]
    pose = estimate_pose(rig, points, pixels, max_error_px=options.max_relocalization_error_px)
    usable = (Status.OK, Status.NOT_CONVERGED) if len(rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
    is_supported = pose.n_inliers.sum() >= options.min_relocalization_inliers
    return pose.motion if pose.status in usable and is_supported else None


def select_keyframes(keyframes: Sequence[SolvedFrame], camera: int, last: SolvedFrame, count: int) -> list[SolvedFrame]:
    """Select the keyframes to compare a camera's image with.

    Args:
        keyframes: in order of time.
        last: the last solved frame.
        count: number of searches since the object was lost; each uses other keyframes.
    """
    nearest = find_nearest_views(keyframes, camera, last.viewpoints[camera], N_KEYFRAMES)
    tried = {k.number for k in nearest}
    others = [k for k in keyframes if k.is_visible[camera] and k.number not in tried]
    # Successive searches use keyframes far from each other, so that all sides are covered after a few.
    stride = max(len(others) // N_KEYFRAMES, 1)
    order = np.argsort(np.argsort(np.arange(stride) * GOLDEN_RATIO % 1.0))
    return nearest + others[order[count % stride] :: stride]


# --- frames without a well-supported pose -----------------------------------------------------------------------------


def search_again(
    context: Context,
    state: JointState,
    frame: Frame,
    predicted_pose: RigidTransform,
    candidate: PoseCandidate | None,
) -> SearchResult:
    """Search a frame thoroughly in which no well-supported pose was found.

    Args:
        frame: with features and regions.
        predicted_pose: predicted world_from_object.
        candidate: a weakly supported pose, the result if no other pose is found and it is plausible; or None.
    """
    is_costly, fallback = state.is_feature_poor or is_fast(state, predicted_pose), None
    kind, search = (
        ("all features", find_pose_with_all_features)
        if is_costly
        else ("guided matching", find_pose_by_guided_matching)
    )
    if (is_costly or candidate is None) and context.has_time_for(kind):
        with context.measure_search(kind, 1.0):
            state, fallback = search(context, state, frame, predicted_pose)
            fallback = reject_other_side(context, state, fallback, predicted_pose)
    if fallback is None and _is_plausible(context, state, candidate, predicted_pose):
        return state, candidate
    return state, fallback


def _is_plausible(
    context: Context, state: JointState, candidate: PoseCandidate | None, predicted_pose: RigidTransform
) -> bool:
    """Return whether a weakly supported pose is plausible nevertheless.

    It is near the predicted pose of a slow object, and its features do not scatter as by chance.
    """
    if candidate is None or not has_known_references(state, candidate) or is_scattered(context, state, candidate):
        return False
    return not is_fast(state, predicted_pose) and is_near_start(state, candidate, predicted_pose)


def has_known_references(state: JointState, candidate: PoseCandidate) -> bool:
    """Return whether all frames that a pose rests on are still known.

    A search that starts again from the first frame discards the others, with all landmarks of poses found before.
    """
    known = state.frames.by_number
    return all(number in known for agreement in candidate.agreements for number in agreement.references)


# --- repetitive patterns ----------------------------------------------------------------------------------------------


def reject_other_side(
    context: Context, state: JointState, candidate: PoseCandidate | None, predicted_pose: RigidTransform
) -> PoseCandidate | None:
    """Return a pose, if there is one; None if it is rotated from the predicted one and may be of a side that looks alike.

    Many features of a repetitive pattern match those of other sides. If the visible side is in no keyframe, only a wrong
    one is found. Keyframes of one side only do not show it, nor does a pattern that repeats within one view.
    """
    if candidate is None or np.linalg.norm(relative_rotvec(predicted_pose, candidate.pose)) <= OTHER_SIDE_ROTATION:
        return candidate
    keyframes, viewpoints = state.frames.keyframes, compute_viewpoints(context.rig, candidate.pose)
    visible = [[k for k in keyframes if k.is_visible[c]] for c in context.executor.local]
    compared = [own[:: -(-len(own) // N_KEYFRAMES**2) or 1] for own in visible]
    nearest = [next(iter(find_nearest_views(keyframes, c, viewpoints[c], 1)), None) for c in context.executor.local]
    count = partial(_count_alike, radius=state.object.radius)
    counts = context.executor.gather(context.executor.run(count, context.cameras, nearest, compared), (0, 0))
    n_same, n_elsewhere = np.array(counts).sum(axis=0)
    return None if n_elsewhere >= MIN_MATCHES and n_elsewhere > MAX_ALIKE_RATIO * n_same else candidate


def _count_alike(
    camera: CameraTracker, keyframe: SolvedFrame | None, others: Sequence[SolvedFrame], radius: float
) -> tuple[int, int]:
    """Count a keyframe's features that match others at the same place of the object, and those that match some elsewhere.

    Args:
        keyframe: None if the camera has none.
        others: keyframes to compare it with.
        radius: of the object.
    """
    if keyframe is None:
        return 0, 0
    features, places = _select_located(camera.frames[keyframe.number], radius)
    is_same, is_elsewhere = np.zeros((2, len(features)), bool)
    for other in (k for k in others if k.number != keyframe.number):
        other_features, other_places = _select_located(camera.frames[other.number], radius)
        i, j = match_features(features, other_features, ALIKE_DESCRIPTOR_RATIO).T
        is_far = np.linalg.norm(places[i] - other_places[j], axis=1) > SAME_PLACE_RATIO * radius
        is_same[i[~is_far]] = True
        is_elsewhere[i[is_far]] = True
    return int(is_same.sum()), int(is_elsewhere.sum())
