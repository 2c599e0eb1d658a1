"""Fallback pose search with all available features and keyframes.

It detects all features in a frame and in the last solved one, uses all nearby keyframes, and accepts matches that are
distinctive only among features near the projection. It takes many times as long as the usual search (`pose_search`) and
runs only after that has failed, before a frame is left without a pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.camera_side.frame import FrameMatches
from sylpose.tracking.context import Frame, TrackerContext, drop_static_matches, object_radius_px, project_regions
from sylpose.tracking.first_motion import update_from_matches
from sylpose.tracking.joint_side.joint_state import JointState, compute_viewpoints, find_nearest_views
from sylpose.tracking.pose_search import (
    MIN_RADIUS_PX,
    SOLVED_RADIUS,
    PoseCandidate,
    compute_noise_weights,
    is_near_start,
    is_weakly_supported,
    solve_pose,
)

# Maximum number of keyframes per camera, in addition to the last solved frame, and their maximum angle around the
# object, radians (choice).
MAX_REFERENCE_KEYFRAMES, MAX_VIEW_ANGLE = 4, np.radians(50.0)
# Search radius around a landmark's projection at a predicted pose, as a share of the object's radius in the image
# (choice).
PREDICTED_RADII = (0.15, 0.07)
# Maximum number of reference frames for comparing a pose's support with chance (choice).
MAX_EVIDENCE_REFERENCES = 2
# Excess features of a wrong pose over chance, since it was fitted to them: two for each of its six unknowns (choice).
SELECTION_BIAS = 12.0
# With all features, static ones in the regions agree with each other, and only those once the object has left: this
# share of a pose's inliers must be moving (measured: 0.97 and more of true poses of benchmarks/kinds.py faint-jumps and
# jumps-25, 0.05 to 0.18 of an empty room's in back) (choice).
MIN_MOVED_RATIO = 0.5


def search_with_all_features(
    context: TrackerContext, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> tuple[JointState, PoseCandidate | None]:
    """Search for the frame's pose with all features, from matches and from the prediction.

    Args:
        frame: with all features in the regions.
        predicted_pose: predicted world_from_object.

    Returns:
        the state; the best candidate, or None.
    """
    _add_remaining_features(context, state)
    references = _select_references(context, state, predicted_pose)
    matches = context.executor.run(CameraTracker.match, context.cameras, frame.cameras, references)
    pairs: Sequence[Sequence[FrameMatches]] = drop_static_matches(context, state, frame, matches, predicted_pose)
    matched_pose = None
    if state.needs_first_motion:
        state, matched_pose, pairs = update_from_matches(context, state, frame, pairs)
        predicted_pose = predicted_pose if matched_pose is None else matched_pose
    # Where another side comes into view all landmarks are young, and the prediction may be used.
    young = replace(state, frames=replace(state.frames, last=replace(state.last, landmark_age=1.0)))
    solve_near = partial(_solve_near_pose, context, young, frame, predicted_pose)
    candidates = [solve_pose(context, state, frame, pairs, predicted_pose)]
    if state.motion.velocity.n_frames or matched_pose is not None:
        near = [solve_near(predicted_pose, share) for share in PREDICTED_RADII]
        candidates += [c for c in near if c is not None and is_near_start(state, c, predicted_pose)]
    found = [candidate for candidate in candidates if candidate is not None]
    # Solve again from all matches near a solution's projections.
    found += [refined for one in found if (refined := solve_near(one.pose, SOLVED_RADIUS)) is not None]
    supported = [
        one
        for one in found
        if not state.may_be_background(one.agreements, MIN_MOVED_RATIO) and not is_weakly_supported(context, state, one)
    ]
    best = max(supported, key=partial(_compute_score, context, state), default=None)
    return state, best if best is not None and _is_significant(context, state, best) else None


def _is_significant(context: TrackerContext, state: JointState, candidate: PoseCandidate) -> bool:
    """Return whether significantly more features agree with a pose than by chance."""
    references = [own[:MAX_EVIDENCE_REFERENCES] for own in _select_references(context, state, candidate.pose)]
    counts = context.executor.run(
        partial(CameraTracker.count_supporting_features, pose=candidate.pose),
        context.cameras,
        candidate.frame.cameras,
        references,
        _search_radii(context, state, candidate.pose, SOLVED_RADIUS),
    )
    n_near, n_by_chance = np.array(context.executor.gather(counts, (0, 0.0))).sum(axis=0)
    return bool(n_near > SELECTION_BIAS + n_by_chance + 3.0 * np.sqrt(n_by_chance))


def _add_remaining_features(context: TrackerContext, state: JointState) -> None:
    """Add all remaining features in the last solved frame's image to that frame."""
    regions = project_regions(context, state, state.last.world_from_object)
    add = partial(CameraTracker.add_remaining_features, last=state.last, model=state.object)
    context.executor.run(add, context.cameras, regions)


def _select_references(context: TrackerContext, state: JointState, guess: RigidTransform) -> list[list[int]]:
    """Return per camera, local: the numbers of the last solved frame and of nearby keyframes."""
    viewpoints, last, keyframes = compute_viewpoints(context.rig, guess), state.last.number, state.frames.keyframes
    near = [
        find_nearest_views(keyframes, c, viewpoints[c], MAX_REFERENCE_KEYFRAMES, MAX_VIEW_ANGLE)
        for c in context.executor.local
    ]
    return [[last, *(k.number for k in own if k.number != last)] for own in near]


def _search_radii(context: TrackerContext, state: JointState, pose: RigidTransform, radius_ratio: float) -> list[float]:
    """Return per camera, local: the search radius, pixels, by its share of the object's radius in the image."""
    radii = object_radius_px(context, state, pose)
    return [max(radius_ratio * radii[c], MIN_RADIUS_PX) for c in context.executor.local]


def _solve_near_pose(
    context: TrackerContext,
    state: JointState,
    frame: Frame,
    predicted_pose: RigidTransform,
    pose: RigidTransform,
    radius_ratio: float,
) -> PoseCandidate | None:
    """Solve the frame from matches near the projections at a pose.

    Args:
        predicted_pose: predicted world_from_object, used to drop background.
        pose: world_from_object at which landmarks are projected.
        radius_ratio: search radius as a share of the object's radius in the image.
    """
    pairs = context.executor.run(
        CameraTracker.match_near,
        context.cameras,
        frame.cameras,
        _select_references(context, state, pose),
        [pose] * len(context.cameras),
        _search_radii(context, state, pose, radius_ratio),
    )
    return solve_pose(context, state, frame, drop_static_matches(context, state, frame, pairs, predicted_pose), pose)


def _compute_score(context: TrackerContext, state: JointState, candidate: PoseCandidate) -> float:
    """Return the number of inlier features of a pose, weighted by their noise."""
    weights = compute_noise_weights(context, state, candidate)
    return float(weights @ np.array([a.n_inlier_features for a in candidate.agreements]))
