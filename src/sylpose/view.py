"""Motions and poses expressed in the axes of a camera, which may be virtual.

All cameras share one rotation; each has a different view of it. With X_c = Q X + q and the camera's center o = -Q'q,
the motion X_j = R X_i + t is, in the camera's axes,

    R_c = Q R Q',   t_c = Q (t + (R - I) o),

and its error (w, d) becomes (Q w, Q d): the uncertainty rotates with the axes and does not grow.

Source: docs/method/1-notation.md; Chen & Schonfeld (2010) give each camera the common rotation in its axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.display import Printable
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import invert_information, propagate_covariance
from sylpose.geometry.validation import check_finite, check_real, check_rotation, check_type, format_value
from sylpose.input_limits import to_one_line
from sylpose.results import FramePose, Motion, RotationEstimate, Trajectory, pan_tilt_roll
from sylpose.rig import Camera, Rig, check_single_pose
from sylpose.status import Status

# A camera (real, or a virtual one made by `rig.make_look_at_camera`), a bare camera_from_world, or a camera's name in a
# rig.
Viewpoint: TypeAlias = Camera | RigidTransform | str


@dataclass(frozen=True, eq=False, repr=False)
class MotionView(Printable):
    """Motion of the object in one camera's axes (x right, y down, z forward).

    Attributes:
        status: of the viewed motion.
        camera_from_world: of the camera.
        motion: maps camera points on the object from frame i to frame j, X_j = R X_i + t; None if the viewed motion is.
        center: (3,) the object's center at frame i, in the camera's axes.
        information: (6, 6) of (w, d): R = exp(w) R̂, d the translation of `center`, both in the camera's axes.
        covariance: (6, 6) its inverse; infinite variance along axes with an unobservable component.
        unobservable: (k, 6) directions of (w, d) that the matches of the rig do not constrain.
    """

    status: Status
    camera_from_world: RigidTransform
    motion: RigidTransform | None
    center: FloatArray
    information: FloatArray
    covariance: FloatArray
    unobservable: FloatArray

    @property
    def pan_tilt_roll(self) -> FloatArray:
        """(3,) radians of the rotation in the camera's axes, R = R_y(pan) R_x(tilt) R_z(roll); NaN without a motion."""
        return np.full(3, np.nan) if self.motion is None else pan_tilt_roll(self.motion.rotation)

    @property
    def center_translation(self) -> FloatArray:
        """(3,) translation of the object's center: right, down, away from the camera; NaN without a motion."""
        return np.full(3, np.nan) if self.motion is None else np.asarray(self.motion.apply(self.center) - self.center)

    @property
    def sigma(self) -> FloatArray:
        """(6,) standard deviations: rotation about the camera's x, y, z (radians), then translation of the center."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True, eq=False, repr=False)
class RotationView(RotationEstimate):
    """Estimate of the object's rotation in one camera's axes, R_c = Q R Q'.

    Attributes:
        camera_from_world: of the camera; only its rotation is used.
    """

    camera_from_world: RigidTransform

    @property
    def pan_tilt_roll(self) -> FloatArray:
        """(3,) radians, R_c = R_y(pan) R_x(tilt) R_z(roll); NaN without an answer."""
        found = np.isfinite(self.rotation).all()
        return pan_tilt_roll(Rotation.from_matrix(self.rotation)) if found else np.full(3, np.nan)


def view_of_motion(motion: Motion, camera: Viewpoint, *, rig: Rig | None = None) -> MotionView:
    """Express the motion between two frames, with its uncertainty, in a camera's axes.

    Args:
        motion: from `estimate_motion` (not from `estimate_pose`, whose motion starts in the model's frame).
        camera: the camera; a name is looked up in `rig`.
        rig: required for a name only.

    Raises:
        ValueError: a name without a rig or not in the rig; a transform that is not a single finite one.
    """
    check_type(motion, Motion, "motion")
    check_finite(motion.information, (6, 6), "motion.information", maximum=np.inf)
    center = check_real(motion.center, "(3,)", "motion.center")  # NaN without matches
    unobservable = check_finite(motion.unobservable, ("k", 6), "motion.unobservable", maximum=np.inf)
    if center.shape != (3,) or (motion.motion is not None and not np.isfinite(center).all()):
        raise ValueError(f"motion.center must be (3,), finite where there is a motion; got shape {center.shape}")
    if motion.motion is not None:
        check_single_pose(motion.motion, "motion.motion")
    if not isinstance(motion.status, Status) or (motion.motion is None and motion.status.has_pose):
        raise ValueError(f"motion: status {format_value(motion.status)} requires a motion")
    pose = resolve_viewpoint(camera, rig)
    axes_rotation = _block_rotation(pose)
    information = axes_rotation @ motion.information @ axes_rotation.T
    return MotionView(
        status=motion.status,
        camera_from_world=pose,
        motion=None if motion.motion is None else pose * motion.motion * pose.inv(),
        center=np.asarray(pose.apply(center)),
        information=information,
        covariance=invert_information(information),
        unobservable=unobservable @ axes_rotation.T,
    )


def view_of_rotation(estimate: RotationEstimate, camera: Viewpoint, *, rig: Rig | None = None) -> RotationView:
    """Express a rotation estimate in a camera's axes.

    Args:
        estimate: from an estimator without translation, such as `solve_centralized`, or another `RotationEstimate`.
        camera, rig: as in `view_of_motion`.

    Raises:
        ValueError: as `view_of_motion`; a matrix that is neither a rotation nor NaN; an information matrix that is not
            (3, 3) and finite.
    """
    check_type(estimate, RotationEstimate, "estimate")
    R = check_real(estimate.rotation, "(3, 3)", "estimate.rotation")
    if R.shape != (3, 3) or not np.isnan(R).all():
        R = check_rotation(R, "estimate.rotation")
    information = check_finite(estimate.information, (3, 3), "estimate.information", maximum=np.inf)
    unobservable = check_finite(estimate.unobservable, ("k", 3), "estimate.unobservable", maximum=np.inf)
    if not isinstance(estimate.status, Status) or (np.isnan(R).any() and estimate.status.has_pose):
        raise ValueError(f"estimate: status {format_value(estimate.status)} requires a rotation")
    pose = resolve_viewpoint(camera, rig)
    Q = pose.rotation.as_matrix()
    return RotationView(
        status=estimate.status,
        rotation=Q @ R @ Q.T,
        information=Q @ information @ Q.T,
        unobservable=unobservable @ Q.T,
        iterations=estimate.iterations,
        camera_from_world=pose,
    )


def view_of_pose(pose: FramePose, camera: Viewpoint, *, rig: Rig | None = None) -> FramePose:
    """Express the pose in one frame in a camera's axes: camera_from_world · world_from_object.

    The object frame is unchanged: pan, tilt and roll are not 0 in the first frame unless the camera is parallel to the
    world. `trajectory_view` rotates the object's axes as well.

    Args:
        pose: of a trajectory.
        camera, rig: as in `view_of_motion`.

    Raises:
        ValueError: as `view_of_motion`.
    """
    _check_pose(check_type(pose, FramePose, "pose"), "pose")
    camera_from_world = resolve_viewpoint(camera, rig)
    return _transform_pose(pose, camera_from_world, _block_rotation(camera_from_world), RigidTransform.identity())


def trajectory_view(trajectory: Trajectory, camera: Viewpoint, *, rig: Rig | None = None) -> Trajectory:
    """Express a trajectory with the camera's frame as the world.

    `world_from_object` becomes camera_from_object.

    The object's axes are parallel to the new world's in the first frame, so they are rotated as well: an orientation of
    zero stays zero, and pan, tilt and roll are about the camera's axes.

    Args:
        trajectory: in the world frame of `camera`.
        camera, rig: as in `view_of_motion`.

    Raises:
        ValueError: as `view_of_motion`.
    """
    for k, pose in enumerate(check_type(trajectory, Trajectory, "trajectory")):
        _check_pose(pose, f"trajectory[{k}]")
    camera_from_world = resolve_viewpoint(camera, rig)
    axes_rotation = _block_rotation(camera_from_world)
    axes = RigidTransform.from_rotation(camera_from_world.rotation.inv())
    frames = [_transform_pose(pose, camera_from_world, axes_rotation, axes) for pose in trajectory]
    return Trajectory(frames, trajectory.camera_names, trajectory.unit)


def resolve_viewpoint(camera: Viewpoint, rig: Rig | None = None) -> RigidTransform:
    """Return the pose of a viewpoint: a camera, a bare camera_from_world, or a camera's name in a rig.

    Raises:
        ValueError: a name without a rig or not in the rig; a transform that is not a single finite one.
    """
    if isinstance(camera, Camera):
        return camera.camera_from_world
    if isinstance(camera, str):
        if rig is None:
            raise ValueError(f"camera {format_value(camera)} is given by name, which requires a rig")
        if camera not in check_type(rig, Rig, "rig").names:
            raise ValueError(f"camera: no {format_value(camera)} in the rig ({to_one_line(', '.join(rig.names), 200)})")
        return rig[camera].camera_from_world
    if not isinstance(camera, RigidTransform):
        raise TypeError(f"camera must be a Camera, a RigidTransform or a camera's name, got {format_value(camera)}")
    return check_single_pose(camera, "camera: camera_from_world")


def _check_pose(pose: FramePose, name: str) -> None:
    if pose.world_from_object is not None:
        check_single_pose(pose.world_from_object, f"{name}: world_from_object")
    covariance = check_real(pose.covariance, "(6, 6)", f"{name}: covariance")
    if covariance.shape != (6, 6) or not np.isfinite(covariance[~np.eye(6, dtype=bool)]).all():
        raise ValueError(f"{name}: covariance must be (6, 6), finite off its diagonal; got shape {covariance.shape}")
    if not (np.diag(covariance) >= 0).all():
        raise ValueError(f"{name}: covariance has a variance that is negative or NaN")


def _transform_pose(
    pose: FramePose, camera_from_world: RigidTransform, axes_rotation: FloatArray, axes: RigidTransform
) -> FramePose:
    """Express a pose in a camera's axes, with the object frame changed by `axes`, object_from_its_new_frame."""
    viewed_pose = None if pose.world_from_object is None else camera_from_world * pose.world_from_object * axes
    return replace(pose, world_from_object=viewed_pose, covariance=propagate_covariance(pose.covariance, axes_rotation))


def _block_rotation(camera_from_world: RigidTransform) -> FloatArray:
    """Return the (6, 6) matrix that rotates (w, d) from the world's axes to the camera's."""
    Q = camera_from_world.rotation.as_matrix()
    return np.asarray(block_diag(Q, Q))
