"""Hand-eye calibration: where a robot's base and flange are in the frames of the tracker.

A tracked object is mounted on the robot's flange, world_from_object_k = X base_from_flange_k Y, or the rig is, with the
inverse of the robot's poses. X and Y are solved linearly from relative motions, A X = X B (`sylvester.hand_eye`), then
by least squares weighted with the covariances of the tracked poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from sylpose.comparison import associate_timestamps
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.sylvester.hand_eye import (
    MIN_AXIS_SPREAD,
    RELATIVE_ANGLE_TOLERANCE,
    measure_axis_spread,
    select_pairs,
    solve_hand_eye_rotation,
    solve_hand_eye_translations,
)

# Fewer poses leave no redundancy (choice).
MIN_POSES = 4
# Rotations of the robot below, radians, are none (choice: 5 degrees).
MIN_ROTATION = np.radians(5.0)
# Rotation angles of robot and object differ by more than this and `RELATIVE_ANGLE_TOLERANCE` in failures: radians, and
# the fraction of pairs (choice).
ANGLE_TOLERANCE, MAX_DIFFERENT = np.radians(2.0), 0.5
# Squared residuals that fit so many times better with inverse robot poses show that these are meant (choice).
INVERSE_RATIO = 0.05
# Whitened residuals above so many standard deviations count linearly (choice).
HUBER_CUTOFF = 3.0
# Squared distance of six components above which a pose was tracked wrongly, and its median (chi-squared, probability of
# 0.001).
MAX_SQUARE, MEDIAN_SQUARE = 22.46, 5.35
# Poses of the robot are interpolated over at most so many of the tracker's steps (choice).
MAX_GAP = 3.0


@dataclass(frozen=True, eq=False)
class HandEye:
    """The two constant transforms of a robot and a tracker, with their uncertainty.

    Attributes:
        world_from_robot: world_from_base; of a rig on the flange, world_from_flange.
        robot_from_object: flange_from_object; of a rig on the flange, base_from_object.
        world_covariance, object_covariance: (6, 6) of (w, d) of these transforms (docs/conventions.md).
        rotation_residual, position_residual: (n,) radians and units, of each pose.
        used: (n,) mask of the poses that agree; the others are not used.
        variance_factor: mean squared residual, divided by its covariance, per degree of freedom. If it is above 1,
            covariances include it.
        axis_spread: second over first singular value of the rotation axes; 0 if they are parallel.
    """

    world_from_robot: RigidTransform
    robot_from_object: RigidTransform
    world_covariance: FloatArray
    object_covariance: FloatArray
    rotation_residual: FloatArray
    position_residual: FloatArray
    used: BoolArray
    variance_factor: float
    axis_spread: float


def solve_hand_eye(tracked: RigidTransform, covariance: FloatArray, robot: RigidTransform) -> HandEye:
    """Solve tracked_k = X robot_k Y for X and Y.

    Args:
        tracked: n poses world_from_object.
        covariance: (n, 6, 6) of them. Those that are not positive definite, as of the first frame, are replaced by the
            mean.
        robot: n poses base_from_flange, or flange_from_base of a rig on the flange, in the same unit.

    Raises:
        ValueError: too few poses; motions that do not determine the transforms; motions that differ.
    """
    if len(tracked) != len(robot) or len(tracked) < MIN_POSES:
        raise ValueError(f"hand-eye calibration needs at least {MIN_POSES} poses of both, got {len(robot)}")
    pairs = select_pairs(len(tracked))
    spread = _check_motions(tracked, robot, pairs)
    weights = np.linalg.inv(np.linalg.cholesky(_repair_covariances(np.asarray(covariance, float))))
    start = _solve_linearly(tracked, robot, pairs)
    inverse = _solve_linearly(tracked, robot.inv(), pairs)
    squares, inverse_squares = (
        np.median(np.sum(_whiten(tracked, poses, *x, weights) ** 2, axis=1))
        for poses, x in ((robot, start), (robot.inv(), inverse))
    )
    if inverse_squares < INVERSE_RATIO * squares:
        raise ValueError(
            "the robot's poses fit only as their inverses: give base_from_flange, with --eye-in-hand if and only if the "
            "cameras are on the flange"
        )

    (world, moved), _, _ = _optimize(start, tracked, robot, weights, "huber")
    squares = np.sum(_whiten(tracked, robot, world, moved, weights) ** 2, axis=1)
    used = np.asarray(squares < MAX_SQUARE * max(1.0, float(np.median(squares)) / MEDIAN_SQUARE))
    (world, moved), total, factor = _optimize((world, moved), tracked[used], robot[used], weights[used], "linear")
    errors = _subtract(tracked, world * robot * moved)
    rotation, position = np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(errors[:, 3:], axis=1)
    return HandEye(world, moved, total[:6, :6], total[6:, 6:], rotation, position, used, factor, spread)


def _optimize(
    start: tuple[RigidTransform, RigidTransform],
    tracked: RigidTransform,
    robot: RigidTransform,
    weights: FloatArray,
    loss: str,
) -> tuple[tuple[RigidTransform, RigidTransform], FloatArray, float]:
    """Minimize whitened residuals; return X and Y, their covariance (12, 12), and the variance factor."""

    def residuals(x: FloatArray) -> FloatArray:
        return _whiten(tracked, robot, _move(start[0], x[:6]), _move(start[1], x[6:]), weights).ravel()

    extent = max(float(np.ptp(tracked.translation, axis=0).max()), 1e-9)
    scale = np.repeat([1.0, extent, 1.0, extent], 3)
    # Robust to a spread that is larger than stated.
    cutoff = HUBER_CUTOFF * max(1.0, 1.4826 * float(np.median(np.abs(residuals(np.zeros(12))))))
    result = least_squares(residuals, np.zeros(12), x_scale=scale, loss=loss, f_scale=cutoff)
    factor = float(2.0 * result.cost / (6 * len(tracked) - 12))
    # Scaled, since rotations and lengths may differ by orders of magnitude.
    jacobian = result.jac * scale
    total = np.linalg.inv(jacobian.T @ jacobian) * np.outer(scale, scale) * max(factor, 1.0)
    return (_move(start[0], result.x[:6]), _move(start[1], result.x[6:])), total, factor


def interpolate_robot(
    times: FloatArray, robot_times: FloatArray, robot: RigidTransform
) -> tuple[IntArray, RigidTransform]:
    """Return the robot's poses at the times of the tracker, interpolated.

    A robot that stops has few poses, far apart; each then belongs to the tracked pose that is nearest in time.

    Args:
        times: (n,) increasing.
        robot_times: (m,) increasing.
        robot: m poses.

    Returns:
        the indices of the times that have a pose of the robot, and these poses.

    Raises:
        ValueError: none is.
    """
    if len(robot_times) < 2 or (np.diff(robot_times) <= 0).any():
        raise ValueError("the robot's file needs two poses or more, at increasing times")
    right = np.clip(np.searchsorted(robot_times, times), 1, len(robot_times) - 1)
    left = right - 1
    limit = MAX_GAP * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    inside = (robot_times[left] <= times) & (times <= robot_times[right])
    exact = (robot_times[left] == times) | (robot_times[right] == times)
    found = np.asarray(np.flatnonzero(inside & (exact | (robot_times[right] - robot_times[left] <= limit))), np.int64)
    if not len(found) and len(times) > 1:
        rows, robot_rows = associate_timestamps(times, robot_times, limit / MAX_GAP)
        rows, first = np.unique(rows, return_index=True)
        if len(rows):
            return np.asarray(rows, np.int64), robot[robot_rows[first]]
    if not len(found):
        span = [f"{row[0]:g} to {row[-1]:g} s" for row in (times, robot_times)]
        raise ValueError(
            f"no tracked pose (times {span[0]}) has a pose of the robot (times {span[1]}): both need one clock"
        )
    positions = np.stack([np.interp(times[found], robot_times, column) for column in robot.translation.T], axis=1)
    return found, RigidTransform.from_components(positions, Slerp(robot_times, robot.rotation)(times[found]))


def _check_motions(tracked: RigidTransform, robot: RigidTransform, pairs: IntArray) -> float:
    """Return the spread of the robot's rotation axes; refuse degenerate and different motions."""
    i, j = pairs.T
    vectors, others = ((poses[j] * poses[i].inv()).rotation.as_rotvec() for poses in (robot, tracked))
    angles, tracked_angles = np.linalg.norm(vectors, axis=1), np.linalg.norm(others, axis=1)
    if angles.max() < MIN_ROTATION:
        raise ValueError(
            f"the robot rotates by {np.degrees(angles.max()):.1f} degrees only: rotate it by 30 degrees and more about two "
            "axes"
        )
    tolerance = np.maximum(ANGLE_TOLERANCE, RELATIVE_ANGLE_TOLERANCE * angles)
    moved = (angles > MIN_ROTATION) & (angles < np.pi - MIN_ROTATION)
    different = np.abs(angles - tracked_angles) > tolerance
    if moved.any() and different[moved].mean() > MAX_DIFFERENT:
        raise ValueError(
            f"robot and object rotate by different angles in {100 * different[moved].mean():.0f} % of the pairs of poses: "
            "check that their times are of one clock, and the order and unit of the robot's angles"
        )
    spread = measure_axis_spread(vectors)
    if spread < MIN_AXIS_SPREAD:
        raise ValueError(
            "the robot rotates about parallel axes only, which leaves a translation along them undetermined: rotate it "
            "about a second axis as well"
        )
    return spread


def _repair_covariances(covariance: FloatArray) -> FloatArray:
    """Replace covariances that are not finite and positive definite by the mean of the others, or the identity."""
    valid = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    scale = np.sqrt(np.where(valid[:, None], np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    valid &= (scale > 0).all(axis=1)
    for k in np.flatnonzero(valid):
        valid[k] = np.linalg.eigvalsh(covariance[k] / np.outer(scale[k], scale[k]))[0] > 1e-9
    mean = covariance[valid].mean(axis=0) if valid.any() else np.eye(6)
    return np.where(valid[:, None, None], covariance, mean)


def _solve_linearly(
    tracked: RigidTransform, robot: RigidTransform, pairs: IntArray
) -> tuple[RigidTransform, RigidTransform]:
    """Solve A X = X B over pairs of poses, and the translations of X and Y over all poses."""
    i, j = pairs.T
    a, b = ((poses[j].rotation * poses[i].rotation.inv()).as_matrix() for poses in (tracked, robot))
    rotation = solve_hand_eye_rotation(a, b, np.ones(len(pairs))).rotation
    solution = solve_hand_eye_translations(
        np.stack([np.eye(3), rotation]),
        robot.rotation.as_matrix(),
        np.stack([robot.translation, tracked.translation]),
        np.broadcast_to(np.eye(3), (2, len(robot), 3, 3)),
        has_known_scales=True,
    )
    world = RigidTransform.from_components(solution.translations[1], Rotation.from_matrix(rotation))
    rest = (world * robot).inv() * tracked
    return world, RigidTransform.from_components(solution.offsets[1], rest.rotation.mean())


def _move(pose: RigidTransform, error: FloatArray) -> RigidTransform:
    return RigidTransform.from_components(pose.translation + error[3:], Rotation.from_rotvec(error[:3]) * pose.rotation)


def _subtract(a: RigidTransform, b: RigidTransform) -> FloatArray:
    """Return (n, 6) errors (w, d) from b to a."""
    return np.hstack([(a.rotation * b.rotation.inv()).as_rotvec(), a.translation - b.translation])


def _whiten(
    tracked: RigidTransform, robot: RigidTransform, world: RigidTransform, moved: RigidTransform, weights: FloatArray
) -> FloatArray:
    """Return (n, 6) residuals of unit variance."""
    errors = _subtract(tracked, world * robot * moved)
    return np.asarray((weights @ errors[:, :, None])[:, :, 0])
