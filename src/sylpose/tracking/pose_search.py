"""Pose search in one frame near the prediction. Landmarks are not updated here.

Each camera uses only its own images; all arrive at the same pose because it depends on exchanged reports alone.

Guided matching runs only after the usual search has failed, before a frame is left without a pose. It uses the nearest
keyframes, accepts matches that are distinctive only among features near the projection, and finds a position that is far
from the predicted one. For objects that are fast or poor in features, all features of the frame and of the last solved
one are detected before: that takes many times as long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import SAME_POSITION_PX
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import make_motion_about, relative_rotvec, rotation_matrix_of
from sylpose.landmarks.landmark_filter import Landmarks, LandmarkTable
from sylpose.relative_pose.camera_evidence import TREMBLE_SD
from sylpose.relative_pose.motion_mixture import MIN_MOVING_MATCHES
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.rig import Rig
from sylpose.tracking.box_motion import is_box_center_static, is_replaced, select_static_matches, update_from_matches
from sylpose.tracking.camera_side.camera import (
    CameraSolution,
    CameraTracker,
    TrackedFeatures,
    append_new_features,
)
from sylpose.tracking.camera_side.frame import (
    MAJORITY,
    PREDICTED_RADIUS,
    SOLVED_RADIUS,
    CameraPairs,
    FrameMatches,
    Pairs,
    SearchArea,
    add_evidence,
    measure_agreement,
    omit_empty,
)
from sylpose.tracking.context import Context, Frame
from sylpose.tracking.frame_solvers import MAXIMUM_LIKELIHOOD, SOLVERS, PoseProblem, PoseSolution
from sylpose.tracking.joint_side.joint_state import (
    PREPARATION_MARGIN,
    JointState,
    compute_viewpoints,
    find_nearest_views,
    has_enough_tracks,
    is_mostly_moving,
    select_references,
    synchronize_rig,
)
from sylpose.tracking.reports import Agreements, PoseAgreement, RelocalizationMatches, TrackingReport

# An object that rotates by more than this, radians, shows another side: per frame it is fast, and a solved pose that is
# farther from the one that its solution started from is another one (choice: in benchmarks/loops.py more features at 7.6
# degrees per frame were no gain).
OTHER_SIDE_ROTATION = np.radians(10.0)
# Places nearer to each other than this share of the object's radius are the same: of a pose and the one that its solution
# started from or that a refinement changed, and of features, whose depths have to be known to it (choice).
SAME_PLACE_RATIO = 0.3
# Number of solutions of a frame whose cameras have different time stamps, each with the velocity of the previous one
# (derived: the fewest with the velocity of this frame).
VELOCITY_ROUNDS = 2
# Noise at which inliers of a pose count nothing, as a share of the object's radius in the image, and minimum pixels.
# Features near a wrong pose are spread evenly over the search radius: their rms distance is six tenths of it (derived).
ZERO_WEIGHT_NOISE_RATIO, ZERO_WEIGHT_NOISE_PX = 0.4 * SOLVED_RADIUS, 0.58 * SAME_POSITION_PX
# Search radius where the translation is searched for, as a share of the object's radius in the image. A prediction is used
# while its position is known to within the radius (derived: `JointState.coast`).
TRANSLATION_RADIUS = 1.0
# Number of translations compared, each of two matches: if a tenth of the matches are true, the probability that no sample
# has two of them is 0.7 % (derived).
N_TRANSLATIONS = 500
# Excess features of a wrong pose over chance, since it was fitted to them: as many as unknowns, and as many again by
# selection (derived).
SELECTION_BIAS = 2 * 6
# With all features, static ones in the regions agree with each other, and only those once the object has left: this
# share of a pose's inliers must be moving (measured: 0.97 and more of true poses of benchmarks/kinds.py faint-jumps and
# jumps-25, 0.05 to 0.18 of an empty room's in back) (choice).
MIN_MOVED_RATIO = 0.5


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """A candidate pose: a frame's motion since the last solved one and its evidence.

    Attributes:
        frame: not solved yet.
        rig: the cameras with their poses at this frame.
        solution: of the pose solver.
        motion: of the object since the last solved frame.
        pose: world_from_object.
        twist: (6,) of the object, as of `SolvedFrame`.
        agreements: per camera, how its matches agree with the pose.
        has_moved: whether the object has been observed to move, in this frame at the latest.
        cameras: per camera, local: its part.
    """

    frame: Frame
    rig: Rig
    solution: PoseSolution
    motion: RigidTransform
    pose: RigidTransform
    twist: FloatArray
    agreements: Agreements
    has_moved: bool
    cameras: Sequence[CameraSolution]

    def as_static(self, last_pose: RigidTransform) -> PoseCandidate:
        """Return the candidate with its motion set to zero."""
        motion = RigidTransform.identity()
        return replace(
            self,
            solution=replace(self.solution, is_static=True),
            motion=motion,
            pose=motion * last_pose,
            cameras=[replace(own, first_landmarks=None) for own in self.cameras],
        )


# The state, and the pose candidate if any.
SearchResult = tuple[JointState, PoseCandidate | None]


def find_pose(context: Context, state: JointState, frame: Frame, guess: RigidTransform) -> SearchResult:
    """Search for the frame's pose near a guess (world_from_object)."""
    pairs: CameraPairs = _match_references(context, state, frame, guess)
    may_rest, last_pose = state.object.is_bounded and not state.motion.has_moved, state.last.world_from_object
    if may_rest and is_box_center_static(context, state, frame, pairs) and not is_replaced(context, state, frame):
        # Something other than the object moves in the boxes.
        candidate = solve_pose(context, state, frame, select_static_matches(frame, pairs), last_pose)
        return state, None if candidate is None else candidate.as_static(last_pose)
    if state.needs_first_motion:
        state, pose, pairs = update_from_matches(context, state, frame, pairs)
        guess = guess if pose is None else pose
    candidate = solve_pose(context, state, frame, pairs, guess)
    if candidate is None:
        return state, None
    is_static = not candidate.has_moved and not is_mostly_moving(candidate.agreements)
    is_background = is_static and may_rest and is_replaced(context, state, frame)
    if is_background or state.may_be_background(candidate.agreements):
        return replace(state, motion=replace(state.motion, is_background_only=True)), None
    return state, candidate.as_static(last_pose) if is_static else candidate


# --- features and matches ---------------------------------------------------------------------------------------------


def track_from_anchor(
    context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> tuple[Frame, int, bool, bool]:
    """Track the anchor's features in the next images.

    Args:
        predicted_pose: predicted world_from_object.

    Returns:
        the frame with the tracked features only; their total number; whether they suffice without new features;
        whether new ones will be needed soon.
    """
    anchor, last = state.frames.anchor, state.last
    assert anchor is not None
    assert frame.regions is not None
    poses = last.world_from_object, predicted_pose
    track = partial(CameraTracker.track_anchor, images=frame.images, poses=poses, radius=state.object.radius)
    tracked = context.executor.run(track, context.cameras)
    own_reports = [own.create_report(region) for own, region in zip(tracked, frame.regions, strict=True)]
    reports = context.executor.gather(own_reports, TrackingReport())
    frame = context.with_features(
        replace(frame, tracked=tracked, has_new_features=False), [own.features for own in tracked]
    )
    # The first motion is unknown: features that are tracked easily may be static.
    is_usable = state.motion.velocity.n_frames > 0 and not state.object.is_depth_guessed
    # While the next anchor is prepared, less is enough.
    min_margin = 1.0 if state.frames.next_anchor_number is None else 1.0 / PREPARATION_MARGIN
    is_enough, is_enough_for_long = (
        has_enough_tracks(reports, anchor, predicted_pose, margin) for margin in (min_margin, PREPARATION_MARGIN)
    )
    n_tracked = sum(report.n_tracked for report in reports)
    return frame, n_tracked, is_usable and is_enough, not is_enough_for_long


def is_fast(state: JointState, predicted_pose: RigidTransform) -> bool:
    """Return whether the next frame may show another side of the object than the last one.

    True too where the motion is unknown.

    Args:
        predicted_pose: predicted world_from_object.
    """
    angle = np.linalg.norm(relative_rotvec(state.last.world_from_object, predicted_pose))
    return bool(not state.motion.velocity.n_frames or state.motion.n_missed > 0 or angle > OTHER_SIDE_ROTATION)


def is_jumping(state: JointState) -> bool:
    """Return whether the object rotates by more than KLT can track per frame, or whether its motion is unknown."""
    velocity = state.motion.velocity
    is_known = bool(velocity.change_variance.any())
    return not is_known or bool(np.linalg.norm(velocity.twist[:3]) * velocity.interval > OTHER_SIDE_ROTATION)


def detect_in_regions(context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform) -> Frame:
    """Detect features in the object's regions and append them to the tracked ones.

    Low-contrast features are included where the others are barely enough.

    Args:
        predicted_pose: predicted world_from_object.

    Returns:
        the frame with the tracked features first, then new ones.
    """
    # Where features disappear quickly, KLT tracking helps little, and every frame needs enough detected features.
    options = context.options
    n_detected, n_total = (
        (options.max_klt_features, options.n_anchor_features)
        if context.uses_klt and not is_fast(state, predicted_pose)
        else (options.max_features, options.max_features)
    )
    features = context.detect(frame, n_detected, faint=state.is_feature_poor)
    if frame.tracked is not None:
        features = [
            append_new_features(tracked, detected, camera.find_known_background(detected), n_total)
            for camera, tracked, detected in zip(context.cameras, frame.tracked, features, strict=True)
        ]
    return context.with_features(replace(frame, has_new_features=True), features)


def _match_references(context: Context, state: JointState, frame: Frame, guess: RigidTransform) -> CameraPairs:
    """Match a frame's features with the anchor, the last frame and keyframes.

    Tracked features are matched with the anchor; new ones with the last frame and with keyframes of similar viewpoints.

    Args:
        guess: world_from_object.

    Returns:
        per camera, local: matches.
    """
    tracked: Sequence[TrackedFeatures | None] = frame.tracked or [None] * len(context.cameras)
    references = [list[int]() for _ in context.cameras]
    if frame.has_new_features:
        viewpoints, last = compute_viewpoints(context.rig, guess), state.last if frame.tracked is None else None
        for c, own in zip(context.executor.local, references, strict=True):
            own += [] if last is None else [last.number]
            own += [k.number for k in select_references(state.frames.keyframes, c, viewpoints[c], last)]
    motion = None if not state.motion.velocity.n_frames else state.motion_to(guess)
    match = partial(CameraTracker.match_all, motion=motion)
    return context.executor.run(match, context.cameras, frame.cameras, tracked, references)


# --- solution ---------------------------------------------------------------------------------------------------------


def solve_pose(
    context: Context, state: JointState, frame: Frame, pairs: CameraPairs, guess: RigidTransform
) -> PoseCandidate | None:
    """Solve a frame's pose from its matches, starting at a guess.

    Args:
        pairs: per camera, local: the matches.
        guess: world_from_object.

    Returns:
        the pose candidate, or None if the solver fails.
    """
    last, velocity = state.last, state.motion.velocity
    center, elapsed = last.world_from_object.translation, frame.time - last.time
    known_frames, seed, radius = state.frames.by_number, context.seed, state.object.radius
    motion = velocity.predict_motion(elapsed)
    rig, twist, none = context.rig, np.zeros(6), [None] * len(context.cameras)
    first_landmarks: list[Landmarks] | None = None
    for _ in range(VELOCITY_ROUNDS):
        if frame.time_offsets.any():
            twist = velocity.estimate_twist(center, motion, elapsed)
            rig = synchronize_rig(context.rig, frame.time_offsets, twist)
        guessed = guess * last.world_from_object.inv()
        hypothesis = (rotation_matrix_of(guessed), guessed.apply(center) - center)
        problem = PoseProblem(rig, last, known_frames, radius, hypothesis, seed, frame.cameras, pairs)
        solution = SOLVERS[context.method](context.executor, problem)
        if solution is None or (solution.is_static and state.motion.n_missed):
            return None
        if not state.motion.is_lost and not solution.is_static:
            prior_free = solution.rotation, solution.translation, solution.information
            rotation, translation, information = velocity.fuse(*prior_free, center, elapsed)
            solution = replace(solution, rotation=rotation, translation=translation, information=information)
        motion = make_motion_about(center, solution.rotation, solution.translation)
        guess = motion * last.world_from_object
        if not frame.time_offsets.any():
            break
        # Time offsets were corrected with the previous frame's velocity. Now this frame's is known, and after the first
        # motion also the first frame's.
        if last.number == state.frames.first.number and len(state.frames.keyframes) == 1:
            first_rig = synchronize_rig(
                context.rig, last.time_offsets, velocity.estimate_twist(center, motion, elapsed)
            )
            first_landmarks = [
                camera.reinitialize_landmarks(last, first_rig.cameras[camera.index], state.object)
                for camera in context.cameras
            ]
            pairs = _replace_first_landmarks(pairs, last.number, first_landmarks)
    assert solution is not None
    own = (frame.cameras, pairs, solution.match_weights, frame.tracked or none, first_landmarks or none)
    cameras = [CameraSolution(*parts) for parts in zip(*own, strict=True)]
    own_agreements = [measure_agreement(camera.pairs, camera.weights, camera.current) for camera in cameras]
    if frame.time_offsets.any():
        distances = np.linalg.norm([camera.center - guess.translation for camera in rig], axis=1)
        if (velocity.predict_offset_error(frame.time_offsets, radius) > TREMBLE_SD * distances).any():
            twist = np.full(6, np.nan)
    if context.method in MAXIMUM_LIKELIHOOD and not solution.is_static:
        number, offsets = frame.number, frame.time_offsets
        solved = replace(
            last, number=number, time=frame.time, time_offsets=offsets, world_from_object=guess, twist=twist
        )
        own_agreements = [
            add_evidence(agreement, camera.pairs, camera.current, context.rig.cameras[c], c, solved, known_frames)
            for agreement, camera, c in zip(own_agreements, cameras, context.executor.local, strict=True)
        ]
    agreements = context.executor.gather(own_agreements, PoseAgreement())
    has_moved = state.is_motion_verified(agreements)
    return PoseCandidate(frame, rig, solution, motion, guess, twist, agreements, has_moved, cameras)


def _replace_first_landmarks(pairs: CameraPairs, number: int, landmarks: Sequence[Landmarks]) -> CameraPairs:
    """Return the pairs with the first frame's landmarks replaced."""
    tables = [LandmarkTable.from_landmarks(own) for own in landmarks]
    return [
        [
            replace(pair, earlier=replace(pair.earlier, table=table)) if pair.reference == number else pair
            for pair in own
        ]
        for own, table in zip(pairs, tables, strict=True)
    ]


# --- acceptance -------------------------------------------------------------------------------------------------------


def compute_noise_weights(context: Context, state: JointState, candidate: PoseCandidate) -> FloatArray:
    """Return the weight (C,) of each camera's inlier features by noise, from 1 to 0.

    The noise limit is the same for all poses.
    """
    cutoff = [
        max(ZERO_WEIGHT_NOISE_RATIO * radius, ZERO_WEIGHT_NOISE_PX)
        for radius in context.object_radius_px(state, candidate.pose)
    ]
    noise = np.nan_to_num(np.array([a.noise_px for a in candidate.agreements]), nan=np.inf)
    return np.asarray(np.maximum(1.0 - (np.minimum(noise, 1e6) / cutoff) ** 2, 0.0) ** 2)


def is_scattered(context: Context, state: JointState, candidate: PoseCandidate) -> bool:
    """Return whether almost all inlier features of a pose are of cameras in which they scatter as by chance.

    They then have no better residuals than features anywhere within the search radius of a predicted pose.
    """
    noise = np.nan_to_num(np.array([a.noise_px for a in candidate.agreements]), nan=np.inf)
    # The noise at which inliers count nothing, for the larger search radius.
    chance_ratio = ZERO_WEIGHT_NOISE_RATIO / SOLVED_RADIUS * PREDICTED_RADIUS
    is_better = noise < chance_ratio * np.array(context.object_radius_px(state, candidate.pose))
    features = np.array([a.n_inlier_features for a in candidate.agreements])
    return bool(features[is_better].sum() < MIN_MATCHES)


def is_weakly_supported(context: Context, state: JointState, candidate: PoseCandidate) -> bool:
    """Return whether a pose has too little support or too much noise to be certain.

    Cameras that mostly see other things do not count if two others agree; nor cameras with almost no features. While
    the motion is unknown static features do not count: the background agrees with itself.
    """
    is_motion_known = state.motion.velocity.n_frames > 0 or candidate.solution.is_static
    features = np.array([a.n_inlier_features if is_motion_known else a.n_moving for a in candidate.agreements])
    noise_weights = compute_noise_weights(context, state, candidate)
    is_good, is_enough = noise_weights > MAJORITY, features >= MIN_MOVING_MATCHES
    n_agreeing, n_seeing = int((is_enough & is_good).sum()), int(is_enough.sum())
    score = (features * noise_weights)[is_good].sum()
    return bool(score < context.options.min_score or n_agreeing < min(2, n_seeing))


def is_near_start(state: JointState, candidate: PoseCandidate, pose: RigidTransform) -> bool:
    """Return whether a solved pose is close to the pose it started from, e.g. by relocalization."""
    difference = candidate.pose * pose.inv()
    distance = np.linalg.norm(difference.apply(pose.translation) - pose.translation)
    is_far = distance > SAME_PLACE_RATIO * state.object.radius
    return bool(not is_far and difference.rotation.magnitude() <= OTHER_SIDE_ROTATION)


# --- guided matching --------------------------------------------------------------------------------------------------


def find_pose_with_all_features(
    context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> SearchResult:
    """Search for the frame's pose by guided matching of all features. See `find_pose_by_guided_matching`."""
    frame = context.with_features(frame, context.detect(frame, faint=True))
    _add_remaining_features(context, state)
    return _search_by_guided_matching(context, state, frame, predicted_pose)


def find_pose_by_guided_matching(
    context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> SearchResult:
    """Search for the frame's pose from matches anywhere and near projections.

    Args:
        frame: with regions.
        predicted_pose: predicted world_from_object.

    Returns:
        the state; the best candidate, or None.
    """
    # Tracked features would match their own descriptors, whatever the image shows.
    frame = context.with_features(frame, context.detect(frame, faint=False))
    return _search_by_guided_matching(context, state, frame, predicted_pose)


def _search_by_guided_matching(
    context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> SearchResult:
    """Search among the frame's features. See `find_pose_by_guided_matching`."""
    frame = replace(frame, tracked=None, has_new_features=True)
    references = _select_nearby(context, state, predicted_pose)
    matches = context.executor.run(CameraTracker.match, context.cameras, frame.cameras, references)
    pairs: CameraPairs = context.drop_static_matches(state, frame, matches, predicted_pose)
    matched_pose = None
    if state.needs_first_motion:
        state, matched_pose, pairs = update_from_matches(context, state, frame, pairs)
        predicted_pose = predicted_pose if matched_pose is None else matched_pose
    # Where another side comes into view all landmarks are young, and the prediction may be used.
    young = replace(state, frames=replace(state.frames, last=replace(state.last, landmark_age=1.0)))
    solve_near = partial(_solve_near_pose, context, young, frame, predicted_pose)
    candidates, is_predicted = [solve_pose(context, state, frame, pairs, predicted_pose)], matched_pose is not None
    if is_predicted or state.motion.velocity.n_frames:
        is_predicted, near = True, solve_near(predicted_pose, PREDICTED_RADIUS)
        candidates += [near] if near is not None and is_near_start(state, near, predicted_pose) else []
    best = _select_candidate(context, state, candidates, solve_near)
    # Where the cameras contradict each other, features of a body that has come to lie on the object may be landmarks.
    if best is None and is_predicted and not state.last.is_contradicted:
        translated_pose, voters = _find_translated_pose(context, young, frame, predicted_pose)
        candidate = solve_pose(context, young, frame, voters, translated_pose)
        if candidate is not None and is_near_start(state, candidate, translated_pose):
            best = _select_candidate(context, state, [candidate], solve_near)
    return state, best


def _select_candidate(
    context: Context,
    state: JointState,
    candidates: Sequence[PoseCandidate | None],
    solve_near: Callable[[RigidTransform, float], PoseCandidate | None],
) -> PoseCandidate | None:
    """Select the best of those candidates, and of poses from matches near their projections, that are supported.

    Args:
        solve_near: `_solve_near_pose` of the frame.
    """
    found = [candidate for candidate in candidates if candidate is not None]
    found += [refined for one in found if (refined := solve_near(one.pose, SOLVED_RADIUS)) is not None]
    supported = [
        one
        for one in found
        if not state.may_be_background(one.agreements, MIN_MOVED_RATIO) and not is_weakly_supported(context, state, one)
    ]
    best = max(supported, key=partial(_compute_score, context, state), default=None)
    return best if best is not None and _is_significant(context, state, best) else None


def _find_translated_pose(
    context: Context, state: JointState, frame: Frame, predicted_pose: RigidTransform
) -> tuple[RigidTransform, CameraPairs]:
    """Find the translation of a predicted pose by votes of matches around its projections.

    A prediction's rotation is usually better than its position, as seen from the size of the object. Matches of the whole
    radius are distinctive among more features than those near a projection: fewer of them are wrong.

    Returns:
        the translated pose; per camera, local: the matches that voted for it.
    """
    pairs = _match_near_pose(context, state, frame, predicted_pose, predicted_pose, TRANSLATION_RADIUS)
    matches = [_collect_places(own) for own in pairs]
    gathered = context.executor.gather(matches, RelocalizationMatches())
    translation = find_translation(context.rig, gathered, predicted_pose, state.object.radius, context.seed)
    pose = RigidTransform.from_translation(translation) * predicted_pose
    areas = _make_search_areas(context, state, pose, PREDICTED_RADIUS)
    return pose, context.executor.run(_select_in_area, context.cameras, pairs, areas)


def _collect_places(pairs: Pairs) -> RelocalizationMatches:
    """Collect a camera's matches; of a feature that matches other landmarks in several keyframes, one may be right."""
    return RelocalizationMatches(
        np.concatenate([np.empty((0, 3)), *(pair.landmarks.mean for pair in pairs)]),
        np.concatenate([np.empty((0, 2)), *(pair.pixels_j for pair in pairs)]),
    )


def _select_in_area(camera: CameraTracker, pairs: Pairs, area: SearchArea) -> list[FrameMatches]:
    """Select a camera's matches near their landmarks' projections."""
    projected = [camera.camera.project(area.pose.apply(pair.landmarks.mean)) for pair in pairs]
    return omit_empty(
        pair.subset(np.linalg.norm(pair.pixels_j - pixels, axis=1) < area.radius_px)
        for pair, pixels in zip(pairs, projected, strict=True)
    )


def find_translation(
    rig: Rig, matches: Sequence[RelocalizationMatches], pose: RigidTransform, radius: float, seed: int
) -> FloatArray:
    """Find the translation (3,) of a pose that most matches agree with.

    Each match restricts it to a line: that of the landmark, moved to its pixel's ray. Two of them at a time are sampled.

    Args:
        matches: per camera.
        pose: world_from_object; its rotation is kept.
        radius: of the object: matches agree within `PREDICTED_RADIUS` of it, translations are less than it.
        seed: of the sampling.
    """
    lines = [
        (
            np.column_stack([camera.normalize(own.pixels), np.ones(len(own.pixels))]) @ camera.rotation,
            camera.center - pose.apply(own.points),
        )
        for camera, own in zip(rig, matches, strict=True)
        if len(own.points)
    ]
    if not lines:
        return np.zeros(3)
    rays, origins = (np.concatenate(parts) for parts in zip(*lines, strict=True))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    nearest = np.einsum("nij,nj->ni", across, origins)
    i, j = np.random.default_rng(seed).integers(len(rays), size=(2, N_TRANSLATIONS))
    # Two lines of one camera are nearly parallel: translations are at most a radius, and true lines hardly off.
    weak_prior = SOLVED_RADIUS**2 * np.eye(3)
    sampled = np.linalg.solve(across[i] + across[j] + weak_prior, (nearest[i] + nearest[j])[..., None])[..., 0]
    sampled = np.concatenate([np.zeros((1, 3)), sampled[np.linalg.norm(sampled, axis=1) < radius]])
    outer = np.einsum("mi,mj->mij", sampled, sampled).reshape(-1, 9)
    squared = outer @ across.reshape(-1, 9).T - 2.0 * sampled @ nearest.T + (nearest**2).sum(axis=1)
    votes = np.fmax(1.0 - squared / (PREDICTED_RADIUS * radius) ** 2, 0.0).sum(axis=1)
    return np.asarray(sampled[np.argmax(votes)])


def _is_significant(context: Context, state: JointState, candidate: PoseCandidate) -> bool:
    """Return whether significantly more features agree with a pose than by chance."""
    references = _select_nearby(context, state, candidate.pose)
    areas = _make_search_areas(context, state, candidate.pose, SOLVED_RADIUS)
    count = CameraTracker.count_supporting_features
    counts = context.executor.run(count, context.cameras, candidate.frame.cameras, references, areas)
    n_near, n_by_chance = np.array(context.executor.gather(counts, (0, 0.0))).sum(axis=0)
    return bool(n_near > SELECTION_BIAS + n_by_chance + 3.0 * np.sqrt(n_by_chance))


def _add_remaining_features(context: Context, state: JointState) -> None:
    """Add all remaining features in the last solved frame's image to that frame."""
    regions = context.project_regions(state, state.last.world_from_object)
    add = partial(CameraTracker.add_remaining_features, last=state.last, model=state.object)
    context.executor.run(add, context.cameras, regions)


def _select_nearby(context: Context, state: JointState, guess: RigidTransform) -> list[list[int]]:
    """Return per camera, local: the numbers of the last solved frame and of nearby keyframes."""
    viewpoints, last, keyframes = compute_viewpoints(context.rig, guess), state.last.number, state.frames.keyframes
    near = [
        find_nearest_views(keyframes, c, viewpoints[c], context.options.max_reference_keyframes)
        for c in context.executor.local
    ]
    return [[last, *(k.number for k in own if k.number != last)] for own in near]


def _make_search_areas(
    context: Context, state: JointState, pose: RigidTransform, radius_ratio: float
) -> list[SearchArea]:
    """Return per camera, local: the search area, by its share of the object's radius in the image.

    It contains all keypoints that count as the same position.
    """
    radii = context.object_radius_px(state, pose)
    return [SearchArea(pose, max(radius_ratio * radii[c], SAME_POSITION_PX)) for c in context.executor.local]


def _solve_near_pose(
    context: Context,
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
    pairs = _match_near_pose(context, state, frame, predicted_pose, pose, radius_ratio)
    return solve_pose(context, state, frame, pairs, pose)


def _match_near_pose(
    context: Context,
    state: JointState,
    frame: Frame,
    predicted_pose: RigidTransform,
    pose: RigidTransform,
    radius_ratio: float,
) -> CameraPairs:
    """Match landmarks near their projections at a pose. Arguments as of `_solve_near_pose`."""
    references, areas = _select_nearby(context, state, pose), _make_search_areas(context, state, pose, radius_ratio)
    pairs = context.executor.run(CameraTracker.match_near, context.cameras, frame.cameras, references, areas)
    return context.drop_static_matches(state, frame, pairs, predicted_pose)


def _compute_score(context: Context, state: JointState, candidate: PoseCandidate) -> float:
    """Return the number of inlier features of a pose, weighted by their noise."""
    weights = compute_noise_weights(context, state, candidate)
    return float(weights @ np.array([a.n_inlier_features for a in candidate.agreements]))
