"""Shared tracker state: pose, velocity, size and keyframes, replicated on every camera.

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
from sylpose.geometry.matrices import invert_information
from sylpose.geometry.rigid import rotation_matrix_of
from sylpose.results import MAX_ROTATION_SD
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.keyframes import add_keyframe
from sylpose.tracking.klt_frontend import Anchor
from sylpose.tracking.motion_model import VelocityModel
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.reports import NewObservations, PoseAgreement

__all__ = ["MIN_MOVED_FEATURES", "JointState", "Nudge", "Refinement", "add_reference_covariance"]

# The pose of a missing object is extrapolated for at most so many frames, and only while its rotation (radians) and its
# position (object's radii) are more certain than this (choice).
MAX_COASTING_FRAMES, MAX_COASTING_ROTATION_SD, MAX_COASTING_POSITION_SD = 15, MAX_ROTATION_SD, 1.0
# Number of recent frames that are refined with the keyframes (choice).
N_RECENT_FRAMES = 8
# Low-contrast features are detected too where fewer features of normal contrast than this agreed with the last pose,
# averaged over cameras. board4, rich in texture, has 90 and more (measured: benchmarks/kinds.py, faint) (choice).
MIN_STRONG_INLIERS = 60
# A pose belongs to the object rather than the background if so many of its inlier features, and this share of them,
# have moved with it (choice).
MIN_MOVED_FEATURES, MIN_MOVED_RATIO = 8, 0.04


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
class Refinement:
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
class JointState:
    """Shared tracker state between two frames.

    Attributes:
        object: size and points of the object.
        last: the last solved frame; None before the first.
        keyframes: solved frames from all sides of the object, in order of time.
        anchor: the anchor frame, whose features are tracked by KLT, if any.
        next_anchor_number: number of the next anchor frame while it is prepared (`tracking.anchor_preparation`).
        recent: the last few solved frames, in order of time.
        velocity: motion model.
        n_missed: frames since the last solved one.
        n_reobserved: frames in which a missing object was detected, but not well enough to accept the pose.
        is_lost: whether the predicted pose is no longer usable.
        path_scale_sd: relative standard deviation of the path's scale, as long as no rotation has determined it; then
            0.
        has_moved: whether the object was ever observed to move against the static background.
        first_motion: motion since the first frame as of the last frame, while its depth is known from boxes only.
        is_background_only: whether in the current frame only features that never moved agreed with a pose.
        nudges: rotations of cameras, in order of time.
        refined_covariance: (6, 6) covariance of (w, d) of the last jointly refined frame. It bounds the covariance of
            later frames from below, since they use the same landmarks. None before any refinement.
        last_refined: the last frame at the most recent joint refinement, as it was then; None before.
        pending_refinement: the joint refinement in progress.
        is_feature_poor: whether features of normal contrast are barely enough for tracking.
        shared_observations: per camera, the observations it has shared of the known frames. Empty before the first
            refinement; after a reset they are sent again.
    """

    object: ObjectModel = field(default_factory=ObjectModel)
    last: SolvedFrame | None = None
    keyframes: tuple[SolvedFrame, ...] = ()
    anchor: Anchor | None = None
    recent: tuple[SolvedFrame, ...] = ()
    velocity: VelocityModel = field(default_factory=VelocityModel)
    n_missed: int = 0
    n_reobserved: int = 0
    is_lost: bool = False
    path_scale_sd: float = 0.0
    has_moved: bool = False
    first_motion: RigidTransform | None = None
    is_background_only: bool = False
    nudges: tuple[Nudge, ...] = ()
    refined_covariance: FloatArray | None = None
    last_refined: SolvedFrame | None = None
    next_anchor_number: int | None = None
    pending_refinement: Refinement | None = None
    shared_observations: tuple[NewObservations, ...] = ()
    is_feature_poor: bool = False

    @property
    def last_frame(self) -> SolvedFrame:
        """The last solved frame; only valid once there is one."""
        assert self.last is not None
        return self.last

    @property
    def known_frames(self) -> Mapping[int, SolvedFrame]:
        """Solved frames that later ones may be matched with, by number."""
        frames = [*self.keyframes, *self.recent, self.last_frame]
        if self.anchor is not None:
            frames.append(self.anchor.frame)
        return {frame.number: frame for frame in frames}

    def predict_pose(self, time: float) -> RigidTransform:
        """Predict the pose at constant velocity; return the last pose once the object is lost."""
        last = self.last_frame.world_from_object
        return last if self.is_lost else self.velocity.predict_motion(time - self.last_frame.time) * last

    def set_first_frame(self, first: SolvedFrame) -> JointState:
        """Return the state after the first frame, whose pose defines the object's frame."""
        return replace(self, last=first, keyframes=(first,))

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
        velocity = self.velocity.reset(is_static=self.is_lost) if self.n_missed else self.velocity
        if not self.is_lost:
            elapsed = solved.time - self.last_frame.time
            velocity = velocity.update(motion, self.last_frame.world_from_object.translation, elapsed)
        strong, has_moved = sum(a.n_strong for a in agreements), self.is_motion_verified(agreements)
        return replace(
            self,
            last=solved,
            # Tracked features are only a selection; and until the object has moved, all may be background.
            is_feature_poor=strong < MIN_STRONG_INLIERS * len(agreements)
            if has_new_features and has_moved and agreements
            else self.is_feature_poor,
            keyframes=add_keyframe(self.keyframes, solved) if has_new_features else self.keyframes,
            recent=(*self.recent, solved)[-N_RECENT_FRAMES:],
            anchor=None if has_new_features or self.anchor is None else replace(self.anchor, age=self.anchor.age + 1),
            next_anchor_number=None if has_new_features else self.next_anchor_number,
            velocity=velocity,
            n_missed=0,
            n_reobserved=0,
            is_lost=False,
            has_moved=has_moved,
            is_background_only=False,
        )

    def is_motion_verified(self, agreements: Sequence[PoseAgreement]) -> bool:
        """Return whether the object has been observed to move, in this frame at the latest.

        At least two cameras have to see it move, since something may pass in front of one.

        Args:
            agreements: per camera, how its matches agree with the frame's pose.
        """
        moved_counts = [a.n_moved for a in agreements if a.n_inlier_features >= MIN_MOVED_FEATURES]
        n_cameras = sum(2 * moved >= MIN_MOVED_FEATURES for moved in moved_counts)
        return self.has_moved or (sum(moved_counts) >= MIN_MOVED_FEATURES and n_cameras >= min(2, len(moved_counts)))

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
        return self.has_moved and moved < max(MIN_MOVED_FEATURES, min_ratio * features)

    def coast(self, time: float) -> tuple[JointState, FloatArray]:
        """Return the state after a frame in which the object was not found.

        The object is assumed to continue at constant velocity, until the prediction becomes too uncertain.

        Returns:
            the state; the covariance (6, 6) of (w, d) of the predicted pose.
        """
        n_missed, last = self.n_missed + 1, self.last_frame
        covariance = last.covariance + self.velocity.predict_covariance(time - last.time, n_missed)
        sd = np.sqrt(np.diag(covariance))
        is_certain = (
            sd[:3].max() < MAX_COASTING_ROTATION_SD and sd[3:].max() < MAX_COASTING_POSITION_SD * self.object.radius
        )
        is_lost = self.is_lost or n_missed > MAX_COASTING_FRAMES or not is_certain
        return replace(
            self, n_missed=n_missed, is_lost=is_lost, is_background_only=False, next_anchor_number=None
        ), covariance

    def add_scale_uncertainty(self, solved: SolvedFrame) -> SolvedFrame:
        """Return a solved frame whose covariance includes the uncertain scale of the path."""
        path = solved.world_from_object.translation - self.keyframes[0].world_from_object.translation
        distance = float(np.linalg.norm(path))
        direction = np.concatenate([np.zeros(3), path / max(distance, 1e-300)])
        missing_variance = (self.path_scale_sd * distance) ** 2 - float(direction @ solved.covariance @ direction)
        return replace(
            solved, covariance=solved.covariance + max(missing_variance, 0.0) * np.outer(direction, direction)
        )

    def replace_frames(self, frames: Mapping[int, SolvedFrame]) -> JointState:
        """Return the state with some frames, by number, replaced by refined ones."""
        anchor = self.anchor
        if anchor is not None and anchor.frame.number in frames:
            anchor = replace(anchor, frame=frames[anchor.frame.number])
        return replace(
            self,
            last=frames.get(self.last_frame.number, self.last_frame),
            keyframes=tuple(frames.get(k.number, k) for k in self.keyframes),
            anchor=anchor,
            recent=tuple(frames.get(k.number, k) for k in self.recent),
        )

    def reset_to_first_frame(self, radius: float) -> JointState:
        """Return the state once the object's size is known from its motion.

        Landmark depths guessed from boxes are discarded, and with them all poses but the first frame's.
        """
        first = replace(self.keyframes[0], landmark_age=1.0)
        keeps_anchor = self.anchor is not None and self.anchor.frame.number == first.number
        return replace(
            self,
            object=replace(self.object, radius=radius, is_depth_guessed=False),
            keyframes=(first,),
            last=first,
            recent=(),
            refined_covariance=None,
            last_refined=None,
            next_anchor_number=None,
            pending_refinement=None,
            shared_observations=(),
            anchor=Anchor(first, self.anchor.age) if keeps_anchor and self.anchor is not None else None,
        )


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
