"""Motion of one object relative to another: poses with covariance, and helical axes of a joint.

H. J. Woltring, "Representation and calculation of 3-D joint movement", Human Movement Science 10 (1991), also for the
mean helical axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.comparison import associate_timestamps
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import propagate_covariance, transpose
from sylpose.results import FramePose, Trajectory
from sylpose.status import FrameStatus, Observability
from sylpose.units import METERS

# Step of finite differences, relative to a radian and to the path (choice: third root of rounding).
STEP = 1e-5
# A rotation about less than so many standard deviations has no helical axis (choice).
MIN_SIGNIFICANCE = 3.0
# Rotations below, radians, have none either; that of a half turn is not unique (choice: rounding).
MIN_ANGLE = 1e-6


@dataclass(frozen=True, eq=False)
class HelicalAxes:
    """Screws of n motions: rotation about an axis and translation along it, in the frame of the poses.

    Attributes:
        angle: (n,) radians in [0, pi].
        axis: (n, 3) unit vectors, with which the angle is positive; NaN where the angle is not significant.
        point: (n, 3) points on the axes nearest to the origin; NaN likewise.
        slide: (n,) translation along the axis; NaN likewise.
        angle_sd: (n,) standard deviation.
        axis_sd: (n,) standard deviation of the axis' direction, radians, rms over the two perpendicular to it.
        point_sd: (n,) of the point, rms over the two directions.
        slide_sd: (n,).
    """

    angle: FloatArray
    axis: FloatArray
    point: FloatArray
    slide: FloatArray
    angle_sd: FloatArray
    axis_sd: FloatArray
    point_sd: FloatArray
    slide_sd: FloatArray


def relate_trajectories(a: Trajectory, b: Trajectory, max_time_diff: float | None = None) -> Trajectory:
    """Compute the poses of object B in the frame of object A, a_from_b, at the times of B.

    The errors of A and B are taken as independent. Those that they share, such as the calibration's, cancel in part, so
    standard deviations are rather too large.

    Args:
        a, b: trajectories of the two objects in the same world.
        max_time_diff: largest time difference of corresponding poses; None for half of B's smallest step.

    Returns:
        a trajectory of the frames with a measured pose of both. Its world is the frame of A, its unit that of B.

    Raises:
        ValueError: units of which only one is known; no common frames.
    """
    if a.unit != b.unit and not {a.unit, b.unit} <= METERS.keys():
        units = [unit or "an unspecified unit" for unit in (a.unit, b.unit)]
        raise ValueError(f"A is in {units[0]} and B in {units[1]}: track both with the same calibration or --unit")
    scale = METERS[a.unit] / METERS[b.unit] if a.unit != b.unit else 1.0
    measured_a, measured_b = ([f for f in t if f.is_measured] for t in (a, b))
    if len(measured_b) < 2 or not measured_a:
        raise ValueError(f"A has {len(measured_a)} measured poses and B {len(measured_b)}: nothing to relate")
    times_a, times_b = (np.array([frame.time for frame in frames]) for frames in (measured_a, measured_b))
    rows = associate_timestamps(times_a, times_b, max_time_diff)
    frames = []
    for i, k in zip(*rows, strict=True):
        frames.append(_relate_poses(measured_a[i], measured_b[k], scale))
    if not frames:
        raise ValueError("A and B have no measured poses at common times; both must come from one recording")
    return Trajectory(frames, (), b.unit)


def _relate_poses(a: FramePose, b: FramePose, scale: float) -> FramePose:
    """Return the pose of B in the frame of A, whose lengths are multiplied by `scale`."""
    assert a.world_from_object is not None
    assert b.world_from_object is not None
    rotation, position = a.world_from_object.rotation, scale * a.world_from_object.translation
    world_from_a = RigidTransform.from_components(position, rotation)
    x, y, z = b.position - position
    # a_from_b = A⁻¹ B with exp(w) R and t + d: w = R_A' (w_B - w_A), d = R_A' (d_B - d_A + r x w_A).
    jacobian = np.zeros((6, 12))
    jacobian[:3, :3], jacobian[:3, 6:9] = -np.eye(3), np.eye(3)
    jacobian[3:, 3:6], jacobian[3:, 9:] = -scale * np.eye(3), np.eye(3)
    jacobian[3:, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    jacobian = np.kron(np.eye(2), rotation.as_matrix().T) @ jacobian
    covariance = np.zeros((12, 12))
    covariance[:6, :6], covariance[6:, 6:] = a.covariance, b.covariance
    padded = np.vstack([jacobian, np.zeros((6, 12))])
    worst = next((o for o in (b.observability, a.observability) if o is not Observability.ALL), Observability.ALL)
    return FramePose(
        b.index,
        b.time,
        FrameStatus.TRACKED if FrameStatus.FIRST in (a.status, b.status) else b.status,
        world_from_a.inv() * b.world_from_object,
        propagate_covariance(covariance, padded)[:6, :6],
        np.empty(0, np.int64),
        np.empty(0),
        worst,
    )


def compute_helical_axes(trajectory: Trajectory, reference: int = 0) -> HelicalAxes:
    """Compute the helical axes of the motions since a reference pose, with standard deviations.

    Args:
        trajectory: measured poses.
        reference: index of the reference in it.

    Raises:
        IndexError: no such pose.
    """
    poses = RigidTransform.concatenate([f.world_from_object for f in trajectory if f.world_from_object is not None])
    covariances = np.array([frame.covariance for frame in trajectory])
    start = poses[reference]
    extent = max(float(np.ptp(poses.translation, axis=0).max()), float(np.abs(poses.translation).max()), 1e-12)
    values = _compute_screws(poses * start.inv())
    # Derivatives by the errors of each pose, then by those of the reference.
    columns = []
    for disturbed in (lambda e: _disturb(poses, e) * start.inv(), lambda e: poses * _disturb(start, e).inv()):
        columns += [_differentiate(disturbed, axis, 1.0 if axis < 3 else extent) for axis in range(6)]
    jacobian = np.stack(columns, axis=2)
    covariance = np.zeros((len(values), 12, 12))
    covariance[:, :6, :6], covariance[:, 6:, 6:] = covariances, covariances[reference]
    # The motion of the reference itself has no error.
    covariance[reference] = 0.0
    sigma = np.array(
        [
            _propagate(c, j) if np.isfinite(j).all() else np.full(8, np.nan)
            for c, j in zip(covariance, jacobian, strict=True)
        ]
    )
    angle, angle_sd = values[:, 0], _angle_sd(poses * start.inv(), covariance)
    is_significant = (angle > MIN_ANGLE) & (angle > MIN_SIGNIFICANCE * angle_sd)
    angle_sd = np.where(is_significant, sigma[:, 0], angle_sd)
    values[~is_significant, 1:] = sigma[~is_significant] = np.nan
    axis_sd, point_sd = (np.sqrt((sigma[:, k : k + 3] ** 2).sum(axis=1) / 2.0) for k in (1, 4))
    return HelicalAxes(angle, values[:, 1:4], values[:, 4:7], values[:, 7], angle_sd, axis_sd, point_sd, sigma[:, 7])


def _compute_screws(motions: RigidTransform) -> FloatArray:
    """Return (n, 8) angle, axis, point nearest to the origin, and slide of motions; NaN axes of translations."""
    rotvecs, translations = motions.rotation.as_rotvec(), motions.translation
    angle = np.linalg.norm(rotvecs, axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        axis = np.where(angle > MIN_ANGLE, rotvecs / angle, np.nan)
        slide = (axis * translations).sum(axis=1, keepdims=True)
        across = translations - slide * axis
        point = 0.5 * (across + np.cross(axis, across) / np.tan(0.5 * angle))
    return np.hstack([angle, axis, point, slide])


def _disturb(poses: RigidTransform, error: FloatArray) -> RigidTransform:
    """Return poses with the error (w, d) of docs/conventions.md."""
    return RigidTransform.from_components(
        poses.translation + error[3:], Rotation.from_rotvec(error[:3]) * poses.rotation
    )


def _differentiate(disturbed: Callable[[FloatArray], RigidTransform], axis: int, size: float) -> FloatArray:
    """Return (n, 8) derivatives of the screws of disturbed motions by component `axis` of the error."""
    error = STEP * size * np.eye(6)[axis]
    after, before = (_compute_screws(disturbed(sign * error)) for sign in (1.0, -1.0))
    return (after - before) / (2.0 * STEP * size)


def _propagate(covariance: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return standard deviations (8,), infinite where a variance is."""
    padded = np.vstack([jacobian, np.zeros((4, 12))])
    return np.asarray(np.sqrt(np.maximum(np.diag(propagate_covariance(covariance, padded))[:8], 0.0)))


def _angle_sd(motions: RigidTransform, covariance: FloatArray) -> FloatArray:
    """Return (n,) the standard deviation of the rotation's components, rms, which small angles have as well."""
    rotation = motions.rotation.as_matrix()
    total = covariance[:, :3, :3] + rotation @ covariance[:, 6:9, 6:9] @ transpose(rotation)
    return np.asarray(np.sqrt(np.trace(total, axis1=1, axis2=2) / 3.0))


def fit_mean_axis(axes: HelicalAxes) -> tuple[FloatArray, FloatArray] | None:
    """Fit the mean helical axis, as of a hinge: unit vector (3,) and the point (3,) nearest to the origin.

    Axes are weighted by sin²(angle / 2). None without any axis.
    """
    found = np.isfinite(axes.axis).all(axis=1) & np.isfinite(axes.point).all(axis=1)
    if not found.any():
        return None
    weights, n = np.sin(0.5 * axes.angle[found]) ** 2, axes.axis[found]
    direction = np.linalg.eigh(np.einsum("k,ki,kj->ij", weights, n, n))[1][:, 2]
    largest = n[np.argmax(axes.angle[found])]
    direction = direction if direction @ largest > 0 else -direction
    across = np.einsum("k,kij->ij", weights, np.eye(3) - n[:, :, None] * n[:, None])
    # Along parallel axes the point is not determined: the pseudo-inverse takes the nearest one.
    towards = np.einsum("k,kij,kj->i", weights, np.eye(3) - n[:, :, None] * n[:, None], axes.point[found])
    point = np.linalg.pinv(across, rcond=1e-9) @ towards
    return direction, point - (point @ direction) * direction
