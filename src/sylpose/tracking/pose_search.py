"""Pose search in one frame: near the prediction or anywhere. Landmarks are not updated here.

Each camera uses only its own images; all arrive at the same pose because it depends on exchanged reports alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import MAX_FEATURES, Features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.matrices import invert_information
from sylpose.geometry.rigid import relative_rotvec, rotation_matrix_of
from sylpose.geometry.robust_loss import SIGMA_OF_MEDIAN
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.relative_pose.motion import make_motion_about
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.tracking.camera_executor import CameraExecutor
from sylpose.tracking.context import Region, TrackerContext
from sylpose.tracking.frame import (
    CameraFrame,
    DetectedFeatures,
    Frame,
    FrameMatches,
    collect_detected_features,
    drop_background,
    find_static,
    select_inliers,
)
from sylpose.tracking.frame_solvers import MatchWeights, PoseProblem, PoseSolution
from sylpose.tracking.joint_state import JointState
from sylpose.tracking.keyframes import compute_viewpoints, select_references
from sylpose.tracking.klt_frontend import N_ANCHOR_FEATURES as ANCHOR_FEATURES
from sylpose.tracking.klt_frontend import PREPARATION_MARGIN, TrackedFeatures, append_new_features, has_enough_tracks
from sylpose.tracking.relocalization import (
    DESCRIPTOR_RATIO,
    LOOSE_DESCRIPTOR_RATIO,
    estimate_relocalized_pose,
    match_keyframes,
    select_keyframes,
)
from sylpose.tracking.reobserved import find_moved
from sylpose.tracking.reports import LandmarkAges, PoseAgreement, RelocalizationMatches, TrackingReport

__all__ = [
    "MAX_WAIT_FRAMES",
    "PoseCandidate",
    "detect_in_regions",
    "drop_static_matches",
    "estimate_noise",
    "is_fast",
    "is_near_start",
    "is_partly_visible",
    "match_references",
    "relocalize",
    "solve_pose",
    "track_from_anchor",
]

# Maximum number of features detected per camera while features are tracked by KLT (choice).
MAX_KLT_FEATURES = 400
# An object that rotates by more than this per frame, radians, shows another side each time (measured:
# benchmarks/loops.py, where more features at 7.6 degrees per frame were no gain) (choice).
FAST_ROTATION = np.radians(10.0)
# A missing object is not accepted again while its rotation is less certain than this, radians, for at most so many
# frames (choice).
MAX_RELOCALIZED_SD, MAX_WAIT_FRAMES = 0.005, 2
# The pose solved after relocalization must agree with the relocalized one within this rotation and share of the radius
# (choice).
MAX_START_ROTATION, MAX_START_TRANSLATION = 0.17, 0.3
# The velocity is known after so many consecutive frames (choice).
MIN_VELOCITY_FRAMES = 1
# Matches whose rms residual exceeds this share of the object's radius in the image, and so many pixels, agree with any
# pose (choice).
MAX_NOISE_RATIO, MAX_NOISE_PX = 0.03, 3.0
# Number of solutions of a frame whose cameras have different time stamps, each with the velocity of the previous one
# (choice).
VELOCITY_ROUNDS = 2


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """A candidate pose: a frame's motion since the last solved one and its evidence.

    Attributes:
        frame: not solved yet.
        rig: the cameras with their poses at this frame.
        pairs: per camera, local: the matches.
        solution: of the pose solver.
        motion: of the object since the last solved frame.
        agreements: per camera, how its matches agree with the pose.
        regions: search regions.
        tracked: per camera, local: its tracked features, which come first; None without KLT.
        has_new_features: whether it has newly detected features, to be matched by descriptors.
        first_landmarks: per camera, local: landmarks of the first frame, where this frame improves them.
    """

    frame: Frame
    rig: Rig
    pairs: Sequence[Sequence[FrameMatches]]
    solution: PoseSolution
    motion: RigidTransform
    agreements: Sequence[PoseAgreement]
    regions: Sequence[Region]
    tracked: Sequence[TrackedFeatures] | None
    has_new_features: bool
    first_landmarks: Sequence[Landmarks] | None = None

    def as_static(self) -> PoseCandidate:
        """Return the candidate with its motion set to zero."""
        solution = replace(self.solution, status=Status.NO_MOTION)
        return replace(self, solution=solution, motion=RigidTransform.identity(), first_landmarks=None)

    @property
    def n_matches(self) -> int:
        """Number of inlier matches."""
        return sum(a.n_inlier_matches for a in self.agreements)


def track_from_anchor(
    context: TrackerContext,
    state: JointState,
    frames: FrameSet,
    predicted_pose: RigidTransform,
    regions: Sequence[Region],
) -> tuple[list[TrackedFeatures], int, bool, bool]:
    """Track the anchor's features in the next images.

    Args:
        predicted_pose: predicted world_from_object.

    Returns:
        per camera, local: the tracked features; their total number; whether they suffice without new features; whether
        new ones will be needed soon.
    """
    assert state.anchor is not None
    last, radius = state.last_frame.world_from_object, state.object.radius
    tracked = context.executor.map_cameras(
        lambda c: context.camera_trackers[c].track_anchor(
            last, predicted_pose, frames.images[c], frames.masks[c], radius
        ),
        is_slow=True,
    )
    reports = context.executor.all_gather(lambda c: tracked[c].create_report(regions[c]), TrackingReport.empty())
    # While the next anchor is prepared, less is enough.
    min_margin = 1.0 if state.next_anchor_number is None else 1.0 / PREPARATION_MARGIN
    is_enough, is_enough_for_long = (
        has_enough_tracks(reports, state.anchor, predicted_pose, margin) for margin in (min_margin, PREPARATION_MARGIN)
    )
    return tracked, sum(report.n_tracked for report in reports), is_enough, not is_enough_for_long


def is_fast(state: JointState, predicted_pose: RigidTransform) -> bool:
    """Return whether the next frame may show another side of the object than the last one.

    True too where the motion is unknown.

    Args:
        predicted_pose: predicted world_from_object.
    """
    angle = np.linalg.norm(relative_rotvec(state.last_frame.world_from_object, predicted_pose))
    return bool(not state.velocity.n_frames or state.n_missed > 0 or angle > FAST_ROTATION)


def detect_in_regions(
    context: TrackerContext,
    state: JointState,
    frames: FrameSet,
    predicted_pose: RigidTransform,
    regions: Sequence[Region],
    tracked: Sequence[TrackedFeatures] | None,
) -> list[Features]:
    """Detect features in the object's regions and append them to the tracked ones.

    Low-contrast features are included where the others are barely enough.

    Args:
        predicted_pose: predicted world_from_object.
        tracked: per camera, local: tracked features; None without KLT.

    Returns:
        per camera, local: tracked features first, then new ones.
    """
    # Where features disappear quickly, KLT tracking helps little, and every frame needs enough detected features.
    max_features = (
        (MAX_KLT_FEATURES, ANCHOR_FEATURES)
        if context.uses_klt and not is_fast(state, predicted_pose)
        else (MAX_FEATURES, MAX_FEATURES)
    )
    detected = context.detect(frames, regions, max_features[0], faint=state.is_feature_poor)
    if tracked is None:
        return detected
    return context.executor.map_cameras(
        lambda c: append_new_features(
            tracked[c], detected[c], context.camera_trackers[c].find_known_background(detected[c]), max_features[1]
        )
    )


def match_references(
    context: TrackerContext,
    state: JointState,
    frame: Frame,
    guess: RigidTransform,
    tracked: Sequence[TrackedFeatures] | None = None,
    *,
    has_new_features: bool = True,
) -> list[list[FrameMatches]]:
    """Match a frame's features with the anchor, the last frame and keyframes.

    Tracked features are matched with the anchor; new ones with the last frame and with keyframes of similar viewpoints.

    Args:
        guess: world_from_object.
        has_new_features: whether there are new features.

    Returns:
        per camera, local: matches.
    """
    viewpoints_now, last = compute_viewpoints(context.rig, guess), state.last_frame if tracked is None else None

    def match_camera(c: int) -> list[FrameMatches]:
        pairs = [tracked[c].match_with_anchor()] if tracked is not None and len(tracked[c]) else []
        if has_new_features:
            references = [
                *([] if last is None else [last]),
                *select_references(state.keyframes, c, viewpoints_now[c], last),
            ]
            pairs += context.camera_trackers[c].match(frame.cameras[c], [reference.number for reference in references])
        context.camera_trackers[c].detections = collect_detected_features(frame.cameras[c].features, pairs)
        return pairs

    pairs = context.executor.map_cameras(match_camera, is_slow=has_new_features)
    return (
        drop_static_matches(context, state, frame, pairs, guess)
        if state.velocity.n_frames >= MIN_VELOCITY_FRAMES
        else pairs
    )


def drop_static_matches(
    context: TrackerContext,
    state: JointState,
    frame: Frame,
    pairs: Sequence[Sequence[FrameMatches]],
    predicted_pose: RigidTransform,
) -> list[list[FrameMatches]]:
    """Remove matches that are background according to the predicted motion; per camera, local.

    Args:
        predicted_pose: predicted world_from_object.
    """
    poses, radius = (
        {number: solved.world_from_object for number, solved in state.known_frames.items()},
        state.object.radius,
    )

    def drop_in_camera(c: int) -> list[FrameMatches]:
        frame_and_camera = frame.cameras[c], context.rig.cameras[c]
        kept = [
            drop_background(pair, *frame_and_camera, poses[pair.reference], predicted_pose, radius) for pair in pairs[c]
        ]
        return [pair for pair in kept if len(pair)]

    return context.executor.map_cameras(drop_in_camera)


def solve_pose(
    context: TrackerContext,
    state: JointState,
    frame: Frame,
    pairs: Sequence[Sequence[FrameMatches]],
    guess: RigidTransform,
    regions: Sequence[Region],
    tracked: Sequence[TrackedFeatures] | None = None,
    *,
    has_new_features: bool = True,
) -> PoseCandidate | None:
    """Solve a frame's pose from its matches, starting at a guess.

    Args:
        pairs: per camera, local: the matches.
        guess: world_from_object.

    Returns:
        the pose candidate, or None if the solver fails.
    """
    last_frame, velocity, executor = state.last_frame, state.velocity, context.executor
    center, elapsed = last_frame.world_from_object.translation, frame.time - last_frame.time
    motion_over_interval, first_landmarks = velocity.predict_motion(elapsed), None
    for _ in range(VELOCITY_ROUNDS):
        rig = velocity.synchronize_rig(context.rig, frame.time_offsets, center, motion_over_interval, elapsed)
        motion = guess * last_frame.world_from_object.inv()
        hypothesis = (rotation_matrix_of(motion), motion.apply(center) - center)
        radius = state.object.radius
        problem = PoseProblem(
            rig, last_frame, state.known_frames, radius, hypothesis, context.seed, frame.cameras, pairs
        )
        solution = context.solver(executor, problem)
        if not solution.status.has_pose or (solution.status is Status.NO_MOTION and state.n_missed):
            return None
        if not state.is_lost and solution.status is not Status.NO_MOTION:
            prior_free = solution.rotation, solution.translation, solution.information
            rotation, translation, information = velocity.fuse(*prior_free, center, elapsed)
            solution = replace(solution, rotation=rotation, translation=translation, information=information)
        motion_over_interval = motion = make_motion_about(center, solution.rotation, solution.translation)
        guess = motion * last_frame.world_from_object
        if not frame.time_offsets.any():
            break
        # Time offsets were corrected with the previous frame's velocity. Now this frame's is known, and after the first
        # motion also the first frame's.
        if last_frame.number == state.keyframes[0].number and len(state.keyframes) == 1:
            first_landmarks = _reinitialize_first_landmarks(
                context,
                state,
                velocity.synchronize_rig(context.rig, last_frame.time_offsets, center, motion_over_interval, elapsed),
            )
            pairs = _replace_first_landmarks(executor, pairs, last_frame.number, first_landmarks)
    agreement = solution.match_weights
    agreements = executor.all_gather(
        lambda c: _measure_agreement(pairs[c], agreement[c], frame.cameras[c]), PoseAgreement.empty()
    )
    is_noise = solution.status is not Status.NO_MOTION and _is_noise(context, state, guess, agreements)
    return (
        None
        if is_noise
        else PoseCandidate(
            frame, rig, pairs, solution, motion, agreements, regions, tracked, has_new_features, first_landmarks
        )
    )


def _is_noise(
    context: TrackerContext, state: JointState, pose: RigidTransform, agreements: Sequence[PoseAgreement]
) -> bool:
    """Return whether in no camera the matches fit a pose (world_from_object) better than any other pose."""
    limit = [
        max(MAX_NOISE_RATIO * context.object_radius_px(state, c, pose), MAX_NOISE_PX) for c in range(len(context.rig))
    ]
    residuals_px = np.array([a.residual_px for a in agreements])
    return bool((np.isnan(residuals_px) | (residuals_px > limit)).all())


def _reinitialize_first_landmarks(context: TrackerContext, state: JointState, rig: Rig) -> list[Landmarks]:
    """Recompute the landmarks of the first frame with time-corrected camera poses; per camera, local."""
    first, cloud, radius = state.last_frame, state.object.points, state.object.radius
    return context.executor.map_cameras(
        lambda c: context.camera_trackers[c].reinitialize_landmarks(
            first.number, rig.cameras[c], first.world_from_object, cloud, radius
        )
    )


def _replace_first_landmarks(
    executor: CameraExecutor, pairs: Sequence[Sequence[FrameMatches]], number: int, landmarks: Sequence[Landmarks]
) -> list[list[FrameMatches]]:
    """Return the pairs with the first frame's landmarks replaced."""

    tables = executor.map_cameras(lambda c: LandmarkTable.from_landmarks(landmarks[c]))

    def replace_landmarks(c: int) -> list[FrameMatches]:
        return [
            replace(pair, earlier=replace(pair.earlier, table=tables[c])) if pair.reference == number else pair
            for pair in pairs[c]
        ]

    return executor.map_cameras(replace_landmarks)


def _measure_agreement(
    pairs: Sequence[FrameMatches], match_weights: MatchWeights, current: CameraFrame
) -> PoseAgreement:
    """Summarize one camera's agreement with a solution."""
    inliers = select_inliers(pairs, [w for w, _ in match_weights])
    squares = np.concatenate([np.empty(0), *(r[w > 0] ** 2 for w, r in match_weights)])
    indices = _concatenate_features([pair.indices for pair in inliers])
    tried, landmarks = _concatenate_features([pair.indices for pair in pairs]), [pair.landmarks for pair in pairs]
    is_inlier = np.concatenate([np.empty(0, bool), *(w > 0 for w, _ in match_weights)])
    all_landmarks = Landmarks.concatenate(landmarks)
    inlier_landmarks = all_landmarks.subset(is_inlier)
    is_moving = np.concatenate([np.empty(0, bool), *(~find_static(pair) for pair in inliers)])
    return PoseAgreement(
        n_inlier_matches=len(indices),
        n_matches=len(tried),
        references=tuple(pair.reference for pair in pairs),
        weights=tuple(float(w.sum()) for w, _ in match_weights),
        ages=LandmarkAges.from_frame_counts(inlier_landmarks.n_observations.astype(float)),
        n_inlier_features=_count_unique(indices),
        n_moved=_count_unique(indices[find_moved(inliers, inlier_landmarks, match_weights, current.static_px)]),
        n_known_moved=_count_unique(tried[all_landmarks.has_moved]),
        residual_px=float(np.sqrt(squares.mean())) if len(squares) else np.nan,
        has_features=len(current.features) > 0,
        n_strong=_count_unique(indices[~current.features.faint[indices]]),
        noise_px=estimate_noise(np.sqrt(squares)),
        n_moving=_count_unique(indices[is_moving]),
        n_features=_count_unique(tried),
    )


def _concatenate_features(indices: Sequence[IntArray]) -> IntArray:
    """Concatenate the current frame's feature indices (n,) of several sets of matches (m, 2)."""
    return np.concatenate([np.empty(0, np.int64), *(index[:, 1] for index in indices)])


def _count_unique(features: IntArray) -> int:
    """Count unique features."""
    return int(np.count_nonzero(np.bincount(features)))


def estimate_noise(residuals: FloatArray) -> float:
    """Estimate the standard deviation of inlier residuals (n,); NaN without any.

    It is the rms, or the median-based estimate if smaller, since a few of many low-contrast features may be far off.
    """
    return (
        float(min(np.sqrt(np.mean(residuals**2)), SIGMA_OF_MEDIAN * np.median(np.abs(residuals))))
        if len(residuals)
        else np.nan
    )


def relocalize(
    context: TrackerContext, state: JointState, frame: Frame, *, faint: bool = False
) -> RigidTransform | None:
    """Relocalize the object anywhere in the images, from the keyframes' landmarks alone.

    Args:
        frame: with the features of the whole images.
        faint: whether low-contrast features are included; then a looser descriptor ratio is used.

    Returns:
        world_from_object; None if not found.
    """
    ratio = LOOSE_DESCRIPTOR_RATIO if faint else DESCRIPTOR_RATIO

    def match_camera(c: int) -> RelocalizationMatches:
        camera_tracker = context.camera_trackers[c]
        tried = select_keyframes(state.keyframes, c, state.last_frame, state.n_missed)
        own = match_keyframes(
            [camera_tracker.frames[k.number] for k in tried], frame.cameras[c], state.object.radius, ratio
        )
        if not len(camera_tracker.detections.rejected):
            camera_tracker.detections = DetectedFeatures(frame.cameras[c].features.pixels, own.pixels)
        return own

    matches = context.executor.map_cameras(match_camera, is_slow=True)
    return estimate_relocalized_pose(
        context.rig, context.executor.all_gather(lambda c: matches[c], RelocalizationMatches.empty())
    )


def is_near_start(state: JointState, candidate: PoseCandidate, pose: RigidTransform) -> bool:
    """Return whether a solved pose is close to the pose it started from, e.g. by relocalization."""
    difference = candidate.motion * state.last_frame.world_from_object * pose.inv()
    is_far = (
        np.linalg.norm(difference.apply(pose.translation) - pose.translation)
        > MAX_START_TRANSLATION * state.object.radius
    )
    return bool(not is_far and difference.rotation.magnitude() <= MAX_START_ROTATION)


def is_partly_visible(state: JointState, candidate: PoseCandidate) -> bool:
    """Return whether too little of a missing object is visible to accept its pose yet.

    Landmarks learned from an uncertain pose would remain wrong.
    """
    is_uncertain = bool(
        np.sqrt(np.diag(invert_information(candidate.solution.information))[:3].max()) > MAX_RELOCALIZED_SD
    )
    return state.n_missed > 0 and is_uncertain and state.n_reobserved < MAX_WAIT_FRAMES
