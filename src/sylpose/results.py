"""Results of the estimators: frozen records, each with a status and its text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.display import Printable
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import invert_information, propagate_covariance
from sylpose.geometry.validation import check_list, check_type
from sylpose.kinematics import Kinematics, estimate_kinematics, fill_frames
from sylpose.rig import check_single_pose
from sylpose.status import DOUBTFUL, PREDICTED, FrameStatus, Observability, Status

# A pose whose rotation has a larger standard deviation about any axis, in radians, is uncertain (choice).
MAX_ROTATION_SD = 0.35


@dataclass(frozen=True, eq=False, repr=False)
class Motion(Printable):
    """Motion of the object between two frames, with its uncertainty.

    Attributes:
        status: outcome; see `Status`.
        motion: maps world points on the object from frame i to frame j, X_j = R X_i + t. None without
            `status.has_pose`, with these exceptions: for a rotation that is not observable, the part in `unobservable`
            is meaningless; for AMBIGUOUS and MIXED it is the best guess.
        center: (3,) the object's center at frame i, world frame; `information` refers to its translation.
        information: (6, 6) of (w, d): R = exp(w) R̂, d the translation of `center` (docs/conventions.md).
        covariance: (6, 6) its inverse; infinite variance along unobservable directions.
        unobservable: (k, 6) directions of (w, d) that the matches do not constrain and that the status refers to; empty
            when all six are observable. If it is not empty, `information` comes from the matches alone; otherwise it
            includes the priors on the object's position and shape.
        inliers: per camera, a mask over its matches.
        residuals: (C,) rms epipolar residual of each camera's inliers, pixels; NaN without inliers.
        method: the estimator that was used.
        iterations: iterations of the solver.
        faults: one sentence per camera identified as faulty: its calibration, its matches or its image. Or one on what all
            of them may have wrong; for `estimate_pose` also one for model points of a different size.
        alternative: for AMBIGUOUS, the other motion that explains the matches, or as many of them, about as well; else
            None.
        second_body_ratio: number of matches of a second body with a different motion, divided by the number of this
            one; 0 without one.
        static_ratio: fraction of the matches that are static while the object moves by little.
        camera_names: (C,) names of the rig's cameras.
        unit: length unit of the rig, or "".
    """

    status: Status
    motion: RigidTransform | None
    center: FloatArray
    information: FloatArray
    covariance: FloatArray
    unobservable: FloatArray
    inliers: tuple[BoolArray, ...]
    residuals: FloatArray
    method: str
    iterations: int
    faults: tuple[str, ...] = ()
    alternative: RigidTransform | None = None
    second_body_ratio: float = 0.0
    static_ratio: float = 0.0
    camera_names: tuple[str, ...] = ()
    unit: str = ""

    @property
    def rotation(self) -> Rotation | None:
        """Rotation of `motion`; None without a motion."""
        return None if self.motion is None else self.motion.rotation

    @property
    def translation(self) -> FloatArray | None:
        """(3,) translation d of `center`, to which `covariance` refers: R c + t - c; None without a motion."""
        return None if self.motion is None else np.asarray(self.motion.apply(self.center) - self.center)

    @property
    def n_inliers(self) -> IntArray:
        """(C,) number of inliers per camera."""
        return np.array([int(mask.sum()) for mask in self.inliers], dtype=np.int64)

    @property
    def inlier_ratio(self) -> float:
        """Fraction of the matches of all cameras that are inliers; NaN without matches."""
        matches = sum(len(mask) for mask in self.inliers)
        return float(self.n_inliers.sum() / matches) if matches else np.nan


@dataclass(frozen=True, eq=False, repr=False)
class RotationEstimate(Printable):
    """Rotation with its uncertainty: base class of the paper's estimators' results.

    Attributes:
        status: outcome; check it first.
        rotation: (3, 3) R, X_j = R X_i + t in the world frame; the best guess where part of the rotation is not
            observable, NaN without an answer.
        information: (3, 3) of w, R = exp(w) R̂, world axes, 1/rad². It is small along unobservable directions. For
            estimators that ignore depth it includes the depth bias (`sylvester.depth_bias`). Zero without an answer.
        unobservable: (k, 3) unit directions of w that are not observable (docs/conventions.md, "Limits").
        iterations: iterations of the solver, or communication rounds of distributed estimators.
    """

    status: Status
    rotation: FloatArray
    information: FloatArray
    unobservable: FloatArray
    iterations: int

    @property
    def covariance(self) -> FloatArray:
        """(3, 3) inverse of `information`; infinite variance on axes that share an unobservable direction."""
        return invert_information(self.information)


def pan_tilt_roll(rotation: Rotation) -> FloatArray:
    """Return (3,) pan, tilt and roll, radians: R = R_y(pan) R_x(tilt) R_z(roll) (docs/conventions.md)."""
    return np.asarray(check_type(rotation, Rotation, "rotation").as_euler("YXZ", suppress_warnings=True))


@dataclass(frozen=True, eq=False, repr=False)
class FramePose(Printable):
    """The object's pose in one frame.

    Attributes:
        index: frame number in the recording.
        time: seconds, or the frame number for image folders without time stamps.
        status: outcome of the frame; when `not status.has_pose`, `world_from_object` is None.
        world_from_object: the pose.
        covariance: (6, 6) of (w, d), docs/conventions.md; zero in the first frame, whose pose is the definition.
        inliers: (C,) number of matches used per camera.
        residuals: (C,) rms residual of the inliers per camera, pixels; NaN without inliers.
        observability: which part of the pose is observable.
        variance_inflation: (C,) variance inflation factor per camera; 1 if it agrees with the others, inf if almost
            none of its matches are inliers, NaN if unknown.
        f_ratio: F ratio of the cameras, pooled over the last frames: about 1 if they agree; NaN if unknown. Above 1 the
            covariance is multiplied by it.
        faults: one sentence per camera identified as faulty.
        matches: (C,) number of features per camera that match the object model, inliers included; empty if unknown.
        reason: why there is no pose, or no measured one; "" where there is one.
    """

    index: int
    time: float
    status: FrameStatus
    world_from_object: RigidTransform | None
    covariance: FloatArray
    inliers: IntArray
    residuals: FloatArray
    observability: Observability = Observability.ALL
    variance_inflation: FloatArray = field(default_factory=lambda: np.empty(0))
    faults: tuple[str, ...] = ()
    matches: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    reason: str = ""
    f_ratio: float = np.nan

    @property
    def is_measured(self) -> bool:
        """Whether the images determine the pose; False for predicted or doubtful ones."""
        return self.world_from_object is not None and self.status not in (*PREDICTED, *DOUBTFUL)

    @property
    def is_observed(self) -> bool:
        """Whether the object was found in this frame's images, even if its pose is not reliable."""
        return self.is_measured or self.status in DOUBTFUL

    def mark_uncertain(self) -> Self:
        """Return the pose with status `UNCERTAIN` if its rotation's covariance is too large; a status never rises.

        Poses without the object in the images, and the first one, are returned unchanged.
        """
        if not self.is_observed or self.status in (FrameStatus.FIRST, FrameStatus.CONTRADICTED, FrameStatus.AMBIGUOUS):
            return self
        rotation_covariance = self.covariance[:3, :3]
        if (
            not np.isfinite(rotation_covariance).all()
            or np.linalg.eigvalsh(rotation_covariance)[-1] > MAX_ROTATION_SD**2
        ):
            return replace(self, status=FrameStatus.UNCERTAIN)
        return self

    def in_object_frame(self, new_from_object: RigidTransform) -> Self:
        """Return the pose of the object in another object frame, with other axes and another origin.

        Args:
            new_from_object: maps points of the present object frame to the new one.

        Raises:
            TypeError, ValueError: not a single transform of finite values.
        """
        new_from_object = check_single_pose(new_from_object, "new_from_object")
        old_pose = self.world_from_object
        if old_pose is None:
            return self
        new_pose = old_pose * new_from_object.inv()
        # A rotation error also translates an origin that is elsewhere: d + w x r.
        jacobian, (x, y, z) = np.eye(6), new_pose.translation - old_pose.translation
        jacobian[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        return replace(self, world_from_object=new_pose, covariance=propagate_covariance(self.covariance, jacobian))

    @property
    def sigma(self) -> FloatArray:
        """(6,) standard deviations: rotation about the world's x, y, z (radians), then position x, y, z."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def pan_tilt_roll(self) -> FloatArray:
        """(3,) radians, R = R_y(pan) R_x(tilt) R_z(roll) (docs/conventions.md); NaN without a pose."""
        if self.world_from_object is None:
            return np.full(3, np.nan)
        return pan_tilt_roll(self.world_from_object.rotation)

    @property
    def position(self) -> FloatArray:
        """(3,) the object's center in the world; NaN without a pose."""
        if self.world_from_object is None:
            return np.full(3, np.nan)
        return np.asarray(self.world_from_object.translation)


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Printable):
    """The object's pose in every frame of a recording: a sequence of `FramePose`.

    Attributes:
        frames: in order of time; frames without a pose are included, with their status.
        camera_names: (C,) names that the per-camera values refer to.
        unit: the calibration's length unit, or "".
    """

    frames: tuple[FramePose, ...]
    camera_names: tuple[str, ...]
    unit: str = ""

    def __init__(self, frames: Sequence[FramePose], camera_names: Sequence[str], unit: str = "") -> None:
        object.__setattr__(self, "frames", tuple(check_list(frames, FramePose, "frames")))
        object.__setattr__(self, "camera_names", tuple(check_list(camera_names, str, "camera_names")))
        object.__setattr__(self, "unit", check_type(unit, str, "unit"))

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[FramePose]:
        return iter(self.frames)

    def __getitem__(self, i: int) -> FramePose:
        return self.frames[i]

    @property
    def times(self) -> FloatArray:
        """(N,) times of all frames."""
        return np.array([f.time for f in self.frames])

    @property
    def measured_mask(self) -> BoolArray:
        """(N,) mask of the frames with a measured pose."""
        return np.array([f.is_measured for f in self.frames], dtype=bool)

    @property
    def positions(self) -> FloatArray:
        """(N, 3) the object's center in the world; NaN rows where there is no pose."""
        return np.array([f.position for f in self.frames]).reshape(-1, 3)

    def differentiate(self) -> Kinematics:
        """Estimate velocities and accelerations in every frame, with standard deviations (`sylpose.kinematics`).

        Frames without a measured pose are not used, and have NaN rows.

        Raises:
            ValueError: too few measured poses; times that do not increase.
        """
        mask = self.measured_mask
        frames = [frame for frame, is_measured in zip(self.frames, mask, strict=True) if is_measured]
        matrices = np.array([f.world_from_object.as_matrix() for f in frames if f.world_from_object is not None])
        poses = RigidTransform.from_matrix(matrices.reshape(-1, 4, 4))
        covariance = np.array([frame.covariance for frame in frames]).reshape(-1, 6, 6)
        counts = np.array([frame.inliers.sum() for frame in frames], float)
        return fill_frames(estimate_kinematics(self.times[mask], poses, covariance, counts), mask)

    @property
    def rotation_angles(self) -> FloatArray:
        """(N,) rotation angle since the first frame with a pose, radians in [0, pi]; NaN where there is no pose."""
        angles = np.full(len(self), np.nan)
        rows = [k for k, frame in enumerate(self.frames) if frame.world_from_object is not None]
        poses = [pose for frame in self.frames if (pose := frame.world_from_object) is not None]
        if poses:
            rotations = Rotation.from_quat([pose.rotation.as_quat() for pose in poses])
            angles[rows] = (rotations * poses[0].rotation.inv()).magnitude()
        return angles
