"""Fallback pose search with all available features and keyframes.

It detects all features in a frame and in the last solved one, uses all nearby keyframes, and accepts matches that are
distinctive only among features near the projection. It takes many times as long as the usual search (`pose_search`) and
runs only after that has failed, before a frame is left without a pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.results import Status
from sylpose.tracking.context import Region, TrackerContext, project_regions
from sylpose.tracking.frame import Frame, FrameMatches
from sylpose.tracking.joint_state import JointState
from sylpose.tracking.keyframes import compute_viewpoints, find_nearest_views
from sylpose.tracking.map_update import update_from_matches
from sylpose.tracking.pose_search import PoseCandidate, drop_static_matches, is_near_start, solve_pose

__all__ = ["is_weakly_supported", "search_with_all_features"]

# Maximum number of keyframes per camera, in addition to the last solved frame, and their maximum angle around the
# object, radians (choice).
MAX_REFERENCE_KEYFRAMES, MAX_VIEW_ANGLE = 4, np.radians(50.0)
# Search radius around a landmark's projection, as a share of the object's radius in the image: at a predicted pose, and
# at a solved one; minimum, pixels (choice).
PREDICTED_RADII, SOLVED_RADIUS, MIN_RADIUS_PX = (0.15, 0.07), 0.03, 3.0
# Maximum number of reference frames for comparing a pose's support with chance (choice).
MAX_EVIDENCE_REFERENCES = 2
# Excess features of a wrong pose over chance, since it was fitted to them: two for each of its six unknowns (choice).
SELECTION_BIAS = 12.0
# Noise at which inliers of a pose count nothing, as a share of the object's radius in the image, and minimum pixels.
# Features near a wrong pose are spread evenly over the search radius: their rms distance is six tenths of it (derived).
MAX_NOISE_RATIO, MAX_NOISE_PX = 0.4 * SOLVED_RADIUS, 0.58 * MIN_RADIUS_PX
# With a lower score another pose may be equally good: a different body of the same outline scores about twenty
# (measured: tests/tracking/test_relocalization.py). Minimum weight of a camera's features, and minimum number of
# features for a camera to count (choice).
MIN_SCORE, MIN_GOOD_WEIGHT, MIN_CAMERA_FEATURES = 20.0, 0.5, 15
# With all features, static ones in the regions agree with each other, and only those once the object has left: this
# share of a pose's inliers must be moving (measured: 0.97 and more of true poses of benchmarks/kinds.py faint-jumps and
# jumps-25, 0.05 to 0.18 of an empty room's in back) (choice).
MIN_MOVED_RATIO = 0.5


def search_with_all_features(
    context: TrackerContext, state: JointState, frame: Frame, predicted_pose: RigidTransform, regions: Sequence[Region]
) -> tuple[JointState, PoseCandidate | None]:
    """Search for the frame's pose with all features, from matches and from the prediction.

    Args:
        frame: with all features in the regions.
        predicted_pose: predicted world_from_object.

    Returns:
        the state; the best candidate, or None.
    """
    add_remaining_features(context, state)
    references = select_references(context, state, predicted_pose)
    matches = context.executor.map_cameras(
        lambda c: context.camera_trackers[c].match(frame.cameras[c], references[c]), is_slow=True
    )
    matches = drop_static_matches(context, state, frame, matches, predicted_pose)
    state, matched_pose, predicted_pose, pairs = update_from_matches(context, state, frame, matches, predicted_pose)
    candidates = [solve_pose(context, state, frame, pairs, predicted_pose, regions)]
    if state.velocity.n_frames or matched_pose is not None:
        # Where another side comes into view all landmarks are young, and the prediction may be used.
        young_state = replace(state, last=replace(state.last_frame, landmark_age=1.0))
        for share in PREDICTED_RADII:
            candidate = solve_near_pose(context, young_state, frame, predicted_pose, predicted_pose, regions, share)
            candidates.append(
                candidate if candidate is not None and is_near_start(state, candidate, predicted_pose) else None
            )
    candidates += [
        refine_candidate(context, state, frame, candidate, predicted_pose, regions) for candidate in candidates
    ]
    foreground = [
        candidate
        for candidate in candidates
        if candidate is not None and not state.may_be_background(candidate.agreements, MIN_MOVED_RATIO)
    ]
    supported = [candidate for candidate in foreground if not is_weakly_supported(context, state, candidate)]
    best = max(supported, key=lambda found: compute_score(context, state, found), default=None)
    return state, best if best is not None and is_significant(context, state, best) else None


def is_significant(context: TrackerContext, state: JointState, candidate: PoseCandidate) -> bool:
    """Return whether significantly more features agree with a pose than by chance."""
    pose, frame = candidate.motion * state.last_frame.world_from_object, candidate.frame
    references = select_references(context, state, pose)
    counts = context.executor.map_cameras(
        lambda c: context.camera_trackers[c].count_supporting_features(
            frame.cameras[c],
            references[c][:MAX_EVIDENCE_REFERENCES],
            pose,
            max(SOLVED_RADIUS * context.object_radius_px(state, c, pose), MIN_RADIUS_PX),
        ),
        is_slow=True,
    )
    n_near, n_by_chance = np.array(context.executor.all_gather(lambda c: counts[c], (0, 0.0))).sum(axis=0)
    return bool(n_near > SELECTION_BIAS + n_by_chance + 3.0 * np.sqrt(n_by_chance))


def add_remaining_features(context: TrackerContext, state: JointState) -> None:
    """Add all remaining features in the last solved frame's image to that frame."""
    base, model = state.last_frame, state.object
    regions = project_regions(context, state, base.world_from_object)
    context.executor.map_cameras(
        lambda c: context.camera_trackers[c].add_remaining_features(
            base.number, base.world_from_object, regions[c], model.points, model.radius
        ),
        is_slow=True,
    )


def select_references(context: TrackerContext, state: JointState, guess: RigidTransform) -> list[list[int]]:
    """Return per camera the numbers of the last solved frame and of nearby keyframes."""
    viewpoints_now, base = compute_viewpoints(context.rig, guess), state.last_frame
    return [
        [base.number]
        + [
            k.number
            for k in find_nearest_views(state.keyframes, c, viewpoints_now[c], MAX_REFERENCE_KEYFRAMES, MAX_VIEW_ANGLE)
            if k.number != base.number
        ]
        for c in range(len(context.rig))
    ]


def solve_near_pose(
    context: TrackerContext,
    state: JointState,
    frame: Frame,
    pose: RigidTransform,
    predicted_pose: RigidTransform,
    regions: Sequence[Region],
    radius_ratio: float,
) -> PoseCandidate | None:
    """Solve the frame from matches near the projections at a pose.

    Args:
        pose: world_from_object at which landmarks are projected.
        predicted_pose: predicted world_from_object, used to drop background.
        radius_ratio: search radius as a share of the object's radius in the image.
    """
    references = select_references(context, state, pose)

    def match_camera(c: int) -> list[FrameMatches]:
        reach = max(radius_ratio * context.object_radius_px(state, c, pose), MIN_RADIUS_PX)
        return context.camera_trackers[c].match_near(frame.cameras[c], references[c], pose, reach)

    pairs = drop_static_matches(
        context, state, frame, context.executor.map_cameras(match_camera, is_slow=True), predicted_pose
    )
    return solve_pose(context, state, frame, pairs, pose, regions)


def refine_candidate(
    context: TrackerContext,
    state: JointState,
    frame: Frame,
    candidate: PoseCandidate | None,
    predicted_pose: RigidTransform,
    regions: Sequence[Region],
) -> PoseCandidate | None:
    """Solve again from all matches near a solution's projections."""
    if candidate is None:
        return None
    pose = candidate.motion * state.last_frame.world_from_object
    state = replace(state, last=replace(state.last_frame, landmark_age=1.0))
    return solve_near_pose(context, state, frame, pose, predicted_pose, regions, SOLVED_RADIUS)


def compute_noise_weights(context: TrackerContext, state: JointState, candidate: PoseCandidate) -> FloatArray:
    """Return the weight (C,) of each camera's inlier features by noise, from 1 to 0.

    The noise limit is the same for all poses.
    """
    pose = candidate.motion * state.last_frame.world_from_object
    cutoff = [
        max(MAX_NOISE_RATIO * context.object_radius_px(state, c, pose), MAX_NOISE_PX) for c in range(len(context.rig))
    ]
    noise = np.nan_to_num(np.array([a.noise_px for a in candidate.agreements]), nan=np.inf)
    return np.asarray(np.maximum(1.0 - (np.minimum(noise, 1e6) / cutoff) ** 2, 0.0) ** 2)


def compute_score(context: TrackerContext, state: JointState, candidate: PoseCandidate) -> float:
    """Return the number of inlier features of a pose, weighted by their noise."""
    return float(
        compute_noise_weights(context, state, candidate) @ np.array([a.n_inlier_features for a in candidate.agreements])
    )


def is_weakly_supported(context: TrackerContext, state: JointState, candidate: PoseCandidate) -> bool:
    """Return whether a pose has too little support or too much noise to be certain.

    Cameras that mostly see other things do not count if two others agree; nor cameras with almost no features. While
    the motion is unknown static features do not count: the background agrees with itself.
    """
    is_motion_known = state.velocity.n_frames > 0 or candidate.solution.status is Status.NO_MOTION
    features = np.array([a.n_inlier_features if is_motion_known else a.n_moving for a in candidate.agreements])
    noise_weights = compute_noise_weights(context, state, candidate)
    is_good = noise_weights > MIN_GOOD_WEIGHT
    n_agreeing, n_seeing = (
        int(((features >= MIN_CAMERA_FEATURES) & is_good).sum()),
        int((features >= MIN_CAMERA_FEATURES).sum()),
    )
    return bool((features * noise_weights)[is_good].sum() < MIN_SCORE or n_agreeing < min(2, n_seeing))
