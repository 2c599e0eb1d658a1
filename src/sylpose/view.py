"""What a camera sees of a motion, also one that sees nothing of the object, or one that does not exist.

All cameras share one rotation; each has its own view of it. With X_c = Q X + q and the camera's centre o = -Q'q, the motion
X_j = R X_i + t is, in the camera's axes,

    R_c = Q R Q',   t_c = Q (t + (R - I) o),

and an error (w, d) of it is (Q w, Q d): the uncertainty turns with the axes and does not grow.

Source: method.md, section 1; Chen & Schonfeld (2010) give each camera the common rotation in its own axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.display import Telling, Told, spread, turned
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import carried, checked_rotation, covariance_of
from sylpose.geometry.validation import finite, kind_of, real, shown
from sylpose.input_limits import one_line
from sylpose.results import FramePose, Motion, RotationEstimate, Status, Trajectory, pan_tilt_roll
from sylpose.rig import Camera, Rig, single_pose

__all__ = [
    "MotionView",
    "RotationView",
    "Viewpoint",
    "camera_from_world_of",
    "trajectory_view",
    "view_of_motion",
    "view_of_pose",
    "view_of_rotation",
]


# A camera (real, or a virtual one as `rig.camera_at` makes), a bare camera_from_world, or a camera's name in a rig.
Viewpoint: TypeAlias = Camera | RigidTransform | str


@dataclass(frozen=True, eq=False, repr=False)
class MotionView(Told):
    """The object's motion between two frames in one camera's axes (x right, y down, z forward).

    Attributes:
        status: of the motion that is viewed.
        camera_from_world: of the camera.
        motion: camera points on the object at frame i -> at frame j, X_j = R X_i + t; None where the motion is.
        center: (3,) the object's centre at frame i, the camera's axes.
        information: (6, 6) of (w, d): R = exp(w) R̂, d the displacement of `center`, both in the camera's axes.
        covariance: (6, 6) its inverse; infinite variance along axes in which something is not known.
        unseen: (k, 6) directions of (w, d) that the matches of the rig leave open.
    """

    status: Status
    camera_from_world: RigidTransform
    motion: RigidTransform | None
    center: FloatArray
    information: FloatArray
    covariance: FloatArray
    unseen: FloatArray

    @property
    def pan_tilt_roll(self) -> FloatArray:
        """(3,) radians of the turn as the camera has it, R = R_y(pan) R_x(tilt) R_z(roll); NaN without a motion."""
        return np.full(3, np.nan) if self.motion is None else pan_tilt_roll(self.motion.rotation)

    @property
    def displacement(self) -> FloatArray:
        """(3,) of the object's centre: right, down, away from the camera; NaN without a motion."""
        return np.full(3, np.nan) if self.motion is None else np.asarray(self.motion.apply(self.center) - self.center)

    @property
    def sigma(self) -> FloatArray:
        """(6,) standard deviations: the turn about the camera's x, y, z (radians), then the displacement."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def _told(self) -> Telling:
        status = f"{self.status.value}. {self.status.text}"
        if self.motion is None:
            return Telling(self.status.value, sentence=status)
        rows = [
            ("turned", turned(self.motion.rotation, self.covariance[:3, :3])),
            ("right, down, away", spread(self.displacement, self.sigma[3:])),
        ]
        return Telling(f"{self.status.value}, turned {turned(self.motion.rotation)}", rows, status)


@dataclass(frozen=True, eq=False, repr=False)
class RotationView(RotationEstimate):
    """An estimate of the object's rotation in one camera's axes: R_c = Q R Q', and so its information.

    Attributes:
        camera_from_world: of the camera; only its rotation matters.
    """

    camera_from_world: RigidTransform

    @property
    def pan_tilt_roll(self) -> FloatArray:
        """(3,) radians, R_c = R_y(pan) R_x(tilt) R_z(roll); NaN without an answer."""
        found = np.isfinite(self.rotation).all()
        return pan_tilt_roll(Rotation.from_matrix(self.rotation)) if found else np.full(3, np.nan)


def view_of_motion(motion: Motion, camera: Viewpoint, *, rig: Rig | None = None) -> MotionView:
    """The motion between two frames as a camera has it, with its uncertainty.

    Args:
        motion: of `estimate_motion` (not of `estimate_pose`, whose motion starts in the model's frame).
        camera: whose view; a name is looked up in `rig`.
        rig: needed for a name only.

    Raises:
        ValueError: a name without a rig or that the rig does not have; a transform that is no single finite one.
    """
    kind_of(motion, Motion, "motion")
    finite(motion.information, (6, 6), "motion.information", most=np.inf)
    center = real(motion.center, "(3,)", "motion.center")  # NaN without matches
    unseen = finite(motion.unseen, ("k", 6), "motion.unseen", most=np.inf)
    if center.shape != (3,) or (motion.motion is not None and not np.isfinite(center).all()):
        raise ValueError(f"motion.center must be (3,), finite where there is a motion; got shape {center.shape}")
    if motion.motion is not None:
        single_pose(motion.motion, "motion.motion")
    if not isinstance(motion.status, Status) or (motion.motion is None and motion.status.has_pose):
        raise ValueError(f"motion: a status {shown(motion.status)} without a motion is none of an estimator's")
    pose = camera_from_world_of(camera, rig)
    turn = _turn(pose)
    information = turn @ motion.information @ turn.T
    return MotionView(
        status=motion.status,
        camera_from_world=pose,
        motion=None if motion.motion is None else pose * motion.motion * pose.inv(),
        center=np.asarray(pose.apply(center)),
        information=information,
        covariance=covariance_of(information),
        unseen=unseen @ turn.T,
    )


def view_of_rotation(estimate: RotationEstimate, camera: Viewpoint, *, rig: Rig | None = None) -> RotationView:
    """A rotation as a camera has it: of the estimators that give no translation (`solve_centralized` and its kin).

    Args:
        estimate: of any of them; or a `RotationEstimate` of one's own.
        camera, rig: as in `view_of_motion`.

    Raises:
        ValueError: as `view_of_motion`; a matrix that is neither a rotation nor NaN, an information that is not (3, 3)
            and finite.
    """
    kind_of(estimate, RotationEstimate, "estimate")
    R = real(estimate.rotation, "(3, 3)", "estimate.rotation")
    if R.shape != (3, 3) or not np.isnan(R).all():
        R = checked_rotation(R, "estimate.rotation")
    information = finite(estimate.information, (3, 3), "estimate.information", most=np.inf)
    unseen = finite(estimate.unseen, ("k", 3), "estimate.unseen", most=np.inf)
    if not isinstance(estimate.status, Status) or (np.isnan(R).any() and estimate.status.has_pose):
        raise ValueError(f"estimate: a status {shown(estimate.status)} without a rotation is none of an estimator's")
    pose = camera_from_world_of(camera, rig)
    Q = pose.rotation.as_matrix()
    return RotationView(
        status=estimate.status,
        rotation=Q @ R @ Q.T,
        information=Q @ information @ Q.T,
        unseen=unseen @ Q.T,
        iterations=estimate.iterations,
        camera_from_world=pose,
    )


def view_of_pose(pose: FramePose, camera: Viewpoint, *, rig: Rig | None = None) -> FramePose:
    """The pose in one frame as a camera has it: `world_from_object` is then camera_from_world · world_from_object.

    The object's frame stays what it was: pan, tilt and roll are not 0 in the first frame unless the camera is parallel to
    the world. `trajectory_view` turns the object's axes as well.

    Args:
        pose: of a trajectory.
        camera, rig: as in `view_of_motion`.

    Raises:
        ValueError: as `view_of_motion`.
    """
    _check_pose(kind_of(pose, FramePose, "pose"), "pose")
    camera_from_world = camera_from_world_of(camera, rig)
    return _pose_from(pose, camera_from_world, _turn(camera_from_world), RigidTransform.identity())


def trajectory_view(trajectory: Trajectory, camera: Viewpoint, *, rig: Rig | None = None) -> Trajectory:
    """The trajectory as if the camera's frame were the world: `world_from_object` is then camera_from_object.

    As in the trajectory itself the object's axes are those of the frame that it is told in, so they are turned along: an
    orientation of zero, the first frame's, stays zero, and pan, tilt and roll are about the camera's own axes.

    Args:
        trajectory: in the world frame of `camera`.
        camera, rig: as in `view_of_motion`.

    Raises:
        ValueError: as `view_of_motion`.
    """
    for k, pose in enumerate(kind_of(trajectory, Trajectory, "trajectory")):
        _check_pose(pose, f"trajectory[{k}]")
    camera_from_world = camera_from_world_of(camera, rig)
    turn = _turn(camera_from_world)
    axes = RigidTransform.from_rotation(camera_from_world.rotation.inv())
    frames = [_pose_from(pose, camera_from_world, turn, axes) for pose in trajectory]
    return Trajectory(frames, trajectory.camera_names, trajectory.unit)


def camera_from_world_of(camera: Viewpoint, rig: Rig | None = None) -> RigidTransform:
    """The pose of a viewpoint: a camera, a bare camera_from_world, or a name that is looked up in a rig.

    Raises:
        ValueError: a name without a rig or that the rig does not have; a transform that is no single finite one.
    """
    if isinstance(camera, Camera):
        return camera.camera_from_world
    if isinstance(camera, str):
        if rig is None:
            raise ValueError(f"camera {shown(camera)} is given by its name, which takes a rig to look it up in")
        if camera not in kind_of(rig, Rig, "rig").names:
            raise ValueError(f"camera: no {shown(camera)} in the rig ({one_line(', '.join(rig.names), 200)})")
        return rig[camera].camera_from_world
    if not isinstance(camera, RigidTransform):
        raise TypeError(f"camera must be a Camera, a RigidTransform or a camera's name, got {shown(camera)}")
    return single_pose(camera, "camera: camera_from_world")


def _check_pose(pose: FramePose, name: str) -> None:
    if pose.world_from_object is not None:
        single_pose(pose.world_from_object, f"{name}: world_from_object")
    covariance = real(pose.covariance, "(6, 6)", f"{name}: covariance")
    if covariance.shape != (6, 6) or not np.isfinite(covariance[~np.eye(6, dtype=bool)]).all():
        raise ValueError(f"{name}: covariance must be (6, 6), finite beside its diagonal; got shape {covariance.shape}")
    if not (np.diag(covariance) >= 0).all():
        raise ValueError(f"{name}: covariance has a variance that is negative or NaN")


def _pose_from(pose: FramePose, camera_from_world: RigidTransform, turn: FloatArray, axes: RigidTransform) -> FramePose:
    """The pose seen from a camera, of an object whose own frame is changed by `axes`, object_from_its_new_frame."""
    seen = None if pose.world_from_object is None else camera_from_world * pose.world_from_object * axes
    return replace(pose, world_from_object=seen, covariance=carried(pose.covariance, turn))


def _turn(camera_from_world: RigidTransform) -> FloatArray:
    """(6, 6) what takes (w, d) from the world's axes to the camera's."""
    Q = camera_from_world.rotation.as_matrix()
    return np.asarray(block_diag(Q, Q))
