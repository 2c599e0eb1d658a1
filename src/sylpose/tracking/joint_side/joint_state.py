"""Shared tracker state: object, solved frames, motion and refinement, replicated on every camera.

All of it follows from what the cameras exchange, so every replica is identical.

Cameras are static and the object rotates, so a keyframe is characterized by the camera's viewpoint in the object's
frame. A new frame is matched with keyframes of similar viewpoints, oldest first: an old pose has drifted less, and the
first keyframe of a side that is observed again closes the loop (docs/method/4-tracking.md, "Drift"). Between them the
object is assumed to move at constant velocity, with an adaptive uncertainty.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.bundle import BundleResult
from sylpose.features.sift import RESPONSE_SCALE
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.future import BackgroundResult
from sylpose.geometry.matrices import invert_information, relative_rotvec, rotation_matrix_of, rotvec
from sylpose.geometry.numba_linalg import apply_rotvec
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.relative_pose.limits import CUTOFF, MISMATCH_PROBABILITY
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.results import MAX_ROTATION_SD
from sylpose.rig import Camera, Rig
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.reports import Agreements, NewObservations, TrackingReport

# After the first frames, a refinement is due once the object has rotated by this since the last one (radians), as less
# shows little new; at the earliest after `MIN_INTERVAL` frames, at the latest after `MAX_INTERVAL` (choice).
MIN_INTERVAL, MAX_INTERVAL = 4, 12
# A frame becomes a keyframe when the object has rotated relative to the nearest one (`TrackingOptions`), or its distance in
# a camera's view has changed by this factor, that between two layers of SIFT's scales (derived).
MIN_KEYFRAME_SCALE = 2.0 ** (1.0 / RESPONSE_SCALE)
# One reference is taken from each ring of angles between viewpoints: near ones match well, far ones limit drift
# (choice).
RING_ANGLES = np.radians([0.0, 10.0, 18.0, 28.0])
# An anchor is used while these shares of its features are still tracked, overall and per camera, and at least so many in
# total (choice). A body can be measured from an earlier frame that shows the first share of its matches.
MIN_TRACKED_RATIO, MIN_CAMERA_RATIO, MIN_TRACKED = 0.4, 0.25, 60
# An anchor is used until the object has rotated beyond the outermost ring, in which frames are matched (derived).
MAX_ANCHOR_ROTATION = RING_ANGLES[-1]
# Preparation of the next anchor starts when the tracked shares fall below these times this factor, or the rotation
# exceeds that divided by it (choice).
PREPARATION_MARGIN = 1.5
# Number of frames after which a search is repeated: of a camera without tracks, and where the object was relocalized, but
# not confirmed. Detection of a camera's motion restarts so many frames after as many of unexplained change, or after too
# few corners. A refinement begins in the background after as many: it takes about as long on a busy processor, at 30 frames
# per second (choice).
RETRY_FRAMES = 8
# The result of work in the background is used so many frames later, before the next one begins (derived).
RESULT_DELAY = RETRY_FRAMES - 1
# Number of frames for which a sparse anchor is used: by then it is clear which features move with the object (choice).
MAX_SPARSE_AGE = 2
# Largest accepted difference between prediction and fit (chi-squared of six: chance exceeds it once in a thousand
# times).
MAX_PREDICTION_ERROR = chi_squared_bound(6)
# Largest squared change of a pose by a refinement, relative to its covariance (chi-squared of six: chance exceeds it once
# in a thousand times).
MAX_CHANGE = chi_squared_bound(6)
# Number of frames over which the usual change of velocity and a camera's noise are averaged, and after which velocity
# predicts poses (choice).
AVERAGING_FRAMES = 5
# The velocity is not updated from an interval shorter than this share of the usual one (choice).
MIN_INTERVAL_RATIO = 0.2


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Constant-velocity model: the last motion and its variability.

    Attributes:
        twist: (6,) exponential coordinates per second, rotation first, in the world.
        change_variance: (6,) mean squared changes of angular velocity and of the center's velocity, per second.
        n_frames: number of consecutive solved frames.
        interval: usual time between them, seconds.
    """

    twist: FloatArray = field(default_factory=lambda: np.zeros(6))
    change_variance: FloatArray = field(default_factory=lambda: np.zeros(6))
    n_frames: int = 0
    interval: float = 0.0

    def predict_motion(self, elapsed: float) -> RigidTransform:
        """Predict the motion over some seconds."""
        return RigidTransform.from_exp_coords(self.twist * elapsed)

    def update(self, motion: RigidTransform, center: FloatArray, elapsed: float) -> MotionModel:
        """Update with the motion to the next frame.

        Args:
            motion: of the object.
            center: (3,) of the object at its start.
            elapsed: seconds.
        """
        # Over a very short interval the pose difference is mostly noise.
        if self.n_frames and elapsed < MIN_INTERVAL_RATIO * self.interval:
            return self
        elapsed = max(elapsed, 1e-9)
        interval, change_variance = elapsed, self.change_variance
        # The first motion is a change by itself.
        if self.n_frames:
            interval = self.interval + (elapsed - self.interval) / AVERAGING_FRAMES
            change = (
                self._compute_prediction_error(
                    rotation_matrix_of(motion), motion.apply(center) - center, center, elapsed
                )
                / elapsed
            )
            change_variance = change_variance + (change**2 - change_variance) / min(self.n_frames, AVERAGING_FRAMES)
        return MotionModel(motion.as_exp_coords() / elapsed, change_variance, self.n_frames + 1, interval)

    def reset(self, *, is_static: bool) -> MotionModel:
        """Reset after unsolved frames.

        The variability is kept, and so is the velocity unless the object `is_static`.
        """
        return replace(self, n_frames=0, twist=np.zeros(6) if is_static else self.twist)

    def predict_covariance(self, elapsed: float, n_missed: int) -> FloatArray:
        """Predict the covariance (6, 6) of (w, d) of the motion; infinite while it is unknown.

        Args:
            elapsed: seconds.
            n_missed: number of unsolved frames within that time.
        """
        if not self.change_variance.any():  # fewer than two motions so far
            return np.full((6, 6), np.inf)
        return np.asarray(np.diag(self.change_variance) * n_missed * elapsed**2)

    def fuse(
        self, rotation: FloatArray, translation: FloatArray, information: FloatArray, center: FloatArray, elapsed: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fuse a motion since the last frame with the constant-velocity prediction.

        The prediction is weak and matters where matches provide little, as when all but a corner of the object is
        hidden. It is ignored if the matches contradict it: then the object has started, stopped or reversed.

        Args:
            rotation: (3, 3) R.
            translation: (3,) d.
            information: (6, 6) of (w, d).
            center: (3,) of the object in the last frame, `elapsed` seconds ago.

        Returns:
            the three, corrected.
        """
        # An object that has been static so far gives no information on its motion.
        if self.n_frames < AVERAGING_FRAMES or not self.change_variance.any():
            return rotation, translation, information
        error = self._compute_prediction_error(rotation, translation, center, elapsed)
        # Larger changes than this many usual ones are no chance.
        sd = np.maximum(CUTOFF * elapsed * np.sqrt(_sum_by_parts(self.change_variance)), 1e-12)
        prediction, fused_information = np.diag(sd**-2), information + np.diag(sd**-2)
        # error' (covariance of the fit + diag(sd²))^-1 error, without inverting an information matrix that may be
        # singular.
        weighted = prediction @ error
        if weighted @ error - weighted @ np.linalg.solve(fused_information, weighted) > MAX_PREDICTION_ERROR:
            return rotation, translation, information
        step = -np.linalg.solve(fused_information, prediction @ error)
        corrected = np.empty((3, 3))
        apply_rotvec(np.asarray(step[:3], float), rotation, corrected)
        return corrected, translation + step[3:], fused_information

    def estimate_twist(self, center: FloatArray, motion: RigidTransform, elapsed: float) -> FloatArray:
        """Estimate the twist (6,) per second at a frame: at most that of the motion to it.

        Args:
            center: (3,) of the object.
            motion: of the object within `elapsed` seconds, up to the frame.
        """
        twist = motion.as_exp_coords() / max(elapsed, 1e-9)
        # A velocity that changes between frames by its own size is no estimate for the times between.
        velocity = np.concatenate([twist[:3], np.cross(twist[:3], center) + twist[3:]])
        square, change = _sum_by_parts(velocity**2), _sum_by_parts(self.change_variance)
        velocity = velocity * square / np.maximum(square + change, 1e-300)
        return np.concatenate([velocity[:3], velocity[3:] - np.cross(velocity[:3], center)])

    def predict_offset_error(self, time_offsets: FloatArray, radius: float) -> FloatArray:
        """Predict how far the object's surface is from where `synchronize_rig` assumes it, (C,) units.

        The standard deviation; infinite while it is unknown.

        Args:
            time_offsets: (C,) seconds.
            radius: of the object.
        """
        if self.n_frames < AVERAGING_FRAMES:
            return np.where(time_offsets == 0.0, 0.0, np.inf)
        variance = self.change_variance[3:].sum() + self.change_variance[:3].sum() * radius**2
        return np.asarray(np.abs(time_offsets) * np.sqrt(variance))

    def _compute_prediction_error(
        self, rotation: FloatArray, translation: FloatArray, center: FloatArray, elapsed: float
    ) -> FloatArray:
        """Return the difference (6,) of (w, d) between a motion and the prediction."""
        predicted_pose = self.predict_motion(elapsed)
        rotation_error = rotvec(rotation @ rotation_matrix_of(predicted_pose).T)
        return np.concatenate([rotation_error, translation - (predicted_pose.apply(center) - center)])


def synchronize_rig(rig: Rig, time_offsets: FloatArray, twist: FloatArray) -> Rig:
    """Return the rig with camera poses corrected for their time offsets.

    With these poses, the moving object appears as if all images were taken at the same time.

    Args:
        time_offsets: (C,) seconds.
        twist: (6,) of the object, per second.
    """
    if not time_offsets.any() or not twist.any():
        return rig
    cameras = [
        replace(camera, camera_from_world=_synchronize(camera.camera_from_world, seconds, twist))
        for camera, seconds in zip(rig, time_offsets, strict=True)
    ]
    return Rig(cameras, rig.unit)


def _synchronize(camera_from_world: RigidTransform, seconds: float, twist: FloatArray) -> RigidTransform:
    """Return camera_from_world with which the object appears as `seconds` later."""
    return camera_from_world * RigidTransform.from_exp_coords(twist * seconds)


def _sum_by_parts(squares: FloatArray) -> FloatArray:
    """Return the sums of the first and the last three elements, each repeated three times (6,)."""
    return np.repeat(squares.reshape(2, 3).sum(axis=1), 3)


@dataclass(frozen=True, eq=False)
class SolvedFrame:
    """A frame with its pose, shared by all cameras.

    Attributes:
        number, time, time_offsets: as in `context.Frame`; each camera stores its own data under the number.
        world_from_object: the pose.
        covariance: (6, 6) of (w, d), docs/conventions.md.
        viewpoints: (C, 3) camera centers in the object's frame.
        is_visible: (C,) which cameras have features in it.
        landmark_age: typical number of frames in which the landmarks used for its pose were observed.
        is_fixed: whether joint refinement keeps its pose fixed, as for keyframes transferred from another rig.
        is_contradicted: whether the cameras contradict its pose, or those of all earlier frames that support it.
        n_uncertain: number of frames since the object was found again, to this one, from which nothing was learned.
        twist: (6,) per second, of the object at `time`; NaN if it is unknown or changes too much for the time offsets.
    """

    number: int
    time: float
    time_offsets: FloatArray
    world_from_object: RigidTransform
    covariance: FloatArray
    viewpoints: FloatArray
    is_visible: BoolArray
    landmark_age: float = 1.0
    is_fixed: bool = False
    is_contradicted: bool = False
    n_uncertain: int = 0
    twist: FloatArray = field(default_factory=lambda: np.full(6, np.nan))

    def camera_from_object(self, camera: Camera, c: int) -> FloatArray | None:
        """Return the object's pose in camera c, (4, 4), when it took its image; None if its time offset is too large."""
        seconds, camera_from_world = self.time_offsets[c] if len(self.time_offsets) else 0.0, camera.camera_from_world
        if seconds != 0.0:
            if np.isnan(self.twist).any():
                return None
            camera_from_world = _synchronize(camera_from_world, seconds, self.twist)
        return np.asarray(camera_from_world.as_matrix() @ self.world_from_object.as_matrix())


@dataclass(frozen=True, eq=False)
class Anchor:
    """Frame whose features are tracked by KLT; shared by all cameras.

    Attributes:
        frame: its landmarks are updated by the tracked features.
        age: number of frames solved by its features alone.
        is_sparse: whether it was created right after the first frame in boxes, when new features in them might be
            background.
    """

    frame: SolvedFrame
    age: int = 0
    is_sparse: bool = False


@dataclass(frozen=True, eq=False)
class KnownFrames:
    """Solved frames that later ones may be matched with.

    Attributes:
        last: the last solved frame; None before the first.
        keyframes: solved frames from all sides of the object, in order of time.
        recent: the last few solved frames, in order of time.
        anchor: the anchor frame, whose features are tracked by KLT, if any.
        next_anchor_number: number of the next anchor frame while it is prepared (`tracking.anchor_preparation`).
    """

    last: SolvedFrame | None = None
    keyframes: tuple[SolvedFrame, ...] = ()
    recent: tuple[SolvedFrame, ...] = ()
    anchor: Anchor | None = None
    next_anchor_number: int | None = None

    @property
    def first(self) -> SolvedFrame:
        """The frame whose pose defines the object's frame; only valid once there is one."""
        return self.keyframes[0]

    @property
    def by_number(self) -> Mapping[int, SolvedFrame]:
        """The frames by number; empty before the first."""
        anchor = () if self.anchor is None else (self.anchor.frame,)
        last = () if self.last is None else (self.last,)
        return {frame.number: frame for frame in (*self.keyframes, *self.recent, *last, *anchor)}

    def is_next_anchor_due(self, number: int) -> bool:
        """Return whether the next anchor is to be used from the frame with this number on."""
        due = self.next_anchor_number
        return due is not None and number >= due + RESULT_DELAY and due in self.by_number

    def add(self, solved: SolvedFrame, options: TrackingOptions, *, has_new_features: bool) -> KnownFrames:
        """Add a solved frame; with new features it may become a keyframe, and its features are tracked no longer."""
        anchor = self.anchor
        return replace(
            self,
            last=solved,
            keyframes=add_keyframe(self.keyframes, solved, options) if has_new_features else self.keyframes,
            recent=(*self.recent, solved)[-options.n_recent_frames :],
            anchor=None if has_new_features or anchor is None else replace(anchor, age=anchor.age + 1),
            next_anchor_number=None if has_new_features else self.next_anchor_number,
        )

    def replace_frames(self, frames: Mapping[int, SolvedFrame]) -> KnownFrames:
        """Replace some frames, by number, by refined ones."""
        assert self.last is not None
        anchor = self.anchor
        if anchor is not None and anchor.frame.number in frames:
            anchor = replace(anchor, frame=frames[anchor.frame.number])
        return replace(
            self,
            last=frames.get(self.last.number, self.last),
            keyframes=tuple(frames.get(k.number, k) for k in self.keyframes),
            anchor=anchor,
            recent=tuple(frames.get(k.number, k) for k in self.recent),
        )


def compute_viewpoints(rig: Rig, world_from_object: RigidTransform) -> FloatArray:
    """Return the camera centers (C, 3) in the object's frame."""
    return np.asarray(world_from_object.inv().apply(np.array([camera.center for camera in rig])).reshape(-1, 3))


def _compute_angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles (n, m) between viewpoints (n, 3) and (m, 3), seen from the object."""
    a, b = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300) for v in (a, b))
    return np.asarray(np.arccos(np.clip(a @ b.T, -1.0, 1.0)))


def _get_viewpoints(keyframes: Sequence[SolvedFrame], camera: int) -> FloatArray:
    """Return one camera's viewpoints (K, 3); NaN where it has no features."""
    empty = np.full(3, np.nan)
    return np.array([k.viewpoints[camera] if k.is_visible[camera] else empty for k in keyframes]).reshape(-1, 3)


def select_references(
    keyframes: Sequence[SolvedFrame], camera: int, viewpoint: FloatArray, skip: SolvedFrame | None = None
) -> list[SolvedFrame]:
    """Select the oldest keyframe in each ring around a camera's viewpoint (3,).

    Args:
        skip: a frame that is matched anyway.
    """
    if not keyframes:
        return []
    angle = _compute_angles(viewpoint[None], _get_viewpoints(keyframes, camera))[0]
    chosen = []
    for inner, outer in pairwise(RING_ANGLES):
        ring = np.flatnonzero((angle >= inner) & (angle < outer))
        if len(ring) and not (skip is not None and keyframes[ring[0]].number == skip.number):
            chosen.append(keyframes[ring[0]])
    return chosen


def find_nearest_views(
    keyframes: Sequence[SolvedFrame], camera: int, viewpoint: FloatArray, count: int
) -> list[SolvedFrame]:
    """Return up to `count` keyframes nearest to a camera viewpoint (3,), nearest first."""
    if not keyframes:
        return []
    angle = np.nan_to_num(_compute_angles(viewpoint[None], _get_viewpoints(keyframes, camera))[0], nan=np.inf)
    order = np.argsort(angle, kind="stable")[:count]
    return [keyframes[i] for i in order if np.isfinite(angle[i])]


def add_keyframe(
    keyframes: tuple[SolvedFrame, ...], current: SolvedFrame, options: TrackingOptions
) -> tuple[SolvedFrame, ...]:
    """Add a solved frame (in order of time) if it shows the object from a new side.

    If there are too many keyframes, the most redundant one is removed.
    """
    if keyframes and not _is_new(keyframes, current, options):
        return keyframes
    kept = [*keyframes, current]
    if len(kept) > options.max_keyframes:
        rotations = np.array([k.world_from_object.rotation.as_matrix().ravel() for k in kept])
        # tr(A'B) = 1 + 2 cos: the larger, the more similar. Of the most similar pair the newer is removed; the first
        # one stays.
        similarity = np.tril(rotations @ rotations.T, -1) - 10.0 * np.triu(np.ones((len(rotations), len(rotations))))
        del kept[int(np.unravel_index(np.argmax(similarity), similarity.shape)[0])]
    return tuple(kept)


def inherit_covariance(poses: RigidTransform, covariances: FloatArray, is_fixed: BoolArray) -> FloatArray:
    """Return the covariance (N, 6, 6) of (w, d) that frames inherit from fixed ones.

    The errors of fixed frames have common ancestors, so they are fully correlated, and rotate with the object.

    Args:
        poses: N world_from_object.
        covariances: (N, 6, 6) of the fixed frames.
        is_fixed: (N,) which frames are fixed.
    """
    rotations = np.zeros((len(is_fixed), 6, 6))
    rotations[:, :3, :3] = rotations[:, 3:, 3:] = poses.rotation.as_matrix()
    inverse_rotations = rotations[is_fixed].transpose(0, 2, 1)
    mean = (inverse_rotations @ covariances[is_fixed] @ rotations[is_fixed]).mean(axis=0)
    return np.asarray(rotations @ mean @ rotations.transpose(0, 2, 1))


def _is_new(keyframes: Sequence[SolvedFrame], current: SolvedFrame, options: TrackingOptions) -> bool:
    """Return whether most cameras with features have a view unlike that in any keyframe."""
    new = []
    for camera in np.flatnonzero(current.is_visible).tolist():
        views, viewpoint = _get_viewpoints(keyframes, camera), current.viewpoints[camera]
        scale = np.linalg.norm(views, axis=1) / np.linalg.norm(viewpoint)
        is_similar = (
            (_compute_angles(viewpoint[None], views)[0] < options.min_keyframe_rotation)
            & (scale < MIN_KEYFRAME_SCALE)
            & (scale > 1.0 / MIN_KEYFRAME_SCALE)
        )
        new.append(not is_similar.any())
    return 2 * sum(new) > len(new)


def has_enough_tracks(
    reports: Sequence[TrackingReport], anchor: Anchor, predicted_pose: RigidTransform, margin: float = 1.0
) -> bool:
    """Return whether an anchor's tracked features suffice without new ones.

    Args:
        reports: of all cameras.
        predicted_pose: predicted world_from_object.
        margin: safety factor on the required numbers.
    """
    angle = np.linalg.norm(relative_rotvec(anchor.frame.world_from_object, predicted_pose))
    found, alive = np.array([r.n_tracked for r in reports]), np.array([r.n_alive for r in reports])
    shares = margin * np.array([MIN_TRACKED_RATIO, MIN_CAMERA_RATIO])
    is_enough = found.sum() >= max(shares[0] * alive.sum(), MIN_TRACKED) and (found >= shares[1] * alive).all()
    for r in reports:
        # A camera that delivers images again is searched at once; one without tracks is searched again after a while.
        is_enough &= not (r.expects_object and not r.has_previous_image)
        is_enough &= not (r.expects_object and r.n_alive == 0 and anchor.age >= RETRY_FRAMES)
    is_lasting = not (anchor.is_sparse and anchor.age >= MAX_SPARSE_AGE)
    return bool(is_enough and is_lasting and angle < MAX_ANCHOR_ROTATION / margin)


@dataclass(frozen=True, eq=False)
class KnownMotion:
    """Motion of the object from earlier frames to a later one, by which background is recognized.

    Attributes:
        earlier: world_from_object of the earlier frames, by number.
        pose: world_from_object of the later frame, predicted or solved.
        radius: of the object.
    """

    earlier: Mapping[int, RigidTransform]
    pose: RigidTransform
    radius: float


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose, and its uncertainty.

    Attributes:
        world_from_object: the pose.
        covariance: (6, 6) of (w, d).
    """

    world_from_object: RigidTransform
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """Motion of the object, and whether it is in view.

    Attributes:
        velocity: motion model.
        has_moved: whether the object was ever observed to move against the static background.
        first_motion: number of a recent frame and its motion since the first one, while depth is known from boxes only.
        independent_pose: what is known of the current frame's pose without guessed depths, while depths are guessed.
        n_missed: frames since the last solved one.
        is_lost: whether the predicted pose is no longer usable.
        is_background_only: whether in the current frame only features that never moved agreed with a pose.
        hypothesis: world_from_object by which a missing object was relocalized, to be confirmed in the next frame.
        next_hypothesis: number of missed frames from which on the next one may be confirmed.
    """

    velocity: MotionModel = field(default_factory=MotionModel)
    has_moved: bool = False
    first_motion: tuple[int, RigidTransform] | None = None
    independent_pose: PoseEstimate | None = None
    n_missed: int = 0
    is_lost: bool = False
    is_background_only: bool = False
    hypothesis: RigidTransform | None = None
    next_hypothesis: int = 0


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
        covariance: (6, 6) covariance of (w, d) of the last jointly refined frame; before any, of the first motion that
            determined depth. It bounds the covariance of later frames from below, since they use the same landmarks. None
            while depth is guessed, and without refinements.
        last: the last frame at the most recent joint refinement, as it was then; None before.
        pending: the joint refinement in progress.
        shared: per camera, the observations it has shared of the known frames. Empty before the first refinement; after
            a reset they are sent again.
        rests_on_prior: whether the prior on the object's shape alone determines the length of the last refined frame's
            translation.
    """

    covariance: FloatArray | None = None
    last: SolvedFrame | None = None
    pending: PendingRefinement | None = None
    shared: tuple[NewObservations, ...] = ()
    rests_on_prior: bool = False


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
        ambiguity: why another body might be the object; empty if it is certain.
        f_ratios: the last known F ratios (`camera_evidence`).
        n_new_f_ratios: number of those since the object was last found again.
        is_unreliable: whether the status of the last pose is one of `DOUBTFUL`.
    """

    object: ObjectModel = field(default_factory=ObjectModel)
    frames: KnownFrames = field(default_factory=KnownFrames)
    motion: ObjectMotion = field(default_factory=ObjectMotion)
    refinement: Refinement = field(default_factory=Refinement)
    nudges: tuple[Nudge, ...] = ()
    is_feature_poor: bool = False
    ambiguity: str = ""
    f_ratios: tuple[float, ...] = ()
    n_new_f_ratios: int = 0
    is_unreliable: bool = False

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

    def motion_to(self, pose: RigidTransform) -> KnownMotion:
        """Return the object's motion from the known frames to a pose (world_from_object)."""
        earlier = {number: frame.world_from_object for number, frame in self.frames.by_number.items()}
        return KnownMotion(earlier, pose, self.object.radius)

    def is_motion_verified(self, agreements: Agreements) -> bool:
        """Return whether the object has been observed to move, in this frame at the latest.

        At least two cameras have to see it move, since something may pass in front of one.

        Args:
            agreements: per camera, how its matches agree with the frame's pose.
        """
        moved_counts = [a.n_moved for a in agreements if a.n_inlier_features >= MIN_MATCHES]
        n_cameras = sum(2 * moved >= MIN_MATCHES for moved in moved_counts)
        return self.motion.has_moved or (sum(moved_counts) >= MIN_MATCHES and n_cameras >= min(2, len(moved_counts)))

    def may_be_background(self, agreements: Agreements, min_ratio: float = MISMATCH_PROBABILITY) -> bool:
        """Return whether a pose may be the background's: almost none of its inliers ever moved.

        Always False before the object has moved: no other evidence exists then.

        Args:
            agreements: per camera, how its matches agree with the pose.
            min_ratio: smallest share of inlier features that must have moved.
        """
        moved, features = sum(a.n_moved for a in agreements), sum(a.n_inlier_features for a in agreements)
        return self.motion.has_moved and moved < max(MIN_MATCHES, min_ratio * features)

    # --- the next state -----------------------------------------------------------------------------------------------

    def add_solved_frame(
        self,
        solved: SolvedFrame,
        motion: RigidTransform,
        options: TrackingOptions,
        *,
        has_new_features: bool,
        agreements: Agreements = (),
    ) -> JointState:
        """Return the state after a solved frame.

        Args:
            solved: the frame.
            motion: of the object since the last solved frame.
            options: limits and sizes.
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
            is_poor = strong < options.min_strong_inliers * len(agreements)
        return replace(
            self,
            frames=self.frames.add(solved, options, has_new_features=has_new_features),
            motion=ObjectMotion(velocity, has_moved, self.motion.first_motion),
            is_feature_poor=is_poor,
        )

    def coast(self, time: float, options: TrackingOptions) -> tuple[JointState, FloatArray]:
        """Return the state after a frame in which the object was not found.

        The object is assumed to continue at constant velocity, while its rotation is certain and its position is within
        its radius.

        Returns:
            the state; the covariance (6, 6) of (w, d) of the predicted pose.
        """
        n_missed = self.motion.n_missed + 1
        covariance = self.last.covariance + self.motion.velocity.predict_covariance(time - self.last.time, n_missed)
        sd = np.sqrt(np.diag(covariance))
        is_certain = sd[:3].max() < MAX_ROTATION_SD and sd[3:].max() < self.object.radius
        is_lost = self.motion.is_lost or n_missed > options.max_coasting_frames or not is_certain
        motion = replace(
            self.motion, n_missed=n_missed, is_lost=is_lost, is_background_only=False, independent_pose=None
        )
        return replace(self, motion=motion, frames=replace(self.frames, next_anchor_number=None)), covariance

    def reset_to_first_frame(self, radius: float, covariance: FloatArray | None) -> JointState:
        """Return the state once the object's size is known from its motion.

        Landmark depths guessed from boxes are discarded, and with them all poses but the first frame's.

        Args:
            covariance: (6, 6) of (w, d) of the pose by the motion that determines depth until a refinement; None without
                refinements.
        """
        first, anchor = replace(self.frames.first, landmark_age=1.0), self.frames.anchor
        keeps_anchor = anchor is not None and anchor.frame.number == first.number
        return replace(
            self,
            object=replace(self.object, radius=radius, is_depth_guessed=False),
            frames=KnownFrames(
                first, (first,), anchor=Anchor(first, anchor.age) if keeps_anchor and anchor is not None else None
            ),
            refinement=Refinement(covariance, rests_on_prior=self.refinement.rests_on_prior),
            f_ratios=(),  # those contradicted the guess, not the rig
            n_new_f_ratios=0,
            is_unreliable=False,
        )

    # --- joint refinement ---------------------------------------------------------------------------------------------

    def is_refinement_due(self, options: TrackingOptions) -> bool:
        """Return whether the last solved frame is to be refined with others.

        The first frames always are; later ones are after enough new motion.
        """
        last, before = self.last, self.refinement.last
        if self.refinement.pending is not None:
            return False
        if before is None or last.number - self.frames.first.number <= options.n_recent_frames + 1:
            return True
        change = compute_pose_change(before.world_from_object, last.world_from_object)
        since = last.number - before.number
        is_new = np.linalg.norm(change[:3]) > options.min_refinement_rotation
        return since >= MAX_INTERVAL or (since >= MIN_INTERVAL and bool(is_new))

    def is_refinement_ready(self, number: int, *, is_live: bool) -> bool:
        """Return whether a background refinement is to be applied in the frame with this number.

        Live it is as soon as it is known, otherwise always in the same frame.
        """
        pending = self.refinement.pending
        if pending is None:
            return False
        return pending.result.is_known() if is_live else number >= pending.number + RESULT_DELAY


def is_mostly_moving(agreements: Agreements) -> bool:
    """Return whether most of what one camera sees in its box moves, unlike with a person passing behind the object."""
    return any(a.n_moved >= MIN_MATCHES and 2 * a.n_moved > a.n_matches for a in agreements)


def compute_pose_change(before: RigidTransform, after: RigidTransform) -> FloatArray:
    """Return the change (6,) (w, d) of a pose."""
    return np.concatenate([relative_rotvec(before, after), after.translation - before.translation])


def is_change_explained(change: FloatArray, covariance: FloatArray, radius: float) -> bool:
    """Return whether the uncertainty of a pose explains its change by a refinement.

    A refinement weighs more observations together. If its model is right, and the pose unbiased, the change is no more
    uncertain than the pose.

    Args:
        change: (6,) (w, d).
        covariance: (6, 6) of (w, d) before the change; singular along exact directions.
        radius: of the object.

    Source: J. A. Hausman, Econometrica 46, 1978.
    """
    scales = np.repeat([1.0, 1.0 / radius], 3)
    difference = covariance - np.outer(change, change) / MAX_CHANGE
    # Positive semidefinite if and only if change' covariance^-1 change is at most the limit.
    return bool(np.linalg.eigvalsh(scales[:, None] * difference * scales)[0] >= 0.0)


def bound_information(radius: float) -> FloatArray:
    """Return the information (6, 6) of (w, d) that bounds unobservable directions, for an object of a radius.

    Matches never span half a turn or the object's size.
    """
    return np.diag(np.repeat([np.pi**-2, radius**-2], 3))


def add_reference_covariance(
    information: FloatArray,
    world_from_object: RigidTransform,
    agreements: Agreements,
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
    own = invert_information(information + bound_information(radius))
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
