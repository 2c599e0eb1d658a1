"""Shared tracker state: object, solved frames, motion and refinement, replicated on every camera.

All of it follows from what the cameras exchange, so every replica is identical.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.bundle import BundleResult
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.future import BackgroundResult
from sylpose.geometry.matrices import invert_information, relative_rotvec, rotation_matrix_of
from sylpose.results import MAX_ROTATION_SD
from sylpose.tracking.joint_side.keyframes import Anchor, KnownFrames, SolvedFrame
from sylpose.tracking.joint_side.motion_model import VelocityModel
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.reports import NewObservations, PoseAgreement

# The pose of a missing object is extrapolated for at most so many frames, and only while its rotation (radians) and its
# position (object's radii) are more certain than this (choice).
MAX_COASTING_FRAMES, MAX_COASTING_ROTATION_SD, MAX_COASTING_POSITION_SD = 15, MAX_ROTATION_SD, 1.0
# Low-contrast features are detected too where fewer features of normal contrast than this agreed with the last pose,
# averaged over cameras. board4, rich in texture, has 90 and more (measured: benchmarks/kinds.py, faint) (choice).
MIN_STRONG_INLIERS = 60
# A pose belongs to the object rather than the background if so many of its inlier features, and this share of them,
# have moved with it (choice).
MIN_MOVED_FEATURES, MIN_MOVED_RATIO = 8, 0.04
# After the first frames, a refinement is due once the object has rotated by this since the last one (radians) or moved
# by this share of its radius, as less motion shows little new; at the earliest after `MIN_INTERVAL` frames, at the
# latest after `MAX_INTERVAL` (choice).
MIN_NEW_ROTATION, MIN_NEW_TRANSLATION, MIN_INTERVAL, MAX_INTERVAL = np.radians(10.0), 0.3, 4, 12
# Minimum number of frames for a refinement that changes poses, as fewer do not determine depths well enough (choice).
MIN_FRAMES_TO_APPLY = 9
# A refinement in the background is applied so many frames later (choice).
RESULT_DELAY = 5


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """Motion of the object, and whether it is in view.

    Attributes:
        velocity: motion model.
        has_moved: whether the object was ever observed to move against the static background.
        first_motion: motion since the first frame as of the last frame, while its depth is known from boxes only.
        n_missed: frames since the last solved one.
        n_reobserved: frames in which a missing object was detected, but not well enough to accept the pose.
        is_lost: whether the predicted pose is no longer usable.
        is_background_only: whether in the current frame only features that never moved agreed with a pose.
    """

    velocity: VelocityModel = field(default_factory=VelocityModel)
    has_moved: bool = False
    first_motion: RigidTransform | None = None
    n_missed: int = 0
    n_reobserved: int = 0
    is_lost: bool = False
    is_background_only: bool = False


@dataclass(frozen=True, eq=False)
class PendingRefinement:
    """Joint refinement of several frames, in progress (`tracking.window`).

    Attributes:
        number: of the last of the frames.
        frames: their state when the refinement began, in order of time.
        landmark_cameras: (m,) camera of each refined landmark.
        landmark_ids: per camera, the landmarks' numbers.
        result: the future result.
    """

    number: int
    frames: tuple[SolvedFrame, ...]
    landmark_cameras: IntArray
    landmark_ids: tuple[IntArray, ...]
    result: BackgroundResult[BundleResult]


@dataclass(frozen=True, eq=False)
class Refinement:
    """State of the joint refinement.

    Attributes:
        covariance: (6, 6) covariance of (w, d) of the last jointly refined frame. It bounds the covariance of later
            frames from below, since they use the same landmarks. None before any refinement.
        last: the last frame at the most recent joint refinement, as it was then; None before.
        pending: the joint refinement in progress.
        shared: per camera, the observations it has shared of the known frames. Empty before the first refinement; after
            a reset they are sent again.
        path_scale_sd: relative standard deviation of the path's scale, as long as no rotation has determined it; then
            0.
    """

    covariance: FloatArray | None = None
    last: SolvedFrame | None = None
    pending: PendingRefinement | None = None
    shared: tuple[NewObservations, ...] = ()
    path_scale_sd: float = 0.0


@dataclass(frozen=True, eq=False)
class Nudge:
    """Rotation of a camera during recording.

    Attributes:
        camera: index in the rig.
        frame: recording's number of the first frame after it.
        rotation: (3,) rotation vector of the background since the camera was last static, camera's axes.
        sd: standard deviation of that rotation about its least certain axis, radians.
    """

    camera: int
    frame: int
    rotation: FloatArray
    sd: float

    @property
    def angle(self) -> float:
        """Rotation angle of the background, radians."""
        return float(np.linalg.norm(self.rotation))


@dataclass(frozen=True, eq=False)
class JointState:
    """Shared tracker state between two frames.

    Attributes:
        object: size and points of the object.
        frames: solved frames that later ones are matched with.
        motion: the object's motion, and whether it is in view.
        refinement: state of the joint refinement.
        nudges: rotations of cameras, in order of time.
        is_feature_poor: whether features of normal contrast are barely enough for tracking.
    """

    object: ObjectModel = field(default_factory=ObjectModel)
    frames: KnownFrames = field(default_factory=KnownFrames)
    motion: ObjectMotion = field(default_factory=ObjectMotion)
    refinement: Refinement = field(default_factory=Refinement)
    nudges: tuple[Nudge, ...] = ()
    is_feature_poor: bool = False

    @property
    def last(self) -> SolvedFrame:
        """The last solved frame; only valid once there is one."""
        assert self.frames.last is not None
        return self.frames.last

    @property
    def needs_first_motion(self) -> bool:
        """Whether depth is known from boxes only, or the motion is unknown."""
        return self.object.is_depth_guessed or not self.motion.velocity.n_frames

    # --- prediction and judgment of a pose ----------------------------------------------------------------------------

    def predict_pose(self, time: float) -> RigidTransform:
        """Predict the pose at constant velocity; return the last pose once the object is lost."""
        last = self.last.world_from_object
        return last if self.motion.is_lost else self.motion.velocity.predict_motion(time - self.last.time) * last

    def is_motion_verified(self, agreements: Sequence[PoseAgreement]) -> bool:
        """Return whether the object has been observed to move, in this frame at the latest.

        At least two cameras have to see it move, since something may pass in front of one.

        Args:
            agreements: per camera, how its matches agree with the frame's pose.
        """
        moved_counts = [a.n_moved for a in agreements if a.n_inlier_features >= MIN_MOVED_FEATURES]
        n_cameras = sum(2 * moved >= MIN_MOVED_FEATURES for moved in moved_counts)
        return self.motion.has_moved or (
            sum(moved_counts) >= MIN_MOVED_FEATURES and n_cameras >= min(2, len(moved_counts))
        )

    def is_static(self, agreements: Sequence[PoseAgreement]) -> bool:
        """Return whether the object has not moved yet, including this frame.

        A person passing behind the object also moves, but not most of what one camera sees in its box.

        Args:
            agreements: per camera, how its matches agree with the frame's pose.
        """
        is_mostly_moving = any(a.n_moved >= MIN_MOVED_FEATURES and 2 * a.n_moved > a.n_matches for a in agreements)
        return not is_mostly_moving and not self.is_motion_verified(agreements)

    def may_be_background(self, agreements: Sequence[PoseAgreement], min_ratio: float = MIN_MOVED_RATIO) -> bool:
        """Return whether a pose may be the background's: almost none of its inliers ever moved.

        Always False before the object has moved: no other evidence exists then.

        Args:
            agreements: per camera, how its matches agree with the pose.
            min_ratio: smallest share of inlier features that must have moved.
        """
        moved, features = sum(a.n_moved for a in agreements), sum(a.n_inlier_features for a in agreements)
        return self.motion.has_moved and moved < max(MIN_MOVED_FEATURES, min_ratio * features)

    def add_scale_uncertainty(self, solved: SolvedFrame) -> SolvedFrame:
        """Return a solved frame whose covariance includes the uncertain scale of the path."""
        path = solved.world_from_object.translation - self.frames.first.world_from_object.translation
        distance = float(np.linalg.norm(path))
        direction = np.concatenate([np.zeros(3), path / max(distance, 1e-300)])
        missing_variance = (self.refinement.path_scale_sd * distance) ** 2 - float(
            direction @ solved.covariance @ direction
        )
        return replace(
            solved, covariance=solved.covariance + max(missing_variance, 0.0) * np.outer(direction, direction)
        )

    # --- the next state -----------------------------------------------------------------------------------------------

    def add_solved_frame(
        self,
        solved: SolvedFrame,
        motion: RigidTransform,
        *,
        has_new_features: bool,
        agreements: Sequence[PoseAgreement] = (),
    ) -> JointState:
        """Return the state after a solved frame.

        Args:
            solved: the frame.
            motion: of the object since the last solved frame.
            has_new_features: whether the frame has newly detected features, to be matched by descriptors.
            agreements: per camera, how its matches agree with the pose.
        """
        velocity, is_lost = self.motion.velocity, self.motion.is_lost
        if self.motion.n_missed:
            velocity = velocity.reset(is_static=is_lost)
        if not is_lost:
            velocity = velocity.update(motion, self.last.world_from_object.translation, solved.time - self.last.time)
        strong, has_moved = sum(a.n_strong for a in agreements), self.is_motion_verified(agreements)
        is_poor = self.is_feature_poor
        if has_new_features and has_moved and agreements:
            # Tracked features are only a selection; and until the object has moved, all may be background.
            is_poor = strong < MIN_STRONG_INLIERS * len(agreements)
        return replace(
            self,
            frames=self.frames.add(solved, has_new_features=has_new_features),
            motion=ObjectMotion(velocity, has_moved, self.motion.first_motion),
            is_feature_poor=is_poor,
        )

    def coast(self, time: float) -> tuple[JointState, FloatArray]:
        """Return the state after a frame in which the object was not found.

        The object is assumed to continue at constant velocity, until the prediction becomes too uncertain.

        Returns:
            the state; the covariance (6, 6) of (w, d) of the predicted pose.
        """
        n_missed = self.motion.n_missed + 1
        covariance = self.last.covariance + self.motion.velocity.predict_covariance(time - self.last.time, n_missed)
        sd = np.sqrt(np.diag(covariance))
        is_certain = (
            sd[:3].max() < MAX_COASTING_ROTATION_SD and sd[3:].max() < MAX_COASTING_POSITION_SD * self.object.radius
        )
        is_lost = self.motion.is_lost or n_missed > MAX_COASTING_FRAMES or not is_certain
        motion = replace(self.motion, n_missed=n_missed, is_lost=is_lost, is_background_only=False)
        return replace(self, motion=motion, frames=replace(self.frames, next_anchor_number=None)), covariance

    def reset_to_first_frame(self, radius: float) -> JointState:
        """Return the state once the object's size is known from its motion.

        Landmark depths guessed from boxes are discarded, and with them all poses but the first frame's.
        """
        first, anchor = replace(self.frames.first, landmark_age=1.0), self.frames.anchor
        keeps_anchor = anchor is not None and anchor.frame.number == first.number
        return replace(
            self,
            object=replace(self.object, radius=radius, is_depth_guessed=False),
            frames=KnownFrames(
                first, (first,), anchor=Anchor(first, anchor.age) if keeps_anchor and anchor is not None else None
            ),
            refinement=Refinement(path_scale_sd=self.refinement.path_scale_sd),
        )

    # --- joint refinement ---------------------------------------------------------------------------------------------

    def is_refinement_due(self) -> bool:
        """Return whether the last solved frame is to be refined with others.

        The first frames always are; later ones are after enough new motion.
        """
        last, before = self.last, self.refinement.last
        if self.refinement.pending is not None:
            return False
        if before is None or last.number - self.frames.first.number <= MIN_FRAMES_TO_APPLY:
            return True
        change, since = compute_pose_change(before, last.world_from_object), last.number - before.number
        is_new = (
            np.linalg.norm(change[:3]) > MIN_NEW_ROTATION
            or np.linalg.norm(change[3:]) > MIN_NEW_TRANSLATION * self.object.radius
        )
        return since >= MAX_INTERVAL or (since >= MIN_INTERVAL and bool(is_new))

    def is_refinement_ready(self, number: int) -> bool:
        """Return whether a background refinement is to be applied in the frame with this number."""
        pending = self.refinement.pending
        return pending is not None and number >= pending.number + RESULT_DELAY


def compute_pose_change(last: SolvedFrame, refined_pose: RigidTransform) -> FloatArray:
    """Return the change (6,) (w, d) of a frame's pose by the refinement."""
    before = last.world_from_object
    return np.concatenate([relative_rotvec(before, refined_pose), refined_pose.translation - before.translation])


def enlarge_covariance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) not smaller than either input in any direction.

    Args:
        a: positive definite; enlarged wherever it is smaller than b.
        b: lower bound.
    """
    root = np.linalg.cholesky(a)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    out = root @ vectors @ np.diag(np.maximum(values, 1.0)) @ vectors.T @ root.T
    return np.asarray(0.5 * (out + out.T))


def add_reference_covariance(
    information: FloatArray,
    world_from_object: RigidTransform,
    agreements: Sequence[PoseAgreement],
    known_frames: Mapping[int, SolvedFrame],
    radius: float,
    correlation: float = 0.0,
) -> FloatArray:
    """Return a frame's covariance including that of its reference frames, (6, 6) of (w, d).

    The references' errors have common ancestors, so they are treated as fully correlated: then the covariance of their
    weighted mean is at most the weighted mean of their covariances. The weights are their shares of inliers.

    Args:
        information: (6, 6) of (w, d), of the frame's fit.
        world_from_object: pose of the frame.
        agreements: per camera, how its matches agree with the pose.
        known_frames: solved frames by number.
        radius: of the object.
        correlation: correlation of the frame's own error with the references', each along the axes of its covariance.
    """
    shares: dict[int, float] = {}
    for a in agreements:
        for number, weight in zip(a.references, a.weights, strict=True):
            if number in known_frames:  # a report about any other frame is faulty
                shares[number] = shares.get(number, 0.0) + weight
    total, inherited = max(sum(shares.values()), 1e-12), np.zeros((6, 6))
    for number, weight in shares.items():
        # An error of the reference's pose, in world axes, rotates with the object.
        rotation = rotation_matrix_of(world_from_object) @ rotation_matrix_of(known_frames[number].world_from_object).T
        cross = np.kron(np.eye(2), rotation)
        inherited += weight / total * (cross @ known_frames[number].covariance @ cross.T)
    # Unobservable directions are bounded: matches never span half a turn or the object's size.
    bound = np.repeat([np.pi**-2, radius**-2], 3)
    own = invert_information(information + np.diag(bound))
    if not correlation:
        return own + inherited
    unit = np.repeat([1.0, 1.0 / radius], 3)
    roots = [_matrix_sqrt(unit[:, None] * covariance * unit) for covariance in (own, inherited)]
    cross = correlation * roots[0] @ roots[1] / np.outer(unit, unit)
    return own + inherited + cross + cross.T


def _matrix_sqrt(covariance: FloatArray) -> FloatArray:
    """Return the symmetric square root of a symmetric matrix."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
